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

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from crane.closure.constraint_tolerances import FILE_PRECISION
from crane.closure.coordinates import Indices
from crane.closure.loop_equations import LoopEquations
from crane.common.samples import Array
from crane.description.machine_parameters import tree_parameters, value_at
from crane.description.specification import LoopSpec, MachineSpec
from crane.machine.drive_selection import specified_active_joints
from crane.machine.machine_assembly import assemble_tree

_LOOSE = 1e-6  # weight of the change of a length, and of joints that the file does not specify
_ITERATIONS, _CHANGES, _EVALUATIONS = 25, 6, 30
_LEVER = 0.1  # least cosine of a length's derivative and the gap that it closes
_CLEAR = 0.05  # scaled distance of joints at their specified coordinates
_ALIKE, _DIGIT = 2.0, 2e-3  # ratio of indecisive distances, and rounding of a home in a file
_LISTED = 2


@dataclass(frozen=True)
class Remedy:
    """A parameter whose change would close the loops.

    Attributes:
        name: As in `crane.description.parameters`, or `home JOINT`.
        now: Its value [m], [rad].
        then: The value that closes the loops.
        turns: Whether it is an angle.
    """

    name: str
    now: float
    then: float
    turns: bool

    def __str__(self) -> str:
        return f"{self.name} {self.then:.4g} {'rad' if self.turns else 'm'} (now {self.now:.4g})"


@dataclass(frozen=True)
class Misfit:
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
        close = self.listed or "no other length alone"
        return f"with home as said loop '{self.loop}' is {gap} open, and would close with {close}"

    @property
    def listed(self) -> str:
        """The remedies as text."""
        return " or ".join(map(str, self.remedies))


def misfit(spec: MachineSpec, model: pin.Model, guess: Array) -> Misfit | None:
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
    said = np.isin(names, list(spec.home))[passive]
    guess = _nearest(
        equations,
        guess,
        passive[in_loops & ~said],
        lambda q, _: (*equations.evaluate_scaled(q), guess),
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
    for name, now, unit, turns, changed in _numbers(spec, equations, open_loops, guess, active):
        if (in_loops & said).any():
            found = _change(equations, guess, passive, said, changed)
        else:
            found = _least(equations, guess, passive, changed)
        if found is not None and (turns or now * (now + found[0] * unit) > 0):
            tried.append((found[1], Remedy(name, now, now + found[0] * unit, turns)))
    tried.sort(key=lambda one: (one[0], abs(one[1].then - one[1].now)))
    most = max(_ALIKE * tried[0][0], _DIGIT) if tried else 0.0
    if (in_loops & said).any():
        most = min(most, _CLEAR)
    alike = [one for distance, one in tried if distance <= most]
    worst = int(gaps.argmax())
    return Misfit(spec.loops[worst].name, float(gaps[worst]), tuple(alike[:_LISTED]))


# from q (nq,) and the scaled change of a parameter: phi (m,), dphi/dq, dphi/dp, all scaled
Changed = Callable[[Array, float], tuple[Array, Array, Array]]


def _numbers(
    spec: MachineSpec,
    equations: LoopEquations,
    loops: Sequence[LoopSpec],
    guess: Array,
    active: Sequence[int],
) -> Iterator[tuple[str, float, float, bool, Changed]]:
    """Lengths in loops and driven joints: name, value, unit, is angle, residual function."""
    joints = {joint for loop in loops for joint in _joints(spec, loop)}
    size = equations.characteristic_length

    def length(other: LoopEquations) -> Changed:
        def changed(q: Array, change: float) -> tuple[Array, Array, Array]:
            (phi, jacobian), (other_phi, other_jacobian) = equations.evaluate(q), other.evaluate(q)
            units = equations.residual_units
            jacobian = (
                (jacobian + change * (other_jacobian - jacobian))
                / units[:, None]
                * equations.coordinate_units
            )
            return (phi + change * (other_phi - phi)) / units, jacobian, (other_phi - phi) / units

        return changed

    def drive(column: int) -> Changed:
        def changed(q: Array, change: float) -> tuple[Array, Array, Array]:
            there = q.copy()
            there[column] += change * equations.coordinate_units[column]
            phi, jacobian = equations.evaluate_scaled(there)
            return phi, jacobian, jacobian[:, column]

        return changed

    for name, part, way in tree_parameters(spec.tree, spec.chains):
        if way[0] != "xyz" or part.name not in joints or not (now := value_at(part, way)):
            continue
        joint = spec.tree.joints[part.name]
        x, y, z = (value + size * (i == way[1]) for i, value in enumerate(joint.xyz))
        joint = dataclasses.replace(joint, xyz=(x, y, z))
        moved = assemble_tree(dataclasses.replace(spec, tree=spec.tree.with_parts(joint)))
        yield name, now, size, False, length(LoopEquations(moved, spec.loops, spec.couplings))
    for column in active:
        name = equations.coordinates.names[column]
        if name in joints and name in spec.home:
            unit, turns = (
                float(equations.coordinate_units[column]),
                not equations.coordinates.is_translation[column],
            )
            yield f"home {name}", float(guess[column]), unit, bool(turns), drive(column)


def _joints(spec: MachineSpec, loop: LoopSpec) -> set[str]:
    """Joints of the tree in a loop, including fixed ones."""
    above = {joint.child: joint for joint in spec.tree.joints.values()}
    ways = []
    for link in (loop.predecessor, loop.successor):
        way = set()
        while link in above:
            way.add(above[link].name)
            link = above[link].parent
        ways.append(way)
    return ways[0] ^ ways[1]


def _change(
    equations: LoopEquations,
    guess: Array,
    passive: Indices,
    said: NDArray[np.bool_],
    changed: Changed,
) -> tuple[float, float] | None:
    """The scaled change of a parameter that closes the loops with least joint motion."""
    x, units = np.zeros(len(passive) + 1), equations.coordinate_units[passive]
    weights = np.append(np.where(said, 1.0, _LOOSE), _LOOSE)
    for _ in range(_ITERATIONS):
        q = guess.copy()
        q[passive] += x[:-1] * units
        gap, jacobian, derivative = changed(q, float(x[-1]))
        matrix = np.column_stack([jacobian[:, passive], derivative])
        wanted = np.linalg.lstsq(matrix / weights, matrix @ x - gap, rcond=1e-12)[0] / weights
        step = np.abs(wanted - x).max()
        if not step < 1.0:  # also NaN
            return None
        x = wanted
        if step < 1e-9:
            break
    if not np.abs(gap).max() < FILE_PRECISION:
        return None
    return float(x[-1]), float(np.abs(x[:-1][said]).max(initial=0.0))


def _least(
    equations: LoopEquations, guess: Array, passive: Indices, changed: Changed
) -> tuple[float, float] | None:
    """The least scaled change of a parameter that closes the loops, and its magnitude.

    At the nearest approach the derivative of the gap |phi| is phi . (dphi/dp) / |phi|.
    """
    q, change = guess.copy(), 0.0
    for _ in range(_CHANGES):
        q = _nearest(equations, q, passive, changed, change)
        phi, _, derivative = changed(q, change)
        if np.abs(phi).max() < FILE_PRECISION:
            return change, abs(change)
        lever = float(phi @ derivative)
        if abs(lever) < _LEVER * float(np.linalg.norm(phi) * np.linalg.norm(derivative)):
            return None
        change -= float(phi @ phi) / lever
    return None


def _nearest(
    equations: LoopEquations, q: Array, free: Indices, changed: Changed, change: float = 0.0
) -> Array:
    """The configuration of least squared residuals, from one nearby."""
    from scipy.optimize import least_squares  # slow to import, only needed for open loops

    def there(x: Array) -> Array:
        out = q.copy()
        out[free] += x * equations.coordinate_units[free]
        return out

    if not len(free):
        return q

    def gap(x: Array) -> Array:
        return changed(there(x), change)[0]

    def jacobian(x: Array) -> Array:
        return changed(there(x), change)[1][:, free]

    return there(least_squares(gap, np.zeros(len(free)), jacobian, max_nfev=_EVALUATIONS).x)
