"""The virtual rig against simulations of the plant, and models of its sensors."""

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from rig import Converter, Rig, Sensors, Tolerances, converter, rig

import crane
from crane.common.errors import InputError, LimitError
from crane.description import Friction, parameters
from crane.description.parameter_changes import apply_parameter_changes
from crane.formats import read_machine_spec

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")

NONE = Tolerances(0, 0, 0, 0, 0, 0)
EXACT = Converter(1e-15)
COUNT = np.deg2rad(0.042)
START = [0.1, 0.012, 0.010]


def ideal(machine, **changes):
    """Sensors by joint that tell the truth, with the gains and no-load currents of the paper."""
    motor = Sensors(EXACT, 0.0, 1.765 / 1.5, 0.0, EXACT, 0.0, (0.0, 0.0), 1e6)
    motor = dataclasses.replace(motor, **changes)
    actuator = dataclasses.replace(motor, gain=400.0, no_load=0.05)
    return {joint: motor if joint == "q1" else actuator for joint in machine.active}


def columns(recording, name):
    return np.column_stack([recording.channels[f"{name}_{joint}"] for joint in recording.joints])


@pytest.fixture(scope="module")
def path():
    return crane.point_to_point(START, [0.5, 0.020, 0.014], 1.0)


@pytest.fixture(scope="module")
def exact(mini):
    return Rig(mini, 1, NONE, ideal(mini))


@pytest.fixture(scope="module")
def real(mini):
    return Rig(mini, 1)


@pytest.fixture(scope="module")
def stiff():
    """With friction whose slope at rest asks for short substeps."""
    slopes = {"q1": 4e-4, "X1": 4e-5, "X2": 4e-5}
    changes = {f"friction.{joint}.smoothing": slope for joint, slope in slopes.items()}
    return crane.load("mini_forwarder", changes)


@pytest.fixture(scope="module")
def recording(real, path):
    return real.run(path, label="there")


# --- the motion ------------------------------------------------------------------------------


def test_the_controller_samples_and_holds(mini, exact):
    """Piece by piece with constant forces, by an adaptive method of another order."""
    path = crane.point_to_point(START, [0.3, 0.018, 0.013], 0.3)
    step, count = 0.01, 15
    kp = np.array([mini.control[joint].kp for joint in mini.active])
    ki = np.array([mini.control[joint].ki for joint in mini.active])
    q_a, v_a = path.position(0.0), np.zeros(3)
    integral = crane.Dynamics(mini).inverse(q_a, v_a, v_a, friction=True) / ki
    found = exact.run(path, step)
    for k in range(count):
        error = path.position(k * step) - q_a
        force = kp * error + ki * integral
        integral = integral + step * error
        np.testing.assert_allclose(columns(found, "true")[k], q_a, rtol=0, atol=1e-8)
        np.testing.assert_allclose(columns(found, "true_velocity")[k], v_a, rtol=0, atol=1e-6)
        np.testing.assert_allclose(columns(found, "true_force")[k], force, rtol=0, atol=2e-4)
        piece = crane.simulate(
            mini,
            lambda time, q, v, force=force: force,
            (q_a, v_a),
            step,
            step,
            method="DOP853",
        )
        q_a, v_a = piece.q[-1], piece.v[-1]
    assert np.abs(v_a[[0, 2]]).min() > 1e-3 and v_a[1] == 0  # it moved, and A1 has not yet


def test_substeps_are_stable(stiff, path, monkeypatch):
    """With half the substep the motion changes by much less than the sensors' resolution."""
    coarse = Rig(stiff, 1, sensors=ideal(stiff)).run(path)
    monkeypatch.setattr(rig, "_STABLE", rig._STABLE / 2)
    fine = Rig(stiff, 1, sensors=ideal(stiff)).run(path)
    for name, allowed in (("true", 1e-9), ("true_velocity", 1e-8), ("true_force", 1e-5)):
        assert np.abs(columns(coarse, name) - columns(fine, name)).max() < allowed
    assert not np.array_equal(columns(coarse, "true"), columns(fine, "true"))


def test_a_joint_sticks_until_the_force_breaks_it_away(mini):
    """Below F_C + F_S + offset it stays where it is.

    The slewing joint bears no weight: the force is K_p (c t - q) of a ramp.
    """
    slow = crane.load("mini_forwarder", {"control.q1.ki": 0.0})
    rate = 0.03  # [rad/s]
    ramp = crane.motion.polynomial([[0.0, rate], [0.012], [0.010]], 0.5)
    stuck = Rig(slow, 1, Tolerances(0, 0, 0, 0, 0, 0.2), ideal(slow))
    law = stuck.plant.friction["q1"]
    assert law.coulomb == 0.1010 and law.stiction == pytest.approx(0.2 * 0.1010)
    breakaway = law.coulomb + law.stiction
    found = stuck.run(ramp)
    force = found.channels["true_force_q1"] - law.coulomb_offset
    v = found.channels["true_velocity_q1"]
    sticks = force < breakaway
    assert sticks.sum() > 200
    assert (v[sticks] == 0).all()
    later = np.flatnonzero(sticks)[-1]
    # F_C + F_S is passed at the time of the ramp, then it slips faster than stiction reaches
    due = (breakaway + law.coulomb_offset) / (15 * rate)
    assert found.time[np.argmax(v > 0)] == pytest.approx(due, abs=1.5e-3)
    assert v.max() > 2 * law.stribeck
    free = Rig(slow, 1, NONE, ideal(slow)).run(ramp)
    early = free.channels["true_velocity_q1"][later]
    assert early > 0


def test_forces_saturate(mini):
    dash = crane.point_to_point(START, [1.1, 0.020, 0.014], 0.3)
    weak = Rig(mini, 1, NONE, ideal(mini, driver=0.1))
    assert weak.limits == pytest.approx([0.1 * 1.765 / 1.5, 20.0, 20.0])
    strong = Rig(mini, 1, NONE, ideal(mini))
    assert strong.limits == pytest.approx([1.765, 80.0, 80.0])  # the joints' efforts
    for chosen in (weak, strong):
        found = chosen.run(dash)
        command, force = columns(found, "command"), columns(found, "true_force")
        np.testing.assert_array_equal(force, np.clip(command, -chosen.limits, chosen.limits))
        assert (np.abs(command[:, 0]) > chosen.limits[0]).any()
    # what is cut off does not move the machine: half of q1's way would need more
    lag = {x: x.run(dash).channels["true_q1"][150] for x in (weak, strong)}
    assert lag[weak] < lag[strong] - 0.05


# --- what the sensors tell -------------------------------------------------------------------


def test_a_converter_of_twelve_bits_has_4096_levels():
    rounds = converter(0.0, 0.030)
    x = np.linspace(-0.001, 0.031, 200_001)
    levels = np.unique(rounds(x))
    assert len(levels) == 4096 and levels[0] == 0.0 and levels[-1] == 0.030
    inside = x[(x >= 0) & (x <= 0.030)]
    assert np.abs(rounds(inside) - inside).max() <= 0.5 * 0.030 / 4095 * (1 + 1e-9)


def test_positions_are_whole_counts(recording):
    turns = recording.q[:, 0] / COUNT
    np.testing.assert_allclose(turns, np.rint(turns), rtol=0, atol=1e-9)
    assert len(np.unique(np.rint(turns))) > 100
    gap = np.abs(recording.q - columns(recording, "true"))
    assert 0.4 * COUNT < gap[:, 0].max() <= 0.5 * COUNT * (1 + 1e-9)
    levels = recording.q[:, 1:] * 4095 / 0.030
    np.testing.assert_allclose(levels, np.rint(levels), rtol=0, atol=1e-6)
    # noise of 20 um, and what rounding adds
    spread = np.sqrt(np.mean(gap[:, 1:] ** 2, axis=0))
    np.testing.assert_allclose(spread, np.hypot(2e-5, 0.030 / 4095 / np.sqrt(12)), rtol=0.1)


def test_velocities_are_those_of_the_filtered_coordinates(mini):
    """A slow sine passes the filter, a count's jitter does not."""
    path = crane.point_to_point(START, [0.5, 0.020, 0.014], 4.0)
    found = Rig(mini, 1).run(path)
    true = columns(found, "true_velocity")
    middle = slice(500, -500)
    error = np.sqrt(np.mean((found.v - true)[middle] ** 2, axis=0))
    assert (error < 0.05 * np.abs(true).max(axis=0)).all()
    raw = np.gradient(found.q, found.time, axis=0)
    assert (error < 0.1 * np.sqrt(np.mean((raw - true)[middle] ** 2, axis=0))).all()


def test_equation_8_there_and_back(mini, path):
    found = Rig(mini, 1, NONE, ideal(mini)).run(path)
    force = columns(found, "true_force")
    gain, no_load = [1.765 / 1.5, 400, 400], [0, 0.05, 0.05]
    np.testing.assert_allclose(
        columns(found, "current"), np.abs(force) / gain + no_load, rtol=0, atol=1e-14
    )
    np.testing.assert_allclose(found.tau, force, rtol=0, atol=1e-11)


def test_currents_are_wrong_by_one_share_per_rig(real, recording, path):
    gain, no_load = [1.765 / 1.5, 400, 400], [0, 0.05, 0.05]
    assert ((np.abs(real.errors) >= 0.05) & (np.abs(real.errors) <= 0.10)).all()
    for found in (recording, real.run(path)):
        true = np.abs(columns(found, "true_force")) / gain + no_load
        measured = columns(found, "current")
        share = (true * measured).sum(axis=0) / (true**2).sum(axis=0) - 1
        np.testing.assert_allclose(share, real.errors, rtol=0, atol=2e-3)
        rest = np.std(measured - true * (1 + real.errors), axis=0)
        steps = np.array([2.0, 0.5, 0.5]) / 4095
        noise = np.hypot([5e-3, 1e-3, 1e-3], steps / np.sqrt(12))
        np.testing.assert_allclose(rest, noise, rtol=0.1)
        levels = measured / steps
        np.testing.assert_allclose(levels, np.rint(levels), rtol=0, atol=1e-6)
        # the current's noise is not the potentiometer's
        shaken = found.q - columns(found, "true"), measured - true * (1 + real.errors)
        for i in (1, 2):
            assert abs(np.corrcoef(shaken[0][:, i], shaken[1][:, i])[0, 1]) < 0.15


# --- the plant -------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_parameters_are_within_the_tolerances(mini, seed):
    drawn = Rig(mini, seed)
    spec = read_machine_spec("mini_forwarder")
    printed, numbers = parameters(spec), parameters(apply_parameter_changes(spec, drawn.changes))
    most = Tolerances()
    bodies = [name.removesuffix(".mass") for name in printed if name.endswith(".mass")]
    bodies.remove("payload")
    shapes = []
    for name, value in printed.items():
        link, _, what = name.partition(".")
        gap = numbers[name] - value
        if link == "friction":
            field = what.partition(".")[2]
            if field in ("stiction", "stribeck"):
                continue
            assert abs(gap) <= most.friction * abs(value)
        elif value == 0 or link == "gravity":
            assert gap == 0, name
        elif what == "mass":
            assert 0 < abs(gap) <= most.mass * value
        elif what.startswith("com"):
            assert 0 < abs(gap) <= most.com
        elif what in "xyz" and what:
            assert 0 < abs(gap) <= most.pins * (1 + 1e-9)
        elif what.startswith("inertia"):
            mass = numbers[f"{link}.mass"] / printed[f"{link}.mass"]
            shapes.append(numbers[name] / value / mass - 1)
        else:
            assert gap == 0, name  # angles of frames, limits, gains
    assert 0 < np.abs(shapes).max() <= most.inertia
    for body in bodies:
        tensors = []
        for table in (printed, numbers):
            xx, xy, xz, yy, yz, zz = (
                table[f"{body}.inertia.{key}"] for key in ("xx", "xy", "xz", "yy", "yz", "zz")
            )
            tensors.append(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        low, middle, high = np.linalg.eigvalsh(tensors[1])
        assert low >= 0 and high > 0 and low + middle >= high * (1 - 1e-12)
        np.testing.assert_allclose(
            tensors[1] / np.trace(tensors[1]), tensors[0] / np.trace(tensors[0]), atol=1e-15
        )


def test_draws_fill_the_tolerances(mini):
    """Of a uniform distribution: the mean is zero, the spread 1/sqrt(3) of the half-width."""
    shares, errors = [], []
    printed = parameters(read_machine_spec("mini_forwarder"))
    for seed in range(12):
        drawn = Rig(mini, seed)
        found, errors = drawn.changes, [*errors, *drawn.errors]
        shares += [found[n] / printed[n] - 1 for n in found if n.endswith(".mass")]
    count = len(shares)
    assert abs(np.mean(shares)) < 4 * 0.05 / np.sqrt(3 * count)
    low, high = np.abs(errors).min(), np.abs(errors).max()
    assert 0.05 <= low < 0.06 and 0.09 < high <= 0.10 and min(errors) < 0 < max(errors)
    assert np.std(shares) == pytest.approx(0.05 / np.sqrt(3), rel=4 / np.sqrt(count))


def test_pins_stay_in_the_plane():
    """Also those beside it: link 4 stands 13 mm off."""
    offset = {"link2_F.z": 0.013, "link4_J.z": -0.013}
    drawn = Rig(crane.load("mini_forwarder", offset), 3)
    assert {name: drawn.changes[name] for name in offset} == offset
    assert drawn.changes["link2_F.x"] != 0.072
    plant, data = drawn.plant, drawn.plant.model.createData()
    for q_a in ([0.0, 0.001, 0.002], [0.0, 0.029, 0.028]):
        pin.framesForwardKinematics(plant.model, data, plant.closure.solve(q_a))
        for name in ("link2_D", "A1_eye", "link3_G", "A2_eye", "link5_J", "link6_K", "link7_tip"):
            assert abs(data.oMf[plant.frame(name)].translation[1]) < 1e-15


def test_a_machine_of_spherical_loops_keeps_its_pins(stewart):
    drawn = Rig(stewart, 1, Tolerances(pins=1e-2))
    assert not [n for n in drawn.changes if n.rpartition(".")[2] in "xyz" and ".com." not in n]


def test_what_was_put_on_the_model_is_on_the_plant(mini):
    spring = crane.description.GasSpring(
        "X2", area=1e-4, pressure=1e5, volume=1e-5, rest=0.01, exponent=1.2
    )
    push = crane.description.ForceElement("X1", force=3.0)
    other = mini.replace(
        friction={"X1": Friction(viscous=100.0)},
        forces=(push,),
        gas_springs=(spring,),
        end_stops=(),
    )
    plant = Rig(other, 1).plant
    assert plant.forces == (push,) and plant.gas_springs == (spring,) and plant.end_stops == ()
    assert 80 <= plant.friction["X1"].viscous <= 120
    assert plant.friction["q1"].coulomb == 0.0
    loaded = Rig(crane.load("mini_forwarder", {"payload.mass": 0.1}), 1)
    assert loaded.changes["payload.mass"] == 0.1


# --- chance ----------------------------------------------------------------------------------


def same(one, two):
    return all(
        np.array_equal(a, b)
        for a, b in (
            (one.q, two.q),
            (one.v, two.v),
            (one.tau, two.tau),
            *((one.channels[name], two.channels[name]) for name in one.channels),
        )
    )


def test_the_seed_decides_everything(mini, path):
    first, twin, other = Rig(mini, 7), Rig(mini, 7), Rig(mini, 8)
    assert first.changes == twin.changes and first.changes != other.changes
    runs = [first.run(path), first.run(path)]
    assert same(runs[0], twin.run(path)) and same(runs[1], twin.run(path))
    assert not same(*runs)
    assert not same(runs[0], other.run(path))
    np.testing.assert_array_equal(first.errors, twin.errors)


# --- the recording ---------------------------------------------------------------------------


def test_tips_are_of_the_model_and_of_the_plant(real, recording):
    measured = np.column_stack([recording.channels[f"tip_{axis}"] for axis in "xyz"])
    true = np.column_stack([recording.channels[f"true_tip_{axis}"] for axis in "xyz"])
    at = crane.Kinematics(real.machine).position(recording.q)
    np.testing.assert_allclose(measured, at, rtol=0, atol=1e-12)
    at = crane.Kinematics(real.plant).position(columns(recording, "true"))
    np.testing.assert_allclose(true, at, rtol=0, atol=1e-12)
    assert 1e-5 < np.abs(measured - true).max() < 1e-2


# --- errors ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda m: Rig(m, -1), "the seed is -1"),
        (lambda m: Rig(m, 0.5), "the seed is 0.5"),
        (lambda m: Rig(m, 1, sensors={"X3": None}), "sensors of 'X3'"),
        (lambda m: Rig(m, 1, Tolerances(pins=0.05)), "the plant of seed 1 does not close"),
        (lambda m: Tolerances(mass=1.0), "the tolerance 'mass' is 1"),
        (lambda m: Tolerances(com=-0.1), "the tolerance 'com' is -0.1"),
        (lambda m: Converter(0.0), "the step of a converter"),
        (lambda m: ideal(m, gain=0.0), "the gain of a current"),
        (lambda m: ideal(m, driver=0.04), "the driver's largest current"),
        (
            lambda m: Rig(m.with_payload(crane.Payload(m.tip, 0.1)), 1),
            "'mini_forwarder' has a payload or locked joints",
        ),
        (
            lambda m: Rig(crane.load("mini_forwarder", lock={"X2": 0.01}), 1),
            "'mini_forwarder' has a payload or locked joints",
        ),
    ],
)
def test_errors_of_a_rig_are_one_line(mini, make, text):
    with pytest.raises(InputError) as caught:
        make(mini)
    assert text in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("end", "step", "label", "error", "text"),
    [
        ([0.5, 0.020, 0.014], 0.3, "", InputError, "the step of 0.3 s is no part of 1 s"),
        ([0.5, 0.020, 0.014], 0.1, "", InputError, "give less than 0.05 s"),
        ([0.5, 0.020, 0.014], 0.0, "", InputError, "the step is 0"),
        ([0.5, 0.020, 0.014], 1e-3, "two\nlines", InputError, "is not one line of text"),
        ([0.5, 0.020], 1e-3, "", InputError, "the path is of 2 joints"),
    ],
)
def test_errors_of_a_run_are_one_line(real, end, step, label, error, text):
    with pytest.raises(error) as caught:
        real.run(crane.point_to_point(START[: len(end)], end, 1.0), step, label=label)
    assert text in str(caught.value) and "\n" not in str(caught.value)


def test_a_run_starts_within_the_limits(real):
    with pytest.raises(LimitError, match="the start of the path: X1 = 0.04"):
        real.run(crane.point_to_point([0, 0.04, 0.01], START, 1.0))


def test_a_potentiometer_needs_limits(mini):
    endless = dataclasses.replace(mini, upper=np.full(3, np.inf))
    with pytest.raises(InputError, match="'X1' has no limits for a potentiometer, give its"):
        Rig(endless, 1)
