"""Machines as programs outside of Python: C by compilers that are here."""

import ctypes
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import singular_linkages
from command_line import typed
from scipy.interpolate import CubicHermiteSpline
from warned import quiet

import crane
from crane.codegen.c_emitter import C_PRELUDE
from crane.codegen.llvm.wasm_emitter import emit_wasm_module
from crane.common.errors import InputError
from crane.control import interpolate_references
from crane.control.force_inputs import ForceInputs
from crane.description.force_elements import Friction
from crane.export import InstanceProgram, write_c
from crane.export.c_sources import CSources
from crane.export.instance_program import DYNAMICS_ROUTINES
from crane.export.instance_routines import BEYOND_CHART, HALTED, TOO_MANY_CALLS
from crane.machine.payload import Payload

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
EVERY_MACHINE = (
    "excavator", "excavator_ls", "excavator_two_pumps", "kr300", "mini_forwarder", "patu655",
    "patu655_grapple", "patu655_ls", "tx40",
)  # fmt: skip
STEP = 1e-3
needs_compiler = pytest.mark.skipif(not COMPILERS, reason="no C compiler is here")


def compiled(folder, name, *flags, compiler=None):
    """The self-test of the sources in a folder as an executable, by strict rules."""
    command = [compiler or COMPILERS[0], *STRICT, *flags, f"{name}.c", f"{name}_test.c"]
    subprocess.run([*command, "-o", "self_test", "-lm"], cwd=folder, check=True, timeout=300)
    return folder / "self_test"


def links(compiler, folder, *flags):
    """Whether a compiler makes a program with some flags."""
    (folder / "empty.c").write_text("int main(void) { return 0; }\n")
    command = [compiler, *flags, "empty.c", "-o", "empty"]
    return not subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode


def run(path, *before):
    done = subprocess.run([*before, path], capture_output=True, text=True, timeout=300)
    return done.returncode, done.stdout + done.stderr


def largest_relative_difference(output):
    return float(re.search(r"dynamics: largest relative difference (\S+),", output)[1])


class Library:
    """The functions of a machine in C, and an instance as numpy arrays by part."""

    def __init__(self, machine, folder, *flags, controller=None, quantities=None):
        quantities = DYNAMICS_ROUTINES if quantities is None else quantities
        self.program = InstanceProgram(machine, quantities, controller=controller)
        sources = CSources(self.program, "m")
        (folder / "m.h").write_text(sources.header())
        (folder / "m.c").write_text(sources.source())
        command = [COMPILERS[0], *STRICT, *(flags or ("-O1",)), "-shared", "-fPIC", "m.c", "-lm"]
        subprocess.run([*command, "-o", "m.so"], cwd=folder, check=True, timeout=300)
        self._library = ctypes.CDLL(str(folder / "m.so"))
        self.instance = self.program.defaults.copy()
        self.at = self.program.layout.view(self.instance)

    def __call__(self, name, *arrays):
        pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in (self.instance, *arrays)]
        return getattr(self._library, f"m_{name}")(*pointers)


def signals(program, times):
    """Signals that open and reverse all valves, one after another."""
    start = program.layout.view(program.defaults).inputs
    found = {}
    for i, (name, spool) in enumerate(program.control.circuit.hydraulics.spools.items()):
        stroke = 0.25 * (spool.full - spool.neutral) * np.sin(3 * times + i)
        found[name] = start[i] + stroke * (times > 0.1)
    return found


def largest_difference(machine, library, steps=150, step=0.01):
    """Of the active coordinates in C and by `simulate`, over their motion; transitions."""
    program, times = library.program, step * np.arange(steps + 1)
    moved = signals(program, times)
    command = crane.control.ValveSignals(machine, times, moved)
    expected = quiet(crane.simulate, machine, command, duration=times[-1], step=step)
    library.at.step[:] = step
    library.at.inputs[: len(moved)] = [x[0] for x in moved.values()]
    assert library("initialize") == 1
    worst = 0.0
    for i in range(steps):
        library.at.inputs[: len(moved)] = [x[i + 1] for x in moved.values()]
        assert library("advance") == 1
        q_a = library.at.q[machine.closure.active]
        worst = max(worst, np.abs(q_a - expected.q[i + 1]).max())
    assert library.at.time[0] == pytest.approx(times[-1], rel=1e-12)
    return worst / np.ptp(expected.q, axis=0).max(), expected


@needs_compiler
def test_sources_compile_without_warnings_and_their_self_test_passes(tmp_path):
    typed("export", "mini_forwarder", "--out", str(tmp_path / "c"), "--name", "crane 1")
    status, output = run(compiled(tmp_path / "c", "crane_1", "-O0"))
    assert status == 0
    assert "motion: status 1" in output


@needs_compiler
@pytest.mark.slow
def test_a_motion_with_joints_that_stick_is_that_of_simulate(tmp_path):
    machine = crane.load("patu655")
    difference, expected = largest_difference(machine, Library(machine, tmp_path))
    assert difference < 1e-12
    stick = np.array([x for name, x in expected.channels.items() if name.startswith("rest_")])
    assert 0 < np.count_nonzero(stick) < stick.size


@needs_compiler
@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("cmake"), reason="no CMake is here")
def test_the_build_by_cmake_uses_this_processor_and_its_self_test_passes(tmp_path):
    program = InstanceProgram(crane.load("kr300"), quantities=("forward_dynamics",))
    for file, text in CSources(program, "m").files().items():
        (tmp_path / file).write_text(text)
    for native in ("OFF", "ON"):
        flags = [f"-DCRANE_NATIVE={native}", "-DCMAKE_BUILD_TYPE=Debug"]
        flags.append("-DCMAKE_EXPORT_COMPILE_COMMANDS=ON")
        subprocess.run(["cmake", "-S", tmp_path, "-B", tmp_path, *flags], check=True, timeout=100)
        commands = (tmp_path / "compile_commands.json").read_text()
        assert ("-march=native" in commands) == (native == "ON")
    subprocess.run(["cmake", "--build", tmp_path], check=True, timeout=300)
    status, output = run(tmp_path / "m_test")
    assert status == 0, output
    assert largest_relative_difference(output) < 1e-13


def compare_with_changes(library, machine, configurations, random):
    """A payload, a slope and friction, set in C, against a machine that was built with them."""
    tensor = np.cov(random.normal(size=(3, 9)))
    tensor, com = np.trace(tensor) * np.eye(3) - tensor, random.normal(size=3)
    column = machine.closure.active[-1]
    joint, law = machine.joints[column], f"{machine.joints[column]}_"
    friction = replace(machine.friction.get(joint, Friction()), coulomb=7.0, viscous=3.0)
    gravity = [1.0, -2.0, -9.0]
    given = {f"gravity_{x}": value for x, value in zip("xyz", gravity, strict=True)}
    given |= {f"{law}coulomb": 7.0, f"{law}viscous": 3.0}
    if machine.friction.get(joint) is None:  # C has no stick-slip transitions of this joint
        given[f"{law}sharpness"] = 1.0 / 0.002
        friction = replace(friction, smoothing=0.002)
    for name, value in given.items():
        library.instance[library.program.names.index(name)] = value
    payload = np.array([50.0, *com, *tensor[np.triu_indices(3)]])
    assert library("set_payload", payload) == 1
    changed = replace(machine, friction=machine.friction | {joint: friction})
    changed = changed.with_payload(Payload(machine.tip, 50.0, tuple(com), tensor))
    changed.model.gravity.linear = np.array(gravity)
    dynamics = crane.Dynamics(changed)
    for q in configurations:
        v, x = random.normal(size=(2, len(machine.active)))
        expected = dynamics.evaluate_closed("inverse with friction", q, v, x)
        found = np.empty_like(expected)
        assert library("inverse_dynamics_with_friction", q, v, x, found) == 1
        assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY_MACHINE)
def test_quantities_at_random_states_are_those_of_the_library(tmp_path, name):
    machine = crane.load(name)
    library, dynamics = Library(machine, tmp_path, "-O0"), crane.Dynamics(machine)
    random, n = np.random.default_rng(2), len(machine.active)
    home, units = (
        machine.home[machine.closure.active],
        machine.closure.units[machine.closure.active],
    )
    path = 0.05 * units * np.sin(0.05 * np.arange(1000)[:, None] * random.uniform(0.5, 1.5, n))
    configurations = machine.closure.solve(home + path)
    quantities = {
        "inverse_dynamics": "inverse",
        "forward_dynamics": "forward",
        "mass_matrix": "mass matrix",
    }
    differences, sizes = ({name: 0.0 for name in quantities} for _ in range(2))
    for q in configurations:
        v, x = random.normal(size=(2, n))
        for routine, quantity in quantities.items():
            expected = dynamics.evaluate_closed(quantity, q, v, x)
            found = np.empty_like(expected)
            assert library(routine, q, v, x, found) == 1
            differences[routine] = max(differences[routine], np.abs(found - expected).max())
            sizes[routine] = max(sizes[routine], np.abs(expected).max())
        closed = q.copy()
        closed[machine.closure.passive] += 1e-3 * units.min()
        assert library("close_loops", closed) == 1
        assert np.abs((closed - q) / machine.closure.units).max() < 1e-13
    assert all(differences[name] < 1e-13 * sizes[name] for name in quantities)
    compare_with_changes(library, machine, configurations[:20], random)


@needs_compiler
@pytest.mark.slow
def test_tools_find_no_error_in_memory_or_arithmetic(tmp_path):
    write_c(crane.load("patu655"), tmp_path, name="m")
    flags = "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
    for compiler in COMPILERS:
        if not links(compiler, tmp_path, *flags):
            continue  # its libraries of sanitizers are another package
        status, output = run(compiled(tmp_path, "m", *flags, compiler=compiler))
        assert status == 0, output
    if shutil.which("valgrind"):
        checked = compiled(tmp_path, "m", "-O1")
        status, output = run(checked, "valgrind", "--error-exitcode=9")
        assert status == 0, output
        assert "total heap usage: 1 allocs" in output  # the buffer of printf


@needs_compiler
@pytest.mark.parametrize("name", ["kr300", pytest.param("patu655", marks=pytest.mark.slow)])
def test_single_precision_keeps_its_digits(tmp_path, name):
    program = InstanceProgram(crane.load(name), quantities=("inverse_dynamics", "bias"))
    for file, text in CSources(program, "m").files().items():
        (tmp_path / file).write_text(text)
    status, output = run(compiled(tmp_path, "m", "-O0", "-Dm_real=float"))
    assert status == 0, output
    assert 1e-9 < largest_relative_difference(output) < 1e-5


@pytest.mark.parametrize("flags", [[], ["-march=native", "-ffp-contract=fast"]])
def test_sines_in_c_are_exact_to_the_last_digits(tmp_path, flags):
    """Against libm in long double, in units in the last place."""
    if np.finfo(np.longdouble).eps > 1e-18 or not COMPILERS:
        pytest.skip("no long double, or no compiler")
    head = "#include <math.h>\n#include <string.h>\ntypedef double real;\n#define R(x) (real)(x)\n"
    call = "void f(int n, const double *x, double *s, double *c, double *m)\n"
    body = (
        "{ while (n--) { s[n] = SIN(x[n]); c[n] = COS(x[n]); m[n] = maximum_of(x[n], 1.0); } }\n"
    )
    (tmp_path / "f.c").write_text(head + C_PRELUDE + call + body)
    command = [COMPILERS[0], "-O2", "-std=c99", "-shared", "-fPIC", *flags, "f.c", "-o", "f.so"]
    subprocess.run([*command, "-lm"], cwd=tmp_path, check=True)
    x = np.concatenate([
        np.random.default_rng(0).uniform(-size, size, 20_000) for size in (1.0, 1e3, 2.9e9)
    ])  # fmt: skip
    x = np.concatenate([x, [0.0, np.nan, np.inf, -4e9]])
    found = np.empty((3, len(x)))
    pointers = [ctypes.c_void_p(row.ctypes.data) for row in (x, *found)]
    ctypes.CDLL(str(tmp_path / "f.so")).f(len(x), *pointers)
    for values, function in zip(found, (np.sin, np.cos), strict=False):
        exact = function(x[:-3].astype(np.longdouble))
        assert (np.abs(values[:-3] - exact) <= 2.5 * np.spacing(np.abs(values[:-3]))).all()
        assert np.isnan(values[-3:]).all()
    np.testing.assert_array_equal(found[2], np.maximum(x, 1.0))


def test_parameters_have_names_and_change_the_motion():
    program = InstanceProgram(crane.load("mini_forwarder"), quantities=("gravity",))
    assert len({*program.names}) == len(program.names) == program.layout.size
    mass = program.defaults[program.names.index("q2_mass")]
    expected = program.machine.model.inertias[program.machine.model.getJointId("q2")].mass
    assert mass == expected
    header = CSources(program).header()
    assert "mini_forwarder_real q2_mass; /* kg */" in header


def test_a_load_that_is_a_function_in_python_is_refused():
    machine = crane.load("mini_forwarder")
    load = crane.description.WrenchFunction(machine.tip, lambda *motion: np.zeros(6))
    with pytest.raises(InputError, match="is a function in Python"):
        InstanceProgram(machine.with_external_forces(load))


@pytest.mark.slow
@pytest.mark.skipif(
    not (shutil.which("aarch64-linux-gnu-gcc") and shutil.which("qemu-aarch64")),
    reason="no cross-compiler with an emulator is here",
)
@pytest.mark.parametrize("name", ["mini_forwarder", "patu655"])
def test_another_processor_with_fused_operations_computes_the_same(tmp_path, name):
    quantities = ("inverse_dynamics_with_friction", "forward_dynamics", "energy")
    program = InstanceProgram(crane.load(name), quantities=quantities)
    for file, text in CSources(program, "m").files().items():
        (tmp_path / file).write_text(text)
    flags = "-O1", "-ffp-contract=fast", "-static"
    path = compiled(tmp_path, "m", *flags, compiler="aarch64-linux-gnu-gcc")
    status, output = run(path, "qemu-aarch64")
    assert status == 0, output
    assert largest_relative_difference(output) < 1e-13


_NODE_PROGRAM = """
const fs = require("fs");
const given = JSON.parse(fs.readFileSync("given.json"));
const module = new WebAssembly.Module(fs.readFileSync("machine.wasm"));
const machine = new WebAssembly.Instance(module, { math: Math }).exports;
const numbers = new Float64Array(machine.memory.buffer), start = 8;
numbers.set(given.defaults, start);
const statuses = [machine.initialize(8 * start)], motion = [];
for (const row of given.inputs.slice(1)) {
  numbers.set(row, start + given.input);
  statuses.push(machine.advance(8 * start));
  motion.push(Array.from(numbers.subarray(start + given.q, start + given.q + given.nq)));
}
console.log(JSON.stringify({ statuses, motion }));
"""


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("node"), reason="no node is here")
def test_a_motion_in_web_assembly_is_that_of_simulate(tmp_path):
    machine, step, steps = crane.load("patu655"), 0.01, 100
    program, times = InstanceProgram(machine, quantities=()), step * np.arange(steps + 1)
    moved, start = signals(program, times), program.layout.start_index
    command = crane.control.ValveSignals(machine, times, moved)
    expected = quiet(crane.simulate, machine, command, duration=times[-1], step=step)
    defaults, inputs = program.defaults.copy(), np.column_stack(list(moved.values()))
    program.layout.view(defaults).step[:] = step
    program.layout.view(defaults).inputs[: inputs.shape[1]] = inputs[0]
    given = {
        "defaults": defaults.tolist(), "inputs": inputs.tolist(), "input": start("inputs"),
        "q": start("q"), "nq": machine.model.nv,
    }  # fmt: skip
    module = emit_wasm_module(program.functions, program.entries, program.layout.size + 8)
    (tmp_path / "machine.wasm").write_bytes(module)
    (tmp_path / "given.json").write_text(json.dumps(given))
    command_line = ["node", "-e", _NODE_PROGRAM]
    done = subprocess.run(command_line, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    found = json.loads(done.stdout)
    assert set(found["statuses"]) == {1}
    difference = np.array(found["motion"])[:, machine.closure.active] - expected.q[1:]
    assert np.abs(difference).max() < 1e-12 * np.ptp(expected.q, axis=0).max()


def tracking_difference(machine, task, make_controller, folder, steps, step=0.01):
    """Of the active coordinates in C and by `simulate` with a reference by samples, relative."""
    reference = crane.task_trajectory(machine, task)
    law, times = make_controller(machine, reference), step * np.arange(steps + 1)
    rows, start = law.references(times), reference.position(0.0)
    sampled = interpolate_references(law, times, rows)
    expected = quiet(
        crane.simulate, machine, sampled, initial=start, duration=times[-1], step=step
    )
    library = Library(machine, folder, controller=law, quantities=())
    library.at.step[:] = step
    library.at.q[machine.closure.active] = start
    library.at.inputs[: len(rows.T)] = rows[0]
    assert library("initialize") == 1
    worst = 0.0
    for row, q_a in zip(rows[1:], expected.q[1:], strict=True):
        library.at.inputs[: len(row)] = row
        assert library("advance") == 1
        worst = max(worst, np.abs(library.at.q[machine.closure.active] - q_a).max())
    motion, errors = np.ptp(expected.q, axis=0).max(), expected.q - reference.position(times)
    return worst / motion, np.abs(errors).max() / motion


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "task", "controller", "steps"),
    [
        ("mini_forwarder", "lift", crane.PI, 1000),
        ("patu655", "reach", crane.control.ValvePD, 400),
    ],
)
def test_a_closed_loop_is_that_of_simulate(tmp_path, name, task, controller, steps):
    machine = crane.load(name)
    difference, error = tracking_difference(machine, task, controller, tmp_path, steps)
    assert difference < 1e-12
    assert error < 0.5  # the loop is closed


def test_a_controller_has_its_gains_and_references_by_name():
    machine = crane.load("mini_forwarder")
    controller = crane.control.make_controller("pi", machine)
    program = InstanceProgram(machine, (), controller=controller)
    at = program.layout.view(np.array(program.names))
    assert at.inputs.tolist()[:3] == ["reference_q1", "reference_X1", "reference_X2"]
    assert at.settings.tolist()[:4] == ["q1_kp", "X1_kp", "X2_kp", "q1_ki"]
    assert at.controller.tolist()[0] == "error_integral_q1"
    home = program.layout.view(program.defaults).inputs[:3]
    assert home == pytest.approx(machine.home[machine.closure.active])


@needs_compiler
def test_a_dead_centre_ends_the_motion_with_a_status(tmp_path):
    """A slider that its drive pushes out; `simulate` passes the dead centre."""
    machine = singular_linkages.slider_crank(tmp_path, "s", 0.3, 0.6)
    pushed = interpolate_references(ForceInputs(machine), [0.0, 1.0], [[40.0], [40.0]])
    expected = quiet(crane.simulate, machine, pushed, duration=0.5, step=STEP)
    library = Library(machine, tmp_path, quantities=())
    library.at.step[:] = STEP
    library.at.inputs[0] = library.at.inputs_start[0] = 40.0
    assert library("initialize") == 1
    worst, statuses = 0.0, [1]
    for q_a in expected.q[1:]:
        statuses.append(library("advance"))
        if statuses[-1] != 1:
            break
        worst = max(worst, abs(library.at.q[machine.closure.active] - q_a)[0])
    assert statuses[-1] == BEYOND_CHART and library("advance") == BEYOND_CHART
    assert (
        library("derivatives", np.empty(library.program.chart.state_layout.size)) == BEYOND_CHART
    )
    assert worst < 1e-12
    last, (end,) = library.at.q[machine.closure.active][0], library.at.time
    motion = CubicHermiteSpline(expected.time, expected.q[:, 0], expected.v[:, 0])
    assert last == pytest.approx(motion(end), abs=1e-9)
    assert 0.88 < last < expected.q.max() < 0.9 + 1e-9  # of rods of 0.3 m and 0.6 m
    library.at.q[:], library.at.v_a[:] = machine.home, 0.0
    assert library("initialize") == 1 and library("advance") == 1
    for step in (0.0, -STEP, np.inf, np.nan):
        library.at.step[:], time = step, library.at.time.copy()
        assert library("advance") == HALTED and library.at.time == time


@needs_compiler
@pytest.mark.slow
def test_dead_times_of_valves_are_those_of_simulate(tmp_path):
    """Not whole milliseconds, nor equal for all valves."""
    machine = crane.load("patu655", {"valve.X_lift.delay": 0.0437, "valve.X_ext.delay": 0.02})
    library = Library(machine, tmp_path, quantities=())
    assert "X_lift_delay" in library.program.names
    assert largest_difference(machine, library, steps=100)[0] < 1e-12
    for step, most in ((1e-3, 200), (1e-4, 100)):  # that of `simulate`, and a tenth of it
        library.at.step[:] = step
        statuses = {library("advance") for _ in range(most)}
        assert statuses == ({1} if step == 1e-3 else {1, TOO_MANY_CALLS})


def test_controllers_that_are_programs_in_python_are_refused():
    machine = crane.load("patu655", {"valve.X_lift.delay": 0.05})
    for controller, text in (
        (lambda time, q_a, v_a: 0.0 * q_a, "function is computed in Python"),
        (crane.control.SampledCommand(lambda *at: np.zeros(4), machine), "SampledCommand is comp"),
        (crane.control.make_controller("valve-pd", machine), "ValvePD with valves that have a de"),
    ):
        with pytest.raises(InputError, match=text):
            InstanceProgram(machine, controller=controller)
