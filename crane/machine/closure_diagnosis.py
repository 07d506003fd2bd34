"""Parameters that keep the loops from closing at the home configuration of the file.

If one length of a linkage is wrong, it does not close at the home configuration of its file, or
only far from it. For each length p, with the passive joints q_P, the change that closes the loops
with the joints nearest to their specified coordinates q_S solves

    min |q_P - q_S|^2    such that    phi(q_P, p) = 0

by Newton's method; phi is linear in p, which places a pin. The wrong length leaves the joints at
their specified coordinates, up to rounding of the file; any other length moves them. If the file
specifies no passive joint, the least change that closes the loops is searched for. Home
coordinates of driven joints are tried like lengths.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from crane.closure.constraint_tolerances import FILE_PRECISION
from crane.closure.coordinates import Indices
from crane.closure.loop_equations import LoopEquations
from crane.closure.multi_start_search import closest_approach
from crane.common.samples import Array
from crane.description.kinematic_tree import path_to_root
from crane.description.machine_parameters import tree_parameters, value_at
from crane.description.specification import LoopSpec, MachineSpec
from crane.machine.drive_selection import specified_active_joints
from crane.machine.machine_assembly import assemble_tree

_FREE_WEIGHT = (
    1e-6  # weight of the change of a length, and of joints that the file does not specify
)
_MAX_ITERATIONS, _MAX_CHANGES, _MAX_EVALUATIONS = 25, 6, 30
_MIN_COSINE = 0.1  # least cosine of a length's derivative and the gap that it closes
_MAX_DISTANCE = 0.05  # scaled distance of joints at their specified coordinates
_DISTANCE_RATIO, _ROUNDING = 2.0, 2e-3  # of indecisive distances, and of a home in a file
_MAX_REMEDIES = 2


@dataclass(frozen=True)
class Remedy:
    """A parameter whose change would close the loops.

    Attributes:
        name: As in `crane.description.parameters`, or `home JOINT`.
        value: Its value [m], [rad].
        closing_value: The value that closes the loops.
        is_angle: Whether it is an angle.
    """

    name: str
    value: float
    closing_value: float
    is_angle: bool

    def __str__(self) -> str:
        unit = "rad" if self.is_angle else "m"
        return f"{self.name} {self.closing_value:.4g} {unit} (now {self.value:.4g})"


@dataclass(frozen=True)
class ClosureDiagnosis:
    """A machine that does not close at the home configuration of its file.

    Attributes:
        loop: The loop with the largest gap there.
        gap: The gap [m].
        remedies: Parameters that would close it, the likeliest first; empty if no single one does.
    """

    loop: str
    gap: float
    remedies: tuple[Remedy, ...]

    def __str__(self) -> str:
        gap = f"{self.gap:.3g} m" if self.gap >= 1 else f"{1e3 * self.gap:.3g} mm"
        close = self.remedies_text or "no other length alone"
        loop = f"at the home of the file loop '{self.loop}' is {gap} open"
        return f"{loop}, and would close with {close}"

    @property
    def remedies_text(self) -> str:
        """The remedies as text."""
        return " or ".join(map(str, self.remedies))


def diagnose_closure(spec: MachineSpec, model: pin.Model, guess: Array) -> ClosureDiagnosis | None:
    """Find what keeps a machine from closing at the home configuration of its file.

    Args:
        spec: The machine as read.
        model: Its tree.
        guess: (nq,) home as specified; joints that the file does not specify are moved to the
            smallest gap.

    Returns:
        None if no loop has a gap there.
    """
    equations = LoopEquations(model, spec.loops, spec.couplings)
    names = equations.coordinates.names
    active = [names.index(name) for name in specified_active_joints(spec, model)]
    passive = np.setdiff1d(np.arange(model.nv), active)
    in_loops = (equations.sign != 0).any(axis=0)[passive]
    specified = np.isin(names, list(spec.home))[passive]
    undecided = passive[in_loops & ~specified]
    guess = closest_approach(
        equations, guess, undecided, equations.evaluate_scaled, max_nfev=_MAX_EVALUATIONS
    )
    phi, size = equations.evaluate(guess)[0], equations.characteristic_length
    loop_rows = [
        (equations.loop_of_row == i) & equations.is_translation for i in range(len(spec.loops))
    ]
    gaps = np.array([np.linalg.norm(phi[rows]) for rows in loop_rows])  # [m]
    if not len(gaps) or gaps.max() <= FILE_PRECISION * size:
        return None
    open_loops = [
        loop for loop, gap in zip(spec.loops, gaps, strict=True) if gap > FILE_PRECISION * size
    ]
    tried = []
    for name, value, unit, is_angle, changed in _parameters_in_loops(
        spec, equations, open_loops, guess, active
    ):
        if (in_loops & specified).any():
            found = _closing_change(equations, guess, passive, specified, changed)
        else:
            found = _smallest_closing_change(equations, guess, passive, changed)
        if found is not None and (is_angle or value * (value + found[0] * unit) > 0):
            tried.append((found[1], Remedy(name, value, value + found[0] * unit, is_angle)))
    tried.sort(key=lambda one: (one[0], abs(one[1].closing_value - one[1].value)))
    most = max(_DISTANCE_RATIO * tried[0][0], _ROUNDING) if tried else 0.0
    if (in_loops & specified).any():
        most = min(most, _MAX_DISTANCE)
    alike = [one for distance, one in tried if distance <= most]
    worst = int(gaps.argmax())
    return ClosureDiagnosis(
        spec.loops[worst].name, float(gaps[worst]), tuple(alike[:_MAX_REMEDIES])
    )


# from the scaled change of a parameter and q (nq,): phi (m,), dphi/dq, dphi/dp, all scaled
ChangedResidual = Callable[[float, Array], tuple[Array, Array, Array]]


def _parameters_in_loops(
    spec: MachineSpec,
    equations: LoopEquations,
    loops: Sequence[LoopSpec],
    guess: Array,
    active: Sequence[int],
) -> Iterator[tuple[str, float, float, bool, ChangedResidual]]:
    """Lengths in loops and driven joints: name, value, unit, is angle, residual function."""
    joints = {joint for loop in loops for joint in _joints(spec, loop)}
    size = equations.characteristic_length

    for name, part, path in tree_parameters(spec.tree, spec.chains):
        if path[0] != "xyz" or part.name not in joints or not (value := value_at(part, path)):
            continue
        joint = spec.tree.joints[part.name]
        x, y, z = (x + size * (i == path[1]) for i, x in enumerate(joint.xyz))
        joint = dataclasses.replace(joint, xyz=(x, y, z))
        moved = assemble_tree(dataclasses.replace(spec, tree=spec.tree.with_parts(joint)))
        other = LoopEquations(moved, spec.loops, spec.couplings)
        yield name, value, size, False, partial(_evaluate_with_length, equations, other)
    for column in active:
        name = equations.coordinates.names[column]
        if name in joints and name in spec.home:
            unit = float(equations.coordinate_units[column])
            is_angle = not equations.coordinates.is_translation[column]
            moved_drive = partial(_evaluate_with_drive, equations, column)
            yield f"home {name}", float(guess[column]), unit, is_angle, moved_drive


def _evaluate_with_length(
    equations: LoopEquations, other: LoopEquations, change: float, q: Array
) -> tuple[Array, Array, Array]:
    """`ChangedResidual` of a length, which is one characteristic length more in `other`."""
    (phi, jacobian), (other_phi, other_jacobian) = equations.evaluate(q), other.evaluate(q)
    units = equations.residual_units
    jacobian = (
        (jacobian + change * (other_jacobian - jacobian))
        / units[:, None]
        * equations.coordinate_units
    )
    return (phi + change * (other_phi - phi)) / units, jacobian, (other_phi - phi) / units


def _evaluate_with_drive(
    equations: LoopEquations, column: int, change: float, q: Array
) -> tuple[Array, Array, Array]:
    """`ChangedResidual` of the home coordinate of a driven joint."""
    moved = q.copy()
    moved[column] += change * equations.coordinate_units[column]
    phi, jacobian = equations.evaluate_scaled(moved)
    return phi, jacobian, jacobian[:, column]


def _joints(spec: MachineSpec, loop: LoopSpec) -> set[str]:
    """Joints of the tree in a loop, including fixed ones."""
    above = spec.tree.parent_joints
    one, two = (
        {joint.name for joint in path_to_root(above, link)}
        for link in (loop.predecessor, loop.successor)
    )
    return one ^ two


def _closing_change(
    equations: LoopEquations,
    guess: Array,
    passive: Indices,
    specified: NDArray[np.bool_],
    changed: ChangedResidual,
) -> tuple[float, float] | None:
    """The scaled change of a parameter that closes the loops with least joint motion."""
    x = np.zeros(len(passive) + 1)
    weights = np.append(np.where(specified, 1.0, _FREE_WEIGHT), _FREE_WEIGHT)
    for _ in range(_MAX_ITERATIONS):
        q = equations.displace(guess, passive, x[:-1])
        gap, jacobian, derivative = changed(float(x[-1]), q)
        matrix = np.column_stack([jacobian[:, passive], derivative])
        solution = np.linalg.lstsq(matrix / weights, matrix @ x - gap, rcond=1e-12)[0] / weights
        step = np.abs(solution - x).max()
        if not step < 1.0:  # also NaN
            return None
        x = solution
        if step < 1e-9:
            break
    if not np.abs(gap).max() < FILE_PRECISION:
        return None
    return float(x[-1]), float(np.abs(x[:-1][specified]).max(initial=0.0))


def _smallest_closing_change(
    equations: LoopEquations, guess: Array, passive: Indices, changed: ChangedResidual
) -> tuple[float, float] | None:
    """The least scaled change of a parameter that closes the loops, and its magnitude.

    At the nearest approach the derivative of the gap |phi| is phi . (dphi/dp) / |phi|.
    """
    q, change = guess.copy(), 0.0
    for _ in range(_MAX_CHANGES):
        at_change = partial(changed, change)
        q = closest_approach(equations, q, passive, at_change, max_nfev=_MAX_EVALUATIONS)
        phi, _, derivative = changed(change, q)
        if np.abs(phi).max() < FILE_PRECISION:
            return change, abs(change)
        lever = float(phi @ derivative)
        if abs(lever) < _MIN_COSINE * float(np.linalg.norm(phi) * np.linalg.norm(derivative)):
            return None
        change -= float(phi @ phi) / lever
    return None
