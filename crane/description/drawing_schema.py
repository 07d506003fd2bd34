"""Keys of the section `drawing` of a machine file: a machine by its pins."""

from typing import Any

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

STEEL_DENSITY = 7850.0  # [kg/m3]
PIN_AXES = ("x", "y", "z", "ball")

_POSITIVE: dict[str, Any] = {
    "minimum": 0.0, "zero_error": "'{key}' of {title} is 0, give more",
}  # fmt: skip
_POINT = NumberListKey("coordinates: [x, z], or [x, y, z]", "m")
_OFFSETS = NumberListKey(
    "positions across the plane, one of each part, e.g. [-0.2, 0.2]", "m", default=(0.0,)
)
_DENSITY = NumberKey("density", "kg/m3", **_POSITIVE, default=STEEL_DENSITY)
_LENGTH = {**_POSITIVE, "default": REQUIRED}
PLATE = section_schema(
    "plate",
    {
        "outline": NameListKey("points around it, in order", default=REQUIRED),
        "thickness": NumberKey("thickness", "m", **_LENGTH),
        "y": _OFFSETS,
        "density": _DENSITY,
    },
)
TUBE = section_schema(
    "tube",
    {
        "points": NameListKey("its two ends", size=2, default=REQUIRED),
        "height": NumberKey("outer height, in the plane of the drawing", "m", **_LENGTH),
        "width": NumberKey(
            "outer width, across it; without it the tube is round", "m", **_POSITIVE
        ),
        "wall": NumberKey("thickness of the wall", "m", **_POSITIVE, default_text="a solid bar"),
        "y": _OFFSETS,
        "density": _DENSITY,
    },
)
DRAWN_BODY = section_schema(
    "body",
    {
        "points": VariantKey(
            "points that it has; a point of two bodies is a pin. With coordinates of its own, "
            "`{A: [0, 0], B: [0.4, 0.1]}`, of which the drawing has two points or more",
            (NameListKey(), MapKey("", _POINT, "point")), default=REQUIRED,
        ),
        "mass": NumberKey(
            "mass; of plates and tubes, to which it is scaled, if they are given", "kg",
            **_POSITIVE, default_text="that of plates and tubes, else an estimate",
        ),
        "centre": VariantKey(
            "centre of mass: coordinates (its own, if it has them), or the name of a point",
            (NumberListKey(unit="m"), TextKey()), default_text="that of its shape",
        ),
        "inertia": VariantKey(
            "inertia about the centre: about the y axis, or [xx, yy, zz], or [xx, yy, zz, xy, "
            "yz, xz]",
            (NumberKey(unit="kg m2"), NumberListKey(unit="kg m2")),
            default_text="that of its shape",
        ),
        "width": NumberKey(
            "width across the plane, over which the mass of a body without plates and tubes is "
            "spread", "m", minimum=0.0, default=0.0,
        ),
        "plates": ListKey("plates in the plane of the drawing", SectionKey(section=PLATE)),
        "tubes": ListKey("tubes and bars between points", SectionKey(section=TUBE)),
    },
)  # fmt: skip
_SLIDE = {
    "shortest": NumberKey("distance of the points at coordinate zero", "m", minimum=0.0,
                          default=REQUIRED),
    "longest": NumberKey("largest distance", "m", **_LENGTH),
}  # fmt: skip
DRAWN_CYLINDER = section_schema(
    "cylinder",
    {
        "points": NameListKey("pin of the barrel, pin of the rod", size=2, default=REQUIRED),
        "bore": NumberKey("diameter of the piston", "m", **_LENGTH),
        "rod": NumberKey("diameter of the rod", "m", **_LENGTH),
        "shortest": NumberKey("pin to pin with the rod in", "m", **_LENGTH),
        "longest": NumberKey("pin to pin with the rod out", "m", **_LENGTH),
        "count": NumberKey("number of equal cylinders side by side", default=1),
        "spacing": NumberKey("distance between the outer ones, across", "m", minimum=0.0,
                             default=0.0),
    },
)  # fmt: skip
DRAWN_SLIDE = section_schema(
    "slide",
    {
        "bodies": NameListKey("outer and inner body", size=2, default=REQUIRED),
        "points": NameListKey(
            "a point of each, one after the other along the slide", size=2, default=REQUIRED
        ),
        **_SLIDE,
        "driven": FlagKey("whether a drive acts along it", default=False),
    },
)
DRAWN_PIN = section_schema(
    "pin",
    {
        "axis": VariantKey(
            "axis of the pin: a direction or `[x, y, z]`; or a ball joint",
            (TextKey(choices=PIN_AXES), NumberListKey(size=3)),
            default="y",
            choices=PIN_AXES,
        ),
        "driven": FlagKey("whether a motor turns it", default=False),
        "lower": NumberKey("least angle from the posture drawn", "rad"),
        "upper": NumberKey("largest angle", "rad"),
        "effort": NumberKey("largest torque of the motor", "N m", **_POSITIVE),
        "velocity": NumberKey("largest velocity", "rad/s", **_POSITIVE),
    },
)
PICTURE = section_schema(
    "'picture'",
    {
        "file": FileKey("picture, or PDF", default=REQUIRED),
        "page": NumberKey("page of a PDF", default=1),
        "width": NumberKey("width of the picture", "m", **_LENGTH),
        "corner": NumberListKey("where its lower left corner is: [x, z]", "m", size=2,
                                default=(0.0, 0.0)),
        "angle": NumberKey("rotation about this corner", "rad", default=0.0),
        "mirrored": FlagKey("whether its left is right, with the corner there", default=False),
    },
)  # fmt: skip
DRAWING = section_schema(
    "'drawing'",
    {
        "base": TextKey("body that stands on the world", default=REQUIRED),
        "points": MapKey("points by name", _POINT, "point", default=REQUIRED),
        "bodies": MapKey("rigid bodies", SectionKey(section=DRAWN_BODY), "body",
                         default=REQUIRED),
        "pins": MapKey("what distinguishes a pin", SectionKey(section=DRAWN_PIN), "point"),
        "cylinders": MapKey(
            "hydraulic cylinders between points", SectionKey(section=DRAWN_CYLINDER), "cylinder"
        ),
        "slides": MapKey(
            "bodies that slide in others", SectionKey(section=DRAWN_SLIDE), "joint"
        ),
        "picture": SectionKey("picture under it, of `crane draw`", section=PICTURE),
    },
)  # fmt: skip
