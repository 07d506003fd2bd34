"""Formulas of a machine as CasADi functions, for optimal control and estimation."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from crane.closure.kinematics_formulas import FormulaConstants, PositionKinematics
from crane.closure.loop_formulas import LoopFormulas
from crane.codegen.casadi_expressions import casadi_expressions
from crane.codegen.symbolic import (
    Scalar,
    Tape,
    add_vectors,
    matvec,
    subtract_vectors,
    transpose,
)
from crane.common.errors import InputError, MechanismError, suggest_names
from crane.common.optional_libraries import import_optional_library
from crane.control.valve_commands import ValveSignals
from crane.control.valve_drive import ValveDrive
from crane.dynamics.compiled_dynamics import QUANTITIES, WITH_FRICTION
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.dynamics_formulas import DynamicsFormulas
from crane.dynamics.joint_forces import find_stick_slip_columns
from crane.dynamics.quantity_evaluator import QUANTITY_ARGUMENTS
from crane.formats.machine_loading import load
from crane.hydraulics.circuit_states import BALANCE_UNITS
from crane.machine.machine import Machine
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.machine_formulas import controller_settings, trace_machine

_KINEMATIC_QUANTITIES = ("loops", "gamma", "tip")  # what depends on q alone
_SIMULATION_QUANTITY = "simulation"

FormulaOutputs = dict[str, tuple[Sequence[Scalar], tuple[int, ...]]]  # formulas and their shapes


def casadi_function(
    machine: Machine | str | Path, quantity: str, *, friction: bool = False
) -> Any:
    """A quantity of a machine as a `casadi.Function`, generated from the formulas of its programs.

    The argument q has all coordinates of the spanning tree, in the order of `machine.joints`. The
    loops are not solved within the function; they are the equations `loops`, phi(q) = 0, which are
    constraints of the optimisation. Its variables then stay on their branch, whereas an inner
    iteration could leave it; and a function is one expression, of which CasADi generates exact
    sparse derivatives of any order, and code. Along the closed machine

        d f / d q_A = (df/dq) gamma,    q' = gamma v_A,

    except for a floating base, whose q has a rotation vector. `casadi.rootfinder` computes q_P
    from q_A by `loops`.

    | quantity | arguments | result |
    |---|---|---|
    | "loops" | q | phi (r,) of the independent equations |
    | "gamma" | q | dq/dq_A (nq, n) |
    | "tip" | q | position of the tip (3,) [m] |
    | "inverse", "regressor" | q, v_a, a_a | as `Dynamics` |
    | "forward" | q, v_a, tau_a | as `Dynamics` |
    | "mass_matrix", "gravity" | q | as `Dynamics` |
    | "bias", "friction", "passive" | q, v_a | as `Dynamics` |
    | "energy" | q, v_a | kinetic, potential (2,) [J] |
    | "simulation" | q, v_a, circuit, signals | rates of a machine with valves |

    "simulation" gives the rates q_rate (nq,), a_a (n,), circuit_rate of the states of
    `crane.hydraulics.circuit_equations.CircuitEquations` (`state_units` of
    `ValveDrive(machine, command).circuit` names them, `start` of the drive returns those at rest)
    and balance_rate (6,) of the integrals
    `crane.hydraulics.circuit_states.BALANCE_UNITS`. `signals` are those of the valves [V].

    Args:
        machine: The machine, or what `crane.load` takes.
        quantity: See above.
        friction: Whether inverse or forward dynamics have friction.

    Raises:
        InputError: Unknown quantity, no CasADi, no tip, no valves, or friction that sticks, whose
            accelerations jump, in "simulation".
        MechanismError: Its formulas are too long.
    """
    ca = import_optional_library("casadi", "a symbolic function")
    if not isinstance(machine, Machine):
        machine = load(machine)
    names = [*_KINEMATIC_QUANTITIES, *QUANTITY_ARGUMENTS, _SIMULATION_QUANTITY]
    if quantity not in names:
        raise InputError(f"quantity '{quantity}' is unknown, {suggest_names(names, quantity)}")
    if friction and quantity not in ("inverse", "forward"):
        raise InputError(f"'{quantity}' is without friction or with its own, leave friction out")
    if not machine.closure.is_compiled:
        raise MechanismError(f"'{machine.name}' is too large to have formulas: lock joints")
    if quantity == _SIMULATION_QUANTITY:
        sizes, arguments, outputs = _simulation_quantity(machine)
    else:
        sizes, arguments, outputs = _dynamics_quantity(machine, quantity, friction)
    symbols = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    flat = [x for formulas, _ in outputs.values() for x in formulas]
    # arguments of the tape: numbers, or the symbols named in a tuple
    inputs = [
        [x for name in one for x in ca.vertsplit(symbols[name])] if isinstance(one, tuple) else one
        for one in arguments
    ]
    values, results = casadi_expressions(flat, inputs), []
    for formulas, shape in outputs.values():
        part = ca.vertcat(*values[: len(formulas)]) if formulas else ca.SX(0, 1)
        values = values[len(formulas) :]
        results.append(ca.reshape(part, shape[1], shape[0]).T if len(shape) == 2 else part)
    return ca.Function(quantity, list(symbols.values()), results, list(sizes), list(outputs))


def _dynamics_quantity(
    machine: Machine, quantity: str, friction: bool
) -> tuple[dict[str, int], list[Any], FormulaOutputs]:
    """Sizes of the arguments, arguments of the tape, and formulas."""
    fast, tape, n = machine.closure.compiled_closure, Tape(), len(machine.active)
    q, kinematics, loops = fast.trace_kinematics(tape, 0, 1)
    geometry = fast.geometry.constants
    if quantity in _KINEMATIC_QUANTITIES:
        formulas, shape = _kinematic_quantity(machine, quantity, kinematics, loops)
        return {"q": len(q)}, [geometry, ("q",)], {quantity: (formulas, shape)}
    dynamics = Dynamics(machine)
    constants = FormulaConstants(tape, 2, dynamics.constant_pattern)
    names = QUANTITY_ARGUMENTS[quantity][1:]
    v_a, x = tape.load_vector(3, 0, n), tape.load_vector(4, 0, n)
    dynamics_formulas = DynamicsFormulas(
        kinematics, loops, constants, q, v_a, dynamics.formula_structure
    )
    formulas = QUANTITIES[quantity.replace("_", " ") + WITH_FRICTION * friction](
        dynamics_formulas, x
    )
    arguments = [geometry, ("q",), dynamics.formula_constants, *((name,) for name in names)]
    arguments += [[0.0] * n] * (2 - len(names))
    return (
        {"q": len(q)} | dict.fromkeys(names, n),
        arguments,
        {quantity: (formulas, dynamics.result_shape(quantity))},
    )


def _kinematic_quantity(
    machine: Machine, quantity: str, kinematics: PositionKinematics, loops: LoopFormulas
) -> tuple[list[Scalar], tuple[int, ...]]:
    if quantity == "loops":
        return [row.phi for row in loops.rows], (len(loops.rows),)
    if quantity == "gamma":
        rows = [loops.gamma[i] for i in range(1, machine.model.nv + 1)]
        return [x for row in rows for x in row], (machine.model.nv, len(machine.active))
    if machine.tip is None:
        raise InputError(f"'{machine.name}' has no tip, name a link as its tip")
    frame = machine.model.frames[machine.frame(machine.tip)]
    body = machine.coordinates.body_of_joint[frame.parentJoint]
    rotation = machine.closure.compiled_closure.geometry.body_rotations[body]
    offset = (rotation.T @ frame.placement.translation).tolist()
    place = add_vectors(kinematics.origin[body], matvec(kinematics.rotation[body], offset))
    # positions are relative to the reference body, which may not be the world
    return matvec(
        transpose(kinematics.rotation[0]), subtract_vectors(place, kinematics.origin[0])
    ), (3,)


def _simulation_quantity(machine: Machine) -> tuple[dict[str, int], list[Any], FormulaOutputs]:
    for column in find_stick_slip_columns(machine):
        joint = machine.joints[column]
        raise InputError(
            f"friction of '{joint}' sticks, so that accelerations jump: say over which "
            f"velocity it turns, as friction.{joint}.smoothing=2e-3"
        )
    # the signals are a command's references
    drive = ValveDrive(machine, ValveSignals(machine, [0.0], {}))
    chart = Chart.from_dynamics(Dynamics(machine), drive, drive.circuit.state_count)
    tape, m = Tape(), len(drive.circuit.spools)
    # zeros among the settings are features that the circuit does not have
    settings = controller_settings(drive, tape, 2, True)
    formulas = trace_machine(chart, tape, 4, tape.load_vector(3, 0, m), settings)
    rates, stiff_state_count = formulas.controller_rate, drive.circuit.stiff_state_count
    accelerations = formulas.accelerations(with_joints_at_rest=False)
    numbers = (
        machine.closure.compiled_closure.geometry.constants,
        chart.dynamics.formula_constants,
        drive.settings,
    )
    sizes = {
        "q": machine.model.nv,
        "v_a": len(machine.active),
        "circuit": stiff_state_count,
        "signals": m,
    }
    outputs: FormulaOutputs = {
        "q_rate": (formulas.dynamics_formulas.coordinate_derivatives, (machine.model.nv,)),
        "a_a": (accelerations.a_a, (len(machine.active),)),
        "circuit_rate": (rates[:stiff_state_count], (stiff_state_count,)),
        "balance_rate": (rates[stiff_state_count:], (len(BALANCE_UNITS),)),
    }
    return sizes, [*numbers, ("signals",), ("q", "v_a", "circuit")], outputs
