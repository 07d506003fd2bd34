"""A machine's formulas as functions of CasADi, for optimal control and estimation."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from crane.closure.traced import Bodies, Constants, Loops
from crane.codegen import Number, Tape
from crane.codegen.casadi_graph import expressions
from crane.codegen.scalar import add, subtract, times, transposed
from crane.common.errors import InputError, MechanismError, known
from crane.common.extras import library
from crane.control import Signals, ValveDrive
from crane.dynamics import Dynamics
from crane.dynamics.compiled import FRICTION, QUANTITIES
from crane.dynamics.dynamics import ARGUMENTS
from crane.dynamics.joint_forces import sticking
from crane.dynamics.traced import Sweep
from crane.formats import load
from crane.hydraulics.circuit import BALANCES
from crane.machine import Machine
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.state import state_layout
from crane.simulation.integration.traced import machine_at, settings_of

_POSTURES = ("loops", "gamma", "tip")  # what depends on q alone
_SIMULATION = "simulation"

Outputs = dict[str, tuple[Sequence[Number], tuple[int, ...]]]  # formulas and their shapes


def casadi_function(
    machine: Machine | str | Path, quantity: str, *, friction: bool = False
) -> Any:
    """A quantity of a machine as a `casadi.Function`, generated from the formulas of its programs.

    All coordinates q of the spanning tree are an argument, in the order of `machine.joints`, not
    the active ones alone: the loops are no part of the function but equations `loops`, phi(q) = 0,
    for the optimisation to hold. So the branch is the one that its variables are on, where an
    iteration inside might end on another; and a function is one expression, of which CasADi has
    exact sparse derivatives of any order, and makes code. Along the closed machine

        d f / d q_A = (df/dq) gamma,    q' = gamma v_A,

    but for a base that floats, whose q holds a rotation vector. Where only q_A is wanted,
    `casadi.rootfinder` makes q_P from `loops`.

    | quantity | arguments | result |
    |---|---|---|
    | "loops" | q | phi (r,) of the independent equations |
    | "gamma" | q | dq/dq_A (nq, n) |
    | "tip" | q | place of the tip (3,) [m] |
    | "inverse", "regressor" | q, v_a, a_a | as `Dynamics` |
    | "forward" | q, v_a, tau_a | as `Dynamics` |
    | "mass_matrix", "gravity" | q | as `Dynamics` |
    | "bias", "friction", "passive" | q, v_a | as `Dynamics` |
    | "energy" | q, v_a | kinetic, potential (2,) [J] |
    | "simulation" | q, v_a, circuit, signals | what a machine with valves is simulated by |

    "simulation" gives the rates q_rate (nq,), a_a (n,), circuit_rate of the states of
    `crane.hydraulics.Circuit` (`ValveDrive(machine, command).circuit.states` names them, its
    `start` has those at rest) and balance_rate (6,) of the oil's and the energy's balances, in
    `crane.hydraulics.circuit.BALANCES`. `signals` are those of the valves [V].

    Args:
        machine: The machine, or what `crane.load` takes.
        quantity: See above.
        friction: Whether inverse or forward dynamics have friction.

    Raises:
        InputError: Unknown quantity, no CasADi, no tip, no valves, or friction that sticks, whose
            accelerations jump, in "simulation".
        MechanismError: Its formulas are too long.
    """
    ca = library("casadi", "a symbolic function")
    if not isinstance(machine, Machine):
        machine = load(machine)
    names = [*_POSTURES, *ARGUMENTS, _SIMULATION]
    if quantity not in names:
        raise InputError(f"quantity '{quantity}' is unknown, {known(names, quantity)}")
    if friction and quantity not in ("inverse", "forward"):
        raise InputError(f"'{quantity}' is without friction or with its own, leave friction out")
    if not machine.closure.compiled:
        raise MechanismError(f"'{machine.name}' is too large to have formulas: lock joints")
    if quantity == _SIMULATION:
        sizes, arguments, outputs = _simulation(machine)
    else:
        sizes, arguments, outputs = _quantity(machine, quantity, friction)
    symbols = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    flat = [x for formulas, _ in outputs.values() for x in formulas]
    given = [_given(ca, symbols, one) for one in arguments]
    values, results = expressions(flat, given), []
    for formulas, shape in outputs.values():
        part = ca.vertcat(*values[: len(formulas)]) if formulas else ca.SX(0, 1)
        values = values[len(formulas) :]
        results.append(ca.reshape(part, shape[1], shape[0]).T if len(shape) == 2 else part)
    return ca.Function(quantity, list(symbols.values()), results, list(sizes), list(outputs))


def _given(ca: Any, symbols: dict[str, Any], argument: Any) -> Any:
    """What stands for an argument of the tape: numbers, or parts named in a tuple."""
    if not isinstance(argument, tuple):
        return argument
    return [x for name in argument for x in ca.vertsplit(symbols[name])]


def _quantity(
    machine: Machine, quantity: str, friction: bool
) -> tuple[dict[str, int], list[Any], Outputs]:
    """Sizes of the arguments, what the tape's are, and formulas."""
    fast, tape, n = machine.closure.fast, Tape(), len(machine.active)
    q, posture, loops = fast.trace(tape, 0, 1)
    geometry = fast.geometry.numbers
    if quantity in _POSTURES:
        formulas, shape = _posture(machine, quantity, posture, loops)
        return {"q": len(q)}, [geometry, ("q",)], {quantity: (formulas, shape)}
    dynamics = Dynamics(machine)
    constants = Constants(tape, 2, dynamics.pattern)
    names = ARGUMENTS[quantity][1:]
    v_a, x = tape.loads(3, 0, n), tape.loads(4, 0, n)
    sweep = Sweep(posture, loops, constants, q, v_a, dynamics.form)
    formulas = QUANTITIES[quantity.replace("_", " ") + FRICTION * friction](sweep, x)
    still = [0.0] * n
    arguments = [geometry, ("q",), dynamics.numbers, *((name,) for name in names)]
    arguments += [still] * (2 - len(names))
    sizes = {"q": len(q)} | dict.fromkeys(names, n)
    return sizes, arguments, {quantity: (formulas, dynamics.shape(quantity))}


def _posture(
    machine: Machine, quantity: str, posture: Bodies, loops: Loops
) -> tuple[list[Number], tuple[int, ...]]:
    if quantity == "loops":
        return [row.phi for row in loops.rows], (len(loops.rows),)
    if quantity == "gamma":
        rows = [loops.gamma[i] for i in range(1, machine.model.nv + 1)]
        return [x for row in rows for x in row], (machine.model.nv, len(machine.active))
    if machine.tip is None:
        raise InputError(f"'{machine.name}' has no tip, name a link as its tip")
    frame = machine.model.frames[machine.frame(machine.tip)]
    body = machine.coordinates.bodies[frame.parentJoint]
    turn = machine.closure.fast.geometry.turns[body]
    arm = (turn.T @ frame.placement.translation).tolist()
    place = add(posture.origin[body], times(posture.rotation[body], arm))
    # formulas are seen from the trunk, which may be another body than the world
    return times(transposed(posture.rotation[0]), subtract(place, posture.origin[0])), (3,)


def _simulation(machine: Machine) -> tuple[dict[str, int], list[Any], Outputs]:
    """The same of what `crane.simulate` integrates."""
    for column in sticking(machine):
        joint = machine.joints[column]
        raise InputError(
            f"friction of '{joint}' sticks, so that accelerations jump: say over which "
            f"velocity it turns, as friction.{joint}.smoothing=2e-3"
        )
    # the signals are a command's references
    drive = ValveDrive(machine, Signals(machine, [0.0], {}))
    chart, layout = Chart.of(Dynamics(machine)), state_layout(machine, drive.circuit.size)
    tape, m = Tape(), len(drive.circuit.spools)
    traced = machine_at(chart, tape, layout, 4, [])
    # zeros among the settings are parts that the circuit has not
    at = traced.seen(settings_of(drive, tape, 2, True), tape.loads(3, 0, m))
    tau, rates = drive.trace(at)
    traced = traced.gripped(drive, at)
    moved, stiff = traced.moved(tau, rest=False), drive.circuit.stiff
    numbers = machine.closure.fast.geometry.numbers, chart.dynamics.numbers, drive.settings
    sizes = {"q": machine.model.nv, "v_a": len(machine.active), "circuit": stiff, "signals": m}
    outputs: Outputs = {
        "q_rate": (traced.sweep.slopes, (machine.model.nv,)),
        "a_a": (moved.a_a, (len(machine.active),)),
        "circuit_rate": (rates[:stiff], (stiff,)),
        "balance_rate": (rates[stiff:], (len(BALANCES),)),
    }
    return sizes, [*numbers, ("signals",), ("q", "v_a", "circuit")], outputs
