"""Keys of the sections of a machine file on external forces: loads, contacts, cutters."""

from crane.description.external_forces import AXES
from crane.description.ground_contact import (
    DEFAULT_DAMPING,
    DEFAULT_FRICTION,
    DEFAULT_SMOOTHING,
    DEFAULT_STIFFNESS,
    Ground,
)
from crane.description.key_types import (
    REQUIRED,
    Key,
    NumberKey,
    NumberListKey,
    RowListKey,
    TextKey,
    VariantKey,
    section_schema,
)
from crane.description.soil_cutting import SOILS

_FRAME = "moving link on which the force acts"
_CHANNEL_NAME = TextKey(
    "name in recordings; required if several forces of this kind act on the frame",
    default_text="name of the frame",
)
_WRENCH_KEYS: dict[str, Key] = {
    "frame": TextKey(_FRAME, default=REQUIRED),
    "force": VariantKey(
        "force [x, y, z], or one such list for each time",
        (NumberListKey("", "N", size=3), RowListKey("", "N", size=3)), default_text="0",
    ),
    "moment": VariantKey(
        "moment [x, y, z] about the origin of the frame, or one such list for each time",
        (NumberListKey("", "N m", size=3), RowListKey("", "N m", size=3)), default_text="0",
    ),
    "times": NumberListKey("times, in ascending order", "s", default_text="constant"),
    "axes": TextKey(
        "axes of the components: `world`, or `frame` if they rotate with the link",
        choices=AXES, default="world",
    ),
    "name": _CHANNEL_NAME,
}  # fmt: skip
LOAD = section_schema("load of", _WRENCH_KEYS)
TASK_LOAD = section_schema(
    "load of",
    _WRENCH_KEYS | {"phases": NumberListKey("values of the channel `phase`, instead of `times`")},
    exclusive=(
        (
            ("phases",), ("times",),
            "the load on '{frame}' has times and phases, give one of both",
        ),
    ),
)  # fmt: skip
_CONTACT_LAW: dict[str, Key] = {
    "stiffness": NumberKey(
        "stiffness of the contact between ground and body", "N/m", minimum=0.0,
        default=DEFAULT_STIFFNESS,
    ),
    "damping": NumberKey(
        "reciprocal of the approach speed at which there is no restitution", "s/m", minimum=0.0,
        default=DEFAULT_DAMPING,
    ),
    "friction": NumberKey("coefficient of friction", minimum=0.0, default=DEFAULT_FRICTION),
    "smoothing": NumberKey(
        "velocity range over which friction changes its sign", "m/s", minimum=0.0,
        default=DEFAULT_SMOOTHING,
    ),
}  # fmt: skip
GROUND = section_schema(
    "'ground'",
    {
        "height": NumberKey(
            "height of the plane at $x = y = 0$; of one along z, its distance from the origin", "m"
        ),
        "normal": NumberListKey("normal of the plane, upwards; or across z", size=3),
        "profile": RowListKey(
            "points [x, z] with increasing x, instead of a plane", "m", size=2, default_text="none"
        ),
        **_CONTACT_LAW,
    },
    Ground,
)
_CONTACT_SIZE: dict[str, Key] = {
    "radius": NumberKey("radius of a wheel or ball", "m", minimum=0.0, default=0.0),
    "area": NumberKey(
        "area of a foot; its ground pressure is recorded", "m2", minimum=0.0, default=0.0
    ),
    "lateral_stiffness": NumberKey(
        "stiffness of a tyre or foot along the ground; 0: none", "N/m", minimum=0.0, default=0.0
    ),
    "lateral_damping": NumberKey(
        "damping along the ground, with `lateral_stiffness`", "N s/m", minimum=0.0, default=0.0
    ),
}
CONTACT_LAW_KEYS = tuple(_CONTACT_LAW)
CONTACT = section_schema(
    "contact of",
    {
        "frame": TextKey(_FRAME, default=REQUIRED),
        "name": _CHANNEL_NAME,
        **_CONTACT_SIZE,
        **_CONTACT_LAW,
    },
)
_WITHOUT_KIND = "required without `kind`"
_OF_KIND = "0, or the value of `kind`"
SOIL = section_schema(
    "'soil'",
    {
        "kind": TextKey("name of a soil in the table below", choices=tuple(SOILS)),
        "unit_weight": NumberKey(
            "unit weight $\\gamma$", "N/m3", minimum=0.0, default_text=_WITHOUT_KIND
        ),
        "cohesion": NumberKey("cohesion $c$", "Pa", minimum=0.0, default_text=_WITHOUT_KIND),
        "friction": NumberKey(
            "angle of internal friction $\\phi$, at most 1.05; 0 for clay that is cut too fast "
            "to drain", "rad", minimum=0.0, default_text=_WITHOUT_KIND,
        ),
        "tool_friction": NumberKey(
            "friction angle $\\delta$ between soil and tool, at most `friction`", "rad",
            minimum=0.0, default_text=_OF_KIND,
        ),
        "adhesion": NumberKey(
            "adhesion $c_a$ of soil to the tool, at most `cohesion`", "Pa", minimum=0.0,
            default_text=_OF_KIND,
        ),
        "surcharge": NumberKey(
            "surcharge $q$ on the surface", "Pa", minimum=0.0, default_text=_OF_KIND
        ),
    },
)  # fmt: skip
CUTTER = section_schema(
    "cutter of",
    {
        "frame": TextKey(
            "moving link whose origin is the middle of the edge", default=REQUIRED
        ),
        "width": NumberKey("width of the edge", "m", minimum=0.0, default=REQUIRED),
        "length": NumberKey(
            "length of the blade, upwards from the edge", "m", minimum=0.0, default=REQUIRED
        ),
        "blade": NumberListKey(
            "direction from the edge up the blade, in the axes of the frame", size=3,
            default=REQUIRED,
        ),
        "cutting": NumberListKey(
            "direction into the soil that is cut, in the axes of the frame", size=3,
            default=REQUIRED,
        ),
        "thickness": NumberKey(
            "thickness of the edge; 0: sharp", "m", minimum=0.0, default=0.0
        ),
        "smoothing": NumberKey(
            "velocity range over which the resistance builds up", "m/s", minimum=0.0,
            default=DEFAULT_SMOOTHING,
        ),
        "name": _CHANNEL_NAME,
    },
)  # fmt: skip
