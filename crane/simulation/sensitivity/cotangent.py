"""What all numbers of a simulated machine do to a weighted sum of its rate and its outputs.

The transpose of `Tangent`: with weights mu of the rate r(s, c), w of the outputs y(s, c) and the
closed loops phi(q, c) = 0, the gradient of mu . r + w . y by all numbers c at a state is, by one
pass against the order of the formulas in which coordinates q and numbers are independent,

    g = dr/dc^T mu + dy/dc^T w - dphi/dc^T z,    J_P^T z = dr/dq_P^T mu + dy/dq_P^T w.
"""

from collections.abc import Sequence

import numpy as np

from crane.codegen import Expression, Number, Program
from crane.codegen.derivative import against
from crane.common.samples import Array
from crane.simulation.sensitivity.rate import Rate, Rated, index_of
from crane.simulation.sensitivity.setup import Setup


class Cotangent(Rate):
    """Gradients of a machine's rate and outputs by all numbers that move; see `Rate`."""

    def against(self, base: Setup, states: Array, weights: Array, rest: bool) -> Array:
        """Gradients at states of one motion.

        Args:
            base: See `Tangent.along`.
            states: (N, .) as they are integrated.
            weights: (N, K, m + k + 1) of rate, outputs and margin.
            rest: Whether some joint is at rest.

        Returns:
            (N, K, l) by the numbers that move: of geometry, numbers, settings, frames.
        """
        count, several, _ = weights.shape
        out = np.empty((count, several, self._program.outputs("cotangent").size))
        self._call(
            "against", rest, count, several, base.geometry, base.numbers, base.settings,
            base.frames, np.ascontiguousarray(base.references), np.ascontiguousarray(states),
            np.ascontiguousarray(weights), out,
        )  # fmt: skip
        return out

    def _add(self, program: Program, added: str, rated: Rated) -> None:
        """cotangent(geometry, numbers, settings, frames, references, state, weights)."""
        tape, sweep, moved = rated.tape, rated.machine.sweep, self._moved
        masks = moved.geometry, moved.numbers, moved.settings, moved.frames
        numbers = [
            tape.load(array, i)
            for array, mask in enumerate(masks)
            for i in np.flatnonzero(mask).tolist()
        ]
        weights = tape.loads(6, 0, len(rated.values))
        for k, (_, factor) in enumerate(rated.seen, start=len(rated.rate)):
            weights[k] = factor * weights[k]
        loops = sweep.loops
        passive = [Expression(tape, index_of(sweep.q[i - 1])) for i in loops.passive_joints]
        found = against(rated.values, weights, [*numbers, *passive])
        out: Sequence[Number] = found[: len(numbers)]
        if loops.rows:
            # q_P moves linearly with how far loops are opened, by numbers that cancel out
            opened = [tape.load(7, r) for r in range(len(loops.rows))]
            held: dict[int, list[Number]] = {joint: [0.0] for joint in loops.active_joints}
            moving, _ = loops.solve(held, [[-1.0 * x] for x in opened])
            ways = [moving[i][0] for i in loops.passive_joints]
            z = against(ways, found[len(numbers) :], opened)
            by_loops = against([row.phi for row in loops.rows], z, numbers)
            out = [one + other for one, other in zip(out, by_loops, strict=True)]
        program.add("cotangent" + added, 7, out)
        names = (
            "geometry", "numbers", "settings", "frames", "references", "states", "weights", "out",
        )  # fmt: skip
        counts, width = ("count", "several"), len(out)
        with program.routine("against" + added, counts=counts, arrays=names) as r:
            with r.loop(r.count) as i, r.loop(r.several) as j:
                at_both = i * r.several + j
                r.call(
                    "cotangent" + added, r.geometry, r.numbers, r.settings, r.frames,
                    r.references.row(i, self._columns), r.states.row(i, self._state.size),
                    r.weights.row(at_both, len(weights)), r.out.row(at_both, width),
                )  # fmt: skip
            r.give(r.count)
