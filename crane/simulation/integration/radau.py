"""Steps of an implicit method of fifth order in machine code, which nothing stiff shortens.

Radau IIA of three stages with its embedded method of order 3 (Hairer and Wanner, Solving Ordinary
Differential Equations II, IV.8, from where the coefficients are).
"""

import numpy as np

from crane.closure.traced import largest_share
from crane.codegen import Layout, Number, Program, Tape, Value, select
from crane.codegen.factors import Matrix, eliminated, substituted
from crane.codegen.representation import Array as Place
from crane.codegen.scalar import add, apply, dot, maximum, minimum, scale, subtract, times
from crane.common.samples import Array
from crane.control import TracedController
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.controlled import ControlledStepper, errors_of
from crane.simulation.integration.step_loop import SLOWER, Attempt, Way

TOLERANCE = 1e-9  # error of a step, per size of the state
_ROOT = np.sqrt(6.0)
NODES = np.array([(4.0 - _ROOT) / 10.0, (4.0 + _ROOT) / 10.0, 1.0])
# of the inverse of the method's matrix the eigenvalues, and in whose basis
REAL = 3.0 + 3.0 ** (2 / 3) - 3.0 ** (1 / 3)
COMPLEX = (
    3.0 + 0.5 * (3.0 ** (1 / 3) - 3.0 ** (2 / 3)),
    -0.5 * (3.0 ** (5 / 6) + 3.0 ** (7 / 6)),
)
BASIS = np.array([
    [0.09443876248897524, -0.14125529502095421, 0.03002919410514742],
    [0.25021312296533332, 0.20412935229379994, -0.38294211275726192],
    [1.0, 1.0, 0.0],
])  # fmt: skip
INVERSE = np.array([
    [4.17871859155190428, 0.32768282076106237, 0.52337644549944951],
    [-4.17871859155190428, -0.32768282076106237, 0.47662355450055044],
    [0.50287263494578682, -2.57192694985560522, 0.59603920482822492],
])  # fmt: skip
ERROR = np.array([-13.0 - 7.0 * _ROOT, -13.0 + 7.0 * _ROOT, -1.0]) / 3.0
# the stages' polynomial: x, x^2, x^3 by stage
POWERS = np.array([
    [13.0 / 3.0 + 7.0 * _ROOT / 3.0, -23.0 / 3.0 - 22.0 * _ROOT / 3.0, 10.0 / 3.0 + 5.0 * _ROOT],
    [13.0 / 3.0 - 7.0 * _ROOT / 3.0, -23.0 / 3.0 + 22.0 * _ROOT / 3.0, 10.0 / 3.0 - 5.0 * _ROOT],
    [1.0 / 3.0, -8.0 / 3.0, 10.0 / 3.0],
])  # fmt: skip
STAGES = 3
Pair = tuple[Number, Number]
"""A complex number."""
_NUDGE = 1e-7  # of rad, machine's size, per `Closure.pace`, by which derivatives are taken
_TRIES, _CLOSE = 8, 1e-3  # of Newton's method; what is left then, per error of a step
_QUICK = 1e-3  # rate of its convergence with which derivatives stay as they are
_FASTER, _SAFETY = 8.0, 0.9  # change of the step's length from one to the next
_BETWEEN = 0.07  # of how far slopes at the beginning are off, what interpolation is


class Shift:
    """An eigenvalue over the length of a step, as formulas, and one over it.

    Args:
        name: "real" or "complex".
        h: Length of the step.

    Attributes:
        complex: Whether it is.
        value: Real and imaginary part.
        inverse: Likewise.
    """

    def __init__(self, name: str, h: Number):
        self.complex = name == "complex"
        a, b = COMPLEX if self.complex else (REAL, 0.0)
        size = a * a + b * b
        per: Number = 1.0 / h
        self.value: Pair = (a * per, b * per)
        self.inverse: Pair = (a / size * h, -b / size * h)


class RadauStepper(ControlledStepper):
    """See above; `tolerance` is that of `errors_of`, and the nudges of v_A, q_A, own.

    Derivatives are differences of the compiled rates along v_A, along the ways dq/dv_A that it
    moves the joints, and along the controller's states. With T = dq'/dv_A, G = dq'/dq_A and a
    shift mu the linear systems (mu - J) x = r are

        mu x_q = r_q + T x_v + G xi,    mu xi = r_qA + x_v,
        [mu M - M J_vv - M J_vq / mu] x_v - M J_vo x_o = M (r_v + J_vq r_qA / mu)

    and the rows of the controller's states o, solved as formulas for the real and the complex
    eigenvalue over the length of the step.

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
        closure = chart.machine.closure
        active = closure.units[closure.active]
        rates = active / closure.pace
        self._n, self._own = len(active), states
        nudges = _NUDGE * np.concatenate([rates, active, np.ones(states)])
        both = np.concatenate([errors_of(chart, states, tolerance), nudges])
        super().__init__(chart, control, states, ("radau",), False, both)

    @property
    def _blocks(self) -> Layout:
        """What the derivatives are, as formulas pass them on."""
        n, k, nq = self._n, self._own, self.state_layout.parts["q"]
        return Layout(
            ways=nq * n, bends=nq * n, oo=k * k, ov=k * n, oq=k * n, vo=n * k, vv=n * n,
            vq=n * n, mass=n * n, free=n,
        )  # fmt: skip

    def _add_method(self, program: Program) -> None:
        size, n = self.state_layout.size, self._n
        for added, rest in self._rests:
            sweep = self._driven(Tape())[0].sweep
            mass = [x for row in sweep.mass for x in row]
            program.add("mass" + added, 5, [*mass, *(sweep.free if rest else [1.0] * n)])
        tape = Tape()
        moved = add(tape.loads(0, 0, size), tape.loads(1, 0, size))
        program.add("moved", 2, moved)
        # directions(tol): v_A and own by their nudges; bent(first, bumped, tol): q_A along ways
        start = self._start
        tape = Tape()
        along: list[Number] = []
        for j in range(n):
            row: list[Number] = [0.0] * size
            row[self.state_layout.start("v_a") + j] = tape.load(0, start + j)
            along += row
        for j in range(self._own):
            row = [0.0] * size
            row[self.state_layout.start("own") + j] = tape.load(0, start + 2 * n + j)
            along += row
        program.add("directions", 1, along)
        tape = Tape()
        along = []
        for j in range(n):
            reach = tape.load(2, start + n + j) / tape.load(2, start + j)
            now = tape.loads(0, 0, self.state_layout.parts["q"])
            there = tape.loads(1, j * size, self.state_layout.parts["q"])
            row = [0.0] * size
            row[: len(now)] = scale(reach, subtract(there, now))
            along += row
        program.add("bent", 3, along)
        self._add_jacobian(program)
        for name in ("real", "complex"):
            tape = Tape()
            parts = self._loaded(tape, 0)
            rows = self._matrix(parts, Shift(name, tape.load(1, 0)))
            program.add(f"{name}_factors", 2, [x for row in eliminated(rows) for x in row])
        self._add_newton(program)
        self._add_ends(program)

    @property
    def _start(self) -> int:
        """Where the nudges are in `tolerance`."""
        return self.state_layout.size + 1

    def _add_jacobian(self, program: Program) -> None:
        """jacobian(first, by v and own, by q, mass, tol)."""
        size, n, k, start = self.state_layout.size, self._n, self._own, self._start
        tape = Tape()
        first = self.state_layout.view(tape.loads(0, 0, size))

        def slopes(array: int, column: int, nudge: int) -> list[list[Number]]:
            there = self.state_layout.view(tape.loads(array, column * size, size))
            by = 1.0 / tape.load(4, start + nudge)
            return [
                scale(by, subtract(getattr(there, part), getattr(first, part)))
                for part in ("q", "v_a", "own")
            ]

        by_v = [slopes(1, j, j) for j in range(n)]
        by_o = [slopes(1, n + j, 2 * n + j) for j in range(k)]
        by_q = [slopes(2, j, n + j) for j in range(n)]
        mass = [tape.loads(3, i * n, n) for i in range(n)]

        def rows(columns: list[list[list[Number]]], part: int) -> Matrix:
            return [list(row) for row in zip(*(column[part] for column in columns), strict=True)]

        def weighed(columns: list[list[list[Number]]]) -> Matrix:
            found = rows(columns, 1)
            across = [list(column) for column in zip(*found, strict=True)]
            return [[dot(row, column) for column in across] for row in mass]

        outputs = {
            "ways": rows(by_v, 0), "bends": rows(by_q, 0), "oo": rows(by_o, 2),
            "ov": rows(by_v, 2), "oq": rows(by_q, 2), "vo": weighed(by_o), "vv": weighed(by_v),
            "vq": weighed(by_q), "mass": mass, "free": [tape.loads(3, n * n, n)],
        }  # fmt: skip
        flat = {name: [x for row in table for x in row] for name, table in outputs.items()}
        program.add("jacobian", 5, flat)

    def _loaded(self, tape: Tape, array: int) -> dict[str, Matrix]:
        """`jacobian`, read from an argument."""
        n, k, layout = self._n, self._own, self._blocks
        columns = {"oo": k, "vo": k}
        out = {}
        for name, count in layout.parts.items():
            width = columns.get(name, n)
            flat = tape.loads(array, layout.start(name), count)
            out[name] = [flat[i : i + width] for i in range(0, count, width)] if width else []
        return out

    def _matrix(self, parts: dict[str, Matrix], shift: Shift) -> Matrix:
        """The rows of own and v_A, real; the complex one as twice as many real ones."""
        n, k = self._n, self._own
        real: Matrix = []
        imaginary: Matrix = []
        along: list[Pair]
        own: list[Pair]
        for i in range(k):
            along = [
                _plus((-1.0 * one, 0.0), _times(shift.inverse, -1.0 * other))
                for one, other in zip(parts["ov"][i], parts["oq"][i], strict=True)
            ]
            own = [(-1.0 * x, 0.0) for x in parts["oo"][i]]
            own[i] = _plus(own[i], shift.value)
            real.append([x for x, _ in (*own, *along)])
            imaginary.append([y for _, y in (*own, *along)])
        for i in range(n):
            own = [(-1.0 * x, 0.0) for x in parts["vo"][i]] if k else []
            along = [
                _plus(
                    _plus((-1.0 * v, 0.0), _times(shift.inverse, -1.0 * q)),
                    _times(shift.value, m),
                )
                for v, q, m in zip(parts["vv"][i], parts["vq"][i], parts["mass"][i], strict=True)
            ]
            real.append([x for x, _ in (*own, *along)])
            imaginary.append([y for _, y in (*own, *along)])
        if not shift.complex:
            return real
        return [
            *([*a, *scale(-1.0, b)] for a, b in zip(real, imaginary, strict=True)),
            *([*b, *a] for a, b in zip(real, imaginary, strict=True)),
        ]

    def _solved(
        self, parts: dict[str, Matrix], factors: Matrix, shift: Shift, right: list[list[Number]]
    ) -> list[list[Number]]:
        """The x of (mu - J) x = r; real and imaginary parts of both where mu is complex."""
        n, k, active = self._n, self._own, self._chart.machine.closure.active.tolist()
        views = [self.state_layout.view(one) for one in right]

        def turned(values: list[list[Number]]) -> list[list[Number]]:
            """Over mu."""
            if not shift.complex:
                return [scale(shift.inverse[0], values[0])]
            a, b = shift.inverse
            one, other = values
            return [
                subtract(scale(a, one), scale(b, other)), add(scale(b, one), scale(a, other)),
            ]  # fmt: skip

        here = turned([[view.q[i] for i in active] for view in views])
        wanted: list[Number] = []
        for view, rho in zip(views, here, strict=True):
            wanted += add(list(view.own), times(parts["oq"], rho)) if k else []
            wanted += add(times(parts["mass"], view.v_a), times(parts["vq"], rho))
        x = substituted(factors, wanted)
        m = n + k
        own = [x[i * m : i * m + k] for i in range(len(views))]
        v_a = [
            [w * y for w, y in zip(parts["free"][0], x[i * m + k : (i + 1) * m], strict=True)]
            for i in range(len(views))
        ]
        xi = [
            add(rho, one) for rho, one in zip(here, turned(v_a), strict=True)
        ]  # (r_qA + x_v) / mu
        ways = [
            add(view.q, times(parts["ways"], one), times(parts["bends"], other))
            for view, one, other in zip(views, v_a, xi, strict=True)
        ]
        q = turned([list(row) for row in ways])
        rest = turned([[*view.work, *view.lost] for view in views])
        return [[*a, *b, *c, *d] for a, b, c, d in zip(q, v_a, own, rest, strict=True)]

    def _factors(self, tape: Tape, array: int, twice: int) -> Matrix:
        m = twice * (self._n + self._own)
        flat = tape.loads(array, 0, m * m)
        return [flat[i : i + m] for i in range(0, m * m, m)]

    def _add_newton(self, program: Program) -> None:
        """start(state, Z before, ratio); newton(state, J, real, complex, F, W, h, tol)."""
        size = self.state_layout.size
        tape = Tape()
        state, ratio = tape.loads(0, 0, size), tape.load(2, 0)
        before = [tape.loads(1, i * size, size) for i in range(STAGES)]
        guess = []
        for node in NODES.tolist():
            x = 1.0 + node * ratio
            weights = [dot(row, [x, x * x, x * x * x]) for row in POWERS.tolist()]
            weights[2] = weights[2] - 1.0
            guess.append([dot(weights, column) for column in zip(*before, strict=True)])
        outputs = self._stage_outputs(state, guess, _combined(INVERSE, guess))
        program.add("start", 3, outputs)
        tape = Tape()
        state, h = tape.loads(0, 0, size), tape.load(6, 0)
        parts = self._loaded(tape, 1)
        rates = [tape.loads(4, i * size, size) for i in range(STAGES)]
        W = [tape.loads(5, i * size, size) for i in range(STAGES)]
        real, other = Shift("real", h), Shift("complex", h)
        turned = _combined(INVERSE, rates)
        right = subtract(turned[0], scale(real.value[0], W[0]))
        a, b = other.value
        pair = [
            subtract(turned[1], subtract(scale(a, W[1]), scale(b, W[2]))),
            subtract(turned[2], add(scale(b, W[1]), scale(a, W[2]))),
        ]
        change = self._solved(parts, self._factors(tape, 2, 1), real, [right])
        change += self._solved(parts, self._factors(tape, 3, 2), other, pair)
        W = [add(one, by) for one, by in zip(W, change, strict=True)]
        norm: Number = 0.0
        shares = self._shares(tape, 7, state, state)
        for row in change:
            for x, share in zip(row, shares, strict=False):
                norm = norm + (x * share) * (x * share)
        norm = apply("sqrt", norm * (1.0 / (3.0 * len(shares))))
        outputs = self._stage_outputs(state, _combined(BASIS, W), W)
        program.add("newton", 8, {**outputs, "norm": [norm]})

    def _stage_outputs(
        self, state: list[Number], Z: list[list[Number]], W: list[list[Number]]
    ) -> dict[str, list[Number]]:
        return {
            "W": [x for row in W for x in row],
            "Z": [x for row in Z for x in row],
            "stages": [x for row in Z for x in add(state, row)],
        }

    def _add_ends(self, program: Program) -> None:
        """estimate(J, real, rate, Z, h); finish(numbers, state, Z, e, first, h, tol); dense(Z)."""
        size, nq = self.state_layout.size, self.state_layout.parts["q"]
        tape = Tape()
        h = tape.load(4, 0)
        Z = [tape.loads(3, i * size, size) for i in range(STAGES)]
        rate = tape.loads(2, 0, size)
        sums = [dot(ERROR.tolist(), column) for column in zip(*Z, strict=True)]
        right = add(rate, scale(1.0 / h, sums))
        parts, factors = self._loaded(tape, 0), self._factors(tape, 1, 1)
        (error,) = self._solved(parts, factors, Shift("real", h), [right])
        program.add("estimate", 5, error)
        tape = Tape()
        state, h = tape.loads(1, 0, size), tape.load(5, 0)
        Z = [tape.loads(2, i * size, size) for i in range(STAGES)]
        error, first = tape.loads(3, 0, size), tape.loads(4, 0, size)
        after = add(state, Z[2])
        shares = self._shares(tape, 6, state, after)
        total: Number = 0.0
        for x, share in zip(error, shares, strict=False):
            total = total + (x * share) * (x * share)
        norm = apply("sqrt", total * (1.0 / len(shares)))
        # what is between: the stages' polynomial against the cubic that begins as the motion does
        # and ends where the stages do
        middle: Number = 0.0
        for i in range(nq):
            c = [dot([Z[j][i] for j in range(STAGES)], column) for column in POWERS.T.tolist()]
            gap = c[0] - h * first[i]
            middle = middle + (gap * shares[i] * _BETWEEN) * (gap * shares[i] * _BETWEEN)
        norm = maximum(norm, apply("sqrt", middle * (1.0 / nq)))
        long = [not turns for turns in self.closure_code.geometry.revolute[1:]]
        move = largest_share(Z[2][:nq], long, self.closure_code.per_size(tape))
        norm = self._followed(norm, move)
        usable = minimum(maximum(norm, 1e-9), 1e9)
        change = _SAFETY * apply("exp", (-1.0 / 4.0) * apply("log", usable))
        change = minimum(maximum(change, SLOWER), _FASTER)
        outputs = {"state": after, "error": [norm], "change": [change], "move": [move]}
        program.add("finish", 7, outputs)
        # x (Q0 + Q1 x + Q2 x^2) as x (c0 + (1 - x) (c1 + x c2))
        tape = Tape()
        Z = [tape.loads(0, i * size, size) for i in range(STAGES)]
        Q = [[dot(column, z) for z in zip(*Z, strict=True)] for column in POWERS.T.tolist()]
        parts_of = [add(*Q), scale(-1.0, add(Q[1], Q[2])), scale(-1.0, Q[2])]
        program.add("dense", 1, [x for row in parts_of for x in row])

    def _made(self, program: Program, step: Attempt) -> tuple[Way, Way]:
        """See `ControlledStepper`."""
        r, size, n, k = step.r, self.state_layout.size, self._n, self._own
        columns, m = n + k, n + k
        directions = r.array("directions", columns * size)
        bent = r.array("bent", max(1, n * size))
        # a rate has more behind it, which the next one replaces
        more = program.outputs("rate").size - size
        bumped, curved = (r.array(x, columns * size + more) for x in ("bumped", "curved"))
        mass, stage = r.array("mass", n * n + n), r.array("stage", size)
        jacobian = r.array("jacobian", program.outputs("jacobian"))
        real, pair = r.array("real", m * m), r.array("pair", 4 * m * m)
        rates = r.array("rates", STAGES * size + more)
        slope = r.array("slope", size + more)
        iterate = r.array("iterate", program.outputs("newton"))
        kept, ratio = r.array("kept", STAGES * size), r.array("ratio", 1)
        wrong = r.array("wrong", size)
        known, theta, before = r.let(-np.inf), r.let(1.0), r.let(0.0)
        r.call("directions", r.tol, directions)
        with r.loop(r.let(STAGES * size)) as i:
            r.store(kept, i, 0.0)

        def along(t: Value, count: int, ways: Place, out: Place) -> None:
            with r.loop(r.let(count)) as i:
                r.call("moved", r.state, ways.row(i, size), stage)
                step.call("rate", t, stage, out.row(i, size))

        def attempt(t: Value, length: Value) -> None:
            with r.when((t > known) & (theta > _QUICK)):
                step.call("mass", t, r.state, mass)
                along(t, columns, directions, bumped)
                r.call("bent", step.first, bumped, r.tol, bent)
                along(t, n, bent, curved)
                r.call("jacobian", step.first, bumped, curved, mass, r.tol, jacobian)
                r.set(known, t)
            r.call("real_factors", jacobian, step.length, real)
            r.call("complex_factors", jacobian, step.length, pair)
            r.store(ratio, 0, select(before > 0.0, length / before, 0.0))
            r.call("start", r.state, kept, ratio, iterate)
            tries, done, norm = r.let(0), r.let(0), r.let(0.0)
            with r.forever():
                for i in range(STAGES):
                    at = iterate.at("stages").at(i * size)
                    step.call("rate", t + length * float(NODES[i]), at, rates.at(i * size))
                r.call(
                    "newton", r.state, jacobian, real, pair, rates, iterate.at("W"), step.length,
                    r.tol, iterate,
                )  # fmt: skip
                r.set(tries, tries + 1)
                last = r.let(norm)
                r.set(norm, iterate["norm"])
                with r.when(tries > 1):
                    r.set(theta, norm / last)
                    with r.when(theta * norm < (theta * -1.0 + 1.0) * _CLOSE):
                        r.set(done, 1)
                    with r.when(~(theta < 1.0)):
                        r.set(done, 0)
                        r.set(tries, _TRIES)
                with r.when(norm < 1e-3 * _CLOSE):
                    r.set(done, 1)
                with r.when((done > 0) | (tries >= _TRIES)):
                    r.leave()
            Z = iterate.at("Z")
            r.call("estimate", jacobian, real, step.first, Z, step.length, wrong)
            ends = Z, wrong, step.first, step.length, r.tol, step.following
            r.call("finish", r.geometry, r.state, *ends)
            with r.when(step.following["error"] > 1.0):
                r.call("moved", r.state, wrong, stage)
                step.call("rate", t, stage, slope)
                r.call("estimate", jacobian, real, slope, Z, step.length, wrong)
                r.call("finish", r.geometry, r.state, *ends)
            with r.when(done < 1):
                r.store(step.following.at("error"), 0, 2.0)
                r.store(step.following.at("change"), 0, 0.25)
                r.set(theta, 1.0)
                r.set(known, select(known < t, -np.inf, known))
            with r.otherwise():
                r.copy(kept, Z, STAGES * size)
                r.set(before, select(step.following["error"] <= 1.0, length, 0.0))

        def interpolate(t: Value, length: Value) -> None:
            r.call("dense", iterate.at("Z"), step.inside)

        return attempt, interpolate


def _plus(one: Pair, other: Pair) -> Pair:
    return one[0] + other[0], one[1] + other[1]


def _times(one: Pair, by: Number) -> Pair:
    return one[0] * by, one[1] * by


def _combined(weights: Array, rows: list[list[Number]]) -> list[list[Number]]:
    """Sums of rows by weights."""
    columns = list(zip(*rows, strict=True))
    return [[dot(row, column) for column in columns] for row in weights.tolist()]
