"""How large the numbers of a hydraulic circuit are, and the unit that was meant where one is not.

The table holds what machines have from a syringe's piston to a ship's crane. A number outside is
tried in the units that data sheets use; what is then usual is proposed.
"""

import math
from typing import NamedTuple

LONGEST = 50.0  # [m], a length that no part of a machine has

Units = tuple[tuple[str, float], ...]


class Magnitude(NamedTuple):
    """What is usual of a quantity.

    Attributes:
        unit: Its SI unit.
        least: Least usual value; what is zero by the description's leave is not looked at.
        most: Largest one.
        typical: Of several units, that counts which comes nearest to this.
        units: Other units and their size in the SI unit, those tried first, then rarer ones.
    """

    unit: str
    least: float
    most: float
    typical: float
    units: tuple[Units, ...] = ()


_LITRE_PER_MINUTE = 1e-3 / 60
_PRESSURE: tuple[Units, ...] = ((("bar", 1e5), ("MPa", 1e6)), (("psi", 6894.757), ("kPa", 1e3)))
_MODULUS: tuple[Units, ...] = ((("GPa", 1e9), ("MPa", 1e6), ("bar", 1e5)),)
_FLOW: tuple[Units, ...] = (
    (("l/min", _LITRE_PER_MINUTE), ("l/s", 1e-3)),
    (("cm3/s", 1e-6), ("ml/min", 1e-3 * _LITRE_PER_MINUTE)),
)
_VOLUME: tuple[Units, ...] = ((("l", 1e-3), ("cm3", 1e-6)), (("mm3", 1e-9),))
_LEAKAGE: tuple[Units, ...] = (
    (("l/min per bar", 1e-5 * _LITRE_PER_MINUTE), ("ml/min per bar", 1e-8 * _LITRE_PER_MINUTE)),
)
_ORIFICE: tuple[Units, ...] = (
    (("l/min per root of bar", _LITRE_PER_MINUTE / math.sqrt(1e5)),),
    (("l/min per root of MPa", 1e-3 * _LITRE_PER_MINUTE), ("m3/s per root of bar", 10**-2.5)),
)
_PRESSING: tuple[Units, ...] = ((("N per bar", 1e-5), ("N per MPa", 1e-6)),)

_PORT = Magnitude("Pa", 1e5, 7e7, 2e7, _PRESSURE)
_AREA = Magnitude("m2", 1e-6, 0.2, 3e-3, ((("cm2", 1e-4), ("mm2", 1e-6)),))
_HOSE = Magnitude("m3", 1e-10, 0.05, 3e-4, _VOLUME)
_LEAK = Magnitude("m3/(s Pa)", 0.0, 1e-9, 1e-12, _LEAKAGE)
_COEFFICIENT = Magnitude("m3/(s Pa^0.5)", 1e-12, 1e-4, 5e-7, _ORIFICE)

USUAL = {
    "pressure": _PORT,
    "relief": _PORT,
    "tank": Magnitude("Pa", 5e4, 5e6, 2e5, _PRESSURE),
    "droop": Magnitude("Pa", 1e3, 2e7, 5e5, _PRESSURE),
    "margin": Magnitude("Pa", 1e4, 1e7, 1e6, _PRESSURE),
    "range": Magnitude("Pa", 1e4, 7e7, 2e6, _PRESSURE),
    "vapour_pressure": Magnitude("Pa", 0.0, 9e4, 1e3, _PRESSURE),
    "bulk_modulus": Magnitude("Pa", 1e8, 5e9, 1.5e9, _MODULUS),
    "hose_modulus": Magnitude("Pa", 1e7, 1e13, 1e9, _MODULUS),
    "steel_modulus": Magnitude("Pa", 1e9, 1e13, 2e11, _MODULUS),
    "gas_exponent": Magnitude("", 1.0, 1.7, 1.4),
    "flow": Magnitude("m3/s", 1e-8, 0.05, 1e-3, _FLOW),
    "volume": Magnitude("m3", 1e-8, 1.0, 2e-3, _VOLUME),
    "area_a": _AREA,
    "area_b": _AREA,
    "hose_a": _HOSE,
    "hose_b": _HOSE,
    "gas_a": Magnitude("m3", 0.0, 0.05, 1e-5, _VOLUME),
    "gas_b": Magnitude("m3", 0.0, 0.05, 1e-5, _VOLUME),
    "leakage": _LEAK,
    "leakage_a": _LEAK,
    "leakage_b": _LEAK,
    "relief_gain": Magnitude("m3/(s Pa)", 1e-13, 1e-6, 2e-9, _LEAKAGE),
    "cushion": Magnitude("m", 0.0, 1.0, 0.03, ((("mm", 1e-3),),)),
    "stiffness": Magnitude("N/m", 1e2, 1e12, 1e8, ((("N/mm", 1e3), ("kN/mm", 1e6)),)),
    "seal_friction": Magnitude("N/Pa", 1e-8, 5e-3, 2e-4, _PRESSING),
    "brake_release": Magnitude("", 1e-3, 1.0, 0.05, ((("percent", 1e-2),),)),
    "pilot_ratio": Magnitude("", 0.1, 100.0, 4.0),
    "bandwidth": Magnitude("rad/s", 0.5, 1e4, 50.0),
    "rate": Magnitude("1/s", 0.05, 1e3, 10.0),
    "bore": Magnitude("m", 2e-3, 0.6, 0.1, ((("mm", 1e-3), ("cm", 1e-2)),)),
    "rod": Magnitude("m", 1e-3, 0.5, 0.06, ((("mm", 1e-3), ("cm", 1e-2)),)),
    "stroke": Magnitude("m", 5e-3, 20.0, 0.8, ((("mm", 1e-3), ("cm", 1e-2)),)),
    "tube": Magnitude("m", 2e-3, 0.8, 0.12, ((("mm", 1e-3), ("cm", 1e-2)),)),
    "standby": Magnitude("Pa", 1e5, 2e7, 2e6, _PRESSURE),
    "signal": Magnitude("Pa", 1e4, 1e7, 2e6, _PRESSURE),
    "precharge": Magnitude("Pa", 1e5, 5e7, 1e7, _PRESSURE),
    "cross_relief": _PORT,
    "power": Magnitude("W", 1e3, 2e6, 8e4, ((("kW", 1e3), ("hp", 745.7)),)),
    "drag": Magnitude("W", 20.0, 1e5, 2e3, ((("kW", 1e3),),)),
    "response": Magnitude("s", 1e-3, 5.0, 0.1, ((("ms", 1e-3),),)),
    "sensing": Magnitude("", 0.0, 20.0, 0.3),
    "delay": Magnitude("s", 1e-4, 1.0, 0.02, ((("ms", 1e-3),),)),
    "slip": _LEAK,
    "air": Magnitude("", 0.0, 0.2, 0.01, ((("percent", 0.01),),)),
    "speed": Magnitude("rad/s", 5.0, 420.0, 190.0, ((("rpm", math.pi / 30),),)),
    "speed_droop": Magnitude("rad/s", 0.01, 60.0, 8.0, ((("rpm", math.pi / 30),),)),
    "torque": Magnitude("N m", 0.1, 5e4, 500.0, ((("kN m", 1e3),),)),
    "inertia": Magnitude("kg m2", 1e-5, 1e3, 2.0),
    "fuel": Magnitude("kg/J", 3e-8, 2e-7, 6e-8, ((("g/kWh", 1e-3 / 3.6e6),),)),
    "idle": Magnitude("kg/s", 1e-6, 1e-2, 3e-4, ((("kg/h", 1 / 3600), ("g/s", 1e-3)),)),
    "time_constant": Magnitude("s", 0.1, 1e4, 30.0),
    "rupture_a": Magnitude("m3/s", 1e-8, 0.05, 1e-3, _FLOW),
    "rupture_b": Magnitude("m3/s", 1e-8, 0.05, 1e-3, _FLOW),
    "displacement": Magnitude(
        "m3/rad", 1e-9, 1e-2, 1e-5, ((("cm3/rad", 1e-6), ("cm3 per turn", 1e-6 / (2 * math.pi))),)
    ),
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
        _COEFFICIENT,
    ),
}
_SHARE = (("percent", 0.01),)
USUAL |= {
    "friction": Magnitude("", 0.0, 0.5, 0.05, (_SHARE,)),
    "least": Magnitude("", 0.0, 0.9, 0.05, (_SHARE,)),
    "demand": Magnitude("", 0.01, 2.0, 1.0, (_SHARE,)),
    "gear": Magnitude("", 0.02, 1e4, 20.0),
}
_TURN = Magnitude("m3/rad", 1e-9, 0.1, 1e-3, ((("cm3/rad", 1e-6), ("l/rad", 1e-3)),))
TURNING = {  # what differs where the joint turns
    "area_a": _TURN,
    "area_b": _TURN,
    "cushion": Magnitude("rad", 0.0, 3.2, 0.2, ((("degrees", math.pi / 180),),)),
    "stiffness": Magnitude("N m/rad", 1e0, 1e12, 1e7),
    "seal_friction": Magnitude(
        "N m/Pa", 1e-9, 1e-2, 5e-5, ((("N m per bar", 1e-5), ("N m per MPa", 1e-6)),)
    ),
}
_VESSEL = Magnitude("m3", 1e-8, 0.3, 2e-3, _VOLUME)  # half a litre is a usual one, half a m3 not
OWN = {  # what differs for a kind of part
    ("element", "gain"): Magnitude("m3/(s Pa)", 0.0, 1e-6, 2e-9, _LEAKAGE),
    ("element", "pressure"): Magnitude("Pa", 1e3, 7e7, 1e6, _PRESSURE),
    ("accumulator", "line"): _HOSE,
    ("accumulator", "volume"): _VESSEL,
    ("line", "volume"): _VESSEL,
    ("motor", "volume"): _HOSE,
}
_BOTH = 20.0  # how much farther from the typical value a second unit may bring it to be named


def usual_of(name: str, turning: bool = False, kind: str = "") -> Magnitude | None:
    """What is usual of a number, None of one that may be anything; see `doubt`."""
    own = OWN.get((kind, name)) or (TURNING.get(name) if turning else None)
    return own or USUAL.get(name)


def doubt(name: str, value: float, turning: bool = False, kind: str = "") -> str:
    """What to say of a number that hardly is in its SI unit, else nothing.

    Args:
        name: Of the number in a machine file.
        value: The number, which may be; zero is never doubted.
        turning: Whether it belongs to a joint that turns.
        kind: Of the part that has it: "engine", "element", "accumulator" ...
    """
    usual = usual_of(name, turning, kind)
    if usual is None or value == 0 or usual.least <= value <= usual.most:
        return ""
    unit = f" {usual.unit}" if usual.unit else ""
    text = f"is {value:g}{unit}, usual are {usual.least:g} to {usual.most:g}"
    meant = [f"{name}, write {_written(value, size)}" for name, size in _meant(value, usual)]
    return f"{text}: looks like {' or '.join(meant)}" if meant else f"{text}, look at its unit"


def meant(name: str, value: float) -> str:
    """What a number that cannot be looks like, to be put behind an error; perhaps nothing."""
    found = [f"{unit}, write {_written(value, size)}" for unit, size in _meant(value, USUAL[name])]
    return f": looks like {' or '.join(found)}" if found else ""


def _meant(value: float, usual: Magnitude) -> list[tuple[str, float]]:
    """Units in which a number is usual, and their size; at most two."""
    for units in usual.units:
        able = [(x, size) for x, size in units if usual.least <= abs(value) * size <= usual.most]
        if able:
            away = {size: abs(math.log(abs(value) * size / usual.typical)) for _, size in able}
            nearest = min(away.values())
            able = [item for item in able if away[item[1]] <= nearest + math.log(_BOTH)]
            return sorted(able, key=lambda item: away[item[1]])[:2]
    return []


def _written(value: float, size: float) -> str:
    """A number in another unit, as it is written in the SI unit."""
    power = math.log10(size)
    shown = f"{value:g}"
    if abs(power - round(power)) < 1e-9 and "e" not in shown and float(shown) == value:
        return f"{shown}e{round(power)}"
    return f"{value * size:.4g}"
