"""Cost of exported machines on a Cortex-M7: instructions in an emulator, cycles by latencies.

    python scripts/cortex_m7.py mini_forwarder [--float]

writes the machine as C sources, compiles them with arm-none-eabi-gcc (Debian: gcc-arm-none-eabi,
libnewlib-arm-none-eabi) for the double or single precision unit of the core, runs their self-test
in qemu-system-arm (board mps2-an500) and records the instructions of single calls there. Cycles
are estimated with the latencies of LLVM's model of the core, one instruction at a time, each when
its operands are there; the upper bound has all latencies one after another. The core issues two
at a time where it can and predicts branches, of which each costs `BRANCH` further cycles here;
waits for memory are not in the figures, as if code and data were in tightly coupled memory.
"""

import argparse
import re
import subprocess
import tempfile
from collections import Counter
from pathlib import Path

import crane

FLAGS = ["-std=c99", "-O2", "-mcpu=cortex-m7", "-mfpu=fpv5-d16", "-mfloat-abi=hard"]
FUNCTIONS = {
    "close_loops": "(&m, q)", "follow_loops": "(&m, q_a, q)", "gamma": "(&m, q, out)",
    "inverse_dynamics": "(&m, q, v, x, out)",
    "inverse_dynamics_with_friction": "(&m, q, v, x, out)",
    "forward_dynamics": "(&m, q, v, x, out)",
    "forward_dynamics_with_friction": "(&m, q, v, x, out)", "advance_fixed": "(&m)",
}  # fmt: skip
BRANCH, FREQUENCY = 6, 480e6
# latencies of LLVM's model of the core (ARMScheduleM7.td): double precision, single precision
LATENCIES = (
    (r"vdiv|vsqrt", 30, 16), (r"vf?n?m[al][as]|vfn?m[as]", 11, 6), (r"vn?mul", 7, 3),
    (r"vadd|vsub", 4, 3), (r"v", 3, 3), (r"sdiv|udiv", 12, 12), (r"ld|pop", 2, 2),
)  # fmt: skip
STARTUP = """
extern unsigned _stack;
extern int main(void);
extern void initialise_monitor_handles(void);
extern void _exit(int);
void reset(void)
{
    *(volatile unsigned *)0xE000ED88 |= 0xFu << 20; /* floating point unit */
    __asm volatile("dsb\\nisb");
    initialise_monitor_handles();
    _exit(main());
}
__attribute__((section(".vectors"), used))
static void *const vectors[2] = {&_stack, (void *)reset};
"""
LINKER = """
ENTRY(reset)
SECTIONS {
    . = 0; .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) *(.ARM*) }
    . = 0x20000000; .data : { *(.data*) } .bss : { *(.bss*) *(COMMON) } end = .;
    _stack = 0x20200000;
}
"""
MEASUREMENT = """
#include "@.h"
@_real q[@UPPER_NQ], q_a[@UPPER_N], v[@UPPER_N], x[@UPPER_N], out[4096];
@ m;
void __attribute__((noinline)) mark(void) { __asm volatile(""); }
int main(void)
{
    const int active[] = {ACTIVE};
    int i;
    m = @_defaults;
    m.step = 1e-3;
    if (@_initialize(&m) != 1) return 1;
    for (i = 0; i < @UPPER_NQ; ++i) q[i] = m.q[i];
    for (i = 0; i < @UPPER_N; ++i) {
        q_a[i] = q[active[i]] + SHIFT;
        v[i] = 0.1 * (i + 1);
        x[i] = 1.0 - 0.3 * i;
    }
    CALLS
    mark();
    return 0;
}
"""


def sources(machine: crane.Machine, folder: Path) -> None:
    """Write the machine as arm.c, with the programs around it."""
    crane.export.write_c(machine, folder, name="arm")
    header = (folder / "arm.h").read_text()
    calls = [f"mark(); @_{name}{x};" for name, x in FUNCTIONS.items() if f"arm_{name}(" in header]
    active = ", ".join(map(str, machine.closure.active.tolist()))
    text = MEASUREMENT.replace("CALLS", "\n    ".join(calls)).replace("ACTIVE", active)
    text = text.replace("@UPPER", "ARM").replace("@", "arm").replace("SHIFT", "1e-4")
    for name, content in {"measure.c": text, "startup.c": STARTUP, "m7.ld": LINKER}.items():
        (folder / name).write_text(content)


def build(folder: Path, program: str, flags: list[str]) -> None:
    """Compile and link a program with the machine, for RAM of the board."""
    link = ["--specs=rdimon.specs", "-nostartfiles", "-Wl,-T,m7.ld", "-Wl,--gc-sections"]
    compiler = ["arm-none-eabi-gcc", *FLAGS, *flags]
    if not (folder / "arm.o").exists():
        subprocess.run([*compiler, "-c", "arm.c"], cwd=folder, check=True)
    command = [
        *compiler,
        *link,
        "startup.c",
        f"{program}.c",
        "arm.o",
        "-o",
        f"{program}.elf",
        "-lm",
    ]
    subprocess.run(command, cwd=folder, check=True)


def emulate(folder: Path, program: str, *options: str) -> str:
    """Run a program on the emulated board and return what it prints."""
    command = ["qemu-system-arm", "-M", "mps2-an500", "-nographic", "-semihosting", *options]
    done = subprocess.run([*command, "-kernel", f"{program}.elf"], cwd=folder, capture_output=True,
                          text=True, timeout=600, check=False)  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{program}: {done.stdout}{done.stderr}")
    return done.stdout


def disassembly(folder: Path, program: str) -> dict[int, str]:
    """Instructions by address."""
    command = ["arm-none-eabi-objdump", "-d", "--no-show-raw-insn", f"{program}.elf"]
    text = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout
    found = re.findall(r"^ *([0-9a-f]+):\t([^;@\n]+)", text, re.MULTILINE)
    marks = [int(x, 16) for x in re.findall(r"^([0-9a-f]+) <mark>:", text, re.MULTILINE)]
    return {int(at, 16): "mark" if int(at, 16) in marks else x.strip() for at, x in found}


def calls(folder: Path) -> list[list[str]]:
    """Instructions of each call in order."""
    emulate(folder, "measure", "-singlestep", "-d", "exec,nochain", "-D", "trace.log")
    at = disassembly(folder, "measure")
    found: list[list[str]] = [[]]
    with (folder / "trace.log").open() as log:
        for line in log:
            match = re.match(r"Trace 0: \S+ \[[0-9a-f]+/([0-9a-f]+)/", line)
            if match is None:
                continue
            instruction = at[int(match[1], 16)]
            if instruction == "mark":
                found.append([])
            found[-1].append(instruction)
    return found[1:-1]


def is_branch(instruction: str) -> bool:
    """Whether an instruction may jump."""
    return bool(re.match(r"(b(?!ic|fi|fc|kpt)|cb|tb)", instruction)) or "pc}" in instruction


def latency(instruction: str, is_double: bool) -> int:
    """Cycles until the result of an instruction can be used."""
    for pattern, double, single in LATENCIES:
        if re.match(pattern, instruction):
            return double if is_double or ".f64" in instruction else single
    return 1


def registers(text: str) -> list[str]:
    """Registers of an operand list; of a single precision register the double one that has it."""
    names = re.findall(r"\b([rds]\d+|sp|lr|ip|fp|sl|sb)\b", text)
    return [f"d{int(x[1:]) // 2}" if re.match(r"s\d", x) else x for x in names]


def in_order_cycles(instructions: list[str], is_double: bool) -> int:
    """Cycles if one instruction is issued at a time, once the results that it needs are there."""
    ready: dict[str, int] = {}
    now = last = 0
    for instruction in instructions:
        name, _, operands = instruction.partition("\t")
        used = registers(operands)
        count = len(used) if re.match(r"push|pop|ldm|stm|vpush|vpop|vldm|vstm", name) else 1
        now = max([now + count, *(ready.get(x, 0) for x in used)])
        if re.match(r"vmrs", name):  # of a comparison
            now = max(now, ready.get("flags", 0))
        result = "flags" if name.startswith("vcmp") else used[0] if used else "flags"
        if not re.match(r"v?st|v?push|cmp|tst|b", name):
            ready[result] = now + latency(instruction, is_double)
            last = max(last, ready[result])
        now += BRANCH * is_branch(instruction)
    return max(now, last)


def main() -> None:
    """Print the table of a machine."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("machine")
    parser.add_argument("--float", action="store_true", help="single precision")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sources(crane.load(options.machine), folder)
        flags = ["-Darm_real=float", "-DMOTION_TOLERANCE=1e300"]
        flags = flags if options.float else []
        for program in ("arm_test", "measure"):
            build(folder, program, flags)
        print(emulate(folder, "arm_test"))
        print("| function | instructions | floating point | cycles | at 480 MHz | upper bound |")
        print("| --- | ---: | ---: | ---: | ---: | ---: |")
        header = (folder / "arm.h").read_text()
        names = [x for x in FUNCTIONS if f"arm_{x}(" in header]
        for function, instructions in zip(names, calls(folder), strict=True):
            bound = BRANCH * sum(map(is_branch, instructions))
            bound += sum(latency(x, not options.float) for x in instructions)
            cycles = in_order_cycles(instructions, not options.float)
            kinds = Counter(x.split(".f")[0] for x in instructions if ".f" in x.split()[0])
            print(
                f"| `{function}` | {len(instructions):,} | {sum(kinds.values()):,} | {cycles:,} | "
                f"{1e6 * cycles / FREQUENCY:.1f} us | {1e6 * bound / FREQUENCY:.1f} us |"
            )


if __name__ == "__main__":
    main()
