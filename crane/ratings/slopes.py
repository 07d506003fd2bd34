"""How rated loads and forces change with numbers of the machine, exactly."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.dynamics.named import Named
from crane.dynamics.statics import AtRest
from crane.machine import Machine
from crane.ratings.actions import slewed
from crane.ratings.causes import Causes, lines_of
from crane.ratings.strength import strengths

if TYPE_CHECKING:
    from crane.ratings.field import Field

EQUAL = 1e-6  # of a load: causes that end it together
_AT_LIMIT = 1e-6  # of a stroke


def field_slopes(chart: "Field", names: Sequence[str]) -> Array:
    """Derivatives of a field's values by numbers of the machine, places held still.

    With p a number, a posture of the largest value m is stationary under the place x(q_A, p) and
    under limits of the strokes,

        sum mu_k dm_k/dq + lambda^T dx/dq + sum nu_j e_j = 0,    sum mu_k = 1,

    over causes k that end it together and strokes j at their limits, so that

        dm/dp = sum mu_k dm_k/dp + lambda^T dx/dp,

    derivatives on the right at the same q_A; limits of strokes stay. Where just two strokes move
    the frame, lambda follows from them alone.

    Args:
        chart: See `crane.capacity`, `crane.tool_force`.
        names: Numbers of the machine, such as "boom_eye.x".

    Returns:
        (s, b, a, k) per unit of each number; NaN where there is no value or no end to it, or where
        a pin's limit ends it, whose derivatives are not computed.

    Raises:
        InputError: There is no such number, or it moves a support.
    """
    machine, names = chart.machine, list(names)
    places, statics = chart.places, chart.places.statics
    drives = strengths(machine, chart.working, chart.friction)
    causes = Causes(statics, drives, chart.rule, chart.action, chart.slope, chart.weights)
    named = Named(machine)
    of_drives = named.slopes(names, lambda variant: _drives(variant, chart))
    if np.any(named.slopes(names, _supports)):
        raise InputError("a number that moves the supports cannot be varied here, leave it out")
    out = np.full((*chart.values.shape, len(names)), np.nan)
    here = np.argwhere(np.isfinite(chart.values) & (chart.values > 0))
    if not len(here) or not names:
        return out
    s, b, a = here.T
    q_a = np.ascontiguousarray(chart.q_a[s, b, a])
    q = machine.closure.solve(q_a)
    at, by_q, by_p = statics.at(q), statics.derivatives(q), statics.by_numbers(q, names)
    angles = slewed(machine, chart.frame, places.section, chart.slews[s])
    loads = chart.values[s, b, a]
    unit, pins = chart.action.unit(at, angles), causes.in_pins(at, angles, q)
    each = {}  # by bound but pins: derivatives of its load by q_A (N, n) and by numbers (N, k)
    ends = np.empty((len(here), len(causes.bounds)))
    for j, bound in enumerate(causes.bounds):
        parts = causes.terms(bound, at, unit, pins)
        x = causes.end(bound, parts)
        ends[:, j] = x * causes.shares[bound.cause]
        if bound.pin is not None:
            continue
        per_q, per_p = (_slopes(causes, j, x, parts, at, by, angles) for by in (by_q, by_p))
        if bound.drive is not None:  # what its strength changes by
            k = 2 * drives.index(bound.drive) + (bound.sign < 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                per_p = per_p + bound.sign * of_drives[:, k] / _rate(x, parts)[:, None]
        each[j] = per_q * causes.shares[bound.cause], per_p * causes.shares[bound.cause]
    strokes = places.moving
    section = places.section  # it stands at home: seen from there, what slews is turned back
    back = Rotation.from_rotvec(-angles[:, None] * section.second).as_matrix()
    tips = section.origin + (back @ (at.tip - section.origin)[:, :, None])[:, :, 0]
    ways = section.slopes(tips, back @ at.ways)[:, :, strokes]
    place_by = section.slopes(tips, back @ by_p.tip)
    span = places.high - places.low
    for i in range(len(here)):
        together = np.flatnonzero(ends[i] <= loads[i] * (1 + EQUAL)).tolist()
        if not all(j in each for j in together):
            continue
        rises = np.array([each[j][0][i, strokes] for j in together])
        if len(strokes) == 2:
            share = np.zeros(len(together))
            share[np.argmin(ends[i, together])] = 1.0
            force = -np.linalg.solve(ways[i].T, share @ rises)
        else:
            at_low = q_a[i, strokes] <= (places.low + _AT_LIMIT * span)[strokes]
            at_high = q_a[i, strokes] >= (places.high - _AT_LIMIT * span)[strokes]
            share, force = _multipliers(rises, ways[i], at_low, at_high, span[strokes])
        out[s[i], b[i], a[i]] = share @ np.array([each[j][1][i] for j in together])
        out[s[i], b[i], a[i]] += force @ place_by[i]
    return out


def _multipliers(
    rises: Array, ways: Array, at_low: NDArray[np.bool_], at_high: NDArray[np.bool_], span: Array
) -> tuple[Array, Array]:
    """Shares mu (c,) of causes and forces lambda (2,) that hold a posture of the most load.

    Args:
        rises: (c, k) of the causes' loads by the strokes.
        ways: (2, k) of the place by the strokes.
        at_low: (k,) which strokes are at their lower limit.
        at_high: (k,) at their upper one.
        span: (k,) of the strokes.
    """
    size = np.abs(rises * span).max() or 1.0
    reach = np.abs(ways * span).max()
    limits = np.vstack([np.diag(span)[at_low], -np.diag(span)[at_high]])
    rows = np.vstack(
        [rises * span / size, ways * span / reach, -ways * span / reach, limits / span]
    )
    causes = len(rises)
    one = np.zeros((len(rows), 1))
    one[:causes] = 1.0
    found = nnls(np.hstack([rows, one]).T, np.r_[np.zeros(rows.shape[1]), 1.0])[0]
    forces = (found[causes : causes + 2] - found[causes + 2 : causes + 4]) * size / reach
    return found[:causes], forces


def _rate(x: Array, parts: tuple[Array, ...]) -> Array:
    """How fast a + b x + |c + d x| rises with x (N,)."""
    _, b, c, d = parts
    return np.asarray(b + (_unit(x, c, d) * d).sum(axis=-1))


def _unit(x: Array, c: Array, d: Array) -> Array:
    whole = c + d * np.where(np.isfinite(x), x, 0.0)[:, None]
    length = np.linalg.norm(whole, axis=-1, keepdims=True)
    return whole / np.where(length > 0, length, 1.0)


def _slopes(
    causes: Causes,
    j: int,
    x: Array,
    parts: tuple[Array, ...],
    at: AtRest,
    by: AtRest,
    angles: Array,
) -> Array:
    """Derivatives (N, k) of the load at which bound j ends, by k numbers or strokes."""
    unit, rate = _unit(x, *parts[2:]), _rate(x, parts)
    x = np.where(np.isfinite(x), x, 0.0)
    columns = []
    for k in range(by.mass.shape[-1]):
        one = AtRest(*(part[..., k] for part in by))
        a, b, c, d = causes.changes(causes.bounds[j], at, one, angles)
        moved = a + b * x + (unit * (c + d * x[:, None])).sum(axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            columns.append(-moved / rate)
    return np.stack(columns, axis=-1)


def _drives(machine: Machine, chart: "Field") -> Array:
    """What its drives push and pull at most."""
    found = strengths(machine, chart.working, chart.friction)
    return np.array([x for drive in found for x in (drive.most, drive.least)])


def _supports(machine: Machine) -> Array:
    """Places of the tipping lines."""
    return np.concatenate([np.zeros(1), *(np.r_[x.foot, x.way] for x in lines_of(machine))])
