"""Nodes beside chambers, and elements between nodes, as formulas."""

from collections.abc import Iterable, Mapping, Sequence

from crane.codegen import Expression, Number, maximum
from crane.codegen.scalar import apply
from crane.hydraulics.elements import Element
from crane.hydraulics.flow import Flow, clipped, root

GAS_PRESSURE = 1.0e5  # at which volumes of entrapped gas are given [Pa]
PER_SENSED = 100.0  # one over the opening at which all of a load is reported
_SEAT = 1.0e-3  # of an accumulator's precharge or volume, within which it runs empty
_FULL = 0.02  # of an accumulator's gas, the least that is left


def softness_of(
    common: Mapping[str, Number], volume: Number, hose: Number, gas: Number, p: Number
) -> Number:
    """Volume per pressure, V / K = V / B_oil + (V - V_h) / B_steel + V_h / B_hose + gas's.

    The gas is what is entrapped, and the oil's free air.
    """
    soft = volume * common["oil"] + hose * common["hose"]
    if _is(common["steel"]):
        soft = soft + common["steel"] * maximum(volume - hose, 0.0)
    if _is(common["air"]):
        gas = gas + common["air"] * volume
    return soft + bubbles(common, gas, p) if _is(gas) else soft


def bubbles(common: Mapping[str, Number], gas: Number, p: Number) -> Number:
    """Volume per pressure of gas in the oil.

    V = gas (p0 / p)^(1/n), -dV/dp = gas / (n p0) (p0 / p)^(1 + 1/n).
    """
    power = common["gas_power"]
    thin = apply("log", maximum(p, 1.0) * (1.0 / GAS_PRESSURE))
    return gas * (power - 1.0) * (1.0 / GAS_PRESSURE) * apply("exp", -power * thin)


def _is(number: Number) -> bool:
    """Whether it is there."""
    return isinstance(number, Expression) or number != 0.0


def gas_of(
    gas: Mapping[str, Number], p: Number, inflow: Number, oil: Number | None
) -> tuple[list[Number], Number]:
    """Rates of an accumulator's states, and the heat that leaves its gas [W].

    See `Accumulator`. Below the precharge the gas keeps its volume, and the port's oil alone gives
    way; which of them does passes from one to the other within `_SEAT` below it, or above the
    last oil. With w the share of the gas that moves, Q = line p' + w Q_g.

    Args:
        gas: Its numbers.
        p: Its pressure [Pa].
        inflow: [m3/s].
        oil: In it, a state where heat leaves the gas [m3].
    """
    line, volume, precharge, n = (gas[x] for x in ("line", "volume", "precharge", "exponent"))
    lifted = 1.0 + (p / precharge - 1.0) * (1.0 / _SEAT)
    if oil is None:
        # V_g = volume (p0 / p)^(1/n), -dV/dp = V_g / (n p)
        above = maximum(p, precharge)
        thin = apply("log", precharge / above)
        soft = volume * apply("exp", thin / n) / (n * above)
        return [inflow / (line + clipped(lifted, 0.0, 1.0) * soft)], 0.0
    left = clipped(volume - oil, _FULL * volume, volume)
    isothermal = precharge * volume / left
    cooling = (p - isothermal) * gas["per_time"]
    moves = clipped(maximum(lifted, oil / (_SEAT * volume)), 0.0, 1.0)
    slope = (n * p * inflow / left - moves * cooling) / (moves + line * n * p / left)
    return [slope, inflow - line * slope], moves * left * cooling / (n - 1.0)


def flow_of(
    name: str,
    element: Element,
    numbers: Mapping[str, Number],
    pressures: Mapping[str, Number],
    opened: Mapping[str, Sequence[Number]],
) -> Flow:
    """What flows through an element, see `Element`.

    Args:
        name: Its name.
        element: What it is.
        numbers: Its numbers.
        pressures: Of all nodes [Pa].
        opened: Openings y of valves on both sides, by joint.
    """
    drop = pressures[element.source] - pressures[element.target]
    if element.kind in ("check", "relief"):
        drop = maximum(drop - numbers["pressure"], 0.0)
    if element.kind in ("orifice", "check"):
        rate = numbers["coefficient"] * root(drop)
    else:
        rate = numbers["gain"] * drop
    rate = opening_of(element, opened) * rate
    return Flow(element.source, element.target, rate, name)


def opening_of(element: Element, opened: Mapping[str, Sequence[Number]]) -> Number:
    """How far valves open an element, 0 to 1; see `flow_of`."""
    if not element.joints:
        return 1.0
    sides = {"both": (0, 1), "out": (0,), "back": (1,)}[element.side]
    return highest([opened[joint][side] for joint in element.joints for side in sides])


def highest(values: Sequence[Number]) -> Number:
    """The largest of some."""
    out = values[0]
    for value in values[1:]:
        out = maximum(out, value)
    return out


def joined(
    elements: Iterable[Element],
    loads: Mapping[str, Number],
    tank: Number,
    opened: Mapping[str, Sequence[Number]],
) -> dict[str, Number]:
    """Highest loads by pump, where orifices between pumps join what they know of them [Pa].

    Args:
        elements: All of the circuit.
        loads: Of each pump's own valves.
        tank: Pressure [Pa].
        opened: See `flow_of`.
    """
    out = dict(loads)
    for element in elements:
        pair = element.source, element.target
        if element.kind == "orifice" and {*pair} <= loads.keys():
            share = clipped(opening_of(element, opened) * PER_SENSED, 0.0, 1.0)
            for one, other in (pair, pair[::-1]):
                out[one] = maximum(out[one], tank + share * (loads[other] - tank))
    return out
