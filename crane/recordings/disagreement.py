"""Sensors that say more than is needed, compared through the machine's loops.

Those that determine the posture put every other sensor where it should be. What it reads instead
is explained by the simplest that leaves no more than noise, by least squares over the recording:
a zero of the sensor or of one of those that determine it, then a delay, a scale, or a pin that is
not where the file has it. Rates are compared as what they add up to, so that noise does not hide
their zero.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from crane.common.errors import ClosureError, CraneWarning, MechanismError
from crane.common.samples import Array
from crane.description.sensors import INCLINATION, SENSOR, VELOCITY, Sensor, unit_of
from crane.machine import Machine
from crane.recordings.inclined import with_angles
from crane.recordings.postures import Postures
from crane.recordings.reading import known_sensors
from crane.recordings.timeseries import TIME, Table, column
from crane.recordings.tolerances import AGREE, allowed

_NOISE = 3.3, 2.0  # standard deviations that tell a difference, and that explain what is left
_WALKS = 1.5  # of what white noise adds up to, which it hardly spreads over
_AS_GOOD = 2.0  # times what the best explanation leaves
_BETTER = 0.8  # of what a zero leaves, below which more is told
_NEAR, _LISTED = 1.3, 2  # times the best of those, and how many
_STILL = 0.05  # of the motion that it should tell
_MOVES = 4.0  # times what sensors may differ by, over which scale and delay show
_FLAT = 1e-6  # slope of what does not depend on something
_STEPS = 4  # of Gauss and Newton
_SHOWN = {"rad": ("deg", 180 / np.pi), "m": ("mm", 1e3)}


def tell_disagreement(machine: Machine, table: Table) -> None:
    """Warn where sensors of one quantity disagree through the machine's loops, a line each.

    Joints and inclinations that are recorded beside the joints that determine the posture, and
    rates, are compared with where these put them.
    """
    known = known_sensors(table, machine)
    try:
        postures = Postures(machine, with_angles(machine, table))
        pairs = [_Pair(postures, name) for name in _others(machine, table, postures.drives)]
        told = [text for pair in pairs if (text := pair.told(known, list(table.units)))]
    except (ClosureError, MechanismError):  # whoever closes the loops tells it
        return
    for text in told:
        warnings.warn(text, CraneWarning, stacklevel=3)


def _others(machine: Machine, table: Table, drives: tuple[str, ...]) -> list[str]:
    """Columns, in units of the machine, that the posture and its motion tell as well."""
    found = []
    for name, unit in table.units.items():
        base = name.removesuffix(VELOCITY)
        tells = base in machine.joints or base.startswith(INCLINATION)
        if tells and name not in drives and unit == unit_of(machine.tree, name):
            found.append(name)
    return found


@dataclass(frozen=True)
class _Cause:
    """What may explain a difference.

    Attributes:
        sensors: By sensor its zero, scale and delay, on top of what is known of it.
        left: Root mean square of what it leaves.
        words: What it is.
        pins: By name where a pin would have to be [m].
    """

    sensors: dict[str, dict[str, float]]
    left: float
    words: str
    pins: dict[str, float] = field(default_factory=dict)

    def numbers(self, known: Mapping[str, Sensor]) -> str:
        """As machine files, notes and options take them."""
        found = []
        for name, now in self.sensors.items():
            was = known.get(name, Sensor())
            values = {
                "zero": was.zero + was.scale * now.get("zero", 0.0),
                "scale": was.scale * now.get("scale", 1.0),
                "delay": was.delay + now.get("delay", 0.0),
            }
            found += [f"{SENSOR}{name}.{what} = {values[what]:.4g}" for what in now]
        return ", ".join(found + [f"{name} = {value:.4g}" for name, value in self.pins.items()])


class _Pair:
    """One sensor beside what the others say of it.

    Args:
        postures: Of those that are used.
        name: Its column.
    """

    def __init__(self, postures: Postures, name: str):
        self._postures, self.name = postures, name
        self.time = postures.time
        self.base = name.removesuffix(VELOCITY)
        self.rate = self.base != name
        self.unit = str(unit_of(postures.machine.tree, self.base))
        reading, walk = column(postures.table, name), 0.0
        if self.rate:
            time = column(postures.table, TIME)
            walk = noise_of(reading) * float(time[-1] - time[0]) / float(np.sqrt(len(time)))
            reading = _added_up(time, reading)
        self.measured = reading[postures.chosen]
        self.said = postures.said(self.base)
        self.off = self.measured - self.said
        if self.rate:
            self.off = self.off - self.off.mean()
        elif self.unit == "rad":
            self.off = self.off - 2 * np.pi * np.round(np.median(self.off) / (2 * np.pi))
        noise = noise_of(self.off)
        self.allowed = allowed(AGREE, postures.machine, self.unit)
        # of what differs, and of what a cause may leave; noise that is added up walks at random
        self.most = max(self.allowed, _NOISE[0] * noise, _WALKS * walk)
        self.limit = max(self.allowed, _NOISE[1] * noise, walk)

    def told(self, known: Mapping[str, Sensor], measured: Sequence[str]) -> str:
        """How they disagree, and why; "" where they do not.

        Args:
            known: What is known of the sensors.
            measured: Columns that were measured, whose zeros may explain it.
        """
        mean, spread = float(self.off.mean()), float(self.off.std())
        if abs(mean) <= self.allowed and spread <= self.most:
            return ""
        cause = self._why(known, measured)
        if self.rate and not cause:
            return ""  # what it adds up to drifts for many reasons
        unit, factor = _SHOWN[self.unit]
        used = ", ".join(self._used)
        if self.rate:
            slope = factor * float(self._fitted([self.time])[0][0])
            return (
                f"sensors disagree: '{self.name}' is {slope:+.3g} {unit}/s off on the mean "
                f"against {used}: {cause}"
            )
        low, high = factor * self.off.min(), factor * self.off.max()
        return (
            f"sensors disagree: '{self.name}' is {factor * mean:+.3g} {unit} off on the mean "
            f"({low:+.3g} to {high:+.3g} over the motion) against {used}: {cause}"
        )

    @property
    def _used(self) -> list[str]:
        """Joints that tell it."""
        postures = self._postures
        q = postures.q[postures.few]
        gamma = postures.machine.closure.gamma(q)
        slopes = [postures.slope(self.base, q, g) for g in np.moveaxis(gamma, 2, 0)]
        pairs = zip(postures.machine.active, slopes, strict=True)
        return [joint for joint, slope in pairs if np.abs(slope).max() > _FLAT]

    def _why(self, known: Mapping[str, Sensor], measured: Sequence[str]) -> str:
        """In words; of a rate "" where nothing explains it."""
        own, limit = self._zero(), self.limit
        zeros = sorted([own, *self._zeros_of_others(measured)], key=lambda x: x.left)
        zero = zeros[0] if zeros[0].left < _BETTER * own.left else own
        if zeros[0].left <= limit:
            most = max(_AS_GOOD * zeros[0].left, 0.2 * self.allowed)
            named = " or ".join(x.numbers(known) for x in zeros if x.left <= most)
            return f"a constant offset explains it but for {self._shown(zeros[0].left)}, {named}"
        if np.ptp(self.measured) < _STILL * np.ptp(self.said):
            return "" if self.rate else "it does not move"
        more = sorted([*self._with_zero(), *self._with_pins()], key=lambda x: x.left)
        if self.rate:
            more = [x for x in more if x.left <= limit]
            return self._told([zero, more[0]], known) if more else ""
        if absolute := self._absolute(zero):
            return absolute
        most = min(_BETTER * zero.left, max(limit, _NEAR * more[0].left)) if more else 0.0
        best = sorted((x for x in more if x.left <= most), key=lambda x: len(x.sensors))
        rest = "" if best else ", and no delay, scale or pin explains the rest"
        return self._told([zero, *best[:_LISTED]], known) + rest

    def _told(self, causes: list[_Cause], known: Mapping[str, Sensor]) -> str:
        first, *more = ((x.words, self._shown(x.left), x.numbers(known)) for x in causes)
        told = [f"{first[0]} leaves {first[1]} of it ({first[2]})"]
        return ", ".join(told + [f"{words} {left} ({numbers})" for words, left, numbers in more])

    def _shown(self, left: float) -> str:
        unit, factor = _SHOWN[self.unit]
        return f"{factor * left:.2g} {unit}"

    def _fitted(self, columns: list[Array], off: Array | None = None) -> tuple[Array, float]:
        """Least squares of the difference (N,) over columns (N,), and what they leave."""
        off = self.off if off is None else off
        more = [np.ones_like(self.time)] if self.rate else []
        A = np.column_stack([*columns, *more])
        values: Array = np.asarray(np.linalg.lstsq(A, off, rcond=None)[0])
        return values, float(np.sqrt(np.mean((off - A @ values) ** 2)))

    @property
    def _one(self) -> Array:
        """(N,) what a zero adds."""
        return self.time - self.time[0] if self.rate else np.ones_like(self.time)

    def _zero(self) -> _Cause:
        values, left = self._fitted([self._one])
        return _Cause({self.name: {"zero": float(values[0])}}, left, "a constant offset")

    def _with_zero(self) -> list[_Cause]:
        """A zero with a delay, and with a scale."""
        if np.ptp(self.said) < _MOVES * self.allowed:
            return []
        (zero, more, *_), left = self._fitted([self._one, self.said])
        numbers = {"zero": float(zero), "scale": 1.0 + float(more)}
        found = [_Cause({self.name: numbers}, left, "a scale besides")]
        delay = 0.0
        for _ in range(_STEPS):
            late = np.interp(self.time - delay, self.time, self.said)
            off = self.off + self.said - late
            slope = -np.gradient(late, self.time)
            (zero, more, *_), left = self._fitted([self._one, slope], off)
            delay += float(more)
        if delay > 0:  # a sensor does not know what comes
            numbers = {"zero": float(zero), "delay": delay}
            found.append(_Cause({self.name: numbers}, left, "a delay besides"))
        return found

    def _zeros_of_others(self, measured: Sequence[str]) -> list[_Cause]:
        """Zeros of what is used, one at a time, by Gauss and Newton's method."""
        found = []
        drives = self._postures.machine.active
        for i, joint in enumerate(drives if not self.rate else ()):
            if joint not in measured:
                continue
            zero, left = 0.0, np.inf
            try:
                for _ in range(_STEPS):
                    moved = self._postures.q_b.copy()
                    moved[:, i] -= zero
                    q = self._postures.machine.closure.solve(moved)
                    off = self.off + self.said - self._postures.said(self.name, q)
                    left = float(np.sqrt(np.mean(off**2)))
                    gamma = self._postures.machine.closure.gamma(q)
                    slope = -self._postures.slope(self.name, q, gamma[:, :, i])
                    if np.abs(slope).max() < _FLAT:
                        break
                    zero += float(slope @ off / (slope @ slope))
            except ClosureError:
                continue
            found.append(_Cause({joint: {"zero": zero}}, left, "a constant offset"))
        return found

    def _with_pins(self) -> list[_Cause]:
        """The place of a pin, alone or with a zero, to first order: of each the least move."""
        postures = self._postures
        q, time = postures.q[postures.few], self.time[postures.few]
        found: dict[str, list[tuple[float, _Cause]]] = {}
        for name, dq in postures.pins.items() if not self.rate else ():
            few = postures.slope(self.name, q, dq)
            if np.abs(few).max() < _FLAT:
                continue
            link, _, axis = name.rpartition(".")
            place = postures.places[link]["xyz".index(axis)]
            slope = np.interp(self.time, time, few)
            (move, zero), left = self._fitted([slope, self._one])
            (alone,), rest = self._fitted([slope])
            if rest <= max(_NEAR * left, self.limit):
                move, own, left, words = alone, {}, rest, "a pin elsewhere alone"
            else:
                own, words = {self.name: {"zero": float(zero)}}, "a pin elsewhere besides"
            cause = _Cause(own, left, words, {name: float(place + move)})
            found.setdefault(link, []).append((abs(float(move)), cause))
        return [_least(causes, self.limit) for causes in found.values()]

    def _absolute(self, best: _Cause) -> str:
        """That an angle counts from the horizon and is taken for that of a joint, if it does."""
        postures, joints = self._postures, self._postures.machine.tree.joints
        if self.unit != "rad":
            return ""
        if self.base.startswith(INCLINATION):
            link = self.base.removeprefix(INCLINATION)
            pairs = [
                (joint, column(postures.table, joint)[postures.chosen], self.measured)
                for joint in postures.drives
                if joints[joint].child == link and joints[joint].kind == "revolute"
            ]
        else:
            link = joints[self.base].child
            pairs = [(self.base, self.measured, postures.said(INCLINATION + link))]
        for joint, angle, inclined in pairs:
            for turned, sign in (("", 1.0), (" with its sign turned", -1.0)):
                left = float(np.std(angle - sign * inclined))
                if left <= self.limit < best.left:
                    what = f"'{joint}' follows the inclination of '{link}' against the horizon"
                    name = f"an absolute angle is called '{INCLINATION}{link}'{turned}"
                    return f"{what} within {self._shown(left)}, {name}"
        return ""


def _least(causes: list[tuple[float, _Cause]], limit: float) -> _Cause:
    """Of moves of one pin that explain about as much, the smallest."""
    most = max(limit, _NEAR * min(cause.left for _, cause in causes))
    near = [(move, cause) for move, cause in causes if cause.left <= most]
    return min(near, key=lambda pair: (len(pair[1].sensors), pair[0]))[1]


def noise_of(x: Array) -> float:
    """Standard deviation of white noise on a smooth signal (N,), by its second differences."""
    return float(np.median(np.abs(np.diff(x, 2)))) / 1.65 if len(x) > 2 else 0.0


def _added_up(time: Array, rate: Array) -> Array:
    """Integral (N,) of a rate (N,), by trapezia."""
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)
    return np.concatenate([[0.0], np.cumsum(steps)])
