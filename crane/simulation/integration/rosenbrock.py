"""Steps of a Rosenbrock method in machine code, for stiff circuits."""

import numpy as np

from crane.codegen import Expression, Number, Program, Tape, largest, maximum, select
from crane.codegen.derivative import derivatives
from crane.codegen.factors import eliminated, loaded, stored, substituted
from crane.codegen.scalar import add, apply, dot, minimum, scale, times
from crane.common.samples import Array
from crane.control import At, ValveDrive
from crane.simulation.integration.blocks import in_blocks
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.sticking import NEAR
from crane.simulation.integration.traced import (
    Stepper,
    Traced,
    beyond,
    machine_at,
    settings_of,
    wrapped,
)

# ROS34PW2 of Rang and Angermann (2005): order 3 with any Jacobian, L-stable, stiffly accurate,
# with an embedded method of order 2.
GAMMA = 4.3586652150845900e-01
ALPHA = np.array([
    [0.0, 0.0, 0.0, 0.0],
    [8.7173304301691801e-01, 0.0, 0.0, 0.0],
    [8.4457060015369423e-01, -1.1299064236484185e-01, 0.0, 0.0],
    [0.0, 0.0, 1.0, 0.0],
])  # fmt: skip
LOWER = np.array([
    [GAMMA, 0.0, 0.0, 0.0],
    [-8.7173304301691801e-01, GAMMA, 0.0, 0.0],
    [-9.0338057013044082e-01, 5.4180672388095326e-02, GAMMA, 0.0],
    [2.4212380706095346e-01, -1.2232505839045147e00, 5.4526025533510214e-01, GAMMA],
])  # fmt: skip
WEIGHTS = np.array([2.4212380706095346e-01, -1.2232505839045147e00, 1.5452602553351020e00, GAMMA])
EMBEDDED = np.array([3.7810903145819369e-01, -9.6042292212423178e-02, 0.5, 2.1793326075422950e-01])
STAGES = len(WEIGHTS)

# in the transformed variables; rounding above the diagonal would read what is not there
_INVERSE = np.tril(np.linalg.inv(LOWER))
_FORWARD = ALPHA @ _INVERSE
_BACKWARD = np.diag(np.diag(_INVERSE)) - _INVERSE
_FINAL, _SECOND = WEIGHTS @ _INVERSE, EMBEDDED @ _INVERSE

_RELATIVE = 1e-8  # accuracy of a step, per size of the state
# accuracy that matters [rad], [machine's size], and that per `Closure.pace`
_COORDINATE, _VELOCITY = 1e-11, 1e-9
_FASTER, _SLOWER, _SAFETY = 6.0, 0.2, 0.9  # change of the step's length from one to the next
_SHORTEST = 1e-9  # part of a recorded step that is given up on
_NEARLY = 1.0 - 2.0**-41  # of what is left of a recorded step: all of it


def mixed(tape: Tape, array: int, size: int, weights: Array) -> list[Number]:
    """A weighted sum of vectors of some size that are in an argument one after the other."""
    out: list[Number] = [0.0] * size
    for j, weight in enumerate(weights):
        if weight:
            out = add(out, scale(float(weight), tape.loads(array, j * size, size)))
    return out


class StiffStepper(Stepper):
    """Many steps at once in machine code, by a method that stiff circuits do not shorten.

    y' = f(y) is stepped by ROS34PW2 with its own choice of length within each recorded step. The
    Jacobian is exact for the controller's states and for what forces, friction and passive forces
    do to the velocities, and zero for the rest (coordinates, centrifugal forces, integrals):
    the order does not depend on it. In the transformed variables u = sum gamma_ij k_j, stage i
    solves

        (1 / (h gamma) - J) u_i = f(y + sum a_ij u_j) + sum c_ij / h u_j.

    (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.7.)

    Args:
        chart: The machine.
        control: Its controller.

    Raises:
        TooLongError: It would take too long to compile.
    """

    _control: ValveDrive

    def __init__(self, chart: Chart, control: ValveDrive):
        self._stiff = int(np.isfinite(control.scales).sum())
        super().__init__(chart, control, len(control.scales), ("stiff", self._stiff), fold=True)
        machine = chart.machine
        units, pace = machine.closure.units, machine.closure.pace
        self._scales = np.concatenate(
            [
                1.0 / (_COORDINATE * units),
                pace / (_VELOCITY * units[machine.closure.active]),
                1.0 / control.scales,
            ]
        )
        self._lengths = np.zeros(3)

    def run(self, times: Array, state: Array, step: float, rows: Array) -> int:
        """See `CompiledStepper.run`."""
        arguments = self._arguments
        if self._lengths[0] != step:
            self._lengths[:2] = step, 0.01 * step
        self._lengths[2] = 0.0

        def call(count: int, references: Array, out: Array) -> int:
            return self._program.call(
                "run", count, self._fast.close_address, *arguments, references, state,
                out, self._lengths, self.bounds, self._scales,
            )  # fmt: skip

        return in_blocks(call, self._control, times, step, rows)

    @property
    def event(self) -> float:
        """See `CompiledStepper.event`."""
        return float(self._lengths[2])

    def _trace(self, tape: Tape, state: int, theta: int | None) -> tuple[Traced, At]:
        """The machine at a state, its references between three rows or in one."""
        control, columns = self._control, self._columns
        machine = machine_at(self._chart, tape, self._state, state)
        settings = settings_of(control, tape, 2, fold=True)
        rows = [tape.loads(3, columns * row, columns) for row in range(3)]
        reference = rows[0]
        if theta is not None:
            # the parabola through the rows at 0, 1/2, 1
            s = tape.load(theta, 0)
            shares = ((2.0 * s - 1.0) * (s - 1.0), 4.0 * s * (1.0 - s), s * (2.0 * s - 1.0))
            reference = [dot(shares, values) for values in zip(*rows, strict=True)]
        return machine, machine.seen(settings, reference)

    def _build(self, program: Program) -> None:
        control = self._control
        for added, rest in self._rests:
            machine, at = self._trace(Tape(), 5, 4)
            tau, own_rate = control.trace(at)
            moved, slopes = machine.moved(tau, rest), machine.sweep.slopes
            rate = [*slopes, *moved.a_a, *own_rate, *machine.powers(tau)]
            program.add(f"rate{added}", 6, {"rate": rate, "margin": [moved.margin]})
            machine, at = self._trace(Tape(), 4, None)
            tau, _ = control.trace(at)
            seen = [*machine.observed(tau, rest), *control.look(at)]
            margin = machine.moved(tau, rest).margin
            program.add(f"observe{added}", 5, {"seen": seen, "margin": [margin]})
            self._add_solves(program, added, rest)
        self._add_sums(program)
        self._add_run(program)

    def _add_run(self, program: Program) -> None:
        """run: recorded steps of length h[0], each in as many parts as their error asks for.

        h[1] is the length to try next; h[2] how far behind the last recorded instant a joint has
        started or stopped, if one has.
        """
        size, seen, columns = self._state.size, self._seen.size, self._columns
        names = ("geometry", "numbers", "control", "refs", "state", "out", "h", "bounds", "scales")
        with program.routine("run", counts=("steps",), functions=("close",), arrays=names) as r:
            following = r.array("following", program.outputs("finish"))
            u = r.array("u", STAGES * size)
            stage, slope = r.array("stage", size), r.array("slope", program.outputs("rate"))
            looked = r.array("looked", program.outputs("observe"))
            # the last has the most
            factors = r.array("factors", program.outputs("prepare" + self._rests[-1][0]))
            result = r.array("result", self._fast.outputs("newton"))
            theta, part = r.array("theta", 1), r.array("part", 1)
            whole = r.let(r.h[0])
            with r.loop(r.steps) as i:
                refs, row = r.refs.row(i, 2 * columns), r.out.row(i, size + seen)
                machine = (r.geometry, r.numbers, r.control, refs)
                r.copy(row, r.state, size)
                self._call(r, "observe", *machine, r.state, looked)
                if self._sticks:
                    with r.when(looked["margin"] < -NEAR):
                        r.store(r.h, 2, whole)
                        r.give(i)
                r.copy(row.at(size), looked, seen)
                t = r.let(0.0)
                with r.forever():
                    left, proposed = r.let(whole - t), r.let(r.h[1])
                    last = r.let(proposed >= left * _NEARLY)
                    length = r.let(select(last, left, proposed))
                    with r.when(~(length >= whole * _SHORTEST)):
                        r.give(i)
                    r.store(part, 0, length)
                    r.store(theta, 0, t / whole)
                    self._call(r, "prepare", *machine, theta, r.state, part, factors)
                    for k in range(STAGES):
                        r.store(theta, 0, (t + length * float(ALPHA[k].sum())) / whole)
                        r.call(f"combine{k}", r.state, u, stage)
                        self._call(r, "rate", *machine, theta, stage, slope)
                        if self._sticks and k == 0:
                            with r.when((slope["margin"] < -NEAR) & (t > 0.0)):
                                r.store(r.h, 2, t)
                                r.give(i + 1)
                        self._call(r, f"solve{k}", slope, u, factors, part, u.at(k * size))
                    r.call("finish", r.state, u, r.scales, following)
                    change = following["change"]
                    wanted = r.let(length * select(change > 0.0, change, _SLOWER))  # NaN: slower
                    with r.when(following["error"] <= 1.0):
                        closed = r.call("close", r.geometry, following, result, r.bounds)
                        with r.when(closed < 1):
                            r.give(i)
                        r.copy(r.state, following, size)
                        # a last part that was cut short says nothing against the length it was
                        # cut from
                        r.store(r.h, 1, select(last & (proposed > wanted), proposed, wanted))
                        r.set(t, t + length)
                        with r.when(last):
                            r.leave()
                    with r.otherwise():
                        r.store(r.h, 1, wanted)
                with r.when(beyond(r, result)):
                    r.give(i + 1)
            r.give(r.steps)

    def _add_solves(self, program: Program, added: str, rest: bool) -> None:
        """prepare(..., h): elimination of 1 - h gamma J, rows of the velocities times M_A.

        And solve(rate, u, factors, h) of each stage. Joints at rest get the accelerations that
        they have in `rate`, whatever the Jacobian says: a row Gamma x = Gamma b for each of them.
        """
        tape = Tape()
        machine, at = self._trace(tape, 5, 4)
        sweep, parts = machine.sweep, machine.parts
        tau, own_rate = self._control.trace(at)
        net = machine.forces(tau)
        unknown = [x for x in (*parts.own[: self._stiff], *parts.v_a) if isinstance(x, Expression)]
        jacobian = derivatives([*own_rate[: self._stiff], *net], unknown)
        reach = GAMMA * tape.load(6, 0)
        matrix = [[-1.0 * (reach * entry) for entry in row] for row in jacobian]
        for i in range(self._stiff):
            matrix[i][i] = matrix[i][i] + 1.0
        for i, row in enumerate(sweep.mass):
            for j, entry in enumerate(row):
                at_row = matrix[self._stiff + i]
                at_row[self._stiff + j] = at_row[self._stiff + j] + entry
        mass, n = sweep.mass, len(parts.v_a)
        constraints = sweep.held if rest else []
        for row in matrix:
            row += [0.0] * len(constraints)
        kept = [scale(held, row) for held, row in constraints]
        for k, row in enumerate(kept):
            for j, entry in enumerate(row):
                matrix[self._stiff + j][self._stiff + n + k] = entry
            others: list[Number] = [0.0] * len(constraints)
            others[k] = constraints[k][0] - 1.0
            matrix.append([*([0.0] * self._stiff), *row, *others])
        factors = eliminated(matrix)
        outputs = {"factors": stored(factors), "mass": stored(mass), "rows": stored(kept)}
        program.add(f"prepare{added}", 7, outputs)
        starts = program.outputs(f"prepare{added}")
        size, stiff = self._state.size, self._stiff
        for i in range(STAGES):
            tape = Tape()
            right = scale(GAMMA * tape.load(3, 0), tape.loads(0, 0, size))
            right = add(right, scale(GAMMA, mixed(tape, 1, size, _BACKWARD[i])))
            there = loaded(factors, tape, 2, 0)
            inertia = loaded(mass, tape, 2, starts.start("mass"))
            rows = loaded(kept, tape, 2, starts.start("rows"))
            part = self._state.view(right)
            wanted = [*part.own[:stiff], *times(inertia, part.v_a), *times(rows, part.v_a)]
            x = substituted(there, wanted)[: stiff + n]
            own = [*x[:stiff], *part.own[stiff:]]
            solved = [*part.q, *x[stiff:], *own, *part.work, *part.lost]
            program.add(f"solve{i}{added}", 4, solved)

    def _add_sums(self, program: Program) -> None:
        """combine(s, u) of each stage, and finish(s, u, scales)."""
        size, stiff = self._state.size, self._stiff
        for i in range(STAGES):
            tape = Tape()
            state = tape.loads(0, 0, size)
            program.add(f"combine{i}", 2, add(state, mixed(tape, 1, size, _FORWARD[i])))
        tape = Tape()
        state = tape.loads(0, 0, size)
        after = add(state, mixed(tape, 1, size, _FINAL))
        gap = mixed(tape, 1, size, _FINAL - _SECOND)
        used = self._state.start("own") + stiff
        shares = [
            gap[i] / (1.0 / tape.load(2, i) + _RELATIVE * apply("abs", after[i]))
            for i in range(used)
        ]
        # the integrals count only so far as that NaN and infinity anywhere show
        error = maximum(largest(shares), largest(scale(1e-30, gap[used:])))
        usable = minimum(maximum(error, 1e-9), 1e9)
        change = _SAFETY * apply("exp", (-1.0 / 3.0) * apply("log", usable))
        change = minimum(maximum(change, _SLOWER), _FASTER)
        after = wrapped(self._chart, after)
        program.add("finish", 3, {"state": after, "error": [error], "change": [change]})
