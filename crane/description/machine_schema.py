"""Keys of a machine file: the one description that its reader, writer, tables and schema use."""

from crane.description.circuit_schema import HYDRAULICS
from crane.description.drawing_schema import DRAWING
from crane.description.external_force_schema import CONTACT, CUTTER, GROUND, LOAD, SOIL, TASK_LOAD
from crane.description.force_elements import EndStop, ForceElement, Friction, GasSpring, Rope
from crane.description.key_types import (
    QUANTITY_UNIT,
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
from crane.description.rotation_vectors import FLOATING_FREEDOMS
from crane.description.sensors import Sensor
from crane.description.specification import (
    DEFAULT_RAMP_TIME,
    LOOP_TYPES,
    STANDARD_GRAVITY,
    TIP_COORDINATES,
    PIGains,
)

ALL_ITEM = "all"  # an item whose keys hold for all items beside it
EXTENDS_KEY = "extends"  # the key that names the file a machine file is a variant of
MOTION_KEYS = ("tip", "active", "via", "joystick", "phases")  # of which a task has one
_COORDINATE = ("m", "rad")  # units of a coordinate, of a prismatic and of a revolute joint
_BETWEEN = NameListKey("two frames, on two bodies or on a body and the world", size=2)

CHAIN = section_schema(
    "chain",
    {
        "name": TextKey("name of the chain, unique", default=REQUIRED),
        "urdf": FileKey("URDF of the chain", default=REQUIRED),
        "parent": TextKey(
            "frame of an earlier chain with which the root link coincides",
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
            "direction of the joint axis, the same in both frames; any length",
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
            "factors of at least two joints",
            _FACTOR,
            "joint",
            default=REQUIRED,
            attribute="factors",
        ),
        "powers": MapKey(
            "coefficients of the square, cube and fourth power of joints, added to the sum",
            NumberListKey("", size=3),
            "joint",
        ),
        "offset": NumberKey("value of the weighted sum", *_COORDINATE, default=0.0),
    },
)
FRICTION = section_schema(
    "friction of",
    {
        "coulomb": NumberKey("Coulomb friction $F_C$", "N", "N m", minimum=0.0),
        "coulomb_offset": NumberKey(
            "$D_C$, direction-dependent part of Coulomb friction", "N", "N m"
        ),
        "viscous": NumberKey("viscous friction $F_V$", "N s/m", "N m s/rad", minimum=0.0),
        "viscous_offset": NumberKey(
            "$D_V$, direction-dependent part of viscous friction", "N s/m", "N m s/rad"
        ),
        "smoothing": NumberKey(
            "$v_s$, makes friction differentiable: $s = \\tanh(v / v_s)$; a joint that should be "
            "at rest then creeps ([theory](theory.md#7-control-and-simulation))",
            "m/s", "rad/s", minimum=0.0,
        ),
        "stiction": NumberKey(
            "$F_S$, excess of the breakaway force over `coulomb`; negative where friction rises "
            "from rest", "N", "N m",
        ),
        "stribeck": NumberKey(
            "$v_{St}$, Stribeck velocity, over which $F_S$ decays", "m/s", "rad/s", minimum=0.0,
            zero_error="'{key}' of {title} is 0, give a velocity",
        ),
        "stiction_2": NumberKey("a second excess, over another velocity", "N", "N m"),
        "stribeck_2": NumberKey(
            "its Stribeck velocity", "m/s", "rad/s", minimum=0.0,
            zero_error="'{key}' of {title} is 0, give a velocity",
        ),
        "root": NumberKey(
            "$F_R$, mixed lubrication, times the root of the speed", "N s^0.5/m^0.5",
            "N m s^0.5/rad^0.5",
        ),
        "presliding": NumberKey(
            "$F_P$, Coulomb friction that builds up over a distance (Dahl)", "N", "N m",
            minimum=0.0,
        ),
        "presliding_length": NumberKey(
            "$l_P$, that distance", "m", "rad", minimum=0.0,
            zero_error="'{key}' of {title} is 0, give a distance",
        ),
        "memory": NumberKey("$F_M$, friction that is higher after a rest", "N", "N m"),
        "memory_time": NumberKey(
            "$T_M$, time constant of the memory", "s", minimum=0.0,
            zero_error="'{key}' of {title} is 0, give a time",
        ),
        "memory_speed": NumberKey(
            "$v_M$, speed over which it fades", "m/s", "rad/s", minimum=0.0,
            zero_error="'{key}' of {title} is 0, give a velocity",
        ),
        "drives": FlagKey(
            "`yes`: an offset larger than the mean of both directions is intended", default=False,
            attribute="is_driving",
        ),
    },
    Friction,
)  # fmt: skip
FORCE = section_schema(
    "force element of",
    {
        "joint": TextKey("joint on which the element acts, active or passive", default=REQUIRED),
        "between": _BETWEEN,
        "stiffness": NumberKey("spring stiffness", "N/m", "N m/rad", minimum=0.0),
        "rest": NumberKey("coordinate at which the spring force is zero", *_COORDINATE),
        "damping": NumberKey("damping coefficient", "N s/m", "N m s/rad", minimum=0.0),
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
            "effective piston area; positive if the gas drives the joint in its positive "
            "direction, otherwise negative",
            "m2", "m3/rad", zero_error=_NOT_ZERO,
        ),
        "pressure": NumberKey("gas pressure at `rest`, above ambient pressure", "Pa", minimum=0.0),
        "volume": NumberKey("gas volume at `rest`", "m3", minimum=0.0, zero_error=_NOT_ZERO),
        "rest": NumberKey("coordinate at which `pressure` and `volume` hold", *_COORDINATE),
        "exponent": NumberKey(
            "polytropic exponent; 1: slow changes, at constant temperature; 1.4: fast changes, "
            "without heat flow",
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
        "length": NumberKey("length of the unloaded rope", "m", minimum=0.0, zero_error=_NOT_ZERO),
        "stiffness": NumberKey("stiffness", "N/m", minimum=0.0, zero_error=_NOT_ZERO),
        "damping": NumberKey("damping relative to the spring force", "s/m", minimum=0.0),
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
        "damping": NumberKey(
            "damping relative to the spring force", "s/m", "s/rad", minimum=0.0
        ),
    },
    EndStop,
)  # fmt: skip
PAYLOAD = section_schema(
    "'payload'",
    {
        "urdf": FileKey(
            "URDF of the load; it has a mass, and no moving joints or loops", default=REQUIRED
        )
    },
)
_POLYNOMIAL = NumberListKey("", *_COORDINATE, is_polynomial=True)
_JOINT_VALUE = NumberKey("", *_COORDINATE)
_RATE = NumberKey("", "m/s", "rad/s")
VIA_POINT = section_schema(
    "via point of",
    {
        "time": NumberKey("time of the point", "s", minimum=0.0, default=REQUIRED),
        "rates": MapKey("velocities of the coordinates", _RATE, "coordinate"),
    },
    others=_JOINT_VALUE,
)
_LEVER = NumberKey("", "")
PHASE = section_schema(
    "phase",
    {
        "name": TextKey("name of the phase", default=REQUIRED),
        "levers": MapKey("lever positions, -1 to 1", _LEVER, "joint"),
        "until": MapKey(
            "joint positions at which the levers return to neutral", _JOINT_VALUE, "joint"
        ),
        "within": NumberKey("maximum duration", "s", default=REQUIRED),
    },
)
_UNPHASED = MOTION_KEYS[:-1]
MOTIONS = ", ".join(f"'{key}'" for key in MOTION_KEYS)
_CONTINUOUS_MOTIONS = ("tip", "active", "joystick")
_SEVERAL_MOTIONS = f"{{title}} has more than one of {MOTIONS}, give one"
TASK = section_schema(
    "task",
    {
        "description": TextKey("description, one line", default=""),
        "duration": NumberKey(
            "duration of the task", "s", minimum=0.0,
            zero_error="{title} takes no time, give a duration",
            default_text="required without `via`, `phases`",
        ),
        "tip": MapKey(
            "polynomials in time of the tip position in the world", _POLYNOMIAL,
            " or ".join(TIP_COORDINATES),
            default_text="exactly one of `tip`, `active`, `via`, `joystick`, `phases`",
        ),
        "active": MapKey("polynomials in time of all active joints", _POLYNOMIAL, "joint"),
        "via": ListKey(
            "timed points of the tip or of active joints", SectionKey(section=VIA_POINT)
        ),
        "joystick": MapKey(
            "lever positions of the valves, as pairs of time and position",
            NumberListKey("", column_units=("s", "")), "joint",
        ),
        "phases": ListKey(
            "lever positions of the valves, each constant until joints reach given positions",
            SectionKey(section=PHASE),
        ),
        "ramp": NumberKey(
            "with `phases`: time in which a lever moves from neutral to its full position", "s",
            minimum=0.0, default=DEFAULT_RAMP_TIME,
        ),
        "start": MapKey(
            "initial active coordinates of a task with levers", _JOINT_VALUE, "joint",
            default_text="home",
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
_TERM_UNITS = ("s, m, rad, m/s, rad/s",)
IDENTIFICATION = section_schema(
    "'identification'",
    {
        "terms": MapKey(
            "[model terms](identification.md#model-terms-and-priors) added to the default ones, "
            "or `off` to remove one; their numbers, e.g. 0.1 mm or [0.3 s, 2 deg/s]",
            VariantKey(
                "", (FlagKey(), NumberKey(), TextKey(), NumberListKey(column_units=_TERM_UNITS))
            ), "term",
        ),
        "prior": MapKey(
            "priors of parameters, e.g. 50, 10 %, 609 +- 60, 0.6 +- 0.1 kN, or auto",
            VariantKey("", (NumberKey(), TextKey())), "parameter",
        ),
        "bandwidth": NumberKey(
            "bandwidth of the low-pass filter", "Hz", minimum=0.0,
            zero_error="'{key}' is 0, give one in Hz", default_text="derived from the motion",
        ),
        "min_speed": MapKey(
            "velocity below which samples are excluded",
            NumberKey("", "m/s", "rad/s", minimum=0.0), _PATTERN,
            default_text="derived from friction and motion",
        ),
    },
)  # fmt: skip
SENSOR = section_schema(
    "sensor",
    {
        "column": TextKey(
            "column of a log of another program, or an expression as in a "
            "[file of columns](recording.md#logs-of-other-programs), e.g. `s1_mm - 820`",
            default_text="name of the quantity",
        ),
        "unit": TextKey("unit of that column", default_text="SI unit"),
        "zero": NumberKey("offset", QUANTITY_UNIT),
        "scale": NumberKey("scale factor, not 0"),
        "delay": NumberKey("delay of the sensor", "s"),
        "noise": NumberKey(
            "standard deviation of the noise, which sets the weight of the channel in a "
            "calibration",
            QUANTITY_UNIT,
            default_text="derived from the recording",
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
            "path of the machine file, or name of the bundled machine, of which this one is a "
            "[variant](#extends)"
        ),
        "name": TextKey("name of the machine", default=REQUIRED),
        "source": TextKey("source of the parameters", default=""),
        "gravity": NumberListKey(
            "acceleration of gravity, in the axes of the world; 0, 0, 0 for none", "m/s2", size=3,
            default=STANDARD_GRAVITY, default_text="0, 0, -9.81, or that of the files of `chains`",
        ),
        "drawing": SectionKey(
            "the machine by its pins, instead of chains or before them", section=DRAWING
        ),
        "chains": ListKey(
            "open sub-chains", SectionKey(section=CHAIN),
            default_text="required without `drawing`",
        ),
        "floating": NameListKey(
            "degrees of freedom of the root of the first chain",
            choices=FLOATING_FREEDOMS, default_text="none: fixed to the world",
        ),
        "loops": ListKey("joints that close the chains into loops", SectionKey(section=LOOP)),
        "couplings": ListKey("constraints between joints", SectionKey(section=COUPLING)),
        "active": NameListKey(
            "driven joints, in the order of $q_A$; redundant ones share the load",
            default_text="the set with the best condition number, with a warning",
        ),
        "free": NameListKey(
            "independent coordinates without a drive: only friction, springs and end stops act",
            default_text="the independent coordinates not in `active`, with a warning",
        ),
        "drives": MapKey(
            "linear combinations of joints along which motors act",
            MapKey("", _FACTOR, "joint"), default_text="the joints under `active`",
        ),
        "home": MapKey("home configuration", _JOINT_VALUE, "joint", default_text="0 each"),
        "start": TextKey(
            "how runs [start](simulation.md#start): in static equilibrium of all free joints and "
            "of the oil, or at home with the pressures of the file", default="",
            choices=("equilibrium", "home"), default_text="equilibrium on contacts, else home",
        ),
        "friction": MapKey(
            "joint friction", SectionKey(section=FRICTION), "joint",
            default_text="none, or the URDF's"
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
        "supports": NameListKey("links on which the machine stands", default_text="all contacts"),
        "pins": MapKey(
            "maximum permitted force of a pin", _PIN, "joint or loop", attribute="pin_capacities"
        ),
        "end_stops": MapKey("end stops", SectionKey(section=END_STOP), "joint"),
        "rotor_inertia": MapKey(
            "inertia of the motor rotors, reflected to the joint",
            NumberKey("", "kg", "kg m2", minimum=0.0), "joint", default_text="0 each",
        ),
        "tip": TextKey("frame to which tasks and ratings refer; a moving link"),
        "payload": SectionKey(
            "load at the tip, if `payload.mass` is set", section=PAYLOAD,
            default_text="a point mass",
        ),
        "tasks": MapKey("named motions", SectionKey(section=TASK)),
        "control": MapKey(
            "PI gains of all active joints, or of none", SectionKey(section=CONTROL), "joint"
        ),
        "hydraulics": SectionKey("pumps, oil, cylinders, valves", section=HYDRAULICS),
        "sensors": MapKey(
            "properties of sensors and columns of logs", SectionKey(section=SENSOR), "quantity"
        ),
        "identification": SectionKey("settings of `crane identify`", section=IDENTIFICATION),
    },
)  # fmt: skip
