"""Formulas as CasADi functions, against machine code, Pinocchio and CasADi's integrators."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest

import crane
from crane.codegen.casadi_expressions import casadi_expressions
from crane.codegen.symbolic import (
    Tape,
    apply_function,
    copysign,
    dot_products,
    maximum,
    where_positive,
)
from crane.common.errors import CraneError
from crane.control import ValveDrive, ValveSignals
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.rosenbrock import RosenbrockStepper

ca = pytest.importorskip("casadi", reason="CasADi is not installed")
pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")
ARGUMENTS = {
    "inverse": 2, "forward": 2, "mass_matrix": 0, "bias": 1, "gravity": 0, "friction": 1,
    "passive": 1, "energy": 1, "regressor": 2,
}  # fmt: skip


def states(machine, count=4, seed=0):
    """Closed postures near home, velocities and second arguments."""
    rng, n = np.random.default_rng(seed), len(machine.active)
    span = np.where(np.isfinite(machine.upper - machine.lower), machine.upper - machine.lower, 1.0)
    for _ in range(count):
        q_a = machine.home[machine.closure.active] + 0.03 * span * rng.uniform(-1, 1, n)
        yield machine.closure.solve(q_a), rng.normal(size=n), 100 * rng.normal(size=n)


def smooth(machine, over=2e-3):
    laws = {joint: replace(law, smoothing=over) for joint, law in machine.friction.items()}
    return machine.replace(friction=laws)


@pytest.fixture(scope="module")
def log_crane():
    return crane.load("patu655", changes={"payload.mass": 211.4})


@pytest.mark.parametrize("name", ["patu655", "tx40"])
@pytest.mark.parametrize("quantity", ARGUMENTS)
def test_values_and_derivatives_are_those_of_machine_code(name, quantity):
    """Values to 1e-12; (df/dq) gamma against `Dynamics.derivatives`, which goes through loops."""
    machine = crane.load(name)
    dynamics, function = (
        crane.Dynamics(machine),
        crane.simulation.casadi_function(machine, quantity),
    )
    for q, *rest in states(machine):
        q_a, rest = q[machine.closure.active], rest[: ARGUMENTS[quantity]]
        wanted = np.array(getattr(dynamics, quantity)(q_a, *rest))
        found = np.array(function(q, *rest)).reshape(wanted.shape)
        assert np.abs(found - wanted).max() <= 1e-12 * max(np.abs(wanted).max(), 1.0)
        if quantity == "regressor":
            continue
        symbols = [ca.SX.sym(f"x{i}", len(x)) for i, x in enumerate((q, *rest))]
        flat = ca.vec(function(*symbols).T)
        slopes = [np.array(ca.Function("slopes", symbols, [ca.jacobian(flat, x)])(q, *rest))
                  for x in symbols]  # fmt: skip
        slopes[0] = slopes[0] @ machine.closure.gamma(q)
        exact = dynamics.derivatives(quantity, q_a, *rest)
        for one, other in zip(slopes, exact.values(), strict=True):
            other = other.reshape(one.shape)
            assert np.abs(one - other).max() <= 1e-10 * max(np.abs(other).max(), 1.0)


def test_a_machine_that_floats():
    machine = crane.load("anymal", floating=True)
    dynamics, rng = crane.Dynamics(machine), np.random.default_rng(0)
    q, v, x = (0.3 * rng.normal(size=len(machine.active)) for _ in range(3))
    for quantity in ("inverse", "forward"):
        wanted = getattr(dynamics, quantity)(q, v, x)
        found = np.array(crane.simulation.casadi_function(machine, quantity)(q, v, x)).ravel()
        assert np.abs(found - wanted).max() <= 1e-12 * np.abs(wanted).max()


def test_friction_is_in_when_asked_for(log_crane):
    dynamics = crane.Dynamics(log_crane)
    for quantity in ("inverse", "forward"):
        function = crane.simulation.casadi_function(log_crane, quantity, friction=True)
        for q, v, x in states(log_crane):
            wanted = getattr(dynamics, quantity)(q[log_crane.closure.active], v, x, friction=True)
            found = np.array(function(q, v, x)).ravel()
            assert np.abs(found - wanted).max() <= 1e-12 * np.abs(wanted).max()


def test_loops_gamma_and_tip(log_crane):
    loops, gamma, tip = (
        crane.simulation.casadi_function(log_crane, name) for name in ("loops", "gamma", "tip")
    )
    place = crane.Kinematics(log_crane)
    for q, *_ in states(log_crane):
        assert np.abs(np.array(loops(q))).max() < 1e-13
        open_loops = q + 1e-3 * np.isin(np.arange(len(q)), log_crane.closure.passive)
        assert np.abs(np.array(loops(open_loops))).max() > 1e-5
        assert np.array(gamma(q)) == pytest.approx(log_crane.closure.gamma(q), abs=1e-13)
        wanted = place.position(q[log_crane.closure.active])
        assert np.array(tip(q)).ravel() == pytest.approx(wanted, abs=1e-13)


def test_a_rootfinder_closes_the_loops(log_crane):
    """q_P by q_A, as the page says; its derivative is gamma."""
    closure = log_crane.closure
    q = ca.SX.sym("q", log_crane.model.nv)
    loops = crane.simulation.casadi_function(log_crane, "loops")
    active, passive = (list(map(int, x)) for x in (closure.active, closure.passive))
    problem = {"x": q[passive], "p": q[active], "g": loops(q)}
    closed = ca.rootfinder("closed", "newton", problem)
    symbol = ca.MX.sym("q_a", len(active))
    slopes = ca.Function("slopes", [symbol], [
        ca.jacobian(closed(log_crane.home[passive], symbol), symbol)
    ])  # fmt: skip
    for posture, *_ in states(log_crane, 2):
        found = np.array(closed(log_crane.home[passive], posture[active])).ravel()
        assert found == pytest.approx(posture[passive], abs=1e-9)
        wanted = closure.gamma(posture)[passive]
        assert np.array(slopes(posture[active])) == pytest.approx(wanted, abs=1e-8)


def test_the_simulation_s_rates_are_those_that_are_integrated(log_crane):
    machine = smooth(log_crane)
    function = crane.simulation.casadi_function(machine, "simulation")
    drive = ValveDrive(machine, ValveSignals(machine, [0.0], {}))
    circuit = drive.circuit
    chart = Chart.from_dynamics(crane.Dynamics(machine), drive, circuit.state_count)
    stepper = RosenbrockStepper(chart)
    rng, out = np.random.default_rng(1), np.empty(stepper._program.formula_outputs("rate").size)
    for q, v, _ in states(machine):
        own = drive.start(q[machine.closure.active]) * rng.uniform(0.7, 1.0, circuit.state_count)
        own[: circuit.stiff_state_count] += 0.2 * rng.uniform(size=circuit.stiff_state_count)
        signals = rng.uniform(3.0, 8.0, len(circuit.joints))
        state = np.concatenate([q, 0.1 * v, own, [0.0, 0.0]])
        stepper._program.call("rate", *stepper._common_arguments, signals, state, out)
        found = [
            np.array(x).ravel()
            for x in function(q, 0.1 * v, own[: circuit.stiff_state_count], signals)
        ]
        found = np.concatenate(found)
        wanted = out[: len(found)]
        assert found == pytest.approx(wanted, rel=1e-12, abs=1e-12)


def test_sundials_moves_the_crane_as_crane_does(log_crane):
    """The same rates by CVODES, two seconds of lifting."""
    machine = smooth(log_crane)
    function = crane.simulation.casadi_function(machine, "simulation")
    signals = {"X_lift": 4.9, "X_ext": 6.6}
    command = ValveSignals(machine, [0.0], {joint: [x] for joint, x in signals.items()})
    drive = ValveDrive(machine, command)
    run = crane.simulate(machine, command, duration=2.0, step=0.01)
    stiff = drive.circuit.stiff_state_count
    own = drive.start(machine.home[machine.closure.active])[:stiff]
    sizes = len(machine.home), len(machine.active), stiff
    scale = ca.vertcat(ca.DM.ones(sum(sizes[:2])), np.maximum(np.abs(own), 1.0))
    state = ca.SX.sym("state", sum(sizes))
    parts = ca.vertsplit(state * scale, [0, sizes[0], sum(sizes[:2]), sum(sizes)])
    levels = [signals.get(joint, 5.8) for joint in drive.circuit.joints]
    rates = ca.vertcat(*function(*parts, levels)[:3]) / scale
    integrator = ca.integrator(
        "crane", "cvodes", {"x": state, "ode": rates}, 0.0, 2.0,
        {"abstol": 1e-9, "reltol": 1e-9, "max_num_steps": 100000},
    )  # fmt: skip
    start = np.concatenate([machine.home, np.zeros(sizes[1]), own]) / np.array(scale).ravel()
    end = np.array(integrator(x0=start)["xf"]).ravel() * np.array(scale).ravel()
    active = end[machine.closure.active]
    assert np.abs(active - run.q[-1]).max() < 1e-6
    assert np.abs(run.q[-1] - run.q[0]).max() > 0.05
    vapour = machine.hydraulics.oil.vapour_pressure
    at = drive.circuit.cylinder_state_starts[machine.hydraulics.joints.index("X_lift")]
    found = vapour + end[sizes[0] + sizes[1] + at]
    assert found == pytest.approx(run.channels["pressure_X_lift_a"][-1], rel=1e-4)


@pytest.mark.parametrize("a, b", [(0.7, -0.4), (-0.7, 0.4), (-0.7, -0.4), (0.3, 0.9)])
def test_operations_and_their_derivatives(a, b):
    """Those that CasADi writes differently, at numbers of either sign."""
    tape = Tape()
    x, y = tape.load(0, 0), tape.load(0, 1)
    outputs = [
        maximum(x, y),
        copysign(x, y),
        where_positive(x, y, x * x),
        apply_function("abs", x),
        2.0 / y,
        apply_function("tanh", x) - y,
        -x,
        3.0,
    ]
    symbol = ca.SX.sym("x", 2)
    found = ca.vertcat(*casadi_expressions(outputs, [ca.vertsplit(symbol)]))
    both = ca.Function("both", [symbol], [found, ca.jacobian(found, symbol)])
    values, slopes = (np.array(part) for part in both([a, b]))
    wanted = [
        max(a, b), math.copysign(a, b), b if a > 0 else a * a, abs(a), 2 / b, math.tanh(a) - b,
        -a, 3.0,
    ]  # fmt: skip
    assert values.ravel() == pytest.approx(wanted, abs=1e-15)
    side = math.copysign(1.0, a)
    by = [
        [a > b, b > a], [side * math.copysign(1.0, b), 0], [0, 1] if a > 0 else [2 * a, 0],
        [side, 0], [0, -2 / b**2], [1 - math.tanh(a) ** 2, -1], [-1, 0], [0, 0],
    ]  # fmt: skip
    assert slopes == pytest.approx(np.array(by, dtype=float), abs=1e-14)


def test_what_cannot_be_is_one_line(log_crane, slider_crank, five_bar, monkeypatch):
    for machine, quantity, options, said in (
        (log_crane, "mass", {}, "quantity 'mass' is unknown, known: bias"),
        (log_crane, "gravity", {"friction": True}, "'gravity' is without friction"),
        (log_crane, "simulation", {}, "friction.slew.smoothing=2e-3"),
        (slider_crank, "simulation", {}, "has no valves, describe its circuit"),
        (five_bar, "tip", {}, "has no tip, name a link"),
    ):
        with pytest.raises(CraneError) as error:
            crane.simulation.casadi_function(machine, quantity, **options)
        assert said in str(error.value) and "\n" not in str(error.value)
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(CraneError, match="repository's folder: pip install '..casadi.'"):
        crane.simulation.casadi_function(log_crane, "gravity")


def test_dots_are_sums_of_products():
    tape = Tape()
    x = tape.load_vector(0, 0, 4)
    found = casadi_expressions(
        dot_products([x[0], 2.0, x[1]], [x[1:], [x[3], 0.0, x[0]]]), [[1.0, 2.0, 3.0, 4.0]]
    )
    assert [float(value) for value in found] == [1 * 2 + 2 * 3 + 2 * 4, 1 * 4 + 2 * 1]
