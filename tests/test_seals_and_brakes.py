"""Pressure-dependent seal friction and spring-applied brakes against closed forms."""

import warnings

import numpy as np
import pytest
import singular_linkages
import urdf_text
import yaml
from hydraulic_rig import AREA_A, AREA_B, ORIFICE, rig
from warned import quiet, without_a_word

import crane
from crane.common.errors import CraneError
from crane.description.machine_parameters import parameter_unit
from crane.dynamics import Dynamics
from crane.dynamics.joint_forces import MIN_COULOMB_FRICTION, find_stick_slip_columns
from crane.formats.machine_loading import MachineVariants
from crane.hydraulics.circuit_elements import Supply
from crane.hydraulics.components import Cylinder, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics, Oil
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.python_stepper import PythonStepper
from crane.simulation.integration.rosenbrock import RosenbrockStepper

pytestmark = pytest.mark.slow

G, TANK = 9.81, 1e5
SEAL, BRAKE = 1.5e-4, 2000.0
METHODS = ("rosenbrock", "DOP853", pytest.param("Radau", marks=pytest.mark.long))


def run(*args, **options):
    return without_a_word(crane.simulate, *args, **options)


def gaps(recording):
    """What is left of the balances of energy and of oil's energy, as shares of the work."""
    c = recording.channels
    stored = c["kinetic"] + c["potential"]
    work = sum(values for name, values in c.items() if name == "work" or name.startswith("work_"))
    size = max(np.abs(work).max(), c["dissipated"].max())
    mechanical = work - (stored - stored[0]) - c["dissipated"]
    oil = c["pump_work"] - c["work"] - c["hydraulic_loss"] - c["oil_energy"]
    return max(np.abs(mechanical).max(), np.abs(oil).max()) / size


def pressed(recording, joint, seal=SEAL):
    """What seals add [N], of recorded pressures."""
    p = [recording.channels[f"pressure_{joint}_{side}"] for side in "ab"]
    return seal * sum(np.maximum(x - TANK, 0.0) for x in p)


def closed(machine, pressures=None):
    return crane.control.ValveDrive(
        machine, crane.control.ValveSignals(machine, [0.0], {}), pressures
    )


def slewing(folder, brake=BRAKE, friction=None, valve=None, inertia=15.0, **cylinder):
    """A pillar that a rotary drive of 1e-3 m3/rad turns about z."""
    turn = urdf_text.joint("turn", "base", "pillar", kind="revolute", limits=(-2, 2))
    urdf_text.write(
        folder, "slew", "base", urdf_text.body("pillar", 10, moments=(9, 9, inertia)), turn
    )
    hoses = dict.fromkeys(("hose_a", "hose_b"), 2e-4)
    parts = dict.fromkeys(("area_a", "area_b"), 1e-3) | hoses | {"brake": brake} | cylinder
    data = {
        "name": "slew",
        "chains": [{"name": "slew", "urdf": "slew.urdf"}],
        "active": ["turn"],
        "home": {"turn": 0.0},
        "hydraulics": {
            "supply": {"pressure": 9e6},
            "cylinders": {"turn": parts},
            "valves": {"turn": ORIFICE | {"dead_band": 0.1} | (valve or {})},
        },
    } | ({"friction": {"turn": friction}} if friction else {})
    (folder / "slew.yaml").write_text(yaml.dump(data))
    return crane.load(folder / "slew.yaml")


@pytest.mark.parametrize(
    ("method", "coulomb"),
    [("rosenbrock", 500.0), ("rosenbrock", 0.0), ("rosenbrock", None), ("DOP853", 0.0),
     pytest.param("Radau", 500.0, marks=(pytest.mark.slow, pytest.mark.long))],
)  # fmt: skip
def test_a_locked_cylinder_holds_up_to_what_its_seals_press(tmp_path, coulomb, method):
    """To the last bit until the force is F_C + mu (p_A + p_B), from weight's equilibrium on."""
    machine = rig(tmp_path, cylinder={"seal_friction": SEAL})
    laws = {} if coulomb is None else {"x": crane.description.Friction(coulomb=coulomb)}
    machine = machine.replace(friction=laws)
    p_b = 3e6
    p_a = (2000 * G + AREA_B * p_b) / AREA_A
    limit = (coulomb or MIN_COULOMB_FRICTION) + SEAL * (p_a + p_b - 2 * TANK)
    for sign in (1.0, -1.0):
        pull = crane.Wrench("load_x", [(0, 0, 0), (0, 0, sign * 4000.0)], times=[0.0, 1.0])
        step = 1e-3 if method == "rosenbrock" else 4e-3
        found = run(machine, closed(machine, {"x": (p_a, p_b)}), None, 0.6, step,
                    loads=[pull], method=method)  # fmt: skip
        starts = limit / 4000.0
        assert 0.2 < starts < 0.5
        still = found.time < starts - 1e-9
        assert (found.q[still] == found.q[0]).all() and (found.v[still] == 0).all()
        assert np.ptp(found.channels["pressure_x_a"][still]) == 0
        held = found.channels["rest_x"]
        force = sign * 4000.0 * found.time
        assert held[still] == pytest.approx(force[still], abs=1e-6)
        after = (found.time > starts + step) & (found.time < starts + 0.03)
        assert after.any() and (sign * found.v[after, 0] > 0).all()
        assert gaps(found) < 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_a_sliding_cylinder_loses_what_its_seals_press(tmp_path, method):
    """At constant speed and pressures A_A p_A - A_B p_B - F_V v = F_C + mu (p_A + p_B)."""
    machine = rig(tmp_path, axis="1 0 0", mass=300.0, cylinder={"seal_friction": SEAL},
                  friction={"coulomb": 400.0, "viscous": 900.0})  # fmt: skip
    signals = crane.control.ValveSignals(machine, [0.0, 0.1, 0.2], {"x": [0.0, 0.0, 0.3]})
    step = 1e-3 if method == "rosenbrock" else 1e-2
    found = run(machine, signals, [0.05], 1.5, step, method=method)
    v = found.v[-1, 0]
    lost = found.tau[-1, 0] - 900.0 * v
    seals = pressed(found, "x")
    assert seals[-1] > 300.0 and v > 0.04
    assert lost == pytest.approx(400.0 + seals[-1], rel=1e-6)
    moves = found.v[:, 0] > 1e-6
    formula = 400.0 + seals + 900.0 * found.v[:, 0]
    assert found.channels["friction_x"][moves] == pytest.approx(formula[moves], rel=1e-9)
    assert gaps(found) < 1e-6


def test_pressures_below_the_tank_press_nothing(tmp_path):
    """A chamber that is sucked empty adds nothing, and takes nothing from the other one."""
    machine = rig(tmp_path, cylinder={"seal_friction": SEAL}, supply={"tank": 5e5})
    state = np.zeros(8)
    for pair, wanted in (((3e6, 2e5), 2.5e6), ((2e5, 1e5), 0.0), ((2e6, 3e6), 4e6)):
        drive = closed(machine, {"x": pair})
        state = drive.start(np.array([0.2]))
        at = drive.inputs_at(0.0, np.array([0.2]), np.zeros(1), state)
        assert drive.circuit_friction(at) == [pytest.approx(SEAL * wanted, rel=1e-12, abs=1e-12)]


@pytest.mark.parametrize("method", METHODS)
def test_a_brake_holds_what_is_below_it(tmp_path, method):
    """A torque that grows: nothing turns below the brake's, and it gives way there."""
    machine = slewing(tmp_path)
    assert "turn" not in machine.friction
    push = crane.Wrench("pillar", moment=[(0, 0, 0), (0, 0, -5000.0)], times=[0.0, 1.0])
    step = 1e-3 if method == "rosenbrock" else 4e-3
    found = run(machine, None, None, 0.5, step, loads=[push], method=method)
    starts = (BRAKE + MIN_COULOMB_FRICTION) / 5000.0
    still = found.time < starts - 1e-9
    assert (found.q[still] == 0).all() and (found.v[still] == 0).all()
    assert found.channels["rest_turn"][still] == pytest.approx(
        -5000.0 * found.time[still], abs=1e-6
    )
    after = (found.time > starts + step) & (found.time < starts + 0.02)
    assert after.any() and (found.v[after] < 0).all()
    assert gaps(found) < 1e-6


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_brake_lets_go_as_the_lever_moves(tmp_path, way):
    """Under 1000 N m it starts where B (1 - (|u| - d) / e) is 1000 N m, released beyond d + e."""
    slight = dict.fromkeys(("c1", "c2", "c3", "c4"), 1e-12)  # pressures stay what they are
    machine = slewing(tmp_path, valve=slight, brake_release=0.2)
    signals = crane.control.ValveSignals(machine, [0.0, 1.0], {"turn": [0.0, way]})
    push = crane.Wrench("pillar", moment=(0, 0, 1000.0))
    borne = crane.control.ValveDrive(machine, signals, {"turn": (1e5, 1e5)})  # by the brake alone
    found = run(machine, borne, None, 0.5, 1e-3, loads=[push])
    starts = 0.1 + 0.2 * 0.5
    still = found.time < starts - 1e-9
    assert (found.q[still] == 0).all()
    assert (found.v[found.time > starts + 1e-3][:20] > 0).all()
    brake = BRAKE * np.clip(1 - (found.time - 0.1) / 0.2, 0, 1)
    slips = found.time > starts + 1e-3
    sign = np.sign(found.v[slips, 0])
    friction = found.channels["friction_turn"][slips]
    assert friction == pytest.approx(brake[slips] * sign, abs=1e-3)
    assert np.abs(friction[found.time[slips] > 0.3 + 1e-9]).max() <= 2 * MIN_COULOMB_FRICTION
    assert gaps(found) < 1e-6


def test_a_brake_stops_what_slews(tmp_path):
    """The lever goes back within the dead band: the pillar comes to rest, and stays there."""
    machine = slewing(tmp_path, friction={"viscous": 100.0}, seal_friction=2e-5)
    corners = [(0.0, 0.0), (0.2, 0.0), (0.3, 0.5), (1.0, 0.5), (1.1, 0.0), (2.0, 0.0)]
    times, levers = zip(*corners, strict=True)
    signals = crane.control.ValveSignals(machine, times, {"turn": levers})
    found = run(machine, signals, None, 2.0, 1e-3)
    assert found.v[found.time < 1.0].max() > 0.1
    assert (found.q[-500:] == found.q[-1]).all() and (found.v[-500:] == 0).all()
    free = slewing(tmp_path, brake=0.0, friction={"viscous": 100.0})
    assert np.ptp(run(free, signals, None, 2.0, 1e-3).q[-500:]) > 1e-5  # it rings on its oil
    assert gaps(found) < 1e-6


def test_a_smooth_law_has_the_same_limit(tmp_path):
    """tau_F = F_V v + (F_C + F_K) tanh(v / v_s), with spool and pressures of the recording."""
    for coulomb in (300.0, 0.0):
        law = {"coulomb": coulomb, "viscous": 500.0, "smoothing": 5e-3}
        machine = rig(tmp_path, ORIFICE | {"dead_band": 0.1}, friction=law,
                      cylinder={"seal_friction": SEAL, "brake": BRAKE})  # fmt: skip
        assert not find_stick_slip_columns(machine)
        signals = crane.control.ValveSignals(
            machine, [0, 0.2, 0.5, 0.8, 1.2], {"x": [0, 0, 0.5, -0.5, 0]}
        )
        found = run(machine, signals, None, 1.5, 1e-3)
        spool = np.abs(found.channels["spool_x"])
        grip = pressed(found, "x") + BRAKE * np.clip(1 - (spool - 0.1) / 0.05, 0, 1)
        v = found.v[:, 0]
        formula = 500.0 * v + (coulomb + grip) * np.tanh(v / 5e-3)
        assert np.abs(formula).max() > 900.0 and "rest_x" not in found.channels
        assert found.channels["friction_x"] == pytest.approx(formula, rel=1e-9, abs=1e-9)
        assert gaps(found) < 1e-6


def gripping(changes=()):
    """The PATU 655 with seals, a slewing brake, and a rough pin behind its four-bar."""
    seals = {f"cylinder.{joint}.seal_friction": SEAL for joint in ("X_lift", "X_tilt", "X_ext")}
    brake = {"cylinder.slew.brake": 3000.0, "friction.slew.coulomb": 0.0}
    return crane.load("patu655", {**seals, **brake, **dict(changes)})


def levers(machine):
    return crane.joystick(
        machine,
        {
            "slew": [(0.1, 0.0), (0.3, 0.6), (0.6, 0.0)],
            "X_lift": [(0.0, 0.0), (0.2, 0.5), (0.4, -0.4), (0.7, 0.0)],
            "X_tilt": [(0.2, 0.0), (0.4, -0.5), (0.6, 0.0)],
        },
    )


def test_a_crane_balances_with_seals_and_brake():
    machine = gripping()
    found = crane.simulate(machine, levers(machine), None, 1.2, 1e-3)
    assert gaps(found) < 1e-6
    without = crane.load("patu655", {"friction.slew.coulomb": 0.0})
    other = crane.simulate(without, levers(without), None, 1.2, 1e-3)
    assert found.channels["dissipated"][-1] > 1.2 * other.channels["dissipated"][-1]
    assert (found.v[-100:, 0] == 0).all() and found.q[-1, 0] > 0.01
    # friction of what slips, of both signs, from what is recorded
    law = machine.friction["X_lift"]
    v = found.v[:, 1]
    slips = np.abs(v) > 1e-4
    coulomb = law.coulomb + law.stiction * np.exp(-((v / law.stribeck) ** 2))
    formula = law.viscous * v + (coulomb + pressed(found, "X_lift")) * np.sign(v)
    assert set(np.sign(v[slips])) == {1.0, -1.0}
    assert found.channels["friction_X_lift"][slips] == pytest.approx(formula[slips], rel=1e-9)


@pytest.mark.parametrize("smoothing", [0.0, 5e-3])
def test_machine_code_and_pinocchio_agree_along_a_motion(smoothing):
    """Rates, what is seen and the margin, at states with joints at rest and without."""
    smooth = {
        f"friction.{joint}.smoothing": smoothing for joint in ("slew", "X_lift", "X_tilt", "X_ext")
    }
    machine = gripping(smooth if smoothing else ())
    drive = crane.control.ValveDrive(machine, levers(machine))
    compiled, plain = (
        Chart.from_dynamics(Dynamics(machine, backend=backend), drive, drive.circuit.state_count)
        for backend in ("compiled", "pinocchio")
    )
    fast = RosenbrockStepper(compiled)
    slow, checked = PythonStepper(plain), PythonStepper(compiled)
    recording = crane.simulate(machine, drive, None, 0.8, 1e-2)
    rested, n = 0, len(machine.active)
    for i in range(0, 80, 7):
        state, time = np.zeros(slow.state_layout.size), float(recording.time[i]) + 1e-4
        at = slow.state_layout.view(state)
        at.q[:] = machine.closure.solve(recording.q[i])
        at.v_a[:] = recording.v[i]
        at.controller[:] = drive.start(recording.q[i])
        for joint, start in zip(
            drive.circuit.joints, drive.circuit.cylinder_state_starts, strict=True
        ):
            for k, side in enumerate("ab"):
                at.controller[start + k] = recording.channels[f"pressure_{joint}_{side}"][i] - 1e3
        slow.find_modes(time, state)
        other = state.copy()
        checked.find_modes(time, other)
        assert np.array_equal(plain.stick_slip.is_held, compiled.stick_slip.is_held)
        assert other == pytest.approx(state, abs=1e-12)
        rested += plain.stick_slip.is_held.sum()
        fast.adopt_modes()
        rate, seen = slow.observe(time, state)
        found, margin = fast.observe(time, state)
        sizes = np.maximum(np.abs(seen), 1.0)
        assert np.abs((found - seen) / sizes).max() < 1e-9
        assert margin == pytest.approx(slow.transition_margin, abs=1e-8)
        rated, again = checked.observe(time, state)
        assert again == pytest.approx(seen, rel=1e-9, abs=1e-6)
        assert at.v_a.shape == (n,)
        assert rated == pytest.approx(rate, rel=1e-8, abs=1e-6)
    assert rested > 0 or smoothing


def test_joints_that_hold_share_the_limits_of_the_moment():
    """A rough pin and a cylinder give way at F_pin |Gamma| + F_cylinder, by virtual work."""
    alone = {"X_ext": 0.1, "slew": 0.0, "X_lift": 0.117}
    changes = {"cylinder.X_tilt.seal_friction": SEAL}
    machine = crane.load("patu655", changes, lock=alone)
    pins = {
        "q3": crane.description.Friction(coulomb=400.0),
        "X_tilt": crane.description.Friction(coulomb=200.0),
    }
    machine = machine.replace(friction=pins)
    q = machine.closure.solve([0.3])
    gamma = machine.closure.gamma(q)[:, 0]
    dynamics = Dynamics(machine)
    weight = dynamics.gravity(np.array([0.3]))[0]
    cylinder = machine.hydraulics.cylinders["X_tilt"]
    p_b = 5e6
    p_a = (weight + cylinder.area_b * p_b) / cylinder.area_a
    seals = SEAL * (p_a + p_b - 2 * TANK)
    limit = 200.0 + seals + 400.0 * abs(gamma[machine.column("q3")])
    per = dynamics.project_wrenches(
        np.array([[0.3]]), {machine.tip: np.array([[0, 0, 1.0, 0, 0, 0]])}
    )[0, 0]
    top = 2.0 * limit / abs(per)
    pull = crane.Wrench(machine.tip, [(0, 0, 0), (0, 0, top)], times=[0.0, 1.0])
    with pytest.warns(crane.CraneWarning, match="in more ways than one"):
        found = crane.simulate(machine, closed(machine, {"X_tilt": (p_a, p_b)}), [0.3], 0.6, 1e-3,
                               loads=[pull])  # fmt: skip
    starts = 0.5
    still = found.time < starts - 1e-4
    # leakage of the closed spool changes the pressures by little meanwhile
    first = found.time[np.flatnonzero(found.v[:, 0])[0]]
    assert first == pytest.approx(starts, abs=5e-3)
    assert (found.q[still & (found.time < first)] == found.q[0]).all()
    assert seals > 0.2 * limit


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["compiled", "pinocchio"])
def test_measured_pressures_of_the_tank_count(tmp_path, backend):
    """A replay of a recording whose tank is not the machine's: that of the recording counts."""
    law = {"coulomb": 100.0, "viscous": 900.0}
    machine = rig(tmp_path, axis="1 0 0", mass=300.0, cylinder={"seal_friction": SEAL},
                  friction=law)  # fmt: skip
    times = [0.0, 0.01, 0.02, 0.2]
    tank = np.array([8e5, 8e5, 8e5, 4e5])
    signals = crane.control.ValveSignals(
        machine, times, {"x": [0.0, 0.0, 0.3, 0.3]}, [8e6] * 4, tank
    )
    found = run(machine, signals, [0.1], 0.12, 2e-3, backend=backend)
    late = found.time > 0.04
    p = [found.channels[f"pressure_x_{side}"] for side in "ab"]
    measured = found.channels["pressure_tank"]
    assert np.ptp(measured[late]) > 1e5
    seals = SEAL * sum(np.maximum(x - measured, 0.0) for x in p)
    formula = 100.0 + seals + 900.0 * found.v[:, 0]
    assert found.channels["friction_x"][late] == pytest.approx(formula[late], rel=1e-9)


def test_what_holds_nothing_beside_what_holds_much(tmp_path):
    """The small limit of a released brake does not affect the scales of other joints."""
    slight = dict.fromkeys(("c1", "c2", "c3", "c4"), 1e-12)
    machine = rig(tmp_path, ORIFICE | slight, axis="1 0 0", joints=("x", "y"),
                  cylinder={"brake": BRAKE})  # fmt: skip
    machine = machine.replace(friction={"x": crane.description.Friction(coulomb=1e6)})
    signals = crane.control.ValveSignals(machine, [0.0], {"y": [0.5]})
    found = run(machine, signals, None, 0.2, 1e-3)
    assert (found.q[:, 0] == found.q[0, 0]).all()
    assert np.abs(found.channels["rest_y"]).max() <= 2 * MIN_COULOMB_FRICTION
    assert found.v[-1, 1] > 0


def test_seals_press_through_dead_centres(tmp_path):
    """A crank spins while the cylinder at its slider turns back: seen from others, the same."""
    parts = {
        "cylinders": {"s": Cylinder("s", 2e-4, 2e-4, 1e-3, 1e-3, seal_friction=2e-5)},
        "valves": {"s": Valve("s", c1=4e-6, c2=4e-6, c3=4e-6, c4=4e-6)},
    }
    machine = singular_linkages.slider_crank(tmp_path, "s", 0.3, 0.6)
    machine = machine.replace(
        friction={"s": crane.description.Friction(coulomb=2.0)},
        hydraulics=Hydraulics(Supply(5e6), Oil(), **parts),
    )
    signals = crane.control.ValveSignals(machine, [0.0], {"s": [0.3]})
    start = singular_linkages.start(machine, "a", 15.0)
    with pytest.warns(crane.CraneWarning, match=r"^'s' passes a dead centre"):
        found = crane.simulate(machine, signals, start, 0.8, 1e-3)
    a = np.abs(np.diff(np.sign(found.v[:, 0]))) > 0
    assert a.sum() >= 2
    v = found.v[:, 0]
    slips = np.abs(v) > 0.05
    formula = (2.0 + pressed(found, "s", 2e-5)) * np.sign(v)
    assert found.channels["friction_s"][slips] == pytest.approx(formula[slips], rel=1e-9)
    assert np.ptp(pressed(found, "s", 2e-5)) > 5.0
    assert gaps(found) < 1e-6


@pytest.mark.parametrize("method", ["DOP853", "rk4"])
def test_forces_know_no_pressure(tmp_path, method):
    """Without a circuit that says what presses them, they are not there, to the last bit."""
    with_, without = (
        rig(tmp_path, axis="1 0 0", cylinder=cylinder)
        for cylinder in ({"seal_friction": SEAL, "brake": BRAKE}, {})
    )
    found, other = (
        run(machine, lambda t, q, v: [300.0 * np.sin(9 * t)], [0.2], 0.5, 1e-3, method=method)
        for machine in (with_, without)
    )
    assert np.ptp(found.q) > 1e-3
    assert np.array_equal(found.q, other.q)
    assert found.channels.keys() == other.channels.keys()
    batch = crane.simulation.simulate_batch(
        [with_], lambda m: lambda t, q, v: [300.0 * np.sin(9 * t)], [[0.2]], 0.5, method=method
    )
    assert np.array_equal(batch.q[0], found.q)


def test_sensitivities_know_seals_and_brake(tmp_path):
    """Against differences of simulations, of order 4."""
    law = {"coulomb": 300.0, "viscous": 2000.0}
    base = {"cylinder.x.seal_friction": SEAL, "cylinder.x.brake": BRAKE,
            "cylinder.x.brake_release": 0.05}  # fmt: skip
    parts = {name.rpartition(".")[2]: value for name, value in base.items()}
    machine = rig(tmp_path, ORIFICE | {"dead_band": 0.1}, cylinder=parts, friction=law)

    def simulated(changes):
        other = crane.load(machine.path, changes)
        return signals(other), other

    def signals(other):
        return crane.control.ValveSignals(other, [0.0, 0.2, 0.4, 0.8], {"x": [0.0, 0.0, 0.5, 0.5]})

    by, outputs = tuple(base), ("x", "x_velocity", "pressure_x_a")
    found = crane.sensitivities(machine, signals(machine), [0.2], 0.6, 1e-3, parameters=by,
                                outputs=outputs, tolerance=1e-9)  # fmt: skip
    for k, name in enumerate(by):
        h = 0.02 * base[name]
        rows = {}
        for j in (-2, -1, 1, 2):
            control, other = simulated({name: base[name] + j * h})
            r = run(other, control, [0.2], 0.6, 1e-3, tolerance=1e-10)
            rows[j] = np.column_stack([r.q, r.v, r.channels["pressure_x_a"]])
        true = (8 * (rows[1] - rows[-1]) - (rows[2] - rows[-2])) / (12 * h)
        sizes = np.abs(true).max(axis=0)
        assert (sizes > 0).all()
        off = np.abs(found.derivatives[-100:, :, k] - true[-100:]) / sizes
        assert off.max() < 2e-3, name
    weights = np.random.default_rng(1).normal(size=found.derivatives.shape[:2]) * [1.0, 1.0, 1e-7]
    back = crane.simulation.gradient(
        machine,
        signals(machine),
        [0.2],
        0.6,
        1e-3,
        functional=weights,
        parameters=by,
        outputs=outputs,
        tolerance=1e-9,
    )
    ahead = np.einsum("ik,ikp->p", weights, found.derivatives)
    assert back.derivatives == pytest.approx(ahead, rel=1e-4)
    bare = rig(tmp_path, ORIFICE, friction=law)
    with pytest.raises(CraneError, match="'cylinder.x.brake' cannot be varied about 0"):
        crane.sensitivities(bare, signals(bare), [0.2], 0.1, parameters=["cylinder.x.brake"])


def test_linear_models_have_seals_that_are_smooth(tmp_path):
    """d v'/d v has -F_K / (v_s m) at rest, beside the same machine without seals."""
    law = {"viscous": 500.0, "smoothing": 0.5}
    pressures = {"x": ((2000 * G + AREA_B * 3e6) / AREA_A, 3e6)}
    models = []
    for cylinder in ({}, {"seal_friction": SEAL}):
        machine = rig(tmp_path, friction=law, cylinder=cylinder)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            models.append(crane.linearize(machine, pressures=pressures))
    change = models[1].A[1, 1] - models[0].A[1, 1]
    a, b = (models[1].x[models[1].states.index(f"pressure_x_{side}")] for side in "ab")
    assert change == pytest.approx(-SEAL * (a + b - 2 * TANK) / 0.5 / 2000.0, rel=1e-9)
    assert change < -0.5


def test_linear_models_have_seals_that_slide(tmp_path):
    """At a constant speed the trimmed force bears them."""
    machine = rig(tmp_path, axis="1 0 0", cylinder={"seal_friction": SEAL},
                  friction={"viscous": 500.0})  # fmt: skip
    model = quiet(crane.linearize, machine, velocity={"x": 0.05})
    a, b = (model.x[model.states.index(f"pressure_x_{side}")] for side in "ab")
    force = AREA_A * a - AREA_B * b
    assert force == pytest.approx(
        25.0 + MIN_COULOMB_FRICTION + SEAL * (a + b - 2 * TANK), rel=1e-7
    )


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"brake_release": 0.0}, "brake_release of the cylinder of 'x' is 0, it must be positive"),
        ({"brake": -1.0}, "'brake' of cylinder of 'x' is -1, give at least 0"),
        ({"seal_friction": -1.0}, "'seal_friction' of cylinder of 'x' is -1, give at least 0"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, change, text):
    with pytest.raises(CraneError, match=text):
        rig(tmp_path, cylinder=change)


def test_newton_per_bar_are_told(tmp_path):
    with pytest.warns(crane.CraneWarning, match="looks like N per bar, write 16e-5"):
        rig(tmp_path, cylinder={"seal_friction": 16.0})
    with pytest.warns(crane.CraneWarning, match="looks like percent, write 5e-2"):
        rig(tmp_path, cylinder={"brake": 10.0, "brake_release": 5.0})


def test_their_units_are_told():
    tree = MachineVariants(crane.load("patu655")).spec.tree
    for joint, brake in (("slew", "N m"), ("X_lift", "N")):
        assert parameter_unit(tree, f"cylinder.{joint}.brake") == brake
        assert parameter_unit(tree, f"cylinder.{joint}.seal_friction") == f"{brake}/Pa"


def test_a_written_machine_keeps_them(tmp_path):
    machine = gripping({"cylinder.slew.brake_release": 0.08})
    again = crane.load(crane.write_machine(machine, tmp_path / "again"))
    for joint in ("slew", "X_lift"):
        assert again.hydraulics.cylinders[joint] == machine.hydraulics.cylinders[joint]
    assert again.hydraulics.cylinders["slew"].brake == 3000.0


def test_optimal_control_asks_for_a_smooth_law(tmp_path):
    machine = slewing(tmp_path)
    with pytest.raises(CraneError, match=r"friction of 'turn' sticks.*friction.turn.smoothing"):
        crane.simulation.casadi_function(machine, "simulation")
    smooth = slewing(tmp_path, friction={"smoothing": 0.1}, seal_friction=2e-5)
    function = crane.simulation.casadi_function(smooth, "simulation")
    inputs = {"q": [0.1], "v_a": [0.02], "circuit": [4e6, 3e6], "signals": [0.12]}
    found = function(**inputs)
    grip = BRAKE * (1 - (0.12 - 0.1) / 0.05) + 2e-5 * (7e6 + 2 * (1e3 - TANK))
    torque = 1e-3 * 1e6 - grip * np.tanh(0.2)
    assert float(found["a_a"]) == pytest.approx(torque / 15.0, rel=1e-12)
