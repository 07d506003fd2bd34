"""The largest load or force at every place, and what ends it."""

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError
from crane.common.result import Result
from crane.common.samples import Array, as_number, as_sample
from crane.dynamics.statics import StaticQuantities, StaticsEvaluator
from crane.machine import Machine
from crane.motion.workspaces.workspace_section import WorkspaceSection
from crane.ratings.configuration_search import ConfigurationSearch
from crane.ratings.drive_force_limits import drive_force_limits
from crane.ratings.limiting_factors import TIPPING, LimitingFactor, LoadLimits
from crane.ratings.rating_derivatives import EQUAL, chart_derivatives
from crane.ratings.rating_rules import Rule
from crane.ratings.strokes import check_drives
from crane.ratings.unit_actions import UnitAction, slew_angles
from crane.recordings.timeseries import Table, write_table

_DEFAULT_CELLS = {
    0: 100,
    1: 75,
    2: 40,
}  # of the larger extent at most, by how many strokes are free
_ROUND_STEPS = (1.0, 2.5, 5.0, 10.0)  # multiples of a quarter, for tables by 0.5, 1, 1.5 ... m
_DIGITS = 12  # behind the point of places
_MAX_CELLS = 400  # cells along one axis


@dataclass(frozen=True, eq=False, repr=False)
class RatingChart(Result):
    """What is largest over reach and height.

    Attributes:
        machine: The machine.
        places: What is acted on, and how it gets anywhere.
        action: What acts on it, per magnitude.
        rule: By which it is rated.
        working_joints: Joints whose drives work; others hold.
        ground_slope: Of the ground [rad].
        with_friction: Whether drives that work overcome friction.
        with_weight: Whether the machine has its weight.
        radii: (a,) first coordinate of the section, as a rule the distance from the slewing axis
            [m].
        heights: (b,) second coordinate [m].
        slews: (s,) angles of the slewing joint [rad]; one, at home, where nothing slews.
        limiting_factors: What may end it.
        values: (s, b, a) magnitudes; NaN where the frame does not reach, infinite where nothing
            ends them.
        limiting_factor_index: (s, b, a) index of what ends it, the first of those that do
            together;
            -1 where nothing does.
        values_by_factor: (s, b, a, K) magnitudes by cause.
        q_a: (s, b, a, n) active coordinates; of all that reach the place those of the largest.
    """

    machine: Machine
    places: ConfigurationSearch
    action: UnitAction
    rule: Rule
    working_joints: tuple[str, ...]
    ground_slope: float
    with_friction: bool
    with_weight: bool
    radii: Array
    heights: Array
    slews: Array
    limiting_factors: tuple[LimitingFactor, ...]
    values: Array
    limiting_factor_index: NDArray[np.intp]
    values_by_factor: Array
    q_a: Array

    quantity: ClassVar[tuple[str, str]] = ("value", "1")

    @property
    def frame(self) -> str:
        """What is acted on."""
        return self.places.statics.frame

    @property
    def section(self) -> WorkspaceSection:
        """The plane of the places."""
        return self.places.section

    @property
    def active_factors(self) -> tuple[int, ...]:
        """Indices of the causes that are the first to end it somewhere."""
        return tuple(
            np.unique(self.limiting_factor_index[self.limiting_factor_index >= 0]).tolist()
        )

    @property
    def together(self) -> NDArray[np.bool_]:
        """(s, b, a, K) which causes end it: several where the best posture balances them."""
        return _together(self.values_by_factor, self.values)

    def derivatives(self, parameter_names: Sequence[str]) -> Array:
        """Derivatives of the values by parameters, see `crane.ratings.rating_derivatives`.

        Args:
            parameter_names: Such as "boom_eye.x" or "cylinder.X_boom.area_a".

        Returns:
            (s, b, a, k) per unit of each.

        Raises:
            InputError: There is no such number, or it moves a support.
        """
        return chart_derivatives(self, parameter_names)

    def to_csv(self, path: str | Path) -> None:
        """Write a row per place: slew, place, value, cause, values by cause, active coordinates.

        Raises:
            OutputError: The file cannot be written.
        """
        machine, (name, unit) = self.machine, self.quantity
        units = {
            "slew": "rad", "radius": "m", "height": "m", name: unit, "cause": "1",
            **{f"{name}_{_column_suffix(cause)}": unit for cause in self.limiting_factors},
            **{joint: machine.unit(joint) for joint in machine.active},
        }  # fmt: skip
        s, b, a = np.nonzero(np.isfinite(self.values) | (self.limiting_factor_index >= 0))
        rows = np.column_stack(
            [
                self.slews[s],
                self.radii[a],
                self.heights[b],
                self.values[s, b, a],
                self.limiting_factor_index[s, b, a],
                self.values_by_factor[s, b, a],
                self.q_a[s, b, a],
            ]
        )
        rows[~np.isfinite(rows)] = np.nan
        notes = {"machine": machine.load_expression, "frame": self.frame, **self.file_notes()}
        notes |= {f"cause {k}": str(cause) for k, cause in enumerate(self.limiting_factors)}
        write_table(path, Table(units, rows, notes))

    def derivatives_to_csv(self, path: str | Path, parameter_names: Sequence[str]) -> None:
        """Write a row per place: slew, place, value, its derivatives by numbers; empty for none.

        Raises:
            InputError: See `derivatives`.
            OutputError: The file cannot be written.
        """
        name, unit = self.quantity
        units = {"slew": "rad", "radius": "m", "height": "m", name: unit}
        units |= {f"{name}_by_{number}": f"{unit}/SI" for number in parameter_names}
        s, b, a = np.nonzero(np.isfinite(self.values))
        rows = np.column_stack(
            [self.slews[s], self.radii[a], self.heights[b], self.values[s, b, a],
             self.derivatives(parameter_names)[s, b, a]]
        )  # fmt: skip
        notes = {"machine": self.machine.load_expression, "frame": self.frame, **self.file_notes()}
        write_table(path, Table(units, rows, notes))

    def file_notes(self) -> dict[str, str]:
        """What else a file of it says above its table."""
        return {}


ChartType = TypeVar("ChartType", bound=RatingChart)


def configuration_search(machine: Machine, frame: str | None) -> ConfigurationSearch:
    """The places of a frame of a machine that one can rate.

    Raises:
        InputError: Its drives are not its active joints, or see `Places`.
    """
    return ConfigurationSearch(StaticsEvaluator(check_drives(machine), frame))


def compute_chart(
    chart_class: type[ChartType],
    machine: Machine,
    search: ConfigurationSearch,
    action: UnitAction,
    rule: Rule,
    working_joints: Collection[str],
    *,
    ground_slope: float = 0.0,
    with_friction: bool = False,
    with_weight: bool = True,
    slews: Sequence[float] | None = None,
    step: float | None = None,
    radii: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
) -> ChartType:
    """The field of an action.

    Args:
        chart_class: What it becomes.
        machine: The machine.
        search: Of the frame.
        action: What acts on it.
        rule: By which it is rated.
        working_joints: Joints whose drives work; others hold.
        ground_slope: Of the ground [rad].
        with_friction: Whether drives that work overcome friction.
        with_weight: Whether the machine has its weight.
        slews: See `capacity`; so the next ones.
        step: Between places [m].
        radii: In place of steps.
        heights: Likewise.

    Raises:
        InputError: See `capacity`.
    """
    statics = search.statics
    load_limits = LoadLimits(
        statics,
        drive_force_limits(machine, working_joints, with_friction),
        rule,
        action,
        ground_slope,
        with_weight,
    )
    axes = _chart_axes(search, step, radii, heights)
    can_tip = any(cause.reason == TIPPING for cause in load_limits.factors)
    slew_coordinates = _slew_coordinates(machine, search, slews, can_tip)
    configurations = search.find_all(axes)
    if not len(configurations.position_index):
        raise InputError(f"'{statics.frame}' reaches none of these places, give others")
    a, b, n, count = len(axes[0]), len(axes[1]), len(machine.active), len(load_limits.factors)
    values_by_factor, q_a = (
        np.full((len(slew_coordinates), a * b, count), np.nan),
        np.full((len(slew_coordinates), a * b, n), np.nan),
    )
    slewing_joint, active = search.section.slewing_joint, machine.closure.active
    angles = slew_angles(machine, statics.frame, search.section, slew_coordinates)
    for k, slew_coordinate in enumerate(slew_coordinates):

        def factor_values(
            q: Array,
            statics_values: StaticQuantities,
            turn: float = slew_coordinate,
            angle: float = angles[k],
        ) -> Array:
            if slewing_joint is not None and turn != machine.home[active[slewing_joint]]:
                q = q.copy()
                q[:, active[slewing_joint]] = turn
                statics_values = statics.evaluate(q)
            return load_limits.max_magnitudes(statics_values, np.full(len(q), angle), q)

        best_configurations, _ = search.select_best(
            configurations, axes, lambda q, at: factor_values(q, at).min(axis=1)
        )
        values_by_factor[k, best_configurations.position_index] = factor_values(
            best_configurations.q, best_configurations.statics
        )
        q_a[k, best_configurations.position_index] = best_configurations.q[:, active]
        if slewing_joint is not None:
            q_a[k, best_configurations.position_index, slewing_joint] = slew_coordinate
    is_reached = np.isfinite(q_a[..., 0])
    smallest_values = np.where(
        is_reached,
        np.where(np.isnan(values_by_factor), np.inf, values_by_factor).min(axis=2),
        np.nan,
    )
    factor_indices = np.where(
        np.isfinite(smallest_values),
        _together(values_by_factor, smallest_values).argmax(axis=2),
        -1,
    )
    shape = (len(slew_coordinates), b, a)
    return chart_class(
        machine,
        search,
        action,
        rule,
        tuple(working_joints),
        ground_slope,
        with_friction,
        with_weight,
        *axes,
        slew_coordinates,
        load_limits.factors,
        smallest_values.reshape(shape),
        factor_indices.reshape(shape),
        values_by_factor.reshape(*shape, count),
        q_a.reshape(*shape, n),
    )


def _together(each: Array, least: Array) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        ends: NDArray[np.bool_] = each <= least[..., None] * (1 + EQUAL)
    return ends & np.isfinite(least)[..., None]


def _chart_axes(
    search: ConfigurationSearch,
    step: float | None,
    radii: Sequence[float] | None,
    heights: Sequence[float] | None,
) -> tuple[Array, Array]:
    """Coordinates of the places: multiples of a step within the reach, or those that are given."""
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
    machine: Machine, search: ConfigurationSearch, slews: Sequence[float] | None, can_tip: bool
) -> Array:
    """Angles of the slewing joint."""
    slewing_joint = search.section.slewing_joint
    home = (
        0.0
        if slewing_joint is None
        else float(machine.home[machine.closure.active[slewing_joint]])
    )
    if slews is None:
        quarter_turn = home + np.pi / 2
        is_within_limits = (
            slewing_joint is not None
            and can_tip
            and search.low[slewing_joint] <= quarter_turn <= search.high[slewing_joint]
        )
        return np.array([home, quarter_turn] if is_within_limits else [home])
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


def _column_suffix(factor: LimitingFactor) -> str:
    return "_".join(itertools.chain(factor.reason.split(), factor.element.split()))
