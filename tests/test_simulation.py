"""Simulations: outputs, tolerances, start states, errors."""

import numpy as np
import pytest
from broken_machines import DATA

import crane
from crane.common.errors import CraneWarning, InputError, LimitError, SimulationError


@pytest.fixture(scope="module")
def springy(mini):
    """Frictionless, carried by a spring at each actuator about the middle of its stroke."""
    middle = np.array([0.0, 0.015, 0.015])
    weight = crane.Dynamics(mini).gravity(middle)
    springs = tuple(
        crane.description.ForceElement(joint, stiffness=k, rest=float(middle[i] + weight[i] / k))
        for i, (joint, k) in enumerate(zip(mini.active, (0.3, 2000.0, 4000.0), strict=True))
    )
    return mini.replace(friction={}, forces=springs, end_stops=())


START = (np.array([0.3, 0.018, 0.013]), np.array([0.5, 0.0, 0.02]))


def total_energy(recording):
    return recording.channels["kinetic"] + recording.channels["potential"]


def imbalance(recording):
    """Largest gap of the energy balance, relative to what went through."""
    channels, energy = recording.channels, total_energy(recording)
    gap = channels["work"] - (energy - energy[0]) - channels["dissipated"]
    through = max(np.ptp(channels[name]) for name in ("work", "dissipated", "potential"))
    return np.abs(gap).max() / through


def test_energy_is_conserved_and_the_error_falls_with_the_fourth_power(springy):
    drift = {}
    for step in (4e-3, 2e-3, 1e-3):
        recording = crane.simulate(springy, initial=START, duration=5.0, step=step, method="rk4")
        low, high = recording.q[:, 1:].min(), recording.q[:, 1:].max()
        assert low > 0 and high < 0.030  # within the strokes
        energy = total_energy(recording)
        drift[step] = np.abs(energy - energy[0]).max() / recording.channels["kinetic"].max()
    assert drift[1e-3] < 1e-8
    # energy is a smooth function of the state: its error is of the method's order or one better
    for coarse in (4e-3, 2e-3):
        assert 3.7 < np.log2(drift[coarse] / drift[coarse / 2]) < 5.3


def test_power_balance_with_friction_and_control(mini):
    path = crane.task_trajectory(mini, "return")
    recording = crane.simulate(mini, crane.PI(mini, path), duration=1.5)
    assert imbalance(recording) < 1e-6
    assert recording.channels["dissipated"][-1] > 0.1  # [J], so there was something to balance


def test_power_balance_at_the_end_stops(mini):
    recording = crane.simulate(mini, duration=0.6, step=5e-4)  # falls onto its stops
    stopped = recording.q[:, 1] > mini.upper[1]
    assert stopped.any()
    assert recording.q[:, 1].max() < mini.upper[1] + 0.002
    assert imbalance(recording) < 1e-4  # the stop's damping jumps, which costs the order


def test_channels_are_those_of_the_machine(mini):
    path = crane.task_trajectory(mini, "lift")
    recording = crane.simulate(mini, crane.PI(mini, path), duration=0.4, label="lift")
    kinematics, dynamics = crane.Kinematics(mini), crane.Dynamics(mini)
    tip = np.column_stack([recording.channels[f"tip_{axis}"] for axis in "xyz"])
    np.testing.assert_allclose(tip, kinematics.position(recording.q), atol=1e-12)
    reference = np.column_stack([recording.channels[f"reference_{j}"] for j in mini.active])
    np.testing.assert_array_equal(reference, path(recording.time)[0])
    wanted = np.column_stack([recording.channels[f"reference_tip_{axis}"] for axis in "xyz"])
    np.testing.assert_allclose(wanted, kinematics.position(reference), atol=1e-9)
    friction = np.column_stack([recording.channels[f"friction_{j}"] for j in mini.active])
    moving = recording.v != 0
    law = dynamics.friction(recording.q, recording.v)
    np.testing.assert_allclose(friction[moving], law[moving], atol=1e-9)
    # at rest it is what keeps the drives there
    rest = np.column_stack([recording.channels[f"rest_{j}"] for j in mini.active])
    weight = dynamics.gravity(recording.q)
    np.testing.assert_allclose(recording.tau[1], weight[1] + rest[1], atol=1e-9)
    assert 0 < moving.sum() < moving.size
    kinetic, potential = dynamics.energy(recording.q, recording.v)
    np.testing.assert_allclose(recording.channels["kinetic"], kinetic, atol=1e-12)
    np.testing.assert_allclose(recording.channels["potential"], potential, atol=1e-12)
    assert recording.machine == "mini_forwarder" and recording.task == "lift"
    assert recording.units == {"q1": "rad", "X1": "m", "X2": "m"}


def test_a_function_controls_as_well(mini):
    gain = np.array([15.0, 5500.0, 18000.0])
    target = np.array([0.1, 0.02, 0.012])
    seen = []

    def hold(time, q_a, v_a):
        seen.append(time)
        return gain * (target - q_a)

    recording = crane.simulate(mini, hold, duration=0.01)
    np.testing.assert_array_equal(recording.tau, gain * (target - recording.q))
    assert min(seen) == 0 and max(seen) == pytest.approx(0.01)


def test_progress_ends_at_one(mini):
    shares = []
    crane.simulate(mini, duration=0.01, progress=shares.append)
    assert shares == sorted(shares) and shares[-1] == 1.0


@pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")
def test_a_step_that_is_too_long_is_told(smooth):
    mini = smooth
    path = crane.task_trajectory(mini, "return")
    with pytest.warns(CraneWarning, match="step of 0.005 s is too long"):
        crane.simulate(mini, crane.PI(mini, path), duration=0.5, step=5e-3, method="rk4")
    path = crane.task_trajectory(mini, "lift")
    with pytest.raises(SimulationError, match="explodes .* shorten the step"):
        crane.simulate(mini, crane.PI(mini, path), duration=0.5, step=5e-3, method="rk4")


@pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")
def test_a_machine_that_leaves_its_branch_goes_on_and_is_told(mini):
    """A cylinder pushed through its dead centre, where nothing stops it."""
    free = mini.replace(friction={}, end_stops=())
    with pytest.warns(CraneWarning) as caught:
        run = crane.simulate(
            free, lambda t, q, v: np.array([0.0, 200.0, 0.0]), duration=0.5, step=2e-4
        )
    lines = [str(one.message) for one in caught]
    (line,) = (line for line in lines if "dead centre" in line)
    assert line.startswith("'X1'") and "a dead centre at t = 0.0" in line and "\n" not in line
    postures = np.column_stack(
        [run.q.T[run.joints.index(j)] if j in run.joints else run.channels[j] for j in free.joints]
    )
    assert free.closure.residual(postures).max() < 1e-12
    balance = run.channels["work"] - run.channels["kinetic"] - run.channels["potential"]
    assert np.ptp(balance) < 1e-4 * np.ptp(run.channels["kinetic"])


def test_leaving_the_limits_without_an_end_stop_is_told(mini):
    free = mini.replace(end_stops=())
    with pytest.warns(CraneWarning) as caught:
        run = crane.simulate(free, lambda t, q, v: np.array([0.0, 30.0, 0.0]), duration=0.4)
    (line,) = (str(one.message) for one in caught if "passes its limit" in str(one.message))
    stroke = run.q[:, 1]
    first = run.time[np.argmax(stroke > 0.03 + 1e-6)]
    wanted = f"'X1' passes its limit 0.03 m at t = {first:.4g} s, by up to "
    assert line.startswith(f"{wanted}{max(stroke) - 0.03:.3g}") and "end stop" in line


def test_passive_joints_beyond_their_limits_are_told_in_the_same_line(tmp_path):
    """The rocker, which may swing freely in the file, is given a range; batches tell it, too."""
    text = (DATA / "four_bar_loop.urdf").read_text()
    rocker = '<joint name="rocker" type="continuous">'
    assert text.count(rocker) == 1
    ranged = f'{rocker.replace("continuous", "revolute")}<limit lower="-3" upper="-0.1"/>'
    (tmp_path / "bar.urdf").write_text(text.replace(rocker, ranged))
    machine = crane.load(tmp_path / "bar.urdf")

    def push(t, q, v):
        return np.array([20.0])

    with pytest.warns(CraneWarning) as caught:
        run = crane.simulate(machine, push, duration=0.5)
    (line,) = (str(one.message) for one in caught if "passes its limit" in str(one.message))
    past = np.max(run.channels["rocker"]) + 0.1
    assert "'crank' passes its limit" in line
    assert f"'rocker' passes its limit -0.1 rad at t = 0.001 s, by up to {past:.3g} rad" in line
    assert line.endswith("nothing stops them there, give them end stops")
    batch = crane.simulation.simulate_batch([machine], lambda machine: push, duration=0.5)
    assert batch.warnings[0].startswith(line)


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({}, InputError, "no duration and no reference"),
        ({"duration": -1.0}, InputError, "the duration is -1.0 s"),
        ({"duration": np.nan}, InputError, "the duration is nan s"),
        ({"duration": 1.0, "step": 0.0}, InputError, "the step is 0.0 s"),
        ({"duration": 1.0, "step": 0.3}, InputError, "no whole number of steps"),
        ({"duration": 1.0, "initial": [0, 0.04, 0]}, LimitError, "initial: X1 = 0.04 is outside"),
        ({"duration": 1.0, "initial": [0, 0.01]}, InputError, "initial has the shape"),
        ({"duration": 1.0, "initial": [[0, 0.01, 0]]}, InputError, "initial is a stack"),
        (
            {"duration": 1.0, "initial": ([0, 0.01, 0.01], [0, np.nan, 0])},
            InputError,
            "initial v_a is nan at X1",
        ),
        ({"duration": 1.0, "controller": 3}, InputError, "the controller is a int"),
        (
            {"duration": 1.0, "controller": lambda t, q, v: np.zeros(2)},
            InputError,
            "the controller's force at t = 0 s has the shape (2,), give (3,) (q1, X1, X2)",
        ),
        (
            {"duration": 1.0, "controller": lambda t, q, v: np.full(3, np.nan)},
            InputError,
            "the controller's force at t = 0 s is nan at q1",
        ),
    ],
)
def test_wrong_arguments_are_one_line(mini, arguments, error, text):
    with pytest.raises(error) as caught:
        crane.simulate(mini, **arguments)
    assert text in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("method", ["DOP853", "Radau", "rosenbrock"])
def test_adaptive_methods_agree_with_fixed_steps(springy, method):
    fixed = crane.simulate(springy, initial=START, duration=0.3, step=5e-4, method="rk4")
    adaptive = crane.simulate(springy, initial=START, duration=0.3, step=5e-4, method=method)
    np.testing.assert_allclose(adaptive.q, fixed.q, atol=1e-8)
    np.testing.assert_allclose(adaptive.v, fixed.v, atol=1e-6)
    assert adaptive.time.tolist() == fixed.time.tolist()


def test_unknown_method(springy):
    with pytest.raises(InputError, match="method 'rk5' is unknown"):
        crane.simulate(springy, duration=0.1, method="rk5")


def test_steps_by_their_error_do_not_depend_on_what_is_recorded(mini):
    """With a reference, states of the controller and friction; against fixed steps, too."""
    control = crane.PI(mini, crane.task_trajectory(mini, "lift"))
    fine = crane.simulate(mini, control, duration=0.28, step=5e-5, method="rk4")
    for step in (1e-3, 7e-3, 0.07):
        found = crane.simulate(mini, control, duration=0.28, step=step, method="DOP853")
        every = round(step / 5e-5)
        np.testing.assert_allclose(found.q, fine.q[::every], rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.v, fine.v[::every], rtol=0, atol=1e-9)
        for name, values in found.channels.items():
            off = np.abs(values - fine.channels[name][::every]).max()
            assert off < 1e-14 + 1e-6 * np.abs(fine.channels[name]).max(), (
                name
            )  # friction is steep


def test_steps_by_their_error_turn_a_floating_machine_round():
    """A rotation vector of half a turn continues at the opposite vector."""
    with pytest.warns(CraneWarning):
        machine = crane.load(DATA / "slider_crank.yaml", floating=True)
    speeds = np.array([1.0, 0.2, 0.0, 1.0, 2.0, 9.0, 0.5])
    start = machine.home[machine.closure.active], speeds
    run = crane.simulate(machine, initial=start, duration=3.0, step=1e-2, method="DOP853")
    energy = run.channels["kinetic"] + run.channels["potential"]
    assert np.ptp(energy) < 1e-8 * np.ptp(run.channels["kinetic"])
    turned = run.q[:, [machine.active.index(f"base_r{axis}") for axis in "xyz"]]
    sizes = np.linalg.norm(turned, axis=1)
    assert sizes.max() <= np.pi + 1e-9 and np.abs(np.diff(turned, axis=0)).max() > np.pi


def test_too_many_steps(mini):
    with pytest.raises(InputError, match="1e[+]15 steps of 0.001 s, at most 4000000"):
        crane.simulate(mini, duration=1e12)
    with pytest.raises(InputError, match="1 steps of 1e[+]09 s, at most 4000000 and 1e[+]06 s"):
        crane.simulate(mini, duration=1e9, step=1e9)


def test_long_output_steps_are_integrated_in_parts(slider_crank):
    """References are sampled for some hundred output steps at a time, or for a part of one."""
    fine = crane.simulate(slider_crank, duration=6.0, step=1e-2)
    for step in (3.0, 6.0):
        coarse = crane.simulate(slider_crank, duration=6.0, step=step)
        every = round(step / 1e-2)
        np.testing.assert_allclose(coarse.q, fine.q[::every], rtol=0, atol=1e-9)


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_a_machine_may_be_given_by_its_name():
    found, wanted = (
        crane.simulate(machine, duration=0.01)
        for machine in ("mini_forwarder", crane.load("mini_forwarder"))
    )
    np.testing.assert_array_equal(found.q, wanted.q)
    for nothing in (None, 5):
        with pytest.raises(crane.CraneError, match="names no machine, give a name or the path"):
            crane.simulate(nothing, duration=0.01)
