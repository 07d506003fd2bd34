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
CYLINDER_SIZE_KEYS = (*AREA_KEYS, *BORE_KEYS, "count")
_COEFFICIENT = "m3/(s Pa^0.5)"

CURVE = section_schema(
    "curve",
    {
        "coefficient": NumberKey(
            "flow coefficient of the fully open edge", _COEFFICIENT, minimum=0.0
        ),
        "shape": RowListKey("rows of relative stroke and relative coefficient", size=2),
        "flow": RowListKey(
            "rows of relative stroke and flow, with `drop`", "m3/s", size=2,
            column_units=("", "m3/s"),
        ),
        "drop": NumberKey("pressure drop at which the flows were measured", "Pa", minimum=0.0),
        "area": RowListKey(
            "rows of relative stroke and opening area", "m2", size=2, column_units=("", "m2")
        ),
        "discharge": NumberKey(
            "discharge coefficient of the opening areas", minimum=0.0, default=0.7
        ),
        "density": NumberKey("density of the oil", "kg/m3", minimum=1.0, default=870.0),
        "file": FileKey("CSV file with the columns `u` and `flow`, `area` or `coefficient`"),
    },
)  # fmt: skip


def _edge(text: str) -> VariantKey:
    """A flow coefficient, or a curve of it over the relative stroke."""
    return VariantKey(
        text,
        (
            NumberKey("", _COEFFICIENT, minimum=0.0),
            RowListKey(size=2, column_units=("", _COEFFICIENT)),
            SectionKey(section=CURVE),
        ),
    )


# fmt: off
_PUMP_KEYS: dict[str, Key] = {
    "control": TextKey("type of the regulator", choices=PUMP_CONTROLS),
    "pressure": NumberKey("set pressure, or cut-off pressure"),
    "tank": NumberKey("pressure of the return line; first pump only"),
    "flow": NumberKey("maximum flow; 0: no limit"),
    "displacement": NumberKey(
        "displacement at full stroke, instead of `flow` = displacement times speed",
        "m3/rad", minimum=0.0, zero_error="'{key}' of {title} is 0, give it",
    ),
    "speed": NumberKey(
        "speed of the pump, with `displacement`", "rad/s", minimum=0.0,
        zero_error="'{key}' of {title} is 0, give it", default_text="`engine.speed`",
    ),
    "droop": NumberKey("decrease of the pressure from zero to full flow"),
    "volume": NumberKey("volume of the line between pump and valves"),
    "margin": NumberKey("load sensing: pressure difference above the highest load pressure"),
    "standby": NumberKey("load sensing: minimum set pressure"),
    "signal": NumberKey(
        "negative control: pressure upstream of the throttle at which the flow is 0"
    ),
    "throttle": NumberKey(
        "negative control: flow coefficient of the throttle downstream of the open centres"
    ),
    "least": NumberKey("minimum flow, as a fraction of the maximum flow"),
    "response": NumberKey(
        "time constant of the displacement, which requires a `relief`; 0: immediate response"
    ),
    "sensing": NumberKey(
        "load sensing: time constant of the load-sensing line as a multiple of `response`; "
        "0: none, which can [cause oscillations]"
        "(hydraulics.md#hunting-instability-of-load-sensing)"
    ),
    "power": NumberKey(
        "power limit, which reduces the flow at pressures above power / flow; 0: none"
    ),
    "summed": NameListKey(
        "pumps whose mean pressure determines the power limit", default_text="the pump itself"
    ),
    "relief": NumberKey("set pressure of the main relief valve; 0: none"),
    "relief_gain": NumberKey("flow of the relief valve per pressure above `relief`"),
    "slip": NumberKey("leakage coefficient of the pump"),
    "friction": NumberKey("friction torque, relative to the hydraulic torque"),
    "drag": NumberKey("drag power without load, at the set speed"),
}
_PUMP_SIZES = (("flow",), ("displacement",), "'{key}' stands beside '{other}', keep one of them")
FIRST_PUMP = section_schema("'supply'", _PUMP_KEYS, Supply, exclusive=(_PUMP_SIZES,))
PUMP = section_schema(
    "supply", {k: x for k, x in _PUMP_KEYS.items() if k != "tank"}, Supply,
    exclusive=(_PUMP_SIZES,),
)
# fmt: on
ENGINE = section_schema(
    "'engine'",
    {
        "speed": NumberKey("set speed, at which the maximum flow of the pumps is `flow`"),
        "torque": NumberKey("maximum torque"),
        "inertia": NumberKey("moment of inertia of engine and pumps"),
        "speed_droop": NumberKey("decrease of the speed from zero to full torque"),
        "fuel": NumberKey("fuel consumption per work; 0: unknown"),
        "idle": NumberKey("fuel consumption without load; 0: unknown"),
    },
    Engine,
)
OIL = section_schema(
    "'oil'",
    {
        "bulk_modulus": NumberKey("bulk modulus of the oil"),
        "hose_modulus": NumberKey("pressure per relative change of volume of the hoses; 0: rigid"),
        "steel_modulus": NumberKey("the same for the cylinder walls; 0: rigid"),
        "vapour_pressure": NumberKey("vapour pressure, the minimum pressure of a chamber"),
        "gas_exponent": NumberKey("polytropic exponent of entrapped gas"),
        "air": NumberKey("volume fraction of free air at 1 bar"),
    },
    Oil,
)
LINE = section_schema(
    "line",
    {
        "volume": NumberKey("volume of the line"),
        "pressure": NumberKey("initial pressure", default_text="tank pressure"),
    },
    CircuitLine,
)
ACCUMULATOR = section_schema(
    "accumulator",
    {
        "volume": NumberKey("volume of the gas at the precharge pressure"),
        "precharge": NumberKey("precharge pressure, absolute"),
        "exponent": NumberKey("polytropic exponent of the gas"),
        "time_constant": NumberKey("time constant of the heat flow from the gas; 0: no heat flow"),
        "line": NumberKey("volume of the oil at the port"),
        "pressure": NumberKey("initial pressure", default_text="`precharge`"),
    },
    Accumulator,
)
ELEMENT = section_schema(
    "element",
    {
        "type": TextKey("type of the element", choices=ELEMENT_KINDS, attribute="kind"),
        "from": TextKey("node from which the flow comes", attribute="source"),
        "to": TextKey("node to which the flow goes", attribute="target"),
        "coefficient": NumberKey("flow coefficient of an orifice or check valve"),
        "gain": NumberKey("flow per pressure of a relief valve or leak"),
        "pressure": NumberKey("cracking pressure of a check or relief valve"),
        "joints": NameListKey(
            "joints whose valves open the element; the largest opening of these valves applies",
            default_text="none: always open",
        ),
        "side": TextKey(
            "direction of motion of `joints` in which the element opens", choices=OPENING_SIDES
        ),
    },
    CircuitElement,
)
COUNTERBALANCE = section_schema(
    "counterbalance valve",
    {
        "pressure": NumberKey("cracking pressure without pilot pressure"),
        "pilot_ratio": NumberKey("pilot ratio, the factor of the pressure in the other chamber"),
        "range": NumberKey("pressure increase from cracking to full opening"),
        "coefficient": NumberKey("flow coefficient of the fully open valve"),
    },
    CounterbalanceValve,
)


def _loss_keys(volume: str, volumes: str, leakage: str) -> dict[str, Key]:
    """Keys of losses and protection: of the chambers of a cylinder, or of the ports of a motor."""
    return {
        "leakage": NumberKey(leakage),
        "leakage_a": NumberKey(f"leakage coefficient from {volume} A to the tank"),
        "leakage_b": NumberKey(f"leakage coefficient from {volume} B to the tank"),
        "relief": NumberKey(
            f"set pressure of the relief (shock) valves of both {volumes}; 0: none"
        ),
        "relief_gain": NumberKey(
            "flow of the relief valves per pressure above their set pressure"
        ),
        "cross_relief": NumberKey(
            f"set pressure of the relief valves from each {volume} to the other, with "
            "`relief_gain`; 0: none"
        ),
        "refill": NumberKey(
            f"flow coefficient of the check valves from the tank to both {volumes}; 0: none"
        ),
        "gas_a": NumberKey(f"volume of the gas entrapped in {volume} A at 1 bar"),
        "gas_b": NumberKey(f"volume of the gas entrapped in {volume} B at 1 bar"),
        "seal_friction": NumberKey(
            "increase of the joint's Coulomb friction per pressure above tank pressure, summed "
            f"over both {volumes}"
        ),
        "brake": NumberKey(
            "Coulomb friction of a spring-applied brake, which acts within the valve's dead band; "
            "0: none",
            "N", "N m",
        ),
        "brake_release": NumberKey(
            "spool travel beyond the dead band that releases the brake completely"
        ),
    }  # fmt: skip


_ONE_CYLINDER = "one cylinder of a prismatic joint"
CYLINDER = section_schema(
    "cylinder of",
    {
        "area_a": NumberKey("$A_A$, total area of all `count` cylinders"),
        "area_b": NumberKey("$A_B$, total area of all `count` cylinders"),
        "bore": NumberKey(f"piston diameter of {_ONE_CYLINDER}, instead of the areas", "m"),
        "rod": NumberKey(
            f"rod diameter of {_ONE_CYLINDER}, with `bore`", "m", minimum=0.0, default=0.0
        ),
        "count": NumberKey("number of equal cylinders in parallel", minimum=1.0),
        "tube": NumberKey(
            "outer diameter of the tube, for [buckling](reactions.md#buckling); 0: unknown"
        ),
        "hose_a": NumberKey("$V_{hA}$, volume of hoses and fittings"),
        "hose_b": NumberKey("$V_{hB}$, volume of hoses and fittings"),
        **_loss_keys(
            "chamber", "chambers", "leakage coefficient past the piston, between the chambers"
        ),
        "cushion": NumberKey(
            "length at both ends of the stroke over which the outflow is throttled; 0: none"
        ),
        "cushion_coefficient": NumberKey(
            "flow coefficient of the cushion throttle at the end of the stroke"
        ),
        "stiffness": NumberKey("series stiffness, of boom and mountings; 0: rigid"),
        "damping": NumberKey("series damping, with `stiffness`", "N s/m", "N m s/rad"),
        "rupture_a": NumberKey(
            "flow at which the hose rupture valve of chamber A closes; 0: none"
        ),
        "rupture_b": NumberKey(
            "flow at which the hose rupture valve of chamber B closes; 0: none"
        ),
        "counterbalance_a": SectionKey("load-holding valve of chamber A", section=COUNTERBALANCE),
        "counterbalance_b": SectionKey("load-holding valve of chamber B", section=COUNTERBALANCE),
    },
    Cylinder,
    exclusive=((AREA_KEYS, ("bore",), "'{key}' stands beside 'bore', keep one of them"),),
)
MOTOR = section_schema(
    "motor of",
    {
        "displacement": NumberKey(
            "displacement of the motor", "m3/rad", minimum=0.0, default=REQUIRED,
            zero_error="'{key}' of {title} is 0, give it",
        ),
        "gear": NumberKey(
            "gear ratio: turns of the motor per turn of the joint", minimum=0.0, default=1.0,
            zero_error="'{key}' of {title} is 0, give it",
        ),
        "volume": NumberKey(
            "volume of the hoses at each port", "m3", minimum=0.0, default=REQUIRED,
            zero_error="'{key}' of {title} is 0, give it",
        ),
        **_loss_keys("port", "ports", "internal leakage coefficient between ports A and B"),
    },
    Cylinder,
    "motor",
)  # fmt: skip
_SPOOL_KEYS: dict[str, Key] = {
    "neutral": NumberKey("signal of the neutral position", "V"),
    "full": NumberKey(
        "signal of $u = 1$; $u = (U - \\text{neutral}) / (\\text{full} - \\text{neutral})$", "V"
    ),
    "dead_band": NumberKey(
        "fraction of the spool stroke without flow; negative: underlap, over which the inlet and "
        "outlet of a chamber are both open",
        minimum=-1.0,
    ),
    "bandwidth": NumberKey("natural frequency of the spool; 0: the spool follows immediately"),
    "damping": NumberKey("damping ratio of the spool"),
    "rate": NumberKey("maximum speed in strokes per second; 0: no limit"),
    "hysteresis": NumberKey("play between signal and spool, as a fraction of the stroke"),
    "delay": NumberKey("dead time between signal and spool"),
}
SPOOL = section_schema("second spool", _SPOOL_KEYS, Spool)
_COMPENSATED = "'{key}' stands beside '{other}', keep one of them"
VALVE = section_schema(
    "valve of",
    {
        "type": TextKey(
            "`compensated`: pressure compensator upstream of the inlet edge; `sharing`: "
            "downstream of it, set by the highest load pressure",
            choices=VALVE_TYPES, default=REQUIRED,
        ),
        "supply": TextKey("pump that supplies the valve"),
        "priority": FlagKey(
            "`yes`: a compensated valve is served before the other valves of its pump"
        ),
        "return_a": TextKey("node to which chamber A drains"),
        "return_b": TextKey("node to which chamber B drains"),
        "c1": _edge("flow coefficient of the edge from the supply to A"),
        "c2": _edge("flow coefficient of the edge from B to the tank"),
        "c3": _edge("flow coefficient of the edge from A to the tank"),
        "c4": _edge("flow coefficient of the edge from the supply to B"),
        "margin": NumberKey(
            "pressure drop that the compensator maintains",
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
            "outlet coefficients $c_2 = c_3$, with `flow`", _COEFFICIENT, minimum=0.0,
            default_text="flow / √margin",
        ),
        **_SPOOL_KEYS,
        "spool_b": SectionKey(
            "second spool, of chamber B, with its own signal; keys that are not given have the "
            "values of the first spool, `{}` copies all "
            "([two spools](hydraulics.md#two-spools-dead-time))",
            section=SPOOL,
        ),
        "centre": _edge("flow coefficient of the open centre in the neutral position; 0: closed"),
        "demand": NumberKey(
            "positive control: fraction of the pump flow that the fully open valve requests"
        ),
        "regeneration": NumberKey(
            "flow coefficient of the check valve from B to A while A is supplied; 0: none"
        ),
        "float_from": NumberKey(
            "fraction of the negative stroke beyond which both chambers are connected to the "
            "tank; 0: none"
        ),
        "float_coefficient": NumberKey(
            "flow coefficient from each chamber to the tank in this float position"
        ),
    },
    Valve,
    exclusive=((("flow", "meter_out"), ORIFICE_KEYS, _COMPENSATED),),
)  # fmt: skip
VALVE_CONTROL = section_schema(
    "control of",
    {
        "kp": NumberKey("spool position per position error", "1/m", "1/rad"),
        "kd": NumberKey("spool position per velocity error", "s/m", "s/rad"),
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
        "engine": SectionKey("engine that drives the pumps", section=ENGINE),
        "oil": SectionKey("properties of the oil", section=OIL),
        "lines": MapKey("lines, which are additional nodes", SectionKey(section=LINE)),
        "accumulators": MapKey(
            "accumulators, which are nodes as well", SectionKey(section=ACCUMULATOR)
        ),
        "elements": MapKey("elements between two nodes", SectionKey(section=ELEMENT)),
        "cylinders": MapKey(
            "cylinders of prismatic or revolute joints", SectionKey(section=CYLINDER),
            "active joint", has_common_item=True,
        ),
        "motors": MapKey(
            "hydraulic motors", SectionKey(section=MOTOR), "active joint", has_common_item=True
        ),
        "valves": MapKey(
            "directional control valves", SectionKey(section=VALVE), "active joint",
            has_common_item=True,
        ),
        "control": MapKey(
            "gains of the valve controllers, of all cylinders or of none",
            SectionKey(section=VALVE_CONTROL), "active joint", has_common_item=True,
        ),
    },
)  # fmt: skip
