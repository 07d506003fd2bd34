"""Keys of the section `hydraulics` of a machine file."""

from crane.description.key_types import (
    REQUIRED,
    FileKey,
    FlagKey,
    Key,
    MapKey,
    NameListKey,
    NumberKey,
    RowListKey,
    SectionKey,
    TextKey,
    VariantKey,
    section_schema,
)
from crane.hydraulics.circuit_elements import (
    ELEMENT_KINDS,
    OPENING_SIDES,
    PUMP_CONTROLS,
    Accumulator,
    CircuitElement,
    CircuitLine,
    Engine,
    Supply,
)
from crane.hydraulics.components import CounterbalanceValve, Cylinder, Spool, Valve
from crane.hydraulics.hydraulic_circuit import Oil, PDGains

VALVE_TYPES = ("orifice", "compensated", "sharing")
ORIFICE_KEYS = ("c1", "c2", "c3", "c4")
AREA_KEYS = ("area_a", "area_b")
BORE_KEYS = ("bore", "rod")
_COEFFICIENT = "m3/(s Pa^0.5)"

CURVE = section_schema(
    "curve",
    {
        "coefficient": NumberKey("of the edge when it is wide open", _COEFFICIENT, minimum=0.0),
        "shape": RowListKey("share of the coefficient over the share of the stroke", size=2),
        "flow": RowListKey("flow over the share of the stroke, with `drop`", "m3/s", size=2),
        "drop": NumberKey("pressure drop at which the flows were measured", "Pa", minimum=0.0),
        "area": RowListKey("opening area over the share of the stroke", "m2", size=2),
        "discharge": NumberKey("discharge coefficient of the areas", minimum=0.0, default=0.7),
        "density": NumberKey("density of the oil", "kg/m3", minimum=1.0, default=870.0),
        "file": FileKey("CSV file with the columns `u` and `flow`, `area` or `coefficient`"),
    },
)


def _edge(text: str) -> VariantKey:
    """A flow coefficient, or a curve of it over the share of the stroke."""
    return VariantKey(
        text,
        (NumberKey("", _COEFFICIENT, minimum=0.0), RowListKey(size=2), SectionKey(section=CURVE)),
    )


_PUMP_KEYS: dict[str, Key] = {
    "control": TextKey("type of the regulator", choices=PUMP_CONTROLS),
    "pressure": NumberKey("set pressure, or cut-off pressure"),
    "tank": NumberKey("pressure of the return line; key of the first pump alone"),
    "flow": NumberKey("largest flow; 0: no limit"),
    "droop": NumberKey("fall of the pressure from no flow to full flow"),
    "volume": NumberKey("volume of the line between pump and valves"),
    "margin": NumberKey("load sensing: pressure above the highest load"),
    "standby": NumberKey("load sensing: least pressure that is set"),
    "signal": NumberKey("negative control: pressure before the throttle at which the flow is 0"),
    "throttle": NumberKey("negative control: throttle behind the open centres"),
    "least": NumberKey("share of the flow that the pump always delivers"),
    "response": NumberKey("time constant of the displacement; 0: at once; needs a `relief`"),
    "sensing": NumberKey(
        "load sensing: time constant of the load-sensing line as a multiple of `response`; "
        "0: none, which can [oscillate](hydraulics.md#hunting)"
    ),
    "power": NumberKey("power limit, with its corner at power / flow; 0: none"),
    "summed": NameListKey("pumps whose mean pressure counts for `power`", default_text="itself"),
    "relief": NumberKey("main relief valve; 0: none"),
    "relief_gain": NumberKey("flow of the relief valve per pressure above `relief`"),
    "slip": NumberKey("leakage"),
    "friction": NumberKey("share of the torque that is lost"),
    "drag": NumberKey("power without load"),
}
FIRST_PUMP = section_schema("'supply'", _PUMP_KEYS, Supply)
PUMP = section_schema("supply", {k: x for k, x in _PUMP_KEYS.items() if k != "tank"}, Supply)
ENGINE = section_schema(
    "'engine'",
    {
        "speed": NumberKey("set speed, at which pumps have their `flow`"),
        "torque": NumberKey("largest torque"),
        "inertia": NumberKey("inertia of engine and pumps"),
        "speed_droop": NumberKey("fall of the speed from no torque to full torque"),
        "fuel": NumberKey("fuel consumption per work; 0: not known"),
        "idle": NumberKey("fuel consumption without load; 0: not known"),
    },
    Engine,
)
OIL = section_schema(
    "'oil'",
    {
        "bulk_modulus": NumberKey("bulk modulus of the oil"),
        "hose_modulus": NumberKey("pressure per relative change of volume of hoses; 0: rigid"),
        "steel_modulus": NumberKey("the same of cylinder walls; 0: rigid"),
        "vapour_pressure": NumberKey("least pressure of a chamber"),
        "gas_exponent": NumberKey("polytropic exponent of entrapped gas"),
        "air": NumberKey("share of free air in the volume at 1 bar"),
    },
    Oil,
)
LINE = section_schema(
    "line",
    {
        "volume": NumberKey("volume of the line"),
        "pressure": NumberKey("initial pressure", default_text="the tank's"),
    },
    CircuitLine,
)
ACCUMULATOR = section_schema(
    "accumulator",
    {
        "volume": NumberKey("volume of the gas at the precharge pressure"),
        "precharge": NumberKey("precharge pressure, from a vacuum"),
        "exponent": NumberKey("polytropic exponent of the gas"),
        "time_constant": NumberKey("time constant of the heat flow from the gas; 0: no heat flow"),
        "line": NumberKey("volume of the oil at the port"),
        "pressure": NumberKey("initial pressure", default_text="the precharge"),
    },
    Accumulator,
)
ELEMENT = section_schema(
    "element",
    {
        "type": TextKey("type of the element", choices=ELEMENT_KINDS, attribute="kind"),
        "from": TextKey("node that the flow comes from", attribute="source"),
        "to": TextKey("node that the flow goes to", attribute="target"),
        "coefficient": NumberKey("flow coefficient of an orifice or check valve"),
        "gain": NumberKey("flow per pressure of a relief valve or leak"),
        "pressure": NumberKey("cracking pressure of a check or relief valve"),
        "joints": NameListKey(
            "joints whose valves open it, as far as the one that is open farthest",
            default_text="none: always open",
        ),
        "side": TextKey("direction of motion of the joints that opens it", choices=OPENING_SIDES),
    },
    CircuitElement,
)
COUNTERBALANCE = section_schema(
    "counterbalance valve",
    {
        "pressure": NumberKey("cracking pressure without pilot pressure"),
        "pilot_ratio": NumberKey("weight of the pressure of the other chamber"),
        "range": NumberKey("pressure from cracking to full opening"),
        "coefficient": NumberKey("flow coefficient when it is fully open"),
    },
    CounterbalanceValve,
)
_HOLDING_VALVE = SectionKey("load-holding valve of the chamber", section=COUNTERBALANCE)
_LOSS_KEYS: dict[str, Key] = {
    "leakage": NumberKey("leakage past the piston"),
    "leakage_a": NumberKey("leakage from chamber A to the tank"),
    "leakage_b": NumberKey("leakage from chamber B to the tank"),
    "relief": NumberKey("relief (shock) valves of both chambers; 0: none"),
    "relief_gain": NumberKey("flow of the relief valves per pressure above `relief`"),
    "cross_relief": NumberKey(
        "relief valves from one chamber into the other, with `relief_gain`; 0: none"
    ),
    "refill": NumberKey("check valves from the tank into both chambers; 0: none"),
    "gas_a": NumberKey("volume of the gas entrapped in chamber A at 1 bar"),
    "gas_b": NumberKey("volume of the gas entrapped in chamber B at 1 bar"),
    "seal_friction": NumberKey(
        "increase of the joint's Coulomb friction per pressure of both chambers above the tank's"
    ),
    "brake": NumberKey(
        "Coulomb friction of a spring-applied brake within the valve's dead band; 0: none",
        "N", "N m",
    ),
    "brake_release": NumberKey("spool travel beyond the dead band that releases the brake"),
}  # fmt: skip
_ONE_CYLINDER = "one cylinder of a sliding joint"
CYLINDER = section_schema(
    "cylinder of",
    {
        "area_a": NumberKey("$A_A$ of all `count` cylinders together"),
        "area_b": NumberKey("$A_B$ of all `count` cylinders together"),
        "bore": NumberKey(f"diameter of the piston of {_ONE_CYLINDER}, instead of the areas", "m"),
        "rod": NumberKey(
            f"diameter of the rod of {_ONE_CYLINDER}, with `bore`", "m", minimum=0.0, default=0.0
        ),
        "count": NumberKey("number of equal cylinders side by side", minimum=1.0),
        "tube": NumberKey(
            "outer diameter of the tube, for [buckling](reactions.md#buckling); 0: not known"
        ),
        "hose_a": NumberKey("$V_{hA}$: hoses and fittings"),
        "hose_b": NumberKey("$V_{hB}$: hoses and fittings"),
        **_LOSS_KEYS,
        "cushion": NumberKey("length at both ends where the outflow is throttled; 0: none"),
        "cushion_coefficient": NumberKey("coefficient of the throttle at the very end"),
        "stiffness": NumberKey("stiffness in series, of boom and mountings; 0: rigid"),
        "damping": NumberKey("damping in series, with `stiffness`", "N s/m", "N m s/rad"),
        "rupture_a": NumberKey("flow that closes the hose rupture valve of chamber A; 0: none"),
        "rupture_b": NumberKey("flow that closes the hose rupture valve of chamber B; 0: none"),
        "counterbalance_a": _HOLDING_VALVE,
        "counterbalance_b": _HOLDING_VALVE,
    },
    Cylinder,
    exclusive=((AREA_KEYS, ("bore",), "'{key}' stands beside 'bore', keep one of them"),),
)
MOTOR = section_schema(
    "motor of",
    {
        "displacement": NumberKey(
            "displacement", "m3/rad", minimum=0.0, default=REQUIRED,
            zero_error="'{key}' of {title} is 0, give it",
        ),
        "gear": NumberKey(
            "turns of the motor per turn of the joint", minimum=0.0, default=1.0,
            zero_error="'{key}' of {title} is 0, give it",
        ),
        "volume": NumberKey(
            "volume of the hoses of each side", "m3", minimum=0.0, default=REQUIRED,
            zero_error="'{key}' of {title} is 0, give it",
        ),
        **_LOSS_KEYS,
    },
    Cylinder,
    "motor",
)  # fmt: skip
_SPOOL_KEYS: dict[str, Key] = {
    "neutral": NumberKey("signal of the middle position", "V"),
    "full": NumberKey(
        "signal of $u = 1$; $u = (U - \\text{neutral}) / (\\text{full} - \\text{neutral})$", "V"
    ),
    "dead_band": NumberKey("share of the stroke without flow"),
    "bandwidth": NumberKey("natural frequency of the spool; 0: follows at once"),
    "damping": NumberKey("damping ratio of the spool"),
    "rate": NumberKey("largest speed in strokes per second; 0: no limit"),
    "hysteresis": NumberKey("play between signal and spool, as a share of the stroke"),
    "delay": NumberKey("dead time between signal and spool"),
}
SPOOL = section_schema("second spool", _SPOOL_KEYS, Spool)
_COMPENSATED = "'{key}' stands beside '{other}', keep one of them"
VALVE = section_schema(
    "valve of",
    {
        "type": TextKey(
            "`compensated`: pressure compensator before the inlet; `sharing`: behind it, set to "
            "the highest load",
            choices=VALVE_TYPES, default=REQUIRED,
        ),
        "supply": TextKey("pump that feeds it"),
        "priority": FlagKey("whether a compensated valve is served before the others of its pump"),
        "return_a": TextKey("node that chamber A drains to"),
        "return_b": TextKey("node that chamber B drains to"),
        "c1": _edge("edge from the supply to A"),
        "c2": _edge("edge from B to the tank"),
        "c3": _edge("edge from A to the tank"),
        "c4": _edge("edge from the supply to B"),
        "margin": NumberKey(
            "pressure drop that the compensator of a compensated valve keeps",
            default_text="required for `compensated`",
            zero_error="'{key}' is 0, give the pressure drop that is kept",
        ),
        "flow": NumberKey(
            "flow of a compensated valve at full stroke, instead of `c1` to `c4`; "
            "$c_1 = c_4 = \\text{flow} / \\sqrt{\\text{margin}}$",
            "m3/s",
            minimum=0.0, zero_error="'{key}' is 0, give the flow at full stroke",
        ),
        "meter_out": NumberKey(
            "$c_2 = c_3$, with `flow`", _COEFFICIENT, minimum=0.0,
            default_text="flow / √margin",
        ),
        **_SPOOL_KEYS,
        "spool_b": SectionKey(
            "second spool, of chamber B, with a signal of its own; keys that are not given are "
            "those of the first, `{}` for all ([two spools](hydraulics.md#two-spools-dead-time))",
            section=SPOOL,
        ),
        "centre": _edge("open centre at rest; 0: closed"),
        "demand": NumberKey("share of the flow that it asks of a pump with positive control"),
        "regeneration": NumberKey("check valve from B to A while A is fed; 0: none"),
        "float_from": NumberKey(
            "share of the negative stroke beyond which both chambers are open to the tank; 0: none"
        ),
        "float_coefficient": NumberKey("edges of both chambers to the tank then"),
    },
    Valve,
    exclusive=((("flow", "meter_out"), ORIFICE_KEYS, _COMPENSATED),),
)  # fmt: skip
VALVE_CONTROL = section_schema(
    "control of",
    {
        "kp": NumberKey("spool position per error", "1/m", "1/rad"),
        "kd": NumberKey("spool position per error of the velocity", "s/m", "s/rad"),
    },
    PDGains,
)
HYDRAULICS = section_schema(
    "'hydraulics'",
    {
        "supply": SectionKey(
            "first pump, whose node is `supply`", section=FIRST_PUMP, default=REQUIRED
        ),
        "supplies": MapKey("further pumps", SectionKey(section=PUMP)),
        "engine": SectionKey("engine that turns the pumps", section=ENGINE),
        "oil": SectionKey("oil", section=OIL),
        "lines": MapKey("further nodes", SectionKey(section=LINE)),
        "accumulators": MapKey("accumulators, which are nodes", SectionKey(section=ACCUMULATOR)),
        "elements": MapKey("elements between two nodes", SectionKey(section=ELEMENT)),
        "cylinders": MapKey(
            "cylinders", SectionKey(section=CYLINDER), "active joint", has_common_item=True
        ),
        "motors": MapKey(
            "motors", SectionKey(section=MOTOR), "active joint", has_common_item=True
        ),
        "valves": MapKey(
            "valves", SectionKey(section=VALVE), "active joint", has_common_item=True
        ),
        "control": MapKey(
            "gains of valve controllers, of all cylinders or of none",
            SectionKey(section=VALVE_CONTROL), "active joint", has_common_item=True,
        ),
    },
)  # fmt: skip
