"""Flow through orifices, from floats or traced numbers."""

from typing import NamedTuple

from crane.codegen.symbolic import (
    Scalar,
    apply_function,
    copysign,
    maximum,
    minimum,
    where_positive,
)

LAMINAR_PRESSURE_DROP = 1.0e4  # pressure drop below which an orifice's flow is smooth [Pa]


class Flow(NamedTuple):
    """What flows from one node to another.

    Attributes:
        source: Where it comes from.
        target: Where it goes.
        rate: [m3/s].
        path: What it flows through: "inlet", "outlet", "leak", "relief", "refill", "bypass",
            "regeneration", "piston", "cross" (relief), "pump", "slip", or an element's
            name.
        metering_drop: Of pressure at the edge that meters it, the rest is its compensator's [Pa];
            None where there is none.
    """

    source: str
    target: str
    rate: Scalar
    path: str
    metering_drop: Scalar | None = None


def signed_square_root(drop: Scalar) -> Scalar:
    """Signed square root of a pressure drop, with a finite slope at zero.

    sign(d) sqrt(|d|) beyond `LAMINAR_PRESSURE_DROP`; within, the odd cubic that meets it with
    equal slope, d / sqrt(L) (5 - (d / L)^2) / 4, as flow turns laminar there.
    """
    laminar_drop = clip(drop, -LAMINAR_PRESSURE_DROP, LAMINAR_PRESSURE_DROP)
    share = laminar_drop * (1.0 / LAMINAR_PRESSURE_DROP)
    cubic = LAMINAR_PRESSURE_DROP**0.5 * share * (1.25 - 0.25 * share * share)
    turbulent = (
        apply_function("sqrt", maximum(apply_function("abs", drop), LAMINAR_PRESSURE_DROP))
        - LAMINAR_PRESSURE_DROP**0.5
    )
    return cubic + copysign(turbulent, drop)


def clip(x: Scalar, lower: Scalar, upper: Scalar) -> Scalar:
    """A number held within bounds."""
    return maximum(minimum(x, upper), lower)


def series_coefficient(orifice: Scalar, holding: Scalar | None, cushion: Scalar) -> Scalar:
    """Coefficient of an orifice, a load-holding valve and a throttle one after the other.

    Pressure drops add up, (Q / c)^2 each: 1 / c^2 = 1 / orifice^2 + 1 / holding^2 + cushion.

    Args:
        orifice: Coefficient of the valve's edge [m3/(s Pa^0.5)].
        holding: Of the load-holding valve, None where there is none.
        cushion: 1 / c^2 of the throttle, 0 where there is none.
    """
    square = orifice * orifice
    if holding is None:
        return orifice / apply_function("sqrt", 1.0 + cushion * square)
    holding_square = holding * holding
    return (
        orifice
        * holding
        / apply_function(
            "sqrt", square + holding_square + cushion * square * holding_square + 1e-40
        )
    )


def directional_flow(
    drop: Scalar, inflow_coefficient: Scalar, outflow_coefficient: Scalar
) -> Scalar:
    """Flow into a chamber, the coefficient depending on its direction."""
    return where_positive(drop, inflow_coefficient, outflow_coefficient) * signed_square_root(drop)
