"""How the rate of a simulated machine changes with its state and with all its numbers.

The state of a motion is s = (q_A, v_A, o): active coordinates, their velocities, the states o of
the controller or circuit that act back; c are all numbers of the simulation, see `Setup`. The
rate r(s, c) = s' is differentiated operation by operation along a direction (ds, dc), through the
closed loops phi(q, c) = 0:

    J_P dq_P = -(J_A dq_A + dphi/dc dc).
"""

import numpy as np

from crane.codegen import Number, Program
from crane.codegen.derivative import along
from crane.common.samples import Array
from crane.simulation.sensitivity.rate import Rate, Rated, index_of
from crane.simulation.sensitivity.setup import Setup


class Tangent(Rate):
    """Derivatives of a machine's rate along directions; see `Rate`."""

    def along(self, base: Setup, states: Array, change: Setup, rest: bool) -> tuple[Array, Array]:
        """Derivatives at states of one motion.

        Args:
            base: The simulation's numbers, with what sticks (see `Dynamics.set_modes`) and
                references (N, c) of the states.
            states: (N, .) as they are integrated.
            change: p directions of the numbers, each part with a leading axis.
            rest: Whether some joint is at rest.

        Returns:
            d r/d s and d r/d c (N, m, m + p); the same of the outputs and the margin (N, k + 1,
            m + p).
        """
        m, p, count = self.size, len(change.geometry), len(states)
        inputs = np.zeros((m + p, m))
        inputs[:m] = np.eye(m)
        padded = [
            np.ascontiguousarray(np.vstack([np.zeros((m, part.shape[1])), part]))
            for part in (change.geometry, change.numbers, change.settings, change.frames)
        ]
        references = np.zeros((count, m + p, self._columns))
        references[:, m:] = np.swapaxes(change.references, 0, 1)
        width = self._program.outputs("tangent").size
        out = np.empty((count, m + p, width))
        self._call(
            "along", rest, count, m + p, base.geometry, base.numbers, base.settings,
            base.frames, np.ascontiguousarray(base.references),
            np.ascontiguousarray(states), *padded, references, inputs, out,
        )  # fmt: skip
        out = np.swapaxes(out, 1, 2)
        return out[:, :m], out[:, m:]

    def _add(self, program: Program, added: str, rated: Rated) -> None:
        """tangent(geometry, numbers, settings, frames, references, state, their changes, ds)."""
        n, moved, tape, sweep = self._n, self._moved, rated.tape, rated.machine.sweep
        # what tells when joints start or stop changes with time by the references
        paced = moved.references + bool(self._chart.sticking.columns)
        masks = moved.geometry, moved.numbers, moved.settings, moved.frames, paced
        seeds: dict[int, Number] = {}

        def seed(array: int, mask: Array) -> None:
            for i in np.flatnonzero(mask).tolist():
                seeds[tape.load(array, i).index] = tape.load(6 + array, i)

        seed(0, masks[0])
        changed = [tape.loads(11, part * n, n) for part in range(2)]
        opened = along([row.phi for row in sweep.loops.rows], seeds)
        joints = sweep.loops.active_joints
        held = {joint: [change] for joint, change in zip(joints, changed[0], strict=True)}
        moving, _ = sweep.loops.solve(held, [[-1.0 * x] for x in opened])
        seeds |= {index_of(sweep.q[i - 1]): change for i, (change,) in moving.items()}
        seeds |= dict(zip(map(index_of, sweep.v_a), changed[1], strict=True))
        own, parts = tape.loads(11, 2 * n, self._stiff), rated.machine.parts
        seeds |= dict(zip(map(index_of, parts.own[: self._stiff]), own, strict=True))
        for array, mask in enumerate(masks[1:], start=1):
            seed(array, mask)
        slopes = along(rated.values, seeds)
        for k, (_, factor) in enumerate(rated.seen, start=len(rated.rate)):
            slopes[k] = factor * slopes[k]
        program.add("tangent" + added, 12, slopes)
        sizes = [len(mask) for mask in masks[:4]]
        width, m, columns = len(slopes), self.size, self._columns
        names = (
            "geometry", "numbers", "settings", "frames", "references", "states", "geometries",
            "numbered", "settled", "framed", "referred", "inputs", "out",
        )  # fmt: skip
        counts = ("count", "directions")
        with program.routine("along" + added, counts=counts, arrays=names) as r:
            with r.loop(r.count) as i, r.loop(r.directions) as j:
                at_both = i * r.directions + j
                r.call(
                    "tangent" + added, r.geometry, r.numbers, r.settings, r.frames,
                    r.references.row(i, columns), r.states.row(i, self._state.size),
                    r.geometries.row(j, sizes[0]), r.numbered.row(j, sizes[1]),
                    r.settled.row(j, sizes[2]), r.framed.row(j, sizes[3]),
                    r.referred.row(at_both, columns), r.inputs.row(j, m),
                    r.out.row(at_both, width),
                )  # fmt: skip
            r.give(r.count)
