"""Signals of valves that move cylinders as planned and turn them before their strokes end."""

from collections.abc import Sequence

import numpy as np

from crane.codegen import Number
from crane.common.samples import Array
from crane.control.base import At
from crane.control.valves import Command, circuit_of
from crane.hydraulics.components import Cylinder, Valve
from crane.hydraulics.sources import Supply
from crane.machine import Machine


class Levers(Command):
    """Pulses of the valves' signals, one per valve and slot of time, that keep within strokes.

    A plan has the largest opening y of each pulse, -1 to 1, and for how much of its slot the
    pulse lasts. The spool's position u = (U - neutral) / (full - neutral) goes from 0 to
    sign(y) (d + (1 - d) |y|), d the dead band, and back to 0 at the rate r, so that over a pulse
    of duration T

        integral of |y| dt = |y| (T - (|u| + d) / r),

    and the stroke moves by that times its steady velocity at full opening (`full_speed`). At the
    begin of a slot the plan meets the machine as it is there: where a pulse would pass the end of
    its range it goes the other way, or less far, and where all together would ask for more than
    the pump's flow, all open less.

    Args:
        machine: The machine.
        plan: (slots, m, 2) openings, and shares of the slot from 0 to 1; the slot before and what
            follows after them is rest.
        slot: Duration of a slot [s].
        rate: The fastest change of u [1/s].
        low: (m,) least coordinates [m], [rad].
        high: (m,) largest.
        flow: The most that the valves ask the pump for [m3/s]; infinite where it has no limit.
    """

    given = True

    def __init__(
        self,
        machine: Machine,
        plan: Array,
        slot: float,
        rate: float,
        low: Array,
        high: Array,
        flow: float,
    ):
        circuit = self._circuit = circuit_of(machine)
        self._plan, self.period, self._rate, self._flow = plan, slot, rate, flow
        self._low, self._high = low, high
        self._columns = [machine.column(joint) for joint in circuit.joints]
        valves = list(circuit.valves.values())
        self._neutral = np.array([valve.neutral for valve in valves])
        self._span = np.array([valve.full - valve.neutral for valve in valves])
        self._dead = np.array([valve.dead_band for valve in valves])
        self._of = [circuit.joints.index(spool.joint) for spool in circuit.spools.values()]
        # slots from when on, how far they open, and for how long
        self._begins = [0.0]
        self._tops, self._lasts = [np.zeros(len(valves))], [np.zeros(len(valves))]

    def update(self, time: float, q: Array, v_a: Array, pressures: Array) -> None:
        """See `Command`."""
        number = round(time / self.period) - 1
        top = self._last = np.zeros(len(self._span))
        if 0 <= number < len(self._plan):
            top = self._pulse(number, q, pressures)
        kept = max(0, number + 1)
        self._begins[kept:], self._tops[kept:], self._lasts[kept:] = [time], [top], [self._last]

    def _pulse(self, number: int, q: Array, pressures: Array) -> Array:
        """(m,) how far valves open in a slot."""
        opening, share = self._plan[number].T
        x = q[self._columns]
        speeds = self._speeds(pressures)
        self._last = share * self.period
        wanted = np.array([
            self._within(i, float(y), float(x[i]), speeds[i]) for i, y in enumerate(opening)
        ])  # fmt: skip
        wanted *= min(1.0, self._flow / max(self._asked(wanted, speeds), 1e-30))
        u = self._dead + (1.0 - self._dead) * np.abs(wanted)
        return np.where(wanted, np.copysign(u, wanted), 0.0)

    def references(self, times: Array) -> Array:
        """See `Command`."""
        at = np.maximum(np.searchsorted(self._begins, times, "right") - 1, 0)
        top, last = np.array(self._tops)[at], np.array(self._lasts)[at]
        since = np.asarray(times)[:, None] - np.array(self._begins)[at, None]
        ramps = self._rate * np.clip(np.minimum(since, last - since), 0.0, None)
        u = np.copysign(np.minimum(np.abs(top), ramps), top)
        # a second spool gets the signal of the first one, as `Signals` have it
        return np.asarray(self._neutral + self._span * u)[:, self._of]

    def signals(self, at: At) -> Sequence[Number]:
        """See `Command`."""
        return at.reference

    def _speeds(self, pressures: Array) -> Array:
        """(m, 2) steady velocities at full opening, forwards and backwards [m/s], [rad/s]."""
        found = []
        for joint, (a, b) in zip(self._circuit.joints, pressures, strict=True):
            cylinder, valve = self._circuit.cylinders[joint], self._circuit.valves[joint]
            force = cylinder.area_a * a - cylinder.area_b * b
            found.append([
                full_speed(cylinder, valve, self._circuit.supply, force, side)
                for side in (False, True)
            ])  # fmt: skip
        return np.array(found)

    def _within(self, i: int, opening: float, x: float, speeds: Array) -> float:
        """The opening of a pulse that keeps cylinder i within its range."""
        rooms = max(self._high[i] - x, 0.0), max(x - self._low[i], 0.0)
        side, size = int(opening < 0), self._possible(i, abs(opening))
        if size and self._way(i, size) * speeds[side] > rooms[side]:
            side = int(rooms[1] > rooms[0])
            if self._way(i, size) * speeds[side] > rooms[side]:
                size = self._reaching(i, rooms[side] / speeds[side])
        return -size if side else size

    def _possible(self, i: int, opening: float) -> float:
        """As much of an opening as the rate allows within the pulse."""
        dead = self._dead[i]
        most = (self._rate * self._last[i] / 2 - dead) / (1.0 - dead)
        return min(opening, max(most, 0.0))

    def _way(self, i: int, opening: float) -> float:
        """Integral of the opening over the pulse [s]."""
        dead = self._dead[i]
        u = dead + (1.0 - dead) * opening
        return float(opening * (self._last[i] - (u + dead) / self._rate))

    def _reaching(self, i: int, way: float) -> float:
        """The opening of which the integral over the pulse is `way` [s], the smaller root."""
        dead, rate = self._dead[i], self._rate
        slope = self._last[i] - 2 * dead / rate
        root = slope**2 - 4 * (1.0 - dead) / rate * way
        return float(2 * way / (slope + np.sqrt(max(root, 0.0)))) if slope > 0 else 0.0

    def _asked(self, openings: Array, speeds: Array) -> float:
        """What the pump is asked for [m3/s]."""
        total = 0.0
        for y, speed, cylinder in zip(
            openings, speeds, self._circuit.cylinders.values(), strict=True
        ):
            area = cylinder.area_b if y < 0 else cylinder.area_a
            total += abs(y) * speed[int(y < 0)] * area
        return total


def full_speed(
    cylinder: Cylinder, valve: Valve, supply: Supply, force: float, backwards: bool
) -> float:
    """Steady velocity of a cylinder at full opening [m/s], [rad/s], its size.

    The pressure drops of both edges, (A_in w / c_in)^2 and (A_out w / c_out)^2, and the force F
    against the motion balance the supply,

        w^2 (A_in^3 / c_in^2 + A_out^3 / c_out^2) = A_in p_S - A_out p_R - F,

    and a compensator lets no more in than c_in sqrt(margin), unless a load that pulls presses out
    more, c_out sqrt(-F / A_out - p_R); 0 where the load is too heavy.

    Args:
        cylinder: The cylinder.
        valve: Its valve.
        supply: Of the circuit.
        force: Of the cylinder, A_A p_A - A_B p_B [N], [N m].
        backwards: Whether oil flows into chamber B.
    """
    inward, outward = cylinder.area_a, cylinder.area_b
    inlet, outlet = valve.c1, valve.c2
    if backwards:
        inward, outward, inlet, outlet = outward, inward, valve.c4, valve.c3
        force = -force
    left = inward * supply.pressure - outward * supply.tank - force
    speed = np.sqrt(max(left, 0.0) / (inward**3 / inlet**2 + outward**3 / outlet**2))
    if valve.margin:
        pulled = outlet * np.sqrt(max(-force / outward - supply.tank, 0.0)) / outward
        speed = min(speed, max(inlet * np.sqrt(valve.margin) / inward, pulled))
    return float(speed)
