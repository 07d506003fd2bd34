"""Random mechanisms written as SDF, in all its notations, and as plain URDF.

The places of links, joints and axes are drawn first, in numbers. The SDF says each of them
relative to some frame drawn at random, the URDF in the frame of the joint that moves the link;
the two have nothing in common but the numbers.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

KINDS = ("revolute", "prismatic", "continuous", "fixed", "universal")


def pose(rotation, place):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation.as_matrix(), place
    return out


def random_pose(rng, reach=0.5):
    return pose(Rotation.random(random_state=rng), rng.uniform(-reach, reach, 3))


def inverse(x):
    return np.linalg.inv(x)


@dataclass
class Drawn:
    """A mechanism: poses (4, 4) in the frame of its model, axes (3,) in that of the joint."""

    model: np.ndarray
    links: dict = field(default_factory=dict)  # name -> pose, mass, COM pose, principal moments
    joints: dict = field(default_factory=dict)  # name -> kind, parent, child, pose, axes
    frames: dict = field(default_factory=dict)  # name -> pose, attached to
    surplus: tuple = ()  # joints that close loops


def draw(rng, count=5, kinds=KINDS):
    """A tree of links from the world on."""
    drawn = Drawn(random_pose(rng))
    for i in range(count):
        drawn.links[f"l{i}"] = link(rng)
        kind = rng.choice(kinds) if i else "revolute"
        parent = f"l{rng.integers(i)}" if i else "world"
        axes = np.linalg.qr(rng.normal(size=(3, 2)))[0].T  # at right angles, as SDF wants them
        drawn.joints[f"j{i}"] = (str(kind), parent, f"l{i}", random_pose(rng), axes)
    for i in range(3):
        drawn.frames[f"f{i}"] = random_pose(rng), f"l{rng.integers(count)}"
    return drawn


def link(rng, moments=0.05):
    """Pose, mass, pose of the centre of mass, and principal moments."""
    drawn = rng.uniform(0.5, 1.0, 3) * moments
    return random_pose(rng), float(rng.uniform(0.5, 2)), random_pose(rng, 0.2), drawn.tolist()


def facing(rng, normal, place):
    """A frame at a place, turned at random, and in it the axis along a normal of the model."""
    turn = Rotation.random(random_state=rng)
    return pose(turn, place), turn.inv().apply(normal)


def planar(rng, pins):
    """A closed polygon of bars, the first of which is the ground, in a plane at random."""
    drawn = Drawn(random_pose(rng))
    plane = Rotation.random(random_state=rng)
    normal = plane.apply([0.0, 1.0, 0.0])
    bodies = ["world", *(f"l{i}" for i in range(1, len(pins)))]
    for name in bodies[1:]:
        drawn.links[name] = link(rng)
    for i, (x, z) in enumerate(pins):
        place, axis = facing(rng, normal, plane.apply([x, rng.uniform(-0.1, 0.1), z]))
        ends = bodies[i], bodies[(i + 1) % len(pins)]
        if i > len(pins) // 2:  # from the ground on, too
            ends, axis = ends[::-1], -axis
        drawn.joints[f"j{i}"] = ("revolute", *ends, place, [axis])
    drawn.surplus = (f"j{len(pins) // 2}",)
    return drawn


def stewart(rng, legs=6):
    """A platform on legs of a universal joint, a slide and a ball each."""
    drawn = Drawn(random_pose(rng))
    drawn.links["platform"] = link(rng)
    for i in range(legs):
        low, high = (np.array([r * np.cos(a), r * np.sin(a), z]) for r, a, z in (
            (1.0, 2 * np.pi * (i // 2 * 2 + (i % 2) * 0.4) / legs + rng.uniform(0, 0.1), 0.0),
            (0.6, 2 * np.pi * (i // 2 * 2 + (i % 2) * 1.6 - 0.6) / legs, 1.0)))  # fmt: skip
        along = (high - low) / np.linalg.norm(high - low)
        drawn.links[f"barrel{i}"], drawn.links[f"rod{i}"] = link(rng), link(rng)
        first = np.cross(along, rng.normal(size=3))
        first /= np.linalg.norm(first)
        foot, axis = facing(rng, first, low)
        second = foot[:3, :3].T @ np.cross(along, first)
        slide, direction = facing(rng, along, low + 0.4 * (high - low))
        drawn.joints |= {
            f"foot{i}": ("universal", "world", f"barrel{i}", foot, [axis, second]),
            f"slide{i}": ("prismatic", f"barrel{i}", f"rod{i}", slide, [direction]),
            f"ball{i}": ("ball", f"rod{i}", "platform", facing(rng, along, high)[0], []),
        }
    drawn.surplus = tuple(f"ball{i}" for i in range(1, legs))
    return drawn


def numbers(values):
    return " ".join(repr(float(x)) for x in np.ravel(values))


def pose_text(rng, x, relative="", modern=True):
    """`<pose>` of a pose, with its angles in any of the ways that SDF has."""
    turn = Rotation.from_matrix(x[:3, :3])
    way = rng.integers(3) if modern else 0
    attributes = f' relative_to="{relative}"' if relative else ""
    if way == 1:
        angles = turn.as_euler("xyz", degrees=True)
        attributes += ' degrees="true"'
    elif way == 2:
        angles = turn.as_quat()
        attributes += ' rotation_format="quat_xyzw"'
    else:
        angles = turn.as_euler("xyz")
    return f"<pose{attributes}>{numbers(x[:3, 3])} {numbers(angles)}</pose>"


class SdfWriter:
    """Writes a drawn mechanism, each pose relative to something that comes before it."""

    def __init__(self, rng, drawn, version, reverse=0.4):
        self.rng, self.drawn, self.version, self.reverse = rng, drawn, version, reverse
        self.modern = version >= 7
        self.known = {"__model__": np.eye(4)}

    def relative(self, x, default="__model__", default_pose=None):
        """A pose relative to some known frame, or by default."""
        base = np.eye(4) if default_pose is None else default_pose
        if not self.modern or self.rng.random() < 0.3:
            return pose_text(self.rng, inverse(base) @ x, modern=self.modern)
        name = str(self.rng.choice(list(self.known)))
        return pose_text(self.rng, inverse(self.known[name]) @ x, name)

    def link(self, name):
        x, mass, com, (ixx, iyy, izz) = self.drawn.links[name]
        text = (
            f'<link name="{name}">{self.relative(x)}<inertial>'
            f"{pose_text(self.rng, com, modern=self.modern)}<mass>{mass!r}</mass><inertia>"
            f"<ixx>{ixx!r}</ixx><iyy>{iyy!r}</iyy><izz>{izz!r}</izz></inertia></inertial></link>"
        )
        self.known[name] = x
        return text

    def frame(self, name):
        x, attached = self.drawn.frames[name]
        text = (
            f'<frame name="{name}" attached_to="{attached}">'
            f"{self.relative(x, attached, self.drawn.links[attached][0])}</frame>"
        )
        self.known[name] = x
        return text

    def axis(self, tag, direction, x):
        """An axis in the joint's frame, in another, or in the model's as of old."""
        if self.version <= 4:
            return f"<{tag}><xyz>{numbers(x[:3, :3] @ direction)}</xyz></{tag}>"
        if not self.modern:
            if self.rng.random() < 0.5:
                return f"<{tag}><xyz>{numbers(direction)}</xyz></{tag}>"
            return (
                f"<{tag}><xyz>{numbers(x[:3, :3] @ direction)}</xyz>"
                f"<use_parent_model_frame>1</use_parent_model_frame></{tag}>"
            )
        if self.rng.random() < 0.4:
            return f"<{tag}><xyz>{numbers(direction)}</xyz></{tag}>"
        name = str(self.rng.choice(list(self.known)))
        said = self.known[name][:3, :3].T @ x[:3, :3] @ direction
        return f'<{tag}><xyz expressed_in="{name}">{numbers(said)}</xyz></{tag}>'

    def joint(self, name):
        kind, parent, child, x, axes = self.drawn.joints[name]
        if kind == "continuous" and self.version < 8:
            kind = "revolute"
        axes = list(axes)
        if (
            "world" not in (parent, child)
            and kind in ("revolute", "prismatic")
            and self.rng.random() < self.reverse
        ):
            parent, child = child, parent  # the same coordinate about the axis turned round
            axes = [-axis for axis in axes]
        text = f'<joint name="{name}" type="{kind}"><parent>{parent}</parent>'
        text += f"<child>{child}</child>"
        text += self.relative(x, child, self.drawn.links[child][0])
        if kind not in ("fixed", "ball"):
            text += self.axis("axis", axes[0], x)
        if kind == "universal":
            text += self.axis("axis2", axes[1], x)
        self.known[name] = x
        return text + "</joint>"

    def text(self):
        body = [self.link(name) for name in self.drawn.links]
        if self.modern:
            body += [self.frame(name) for name in self.drawn.frames]
        body += [self.joint(name) for name in self.drawn.joints]
        self.rng.shuffle(body)
        head = pose_text(self.rng, self.drawn.model, modern=self.modern)
        lines = "\n".join([head, *body])
        return f'<sdf version="1.{self.version}"><model name="drawn">\n{lines}\n</model></sdf>\n'


def origin(x):
    angles = Rotation.from_matrix(x[:3, :3]).as_euler("xyz")
    return f'<origin xyz="{numbers(x[:3, 3])}" rpy="{numbers(angles)}"/>'


def urdf(drawn):
    """The same as URDF, each link in the frame of the joint that moves it."""
    lines = ['<robot name="drawn"><link name="world"/>']
    above = {"world": inverse(drawn.model)}
    tree = {name: x for name, x in drawn.joints.items() if name not in drawn.surplus}
    for kind, _, child, x, _ in tree.values():
        if kind == "universal":
            lines.append(f'<link name="{child}_middle" between="{child}"/>')
        place, mass, com, (ixx, iyy, izz) = drawn.links[child]
        lines.append(
            f'<link name="{child}"><inertial>{origin(inverse(x) @ place @ com)}'
            f'<mass value="{mass!r}"/><inertia ixx="{ixx!r}" iyy="{iyy!r}" izz="{izz!r}" ixy="0" '
            'ixz="0" iyz="0"/></inertial></link>'
        )
        above[child] = x
    for name in drawn.surplus:
        kind, parent, child, x, axes = drawn.joints[name]
        axis = f'<axis xyz="{numbers(axes[0])}"/>' if axes else ""
        style = {"ball": "spherical"}.get(kind, kind)
        ends = "".join(
            f'<{tag} link="{body}">{origin(inverse(above[body]) @ x)}</{tag}>'
            for tag, body in (("predecessor", parent), ("successor", child))
        )
        lines.append(f'<loop name="{name}" type="{style}">{ends}{axis}</loop>')
    for name, (kind, parent, child, x, axes) in tree.items():
        place = origin(inverse(above[parent]) @ x)
        if kind == "ball":
            lines.append(
                f'<joint name="{name}" type="spherical"><parent link="{parent}"/>'
                f'<child link="{child}"/>{place}</joint>'
            )
            continue
        steps = [(name, kind, parent, child, place, axes[0])]
        if kind == "universal":
            steps = [
                (f"{name}_1", "revolute", parent, f"{child}_middle", place, axes[0]),
                (f"{name}_2", "revolute", f"{child}_middle", child, "", axes[1]),
            ]
        for label, style, one, two, where, axis in steps:
            style = "continuous" if style == "revolute" else style
            limit = '<limit lower="-1e9" upper="1e9" effort="1e9" velocity="1e9"/>'
            lines.append(
                f'<joint name="{label}" type="{style}"><parent link="{one}"/>'
                f'<child link="{two}"/>{where}<axis xyz="{numbers(axis)}"/>'
                f"{limit if style == 'prismatic' else ''}</joint>"
            )
    return "\n".join([*lines, "</robot>"])
