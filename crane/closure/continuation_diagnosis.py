"""What a continuation reports where it cannot go on."""

from dataclasses import dataclass

import numpy as np

from crane.closure.constraint_structure import ConstraintStructure
from crane.closure.coordinates import Indices
from crane.closure.loop_equations import LoopEquations
from crane.closure.multi_start_search import closest_approach
from crane.common.errors import OutOfReachError, SingularConfigurationError, WrongBranchError
from crane.common.samples import Array

# Scaled values (rad, characteristic length): the same for machines of any size.
CLOSED_TOLERANCE = 1e-12  # residual of a closed loop
SINGULAR_TOLERANCE = 1e-6  # relative least singular value of a singular block


@dataclass(frozen=True, eq=False)
class ClosedConfiguration:
    """A closed configuration with what the next continuation step needs.

    Attributes:
        q: (nq,).
        q_a: (n,) its active coordinates.
        jacobian: (m, nv) of the independent equations, see `LoopEquations.evaluate_scaled`.
        passive_gamma: (m, n) passive rows of gamma.
        neighbours: Configurations about it if it is in a change point, see
            `crane.closure.change_points.interpolate_limit`.
    """

    q: Array
    q_a: Array
    jacobian: Array
    passive_gamma: Array
    neighbours: "tuple[ClosedConfiguration, ...]" = ()


class ContinuationDiagnosis:
    """Why a continuation cannot go on, as errors; base class of `NewtonContinuation`.

    Args:
        equations: All loop equations.
        structure: Independent equations.
        active: Columns of the active joints.
        passive: Columns of the other joints.
    """

    def __init__(
        self,
        equations: LoopEquations,
        structure: ConstraintStructure,
        active: Indices,
        passive: Indices,
    ):
        self._equations, self._structure = equations, structure
        self._active_columns, self._passive_columns = active, passive
        self._coordinate_units = equations.coordinate_units
        model = equations.model
        places = [*model.jointPlacements, *(frame.placement for frame in model.frames)]
        self._largest_dimension = max(float(np.abs(place.translation).max()) for place in places)

    def rounding_scale(self, q: Array) -> float:
        """Factor on rounding errors at a configuration (nq,): its largest scaled dimension."""
        return max(
            1.0,
            float(
                np.abs(q[self._equations.coordinates.is_translation]).max(
                    initial=self._largest_dimension
                )
            )
            / self._equations.characteristic_length,
        )

    def _most_singular_block(self, jacobian: Array) -> tuple[float, Indices]:
        """Relative least singular value and rows of the most singular block.

        Whole rows set the scale: a single equation for a single joint is singular where that joint
        loses its lever while others keep theirs.
        """
        least_ratio, rows = 1.0, np.zeros(0, dtype=np.intp)
        for block_rows, block_columns in self._structure.blocks:
            values = np.linalg.svd(
                jacobian[np.ix_(block_rows, self._passive_columns[block_columns])],
                compute_uv=False,
            )
            scale = np.abs(jacobian[block_rows]).max()
            ratio = values[-1] / scale if scale > 0 else 0.0
            if ratio <= least_ratio:
                least_ratio, rows = float(ratio), block_rows
        return least_ratio, rows

    def singularity_error(
        self, jacobian: Array, q_a: Array, sample: str = ""
    ) -> SingularConfigurationError:
        """The error for a configuration with a singular J_P."""
        loops = self._format_loop_names(self._most_singular_block(jacobian)[1])
        return SingularConfigurationError(
            f"{loops} is at the edge of its branch at {self._format_values(q_a)}{sample}, where "
            "the passive joints are undetermined: stay away from it"
        )

    def _out_of_reach_error(
        self, target: Array, last_reached: ClosedConfiguration, sample: str
    ) -> OutOfReachError:
        q = last_reached.q.copy()
        q[self._active_columns] = target
        evaluate, passive = self._equations.evaluate_scaled, self._passive_columns
        phi = evaluate(closest_approach(self._equations, q, passive, evaluate, xtol=1e-12))[0]
        worst = int(np.abs(phi).argmax())
        place, last = self._format_values(target), self._format_values(last_reached.q_a)
        if np.abs(phi[worst]) < 10 * CLOSED_TOLERANCE * self.rounding_scale(q):
            loops = self._format_loop_names(self._most_singular_block(last_reached.jacobian)[1])
            return OutOfReachError(
                f"{loops} can be closed at {place}{sample}, but the branch does not lead straight "
                f"there from {last}: go around in between, or give a nearer guess"
            )
        return OutOfReachError(
            f"loop '{self._equations.name_of_row(worst)}' cannot be closed at {place}{sample}: it "
            f"stays {self._format_gap(worst, np.abs(phi[worst]))} open; the last configuration on "
            f"the way that closes is at {last}"
        )

    def _wrong_branch_error(self, subject: str, solution: ClosedConfiguration) -> WrongBranchError:
        return WrongBranchError(
            f"{subject} is assembled the other way at {self._format_values(solution.q_a)}: start "
            "from the branch of the home configuration"
        )

    def _format_gap(self, row: int, scaled_residual: float) -> str:
        gap = scaled_residual * self._equations.residual_units[row]
        return f"{gap:.3g} {self._equations.unit_of_row(row)}"

    def _format_loop_names(self, rows: Indices) -> str:
        loops = sorted(
            set(self._equations.loop_of_row[self._structure.independent_rows[rows]].tolist())
        )
        names = " and ".join(f"'{self._equations.names[i]}'" for i in loops)
        return ("loop " if len(loops) == 1 else "the group of loops ") + names

    def _format_values(self, q_a: Array) -> str:
        return self._equations.coordinates.format_values(self._active_columns, q_a)
