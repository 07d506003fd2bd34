"""Keys of a machine file: the one description that its reader, writer, tables and schema use."""

from crane.description.circuit_schema import HYDRAULICS
from crane.description.external_force_schema import CONTACT, CUTTER, GROUND, LOAD, SOIL, TASK_LOAD
from crane.description.floating_bases import FLOATING_FREEDOMS
from crane.description.force_elements import EndStop, ForceElement, Friction, GasSpring, Rope
from crane.description.key_types import (
    REQUIRED,
    FileKey,
    FlagKey,
    ListKey,
    MapKey,
    NameListKey,
    NumberKey,
    NumberListKey,
    SectionKey,
    TextKey,
    VariantKey,
    section_schema,
)
from crane.description.sensors import Sensor
from crane.description.specification import DEFAULT_RAMP_TIME, LOOP_TYPES, TIP_COORDINATES, PIGains

ALL_ITEM = "all"  # an item whose keys hold for all items beside it
EXTENDS_KEY = "extends"  # the key that names the file a machine file is a variant of
MOTION_KEYS = ("tip", "active", "via", "joystick", "phases")  # of which a task has one
_COORDINATE = ("m", "rad")  # units of a coordinate, of a sliding and of a turning joint
_BETWEEN = NameListKey("two frames on two bodies, or on one body and the world", size=2)

CHAIN = section_schema(
    "chain",
    {
        "name": TextKey("name of the chain, unique", default=REQUIRED),
        "urdf": FileKey("URDF of the chain", default=REQUIRED),
        "parent": TextKey(
            "frame of an earlier chain that the root link coincides with",
            default_text="the world, for the first chain",
        ),
    },
)
LOOP = section_schema(
    "loop",
    {
        "name": TextKey("name of the loop, unique", default=REQUIRED),
        "type": TextKey(
            "joint that closes the loop", default=REQUIRED, choices=tuple(LOOP_TYPES)
        ),
        "predecessor": TextKey("first frame (link)", default=REQUIRED),
        "successor": TextKey("second frame, of another body", default=REQUIRED),
        "axis": NumberListKey(
            "direction of the joint, the same in both frames, of any length",
            size=3, default=(0.0, 0.0, 1.0),
        ),
    },
)  # fmt: skip
_FACTOR = NumberKey("", zero_error="the factor of '{key}' is 0, leave it out")
COUPLING = section_schema(
    "coupling",
    {
        "name": TextKey("name of the coupling, unique", default=REQUIRED),
        "joints": MapKey(
            "factors of two joints at least",
            _FACTOR,
            "joint",
            default=REQUIRED,
            attribute="factors",
        ),
        "offset": NumberKey("value of the sum", *_COORDINATE, default=0.0),
    },
)
FRICTION = section_schema(
    "friction of",
    {
        "coulomb": NumberKey("$F_C$", "N", "N m", minimum=0.0),
        "coulomb_offset": NumberKey("$D_C$, difference between the directions", "N", "N m"),
        "viscous": NumberKey("$F_V$", "N s/m", "N m s/rad", minimum=0.0),
        "viscous_offset": NumberKey(
            "$D_V$, difference between the directions", "N s/m", "N m s/rad"
        ),
        "smoothing": NumberKey(
            "$v_s$, for a gradient: $s = \\tanh(v / v_s)$; a joint at rest then creeps "
            "([theory](theory.md#7-control-and-simulation))",
            "m/s", "rad/s", minimum=0.0,
        ),
        "stiction": NumberKey(
            "$F_S$, by how much friction at rest exceeds `coulomb`", "N", "N m", minimum=0.0
        ),
        "stribeck": NumberKey(
            "$v_{St}$, velocity over which stiction vanishes", "m/s", "rad/s", minimum=0.0,
            zero_error="'{key}' of {title} is 0, give a velocity",
        ),
        "drives": FlagKey(
            "whether an offset larger than its mean is meant", default=False,
            attribute="is_driving",
        ),
    },
    Friction,
)  # fmt: skip
FORCE = section_schema(
    "force element of",
    {
        "joint": TextKey("joint that it acts on, active or passive", default=REQUIRED),
        "between": _BETWEEN,
        "stiffness": NumberKey("stiffness", "N/m", "N m/rad", minimum=0.0),
        "rest": NumberKey("coordinate at which the spring has no force", *_COORDINATE),
        "damping": NumberKey("damping", "N s/m", "N m s/rad", minimum=0.0),
        "force": NumberKey("constant force", "N", "N m"),
    },
    ForceElement,
    exclusive=(
        (
            ("joint",), ("between",),
            "an element is on a joint or between frames, keep one of the two",
        ),
    ),
)  # fmt: skip
_NOT_ZERO = "'{key}' of {title} is 0, give one"
GAS_SPRING = section_schema(
    "gas spring of",
    {
        "area": NumberKey(
            "positive where the gas drives the joint in its positive direction, else negative",
            "m2", "m3/rad", zero_error=_NOT_ZERO,
        ),
        "pressure": NumberKey("at `rest`, above the ambient pressure", "Pa", minimum=0.0),
        "volume": NumberKey("at `rest`", "m3", minimum=0.0, zero_error=_NOT_ZERO),
        "rest": NumberKey("coordinate that pressure and volume belong to", *_COORDINATE),
        "exponent": NumberKey(
            "polytropic exponent; 1: slow, at constant temperature; 1.4: fast, without heat flow",
            minimum=0.0, zero_error=_NOT_ZERO,
        ),
        "between": _BETWEEN,
    },
    GasSpring,
)  # fmt: skip
ROPE = section_schema(
    "rope",
    {
        "between": _BETWEEN,
        "length": NumberKey("length", "m", minimum=0.0, zero_error=_NOT_ZERO),
        "stiffness": NumberKey("stiffness", "N/m", minimum=0.0, zero_error=_NOT_ZERO),
        "damping": NumberKey("damping per force", "s/m", minimum=0.0),
    },
    Rope,
)
END_STOP = section_schema(
    "end stop of",
    {
        "stiffness": NumberKey(
            "stiffness", "N/m", "N m/rad", minimum=0.0,
            zero_error="the {title} has no stiffness, give one",
        ),
        "damping": NumberKey("damping per force", "s/m", "s/rad", minimum=0.0),
    },
    EndStop,
)  # fmt: skip
PAYLOAD = section_schema(
    "'payload'",
    {
        "urdf": FileKey(
            "URDF of the load, without moving joints and loops, with a mass", default=REQUIRED
        )
    },
)
_POLYNOMIAL = NumberListKey("", "m", "rad")
_JOINT_VALUE = NumberKey("", *_COORDINATE)
_RATE = NumberKey("", "m/s", "rad/s")
VIA_POINT = section_schema(
    "via point of",
    {
        "time": NumberKey("time", "s", minimum=0.0, default=REQUIRED),
        "rates": MapKey("velocities of the coordinates", _RATE, "coordinate"),
    },
    others=_JOINT_VALUE,
)
_LEVER = NumberKey("", "")
PHASE = section_schema(
    "phase",
    {
        "name": TextKey("name of the phase", default=REQUIRED),
        "levers": MapKey("levers, -1 to 1", _LEVER, "joint"),
        "until": MapKey("positions at which they return to neutral", _JOINT_VALUE, "joint"),
        "within": NumberKey("longest duration", "s", default=REQUIRED),
    },
)
_UNPHASED = MOTION_KEYS[:-1]
MOTIONS = ", ".join(f"'{key}'" for key in MOTION_KEYS)
_CONTINUOUS_MOTIONS = ("tip", "active", "joystick")
_SEVERAL_MOTIONS = f"{{title}} has more than one of {MOTIONS}, give one"
TASK = section_schema(
    "task",
    {
        "description": TextKey("one line on what it is", default=""),
        "duration": NumberKey(
            "duration", "s", minimum=0.0, zero_error="{title} takes no time, give a duration",
            default_text="required, not with `via`, `phases`",
        ),
        "tip": MapKey(
            "polynomials of the position of the tip in the world", _POLYNOMIAL,
            " or ".join(TIP_COORDINATES), default_text="one of these",
        ),
        "active": MapKey("polynomials of all active joints", _POLYNOMIAL, "joint"),
        "via": ListKey(
            "points in time, of the tip or of active joints", SectionKey(section=VIA_POINT)
        ),
        "joystick": MapKey(
            "levers of the valves, pairs of time and lever", NumberListKey("", ""), "joint"
        ),
        "phases": ListKey(
            "levers of the valves that are held until positions", SectionKey(section=PHASE)
        ),
        "ramp": NumberKey(
            "with `phases`: time from neutral to a full lever", "s", minimum=0.0,
            default=DEFAULT_RAMP_TIME,
        ),
        "start": MapKey(
            "active coordinates where levers begin", _JOINT_VALUE, "joint", default_text="home"
        ),
        "loads": ListKey("external forces during the task", SectionKey(section=TASK_LOAD)),
    },
    exclusive=(
        (_UNPHASED, ("phases",), "{title} has phases and '{key}', give one of both"),
        (
            ("duration",), ("phases",),
            "{title} ends when its last phase does, leave 'duration' out",
        ),
        (("ramp",), _UNPHASED, "{title} has no phases, leave 'ramp' to these"),
        (_CONTINUOUS_MOTIONS, ("via",), _SEVERAL_MOTIONS),
        (_CONTINUOUS_MOTIONS, _CONTINUOUS_MOTIONS, _SEVERAL_MOTIONS),
        (("duration",), ("via",), "{title} ends at its last point, leave 'duration' out"),
        (("start",), ("via",), "{title} starts at its first, leave 'start' out"),
        (
            ("start",), ("tip", "active"),
            "{title} starts where its motion does, leave 'start' to levers",
        ),
    ),
)  # fmt: skip
CONTROL = section_schema(
    "control of",
    {
        "kp": NumberKey("proportional gain", "N/m", "N m/rad", minimum=0.0),
        "ki": NumberKey("integral gain", "N/(m s)", "N m/(rad s)", minimum=0.0),
    },
    PIGains,
)
_PATTERN = "joint or pattern"
IDENTIFICATION = section_schema(
    "'identification'",
    {
        "terms": MapKey(
            "[terms](identification.md#terms-and-what-is-known-before) added to the usual ones, "
            "or left out",
            VariantKey("", (FlagKey(), NumberKey(), NumberListKey())), "term",
        ),
        "prior": MapKey(
            "prior knowledge of parameters: 50, 10 %, 609 +- 60",
            VariantKey("", (NumberKey(), TextKey())), "parameter",
        ),
        "bandwidth": NumberKey(
            "bandwidth of the low-pass filter", "Hz", minimum=0.0,
            zero_error="'{key}' is 0, give one in Hz", default_text="by the motion",
        ),
        "slow": MapKey(
            "velocity below which rows are left out", NumberKey("", "m/s", "rad/s", minimum=0.0),
            _PATTERN,
        ),
    },
)  # fmt: skip
SENSOR = section_schema(
    "sensor",
    {
        "column": TextKey(
            "reading in a log of another program, as in a "
            "[file of columns](recording.md#logs-of-other-programs): `s1_mm - 820`",
            default_text="name of the quantity",
        ),
        "unit": TextKey("unit of that column", default_text="SI unit"),
        "zero": NumberKey("offset, in the unit of the quantity"),
        "scale": NumberKey("factor, not 0"),
        "delay": NumberKey("delay", "s"),
        "noise": NumberKey(
            "standard deviation, weight of the channel in a calibration",
            default_text="from the recording",
        ),
    },
    Sensor,
)
_PIN = NumberKey(
    "", "N", minimum=0.0, zero_error="the pin '{key}' bears 0 N, give a force above 0"
)
MACHINE = section_schema(
    "the machine file",
    {
        EXTENDS_KEY: TextKey(
            "path of the machine file, or name of the bundled machine, that this one is a "
            "[variant](#extends) of"
        ),
        "name": TextKey("name of the machine", default=REQUIRED),
        "source": TextKey("where its parameters come from", default=""),
        "chains": ListKey("open sub-chains", SectionKey(section=CHAIN), default=REQUIRED),
        "floating": NameListKey(
            "freedoms of the root of the first chain",
            choices=FLOATING_FREEDOMS, default_text="none: fixed to the world",
        ),
        "loops": ListKey("joints that close the chains", SectionKey(section=LOOP)),
        "couplings": ListKey("linear constraints of joints", SectionKey(section=COUPLING)),
        "active": NameListKey(
            "driven joints, in the order of $q_A$; more than degrees of freedom share the load",
            default_text="those of the best condition, with a warning",
        ),
        "free": NameListKey(
            "independent coordinates that no drive moves: only friction, springs and stops act",
            default_text="what `active` leaves open, with a warning",
        ),
        "drives": MapKey(
            "linear combinations of joints that motors act along",
            MapKey("", _FACTOR, "joint"), default_text="the joints under `active`",
        ),
        "home": MapKey("home configuration", _JOINT_VALUE, "joint", default_text="0 each"),
        "friction": MapKey(
            "friction", SectionKey(section=FRICTION), "joint", default_text="none, or the URDF's"
        ),
        "forces": ListKey("springs, dampers, constant forces", SectionKey(section=FORCE)),
        "gas_springs": MapKey(
            "counterbalances, accumulators, gas struts", SectionKey(section=GAS_SPRING),
            "joint or name",
        ),
        "ropes": ListKey("ropes and chains between frames", SectionKey(section=ROPE)),
        "loads": ListKey("external forces: wrenches at frames", SectionKey(section=LOAD)),
        "ground": SectionKey("surface of the ground", section=GROUND),
        "contacts": ListKey(
            "points, feet and wheels on the ground", SectionKey(section=CONTACT)
        ),
        "soil": SectionKey("soil that cutters cut", section=SOIL),
        "cutters": ListKey("edges of blades and buckets", SectionKey(section=CUTTER)),
        "supports": NameListKey("links that it stands on", default_text="the contacts"),
        "pins": MapKey(
            "largest force that a pin bears", _PIN, "joint or loop", attribute="pin_capacities"
        ),
        "end_stops": MapKey("end stops", SectionKey(section=END_STOP), "joint"),
        "rotor_inertia": MapKey(
            "inertia of motors' rotors, seen from the joint",
            NumberKey("", "kg", "kg m2", minimum=0.0), "joint", default_text="0 each",
        ),
        "tip": TextKey("frame that paths and plots are about; a link that moves"),
        "payload": SectionKey(
            "load that `payload.mass` puts on the tip", section=PAYLOAD,
            default_text="a point mass",
        ),
        "tasks": MapKey("named motions", SectionKey(section=TASK)),
        "control": MapKey(
            "PI gains, of all active joints or of none", SectionKey(section=CONTROL), "joint"
        ),
        "hydraulics": SectionKey("pumps, oil, cylinders, valves", section=HYDRAULICS),
        "sensors": MapKey(
            "properties of sensors, and columns of logs", SectionKey(section=SENSOR), "quantity"
        ),
        "identification": SectionKey("settings of `crane identify`", section=IDENTIFICATION),
    },
)  # fmt: skip
