"""Nodes beside chambers, and elements between nodes, as formulas."""

from collections.abc import Iterable, Mapping, Sequence

from crane.codegen import Scalar, SymbolicExpression, maximum
from crane.codegen.symbolic import apply_function
from crane.hydraulics.circuit_elements import CircuitElement
from crane.hydraulics.orifice_flow import Flow, clip, signed_square_root

GAS_PRESSURE = 1.0e5  # at which volumes of entrapped gas are given [Pa]
SENSING_OPENING_GAIN = 100.0  # one over the opening at which all of a load is reported
_EMPTY_SHARE = 1.0e-3  # of an accumulator's precharge or volume, within which it runs empty
_MIN_GAS_SHARE = 0.02  # of an accumulator's gas, the least that is left


def volume_compliance(
    oil_constants: Mapping[str, Scalar], volume: Scalar, hose: Scalar, gas: Scalar, p: Scalar
) -> Scalar:
    """Volume per pressure, V / K = V / B_oil + (V - V_h) / B_steel + V_h / B_hose + gas's.

    The gas is what is entrapped, and the oil's free air.
    """
    compliance = volume * oil_constants["oil"] + hose * oil_constants["hose"]
    if _is_present(oil_constants["steel"]):
        compliance = compliance + oil_constants["steel"] * maximum(volume - hose, 0.0)
    if _is_present(oil_constants["air"]):
        gas = gas + oil_constants["air"] * volume
    return compliance + gas_compliance(oil_constants, gas, p) if _is_present(gas) else compliance


def gas_compliance(oil_constants: Mapping[str, Scalar], gas: Scalar, p: Scalar) -> Scalar:
    """Volume per pressure of gas in the oil.

    V = gas (p0 / p)^(1/n), -dV/dp = gas / (n p0) (p0 / p)^(1 + 1/n).
    """
    power = oil_constants["gas_power"]
    log_pressure_ratio = apply_function("log", maximum(p, 1.0) * (1.0 / GAS_PRESSURE))
    return (
        gas
        * (power - 1.0)
        * (1.0 / GAS_PRESSURE)
        * apply_function("exp", -power * log_pressure_ratio)
    )


def _is_present(constant: Scalar) -> bool:
    """Whether it is there."""
    return isinstance(constant, SymbolicExpression) or constant != 0.0


def accumulator_equations(
    constants: Mapping[str, Scalar], p: Scalar, inflow: Scalar, oil: Scalar | None
) -> tuple[list[Scalar], Scalar]:
    """Rates of an accumulator's states, and the heat that leaves its gas [W].

    See `Accumulator`. Below the precharge the gas keeps its volume, and the port's oil alone gives
    way; which of them does passes from one to the other within `_EMPTY_SHARE` below it, or above
    the last oil. With w the share of the gas that moves, Q = line p' + w Q_g.

    Args:
        constants: Its numbers.
        p: Its pressure [Pa].
        inflow: [m3/s].
        oil: In it, a state where heat leaves the gas [m3].
    """
    line, volume, precharge, n = (
        constants[x] for x in ("line", "volume", "precharge", "exponent")
    )
    opening_share = 1.0 + (p / precharge - 1.0) * (1.0 / _EMPTY_SHARE)
    if oil is None:
        # V_g = volume (p0 / p)^(1/n), -dV/dp = V_g / (n p)
        gas_pressure = maximum(p, precharge)
        log_volume_ratio = apply_function("log", precharge / gas_pressure)
        gas_compliance_value = (
            volume * apply_function("exp", log_volume_ratio / n) / (n * gas_pressure)
        )
        return [inflow / (line + clip(opening_share, 0.0, 1.0) * gas_compliance_value)], 0.0
    gas_volume = clip(volume - oil, _MIN_GAS_SHARE * volume, volume)
    isothermal = precharge * volume / gas_volume
    cooling = (p - isothermal) * constants["per_time"]
    moving_share = clip(maximum(opening_share, oil / (_EMPTY_SHARE * volume)), 0.0, 1.0)
    pressure_rate = (n * p * inflow / gas_volume - moving_share * cooling) / (
        moving_share + line * n * p / gas_volume
    )
    return [pressure_rate, inflow - line * pressure_rate], moving_share * gas_volume * cooling / (
        n - 1.0
    )


def element_flow(
    name: str,
    element: CircuitElement,
    constants: Mapping[str, Scalar],
    pressures: Mapping[str, Scalar],
    openings: Mapping[str, Sequence[Scalar]],
) -> Flow:
    """What flows through an element, see `Element`.

    Args:
        name: Its name.
        element: What it is.
        constants: Its numbers.
        pressures: Of all nodes [Pa].
        openings: Openings y of valves on both sides, by joint.
    """
    drop = pressures[element.source] - pressures[element.target]
    if element.kind in ("check", "relief"):
        drop = maximum(drop - constants["pressure"], 0.0)
    if element.kind in ("orifice", "check"):
        rate = constants["coefficient"] * signed_square_root(drop)
    else:
        rate = constants["gain"] * drop
    rate = element_opening(element, openings) * rate
    return Flow(element.source, element.target, rate, name)


def element_opening(element: CircuitElement, openings: Mapping[str, Sequence[Scalar]]) -> Scalar:
    """How far valves open an element, 0 to 1; see `element_flow`."""
    if not element.joints:
        return 1.0
    sides = {"both": (0, 1), "out": (0,), "back": (1,)}[element.side]
    return largest_of([openings[joint][side] for joint in element.joints for side in sides])


def largest_of(values: Sequence[Scalar]) -> Scalar:
    """The largest of some."""
    out = values[0]
    for value in values[1:]:
        out = maximum(out, value)
    return out


def merged_load_pressures(
    elements: Iterable[CircuitElement],
    loads: Mapping[str, Scalar],
    tank: Scalar,
    openings: Mapping[str, Sequence[Scalar]],
) -> dict[str, Scalar]:
    """Highest loads by pump, where orifices between pumps join what they know of them [Pa].

    Args:
        elements: All of the circuit.
        loads: Of each pump's own valves.
        tank: Pressure [Pa].
        openings: See `element_flow`.
    """
    out = dict(loads)
    for element in elements:
        pair = element.source, element.target
        if element.kind == "orifice" and {*pair} <= loads.keys():
            share = clip(element_opening(element, openings) * SENSING_OPENING_GAIN, 0.0, 1.0)
            for one, other in (pair, pair[::-1]):
                out[one] = maximum(out[one], tank + share * (loads[other] - tank))
    return out
