"""Gradients of sums over simulations against sensitivities, closed forms and differences."""

import numpy as np
import pytest
from executed_lines import at_most
from test_sensitivities import DAMPING, HYDRAULIC, MASS, STIFFNESS, block, swung

import crane
from crane.common.errors import CraneError
from crane.formats.machine_loading import MachineVariants
from crane.simulation.sensitivity import adjoint_integration, variational_integration
from crane.simulation.sensitivity.motion_sensitivities import _largest_changes, follow_motion
from crane.simulation.sensitivity.simulation_constants import SimulationConstants

ORDER_8 = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))


def last(output=0):
    """J is an output at the last instant."""

    def of(time, y):
        weights = np.zeros_like(y)
        weights[-1, output] = 1.0
        return y[-1, output], weights

    return of


def squares(time, y):
    return 0.5 * (y**2).sum(), y


def test_a_damped_spring_as_its_closed_form(tmp_path):
    spring = f"forces: [{{joint: x, stiffness: {STIFFNESS}, damping: {DAMPING}}}]"
    machine = block(tmp_path, spring=spring)
    by = ("start.x", "start.x_velocity", "block.mass", "spring.x.stiffness", "spring.x.damping")
    start = [0.3], [0.1]
    found = crane.simulation.gradient(
        machine,
        None,
        start,
        5.0,
        1e-3,
        functional=squares,
        parameters=by,
        outputs=("x", "x_velocity"),
        tolerance=1e-12,
    )

    def total(*at):
        return 0.5 * (swung(found.recording.time, *at) ** 2).sum()

    at = np.array([0.3, 0.1, MASS, STIFFNESS, DAMPING])
    assert found.functional_value == pytest.approx(total(*at), rel=1e-9)
    for i, name in enumerate(by):
        h = 3e-3 * at[i] * np.eye(5)[i]
        true = sum(w * (total(*(at + j * h)) - total(*(at - j * h))) for j, w in ORDER_8)
        assert found.derivative(name) == pytest.approx(true / (3e-3 * at[i]), rel=1e-8), name
    assert found.values == pytest.approx(at)


def forwarder():
    machine = crane.load("mini_forwarder")
    controller = crane.ComputedTorque(machine, crane.task_trajectory(machine, "lift"))
    by = ("link3.mass", "friction.X1.viscous", "link3_G.x", "start.X1", "link7.inertia.xx")
    outputs = ("X1", "q2", "X1_force", "tip_z", "kinetic")
    return machine, controller, None, 0.6, by, outputs


def hydraulic():
    """Valves that open, soft oil, joints that stick, a cylinder that meets its end stop."""
    changes = {"payload.mass": 150.0, "X_lift.upper": 0.31}
    machine = crane.load("patu655", changes=changes, lock={"X_ext": 0.1, "slew": 0.0})
    levers = {}
    for joint, share in (("X_lift", 1.0), ("X_tilt", -0.5)):
        valve = machine.hydraulics.valves[joint]
        ways = share * np.array([0.0, 0.0, 1.0, 1.0, -0.5])
        levers[joint] = valve.neutral + ways * (valve.full - valve.neutral)
    signals = crane.control.ValveSignals(machine, [0, 0.1, 0.3, 0.6, 0.8], levers)
    by = (*HYDRAULIC, "start.X_lift", "friction.X_tilt.coulomb", "tilt_boom.com.x",
          "end_stop.X_lift.stiffness")  # fmt: skip
    outputs = ("X_lift", "X_tilt_velocity", "pressure_X_lift_a", "inclination_lift_boom")
    return machine, signals, [0.3, 0.3], 0.8, by, outputs


def both(machine, controller, initial, duration, by, outputs, accuracy):
    """Sums of random weights of what `follow` gives, and the gradients of these."""
    track, _, _, asked = follow_motion(
        machine, controller, initial, duration, 1e-3, outputs, by, None, None, None
    )
    several = 2
    directions = asked.derivatives(by, track.time)
    base = asked.nominal_constants(track.time)
    sizes = {name: asked.typical_change(name) for name in by}
    stacked = SimulationConstants(*map(np.array, zip(*directions.values(), strict=True)))
    forward = variational_integration.VariationalIntegrator(
        track, outputs, base, stacked, np.array(list(sizes.values())), accuracy
    ).integrate()
    weights = np.random.default_rng(0).normal(size=(several, *forward.shape[:2]))
    gatherer = adjoint_integration.AdjointIntegrator(
        track, outputs, base, _largest_changes(directions, sizes), accuracy
    )
    found = gatherer.integrate_backward(weights)
    back = sum(
        getattr(found, part) @ getattr(stacked, part).T
        for part in SimulationConstants._fields if part != "references"
    )  # fmt: skip
    assert not stacked.references.any()
    parts = np.einsum("Kik,ikp->Kip", weights, forward)
    return back, parts.sum(1), np.abs(parts).max(axis=1), len(track.transitions)


@pytest.mark.slow
@pytest.mark.parametrize("made", [forwarder, hydraulic])
@pytest.mark.parametrize("parted", [False, True])
def test_it_is_the_transpose_of_sensitivities(made, parted, monkeypatch):
    """To rounding, where both take the same steps: none in parts, or each."""
    case, accuracy = list(made()), np.inf
    if parted:
        monkeypatch.setattr(variational_integration, "MAX_REFINEMENTS", 1)
        monkeypatch.setattr(adjoint_integration, "MAX_REFINEMENTS", 1)
        case[3], accuracy = 0.1, 0.0
    back, forward, size, switches = both(*case, accuracy)
    assert (np.abs(back - forward) <= 1e-10 * size).all(), np.abs(back - forward) / size
    assert parted or made is forwarder or switches > 2


@pytest.mark.parametrize("made", [forwarder, pytest.param(hydraulic, marks=pytest.mark.slow)])
def test_its_own_choice_of_steps_is_as_good(made):
    back, forward, size, _ = both(*made(), variational_integration.STEP_ACCURACY)
    assert (np.abs(back - forward) <= 1e-6 * size).all(), np.abs(back - forward) / size


@pytest.mark.long
@pytest.mark.slow
def test_all_numbers_that_matter_are_found():
    machine, controller, initial, _, _, _ = forwarder()
    found = crane.simulation.gradient(
        machine, controller, initial, 0.1, functional=last(), outputs=("X1_force",)
    )
    assert len(found.parameters) > 100
    some = list(found.parameters[::20])
    fewer = crane.sensitivities(
        machine, controller, initial, 0.1, parameters=some, outputs=("X1_force",)
    ).derivatives[-1, 0]
    sizes = np.maximum(np.abs(fewer), 1e-9 * np.abs(found.derivatives).max())
    assert (np.abs([found.derivative(name) for name in some] - fewer) <= 1e-6 * sizes).all()
    text = found.to_text()
    assert f"20 of {len(found.parameters)} numbers" in text and "1 % does to J" in text


def test_it_takes_no_more_for_more_numbers():
    """The way back, counted in lines."""
    machine, controller, initial, _, _, outputs = forwarder()
    track, _, _, asked = follow_motion(
        machine, controller, initial, 0.05, 1e-3, outputs, (), None, None, None
    )
    base, names = asked.nominal_constants(track.time), ["link3.mass", "link7.mass"]
    names += [f"link{i}.com.{axis}" for i in (3, 4, 5, 6, 7) for axis in "xyz"]
    every = asked.derivatives(names, track.time)
    work = []
    for count in (2, len(names)):
        some = {name: every[name] for name in names[:count]}
        changes = _largest_changes(some, {name: asked.typical_change(name) for name in some})
        gatherer = adjoint_integration.AdjointIntegrator(track, outputs, base, changes)
        with at_most(10**7) as counted:
            gatherer.integrate_backward(np.ones((1, 51, len(outputs))))
        work.append(counted.lines)
    assert work[1] <= 1.05 * work[0]


def test_several_at_once_are_each_by_itself(tmp_path):
    spring = f"forces: [{{joint: x, stiffness: {STIFFNESS}}}]"
    machine = block(tmp_path, f"{{x: {{coulomb: {1.7}}}}}", spring)
    given = {"parameters": ("start.x", "friction.x.coulomb"), "outputs": ("x", "x_velocity")}
    weights = np.random.default_rng(3).normal(size=(3, 1001, 2))
    found = crane.simulation.gradient(machine, None, [0.3], 2.0, 2e-3, functional=weights, **given)
    assert found.functional_value.shape == (3,) and found.derivatives.shape == (3, 2)
    for i, one in enumerate(weights):
        alone = crane.simulation.gradient(machine, None, [0.3], 2.0, 2e-3, functional=one, **given)
        assert alone.functional_value == pytest.approx(found.functional_value[i])
        assert alone.derivatives == pytest.approx(found.derivatives[i], rel=1e-6)
    assert "J3" in found.to_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mini_forwarder", "patu655"])
def test_a_machine_beside_another_has_the_numbers_of_one_that_is_loaded(name):
    machine = crane.load(name)
    dynamics, variants = crane.Dynamics(machine), MachineVariants(machine)
    random, refused = np.random.default_rng(5), 0
    for number in random.permutation(list(variants.values))[:40].tolist():
        value = variants.values[number]
        changes, found = {number: value + 5e-3 * (abs(value) or 0.1)}, []
        for made in (variants.machine, variants.perturbed_machine):
            try:
                other = made(changes)
            except CraneError:
                found.append(None)
                refused += 1
            else:
                q = other.closure.solve(machine.home[machine.closure.active], machine.home)
                found.append(np.concatenate([dynamics.constants_of(other), q]))
        assert (found[0] is None) == (found[1] is None), number
        if found[0] is not None:
            assert found[0] == pytest.approx(found[1], rel=1e-12, abs=1e-12), number
    assert refused


def test_what_has_no_gradient_is_refused(tmp_path):
    machine = block(tmp_path)
    start, by = ([0.0], [1.0]), ["block.mass"]
    weights = np.ones((101, 1))
    for options, text in (
        (
            {"functional": np.ones((100, 1)), "parameters": by},
            r"have the shape \(100, 1\), give \(101, 1\)",
        ),
        ({"functional": weights * np.nan, "parameters": by}, "not finite"),
        ({"functional": lambda t, y: (0.0, y[0]), "parameters": by}, r"have the shape \(1,\)"),
        ({"functional": weights, "parameters": ["mass"]}, "'mass'"),
        ({"functional": weights, "parameters": []}, "no number is named"),
        (
            {"functional": weights, "parameters": by, "outputs": ["y"]},
            "'y' is no output of 'block'",
        ),
    ):
        with pytest.raises(CraneError, match=text):
            crane.simulation.gradient(machine, None, start, 0.1, **options)
    found = crane.simulation.gradient(machine, None, start, 0.1, functional=weights, parameters=by)
    with pytest.raises(CraneError, match="'block.mas' is not among them"):
        found.derivative("block.mas")
    with pytest.raises(CraneError, match="where the machine has other equations"):
        crane.sensitivities("patu655", duration=0.1, parameters=["cylinder.X_tilt.stiffness"])
