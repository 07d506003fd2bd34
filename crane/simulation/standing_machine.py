"""The static equilibrium in which a machine stands: pose, contacts, pressures, drive forces."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.control.control_law import FunctionController
from crane.control.valve_drive import ValveDrive
from crane.description.ground_contact import Contact
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.external_forces import static_active_forces
from crane.machine.machine import Machine
from crane.recordings.recording import FORCE_UNITS, Recording
from crane.simulation.simulation_run import simulate
from crane.simulation.simulation_setup import resolve_controller
from crane.simulation.static_equilibrium import rest_state

_STEP = 1e-3  # [s]


@dataclass(eq=False, repr=False)
class StandingMachine(OneLineRepr):
    """A machine at rest under its loads.

    Attributes:
        machine: The machine, whose home is what it settled from.
        q: (nq,) configuration at rest [m], [rad].
        run: A step of a run from there; its first sample has forces, pressures and contacts.
        undetermined: What statics does not determine, and what was taken.
    """

    machine: Machine
    q: Array
    run: Recording
    undetermined: list[str]

    def to_markdown(self) -> str:
        """Tables of the pose, the contacts, the drives and the pressures."""
        machine, run, lines = self.machine, self.run, [f"# {self.machine.name} at rest", ""]
        lines += _table(
            ("free joint", "home", "at rest"),
            [(f"{x} [{machine.unit(x)}]", *(f"{q[machine.column(x)].round(12) + 0.0:.9g}"
             for q in (machine.home, self.q))) for x in machine.free],
        )  # fmt: skip
        rows = []
        for contact in (x for x in machine.external_forces if isinstance(x, Contact)):
            normal = run[f"support_{contact.name}"][0]
            size = np.linalg.norm([run[f"load_{contact.name}_force_{x}"][0] for x in "xyz"])
            along, depth = np.sqrt(max(size**2 - normal**2, 0.0)), normal / contact.stiffness
            rows.append(
                (contact.name, f"{normal:.1f} N", f"{1e3 * depth:.3f} mm", f"{along:.1f} N")
            )
        lines += _table(("contact", "normal force", "deflection", "along the ground"), rows)
        lines += _table(
            ("drive", "holds"),
            [(x, f"{run.tau[0, machine.active.index(x)].round(1) + 0.0:.1f} "
              f"{FORCE_UNITS[machine.unit(x)]}")
             for x in machine.driven_joints],
        )  # fmt: skip
        pressures = [name for name in run.channels if name.startswith("pressure_")]
        lines += _table(
            ("pressure", "at rest", "rate"),
            [(name.removeprefix("pressure_"), f"{run[name][0] / 1e5:.3f} bar",
              f"{np.diff(run[name])[0] / _STEP / 1e5 + 0.0:.3g} bar/s") for name in pressures],
        )  # fmt: skip
        lines += [f"- not determined: {text}" for text in self.undetermined]
        accelerations = np.abs(run.v[1]) / _STEP
        joint = machine.active[int(accelerations.argmax())]
        peak = f"{accelerations.max():.2g} {machine.unit(joint)}/s2"
        return "\n".join([*lines, f"- largest acceleration: {peak} of {joint}", ""])


def settle(machine: Machine, q_a: ArrayLike | None = None) -> StandingMachine:
    """Let a machine come to rest on its contacts, tyres, springs and oil.

    The driven joints keep their coordinates. All free joints move to their static equilibrium, and
    the pressures are those that carry the loads, with the valves at their neutral signals; see
    `crane.simulation.static_equilibrium` and `crane.control.oil_equilibrium`. Runs with
    `start: equilibrium` start there.

    Args:
        machine: The machine.
        q_a: (n,) active coordinates near the equilibrium [m], [rad]; home if not given.

    Raises:
        SimulationError: There is no equilibrium near q_a.
    """
    if q_a is not None:
        q = machine.closure.solve(machine.check_limits(q_a, "q_a"))
        machine = machine.with_home_configuration(q, machine.active)
    machine = replace(machine, start="equilibrium")
    dynamics, control = Dynamics(machine), resolve_controller(None, machine)
    rest = rest_state(dynamics, machine.home[machine.closure.active])
    q, still = machine.closure.solve(rest.q_a, initial_guess=machine.home), np.zeros(len(rest.q_a))
    if not isinstance(control, ValveDrive):
        force = dynamics.inverse(rest.q_a, still, still) + dynamics.friction(rest.q_a, still)
        force -= static_active_forces(machine, q, rest.contact_states)
        control = FunctionController(lambda *_: machine.is_driven * force, machine)
    run = simulate(machine, control, duration=_STEP, step=_STEP)
    directions = rest.equilibrium.undetermined_directions() if rest.equilibrium else []
    undetermined = list(_undetermined(machine, directions))
    if isinstance(control, ValveDrive):
        oil = control.oil_equilibrium(q, control.start(run.q[0]))
        oil.find((*control.circuit.hydraulics.lines, *control.circuit.hydraulics.accumulators))
        undetermined += [
            f"pressures {'; '.join(oil.undetermined)}: closed valves hold others, too; nearest to "
            "those of the tank and of the file"
        ] * bool(oil.undetermined)
    return StandingMachine(machine, q, run, undetermined)


def _undetermined(machine: Machine, directions: Sequence[str]) -> Iterator[str]:
    """What statics of the free joints leaves open."""
    if directions:
        yield f"{'; '.join(directions)}: no force holds a place; nearest to home"
    tyres = [x.name for x in machine.external_forces if isinstance(x, Contact) and x.state_count]
    if tyres:
        yield (
            f"deflections along the ground of {', '.join(tyres)}: friction holds others, too; as "
            "lowered from home without sliding"
        )
    for joint, law in machine.friction.items():
        if joint in machine.free and law.has_stick_slip:
            yield (
                f"{joint}: friction at rest holds it up to {law.breakaway_force:.4g} "
                f"{FORCE_UNITS[machine.unit(joint)]} beside this place; that without friction"
            )


def _table(heading: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Lines of a table in Markdown and an empty one; none without rows."""
    rule = ("---", *["---:"] * (len(heading) - 1))
    return [*(f"| {' | '.join(row)} |" for row in (heading, rule, *rows)), ""] if rows else []
