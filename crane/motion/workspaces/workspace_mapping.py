"""Computation of a workspace from patches of configurations over the strokes."""

import itertools
from collections.abc import Iterator

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array, as_count, as_seed
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces.section_shapes import (
    branch_edges,
    covered_triangles,
    patch_curves,
    singular_curves,
)
from crane.motion.workspaces.workspace_extremes import workspace_extremes
from crane.motion.workspaces.workspace_patch import (
    WorkspacePatch,
    fill_patch,
    last_closed_configuration,
)
from crane.motion.workspaces.workspace_result import (
    CoverageRaster,
    StrokeMap,
    Workspace,
)
from crane.motion.workspaces.workspace_section import (
    WorkspaceKinematics,
    find_slewing_joint,
    workspace_section,
)

_MAX_SAMPLES = 1_000_000  # configurations
# derivative of the tip by a joint, per characteristic length, that counts as motion
_MOTION_TOLERANCE = 1e-9
_MAX_GRID_JOINTS = 3  # joints of a regular grid
_MAP_VALUES = 81  # values of each stroke of the stroke map
_SLICE_COUNT = 9  # values of the third of three strokes
_RANDOM_PATCH_VALUES = 16  # values of both strokes of a random patch
_INTERIOR_SHARE = 0.5  # share of random patches in the interior of the box


# indices of both strokes, coordinates (n,) of the others, number of values of each stroke, and
# whether the patch contributes to the share of the box that closes
_PlannedPatch = tuple[tuple[int, int], Array, int, bool]


def workspace(
    machine: Machine, samples: int = 10_000, frame: str | None = None, seed: int = 0
) -> Workspace:
    """Compute the workspace of a frame of a machine.

    The strokes are those of active joints that move loops or the tip, within their limits (without
    limits pi to both sides of home); limits of passive joints are neglected. Up to three strokes
    give a regular grid. More strokes give patches over pairs of them, with the others at random
    values, half of them at their limits: such a workspace is a part of the true one. A joint that
    slews the whole machine is held at home, see `WorkspaceSection`.

    Args:
        machine: The machine.
        samples: Approximate number of configurations.
        frame: Name of a link; default the tip of the machine.
        seed: Seed of the random values.

    Raises:
        InputError: There are fewer than 100 samples or more than a million, the frame is unknown,
            there is no tip, or no driven joint moves the frame.
    """
    samples, seed = as_count(samples, "the number of samples", 100, _MAX_SAMPLES), as_seed(seed)
    kinematics = Kinematics(machine, frame)
    lower, upper = stroke_limits(machine)
    random = np.random.default_rng(seed)
    slewing_joint = find_slewing_joint(machine, kinematics.frame)
    held_joint = None if slewing_joint is None else slewing_joint[0]
    strokes = moving_strokes(machine, kinematics, lower, upper, held_joint, random)
    if not strokes:
        raise InputError(f"no driven joint moves '{kinematics.frame}', name another frame")
    patches, counted_patches = _create_patches(machine, strokes, lower, upper, samples, random)
    q = np.concatenate([patch.configurations[patch.is_closed] for patch in patches])
    tips = kinematics.positions_at_configurations(q)
    home = kinematics.position_at_configuration(machine.home)
    section = workspace_section(machine, kinematics.frame, tips, home)
    section_positions = section.coordinates(tips)
    workspace_kinematics = WorkspaceKinematics(
        machine, kinematics, section, strokes, float(np.ptp(section_positions, axis=0).max())
    )
    condition, least_singular_value = workspace_kinematics.condition_measures(q, tips)
    branch_edges_by_patch = [branch_edges(machine, patch) for patch in patches]
    patch_counts = np.cumsum([patch.is_closed.sum() for patch in patches])[:-1]
    triangles_by_patch = [
        covered_triangles(workspace_kinematics, patch, positions, patch_edges)
        for patch, positions, patch_edges in zip(
            patches,
            np.split(section_positions, patch_counts),
            branch_edges_by_patch,
            strict=True,
        )
    ]
    raster = CoverageRaster(
        np.concatenate([section_positions, *(part.reshape(-1, 2) for part in triangles_by_patch)])
    )
    for patch_triangles in triangles_by_patch:
        raster.cover(patch_triangles)
    curves = singular_curves(workspace_kinematics, patches, branch_edges_by_patch, (lower, upper))
    closed_share = _closed_share(
        [patches[i] for i in counted_patches], len(strokes) == _MAX_GRID_JOINTS
    )
    map_patch, map_curves = patches[0], curves
    if len(strokes) > 2:
        jacobian = workspace_kinematics.scaled_tip_jacobian(q, tips, machine.closure.gamma(q))
        tip_speeds = np.linalg.norm(jacobian / workspace_kinematics.stroke_scales, axis=1)
        displacements = tip_speeds.mean(axis=0) * (upper - lower)[strokes]
        map_patch = _map_patch(machine, strokes, displacements, lower, upper)
        edges = branch_edges(machine, map_patch)
        map_curves = patch_curves(workspace_kinematics, map_patch, edges)
    map_values = np.full((2, *map_patch.is_closed.shape), np.nan)
    map_q = map_patch.configurations[map_patch.is_closed]
    map_values[:, map_patch.is_closed] = workspace_kinematics.condition_measures(
        map_q, workspace_kinematics.tip_positions(map_q)
    )
    spread = np.linalg.svd(section_positions - section_positions.mean(axis=0), compute_uv=False)
    is_two_dimensional = len(strokes) > 1 and spread[-1] > 1e-6 * spread[0]
    return Workspace(
        machine=machine,
        frame=kinematics.frame,
        section=section,
        strokes=tuple(machine.active[i] for i in strokes),
        lower=lower,
        upper=upper,
        q_a=q[:, machine.closure.active],
        tip_positions=tips,
        section_positions=section_positions,
        condition=condition,
        least_singular_value=least_singular_value,
        closed_share=closed_share,
        area=raster.area if is_two_dimensional else 0.0,
        extremes=workspace_extremes(
            workspace_kinematics, q, section_positions, (lower, upper), curves
        ),
        curves=tuple(curves),
        patches=tuple(patches),
        stroke_map=StrokeMap(map_patch, map_values[0], map_values[1], tuple(map_curves)),
        raster=raster,
        is_complete=len(strokes) <= _MAX_GRID_JOINTS,
    )


def _map_patch(
    machine: Machine, strokes: list[int], displacements: Array, lower: Array, upper: Array
) -> WorkspacePatch:
    """Patch over the two strokes with the largest displacements (d,) of the tip."""
    first, second = sorted(strokes[int(i)] for i in np.argsort(displacements)[-2:])
    axes = tuple(np.linspace(lower[i], upper[i], _MAP_VALUES) for i in (first, second))
    patch = fill_patch(
        machine, machine.home[machine.closure.active], (first, second), (axes[0], axes[1])
    )
    assert patch is not None, "home itself closes"
    return patch


def stroke_limits(machine: Machine, half_turn: float = np.pi) -> tuple[Array, Array]:
    """Limits of the active joints; without limits half a turn, or the characteristic length, off.

    Args:
        machine: The machine.
        half_turn: Distance from home of a missing limit of a joint that turns [rad].
    """
    home = machine.home[machine.closure.active]
    units = machine.closure.units[machine.closure.active]
    half_range = np.where(
        machine.coordinates.is_translation[machine.closure.active], units, half_turn
    )
    return (
        np.where(np.isfinite(machine.lower), machine.lower, home - half_range),
        np.where(np.isfinite(machine.upper), machine.upper, home + half_range),
    )


def moving_strokes(
    machine: Machine,
    kinematics: Kinematics,
    lower: Array,
    upper: Array,
    held_joint: int | None,
    random: np.random.Generator,
) -> list[int]:
    """Indices of driven joints that move the frame or the loops, without the slewing joint."""
    closure = machine.closure
    targets = [random.uniform(lower, upper) for _ in range(8)]
    configurations = [last_closed_configuration(machine, machine.home, x)[0] for x in targets]
    units = closure.units[closure.active] / closure.characteristic_length
    tip_derivatives = [
        kinematics.tree_jacobian(q) @ closure.gamma(q) * units
        for q in (machine.home, *configurations)
    ]
    tip_motion = np.abs(tip_derivatives).max(axis=(0, 1))
    is_coupled = np.abs(closure.gamma(machine.home)[closure.passive]).max(axis=0, initial=0.0) > 0
    tip_motion[~machine.is_driven] = 0.0
    if not tip_motion.max() > _MOTION_TOLERANCE:
        return []
    is_relevant = machine.is_driven & ((tip_motion > _MOTION_TOLERANCE) | is_coupled)
    return [int(i) for i in np.flatnonzero(is_relevant) if i != held_joint]


def _create_patches(
    machine: Machine,
    strokes: list[int],
    lower: Array,
    upper: Array,
    samples: int,
    random: np.random.Generator,
) -> tuple[list[WorkspacePatch], list[int]]:
    """Patches over the strokes, and indices of those that count for the closed share."""
    home = machine.home[machine.closure.active]
    planned: list[_PlannedPatch]
    if len(strokes) <= 2:
        size = min(samples, 2001) if len(strokes) == 1 else int(samples**0.5)
        planned = [((strokes[0], strokes[-1]), home.copy(), size, True)]
    elif len(strokes) == _MAX_GRID_JOINTS:
        planned = list(_sliced_patches(home, strokes, lower, upper, samples))
    else:
        planned = list(_random_patches(home, strokes, lower, upper, samples, random))
    patches: list[WorkspacePatch] = []
    for pair, base, size, _ in planned:
        first_values, second_values = (
            np.linspace(lower[joint], upper[joint], size) for joint in pair
        )
        axes = first_values, home[strokes] if len(strokes) == 1 else second_values
        shape = len(axes[0]), len(axes[1])
        q = np.full((*shape, machine.model.nv), np.nan)
        none_closed = WorkspacePatch(pair, base, axes, np.zeros(shape, dtype=bool), q)
        patches.append(fill_patch(machine, base, pair, axes) or none_closed)
    return patches, [k for k, (*_, counts_for_share) in enumerate(planned) if counts_for_share]


def _sliced_patches(
    home: Array, strokes: list[int], lower: Array, upper: Array, samples: int
) -> Iterator[_PlannedPatch]:
    """Every pair of three strokes, at values of the third over its whole range."""
    count = max(5, round((samples / _SLICE_COUNT) ** 0.5))
    for pair in itertools.combinations(strokes, 2):
        (other,) = set(strokes) - set(pair)
        for value in np.linspace(lower[other], upper[other], _SLICE_COUNT):
            base = home.copy()
            base[other] = value
            yield pair, base, count, pair == (strokes[0], strokes[1])


def _random_patches(
    home: Array,
    strokes: list[int],
    lower: Array,
    upper: Array,
    samples: int,
    random: np.random.Generator,
) -> Iterator[_PlannedPatch]:
    """Pairs of strokes through home, then with the others at random values or limits."""
    pairs = list(itertools.combinations(strokes, 2))
    for pair in pairs:
        yield pair, home.copy(), _RANDOM_PATCH_VALUES, False
    for k in range(max(len(pairs), 4 * samples // _RANDOM_PATCH_VALUES**2)):
        base, random_values = home.copy(), random.uniform(lower, upper)
        is_interior = random.random() < _INTERIOR_SHARE
        if not is_interior:
            random_values = np.where(random.random(len(lower)) < 0.5, lower, upper)
        base[strokes] = random_values[strokes]
        yield pairs[k % len(pairs)], base, _RANDOM_PATCH_VALUES, is_interior


def _closed_share(patches: list[WorkspacePatch], is_sliced: bool) -> float:
    """Share of the box of strokes that closes; nodes on its faces count half."""
    closed = total = 0.0
    for k, patch in enumerate(patches):
        is_face = is_sliced and k in (0, len(patches) - 1)
        weights: Array = np.full(patch.is_closed.shape, 0.5 if is_face else 1.0)
        weights[[0, -1]] *= 0.5
        if weights.shape[1] > 1:  # more than one stroke
            weights[:, [0, -1]] *= 0.5
        closed += float(weights[patch.is_closed].sum())
        total += float(weights.sum())
    return closed / total if total else 0.0
