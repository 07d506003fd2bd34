"""Measures of a variant of a machine, and their derivatives by the parameters that vary."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from crane.common.errors import CraneError, InputError, check_name
from crane.common.samples import Array
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.statics import StaticsEvaluator
from crane.formats.machine_loading import MachineVariants
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces.workspace_extremes import maximize_on_branch
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
        values: Values of the parameters that vary, by name.
        options: Options of the measures.
        load_positions: All arguments of `load` that are needed, to compute them together.
        ranges: Ranges of the k parameters by which derivatives are computed, by name; they scale
            the steps of differences.

    Raises:
        CraneError: The machine cannot be assembled with these parameters.
    """

    def __init__(
        self,
        variants: MachineVariants,
        values: Mapping[str, float],
        options: MeasureOptions,
        load_positions: Sequence[tuple[float, ...]] = (),
        ranges: Mapping[str, float] | None = None,
    ):
        self._variants, self._values, self._ranges = variants, dict(values), ranges or {}
        self._options, self._load_positions = options, list(load_positions)
        self.machine = variants.machine(self._values)
        self._loads: dict[tuple[float, ...], DualNumber] = {}
        self._measure, self._neighbour = (
            cache(self._compute_measure),
            cache(self._create_neighbour),
        )

    def evaluate(self, expression: MeasureExpression) -> DualNumber:
        """Return the value of an expression with its derivatives (k,)."""

        def call(name: str, arguments: tuple[Any, ...]) -> DualNumber:
            if name in DUAL_FUNCTIONS:
                return DUAL_FUNCTIONS[name](*arguments)
            return self._measure(name, tuple(getattr(x, "value", x) for x in arguments))

        result: DualNumber = expression(lambda name: self._measure(name, ()), call, self._constant)
        return result

    def _constant(self, value: float) -> DualNumber:
        return DualNumber(value, np.zeros(len(self._ranges)))

    def _compute_measure(self, name: str, arguments: tuple[Any, ...]) -> DualNumber:
        if name == "load":
            return self._rated_load(arguments)
        if name in ("reach", "highest", "lowest", "nearest"):
            return self._find_extreme(name, arguments)
        if name == "mass":
            home = self.machine.home[None]
            mass = self._constant(float(self._statics.evaluate(home).total_mass[0]))
            if not self._ranges:
                return mass
            slopes = self._statics.parameter_derivatives(home, list(self._ranges))
            return replace(mass, derivatives=slopes.total_mass[0])
        if name == "number" or (name in self._variants.values and not arguments):
            parameter = str(arguments[0]) if arguments else name
            derivatives = np.array([float(parameter == other) for other in self._ranges])
            return DualNumber(self._parameter_value(parameter), derivatives)
        value = self._measured_value(name, arguments)
        return DualNumber(value, self._differences(name, arguments, value))

    def _differences(self, name: str, arguments: tuple[Any, ...], nominal: float) -> Array:
        """Return central differences of a measure; one-sided if one side cannot be assembled."""
        out = np.zeros(len(self._ranges))
        for i, (parameter, interval) in enumerate(self._ranges.items()):
            step, signed_values = _DIFFERENCE_STEP * interval, []
            for sign in (1.0, -1.0):
                try:
                    neighbour = self._neighbour(parameter, sign * step)
                    signed_values.append((sign, neighbour._measure(name, arguments).value))
                except CraneError:
                    signed_values.append((0.0, nominal))
            (upper_sign, upper_value), (lower_sign, lower_value) = signed_values
            if upper_sign == lower_sign:
                raise InputError(f"'{name}' cannot be followed as '{parameter}' varies")
            out[i] = (upper_value - lower_value) / ((upper_sign - lower_sign) * step)
        return out

    def _create_neighbour(self, parameter: str, step: float) -> "VariantEvaluation":
        values = self._values | {parameter: self._values[parameter] + step}
        return VariantEvaluation(self._variants, values, self._options, self._load_positions)

    def _measured_value(self, name: str, arguments: tuple[Any, ...]) -> float:
        """Return the value of a measure without exact derivatives."""
        machine = self.machine
        if name == "net_torque":
            return torques(
                machine, self._options.frame, radius=arguments[0], rule=self._options.rule
            ).net_torque
        if name in ("gross_torque", "slewing_torque"):
            radius = float(np.median(self._configuration_search.section_positions[:, 0]))
            result = torques(machine, self._options.frame, rule=self._options.rule, radius=radius)
            return result.gross_torque if name == "gross_torque" else result.slewing_torque
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
        values = self._variants.values | self._values
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

    def _rated_load(self, position: tuple[float, ...]) -> DualNumber:
        """Return the rated load at a position, 0 if it is out of reach, with derivatives."""
        if position not in self._loads:
            by_slew: dict[tuple[float, ...], list[tuple[float, ...]]] = {}
            for x in (position, *(x for x in self._load_positions if x not in self._loads)):
                by_slew.setdefault(x[2:], []).append(x)
            for slews, positions in by_slew.items():
                self._compute_loads(positions, slews)
        return self._loads[position]

    def _compute_loads(
        self, positions: Sequence[tuple[float, ...]], slews: tuple[float, ...]
    ) -> None:
        radii, heights = (sorted({x[i] for x in positions}) for i in (0, 1))
        try:
            chart = capacity(
                self.machine, self._options.frame, rule=self._options.rule, radii=radii,
                heights=heights, slews=np.deg2rad(slews).tolist() or None,
            )  # fmt: skip
        except InputError as error:
            if "reaches none" not in str(error):
                raise
            self._loads |= {place: self._constant(0.0) for place in positions}
            return
        chart_derivatives = chart.derivatives(list(self._ranges)) if self._ranges else None
        for position in positions:
            a, b = radii.index(position[0]), heights.index(position[1])
            loads = np.nan_to_num(chart.loads[:, b, a], nan=0.0)
            s = int(loads.argmin())
            if not np.isfinite(loads[s]):
                raise InputError(f"nothing limits the load at {position}, choose another position")
            load = self._constant(float(loads[s]))
            if chart_derivatives is not None and load.value > 0:
                load = replace(load, derivatives=chart_derivatives[s, b, a])
            if np.isnan(load.derivatives).any():  # limited by a pin
                load = replace(load, derivatives=self._differences("load", position, load.value))
            self._loads[position] = load

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

    def _find_extreme(self, name: str, arguments: tuple[Any, ...]) -> DualNumber:
        """Return the extreme reach, height or distance of the tip.

        It is searched from the best configurations over all strokes, with exact derivatives. Its
        derivatives are those at its fixed configuration (envelope theorem).
        """
        search, kinematics = (
            self._configuration_search,
            Kinematics(self.machine, self._statics.frame),
        )

        def objective(q: Array) -> tuple[float, Array]:
            tip = kinematics.position_at_configuration(q)[None]
            values, gradients = self._extreme_objective(name, arguments, tip)
            return -float(values[0]), -gradients[0] @ kinematics.tree_jacobian(q)

        tips = self._statics.evaluate(search.configurations).tip_positions
        order = np.argsort(self._extreme_objective(name, arguments, tips)[0], kind="stable")
        found = [
            maximize_on_branch(
                self.machine, q, search.moving, (search.low, search.high), objective
            )
            for q in search.configurations[order[:: max(1, len(order) // 50)][:_START_COUNT]]
        ]
        value, best = max(found, key=lambda pair: pair[0])
        sign, q = 1.0 if name in ("reach", "highest") else -1.0, best[None]
        extreme = self._constant(sign * value)
        if not self._ranges:
            return extreme
        tips = self._statics.evaluate(q).tip_positions
        gradient = -sign * self._extreme_objective(name, arguments, tips)[1][0]
        derivatives = self._statics.parameter_derivatives(q, list(self._ranges))
        return replace(extreme, derivatives=gradient @ derivatives.tip_positions[0])


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


def unique_names(
    label: str, available: Mapping[str, object], requested: Sequence[str] | None
) -> tuple[str, ...]:
    """Return the requested names without repetitions; all by default."""
    for name in requested or ():
        check_name(name, available, f"{label} '{name}' is unknown")
    return tuple(dict.fromkeys(available if requested is None else requested))


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
