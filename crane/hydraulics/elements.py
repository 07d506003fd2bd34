"""What stands between the nodes of a circuit beside valves and cylinders, and further nodes."""

from dataclasses import dataclass

from crane.common.errors import known
from crane.hydraulics.numbers import PartError, above, check_numbers, positive

KINDS = ("orifice", "check", "relief", "leak")
SIDES = ("both", "out", "back")


@dataclass(frozen=True)
class Line:
    """A node with a volume of oil: a hose, a block, a pipe.

    Attributes:
        volume: [m3].
        pressure: That it starts from [Pa]; the tank's if 0.
    """

    volume: float = positive()
    pressure: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(self, "the line")


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

    volume: float = positive()
    precharge: float = positive()
    exponent: float = above(1.4)
    time_constant: float = 0.0
    line: float = above(1.0e-4)
    pressure: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(self, "the accumulator")
        if not 1.0 <= self.exponent < 2.0 or (self.time_constant and self.exponent <= 1.0):
            raise PartError(
                "exponent",
                f"exponent of the accumulator is {self.exponent:g}, give 1 to 1.7, above 1 with a "
                "time constant",
            )


@dataclass(frozen=True)
class Element:
    """A flow Q from one node to another.

        orifice: c w root(p_1 - p_2)             either way
        check:   c w root(p_1 - p_2 - pressure)  forwards only
        relief:  gain w (p_1 - p_2 - pressure)   forwards only
        leak:    gain w (p_1 - p_2)              either way

    w is 1, or the largest opening of the valves of `joints`, on both sides or when they move their
    joint `out` or `back`. An orifice that joins two pumps so joins what they know of loads, too,
    as a merge and divide valve does.

    Attributes:
        kind: One of `KINDS`.
        source: Node 1.
        target: Node 2.
        coefficient: c [m3/(s Pa^0.5)].
        gain: [m3/(s Pa)].
        pressure: That holds it closed [Pa].
        joints: Whose valves open it; always open if empty.
        side: One of `SIDES`.
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
        check_numbers(self, "the element")
        if self.kind not in KINDS:
            raise PartError("type", f"element '{self.kind}' is unknown, {known(KINDS, self.kind)}")
        if self.side not in SIDES:
            raise PartError("side", f"side '{self.side}' is unknown, {known(SIDES, self.side)}")
        if self.side != "both" and not self.joints:
            raise PartError("side", f"side '{self.side}' is that of valves, give their 'joints'")
        by = "coefficient" if self.kind in ("orifice", "check") else "gain"
        if not getattr(self, by):
            raise PartError(by, f"a {self.kind} has no '{by}', give it")
        if self.pressure and self.kind in ("orifice", "leak"):
            raise PartError(
                "pressure", f"nothing holds a {self.kind} closed, leave 'pressure' out"
            )
        if self.source == self.target:
            raise PartError("to", f"it leads from '{self.source}' to itself, give two nodes")
