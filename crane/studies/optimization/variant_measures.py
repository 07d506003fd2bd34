"""Measures of a variant of a machine, and their derivatives by the parameters that vary."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np
from scipy.optimize import minimize

from crane.common.errors import CraneError, InputError, check_name
from crane.common.samples import Array
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.statics import StaticsEvaluator
from crane.formats.machine_loading import MachineVariants
from crane.machine.machine import Machine
from crane.ratings.configuration_search import ConfigurationSearch
from crane.ratings.lifting_capacity import capacity, torques
from crane.ratings.rating_rules import Rule
from crane.studies.measures import (
    combine_task_measures,
    measure_strokes,
    measure_task,
    stroke_measures,
    task_measures,
)
from crane.studies.optimization.measure_expressions import (
    DUAL_FUNCTIONS,
    DualNumber,
    MeasureExpression,
    MeasureFunction,
    constant,
    evaluate_user_measure,
)

_DIFFERENCE_STEP = 1e-4  # share of a parameter's range
_START_COUNT = 6  # starts of the search for an extreme of the tip
_ARGUMENT_COUNTS = {"load": (2, 3), "nearest": (3, 3), "net_torque": (1, 1), "number": (1, 1)}
_FUNCTION_UNITS = {"load": "kg", "nearest": "m", "net_torque": "N m", "number": ""}
PLAIN_MEASURES = {
    "highest": "m", "lowest": "m", "mass": "kg", "gross_torque": "N m", "slewing_torque": "N m",
}  # fmt: skip


@dataclass(frozen=True)
class MeasureOptions:
    """Options of measures.

    Attributes:
        frame: Link at which loads hang; the tip if None.
        rule: Rating rule of `load` and `net_torque`.
        tasks: Tasks of peak_JOINT and similar measures.
        user_measures: Functions of the user by name, or until they are loaded the Python file that
            defines them.
    """

    frame: str | None = None
    rule: str | Rule = "none"
    tasks: tuple[str, ...] = ()
    user_measures: Any = field(default_factory=dict)


class VariantEvaluation:
    """Measures of a variant, and their derivatives by the parameters that vary.

    Derivatives of `load`, reach, highest, lowest, `nearest` and mass are exact, through the closed
    loops; all others are central differences of neighbouring variants.

    Args:
        variants: Variants of the machine.
        parameter_names: Parameters that vary, in order.
        values: (k,) values of these parameters.
        ranges: (k,) ranges of these parameters, which scale the steps of differences.
        options: Options of the measures.
        load_positions: All arguments of `load` that are needed, to compute them together.

    Raises:
        CraneError: The machine cannot be assembled with these parameters.
    """

    def __init__(
        self,
        variants: MachineVariants,
        parameter_names: Sequence[str],
        values: Array,
        ranges: Array,
        options: MeasureOptions,
        load_positions: Sequence[tuple[float, ...]] = (),
    ):
        self._variants, self._parameter_names = variants, list(parameter_names)
        self._values = values
        self._ranges, self._options, self._load_positions = ranges, options, list(load_positions)
        self.machine = variants.machine(dict(zip(parameter_names, values.tolist(), strict=True)))
        self._loads: dict[tuple[bool, tuple[float, ...]], DualNumber] = {}
        self._measure, self._extreme = cache(self._compute_measure), cache(self._find_extreme)
        self._perturbed = cache(self._create_neighbour)

    def evaluate(self, expression: MeasureExpression) -> float:
        """Return the value of an expression."""
        return _evaluate(expression, lambda *call: constant(self._measure(*call), 0), 0).value

    def evaluate_dual(self, expression: MeasureExpression) -> DualNumber:
        """Return the value of an expression with its derivatives."""
        return _evaluate(expression, self._dual_measure, len(self._parameter_names))

    def _dual_measure(self, name: str, arguments: tuple[Any, ...]) -> DualNumber:
        if name == "load":
            return self._rated_load(arguments)
        if name in ("reach", "highest", "lowest", "nearest"):
            value, q = self._extreme(name, arguments)
            return DualNumber(value, self._extreme_derivatives(name, arguments, q))
        if name == "mass":
            derivatives = np.zeros(0)
            if self._parameter_names:
                derivatives = self._statics.parameter_derivatives(
                    self.machine.home[None], self._parameter_names
                ).total_mass[0]
            return DualNumber(self._measure(name, ()), derivatives)
        if name == "number" or (name in self._variants.values and not arguments):
            parameter = str(arguments[0]) if name == "number" else name
            derivatives = np.array([float(parameter == other) for other in self._parameter_names])
            return DualNumber(self._measure(name, arguments), derivatives)
        return DualNumber(self._measure(name, arguments), self._differences(name, arguments))

    def _differences(self, name: str, arguments: tuple[Any, ...]) -> Array:
        """Return central differences of a measure; one-sided if one side cannot be assembled."""
        nominal = self._measure(name, arguments)
        out = np.zeros(len(self._parameter_names))
        for i, step in enumerate(_DIFFERENCE_STEP * self._ranges):
            signed_values = []
            for sign in (1.0, -1.0):
                try:
                    signed_values.append(
                        (sign, self._perturbed(i, sign * step)._measure(name, arguments))
                    )
                except CraneError:
                    signed_values.append((0.0, nominal))
            (upper_sign, upper_value), (lower_sign, lower_value) = signed_values
            if upper_sign == lower_sign:
                raise InputError(
                    f"'{name}' cannot be followed as '{self._parameter_names[i]}' varies"
                )
            out[i] = (upper_value - lower_value) / ((upper_sign - lower_sign) * step)
        return out

    def _create_neighbour(self, parameter_index: int, step: float) -> "VariantEvaluation":
        values = self._values.copy()
        values[parameter_index] += step
        return VariantEvaluation(
            self._variants, self._parameter_names, values, self._ranges, self._options,
            self._load_positions,
        )  # fmt: skip

    def _compute_measure(self, name: str, arguments: tuple[Any, ...]) -> float:
        machine = self.machine
        if name == "load":
            return self._rated_load(arguments, False).value
        if name in ("reach", "highest", "lowest", "nearest"):
            return self._extreme(name, arguments)[0]
        if name == "net_torque":
            return torques(
                machine, self._options.frame, radius=arguments[0], rule=self._options.rule
            ).net_torque
        if name in ("gross_torque", "slewing_torque"):
            radius = float(np.median(self._configuration_search.section_positions[:, 0]))
            result = torques(machine, self._options.frame, rule=self._options.rule, radius=radius)
            return result.gross_torque if name == "gross_torque" else result.slewing_torque
        if name == "mass":
            return float(self._statics.evaluate(machine.home[None]).total_mass[0])
        if name == "number":
            return self._parameter_value(str(arguments[0]))
        if name in self._options.user_measures:
            return evaluate_user_measure(name, self._options.user_measures[name], machine)
        if name in task_measures(machine):
            return self._task_values[name]
        if name in stroke_measures(machine):
            if name not in self._stroke_values:
                raise InputError(f"'{name}' has no value: no configuration closes")
            return self._stroke_values[name]
        return self._parameter_value(name)

    def _parameter_value(self, name: str) -> float:
        values = self._variants.values | dict(
            zip(self._parameter_names, self._values, strict=True)
        )
        if name not in values:
            known = available_measures(self.machine, self._options.user_measures)
            check_name(name, known, f"measure '{name}' is unknown")
        return float(values[name])

    @cached_property
    def _statics(self) -> StaticsEvaluator:
        return StaticsEvaluator(self.machine, self._options.frame)

    @cached_property
    def _configuration_search(self) -> ConfigurationSearch:
        return ConfigurationSearch(self.machine, self._options.frame)

    @cached_property
    def _task_values(self) -> dict[str, float]:
        if not self._options.tasks:
            raise InputError(f"'{self.machine.name}' has no task to measure it with")
        dynamics = Dynamics(self.machine)
        return combine_task_measures(
            [measure_task(self.machine, dynamics, x) for x in self._options.tasks]
        )

    @cached_property
    def _stroke_values(self) -> dict[str, float]:
        return measure_strokes(self.machine)

    def _rated_load(
        self, position: tuple[float, ...], with_derivatives: bool = True
    ) -> DualNumber:
        """Return the rated load at a position, 0 if it is out of reach, with derivatives."""
        if (with_derivatives, position) not in self._loads:
            all_positions = [
                position,
                *(x for x in self._load_positions if (with_derivatives, x) not in self._loads),
            ]
            by_slew: dict[tuple[float, ...], list[tuple[float, ...]]] = {}
            for x in all_positions:
                by_slew.setdefault(x[2:], []).append(x)
            for slews, positions in by_slew.items():
                self._compute_loads(positions, slews, with_derivatives)
        return self._loads[with_derivatives, position]

    def _compute_loads(
        self,
        positions: Sequence[tuple[float, ...]],
        slews: tuple[float, ...],
        with_derivatives: bool,
    ) -> None:
        radii, heights = (sorted({x[i] for x in positions}) for i in (0, 1))
        zero = constant(0.0, len(self._parameter_names))
        try:
            chart = capacity(
                self.machine, self._options.frame, rule=self._options.rule, radii=radii,
                heights=heights, slews=np.deg2rad(slews).tolist() or None,
            )  # fmt: skip
        except InputError as error:
            if "reaches none" not in str(error):
                raise
            self._loads |= {(with_derivatives, place): zero for place in positions}
            return
        chart_derivatives = chart.derivatives(self._parameter_names) if with_derivatives else None
        for position in positions:
            a, b = radii.index(position[0]), heights.index(position[1])
            loads = np.nan_to_num(chart.loads[:, b, a], nan=0.0)
            s = int(loads.argmin())
            if not np.isfinite(loads[s]):
                raise InputError(f"nothing limits the load at {position}, choose another position")
            load_derivatives = zero.derivatives
            if chart_derivatives is not None and loads[s] > 0:
                load_derivatives = chart_derivatives[s, b, a]
                if np.isnan(load_derivatives).any():  # limited by a pin
                    load_derivatives = self._differences("load", position)
            self._loads[with_derivatives, position] = DualNumber(float(loads[s]), load_derivatives)

    def _extreme_objective(
        self, name: str, arguments: tuple[Any, ...], tip: Array
    ) -> tuple[Array, Array]:
        """Return what is minimized (N,), and its derivatives by the tip (N, 3)."""
        if name == "nearest":
            offset = tip - np.array(arguments, dtype=float)
            length = np.linalg.norm(offset, axis=1)
            return length, offset / np.maximum(length, 1e-300)[:, None]
        up = self.machine.up_direction
        height = tip @ up
        if name in ("highest", "lowest"):
            sign = -1.0 if name == "highest" else 1.0
            return sign * height, np.broadcast_to(sign * up, tip.shape)
        horizontal = tip - height[:, None] * up
        length = np.linalg.norm(horizontal, axis=1)
        return -length, -horizontal / np.maximum(length, 1e-300)[:, None]

    def _find_extreme(self, name: str, arguments: tuple[Any, ...]) -> tuple[float, Array]:
        """Return the extreme reach, height or distance of the tip, and its configuration.

        It is searched from the best configurations over all strokes, with exact derivatives.
        """
        search, closure = self._configuration_search, self.machine.closure
        strokes = search.moving
        columns = closure.active[strokes]
        lower, stroke_lengths = search.low[strokes], (search.high - search.low)[strokes]
        values = self._extreme_objective(
            name, arguments, search.statics.evaluate(search.configurations).tip_positions
        )[0]
        order = np.argsort(values, kind="stable")
        lowest_cost, best_configuration = np.inf, search.configurations[order[0]]
        for start_index in order[:: max(1, len(order) // 50)][:_START_COUNT].tolist():
            start = search.configurations[start_index]
            last_closed = [start]

            def cost(x: Array, last: list[Array] = last_closed) -> tuple[float, Array]:
                q = last[0].copy()
                q[columns] = lower + x * stroke_lengths
                closed_configurations, is_closed = search.statics.close_loops(q[None])
                if not is_closed[0]:
                    return 1e6, np.zeros(len(x))
                last[0] = closed_configurations[0]
                statics = search.statics.evaluate(closed_configurations)
                value, gradient = self._extreme_objective(name, arguments, statics.tip_positions)
                return float(value[0]), (
                    gradient[0] @ statics.tip_jacobian[0][:, strokes]
                ) * stroke_lengths

            result = minimize(
                cost, (start[columns] - lower) / stroke_lengths, jac=True, method="L-BFGS-B",
                bounds=[(0.0, 1.0)] * len(strokes), options={"ftol": 1e-15, "gtol": 1e-10},
            )  # fmt: skip
            cost(result.x)
            if result.fun < lowest_cost:
                lowest_cost, best_configuration = float(result.fun), last_closed[0]
        sign = -1.0 if name in ("reach", "highest") else 1.0
        return sign * lowest_cost, best_configuration

    def _extreme_derivatives(self, name: str, arguments: tuple[Any, ...], q: Array) -> Array:
        """Return the derivatives at the fixed configuration of the extreme (envelope theorem)."""
        if not self._parameter_names:
            return np.zeros(0)
        tip_derivatives = self._statics.parameter_derivatives(
            q[None], self._parameter_names
        ).tip_positions[0]
        _, gradient = self._extreme_objective(
            name, arguments, self._statics.evaluate(q[None]).tip_positions
        )
        sign = -1.0 if name in ("reach", "highest") else 1.0
        return np.asarray(sign * gradient[0] @ tip_derivatives)


def _evaluate(
    expression: MeasureExpression,
    measure: Callable[[str, tuple[Any, ...]], DualNumber],
    derivative_count: int,
) -> DualNumber:
    """Return an expression of measures, each a function of its name and arguments."""

    def call(name: str, arguments: tuple[Any, ...]) -> DualNumber:
        if name in DUAL_FUNCTIONS:
            return DUAL_FUNCTIONS[name](*arguments)
        return measure(name, tuple(getattr(x, "value", x) for x in arguments))

    result: DualNumber = expression(
        lambda name: measure(name, ()), call, lambda x: constant(x, derivative_count)
    )
    return result


def available_measures(
    machine: Machine, user_measures: Mapping[str, MeasureFunction]
) -> dict[str, str]:
    """Return all measures and functions of a machine with their units."""
    return {
        **task_measures(machine), **stroke_measures(machine), **PLAIN_MEASURES, **_FUNCTION_UNITS,
        **dict.fromkeys(user_measures, ""),
    }  # fmt: skip


def check_unique_names(
    user_measures: Mapping[str, MeasureFunction], known_measures: Mapping[str, str]
) -> None:
    """Check that no function of a user has the name of a measure.

    Raises:
        InputError: One has.
    """
    for name in user_measures:
        if name in {*known_measures, *PLAIN_MEASURES, *_ARGUMENT_COUNTS, *DUAL_FUNCTIONS}:
            raise InputError(f"a measure '{name}' exists already, give yours another name")


def load_positions(expressions: Sequence[MeasureExpression]) -> list[tuple[float, ...]]:
    """Return all arguments of `load` that are numbers."""
    positions: list[tuple[float, ...]] = []

    def check_name(name: str) -> float:
        if name in _ARGUMENT_COUNTS or name in DUAL_FUNCTIONS:
            raise InputError(f"'{name}' is a function, write {name}(...)")
        return 1.0

    def collect_load(name: str, arguments: tuple[Any, ...]) -> float:
        _check_call(name, arguments)
        if name == "load" and all(isinstance(x, float) for x in arguments):
            positions.append(arguments)
        return 1.0

    for expression in expressions:
        expression(check_name, collect_load)
    return list(dict.fromkeys(positions))


def _check_call(name: str, arguments: tuple[Any, ...]) -> None:
    check_name(name, [*_ARGUMENT_COUNTS, *DUAL_FUNCTIONS], f"function '{name}' is unknown")
    text_arguments = [x for x in arguments if isinstance(x, str)]
    if text_arguments and name != "number":
        raise InputError(f"'{name}' takes numbers, not '{text_arguments[0]}'")
    if name in DUAL_FUNCTIONS:
        if not arguments or (len(arguments) > 1 and name not in ("min", "max")):
            count = "arguments" if name in ("min", "max") else "one argument"
            raise InputError(f"'{name}' takes {count}, not {len(arguments)}")
        return
    min_count, max_count = _ARGUMENT_COUNTS[name]
    if not min_count <= len(arguments) <= max_count:
        count = f"{min_count}" if min_count == max_count else f"{min_count} or {max_count}"
        raise InputError(f"'{name}' takes {count} arguments, not {len(arguments)}")
