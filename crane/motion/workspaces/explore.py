"""Exploring a workspace: patches over the strokes, and what is measured on them."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError
from crane.common.samples import Array, as_count, as_seed
from crane.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces.cover import triangles
from crane.motion.workspaces.curves import branch_edges, curves_of, singular_curves
from crane.motion.workspaces.extremes import extremes
from crane.motion.workspaces.patch import Patch, fill, last_closed
from crane.motion.workspaces.probe import Probe
from crane.motion.workspaces.raster import Raster
from crane.motion.workspaces.result import StrokeMap, Workspace
from crane.motion.workspaces.section import section_of, slewing

_MOST = 1_000_000  # postures
_MOVES = 1e-9  # slope of a tip that a joint moves, in shares of the machine's size
_FULL = 3  # joints that a regular grid is made of
_MAP = 81  # values of each stroke of the map
_SLICES = 9  # values of the third of three strokes
_DRAWN = 16  # values of both strokes of a patch that is drawn
_INNER = 0.5  # share of patches of many joints that do not lie on limits


class _Planned(NamedTuple):
    """A patch to be filled; see `Patch`.

    Attributes:
        pair: Indices of both strokes.
        base: (n,) where the others are held.
        size: Values of each stroke.
        counts: Whether it counts for the share of the box that closes.
    """

    pair: tuple[int, int]
    base: Array
    size: int
    counts: bool


def workspace(
    machine: Machine, samples: int = 10_000, frame: str | None = None, seed: int = 0
) -> Workspace:
    """Map where a machine's strokes take its tip, and where its loops do not close.

    The strokes are those of active joints that move loops or the tip, within their limits (half a
    turn to both sides of home without); passive joints have no limits here. Up to three of them
    give a regular grid; of more, patches over two of them each, the others drawn at random, half
    of them at their limits: what such a workspace covers is within the true one. A joint that
    slews the whole machine is held at home, see `Section`.

    Args:
        machine: The machine.
        samples: About how many postures.
        frame: A link; the machine's tip if not given.
        seed: Of what is drawn.

    Raises:
        InputError: Fewer than 100 samples or more than a million, an unknown frame, no tip, or a
            frame that no driven joint moves.
    """
    samples, seed = as_count(samples, "the number of samples", 100, _MOST), as_seed(seed)
    kinematics = Kinematics(machine, frame)
    low, high = limits_of(machine)
    random = np.random.default_rng(seed)
    slew = slewing(machine, kinematics.frame)
    held = None if slew is None else slew[0]
    strokes = strokes_of(machine, kinematics, low, high, held, random)
    if not strokes:
        raise InputError(f"no driven joint moves '{kinematics.frame}', name another frame")
    patches, counted = _patches(machine, strokes, low, high, samples, random)
    q = np.concatenate([patch.q[patch.closed] for patch in patches])
    tips = kinematics.positions(q)
    home = kinematics.position_at(machine.home)
    section = section_of(machine, kinematics.frame, tips, home)
    places = section.coordinates(tips)
    probe = Probe(machine, kinematics, section, strokes, float(np.ptp(places, axis=0).max()))
    condition, least = probe.at(q, tips)
    edges = [branch_edges(machine, patch) for patch in patches]
    covered = [
        triangles(probe, patch, here, ends)
        for patch, here, ends in zip(patches, _split(patches, places), edges, strict=True)
    ]
    raster = Raster(np.concatenate([places, *(part.reshape(-1, 2) for part in covered)]))
    for part in covered:
        raster.cover(part)
    curves = singular_curves(probe, patches, edges, (low, high))
    share = _share([patches[i] for i in counted], len(strokes) == _FULL)
    if len(strokes) > 2:
        slopes = probe.slopes(q, tips, machine.closure.gamma(q)) / probe.scale_of_strokes
        moves = np.linalg.norm(slopes, axis=1).mean(axis=0) * (high - low)[strokes]
        one, two = sorted(strokes[int(i)] for i in np.argsort(moves)[-2:])
        axes = tuple(np.linspace(low[i], high[i], _MAP) for i in (one, two))
        main = fill(machine, machine.home[machine.closure.active], (one, two), (axes[0], axes[1]))
        assert main is not None, "home itself closes"
        inside = curves_of(probe, main, branch_edges(machine, main))
    else:
        main, inside = patches[0], curves
    shown = np.full((2, *main.closed.shape), np.nan)
    here = main.q[main.closed]
    shown[:, main.closed] = probe.at(here, probe.tips(here))
    return Workspace(
        machine=machine,
        frame=kinematics.frame,
        section=section,
        strokes=tuple(machine.active[i] for i in strokes),
        low=low,
        high=high,
        q_a=q[:, machine.closure.active],
        tips=tips,
        places=places,
        condition=condition,
        least=least,
        share=share,
        area=raster.area if len(strokes) > 1 and _spread(places) else 0.0,
        extremes=extremes(probe, q, places, (low, high), curves),
        curves=tuple(curves),
        patches=tuple(patches),
        stroke_map=StrokeMap(main, shown[0], shown[1], tuple(inside)),
        raster=raster,
        complete=len(strokes) <= _FULL,
    )


def limits_of(machine: Machine) -> tuple[Array, Array]:
    """Limits of the active joints; half a turn, or the joint's scale, from home without."""
    home = machine.home[machine.closure.active]
    units = machine.closure.units[machine.closure.active]
    half = np.where(machine.coordinates.slides[machine.closure.active], units, np.pi)
    return (
        np.where(np.isfinite(machine.lower), machine.lower, home - half),
        np.where(np.isfinite(machine.upper), machine.upper, home + half),
    )


def strokes_of(
    machine: Machine,
    kinematics: Kinematics,
    low: Array,
    high: Array,
    held: int | None,
    random: np.random.Generator,
) -> list[int]:
    """Driven joints that move the frame or open loops, the slewing joint left out."""
    closure = machine.closure
    postures = [machine.home]
    for _ in range(8):
        postures.append(last_closed(machine, machine.home, random.uniform(low, high))[0])
    moves = np.zeros(len(machine.active))
    units = closure.units[closure.active] / closure.size
    for q in postures:
        gamma = closure.gamma(q)
        slopes = np.abs(kinematics.tree_jacobian(q) @ gamma * units).max(axis=0)
        moves = np.maximum(moves, slopes)
    coupled = np.abs(closure.gamma(machine.home)[closure.passive]).max(axis=0, initial=0.0) > 0
    moves[~machine.driven] = 0.0
    linked = [i for i in np.flatnonzero(machine.driven) if moves[i] > _MOVES or coupled[i]]
    return [int(i) for i in linked if i != held] if moves.max() > _MOVES else []


def _patches(
    machine: Machine,
    strokes: list[int],
    low: Array,
    high: Array,
    samples: int,
    random: np.random.Generator,
) -> tuple[list[Patch], list[int]]:
    """Patches over the strokes, and which of them count for the share of the box that closes."""
    home = machine.home[machine.closure.active]
    if len(strokes) == 1:
        axis = np.linspace(low[strokes[0]], high[strokes[0]], min(samples, 2001))
        patch = fill(machine, home.copy(), (strokes[0], strokes[0]), (axis, home[strokes]))
        assert patch is not None, "home itself closes"
        return [patch], [0]
    if len(strokes) == 2:
        planned = [_Planned((strokes[0], strokes[1]), home.copy(), int(samples**0.5), True)]
    elif len(strokes) == _FULL:
        planned = list(_sliced(home, strokes, low, high, samples))
    else:
        planned = list(_drawn(home, strokes, low, high, samples, random))
    patches: list[Patch] = []
    for pair, base, size, _ in planned:
        first, second = (np.linspace(low[joint], high[joint], size) for joint in pair)
        patch = fill(machine, base, pair, (first, second))
        if patch is None:
            nothing: NDArray[np.bool_] = np.zeros((size, size), dtype=bool)
            q = np.full((size, size, machine.model.nv), np.nan)
            patch = Patch(pair, base, (first, second), nothing, q)
        patches.append(patch)
    return patches, [k for k, plan in enumerate(planned) if plan.counts]


def _sliced(
    home: Array, strokes: list[int], low: Array, high: Array, samples: int
) -> Iterator[_Planned]:
    """Every pair of three strokes, at values of the third all over its range."""
    count = max(5, round((samples / _SLICES) ** 0.5))
    for pair in itertools.combinations(strokes, 2):
        (other,) = set(strokes) - set(pair)
        for value in np.linspace(low[other], high[other], _SLICES):
            base = home.copy()
            base[other] = value
            yield _Planned(pair, base, count, pair == (strokes[0], strokes[1]))


def _drawn(
    home: Array,
    strokes: list[int],
    low: Array,
    high: Array,
    samples: int,
    random: np.random.Generator,
) -> Iterator[_Planned]:
    """Pairs of many strokes through home, then with the others drawn: inside, or at limits."""
    pairs = list(itertools.combinations(strokes, 2))
    for pair in pairs:
        yield _Planned(pair, home.copy(), _DRAWN, False)
    for k in range(max(len(pairs), 4 * samples // _DRAWN**2)):
        base, drawn = home.copy(), random.uniform(low, high)
        inside = random.random() < _INNER
        if not inside:
            drawn = np.where(random.random(len(low)) < 0.5, low, high)
        base[strokes] = drawn[strokes]
        yield _Planned(pairs[k % len(pairs)], base, _DRAWN, inside)


def _share(patches: list[Patch], in_order: bool) -> float:
    """Share of the box that closes; nodes on its faces count half."""
    closed = whole = 0.0
    for k, patch in enumerate(patches):
        ends = in_order and k in (0, len(patches) - 1)
        along, across = (_weights(len(values)) for values in patch.axes)
        weights = np.outer(along, across) * (0.5 if ends else 1.0)
        closed, whole = closed + float(weights[patch.closed].sum()), whole + float(weights.sum())
    return closed / whole if whole else 0.0


def _weights(count: int) -> Array:
    """Shares (count,) of the nodes along an axis: half at both ends, one if there is one node."""
    weights = np.ones(count)
    if count > 1:
        weights[[0, -1]] = 0.5
    return weights


def _split(patches: list[Patch], rows: Array) -> list[Array]:
    counts = np.cumsum([patch.closed.sum() for patch in patches])[:-1]
    return np.split(rows, counts)


def _spread(places: Array) -> bool:
    """Whether places (N, 2) fill more than a line."""
    values = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(values[-1] > 1e-6 * values[0])
