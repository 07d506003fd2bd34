"""Plausible ranges of the parameters of a hydraulic circuit, and suggestions of units.

The ranges cover machines from a syringe's piston to a ship's crane. A value outside is converted
from the units of data sheets; units that make it plausible are suggested.
"""

import math
from typing import NamedTuple

LONGEST = 50.0  # [m], longer than any part of a machine

UnitSizes = tuple[tuple[str, float], ...]


class PlausibleRange(NamedTuple):
    """Plausible range of a quantity.

    Attributes:
        unit: Its SI unit.
        lower: Least plausible value; zero is not checked where the description allows it.
        upper: Largest plausible value.
        typical: Among several units the one that comes nearest to this value is suggested.
        other_units: Other units with their size in the SI unit, in the order in which they are
            tried.
    """

    unit: str
    lower: float
    upper: float
    typical: float
    other_units: tuple[UnitSizes, ...] = ()


_LITRE_PER_MINUTE = 1e-3 / 60
_PRESSURE_UNITS: tuple[UnitSizes, ...] = (
    (("bar", 1e5), ("MPa", 1e6)),
    (("psi", 6894.757), ("kPa", 1e3)),
)
_MODULUS_UNITS: tuple[UnitSizes, ...] = ((("GPa", 1e9), ("MPa", 1e6), ("bar", 1e5)),)
_FLOW_UNITS: tuple[UnitSizes, ...] = (
    (("l/min", _LITRE_PER_MINUTE), ("l/s", 1e-3)),
    (("cm3/s", 1e-6), ("ml/min", 1e-3 * _LITRE_PER_MINUTE)),
)
_VOLUME_UNITS: tuple[UnitSizes, ...] = ((("l", 1e-3), ("cm3", 1e-6)), (("mm3", 1e-9),))
_LEAKAGE_UNITS: tuple[UnitSizes, ...] = (
    (("l/min per bar", 1e-5 * _LITRE_PER_MINUTE), ("ml/min per bar", 1e-8 * _LITRE_PER_MINUTE)),
)
_FLOW_COEFFICIENT_UNITS: tuple[UnitSizes, ...] = (
    (("l/min per root of bar", _LITRE_PER_MINUTE / math.sqrt(1e5)),),
    (("l/min per root of MPa", 1e-3 * _LITRE_PER_MINUTE), ("m3/s per root of bar", 10**-2.5)),
)
_FORCE_PER_PRESSURE_UNITS: tuple[UnitSizes, ...] = ((("N per bar", 1e-5), ("N per MPa", 1e-6)),)
_PERCENT_UNITS: tuple[UnitSizes, ...] = ((("percent", 0.01),),)

_PORT_PRESSURE = PlausibleRange("Pa", 1e5, 7e7, 2e7, _PRESSURE_UNITS)
_AREA = PlausibleRange("m2", 1e-6, 0.2, 3e-3, ((("cm2", 1e-4), ("mm2", 1e-6)),))
_HOSE_VOLUME = PlausibleRange("m3", 1e-10, 0.05, 3e-4, _VOLUME_UNITS)
_LEAKAGE_COEFFICIENT = PlausibleRange("m3/(s Pa)", 0.0, 1e-9, 1e-12, _LEAKAGE_UNITS)
_FLOW_COEFFICIENT = PlausibleRange("m3/(s Pa^0.5)", 1e-12, 1e-4, 5e-7, _FLOW_COEFFICIENT_UNITS)

PLAUSIBLE_RANGES = {
    "pressure": _PORT_PRESSURE,
    "relief": _PORT_PRESSURE,
    "tank": PlausibleRange("Pa", 5e4, 5e6, 2e5, _PRESSURE_UNITS),
    "droop": PlausibleRange("Pa", 1e3, 2e7, 5e5, _PRESSURE_UNITS),
    "margin": PlausibleRange("Pa", 1e4, 1e7, 1e6, _PRESSURE_UNITS),
    "range": PlausibleRange("Pa", 1e4, 7e7, 2e6, _PRESSURE_UNITS),
    "vapour_pressure": PlausibleRange("Pa", 0.0, 9e4, 1e3, _PRESSURE_UNITS),
    "bulk_modulus": PlausibleRange("Pa", 1e8, 5e9, 1.5e9, _MODULUS_UNITS),
    "hose_modulus": PlausibleRange("Pa", 1e7, 1e13, 1e9, _MODULUS_UNITS),
    "steel_modulus": PlausibleRange("Pa", 1e9, 1e13, 2e11, _MODULUS_UNITS),
    "gas_exponent": PlausibleRange("", 1.0, 1.7, 1.4),
    "flow": PlausibleRange("m3/s", 1e-8, 0.05, 1e-3, _FLOW_UNITS),
    "volume": PlausibleRange("m3", 1e-8, 1.0, 2e-3, _VOLUME_UNITS),
    "area_a": _AREA,
    "area_b": _AREA,
    "hose_a": _HOSE_VOLUME,
    "hose_b": _HOSE_VOLUME,
    "gas_a": PlausibleRange("m3", 0.0, 0.05, 1e-5, _VOLUME_UNITS),
    "gas_b": PlausibleRange("m3", 0.0, 0.05, 1e-5, _VOLUME_UNITS),
    "leakage": _LEAKAGE_COEFFICIENT,
    "leakage_a": _LEAKAGE_COEFFICIENT,
    "leakage_b": _LEAKAGE_COEFFICIENT,
    "relief_gain": PlausibleRange("m3/(s Pa)", 1e-13, 1e-6, 2e-9, _LEAKAGE_UNITS),
    "cushion": PlausibleRange("m", 0.0, 1.0, 0.03, ((("mm", 1e-3),),)),
    "stiffness": PlausibleRange("N/m", 1e2, 1e12, 1e8, ((("N/mm", 1e3), ("kN/mm", 1e6)),)),
    "seal_friction": PlausibleRange("N/Pa", 1e-8, 5e-3, 2e-4, _FORCE_PER_PRESSURE_UNITS),
    "brake_release": PlausibleRange("", 1e-3, 1.0, 0.05, ((("percent", 1e-2),),)),
    "pilot_ratio": PlausibleRange("", 0.1, 100.0, 4.0),
    "bandwidth": PlausibleRange("rad/s", 0.5, 1e4, 50.0),
    "rate": PlausibleRange("1/s", 0.05, 1e3, 10.0),
    "bore": PlausibleRange("m", 2e-3, 0.6, 0.1, ((("mm", 1e-3), ("cm", 1e-2)),)),
    "rod": PlausibleRange("m", 1e-3, 0.5, 0.06, ((("mm", 1e-3), ("cm", 1e-2)),)),
    "stroke": PlausibleRange("m", 5e-3, 20.0, 0.8, ((("mm", 1e-3), ("cm", 1e-2)),)),
    "tube": PlausibleRange("m", 2e-3, 0.8, 0.12, ((("mm", 1e-3), ("cm", 1e-2)),)),
    "standby": PlausibleRange("Pa", 1e5, 2e7, 2e6, _PRESSURE_UNITS),
    "signal": PlausibleRange("Pa", 1e4, 1e7, 2e6, _PRESSURE_UNITS),
    "precharge": PlausibleRange("Pa", 1e5, 5e7, 1e7, _PRESSURE_UNITS),
    "cross_relief": _PORT_PRESSURE,
    "power": PlausibleRange("W", 1e3, 2e6, 8e4, ((("kW", 1e3), ("hp", 745.7)),)),
    "drag": PlausibleRange("W", 20.0, 1e5, 2e3, ((("kW", 1e3),),)),
    "response": PlausibleRange("s", 1e-3, 5.0, 0.1, ((("ms", 1e-3),),)),
    "sensing": PlausibleRange("", 0.0, 20.0, 0.3),
    "delay": PlausibleRange("s", 1e-4, 1.0, 0.02, ((("ms", 1e-3),),)),
    "slip": _LEAKAGE_COEFFICIENT,
    "air": PlausibleRange("", 0.0, 0.2, 0.01, ((("percent", 0.01),),)),
    "speed": PlausibleRange("rad/s", 5.0, 420.0, 190.0, ((("rpm", math.pi / 30),),)),
    "speed_droop": PlausibleRange("rad/s", 0.01, 60.0, 8.0, ((("rpm", math.pi / 30),),)),
    "torque": PlausibleRange("N m", 0.1, 5e4, 500.0, ((("kN m", 1e3),),)),
    "inertia": PlausibleRange("kg m2", 1e-5, 1e3, 2.0),
    "fuel": PlausibleRange("kg/J", 3e-8, 2e-7, 6e-8, ((("g/kWh", 1e-3 / 3.6e6),),)),
    "idle": PlausibleRange("kg/s", 1e-6, 1e-2, 3e-4, ((("kg/h", 1 / 3600), ("g/s", 1e-3)),)),
    "time_constant": PlausibleRange("s", 0.1, 1e4, 30.0),
    "rupture_a": PlausibleRange("m3/s", 1e-8, 0.05, 1e-3, _FLOW_UNITS),
    "rupture_b": PlausibleRange("m3/s", 1e-8, 0.05, 1e-3, _FLOW_UNITS),
    "displacement": PlausibleRange(
        "m3/rad", 1e-9, 1e-2, 1e-5, ((("cm3/rad", 1e-6), ("cm3 per turn", 1e-6 / (2 * math.pi))),)
    ),
    "friction": PlausibleRange("", 0.0, 0.5, 0.05, _PERCENT_UNITS),
    "least": PlausibleRange("", 0.0, 0.9, 0.05, _PERCENT_UNITS),
    "demand": PlausibleRange("", 0.01, 2.0, 1.0, _PERCENT_UNITS),
    "gear": PlausibleRange("", 0.02, 1e4, 20.0),
    **dict.fromkeys(
        (
            "c1",
            "c2",
            "c3",
            "c4",
            "refill",
            "coefficient",
            "cushion_coefficient",
            "meter_out",
            "centre",
            "throttle",
            "regeneration",
            "float_coefficient",
        ),
        _FLOW_COEFFICIENT,
    ),
}
_ROTARY_DISPLACEMENT = PlausibleRange(
    "m3/rad", 1e-9, 0.1, 1e-3, ((("cm3/rad", 1e-6), ("l/rad", 1e-3)),)
)
ROTARY_RANGES = {  # ranges for revolute joints
    "area_a": _ROTARY_DISPLACEMENT,
    "area_b": _ROTARY_DISPLACEMENT,
    "cushion": PlausibleRange("rad", 0.0, 3.2, 0.2, ((("degrees", math.pi / 180),),)),
    "stiffness": PlausibleRange("N m/rad", 1e0, 1e12, 1e7),
    "seal_friction": PlausibleRange(
        "N m/Pa", 1e-9, 1e-2, 5e-5, ((("N m per bar", 1e-5), ("N m per MPa", 1e-6)),)
    ),
}
_VESSEL_VOLUME = PlausibleRange(
    "m3", 1e-8, 0.3, 2e-3, _VOLUME_UNITS
)  # half a litre is a usual one, half a m3 not
RANGES_BY_COMPONENT = {  # ranges for certain components
    ("element", "gain"): PlausibleRange("m3/(s Pa)", 0.0, 1e-6, 2e-9, _LEAKAGE_UNITS),
    ("element", "pressure"): PlausibleRange("Pa", 1e3, 7e7, 1e6, _PRESSURE_UNITS),
    ("accumulator", "line"): _HOSE_VOLUME,
    ("accumulator", "volume"): _VESSEL_VOLUME,
    ("line", "volume"): _VESSEL_VOLUME,
    ("motor", "volume"): _HOSE_VOLUME,
}
# how much farther from the typical value a second unit may bring it to be named
_SECOND_UNIT_RATIO = 20.0


def plausible_range(
    name: str, is_rotary: bool = False, component: str = ""
) -> PlausibleRange | None:
    """The plausible range of a parameter, None if it has none; see `implausible_value_text`."""
    own = RANGES_BY_COMPONENT.get((component, name)) or (
        ROTARY_RANGES.get(name) if is_rotary else None
    )
    return own or PLAUSIBLE_RANGES.get(name)


def implausible_value_text(
    name: str, value: float, is_rotary: bool = False, component: str = ""
) -> str:
    """Text about a value that is probably not in its SI unit, empty if it is plausible.

    Args:
        name: Name of the parameter in a machine file.
        value: The value, which is valid; zero is never reported.
        is_rotary: Whether it belongs to a revolute joint.
        component: Kind of its component: "engine", "element", "accumulator" ...
    """
    plausible = plausible_range(name, is_rotary, component)
    if plausible is None or value == 0 or plausible.lower <= value <= plausible.upper:
        return ""
    unit = f" {plausible.unit}" if plausible.unit else ""
    return (
        f"is {value:g}{unit}, usual are {plausible.lower:g} to {plausible.upper:g}"
        f"{_suggestion_text(value, plausible) or ', look at its unit'}"
    )


def suggested_units_text(name: str, value: float) -> str:
    """Suggested unit of an invalid value, to append to an error; may be empty."""
    return _suggestion_text(value, PLAUSIBLE_RANGES[name])


def _suggestion_text(value: float, plausible: PlausibleRange) -> str:
    """Text about at most two units in which a value is plausible; empty if there is none."""
    for units in plausible.other_units:
        distances = {
            (unit, size): abs(math.log(abs(value) * size / plausible.typical))
            for unit, size in units
            if plausible.lower <= abs(value) * size <= plausible.upper
        }
        if distances:
            farthest = min(distances.values()) + math.log(_SECOND_UNIT_RATIO)
            able = [x for x in distances if distances[x] <= farthest]
            able.sort(key=lambda x: distances[x])
            texts = [f"{unit}, write {_format_in_si(value, size)}" for unit, size in able[:2]]
            return f": looks like {' or '.join(texts)}"
    return ""


def _format_in_si(value: float, size: float) -> str:
    power = math.log10(size)
    shown = f"{value:g}"
    if abs(power - round(power)) < 1e-9 and "e" not in shown and float(shown) == value:
        return f"{shown}e{round(power)}"
    return f"{value * size:.4g}"
