"""Periodic references that tell as much as possible about a machine's parameters."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import ArrayLike

from crane.common.errors import InputError, known
from crane.common.output import replacing
from crane.common.samples import Array, as_count, as_number, as_seed
from crane.common.shown import Brief
from crane.common.tables import aligned
from crane.common.threads import on_one_thread
from crane.common.waiting import telling
from crane.dynamics import Dynamics
from crane.identification.excitation.fourier import Fourier
from crane.identification.excitation.information import CRITERIA, Information, Quality
from crane.identification.excitation.limits import QUANTITIES, Limits, by_joint, gear, limits
from crane.identification.excitation.search import COARSE, Search
from crane.identification.mechanics.base import Base, base_parameters, random_samples
from crane.identification.mechanics.model import Model
from crane.identification.mechanics.term import Samples
from crane.machine import Machine
from crane.recordings import timeseries
from crane.recordings.recording import FORCE_UNITS, VELOCITY_UNITS
from crane.recordings.timeseries import TIME, Table

_SHARE = 0.01  # of a drive's force limit, its noise if none is given
_WORST = 5  # parameters in the table
_MOST = 4_000_000  # samples of the recording
_SMOOTHING = 5e-4  # of velocities of the machine, over which friction turns in the search
_MEMORY = 1e9  # that motions are optimised in [bytes]

Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False, repr=False)
class Excitation(Brief):
    """A reference to identify a machine with.

    Attributes:
        trajectory: The reference, see `Fourier`.
        machine: The machine.
        base: What is to be identified.
        nominal: (p,) all parameters by the machine's description.
        scale: (r,) deviations of the base parameters beforehand, see `Information`.
        before: What the first random reference within the limits would tell.
        after: What this one will tell.
        limits: That it keeps.
        used: (5, n) share of them that it uses, by `QUANTITIES`.
        noise: (n,) of the forces [N], [N m].
        criterion: It is best in.
        seed: Of the random references.
        step: Of the recording that is counted on [s].
    """

    trajectory: Fourier
    machine: Machine
    base: Base
    nominal: Array
    scale: Array
    before: Quality
    after: Quality
    limits: Limits
    used: Array
    noise: Array
    criterion: str
    seed: int
    step: float

    def _line(self) -> str:
        """For what, how long, and what it gains."""
        return (
            f"Excitation of '{self.machine.name}', {self.trajectory.duration:.6g} s: condition "
            f"{self.before.condition:.3g} random, {self.after.condition:.3g} optimised"
        )

    def motion(self) -> tuple[Array, Array, Array, Array, Array]:
        """Times (N,), and q_A, v_A, a_A, tau_A (N, n) of the machine as described."""
        count = int(self.trajectory.duration / self.step + 1e-9) + 1
        time = self.step * np.arange(count, dtype=np.float64)
        q, v, a = self.trajectory(time)
        return time, q, v, a, Dynamics(self.machine).inverse(q, v, a, friction=True)

    def worst(self, count: int = _WORST) -> list[int]:
        """Base parameters that are told least, by std over what would take all force."""
        return np.argsort(-self.after.std / self.scale, kind="stable")[:count].tolist()

    def to_csv(self, path: str | Path) -> None:
        """Write the motion, with forces of the machine as described: a recording of no noise.

        Raises:
            OutputError: It cannot be written there.
        """
        units = {TIME: "s"}
        for suffix in ("", "_velocity", "_acceleration", "_force"):
            for joint in self.machine.active:
                unit = self.machine.unit(joint)
                units[joint + suffix] = {
                    "": unit,
                    "_velocity": VELOCITY_UNITS[unit],
                    "_acceleration": f"{unit}/s2",
                    "_force": FORCE_UNITS[unit],
                }[suffix]
        lead, period = self.trajectory.lead, self.trajectory.period
        notes = {
            "crane reference": "",
            "machine": self.machine.call,
            "task": f"excitation, steady from {lead:g} s, period {period:g} s",
        }
        timeseries.write(path, Table(units, np.column_stack(self.motion()), notes))

    def to_yaml(self, path: str | Path) -> None:
        """Write the coefficients, see `Fourier`.

        Raises:
            OutputError: It cannot be written there.
        """
        K = self.trajectory.harmonics
        numbers = self.trajectory.coefficients.T.tolist()
        text = {
            "machine": self.machine.call,
            "criterion": self.criterion,
            "seed": self.seed,
            "period": self.trajectory.period,
            "periods": self.trajectory.periods,
            "lead": self.trajectory.lead,
            "coefficients": {
                joint: {"c": row[0], "a": row[1 : K + 1], "b": row[K + 1 :]}
                for joint, row in zip(self.machine.active, numbers, strict=True)
            },
        }
        with replacing(path) as part:
            part.write_text(yaml.safe_dump(text, sort_keys=False), encoding="utf-8")

    def to_text(self) -> str:
        """Tables for reading: before and after, shares of the limits, the worst parameters."""
        before, after = self.before, self.after
        figures: list[tuple[str, ...]] = [
            ("", "random", "optimised"),
            ("ln det (1 + M)", f"{before.logdet:.1f}", f"{after.logdet:.1f}"),
            ("condition number", f"{before.condition:.3g}", f"{after.condition:.3g}"),
            ("smallest singular value", f"{before.smallest:.3g}", f"{after.smallest:.3g}"),
        ]
        shares: list[tuple[str, ...]] = [("share of limits used", *QUANTITIES)]
        for joint, row, limit in zip(
            self.machine.active, self.used.T, self.limits.all.T, strict=True
        ):
            words = (
                f"{x:.0%}" if np.isfinite(y) else "-" for x, y in zip(row, limit, strict=True)
            )
            shares.append((joint, *words))
        nominal = self.base.values(self.nominal)
        least: list[tuple[str, ...]] = [("least known", "value", "std, random", "std, optimised")]
        for i in self.worst():
            numbers = (nominal[i], before.std[i], after.std[i])
            name = self.base.names[self.base.independent[i]]
            least.append((name, *(f"{x:.3g}" for x in numbers)))
        return "\n\n".join("\n".join(aligned(rows)) for rows in (figures, shares, least))


@on_one_thread
def excite(
    machine: Machine,
    model: Model | None = None,
    *,
    period: float = 10.0,
    harmonics: int = 5,
    periods: int = 3,
    criterion: str = "logdet",
    noise: Mapping[str, float] | None = None,
    prior: ArrayLike | None = None,
    acceleration: Mapping[str, float] | None = None,
    margin: float = 0.05,
    step: float = 0.01,
    starts: int = 3,
    seed: int = 0,
    progress: Progress | None = None,
) -> Excitation:
    """Find a periodic reference that determines a machine's base parameters best.

    The best of random references, scaled to what the limits allow, are optimised by sequential
    quadratic programming over the coefficients of `Fourier`, then scaled to keep all limits at
    64 instants per period of the highest harmonic, the ways from and to rest included, with
    1 / cos(pi / 64) for what a series may do in between (Ehlich and Zeller, 1964).

    Args:
        machine: The machine.
        model: What is to be identified; `Model(machine)` if not given.
        period: [s].
        harmonics: K.
        periods: How many.
        criterion: "logdet", the volume of the confidence ellipsoid, or "condition".
        noise: Standard deviations of the measured forces by active joint [N], [N m]; 1 % of the
            force limit if not given, 1 where there is none.
        prior: (p,) standard deviations of the model's parameters before, see `Information`.
        acceleration: See `limits`.
        margin: See `limits`.
        step: Of the recording [s].
        starts: How many random references are optimised.
        seed: Of the random references: the same seed gives the same bits.
        progress: Called with the finished share, 0 to 1.

    Raises:
        InputError: Arguments out of range, or no reference within the limits.
    """
    progress = telling(progress)
    if criterion not in CRITERIA:
        raise InputError(f"criterion '{criterion}' is unknown, {known(CRITERIA, criterion)}")
    for what, value in (("starts", starts), ("harmonics", harmonics), ("periods", periods)):
        as_count(value, f"the number of {what}")
    period = as_number(period, "the period", "s", above=0)
    step = as_number(step, "the step", "s", above=0)
    seed = as_seed(seed)
    if machine.free:
        held = " ".join(f"--lock {joint}=VALUE" for joint in machine.free)
        raise InputError(
            f"nothing drives {', '.join(map(repr, machine.free))}, and a planned motion needs all "
            f"joints where it wants them: hold what is free ({held})"
        )
    # friction that jumps has no gradient to search along
    smooth = model or Model(_smoothed(machine))
    model = model or Model(machine)
    _check_size(model, period, harmonics, periods, step)
    bounds = limits(machine, acceleration, margin)
    force = machine.model.effortLimit[machine.closure.active]
    default = np.where(np.isfinite(force), _SHARE * force, 1.0)
    deviation = by_joint(machine, noise, "noise", default)
    for joint, most, value in zip(machine.active, force, deviation, strict=True):
        if value > most:
            raise InputError(
                f"noise of '{joint}' is {value:g}, above the {most:g} of its drive: give less"
            )
    force = np.where(np.isfinite(force), force, deviation / _SHARE)
    base = base_parameters(model)
    if not base.rank:
        raise InputError(f"nothing of '{machine.name}' has an effect on its drives")
    time = np.arange(0.0, period, step)
    if len(time) * len(machine.active) < base.rank:
        raise InputError(
            f"{len(time)} samples in a period of {period:g} s tell no {base.rank} base "
            "parameters, give a smaller step or a longer period"
        )
    scaled = _anywhere(model, bounds, 2 * np.pi / period * harmonics)
    information = Information(model, base, deviation, force, scaled, prior)
    count = periods * period / step
    seen = Information(smooth, base, deviation, force, scaled, prior)
    search = Search(seen, bounds, period, harmonics, count, CRITERIA[criterion])
    draws = search.draws(np.random.default_rng(seed))
    costs = search.rate(draws)[0]
    order = np.argsort(costs, kind="stable")[:starts]
    best, least = draws[order[0]], float(costs[order[0]])
    for tried, start in enumerate(draws[order]):

        def report(share: float, tried: int = tried) -> None:
            if progress is not None:
                progress((tried + share) / len(order))

        found = search.descend(start, report)
        if (cost := float(search.rate(found[None])[0][0])) < least:
            best, least = found, cost
    before, trajectory = (
        Fourier(search.coefficients(x), period, periods) for x in (draws[0], best)
    )
    first, last = (
        information.quality(model.samples(*one(one.lead + time), float(time[1] - time[0])), count)
        for one in (before, trajectory)
    )
    return Excitation(
        trajectory=trajectory,
        machine=machine,
        base=base,
        nominal=model.nominal,
        scale=np.linalg.norm(information.scale, axis=1),
        before=first,
        after=last,
        limits=bounds,
        used=search.used(trajectory),
        noise=deviation,
        criterion=criterion,
        seed=seed,
        step=step,
    )


def _smoothed(machine: Machine) -> Machine:
    """The machine with friction that is smooth where it sticks."""
    rates = machine.closure.units / machine.closure.pace
    laws = {
        joint: replace(law, smoothing=_SMOOTHING * float(rates[machine.column(joint)]))
        for joint, law in machine.friction.items()
        if law.sticks
    }
    return machine.replace(friction={**machine.friction, **laws})


def _check_size(model: Model, period: float, harmonics: int, periods: int, step: float) -> None:
    """See that the search and the recording have room.

    Raises:
        InputError: They have none; the message has what would be possible.
    """
    n = len(model.machine.active)
    room = _MEMORY / (24 * n * len(model.names))  # samples of three regressors at once
    least = max(period / room, (periods + 1) * period / _MOST)
    if step < least:
        raise InputError(
            f"{periods} periods of {period:g} s and the ways from and to rest are "
            f"{(periods + 1) * period / step:.3g} samples of {step:g} s, for which there is no "
            f"room: give a step of at least {least:.2g} s, or fewer or shorter periods"
        )
    most = max(1, int((room / (2 * n * COARSE)) ** 0.5))  # a stack of motions per derivative
    if harmonics > most:
        raise InputError(
            f"the number of harmonics is {harmonics}, more than there is room for with {n} active "
            f"joints: give at most {most}"
        )


def _anywhere(model: Model, bounds: Limits, fastest: float) -> Samples:
    """Random motions within the limits, of harmonics up to a circular frequency [rad/s]."""
    machine, rng = model.machine, np.random.default_rng(0)
    at = random_samples(model, 300)
    at_ease = gear(machine, at) <= 1
    q_a = at.q_a[at_ease]
    v_max = np.minimum(bounds.velocity, fastest * bounds.half)
    a_max = np.minimum(bounds.acceleration, fastest * v_max)
    v_a, a_a = (limit * rng.uniform(-1, 1, q_a.shape) for limit in (v_max, a_max))
    return model.samples(q_a, v_a, a_a, at.step)
