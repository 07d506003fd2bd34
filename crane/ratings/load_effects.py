"""Drive forces, chamber pressures, pin forces and buckling margins under rated loads."""

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.dynamics.buckling import Buckling
from crane.dynamics.statics import StaticsEvaluator
from crane.motion.workspaces.workspace_section import up_direction
from crane.ratings.drive_force_limits import PinForces
from crane.ratings.rating_chart import RatingChart


def holding_forces(chart: RatingChart) -> tuple[Array, Array]:
    """Compute the forces of the active joints at rest under the rated loads.

    Args:
        chart: A load chart.

    Returns:
        Two arrays (N, n) over the N positions with a finite load [N], [N m]: the forces without
        the lateral part of gravity on a slope, and the largest change by that part over all
        directions of the slope.
    """
    machine, up = chart.machine, up_direction(chart.machine)
    has_load = np.isfinite(chart.values)
    q = machine.closure.solve(np.ascontiguousarray(chart.q_a[has_load]))
    statics = StaticsEvaluator(machine, chart.frame).evaluate(q)
    gravity = float(np.linalg.norm(machine.model.gravity.linear))
    loads = chart.values[has_load][:, None, None]
    moment_jacobian = statics.moment_jacobian + loads * statics.tip_jacobian
    vertical_parts = np.einsum("nix,i->nx", moment_jacobian, up)
    level_forces = gravity * np.cos(chart.ground_slope) * vertical_parts - statics.passive_forces
    lateral_parts = np.linalg.norm(moment_jacobian - vertical_parts[:, None] * up[:, None], axis=1)
    return level_forces, gravity * np.sin(chart.ground_slope) * lateral_parts


def buckling_margins(chart: RatingChart) -> dict[str, Array]:
    """Compute the ratio of buckling force to pressing force of the cylinders.

    On sloping ground this is the ratio for the worst direction of the slope.

    Args:
        chart: A load chart.

    Returns:
        By cylinder that `crane.dynamics.Buckling` evaluates, an array (s, b, a): infinite where
        the cylinder is pulled, NaN where there is no finite load. Empty without a circuit.
    """
    machine = chart.machine
    if machine.hydraulics is None:
        return {}
    buckling = Buckling(machine)
    forces, slope_forces = holding_forces(chart)
    for joint, column in buckling.columns.items():
        i = machine.active.index(joint)
        forces[:, i] += column.compression_sign * slope_forces[:, i]
    q_a = chart.q_a[np.isfinite(chart.values)]
    rows = buckling.buckling_margins(q_a, forces).T
    return {x: _on_grid(chart, row) for x, row in zip(buckling.columns, rows, strict=True)}


def chamber_pressures(chart: RatingChart) -> dict[str, Array]:
    """Compute the pressures of the chambers at rest under the rated loads.

    A force F of a cylinder comes from one chamber; the other one has the tank's pressure p_T:

        p_A = max(p_T, (F + p_T B) / A),    p_B = max(p_T, (p_T A - F) / B).

    On sloping ground each pressure is that for the worst direction of the slope. With friction,
    the pressure of a drive that raises is the one that starts its motion.

    Args:
        chart: A load chart.

    Returns:
        By joint, an array (s, b, a, 2) for chambers A and B [Pa]; NaN where there is no finite
        load. Empty without a circuit.
    """
    machine = chart.machine
    if machine.hydraulics is None:
        return {}
    tank, (forces, slope_forces) = machine.hydraulics.supply.tank, holding_forces(chart)
    out = {}
    for drive in chart.drive_limits():
        if not drive.chamber_pressures:
            continue
        force, slope_force = forces[:, drive.active_index], slope_forces[:, drive.active_index]
        differences = force + slope_force - drive.max_force, drive.min_force - force + slope_force
        pressures = [
            np.maximum(limit + difference / area, tank)
            for limit, difference, area in zip(
                drive.chamber_pressures, differences, drive.chamber_areas, strict=True
            )
        ]
        out[drive.joint] = _on_grid(chart, np.column_stack(pressures))
    return out


def pin_forces(chart: RatingChart) -> dict[str, Array]:
    """Compute the forces in the pins at rest under the rated loads, on level ground.

    Args:
        chart: A load chart.

    Returns:
        By joint and loop, an array (s, b, a) [N] of the magnitude of the components that statics
        determines, see `PinForces`; NaN where there is no finite load.

    Raises:
        InputError: The ground of the chart slopes.
        SingularConfigurationError: The passive joints are not determined at a position.
    """
    if chart.ground_slope:
        raise InputError(
            f"forces in pins are those on level ground, but the chart's ground slopes by "
            f"{np.rad2deg(chart.ground_slope):.3g} degrees: rate without slope"
        )
    machine, has_load = chart.machine, np.isfinite(chart.values)
    pins = PinForces(machine, chart.frame)
    q = machine.closure.solve(np.ascontiguousarray(chart.q_a[has_load]))
    gravity = np.broadcast_to(machine.model.gravity.linear, (len(q), 3))
    unloaded, increments = pins.load_forces(q, gravity)
    forces = unloaded + chart.values[has_load][:, None, None] * increments
    rows = np.linalg.norm(forces, axis=2).T
    return {x: _on_grid(chart, row) for x, row in zip(pins.names, rows, strict=True)}


def _on_grid(chart: RatingChart, values: Array) -> Array:
    """Return values (N, ...) of the positions with a finite load on the grid; NaN elsewhere."""
    out = np.full((*chart.values.shape, *values.shape[1:]), np.nan)
    out[np.isfinite(chart.values)] = values
    return out
