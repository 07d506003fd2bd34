"""What stands between the nodes of a circuit beside valves and cylinders, and further nodes."""

from dataclasses import dataclass

from crane.common.errors import suggest_names
from crane.hydraulics.parameter_checks import (
    ComponentParameterError,
    check_parameters,
    positive_field,
    positive_field_with_default,
)

ELEMENT_KINDS = ("orifice", "check", "relief", "leak")
OPENING_SIDES = ("both", "out", "back")


@dataclass(frozen=True)
class CircuitLine:
    """A node with a volume of oil: a hose, a block, a pipe.

    Attributes:
        volume: [m3].
        pressure: That it starts from [Pa]; the tank's if 0.
    """

    volume: float = positive_field()
    pressure: float = 0.0

    def __post_init__(self) -> None:
        check_parameters(self, "the line")


@dataclass(frozen=True)
class Accumulator:
    """A node with gas behind a diaphragm or piston.

    Above its precharge p_0 the gas has the volume V_g = volume - oil. With a time constant T its
    heat goes into the wall,

        p' = exponent p Q / V_g - (p - p_0 volume / V_g) / T,

    which is adiabatic when fast and isothermal when slow; without one p V_g^exponent stays.

    Attributes:
        volume: Of the gas at the precharge [m3].
        precharge: p_0, from a vacuum [Pa].
        exponent: Of the gas; 1.4 adiabatic, 1 isothermal.
        time_constant: T [s]; 0 for none.
        line: Volume of oil at its port [m3].
        pressure: That it starts from [Pa]; the precharge if 0.
    """

    volume: float = positive_field()
    precharge: float = positive_field()
    exponent: float = positive_field_with_default(1.4)
    time_constant: float = 0.0
    line: float = positive_field_with_default(1.0e-4)
    pressure: float = 0.0

    def __post_init__(self) -> None:
        check_parameters(self, "the accumulator")
        if not 1.0 <= self.exponent < 2.0 or (self.time_constant and self.exponent <= 1.0):
            raise ComponentParameterError(
                "exponent",
                f"exponent of the accumulator is {self.exponent:g}, give 1 to 1.7, above 1 with a "
                "time constant",
            )


@dataclass(frozen=True)
class CircuitElement:
    """A flow Q from one node to another.

        orifice: c w root(p_1 - p_2)             either way
        check:   c w root(p_1 - p_2 - pressure)  forwards only
        relief:  gain w (p_1 - p_2 - pressure)   forwards only
        leak:    gain w (p_1 - p_2)              either way

    w is 1, or the largest opening of the valves of `joints`, on both sides or when they move their
    joint `out` or `back`. An orifice that joins two pumps so joins what they know of loads, too,
    as a merge and divide valve does.

    Attributes:
        kind: One of `ELEMENT_KINDS`.
        source: Node 1.
        target: Node 2.
        coefficient: c [m3/(s Pa^0.5)].
        gain: [m3/(s Pa)].
        pressure: That holds it closed [Pa].
        joints: Whose valves open it; always open if empty.
        side: One of `OPENING_SIDES`.
    """

    kind: str
    source: str
    target: str
    coefficient: float = 0.0
    gain: float = 0.0
    pressure: float = 0.0
    joints: tuple[str, ...] = ()
    side: str = "both"

    def __post_init__(self) -> None:
        check_parameters(self, "the element")
        if self.kind not in ELEMENT_KINDS:
            raise ComponentParameterError(
                "type",
                f"element '{self.kind}' is unknown, {suggest_names(ELEMENT_KINDS, self.kind)}",
            )
        if self.side not in OPENING_SIDES:
            raise ComponentParameterError(
                "side", f"side '{self.side}' is unknown, {suggest_names(OPENING_SIDES, self.side)}"
            )
        if self.side != "both" and not self.joints:
            raise ComponentParameterError(
                "side", f"side '{self.side}' is that of valves, give their 'joints'"
            )
        key = "coefficient" if self.kind in ("orifice", "check") else "gain"
        if not getattr(self, key):
            raise ComponentParameterError(key, f"a {self.kind} has no '{key}', give it")
        if self.pressure and self.kind in ("orifice", "leak"):
            raise ComponentParameterError(
                "pressure", f"nothing holds a {self.kind} closed, leave 'pressure' out"
            )
        if self.source == self.target:
            raise ComponentParameterError(
                "to", f"it leads from '{self.source}' to itself, give two nodes"
            )
