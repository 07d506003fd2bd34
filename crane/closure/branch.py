"""One assembly branch: closing the loops from a near posture, and following the branch."""

from dataclasses import dataclass

import numpy as np

from crane.closure.equations import LoopEquations
from crane.closure.structure import Indices, Structure
from crane.common.errors import BranchEdgeError, MechanismError, OutOfReachError, WrongBranchError
from crane.common.samples import Array, solve

# All in rad and shares of the machine's size, so that a branch is the same at any scale.
_TOLERANCE = 1e-12  # of a closed loop
_EDGE = 1e-6  # relative least singular value of a block where the passive joints get undetermined
_SHORTEST = 2.0**-24  # step of the continuation at which it gives up


@dataclass(frozen=True, eq=False)
class Posture:
    """A closed posture with what the next step from it needs.

    Attributes:
        q: (nq,).
        q_a: (n,) its active coordinates.
        jacobian: (m, nv) of the independent loop equations, as `LoopEquations.scaled` has it.
        gamma: (m, n) passive rows of gamma.
    """

    q: Array
    q_a: Array
    jacobian: Array
    gamma: Array


class Branch:
    """The postures that can be reached from home without passing a singular one.

    Args:
        equations: All loop equations.
        structure: Which of them count.
        names: Names of all joints.
        active: Columns of the active joints.
        passive: Columns of the others.
        span: (n,) ranges of the active coordinates, to compare distances [m], [rad].

    Raises:
        MechanismError: The home posture does not close.
    """

    def __init__(
        self,
        equations: LoopEquations,
        structure: Structure,
        names: tuple[str, ...],
        active: Indices,
        passive: Indices,
        span: Array,
    ):
        self._equations, self._structure = equations, structure
        self._names = [names[i] for i in active]
        self._active, self._passive, self._span = active, passive, span
        self._blocks = structure.by_size()
        self._units, self._slides = equations.units, equations.coordinates.slides
        model = equations.model
        places = [*model.jointPlacements, *(frame.placement for frame in model.frames)]
        self._far = max(float(np.abs(place.translation).max()) for place in places)
        home = self.newton(structure.home, structure.home[active], 30)
        if home is None:
            raise MechanismError("the home posture does not close, change 'home'", "home")
        self.home = home
        self._sign = self._signs(home)

    def far(self, q: Array) -> float:
        """The longest part of a posture (nq,) whose rounding is that of its loops, at least 1."""
        slid = float(np.abs(q[self._slides]).max(initial=self._far))
        return max(1.0, slid / self._equations.size)

    def newton(self, q: Array, q_a: Array, iterations: int) -> Posture | None:
        """Close the loops at q_A from a near posture; None where that does not work."""
        q = q.copy()
        q[self._active] = q_a
        far, before = self.far(q), np.inf
        for _ in range(iterations):
            phi, jacobian = self._equations.scaled(q)
            phi, jacobian = phi[self._structure.rows], jacobian[self._structure.rows]
            residual = np.abs(phi).max(initial=0.0)
            rounded = residual <= 4e-15 * far
            stalled = residual <= 0.1 * _TOLERANCE * far and residual > 0.25 * before
            try:
                if rounded or stalled:
                    gamma = solve(jacobian[:, self._passive], -jacobian[:, self._active])
                    units = self._units[self._passive, None] / self._units[self._active]
                    return Posture(q, q_a, jacobian, gamma * units)
                change = solve(jacobian[:, self._passive], -phi)
            except np.linalg.LinAlgError:
                return None
            if not np.abs(change).max() < 1.0:  # also NaN
                return None
            before = residual
            q[self._passive] += change * self._units[self._passive]
        return None

    def step(self, q: Array, target: Array) -> Posture | None:
        """The posture at a target right beside a posture q (nq,); None where in doubt."""
        if not (np.abs(target - q[self._active]) < 0.01 * self._span).all():
            return None
        posture = self.newton(q, target, 5)
        if posture is None or not self._follows(q, posture, np.zeros(len(self._passive))):
            return None
        self._check(posture, "")
        return posture

    def reach(self, target: Array, known: Posture, sample: str = "") -> Posture:
        """The closed posture at a target, tracked from a known one or from home.

        Args:
            target: (n,) active coordinates.
            known: Where to start; home if that is nearer or if it fails.
            sample: What to call the target in errors.

        Raises:
            OutOfReachError: No posture closes the loops.
            BranchEdgeError: The passive joints are not determined there.
        """
        starts = [known] if known is self.home else [known, self.home]
        starts.sort(key=lambda start: float(np.abs((target - start.q_a) / self._span).max()))
        last = known
        for start in starts:
            posture, last = self._track(start, target)
            if posture is not None:
                self._check(posture, sample)
                return posture
        raise self._out_of_reach(target, last, sample)

    def posture(self, q: Array) -> Posture:
        """The closed posture nearest to a guess (nq,), home where the guess leads nowhere.

        Raises:
            WrongBranchError: It lies on another branch.
        """
        posture = self.newton(q, q[self._active], 10)
        if posture is None:
            return self.home
        flipped = np.flatnonzero(self._signs(posture) * self._sign < 0)
        if len(flipped):
            rows = [block for group, _ in self._blocks for block in group][int(flipped[0])]
            raise self._wrong_branch(self._loops_of(np.ravel(rows)), posture)
        turned = self._equations.turned_over(posture.q)
        if turned is not None:
            raise self._wrong_branch(f"loop '{turned}'", posture)
        return posture

    def check_edge(self, jacobian: Array, solved: Array, q_a: Array, sample: str = "") -> None:
        """Raise where J_P is singular, which shows in what was solved with it.

        Args:
            jacobian: (m, nv) see `LoopEquations.scaled`.
            solved: What was solved with its passive columns.
            q_a: (n,) where.
            sample: See `reach`.

        Raises:
            BranchEdgeError: It is.
        """
        if np.abs(solved).max(initial=0.0) > 1e-3 / _EDGE and self._weakest(jacobian)[0] < _EDGE:
            raise self.edge(jacobian, q_a, sample)

    def edge(self, jacobian: Array, q_a: Array, sample: str = "") -> BranchEdgeError:
        """The error for a posture with a singular J_P."""
        return BranchEdgeError(
            f"{self._loops_of(self._weakest(jacobian)[1])} is at the edge of its assembly branch "
            f"at {self._at(q_a)}{sample}, where the passive joints are undetermined: stay away "
            "from it"
        )

    def _weakest(self, jacobian: Array) -> tuple[float, Indices]:
        """Least singular value of a block, relative to its rows, at the most singular block.

        Rows are taken whole: a single equation for a single joint is singular where that joint
        loses its lever while others keep theirs.
        """
        worst, rows = 1.0, np.zeros(0, dtype=np.intp)
        for block_rows, block_columns in self._structure.blocks:
            values = np.linalg.svd(
                jacobian[np.ix_(block_rows, self._passive[block_columns])], compute_uv=False
            )
            scale = np.abs(jacobian[block_rows]).max()
            ratio = values[-1] / scale if scale > 0 else 0.0
            if ratio <= worst:
                worst, rows = float(ratio), block_rows
        return worst, rows

    def _signs(self, posture: Posture) -> Array:
        """Sign of every block's determinant: constant on an assembly branch."""
        signs = [
            np.linalg.slogdet(posture.jacobian[rows, self._passive[columns]])[0]
            for rows, columns in self._blocks
        ]
        return np.concatenate(signs) if signs else np.zeros(0)

    def _track(self, start: Posture, target: Array) -> tuple[Posture | None, Posture]:
        """Follow the branch along the straight line from a posture to a target.

        Returns:
            The posture at the target, or None, and the last posture on the way.
        """
        at, done, step = start, 0.0, 1.0
        while done < 1.0 and step >= _SHORTEST:
            goal = min(1.0, done + step)
            q_a = target if goal == 1.0 else start.q_a + goal * (target - start.q_a)
            move = at.gamma @ (q_a - at.q_a)
            # towards a fold Newton only converges linearly
            posture = self._moved(at, q_a, move, 8 if step > _SHORTEST * 16 else 40)
            if posture is None:
                step /= 2
                continue
            at, done = posture, goal
            step *= 2
        return at if done == 1.0 else None, at

    def _moved(self, at: Posture, q_a: Array, move: Array, iterations: int) -> Posture | None:
        """The posture at q_A from one beside it, None where it is not on the same branch."""
        if not np.abs(move / self._units[self._passive]).max(initial=0.0) < 1.0:
            return None
        predicted = at.q.copy()
        predicted[self._passive] += move
        posture = self.newton(predicted, q_a, iterations)
        if posture is None or not self._follows(predicted, posture, move):
            return None
        return posture

    def _follows(self, predicted: Array, posture: Posture, move: Array) -> bool:
        """Whether a posture continues the branch it was predicted on."""
        if (self._signs(posture) * self._sign < 0).any():
            return False
        units = self._units[self._passive]
        off = np.abs((posture.q - predicted)[self._passive] / units).max(initial=0.0)
        moved = np.abs(move / units).max(initial=0.0)
        return bool(off <= 0.02 + 0.5 * moved)

    def _check(self, posture: Posture, sample: str) -> None:
        """Raise unless every equation holds and the passive joints are determined."""
        units = self._units[self._passive, None] / self._units[self._active]
        self.check_edge(posture.jacobian, posture.gamma / units, posture.q_a, sample)
        if len(self._structure.redundant):
            phi, _ = self._equations.scaled(posture.q)
            extra = np.abs(phi[self._structure.redundant])
            if extra.max() > self._structure.surplus.allowed:
                row = int(self._structure.redundant[extra.argmax()])
                loop = self._equations.names[self._equations.loop_of_row[row]]
                raise OutOfReachError(
                    f"loop '{loop}' stays {self._gap(row, extra.max())} open at "
                    f"{self._at(posture.q_a)}{sample}, its surplus equations hold only near home: "
                    "the mechanism is overconstrained, use a looser loop type"
                )

    def _out_of_reach(self, target: Array, last: Posture, sample: str) -> OutOfReachError:
        from scipy.optimize import least_squares  # slow to import

        q, units = last.q.copy(), self._units[self._passive]
        q[self._active] = target

        def evaluate(passive: Array) -> tuple[Array, Array]:
            q[self._passive] = passive * units
            phi, jacobian = self._equations.scaled(q)
            return phi, jacobian[:, self._passive]

        def residual(passive: Array) -> Array:
            return evaluate(passive)[0]

        def slope(passive: Array) -> Array:
            return evaluate(passive)[1]

        nearest = least_squares(residual, q[self._passive] / units, slope, xtol=1e-12)
        phi = residual(nearest.x)
        worst = int(np.abs(phi).argmax())
        if np.abs(phi[worst]) < 10 * _TOLERANCE * self.far(q):
            return OutOfReachError(
                f"{self._loops_of(self._weakest(last.jacobian)[1])} can be closed at "
                f"{self._at(target)}{sample}, but the branch does not lead straight there from "
                f"{self._at(last.q_a)}: go around in between, or give a nearer guess"
            )
        loop = self._equations.names[self._equations.loop_of_row[worst]]
        return OutOfReachError(
            f"loop '{loop}' cannot be closed at {self._at(target)}{sample}: it stays "
            f"{self._gap(worst, np.abs(phi[worst]))} open; the last posture on the way that "
            f"closes is at {self._at(last.q_a)}"
        )

    def _wrong_branch(self, what: str, posture: Posture) -> WrongBranchError:
        return WrongBranchError(
            f"{what} is assembled the other way at {self._at(posture.q_a)}: start from the home "
            "posture's branch"
        )

    def _gap(self, row: int, share: float) -> str:
        """How far an equation is open, in words."""
        unit = "m" if self._equations.is_translation[row] else "rad"
        return f"{share * self._equations.row_units[row]:.3g} {unit}"

    def _loops_of(self, rows: Indices) -> str:
        loops = sorted(set(self._equations.loop_of_row[self._structure.rows[rows]].tolist()))
        names = " and ".join(f"'{self._equations.names[i]}'" for i in loops)
        return ("loop " if len(loops) == 1 else "the group of loops ") + names

    def _at(self, q_a: Array) -> str:
        pairs = zip(self._names, q_a, strict=True)
        return ", ".join(f"{name} = {value:.6g}" for name, value in pairs)
