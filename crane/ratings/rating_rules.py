"""Rules by which loads and forces are rated, and the unit actions that are rated."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from crane.common.errors import InputError, check_name
from crane.common.samples import Array, as_number
from crane.dynamics.statics import StaticQuantities
from crane.machine.machine import Machine
from crane.motion.workspaces.workspace_section import WorkspaceSection

MAX_GROUND_SLOPE = np.deg2rad(45.0)


@dataclass(frozen=True)
class Rule:
    """A rating rule: the shares of each limit that count as rated load.

    Attributes:
        name: Name of the rule.
        description: Description for reports.
        hydraulic: Share of the load that the drives lift and hold.
        tipping: Share of the load that tips the machine.
        structural: Share of the load that the pins bear.
        only_raising_drive: Whether only the drive that raises the load works, at the pressure of
            its pump. All other drives then hold behind closed valves, at the pressure of their
            port relief valves.
        min_ground_slope: Smallest slope of the ground that is assumed [rad].
    """

    name: str
    description: str
    hydraulic: float = 1.0
    tipping: float = 1.0
    structural: float = 1.0
    only_raising_drive: bool = False
    min_ground_slope: float = 0.0

    def __post_init__(self) -> None:
        for name in ("hydraulic", "tipping", "structural"):
            as_number(getattr(self, name), f"the {name} share of rule '{self.name}'", "",
                      greater_than=0.0, max_magnitude=1.0)  # fmt: skip
        as_number(self.min_ground_slope, f"the slope of rule '{self.name}'", "rad",
                  max_magnitude=MAX_GROUND_SLOPE)  # fmt: skip


RULES = {
    rule.name: rule
    for rule in (
        Rule("none", "what is possible, without a reserve"),
        Rule(
            "iso10567",
            "ISO 10567 (excavators), as makers' manuals give it: the less of 87 % of what the "
            "boom's cylinders raise at the working pressure, while all others hold at that of "
            "their relief valves, and 75 % of the load that tips the machine, on firm level "
            "ground",
            hydraulic=0.87,
            tipping=0.75,
            only_raising_drive=True,
        ),
        *(
            Rule(
                f"iso14397{name}",
                f"in the manner of ISO 14397-1 (loaders): the less of {100 * share:g} % of the "
                f"tipping load, {text}, and what the lift cylinders raise at the working "
                "pressure; the percentages as makers' handbooks give them, not read in the "
                "standard",
                tipping=share,
                only_raising_drive=True,
            )
            for name, share, text in (
                ("", 0.5, "of wheel loaders with buckets, at full turn"),
                ("-crawler", 0.35, "of crawler loaders with buckets"),
                ("-forks", 0.8, "with forks on firm level ground"),
                ("-rough", 0.6, "with forks on rough ground"),
            )
        ),
        Rule(
            "en12999",
            "in the manner of EN 12999 (loader cranes): what is lifted at the working pressure, "
            "and 1/1.25 of the load that tips, so that a test with 1.25 times the load stands; "
            "this share is assumed here, not read in the standard",
            tipping=0.8,
        ),
        Rule(
            "sfs4677",
            "SFS 4677 (tractor cranes for timber, as the Farmi 4670's manual gives it): 10 % more "
            "than the load does not tip the machine on ground that slopes by 5 degrees",
            tipping=1 / 1.1,
            min_ground_slope=np.deg2rad(5.0),
        ),
    )
}  # fmt: skip


def find_rule(name: str | Rule) -> Rule:
    """Return the rule with a name; a `Rule` is returned as it is.

    Raises:
        InputError: The name is unknown.
    """
    if isinstance(name, Rule):
        return name
    check_name(str(name), RULES, f"rule '{name}' is unknown")
    return RULES[name]


@dataclass(frozen=True)
class FixedUnitAction:
    """A constant vector e per unit of load or force, which turns with the slewing joint.

    Attributes:
        direction: (3,) e in the world with the slewing joint at home: unit vector [1] for a
            force [N]; gravity [m/s2] for a load [kg].
        up: (3,) slewing axis.
        is_weight: Whether e is gravity, whose direction changes with the slope of the ground.
    """

    direction: Array
    up: Array
    is_weight: bool = False

    def unit_vectors(self, statics: StaticQuantities, angles: Array) -> Array:
        """Return e (N, 3) with the machine slewed by angles (N,) from home [rad]."""
        return rotate_about_axis(
            np.broadcast_to(self.direction, statics.tip_positions.shape), self.up, angles
        )

    def unit_derivatives(
        self, statics: StaticQuantities, derivatives: StaticQuantities, angles: Array
    ) -> Array:
        """Return the derivative (N, 3) of e by the parameter of `derivatives`: zero."""
        return np.zeros_like(statics.tip_positions)


@dataclass(frozen=True)
class PathUnitAction:
    """The unit vector along, or across, the path of the frame when one stroke alone moves.

        e = sign u / |u|,   u = dp/dq_i;   across: e = sign n x u / |u|,

    with the normal n of the section. If the stroke turns the frame about a pin, u is the tangent
    of the circle about that pin.

    Attributes:
        stroke: Index i among the active joints.
        sign: 1 or -1.
        up: (3,) slewing axis.
        section_normal: (3,) n with the slewing joint at home; None for e along the path.
    """

    stroke: int
    sign: float
    up: Array
    section_normal: Array | None = None
    is_weight = False

    def unit_vectors(self, statics: StaticQuantities, angles: Array) -> Array:
        """Return e (N, 3), see `FixedUnitAction`; NaN where the frame does not move."""
        tangent = statics.tip_jacobian[:, :, self.stroke]
        with np.errstate(invalid="ignore", divide="ignore"):
            return self._signed_direction(
                tangent / np.linalg.norm(tangent, axis=1, keepdims=True), angles
            )

    def unit_derivatives(
        self, statics: StaticQuantities, derivatives: StaticQuantities, angles: Array
    ) -> Array:
        """Return the derivative (N, 3) of e by the parameter of `derivatives`."""
        tangent = statics.tip_jacobian[:, :, self.stroke]
        derivative = derivatives.tip_jacobian[:, :, self.stroke]
        length = np.linalg.norm(tangent, axis=1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            tangent = tangent / length
            across = derivative - (tangent * derivative).sum(1, keepdims=True) * tangent
            return self._signed_direction(across / length, angles)

    def _signed_direction(self, direction: Array, angles: Array) -> Array:
        if self.section_normal is not None:
            normal = rotate_about_axis(
                np.broadcast_to(self.section_normal, direction.shape), self.up, angles
            )
            direction = np.cross(normal, direction)
        return self.sign * direction


UnitAction = FixedUnitAction | PathUnitAction


def gravity_action(machine: Machine) -> FixedUnitAction:
    """Return the unit action of a load: gravity per kilogram.

    Raises:
        InputError: The machine has no gravity.
    """
    gravity = np.array(machine.gravity)
    if not gravity.any():
        raise InputError(f"'{machine.name}' has no gravity, a load has no weight there")
    return FixedUnitAction(gravity, machine.up_direction, is_weight=True)


def rotate_about_axis(vectors: Array, axis: Array, angles: Array) -> Array:
    """Rotate vectors (N, 3) by angles (N,) [rad] about a unit vector (3,)."""
    return np.asarray(Rotation.from_rotvec(angles[:, None] * axis).apply(np.array(vectors)))


def slew_angles(machine: Machine, section: WorkspaceSection, slew_coordinates: Array) -> Array:
    """Return rotations (N,) about the vertical from home [rad]; 0 without a slewing joint.

    Args:
        machine: The machine.
        section: Section of a frame that the slewing joint carries.
        slew_coordinates: (N,) coordinates of the slewing joint [rad].
    """
    if section.slewing_joint is None:
        return np.zeros(len(slew_coordinates))
    home = machine.home[machine.closure.active[section.slewing_joint]]
    return section.slewing_sign * (slew_coordinates - home)
