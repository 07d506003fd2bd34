"""Which part of a joint's range and of its own stroke a cylinder can be used over."""

import warnings
from collections.abc import Sequence

import numpy as np

from crane.common.errors import CraneWarning, InputError
from crane.common.magnitudes import LONGEST
from crane.formats.adding.eyes import Eye
from crane.formats.adding.span import Span, last_posture
from crane.formats.adding.steel import SteelCylinder
from crane.machine import Machine

_STILL = 1e-9  # rate against the joint's, below which something does not move
_RESOLVED = 1e-6  # of the stroke, to which its reachable part is told


def fitted(
    span: Span, steel: SteelCylinder, eyes: Sequence[Eye], machine: Machine
) -> tuple[int, Span]:
    """Index of the home posture and the part that is reached, told where that is not all.

    Raises:
        InputError: There is none, or the machine is not in metres.
    """
    ends = steel.retracted, steel.retracted + steel.stroke
    if span.length.min() > LONGEST:
        raise InputError(
            f"'{eyes[0]}' and '{eyes[1]}' are {span.length.min():.4g} m apart and more, farther "
            f"than a machine is large: look at its units with crane check, lengths are metres"
        )
    lengths = f"{span.length.min():.4g} to {span.length.max():.4g} m"
    unit = machine.unit(span.joint)
    values = f"{span.values[0]:.4g} to {span.values[-1]:.4g} {unit}"
    found = span.driven(*ends)
    if found is None:
        fits = (span.length >= ends[0]) & (span.length <= ends[1])
        idle = "with a lever arm " if fits.any() else ""
        raise InputError(
            f"a cylinder of {ends[0]:.4g} to {ends[1]:.4g} m does not fit {idle}between "
            f"'{eyes[0]}' and '{eyes[1]}', {lengths} apart with {span.joint} at {values}: choose "
            "another stroke, dead length or eyes"
        )
    start, reached = found
    if any(reached.values[k] != span.values[k] for k in (0, -1)):
        index = machine.active.index(span.joint)
        endless = bool(np.isinf([machine.lower[index], machine.upper[index]]).all())
        a, b = reached.values[[0, -1]]
        dead = [
            f"{reached.values[k]:.4g}"
            for k in (0, -1)
            if reached.values[k] != span.values[k]
            and np.abs(reached.length[k] - ends).min() > _RESOLVED * steel.stroke
        ]
        what = f", with a dead centre at {' and '.join(dead)}" if dead else ""
        if dead or not endless:  # else its range is what the stroke makes of it
            warnings.warn(
                f"'{span.joint}' moves from {values}, and a cylinder of {ends[0]:.4g} to "
                f"{ends[1]:.4g} m drives it from {a:.4g} to {b:.4g}{what}: its eyes are {lengths} "
                "apart over all of it, choose stroke, dead length or eyes by that",
                CraneWarning,
                stacklevel=4,
            )
    return start, reached


def warn_of_masses(machine: Machine, steel: SteelCylinder, joint: str) -> None:
    """Warn where all that a joint moves is lighter than its cylinder, as placeholders are."""
    model, own = machine.model, steel.barrel.mass + steel.piston_rod.mass
    rates = machine.closure.gamma(machine.home)[:, machine.active.index(joint)]
    moving = [
        i for i, x in enumerate(model.joints)
        if (np.abs(rates[x.idx_v : x.idx_v + x.nv]) > _STILL).any() and i
    ]  # fmt: skip
    bodies = {body for i in moving for body in model.subtrees[i]}
    mass = sum(model.inertias[body].mass for body in bodies)
    if mass < own:
        warnings.warn(
            f"the cylinder weighs {own:.4g} kg, and all that '{joint}' moves {mass:.3g} kg: "
            "forces are little more than its own weight, give the bodies the masses of the real "
            "machine",
            CraneWarning,
            stacklevel=4,
        )


def warn_of_strokes(machine: Machine, name: str) -> None:
    """Warn of strokes that the linkage does not let the cylinder have."""
    if name not in machine.active:  # it shares the load: others say how far they go
        return
    index, home = machine.active.index(name), machine.home
    within, lost = _RESOLVED * machine.upper[index], []
    for end in (float(machine.lower[index]), float(machine.upper[index])):
        start = float(home[machine.column(name)]), home
        last, _ = last_posture(machine, name, start, end, within)
        if abs(end - last) > within:
            lost.append(f"{min(last, end):.4g} to {max(last, end):.4g} m")
    if lost:
        warnings.warn(
            f"the linkage does not close at {' and '.join(lost)} of the stroke of '{name}', "
            "beyond its dead centre: choose another stroke, dead length or eyes",
            CraneWarning,
            stacklevel=4,
        )
