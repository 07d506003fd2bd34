"""Dot products of one vector with several in LLVM's language: one instruction for all of a row.

What a processor waits for in a long formula is its instructions, of which it keeps some 32 kB at
hand; those of a vector are as long as those of a number.
"""

from collections.abc import Iterable, Sequence

from crane.codegen.llvm.functions import real

# Products may be fused with sums. Reordering sums would gain nothing and let NaN cancel.
FAST = "nsz arcp contract"
Operands = Sequence[float | int]


def operand_word(operand: float | int) -> str:
    """A number, or what an operation gave."""
    return f"%v{operand}" if isinstance(operand, int) else real(operand)


def common(operation: tuple) -> tuple:
    """What dots have in common that are taken together: the name and the first vector."""
    return operation[: 1 + len(operation) // 2]


def dots_text(step: Sequence[int], operands: Sequence[Operands], known: set[str]) -> list[str]:
    """Statements that give `%d` and the first index, and each of them as a number.

    Args:
        step: Indices of the dots.
        operands: Of each.
        known: Names of vectors that are there; takes those that are made.
    """
    kind, half, name = _kind(len(step)), len(operands[0]) // 2, f"%d{step[0]}"
    lines: list[str] = []
    total = ""
    for i in range(half):
        factor = _packed([operands[0][i]] * len(step), known, lines)
        other = _packed([each[half + i] for each in operands], known, lines)
        made = name if half == 1 else f"{name}_{i}"
        lines.append(f"  {made} = fmul {FAST} {kind} {factor}, {other}")
        if i:
            before, made = made, name if i == half - 1 else f"{name}_{i}_"
            lines.append(f"  {made} = fadd {FAST} {kind} {total}, {before}")
        total = made
    lines += [
        f"  %v{index} = extractelement {kind} {name}, i32 {lane}"
        for lane, index in enumerate(step)
    ]
    return lines


def stored_dots(step: Sequence[int], places: Iterable[tuple[int, int]]) -> list[str]:
    """Statements that put dots into the outputs, those side by side at once.

    Args:
        step: Indices of the dots.
        places: Places of outputs, and which of the dots goes there.
    """
    lines: list[str] = []
    runs: list[list[tuple[int, int]]] = []
    for at, lane in sorted(places):
        if runs and runs[-1][-1] == (at - 1, lane - 1):
            runs[-1].append((at, lane))
        else:
            runs.append([(at, lane)])
    for run in runs:
        at, kind, short = run[0][0], _kind(len(step)), _kind(len(run))
        lanes = ", ".join(f"i32 {lane}" for _, lane in run)
        lines += [
            f"  %s{at} = shufflevector {kind} %d{step[0]}, {kind} poison, "
            f"<{len(run)} x i32> <{lanes}>",
            f"  %q{at} = getelementptr double, ptr %out, i64 {at}",
            f"  store {short} %s{at}, ptr %q{at}, align 8",
        ]
    return lines


def _packed(operands: Operands, known: set[str], lines: list[str]) -> str:
    """The name of a vector of numbers, whose statements are added where it is new."""
    kind, words = _kind(len(operands)), [operand_word(x) for x in operands]
    same = len(set(words)) == 1
    name = "%w" + "_".join(word.removeprefix("%") for word in words)
    if name in known:
        return name
    known.add(name)
    vector = "poison"
    for lane, word in enumerate(words[:1] if same else words):
        made = name if lane == len(words) - 1 else f"{name}.{lane}"
        lines.append(f"  {made} = insertelement {kind} {vector}, double {word}, i32 {lane}")
        vector = made
    if vector != name:
        lines.append(
            f"  {name} = shufflevector {kind} {vector}, {kind} poison, "
            f"<{len(words)} x i32> zeroinitializer"
        )
    return name


def _kind(count: int) -> str:
    return f"<{count} x double>"
