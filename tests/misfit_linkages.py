"""Planar linkages with a specified home configuration, and the same with one wrong length.

Each is drawn by the places of its pins at home, metres: what joints are at there follows, so that
a file with right lengths closes as it says, but for the digits.
"""

import math
from dataclasses import dataclass

import numpy as np

GROUND = "ground"


@dataclass(frozen=True)
class Bar:
    """A link that turns about a pin, or a cylinder's tube and rod between two.

    Attributes:
        name: Of the link, and of the joint that carries it.
        parent: The link that it hangs from.
        pin: Where it does, at home (x, z).
        end: Where its own x axis points, at home; of a cylinder the rod's eye.
        dead: Length of a cylinder between its pins at zero stroke; 0 for a bar.
    """

    name: str
    parent: str
    pin: tuple[float, float]
    end: tuple[float, float]
    dead: float = 0.0


@dataclass(frozen=True)
class Linkage:
    """A linkage as it is drawn.

    Attributes:
        bars: In the order of the tree.
        loops: (loop, link, link, place at home).
        active: Driven joints.
    """

    bars: tuple[Bar, ...]
    loops: tuple[tuple[str, str, str, tuple[float, float]], ...]
    active: tuple[str, ...]

    def write(self, folder, home=None, wrong=None):
        """Write it with some lengths wrong, and give the path of the machine file."""
        said = self.home() if home is None else home
        (folder / "linkage.urdf").write_text(self._urdf(wrong or {}))
        loops = "".join(
            f"  - {{name: {name}, type: revolute, predecessor: {one}_{name}, "
            f"successor: {two}_{name}, axis: [0, 1, 0]}}\n"
            for name, one, two, _ in self.loops
        )
        lines = "".join(f"  {joint}: {value:.3f}\n" for joint, value in said.items())
        path = folder / "linkage.yaml"
        path.write_text(
            "name: linkage\nchains:\n  - {name: all, urdf: linkage.urdf}\n"
            f"loops:\n{loops}active: [{', '.join(self.active)}]\n"
            f"home:\n{lines or '  {}'}"
        )
        return path

    def home(self):
        """Joints at home, by name."""
        out = {}
        for bar in self.bars:
            turned = self._angle(bar.name) - self._angle(bar.parent)
            out[bar.name] = math.remainder(turned, 2 * math.pi)
            if bar.dead:
                out[f"{bar.name}_stroke"] = math.dist(bar.pin, bar.end) - bar.dead
        return out

    def lengths(self):
        """Numbers of the file that place pins, by the names that `load` changes them by."""
        places = {bar.name: self._local(bar.parent, bar.pin) for bar in self.bars}
        for name, one, two, at in self.loops:
            places |= {f"{link}_{name}": self._tip(link, at) for link in (one, two)}
        return {
            f"{name}.{axis}": value
            for name, place in places.items()
            for axis, value in zip("xz", place, strict=True)
            if abs(value) > 0.02
        }

    def _bar(self, name):
        return next(bar for bar in self.bars if bar.name == name)

    def _angle(self, name):
        if name == GROUND:
            return 0.0
        bar = self._bar(name)
        return math.atan2(bar.end[1] - bar.pin[1], bar.end[0] - bar.pin[0])

    def _local(self, link, place):
        """A place at home as a link sees it."""
        origin = (0.0, 0.0) if link == GROUND else self._bar(link).pin
        c, s = math.cos(self._angle(link)), math.sin(self._angle(link))
        x, z = np.subtract(place, origin)
        return float(c * x + s * z), float(c * z - s * x)

    def _tip(self, link, place):
        x, z = self._local(link, place)
        dead = 0.0 if link == GROUND else self._bar(link).dead
        return (dead, z) if dead else (x, z)

    def _urdf(self, wrong):
        def placed(name, place):
            return [wrong.get(f"{name}.{axis}", v) for axis, v in zip("xz", place, strict=True)]

        out = [f'<robot name="linkage"><link name="{GROUND}"/>\n']
        for bar in self.bars:
            place = placed(bar.name, self._local(bar.parent, bar.pin))
            out += [link(bar.name), joint(bar.name, bar.parent, bar.name, place)]
            if bar.dead:
                slide = (f"{bar.name}_stroke", bar.name, f"{bar.name}_rod", (0.0, 0.0))
                out += [link(f"{bar.name}_rod"), joint(*slide, slides=True)]
        for name, one, two, at in self.loops:
            for side in (one, two):
                on = f"{side}_rod" if side != GROUND and self._bar(side).dead else side
                frame = f"{side}_{name}"
                place = placed(frame, self._tip(side, at))
                out += [f'<link name="{frame}"/>']
                out += [joint(f"{frame}_fixed", on, frame, place, fixed=True)]
        return "".join([*out, "</robot>\n"])


def link(name):
    """A body of 10 kg."""
    return (
        f'<link name="{name}"><inertial><origin xyz="0.2 0 0"/><mass value="10"/><inertia '
        'ixx="0.5" iyy="0.5" izz="0.5" ixy="0" ixz="0" iyz="0"/></inertial></link>\n'
    )


def joint(name, parent, child, place, slides=False, fixed=False):
    """A pin about the normal of the plane, a slide along x, or none."""
    kind = "fixed" if fixed else "prismatic" if slides else "continuous"
    axis = "" if fixed else f'<axis xyz="{"1 0 0" if slides else "0 -1 0"}"/>'
    limit = '<limit lower="-9" upper="9" effort="1e5" velocity="1"/>' if slides else ""
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{place[0]:.4f} 0 {place[1]:.4f}"/>'
        f'<parent link="{parent}"/><child link="{child}"/>{axis}{limit}</joint>\n'
    )


def four_bar(crank, coupler_end, rocker_pin):
    """Ground, crank from the origin, coupler to its end, rocker from its own pin."""
    return Linkage(
        (
            Bar("crank", GROUND, (0.0, 0.0), crank),
            Bar("coupler", "crank", crank, coupler_end),
            Bar("rocker", GROUND, rocker_pin, coupler_end),
        ),
        (("pin", "coupler", "rocker", coupler_end),),
        ("crank",),
    )


def six_bar(crank, one, two, end, pins):
    """Two four-bar linkages behind each other: Watt's with three pins on the ground."""
    first = four_bar(crank, one, pins[0])
    more = (Bar("link", "rocker", two, end), Bar("arm", GROUND, pins[1], end))
    return Linkage((*first.bars, *more), (*first.loops, ("eye", "link", "arm", end)), ("crank",))


def lifted(base, eye, pin, tip, dead):
    """A cylinder lifts a boom."""
    return Linkage(
        (Bar("boom", GROUND, pin, tip), Bar("lift", GROUND, base, eye, dead)),
        (("eye", "boom", "lift", eye),),
        ("lift_stroke",),
    )


def bucket():
    """An excavator's bucket linkage on a stick that stands still."""
    eye, pin = (2.45, 0.66), (2.95, 0.43)
    return Linkage(
        (
            Bar("tube", GROUND, (0.55, 0.62), eye, 1.45),
            Bar("rocker", GROUND, (2.33, 0.05), eye),
            Bar("link", "rocker", eye, pin),
            Bar("bucket", GROUND, (2.8, 0.0), pin),
        ),
        (("eye", "tube", "rocker", eye), ("pin", "link", "bucket", pin)),
        ("tube_stroke",),
    )


def loader():
    """A wheel loader of 10 t with its Z-bar: bell crank on the boom, link to the bucket."""
    boom, bell, link = (2.75, 0.75), (1.55, 1.45), (2.62, 1.1)
    top, low = (1.25, 2.1), (1.75, 0.98)
    return Linkage(
        (
            Bar("boom", GROUND, (0.0, 1.8), boom),
            Bar("lift", GROUND, (0.25, 0.75), (1.3, 1.15), 0.9),
            Bar("bell", "boom", bell, top),
            Bar("tilt", GROUND, (0.1, 2.2), top, 0.8),
            Bar("link", "bell", low, link),
            Bar("bucket", "boom", boom, link),
        ),
        (
            ("lift", "boom", "lift", (1.3, 1.15)),
            ("tilt", "bell", "tilt", top),
            ("link", "link", "bucket", link),
        ),
        ("lift_stroke", "tilt_stroke"),
    )


LINKAGES = {
    "crank and rocker": four_bar((0.1, 0.2), (0.9, 0.6), (0.8, 0.0)),
    "double rocker": four_bar((0.2, 0.7), (0.8, 0.75), (1.0, 0.0)),
    "nearly in line": four_bar((0.3, 0.4), (1.05, 0.62), (1.4, 0.78)),
    "six bar": six_bar((0.1, 0.25), (0.7, 0.6), (0.9, 0.5), (1.5, 0.7), ((0.6, 0.0), (1.4, 0.1))),
    "boom": lifted((0.3, 0.2), (1.0, 1.3), (0.0, 0.8), (3.0, 1.9), 0.9),
    "bucket": bucket(),
    "loader": loader(),
}
