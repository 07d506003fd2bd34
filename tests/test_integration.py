"""Integration steps in machine code against the same steps in Python, and other methods."""

import numpy as np
import pytest

import crane
import crane.codegen.program
from crane.common.errors import SimulationError
from crane.simulation.integration.machine_code_stepper import RungeKuttaStepper
from crane.simulation.integration.python_stepper import PythonStepper


def simulate(*arguments, method="rk4", **settings):
    """By steps that can be counted."""
    return crane.simulate(*arguments, method=method, **settings)


pytestmark = pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")


@pytest.fixture(scope="module")
def forwarder(smooth):
    return smooth  # whose steps are as many as there are


@pytest.fixture(scope="module")
def path(forwarder):
    return crane.task_trajectory(forwarder, "return")


@pytest.fixture(scope="module")
def springy(forwarder):
    """Carried by springs at the actuators, braked a little, without anything that jumps."""
    middle = np.array([0.0, 0.015, 0.015])
    weight = crane.Dynamics(forwarder).gravity(middle)
    springs = tuple(
        crane.description.ForceElement(
            joint, stiffness=k, damping=c, rest=float(middle[i] + weight[i] / k)
        )
        for i, (joint, k, c) in enumerate(
            zip(forwarder.active, (0.3, 2e3, 4e3), (0.01, 20.0, 30.0), strict=True)
        )
    )
    return forwarder.replace(friction={}, forces=springs, end_stops=())


class InPython:
    """A controller that cannot be traced: what `simulate` sees of it is the Python part."""

    def __init__(self, control):
        self._control, self.reference = control, control.reference

    def start(self, q_a):
        return self._control.start(q_a)

    def __call__(self, time, q_a, v_a, state):
        return self._control(time, q_a, v_a, state)


class Push(crane.control.ControlLaw):
    """Constant forces."""

    def __init__(self, machine, *forces):
        super().__init__(machine)
        self.settings = np.array(forces, dtype=np.float64)

    def law(self, inputs):
        return inputs.settings, ()


@pytest.fixture
def steps(monkeypatch):
    """How many steps were done in machine code and how many in Python."""
    done = {"compiled": 0, "python": 0}
    run, advance = RungeKuttaStepper.run, PythonStepper.advance

    def counted_run(self, *rest):
        count = run(self, *rest)
        done["compiled"] += count
        return count

    def counted_advance(self, *rest):
        done["python"] += 1
        return advance(self, *rest)

    monkeypatch.setattr(RungeKuttaStepper, "run", counted_run)
    monkeypatch.setattr(PythonStepper, "advance", counted_advance)
    return done


def traces(recording):
    """Everything that was recorded, (N, .)."""
    return np.column_stack([recording.q, recording.v, recording.tau, *recording.channels.values()])


def off(one, two):
    """Largest difference of any recorded quantity, relative to the largest it takes."""
    assert list(one.channels) == list(two.channels)
    a, b = traces(one), traces(two)
    assert a.shape == b.shape and np.isfinite(a).all()
    size = np.abs(b).max(axis=0)
    size = np.maximum(size, 1e-3)  # what hardly moves is measured in thousandths
    return float((np.abs(a - b) / size).max())


CONTROLS = {
    "pi": lambda machine, path: crane.PI(machine, path),
    "pi falling": lambda machine, path: crane.PI(machine, path, integral=np.zeros(3)),
    "computed torque": lambda machine, path: crane.ComputedTorque(machine, path),
    "free": lambda machine, path: None,
    "push": lambda machine, path: Push(machine, 0.2, 12.0, -5.0),
}


@pytest.mark.parametrize("name", CONTROLS)
def test_machine_code_python_and_pinocchio_step_alike(forwarder, path, steps, name):
    control = CONTROLS[name](forwarder, path)
    plain = control or crane.control.ZeroForce(forwarder)
    settings = {"duration": 0.1, "step": 1e-3}
    if name == "pi":  # not at rest, with an offset
        start = path(0.0)[0] + [0.1, 0.001, -0.0005]
        settings["initial"] = (start, np.array([0.3, 0.01, -0.005]))
    compiled = simulate(forwarder, control, **settings)
    assert steps == {"compiled": 100, "python": 0}
    python = simulate(forwarder, InPython(plain), **settings)
    assert steps == {"compiled": 100, "python": 100}
    pinocchio = simulate(forwarder, control, **settings, backend="pinocchio")
    assert steps == {"compiled": 100, "python": 200}
    assert np.ptp(compiled.q, axis=0).max() > 1e-4  # it moves
    assert off(compiled, python) < 1e-10
    assert off(compiled, pinocchio) < 1e-10
    states = np.abs(compiled.q - python.q).max(), np.abs(compiled.q - pinocchio.q).max()
    assert max(states) < 1e-12


@pytest.mark.parametrize("name", ["slider_crank", "five_bar", "ur5_robot"])
def test_other_machines_step_alike(name, steps, request):
    machine = crane.load(name) if name == "ur5_robot" else request.getfixturevalue(name)
    runs = [
        simulate(machine, control, duration=0.05, backend=backend)
        for control, backend in (
            (None, "compiled"),
            (InPython(crane.control.ZeroForce(machine)), "compiled"),
            (None, "pinocchio"),
        )
    ]
    assert steps == {"compiled": 50, "python": 100}
    assert off(runs[0], runs[1]) < 1e-10 and off(runs[0], runs[2]) < 1e-10


def test_energies_are_integrated_alike_and_balance(forwarder, path, steps):
    control = crane.PI(forwarder, path)
    one = simulate(forwarder, control, duration=0.4)
    two = simulate(forwarder, control, duration=0.4, backend="pinocchio")
    assert steps == {"compiled": 400, "python": 400}
    for name in ("work", "dissipated", "kinetic", "potential"):
        assert np.ptp(one.channels[name]) > 1e-5
        size = np.abs(two.channels[name]).max()
        assert np.abs(one.channels[name] - two.channels[name]).max() < 1e-11 * size
    energy = one.channels["kinetic"] + one.channels["potential"]
    gap = one.channels["work"] - (energy - energy[0]) - one.channels["dissipated"]
    assert np.abs(gap).max() < 1e-6 * np.ptp(one.channels["work"])


def test_what_dampers_and_end_stops_take_out_is_integrated_alike(springy, steps):
    stops = tuple(crane.description.EndStop(joint, 2e4, damping=15.0) for joint in ("X1", "X2"))
    machine = springy.replace(end_stops=stops)
    start = (np.array([0.0, 0.0295, 0.0005]), np.array([0.5, 0.3, -0.2]))
    one, two = (
        simulate(machine, None, start, duration=0.05, step=2e-4, backend=backend)
        for backend in ("compiled", "pinocchio")
    )
    assert steps == {"compiled": 250, "python": 250}
    assert one.q[:, 1].max() > machine.upper[1] + 1e-4 and one.q[:, 2].min() < -1e-4
    assert off(one, two) < 1e-10
    lost = one.channels["dissipated"]
    assert np.abs(lost - two.channels["dissipated"]).max() < 1e-11 * lost[-1]
    energy = one.channels["kinetic"] + one.channels["potential"]
    assert np.abs(energy - energy[0] + lost).max() < 1e-4 * lost[-1]
    machine = springy.replace(
        end_stops=tuple(crane.description.EndStop(s.joint, 2e4) for s in stops)
    )
    elastic = simulate(machine, None, start, duration=0.05, step=2e-4)
    assert elastic.channels["dissipated"][-1] < 0.9 * lost[-1]  # the stops' damping counts


def test_a_function_moves_as_the_same_law_built_in(forwarder, path, steps):
    gains = {joint: crane.description.PIGains(g.kp, 0.0) for joint, g in forwarder.control.items()}
    kp = np.array([gains[joint].kp for joint in forwarder.active])
    start = path(0.0)[0]
    one = simulate(forwarder, crane.PI(forwarder, path, gains), start, duration=0.2)
    assert steps == {"compiled": 200, "python": 0}
    two = simulate(forwarder, lambda t, q, v: kp * (path(t)[0] - q), start, duration=0.2)
    assert steps == {"compiled": 200, "python": 200}
    assert np.abs(one.q - two.q).max() < 1e-12
    np.testing.assert_allclose(one.tau, two.tau, atol=1e-12 * np.abs(one.tau).max(), rtol=0)
    np.testing.assert_allclose(one.channels["work"], two.channels["work"], atol=1e-12)


# --- chunks and steps that need a closer look ------------------------------------------------


def test_chunks_are_seamless(forwarder, path, steps, monkeypatch):
    control = crane.PI(forwarder, path)
    whole = simulate(forwarder, control, duration=0.253)
    assert steps["python"] == 0
    for chunk in (1, 7, 11, 252, 253, 254):
        monkeypatch.setattr("crane.simulation.integration.integrators._STEPS_PER_REPORT", chunk)
        shares = []
        parts = simulate(forwarder, control, duration=0.253, progress=shares.append)
        assert off(parts, whole) < 1e-12
        assert shares == sorted(shares) and shares[-1] == 1.0
        assert len(shares) >= 253 // chunk
    assert steps["python"] == 0


@pytest.mark.parametrize("count", [999, 1000, 1001, 2000])
def test_durations_around_whole_chunks(springy, steps, count):
    step = 5e-4
    start = [0.1, 0.018, 0.013]
    recording = simulate(springy, None, start, duration=count * step, step=step)
    assert steps == {"compiled": count, "python": 0}
    assert len(recording.time) == count + 1 and np.isfinite(traces(recording)).all()
    half = simulate(springy, None, start, duration=0.2, step=step)
    np.testing.assert_allclose(recording.q[:401], half.q, rtol=0, atol=1e-13)


def test_steps_that_machine_code_leaves_are_done_in_python(forwarder, path, monkeypatch):
    control = crane.PI(forwarder, path)
    whole = simulate(forwarder, control, duration=0.1)
    run = RungeKuttaStepper.run
    left = []

    def hesitant(self, times, *rest):
        """Stops after 13 steps, like a step that needs more than Newton's method."""
        few = times[:13]
        left.append(len(few))
        return run(self, few, *rest)

    monkeypatch.setattr(RungeKuttaStepper, "run", hesitant)
    parts = simulate(forwarder, control, duration=0.1)
    assert len(left) > 5
    assert off(parts, whole) < 1e-11


def failing(steps, *arguments, **settings):
    """The message of a simulation that fails; it may not go round in circles."""
    rounds = 0

    def progress(_):
        nonlocal rounds
        rounds += 1
        assert rounds < 3000, "no step is done any more"

    with pytest.raises(SimulationError) as caught:
        simulate(*arguments, **settings, progress=progress)
    return str(caught.value)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")
def test_a_branch_that_is_left_is_left_alike(forwarder, steps):
    free = forwarder.replace(friction={}, end_stops=())
    runs = [
        simulate(free, control, duration=0.1, step=2e-4, backend=backend)
        for control, backend in (
            (Push(free, 0.0, 200.0, 0.0), "compiled"),
            (InPython(Push(free, 0.0, 200.0, 0.0)), "compiled"),
            (Push(free, 0.0, 200.0, 0.0), "pinocchio"),
        )
    ]
    assert steps["compiled"] > 5 and steps["python"] > 10
    assert max(off(run, runs[0]) for run in runs[1:]) < 1e-9


def test_an_explosion_is_told_alike(forwarder, steps):
    lift = crane.task_trajectory(forwarder, "lift")
    control = crane.PI(forwarder, lift)
    messages = {
        failing(steps, forwarder, one, duration=0.5, step=5e-3)
        for one in (control, InPython(control))
    }
    assert len(messages) == 1
    assert "explodes" in messages.pop()


@pytest.mark.parametrize("speed", [30.0, 1e3])
def test_a_first_step_that_fails_is_told_alike(forwarder, steps, speed):
    start = (np.array([0.0, 0.015, 0.015]), np.array([0.0, speed, 0.0]))
    messages = {
        failing(steps, forwarder, control, start, duration=0.1)
        for control in (None, InPython(crane.control.ZeroForce(forwarder)))
    }
    assert len(messages) == 1
    assert messages.pop().startswith("at t = ")


def test_a_step_that_fails_after_a_whole_chunk_is_told(forwarder, steps, monkeypatch):
    """The run ends the same in whichever chunk the failure occurs."""
    control, settings = crane.PI(forwarder, crane.task_trajectory(forwarder, "lift")), {
        "duration": 0.5, "step": 5e-3
    }  # fmt: skip
    wanted = failing(steps, forwarder, control, **settings, backend="pinocchio")
    before = round(float(wanted.split()[3]) / 5e-3)  # "at t = 0.088 s: .."
    for chunk in (1, 2, 3, before - 1, before):
        monkeypatch.setattr("crane.simulation.integration.integrators._STEPS_PER_REPORT", chunk)
        found = failing(steps, forwarder, control, **settings)
        assert found[:50] == wanted[:50]


def test_long_formulas_step_in_python(steps, monkeypatch):
    machine = crane.load("mini_forwarder")  # with nothing compiled yet
    start = np.array([0.1, 0.012, 0.016])
    monkeypatch.setattr(crane.codegen.program, "MAX_OPERATIONS", 10)
    monkeypatch.setattr(crane.closure.compiled_closure, "_SHARED_CODE", {})
    slow = simulate(machine, None, start, duration=0.02)
    assert steps == {"compiled": 0, "python": 20}
    monkeypatch.undo()
    machine = crane.load("mini_forwarder")
    fast = simulate(machine, None, start, duration=0.02)
    assert off(fast, slow) < 1e-10


# --- against another method ------------------------------------------------------------------
