"""Steps of a Rosenbrock method in machine code, which nothing stiff shortens."""

import numpy as np

from crane.closure.traced import largest_share
from crane.codegen import Expression, Number, Program, Tape, Value, largest, maximum
from crane.codegen.derivative import derivatives
from crane.codegen.factors import Matrix, eliminated, loaded, stored, substituted
from crane.codegen.scalar import add, apply, minimum, scale, subtract, times
from crane.control import TracedController, ValveDrive
from crane.dynamics.external import states_of
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.controlled import (
    ENERGY,
    LEAST,
    ControlledStepper,
    energy_of,
    mixed,
)
from crane.simulation.integration.step_loop import SLOWER, Attempt, Way

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

TOLERANCE = 1e-8  # error of a step, per size of the state
# accuracy that matters [rad], [machine's size], that per `Closure.pace`, and of a law's states
_COORDINATE, _VELOCITY, _OWN = 1e-11, 1e-9, 1e-9
_FASTER, _SAFETY = 6.0, 0.9  # change of the step's length from one to the next


class StiffStepper(ControlledStepper):
    """Steps of ROS34PW2.

    The Jacobian of y' = f(y) is exact for the controller's states and for what forces, friction
    and passive forces do to the velocities; of coordinates it has what springs, stops, gas and
    the controller do with them, along the active ones and at frozen gamma; and none for the rest
    (weight, centrifugal forces, integrals): the order does not depend on it. In the transformed
    variables u = sum gamma_ij k_j, stage i solves

        (1 / (h gamma) - J) u_i = f(y + sum a_ij u_j) + sum c_ij / h u_j,

    where u_q = h gamma (r_q + Gamma u_v) with the right side r leaves

        [M_A - h gamma D - (h gamma)^2 K] u_v - h gamma B u_o = h gamma (M_A r_v + h gamma K r_qA)

    and the rows of the controller's states o. With circuits J has nothing of coordinates. (Hairer
    and Wanner, Solving Ordinary Differential Equations II, IV.7.)

    Args:
        chart: The machine.
        control: Its controller.
        states: Number of the controller's states.
        tolerance: Error of a step, per size of the state.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self, chart: Chart, control: TracedController, states: int, tolerance: float = TOLERANCE
    ):
        scales = control.scales if isinstance(control, ValveDrive) else np.full(states, _OWN)
        self._stiff = int(np.isfinite(scales).sum())
        closure = chart.machine.closure
        accuracies = np.concatenate(
            [
                _COORDINATE * closure.units,
                _VELOCITY * closure.units[closure.active] / closure.pace,
                np.full(states_of(chart.machine.external), _COORDINATE * closure.size),
                scales,
            ]
        )
        method = ("stiff", self._stiff)
        energy = LEAST * ENERGY * tolerance * energy_of(chart)
        errors = np.append(TOLERANCE / tolerance / accuracies, [tolerance, 1.0 / energy])
        super().__init__(chart, control, states, method, True, errors)

    def _add_method(self, program: Program) -> None:
        """combine(s, u), prepare(..., h), solve(rate, u, factors, h) of stages; finish; dense."""
        for added, rest in self._rests:
            self._add_solves(program, added, rest)
        size, q = self.state_layout.size, self.state_layout.parts["q"]
        for i in range(1, STAGES):
            tape = Tape()
            state = tape.loads(0, 0, size)
            program.add(f"combine{i}", 2, add(state, mixed(tape, 1, size, _FORWARD[i])))
        tape = Tape()
        state = tape.loads(1, 0, size)
        after = add(state, mixed(tape, 2, size, _FINAL))
        gap = mixed(tape, 2, size, _FINAL - _SECOND)
        used, energies = (
            self.state_layout.start("own") + self._stiff,
            self.state_layout.start("work"),
        )
        relative = tape.load(3, energies)
        shares = [
            gap[i] / (1.0 / tape.load(3, i) + relative * apply("abs", after[i]))
            for i in range(used)
        ]
        if not self._short:
            shares += [
                gap[i]
                / (1.0 / tape.load(3, energies + 1) + ENERGY * relative * apply("abs", after[i]))
                for i in range(energies, size)
            ]
        # the other integrals count only so far as that NaN and infinity anywhere show
        error = maximum(largest(shares), largest(scale(1e-30, gap[used:])))
        long = [not turns for turns in self.closure_code.geometry.revolute[1:]]
        way = subtract(after[:q], state[:q])
        move = largest_share(way, long, self.closure_code.per_size(tape))
        error = self._followed(error, move)
        usable = minimum(maximum(error, 1e-9), 1e9)
        change = _SAFETY * apply("exp", (-1.0 / 3.0) * apply("log", usable))
        change = minimum(maximum(change, SLOWER), _FASTER)
        outputs = {"state": after, "error": [error], "change": [change], "move": [move]}
        program.add("finish", 4, outputs)
        # the cubic through both ends and their slopes
        tape = Tape()
        h = tape.load(2, 0)
        way = subtract(tape.loads(3, 0, size), tape.loads(0, 0, size))
        slopes = [scale(h, tape.loads(array, 0, size)) for array in (1, 4)]
        parts = *way, *subtract(slopes[0], way), *subtract(scale(2.0, way), add(*slopes))
        program.add("dense", 5, list(parts))

    def _add_solves(self, program: Program, added: str, rest: bool) -> None:
        """prepare(..., h): elimination of 1 - h gamma J, rows of the velocities times M_A.

        And solve(rate, u, factors, h) of each stage. Joints at rest get the accelerations that
        they have in `rate`, whatever the Jacobian says: a row Gamma x = Gamma b for each of them.
        """
        tape = Tape()
        machine, _, tau, own_rate = self._driven(tape)
        sweep, parts, stiff = machine.sweep, machine.parts, self._stiff
        own_rate, mass, n = list(own_rate[:stiff]), sweep.mass, len(parts.v_a)
        reach = GAMMA * tape.load(5, 0)
        unknown = [x for x in (*parts.own[:stiff], *parts.v_a) if isinstance(x, Expression)]
        jacobian = derivatives([*own_rate, *machine.forces(tau)], unknown)
        by_q: Matrix = [[0.0] * n for _ in range(stiff + n)]
        ways: Matrix = [[0.0] * n for _ in parts.q]
        if not self._short:  # sums of oil and strokes stay what they are where J has neither
            by_q = [scale(reach, row) for row in machine.stiffness(own_rate, tau)]
            ways = [scale(reach, row) for row in sweep.ways]
        matrix = [scale(-1.0 * reach, row) for row in jacobian]
        for i in range(stiff):
            matrix[i][i] = matrix[i][i] + 1.0
        for i, row in enumerate(mass):
            for j, entry in enumerate(row):
                matrix[stiff + i][stiff + j] = matrix[stiff + i][stiff + j] + entry
        for row, slopes in zip(matrix, by_q, strict=True):
            for j, slope in enumerate(slopes):
                row[stiff + j] = row[stiff + j] - reach * slope
        constraints = sweep.held if rest else []
        kept = [scale(held, row) for held, row in constraints]
        for row in matrix:
            row += [0.0] * len(kept)
        for k, row in enumerate(kept):
            for j, entry in enumerate(row):
                matrix[stiff + j][stiff + n + k] = entry
            others: list[Number] = [0.0] * len(kept)
            others[k] = constraints[k][0] - 1.0
            matrix.append([*([0.0] * stiff), *row, *others])
        factors = eliminated(matrix)
        tables: dict[str, Matrix] = {
            "factors": factors, "mass": mass, "rows": kept, "by_q": by_q, "ways": ways,
            "free": [sweep.free] if rest else [[1.0] * n],
        }  # fmt: skip
        outputs = {name: stored(table) for name, table in tables.items()}
        program.add(f"prepare{added}", 6, outputs)
        starts = program.outputs(f"prepare{added}")
        size, active = self.state_layout.size, self._chart.machine.closure.active
        for i in range(STAGES):
            tape = Tape()
            right = scale(GAMMA * tape.load(3, 0), tape.loads(0, 0, size))
            right = add(right, scale(GAMMA, mixed(tape, 1, size, _BACKWARD[i])))
            there = {
                name: loaded(table, tape, 2, starts.start(name)) for name, table in tables.items()
            }
            part = self.state_layout.view(right)
            pulls = times(there["by_q"], [part.q[column] for column in active])
            wanted = add([*part.own[:stiff], *times(there["mass"], part.v_a)], pulls)
            x = substituted(there["factors"], [*wanted, *times(there["rows"], part.v_a)])
            v_a = [w * y for w, y in zip(there["free"][0], x[stiff : stiff + n], strict=True)]
            own = [*x[:stiff], *part.own[stiff:]]
            q = add(part.q, times(there["ways"], v_a))
            program.add(
                f"solve{i}{added}", 4, [*q, *v_a, *part.shear, *own, *part.work, *part.lost]
            )

    def _made(self, program: Program, step: Attempt) -> tuple[Way, Way]:
        """See `ControlledStepper`."""
        r, size = step.r, self.state_layout.size
        u, stage = r.array("u", STAGES * size), r.array("stage", size)
        slope = r.array("slope", program.outputs("rate"))
        # the last has the most
        factors = r.array("factors", program.outputs("prepare" + self._rests[-1][0]))

        def attempt(t: Value, length: Value) -> None:
            step.call("prepare", t, r.state, step.length, factors)
            for k in range(STAGES):
                now = step.first
                if k:
                    now = slope
                    r.call(f"combine{k}", r.state, u, stage)
                    step.call("rate", t + length * float(ALPHA[k].sum()), stage, slope)
                self.call_formula(r, f"solve{k}", now, u, factors, step.length, u.at(k * size))
            r.call("finish", r.geometry, r.state, u, r.tol, step.following)

        def interpolate(t: Value, length: Value) -> None:
            ends = step.first, step.length, step.following, step.ending
            r.call("dense", r.state, *ends, step.inside)

        return attempt, interpolate
