"""Rating charts: the largest load or force over radius and height, and its limiting factors."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError
from crane.common.samples import Array, as_number, as_sample
from crane.dynamics.statics import StaticQuantities
from crane.dynamics.tipping_stability import TippingStability
from crane.machine.machine import Machine
from crane.ratings.configuration_search import (
    ConfigurationSearch,
    ConfigurationSet,
    ValueFunction,
)
from crane.ratings.limiting_factors import (
    TIPPING,
    LimitingFactor,
    LoadLimits,
    RatingConditions,
)
from crane.ratings.rating_derivatives import (
    SIMULTANEOUS_TOLERANCE,
    rating_derivatives,
)
from crane.ratings.rating_rules import slew_angles
from crane.ratings.strokes import Strokes
from crane.recordings.timeseries import Table, write_table

# largest number of cells along the larger extent, by the number of free strokes
_DEFAULT_CELLS = {0: 100, 1: 75, 2: 40}
_ROUND_STEPS = (1.0, 2.5, 5.0, 10.0)  # multiples of a quarter, for tables by 0.5, 1, 1.5 ... m
_DIGITS = 12  # decimal places of positions
_MAX_CELLS = 400  # cells along one axis


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class RatingValues(RatingConditions):
    """The largest loads or forces at the postures of a grid (b, a).

    Attributes:
        slews: (s,) angles of the slewing joint [rad]; one, at home, if nothing slews.
        limiting_factors: Limiting factors.
        values: (s, b, a) largest load [kg] or force [N]; NaN where the frame does not reach,
            infinite where there is no limit.
        limiting_factor_index: (s, b, a) index of the limiting factor, the first one of several
            simultaneous ones; -1 where there is no limit.
        values_by_factor: (s, b, a, K) values by limiting factor.
        q_a: (s, b, a, n) active coordinates of the configuration with the largest value.

    The attributes of `RatingConditions` come first.
    """

    slews: Array
    limiting_factors: tuple[LimitingFactor, ...]
    values: Array
    limiting_factor_index: NDArray[np.intp]
    values_by_factor: Array
    q_a: Array

    quantity: ClassVar[tuple[str, str]] = ("value", "1")

    @property
    def active_factors(self) -> tuple[int, ...]:
        """Indices of the factors that limit the value at some position."""
        index = self.limiting_factor_index
        return tuple(np.unique(index[index >= 0]).tolist())

    @property
    def simultaneous_factors(self) -> NDArray[np.bool_]:
        """(s, b, a, K) which factors limit the value; several if the best configuration has."""
        return _simultaneous_factors(self.values_by_factor, self.values)

    def file_notes(self) -> dict[str, str]:
        """Return further notes for the head of a file: the rule."""
        return {"rule": self.rule.description}

    def to_csv(self, path: str | Path) -> None:
        """Write one row per posture: slew, place, value, limiting factor, coordinates.

        Values by limiting factor precede the active coordinates.

        Raises:
            OutputError: The file cannot be written.
        """
        machine, (name, unit) = self.machine, self.quantity
        units = {
            "cause": "1",
            **{
                "_".join([name, *factor.reason.split(), *factor.element.split()]): unit
                for factor in self.limiting_factors
            },
            **{joint: machine.unit(joint) for joint in machine.active},
        }
        indices = np.nonzero(np.isfinite(self.values) | (self.limiting_factor_index >= 0))
        columns: tuple[Any, ...] = self.limiting_factor_index, self.values_by_factor, self.q_a
        notes = {f"cause {k}": str(factor) for k, factor in enumerate(self.limiting_factors)}
        self._write_rows(path, indices, units, [x[indices] for x in columns], notes)

    def _places(self, b: Any, a: Any) -> dict[str, tuple[str, Array]]:
        raise NotImplementedError  # units and values of the columns of the place, by name

    def _write_rows(
        self,
        path: str | Path,
        indices: tuple[Any, ...],
        units: dict[str, str],
        columns: Sequence[Array],
        notes: dict[str, str],
    ) -> None:
        (name, unit), places = self.quantity, self._places(*indices[1:])
        units = {"slew": "rad", **{x: u for x, (u, _) in places.items()}, name: unit, **units}
        values = (x for _, x in places.values())
        rows = np.column_stack([self.slews[indices[0]], *values, self.values[indices], *columns])
        rows[~np.isfinite(rows)] = np.nan
        head = {"machine": self.machine.load_expression, "frame": self.frame, **self.file_notes()}
        write_table(path, Table(units, rows, head | notes))


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class RatingChart(RatingValues):
    """The largest load or force over radius and height.

    Attributes:
        radii: (a,) first coordinate of the section [m], usually the distance from the slewing
            axis.
        heights: (b,) second coordinate [m].

    The attributes of `RatingValues` come first.
    """

    places: ConfigurationSearch
    radii: Array
    heights: Array

    @property
    def positions(self) -> Array:
        """(b, a, 2) radius and height of the values [m]."""
        return np.stack(np.meshgrid(self.radii, self.heights), axis=-1)

    def derivatives(self, parameter_names: Sequence[str]) -> Array:
        """Compute derivatives of the values by parameters, see `rating_derivatives`.

        Args:
            parameter_names: Such as "boom_eye.x" or "cylinder.X_boom.area_a".

        Returns:
            (s, b, a, k) per unit of each parameter; NaN where there is no positive finite value,
            or where a pin limits it.

        Raises:
            InputError: A parameter does not exist, or it moves a support.
        """
        out = np.full((*self.values.shape, len(parameter_names)), np.nan)
        s, b, a = np.nonzero(np.isfinite(self.values) & (self.values > 0))
        out[s, b, a] = rating_derivatives(
            self, self.q_a[s, b, a], self.slews[s], self.values[s, b, a], parameter_names
        )
        return out

    def at_positions(self, radii: Sequence[float], heights: Sequence[float]) -> Self:
        """Return the same rating at other radii and heights [m]."""
        slews = None if self.section.slewing_joint is None else self.slews.tolist()
        return compute_chart(type(self), self, slews=slews, radii=radii, heights=heights)

    def derivatives_to_csv(self, path: str | Path, parameter_names: Sequence[str]) -> None:
        """Write one row per position: slew, radius, height, value, derivatives by parameters.

        Raises:
            InputError: See `derivatives`.
            OutputError: The file cannot be written.
        """
        name, unit = self.quantity
        units = {f"{name}_by_{parameter}": f"{unit}/SI" for parameter in parameter_names}
        indices = np.nonzero(np.isfinite(self.values))
        self._write_rows(path, indices, units, [self.derivatives(parameter_names)[indices]], {})

    def _places(self, b: Any, a: Any) -> dict[str, tuple[str, Array]]:
        return {"radius": ("m", self.radii[a]), "height": ("m", self.heights[b])}


ChartType = TypeVar("ChartType", bound=RatingChart)


def compute_chart(
    chart_class: type[ChartType],
    conditions: RatingConditions,
    *,
    slews: Sequence[float] | None = None,
    step: float | None = None,
    radii: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
    **attributes: Any,
) -> ChartType:
    """Compute a rating chart.

    Args:
        chart_class: Class of the result.
        conditions: Conditions of the rating.
        slews: Angles of the slewing joint, see `capacity` [rad].
        step: Distance between positions [m].
        radii: Radii, in place of a step [m].
        heights: Heights, in place of a step [m].
        **attributes: Further attributes of the result.

    Raises:
        InputError: See `capacity`.
    """
    search = conditions.places
    assert isinstance(search, ConfigurationSearch)
    axes = _chart_axes(search, step, radii, heights)
    configurations = search.find_all(axes)
    if not len(configurations.position_index):
        raise InputError(f"'{conditions.frame}' reaches none of these positions, give others")

    def select(evaluate: ValueFunction) -> ConfigurationSet:
        return search.select_best(
            configurations, axes, lambda q, statics: np.asarray(evaluate(q, statics).min(axis=1))
        )[0]

    rated = rate_postures(conditions, (len(axes[1]), len(axes[0])), select, slews)
    return chart_class(**rated, radii=axes[0], heights=axes[1], **attributes)


def rate_postures(
    conditions: RatingConditions,
    grid: tuple[int, int],
    select: Callable[[ValueFunction], ConfigurationSet],
    slews: Sequence[float] | None = None,
) -> dict[str, Any]:
    """Rate the postures of a grid, and return the attributes of `RatingValues`.

    Args:
        conditions: Conditions of the rating.
        grid: Shape (b, a) of the grid.
        select: Chooses the configurations by their values, with their indices in the grid.
        slews: Angles of the slewing joint, see `capacity` [rad].

    Raises:
        InputError: A slew angle is beyond the limits, or the supports have another outline there.
    """
    machine, places, limits = conditions.machine, conditions.places, conditions.load_limits()
    can_tip = any(factor.reason == TIPPING for factor in limits.factors)
    slew_coordinates = _slew_coordinates(machine, places, slews, can_tip)
    shape = (len(slew_coordinates), grid[0] * grid[1])
    values_by_factor = np.full((*shape, len(limits.factors)), np.nan)
    q_a = np.full((*shape, len(machine.active)), np.nan)
    slewing_joint, active = places.section.slewing_joint, machine.closure.active
    angles = slew_angles(machine, places.section, slew_coordinates)
    if can_tip and slewing_joint is not None:  # the supports have the outline of home
        slewed = np.tile(machine.home[active], (len(slew_coordinates), 1))
        slewed[:, slewing_joint] = slew_coordinates
        TippingStability(machine).static_margins(slewed)
    for k, slew_coordinate in enumerate(slew_coordinates):
        evaluate = partial(_values_by_factor, conditions, limits, slew_coordinate, angles[k])
        best = select(evaluate)
        values_by_factor[k, best.position_index] = evaluate(best.q, best.statics)
        q_a[k, best.position_index] = best.q[:, active]
        if slewing_joint is not None:
            q_a[k, best.position_index, slewing_joint] = slew_coordinate
    smallest = np.where(np.isnan(values_by_factor), np.inf, values_by_factor).min(axis=2)
    smallest = np.where(np.isfinite(q_a[..., 0]), smallest, np.nan)
    first_factor = _simultaneous_factors(values_by_factor, smallest).argmax(axis=2)
    full = (len(slew_coordinates), *grid)
    return {
        **{x.name: getattr(conditions, x.name) for x in dataclasses.fields(RatingConditions)},
        "slews": slew_coordinates,
        "limiting_factors": limits.factors,
        "values": smallest.reshape(full),
        "limiting_factor_index": np.where(np.isfinite(smallest), first_factor, -1).reshape(full),
        "values_by_factor": values_by_factor.reshape(*full, -1),
        "q_a": q_a.reshape(*full, -1),
    }


def _values_by_factor(
    conditions: RatingConditions,
    limits: LoadLimits,
    slew_coordinate: float,
    angle: float,
    q: Array,
    statics: StaticQuantities,
) -> Array:
    """Return the values (N, K) at configurations (N, nq) found with the slew at home."""
    machine, slewing_joint = conditions.machine, conditions.section.slewing_joint
    if slewing_joint is not None:
        column = machine.closure.active[slewing_joint]
        if slew_coordinate != machine.home[column]:
            q = q.copy()
            q[:, column] = slew_coordinate
            statics = conditions.places.statics.evaluate(q)
    return limits.rated_values(statics, np.full(len(q), angle), q)


def _simultaneous_factors(values_by_factor: Array, smallest: Array) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        is_limiting: NDArray[np.bool_] = values_by_factor <= smallest[..., None] * (
            1 + SIMULTANEOUS_TOLERANCE
        )
    return is_limiting & np.isfinite(smallest)[..., None]


def _chart_axes(
    search: ConfigurationSearch,
    step: float | None,
    radii: Sequence[float] | None,
    heights: Sequence[float] | None,
) -> tuple[Array, Array]:
    """Return the coordinates of the positions: multiples of a step within the reach, or given."""
    lower, upper = search.section_positions.min(axis=0), search.section_positions.max(axis=0)
    if step is None:
        raw_step = float((upper - lower).max()) / _DEFAULT_CELLS[len(search.free_strokes)]
        power = 10.0 ** np.floor(np.log10(raw_step))
        step = float(power * next(x for x in _ROUND_STEPS if x * power >= raw_step))
    step = as_number(step, "the step", "m", greater_than=0.0)
    if float((upper - lower).max()) / step > _MAX_CELLS:
        raise InputError(
            f"a step of {step:g} m divides {float((upper - lower).max()):.3g} m into more than "
            f"{_MAX_CELLS} cells, give a larger one"
        )
    out = []
    for requested, name, first, last in zip(
        (radii, heights), ("radii", "heights"), lower, upper, strict=True
    ):
        if requested is None:
            count = np.arange(np.floor(first / step), np.ceil(last / step) + 1)
            out.append(np.round(step * count, _DIGITS))  # 3.4, not 3.4000000000000004
            continue
        values = as_sample(requested, len(requested), name)
        if not len(values) or not np.isfinite(values).all() or (np.diff(values) <= 0).any():
            raise InputError(f"{name} must be numbers that rise [m]")
        out.append(values)
    return out[0], out[1]


def _slew_coordinates(
    machine: Machine, search: Strokes, slews: Sequence[float] | None, can_tip: bool
) -> Array:
    """Return the angles of the slewing joint [rad]: given, or home and a quarter turn.

    A joint that turns less, as the steering of an articulated frame, goes as far as it turns.
    """
    slewing_joint = search.section.slewing_joint
    home = (
        0.0
        if slewing_joint is None
        else float(machine.home[machine.closure.active[slewing_joint]])
    )
    if slews is None:
        turned = home
        if slewing_joint is not None and can_tip:
            turned = min(home + np.pi / 2, float(search.high[slewing_joint]))
        return np.array([home, turned] if turned > home else [home])
    if slewing_joint is None:
        raise InputError(f"nothing slews '{machine.name}', leave slews out")
    slew_coordinates = as_sample(slews, len(slews), "slews")
    if not len(slew_coordinates) or not np.isfinite(slew_coordinates).all():
        raise InputError("slews must be angles [rad]")
    for slew_coordinate in slew_coordinates:
        if not search.low[slewing_joint] <= slew_coordinate <= search.high[slewing_joint]:
            raise InputError(
                f"'{machine.active[slewing_joint]}' turns from {search.low[slewing_joint]:.4g} to "
                f"{search.high[slewing_joint]:.4g} rad, not to {slew_coordinate:.4g}"
            )
    return slew_coordinates
