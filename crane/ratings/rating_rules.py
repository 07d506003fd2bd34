"""Rules by which lifting capacities are rated."""

from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.samples import as_number

_MAX_GROUND_SLOPE = np.deg2rad(45.0)  # of the ground


@dataclass(frozen=True)
class Rule:
    """What share of a load a rule lets count.

    Attributes:
        name: Of the rule.
        description: In words.
        hydraulic: Share of what the drives lift and hold.
        tipping: Share of what tips the machine.
        structural: Share of what pins bear.
        only_raising_drive: Whether only the drive that raises the load works, at the pressure of
            its pump, and all others hold behind closed valves, at that of their port relief
            valves.
        min_ground_slope: Of the ground, at least [rad].
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
        as_number(
            self.min_ground_slope,
            f"the slope of rule '{self.name}'",
            "rad",
            max_magnitude=_MAX_GROUND_SLOPE,
        )


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
            "than the load does not tip the machine on ground that leans by 5 degrees",
            tipping=1 / 1.1,
            min_ground_slope=np.deg2rad(5.0),
        ),
    )
}  # fmt: skip


def find_rule(name: str | Rule) -> Rule:
    """A rule by its name, or as it is.

    Raises:
        InputError: There is none.
    """
    if isinstance(name, Rule):
        return name
    if not isinstance(name, str) or name not in RULES:
        raise InputError(f"rule '{name}' is unknown, {suggest_names(RULES, str(name))}")
    return RULES[name]
