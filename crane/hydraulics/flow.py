"""Flow through orifices, from floats or traced numbers."""

from typing import NamedTuple

from crane.codegen.scalar import Number, apply, maximum, minimum, where_positive, with_sign_of

LAMINAR = 1.0e4  # pressure drop below which an orifice's flow is smooth [Pa]


class Flow(NamedTuple):
    """What flows from one node to another.

    Attributes:
        source: Where it comes from.
        target: Where it goes.
        rate: [m3/s].
        through: What it flows through: "inlet", "outlet", "leak", "relief", "refill", "bypass",
            "regeneration", "piston", "cross" (relief), "pump", "slip", or an element's
            name.
        drop: Of pressure at the edge that meters it, the rest is its compensator's [Pa]; None
            where there is none.
    """

    source: str
    target: str
    rate: Number
    through: str
    drop: Number | None = None


def root(drop: Number) -> Number:
    """Signed square root of a pressure drop, with a finite slope at zero.

    sign(d) sqrt(|d|) beyond `LAMINAR`; within, the odd cubic that meets it with equal slope,
    d / sqrt(L) (5 - (d / L)^2) / 4, as flow turns laminar there.
    """
    inner = clipped(drop, -LAMINAR, LAMINAR)
    share = inner * (1.0 / LAMINAR)
    cubic = LAMINAR**0.5 * share * (1.25 - 0.25 * share * share)
    beyond = apply("sqrt", maximum(apply("abs", drop), LAMINAR)) - LAMINAR**0.5
    return cubic + with_sign_of(beyond, drop)


def clipped(x: Number, lower: Number, upper: Number) -> Number:
    """A number held within bounds."""
    return maximum(minimum(x, upper), lower)


def in_series(orifice: Number, holding: Number | None, cushion: Number) -> Number:
    """Coefficient of an orifice, a load-holding valve and a throttle one after the other.

    Pressure drops add up, (Q / c)^2 each: 1 / c^2 = 1 / orifice^2 + 1 / holding^2 + cushion.

    Args:
        orifice: Coefficient of the valve's edge [m3/(s Pa^0.5)].
        holding: Of the load-holding valve, None where there is none.
        cushion: 1 / c^2 of the throttle, 0 where there is none.
    """
    square = orifice * orifice
    if holding is None:
        return orifice / apply("sqrt", 1.0 + cushion * square)
    held = holding * holding
    return orifice * holding / apply("sqrt", square + held + cushion * square * held + 1e-40)


def through(drop: Number, inward: Number, outward: Number) -> Number:
    """Flow into a chamber, the coefficient depending on its direction."""
    return where_positive(drop, inward, outward) * root(drop)
