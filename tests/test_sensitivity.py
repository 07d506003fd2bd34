"""Derivatives of the dynamics against differences of order 8 and Pinocchio's."""

from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from linkages import MACHINES, loaded
from test_floating import ARM, states, walker
from warned import quiet

import crane
from crane.common.errors import CraneError
from crane.description.parameter_changes import parameters
from crane.dynamics.compiled_dynamics import DERIVATIVES_OF
from crane.dynamics.quantity_evaluator import ConstantDerivatives
from crane.formats.machine_loading import MachineVariants

ORDER_8 = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
BUNDLED = ("mini_forwarder", "patu655", "tx40", "kr300")
EVERY = (*BUNDLED, *(name for name in MACHINES if name not in ("delta", "stewart")))
QUANTITIES = ("inverse", "forward", "mass_matrix", "bias", "gravity", "friction", "passive",
              "energy", "regressor")  # fmt: skip
STATES = {"inverse": 3, "forward": 3, "regressor": 3, "mass_matrix": 1, "gravity": 1}


@cache
def machine_of(name):
    if name in MACHINES:
        return loaded(name)
    return quiet(crane.load, name)


dynamics_of = cache(crane.Dynamics)


def state(machine, seed):
    """Near home, within the limits, at velocities that the machine may have."""
    random = np.random.default_rng(seed)
    n, closure = len(machine.active), machine.closure
    span = np.minimum(
        np.where(np.isfinite(machine.upper), machine.upper - machine.lower, 1.0), 1.0
    )
    q_a = machine.home[closure.active] + 0.05 * span * random.uniform(-1, 1, n)
    q_a = np.clip(q_a, machine.lower + 0.03 * span, machine.upper - 0.03 * span)
    dynamics = dynamics_of(machine)
    v_a = span * random.normal(size=n)
    a_a = 3.0 * span * random.normal(size=n)
    return dynamics, span, q_a, v_a, a_a


def difference(function, at, along, step):
    """Central difference of order 8 along a direction."""
    return (
        sum(w * function(at + (i - 4) * step * along) for i, w in enumerate(ORDER_8) if w) / step
    )


def compare(dynamics, quantity, friction, span, arguments, tolerance=1e-9, pace=0.1):
    names = ("q_a", "v_a", "x")[: len(arguments)]
    found = dynamics.derivatives(quantity, *arguments, friction=friction)
    key = quantity.replace("_", " ") + (" with friction" if friction else "")
    machine, n = dynamics.machine, len(span)

    def value(*given):
        q_a, v_a, x = (*given, *[np.zeros((9, n))] * (3 - len(given)))
        return dynamics.evaluate_closed(key, machine.closure.solve(q_a), v_a, x)

    for part, derivative in enumerate(found.values()):
        for k in range(n):
            # forces are polynomials of velocities and accelerations; postures are not
            step = 2e-3 if part == 0 else pace
            unit = np.eye(n)[k] * (span[k] if part < 2 or quantity != "forward" else 1.0)
            given = [np.tile(x, (9, 1)) for x in arguments]
            given[part] += np.arange(-4, 5)[:, None] * step * unit
            wanted = ORDER_8 @ value(*given) / step
            got = derivative[..., k].ravel() * unit[k]
            scale = max(np.abs(derivative * span).max(), 1e-4 * np.abs(value(*given)[4]).max())
            error = np.abs(got - wanted).max() / (scale or 1.0)
            assert error < tolerance, (quantity, names[part], machine.active[k], error)


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_derivatives_are_differences(name, quantity):
    machine = machine_of(name)
    dynamics, span, q_a, v_a, a_a = state(machine, 3)
    x = dynamics.inverse(q_a, v_a, a_a) if quantity == "forward" else a_a
    if quantity == "friction":
        v_a = np.abs(v_a) + 0.2 * span  # away from where it jumps
    arguments = (q_a, v_a, x)[: STATES.get(quantity, 2)]
    compare(
        dynamics, quantity, False, span, arguments, pace=5e-3 if quantity == "friction" else 0.1
    )


@pytest.mark.parametrize("name", ("mini_forwarder", "patu655", "kr300"))
@pytest.mark.parametrize("quantity", ("inverse", "forward"))
@pytest.mark.parametrize("smoothing", (0.0, 0.3))
def test_with_friction_that_sticks_or_is_smooth(name, quantity, smoothing):
    machine = machine_of(name)
    friction = crane.description.Friction(
        coulomb=40.0, coulomb_offset=3.0, viscous=200.0, viscous_offset=9.0, smoothing=smoothing,
        stiction=15.0, stribeck=0.4, stiction_2=-5.0, stribeck_2=0.7, root=20.0, memory=8.0,
        memory_speed=0.5, presliding=10.0,
    )  # fmt: skip
    machine = machine.replace(friction=dict.fromkeys(machine.joints, friction))
    dynamics, span, q_a, v_a, a_a = state(machine, 4)
    v_a = np.abs(v_a) + 0.2 * span  # away from where friction that sticks jumps
    x = dynamics.inverse(q_a, v_a, a_a, friction=True) if quantity == "forward" else a_a
    compare(dynamics, quantity, True, span, (q_a, v_a, x), 3e-9, 5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ("delta", pytest.param("stewart", marks=pytest.mark.long)))
@pytest.mark.parametrize("quantity", ("inverse", "forward"))
def test_of_machines_with_one_large_cluster(name, quantity):
    dynamics, span, q_a, v_a, a_a = state(machine_of(name), 3)
    x = dynamics.inverse(q_a, v_a, a_a) if quantity == "forward" else a_a
    compare(dynamics, quantity, False, span, (q_a, v_a, x))


@pytest.mark.parametrize("name", ("arm", "walker"))
def test_floating_bases_move_along_their_twist(name, tmp_path):
    if name == "walker":
        machine = walker()
    else:
        (tmp_path / "arm.urdf").write_text(ARM)
        machine = crane.load(tmp_path / "arm.urdf", floating=True)
    dynamics = crane.Dynamics(machine)
    n = len(machine.active)
    ((q_a, v_a, x),) = states(machine, 1)
    found = dynamics.derivatives("forward", q_a, v_a, x)
    column = machine.coordinates.floating_base_columns[0]
    base = [machine.active.index(joint) for joint in machine.joints[column : column + 6]]
    place, vector = base[:3], base[3:]
    motions = pin.exp3(q_a[vector]), q_a[place].copy()

    def moved(k, s):
        """q_a where v_k = 1 leads in a time s, the base turning about its own axes."""
        out, unit = q_a.copy(), np.eye(n)[k]
        out[place] = motions[1] + motions[0] @ unit[place] * s
        out[vector] = pin.log3(motions[0] @ pin.exp3(unit[vector] * s))
        if k not in base:
            out[k] += s
        return out

    for k in range(n):
        step = 5e-3
        wanted = (
            sum(
                w * dynamics.forward(moved(k, (i - 4) * step), v_a, x)
                for i, w in enumerate(ORDER_8)
            )
            / step
        )
        scale = np.abs(found["q_a"]).max()
        np.testing.assert_allclose(found["q_a"][:, k], wanted, rtol=0, atol=1e-9 * scale)
    for name, at in (("v_a", v_a), ("tau_a", x)):
        for k in range(n):

            def pushed(y, name=name):
                return dynamics.forward(q_a, *((y, x) if name == "v_a" else (v_a, y)))

            wanted = difference(pushed, at, np.eye(n)[k], 0.1)
            scale = np.abs(found[name]).max()
            np.testing.assert_allclose(found[name][:, k], wanted, rtol=0, atol=1e-9 * scale)


def test_open_arms_agree_with_pinocchio():
    machine = machine_of("tx40")
    dynamics, _, q_a, v_a, a_a = state(machine, 5)
    tau = dynamics.inverse(q_a, v_a, a_a)
    model, data = machine.model, machine.model.createData()
    by_q, by_v, by_tau = pin.computeABADerivatives(model, data, q_a, v_a, tau)
    by_tau = np.triu(by_tau) + np.triu(by_tau, 1).T
    found = dynamics.derivatives("forward", q_a, v_a, tau)
    for name, wanted in (("q_a", by_q), ("v_a", by_v), ("tau_a", by_tau)):
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(found[name], wanted, rtol=0, atol=1e-11 * scale)
    by_q, by_v, by_a = pin.computeRNEADerivatives(model, data, q_a, v_a, a_a)
    by_a = np.triu(by_a) + np.triu(by_a, 1).T
    found = dynamics.derivatives("inverse", q_a, v_a, a_a)
    for name, wanted in (("q_a", by_q), ("v_a", by_v), ("a_a", by_a)):
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(found[name], wanted, rtol=0, atol=1e-11 * scale)


def test_every_operation_and_the_formulas_of_their_own_agree(monkeypatch):
    """Differentiated operation by operation, and as the equations say."""
    machine = machine_of("mini_forwarder")
    dynamics, _, q_a, v_a, a_a = state(machine, 7)
    q, inputs = machine.closure.solve(q_a), np.concatenate([v_a, a_a])
    found = dynamics._required_formula(DERIVATIVES_OF + "forward").evaluate_closed(q, inputs)
    monkeypatch.setattr("crane.dynamics.compiled_dynamics._ANALYTIC_DERIVATIVES", {})
    plain = crane.Dynamics(crane.load("mini_forwarder"))
    plain.constant_pattern[0] = np.nan  # another program
    other = plain._required_formula(DERIVATIVES_OF + "forward").evaluate_closed(q, inputs)
    np.testing.assert_allclose(found, other, rtol=0, atol=1e-12 * np.abs(other).max())


@pytest.mark.parametrize(
    "name",
    ("mini_forwarder", "four_bar", "planar_leg")
    + tuple(pytest.param(x, marks=pytest.mark.slow) for x in BUNDLED if x != "mini_forwarder"),
)
def test_numbers_of_the_machine(name):
    """A sample of all kinds of them, pins of closed loops among them."""
    machine = machine_of(name)
    dynamics, _, q_a, v_a, a_a = state(machine, 8)
    v_a = np.abs(v_a) + 0.05
    variants = MachineVariants(machine)
    values = parameters(variants.spec)
    heads = ("control", "supply", "oil", "cylinder", "valve", "valve_control")
    names = [x for x in values if x.split(".")[0] not in heads]
    random, named, possible, tried = np.random.default_rng(9), ConstantDerivatives(machine), [], 0
    for number in random.permutation(names)[:18].tolist():
        try:
            named.jacobian([number], dynamics.constants_of)
        except CraneError as error:
            assert "cannot be varied" in str(error)
            continue
        possible.append(number)
    found = dynamics.derivatives("inverse", q_a, v_a, a_a, friction=True, by=possible)
    for number in possible:
        unit = abs(values[number]) or 0.1

        def value(x, number=number, unit=unit):
            made = variants.machine({number: values[number] + float(x) * unit})
            return crane.Dynamics(made).inverse(q_a, v_a, a_a, friction=True)

        # from one side: most must not be negative
        ahead = np.array([-25 / 12, 4.0, -3.0, 4 / 3, -1 / 4])
        step = 1e-4
        wanted = sum(w * value(i * step) for i, w in enumerate(ahead)) / step
        scale = max(np.abs(wanted).max(), np.abs(value(0.0)).max())
        np.testing.assert_allclose(
            found[number] * unit, wanted, rtol=0, atol=2e-10 * scale, err_msg=number
        )
        tried += np.abs(wanted).max() > 1e-6 * scale
    assert tried > 3


def test_stacks_are_samples_one_after_the_other():
    machine = machine_of("patu655")
    dynamics, _, q_a, v_a, a_a = state(machine, 10)
    rows = [state(machine, seed)[2:] for seed in range(4)]
    q, v, a = (np.array(x) for x in zip(*rows, strict=True))
    names = ("q_a", "a_a", "lift_boom.mass", "lift_eye.x")
    stack = dynamics.derivatives("inverse", q, v, a, by=names)
    assert list(stack) == list(names)
    assert stack["q_a"].shape == (4, 4, 4) and stack["lift_eye.x"].shape == (4, 4)
    for i, row in enumerate(rows):
        one = dynamics.derivatives("inverse", *row, by=names)
        for name in names:
            scale = np.abs(one[name]).max()
            np.testing.assert_allclose(stack[name][i], one[name], rtol=0, atol=1e-11 * scale)
    mass = dynamics.derivatives("mass_matrix", q, by=("q_a", "lift_boom.mass"))
    assert mass["q_a"].shape == (4, 4, 4, 4) and mass["lift_boom.mass"].shape == (4, 4, 4)


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda d, x: d.derivatives("power", x), "quantity 'power' is unknown"),
        (lambda d, x: d.derivatives("inverse", x, x), "derivatives of 'inverse' need a_a"),
        (lambda d, x: d.derivatives("forward", x, x, x, by=["a_a"]),
         "'forward' does not depend on 'a_a', did you mean 'tau_a'?"),
        (lambda d, x: d.derivatives("bias", x, x, friction=True), "leave friction out"),
        (lambda d, x: d.derivatives("gravity", x, by=["lift_bom.mass"]),
         "did you mean 'lift_boom.mass'?"),
        (lambda d, x: d.derivatives("gravity", x, by=["bracket1.roll"]),
         "'bracket1.roll' cannot be varied about 0: "),
        (lambda d, x: crane.Dynamics(d.machine, backend="pinocchio").derivatives("gravity", x),
         "'patu655' has no formulas to differentiate, take the compiled backend"),
        (lambda d, x: d.derivatives("bias", np.tile(x, (2, 1)), np.zeros((3, 4))),
         "stacks of [2, 3] samples do not go together"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_said(call, said):
    machine = machine_of("patu655")
    with pytest.raises(CraneError) as error:
        call(crane.Dynamics(machine), machine.home[machine.closure.active])
    assert said in str(error.value) and "\n" not in str(error.value)


def test_a_payload_counts_from_what_it_is():
    """Its inertia bends with its mass: the slope at 300 kg is not that at none."""
    machine = crane.load("patu655", changes={"payload.mass": 300.0})
    dynamics, _, q_a, v_a, a_a = state(machine, 11)
    found = dynamics.derivatives("inverse", q_a, v_a, a_a, by=["payload.mass"])["payload.mass"]

    def value(x):
        made = crane.load("patu655", changes={"payload.mass": 300.0 + float(x)})
        return crane.Dynamics(made).inverse(q_a, v_a, a_a)

    wanted = difference(value, 0.0, 1.0, 10.0)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize(("name", "most"), [("tx40", 2.65), ("patu655", 2.65), ("kr300", 2.6)])
def test_all_derivatives_of_forward_dynamics_take_few_operations(name, most):
    """Beside forward dynamics; a row of a product of matrices counts as its entries."""
    counts = {}
    dynamics = crane.Dynamics(machine_of(name))
    for quantity in ("forward", DERIVATIVES_OF + "forward"):
        counts[quantity] = dynamics._compiled_quantity(quantity)._program.max_formula_length
    assert counts[DERIVATIVES_OF + "forward"] <= most * counts["forward"]
