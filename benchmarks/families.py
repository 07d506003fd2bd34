"""Generate machines of any number of joints: chains, trees and rings, closed at zero.

`chain`: four-bars in space, each on the rocker or the coupler of the one before, on a slewing
column. `tree`: a trunk of four-bars, each with a chain of about as many four-bars as branch.
`ring`: one large loop of revolute joints in a vertical plane; `spatial ring`: one with arbitrary
axes.

Dimensions, masses and inertias are random, the same ones for the same family and size. All
machines are written as URDF with `<loop>` elements and named active joints.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pinocchio as pin

FAMILIES = {"chain": 4, "tree": 4, "ring": 3, "spatial ring": 6}  # and their fewest joints
TURN = 3  # four-bars in a plane, before the next ones turn out of it by 90 degrees
DRAWS = 50  # of axes of a ring
Array = np.ndarray


def write(family: str, joints: int, folder: Path) -> Path:
    """Write a machine.

    Args:
        family: One of `FAMILIES`.
        joints: How many joints its tree has at most; a chain and a tree have 3 k + 1 of them.
        folder: Where to.

    Returns:
        The file.

    Raises:
        ValueError: There is none of so few joints.
    """
    if joints < FAMILIES[family]:
        raise ValueError(f"a {family} has {FAMILIES[family]} joints or more")
    random = np.random.default_rng([list(FAMILIES).index(family), joints])
    urdf = Urdf(f"{family.replace(' ', '_')}_{joints}", random)
    if family in ("chain", "tree"):
        _four_bars(urdf, list(_places(family, (joints - 1) // 3)))
    else:
        _ring(urdf, joints, family == "spatial ring")
    path = folder / f"{urdf.name}.urdf"
    path.write_text(urdf.text, encoding="utf-8")
    return path


class Urdf:
    """A URDF with loops as it grows.

    Args:
        name: Of the robot.
        random: Of masses.
    """

    def __init__(self, name: str, random: np.random.Generator):
        self.name, self.random = name, random
        self._lines = [f'<robot name="{name}">', '<link name="ground"/>']

    @property
    def text(self) -> str:
        """The whole file."""
        return "\n".join([*self._lines, "</robot>", ""])

    def body(
        self, name: str, parent: str, place: pin.SE3, length: float, active: bool, heavy: float = 1
    ) -> None:
        """A body along its x, turning about its y on another.

        Args:
            name: Of link and joint.
            parent: Link that carries it.
            place: Of its frame in that of the parent, at zero.
            length: [m].
            active: Whether the joint is.
            heavy: Factor of its mass.
        """
        draw = self.random
        mass = heavy * length * draw.uniform(8, 12)
        com = length * np.array([draw.uniform(0.4, 0.6), *draw.uniform(-0.05, 0.05, 2)])
        extent = (length * np.array([0.4, *draw.uniform(0.1, 0.2, 2)])) ** 2
        turn = pin.rpy.rpyToMatrix(*draw.uniform(-0.2, 0.2, 3))
        tensor = turn @ np.diag(mass * (extent.sum() - extent)) @ turn.T
        entries = " ".join(
            f'i{"xyz"[i]}{"xyz"[k]}="{float(tensor[i, k])!r}"'
            for i in range(3)
            for k in range(i, 3)
        )
        self._lines.append(
            f'<joint name="{name}" type="continuous" independent="{str(active).lower()}">'
            f'{_origin(place)}<parent link="{parent}"/><child link="{name}"/><axis xyz="0 1 0"/>'
            f'</joint>\n<link name="{name}"><inertial><origin xyz="{_numbers(com)}"/>'
            f'<mass value="{float(mass)!r}"/><inertia {entries}/></inertial></link>'
        )

    def pin(self, name: str, one: tuple[str, pin.SE3], two: tuple[str, pin.SE3]) -> None:
        """A revolute loop about y of two frames, each a link and a place on it."""
        ends = "".join(
            f'<{end} link="{link}">{_origin(place)}</{end}>'
            for end, (link, place) in zip(("predecessor", "successor"), (one, two), strict=True)
        )
        self._lines.append(f'<loop name="{name}" type="revolute">{ends}<axis xyz="0 1 0"/></loop>')


def _places(family: str, size: int) -> Iterator[int]:
    """The four-bar that each one stands on, -1 for the column."""
    trunk = size if family == "chain" else math.isqrt(size)
    for i in range(size):
        branch, along = divmod(i - trunk, max(1, math.ceil((size - trunk) / trunk)))
        yield i - 1 if i < trunk or along else branch


def _four_bars(urdf: Urdf, below: list[int]) -> None:
    """A column that slews, and four-bars, each on the column or on an earlier one."""
    upright = pin.SE3(pin.utils.rotate("x", np.pi / 2), np.zeros(3))  # y along the world's z
    urdf.body("column", "ground", upright, 0.5, True)
    feet = [("column", upright.inverse() * _shift(0, 0.5))]
    high = [0]
    for i, under in enumerate(below):
        high.append(high[under + 1] + 1)
        parent, place = feet[under + 1]
        if high[-1] % TURN == 0:  # out of the plane, about the way upwards
            place = place * pin.SE3(pin.utils.rotate("z", np.pi / 2), np.zeros(3))
        feet.append(_four_bar(urdf, i, parent, place, 0.97 ** high[-1]))


def _four_bar(urdf: Urdf, i: int, parent: str, place: pin.SE3, size: float) -> tuple[str, pin.SE3]:
    """Four-bar i in the plane of x and z at a place on its parent; where the next one stands.

    The crank is driven. Coupler and rocker meet at about 90 degrees, so that it is well led.
    """
    draw = urdf.random
    wide, crank, rocker = size * draw.uniform((0.35, 0.25, 0.3), (0.45, 0.35, 0.45))
    one, two = draw.uniform(1.3, 1.9), draw.uniform(1.2, 1.8)  # angles from x to z
    head = np.array([wide, 0]) + rocker * np.array([np.cos(two), np.sin(two)])
    way = head - crank * np.array([np.cos(one), np.sin(one)])
    coupler, turn = float(np.hypot(*way)), float(np.arctan2(way[1], way[0]))
    names = [f"{part}{i}" for part in ("crank", "coupler", "rocker")]
    urdf.body(names[0], parent, place * _turn(one), crank, True)
    urdf.body(names[1], names[0], _shift(crank, 0) * _turn(turn - one), coupler, False)
    urdf.body(names[2], parent, place * _shift(wide, 0) * _turn(two), rocker, False, 2)
    urdf.pin(f"pin{i}", (names[1], _shift(coupler, 0)), (names[2], _shift(rocker, 0)))
    if i % 4 == 2:  # on the coupler, whose x points forward
        return names[1], _shift(coupler / 2, 0)
    return names[2], _shift(rocker, 0) * _turn(-two)


def _ring(urdf: Urdf, joints: int, spatial: bool) -> None:
    """A loop of so many bodies from the ground to the ground.

    Its passive joints lie apart from each other: two in a plane, five in space, whose axes are
    the least dependent ones of some that are drawn.
    """
    draw, passive = urdf.random, 5 if spatial else 2
    angles = np.linspace(np.pi, -np.pi, joints + 1, endpoint=False)
    angles += draw.uniform(-0.2, 0.2, joints + 1) / joints
    radius = 0.08 * (joints + 1)
    points = radius * np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    if spatial:
        points[:, 1] = draw.uniform(-0.3, 0.3, joints + 1)
    led = [int((k + 0.5) * joints / passive) for k in range(passive)]
    drawn = [_frames(points, spatial * draw.uniform(-1.2, 1.2, joints + 1)) for _ in range(DRAWS)]
    frames = min(drawn, key=lambda frames: _dependence([frames[k] for k in (*led, -1)], radius))
    parent, below = "ground", pin.SE3.Identity()
    for i, (frame, far) in enumerate(zip(frames[:-1], points[1:], strict=True)):
        length = float(np.linalg.norm(far - frame.translation))
        urdf.body(f"body{i}", parent, below.inverse() * frame, length, i not in led)
        parent, below = f"body{i}", frame
    urdf.pin("clasp", (parent, below.inverse() * frames[-1]), ("ground", frames[-1]))


def _frames(points: Array, tilts: Array) -> list[pin.SE3]:
    """At every point of a ring, x to the next one, or at the last one from that before it."""
    ways = np.diff(points, axis=0)
    ways = np.vstack([ways, ways[-1:]])
    return [
        pin.SE3(_frame(way, tilt), point)
        for way, tilt, point in zip(ways, tilts, points, strict=True)
    ]


def _dependence(frames: list[pin.SE3], size: float) -> float:
    """Condition number of the screws of all y, lengths by the size [m]."""
    axes = [(frame.rotation[:, 1], frame.translation / size) for frame in frames]
    return float(np.linalg.cond([np.hstack([y, np.cross(at, y)]) for y, at in axes]))


def _frame(way: Array, turn: float) -> Array:
    """A rotation whose x points along a way, its y about along the world's, turned about x."""
    x = way / np.linalg.norm(way)
    z = np.cross(x, [0, 1, 0])
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1) @ pin.utils.rotate("x", turn)


def _turn(angle: float) -> pin.SE3:
    """A turn from x to z."""
    return pin.SE3(pin.utils.rotate("y", -angle), np.zeros(3))


def _shift(x: float, z: float) -> pin.SE3:
    return pin.SE3(np.eye(3), np.array([x, 0, z]))


def _origin(place: pin.SE3) -> str:
    turn = pin.rpy.matrixToRpy(place.rotation)
    return f'<origin xyz="{_numbers(place.translation)}" rpy="{_numbers(turn)}"/>'


def _numbers(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
