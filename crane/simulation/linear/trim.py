"""Forces, or pressures and signals, at which a machine goes on as it does."""

import itertools
import warnings

import numpy as np

from crane.common.errors import CraneWarning, SimulationError
from crane.common.samples import Array
from crane.dynamics import Dynamics
from crane.recordings.recording import FORCE_UNITS
from crane.simulation.linear.drive import Drive

_STILL = 1e-9  # what is left of a trimmed machine, in its size per its pace squared
_HANGS = 1e-6  # the same, of free joints that hang still
_ROUNDS = 50  # of Newton's method
_SHORT = 1e-3  # share of its step below which it is taken all the same
_BAR, _MILLIMETRE, _THIMBLE, _SOON = 1e5, 1e-3, 1e-6, 0.1  # [Pa], [m], [m3], [s]


def trimmed(
    dynamics: Dynamics, drive: Drive, q_a: Array, v_a: Array, outside: Array
) -> tuple[Array, Array]:
    """The drive's states and inputs at which velocities and states stay.

    Args:
        dynamics: Of the machine.
        drive: What acts on it.
        q_a: (n,).
        v_a: (n,).
        outside: (n,) what forces from outside do along the active joints.

    Raises:
        SimulationError: There are none.
    """
    machine = dynamics.machine
    forces = dynamics.inverse(q_a, v_a, np.zeros(len(q_a))) + dynamics.friction(q_a, v_a) - outside
    if machine.free:
        _check_hanging(dynamics, q_a, v_a, forces, outside)
    if drive.states:
        for shared in (True, False) if not v_a.any() else (True,):
            found = _on_valves(_Trim(dynamics, drive, q_a, v_a, outside, shared))
            if found is not None:
                return found
        raise SimulationError(
            "the machine cannot be trimmed there: no pressures and signals keep these velocities"
        )
    return drive.own, forces[machine.driven]


def _check_hanging(
    dynamics: Dynamics, q_a: Array, v_a: Array, forces: Array, outside: Array
) -> None:
    """See that free joints keep their velocities while drives bear their share of forces (n,).

    Raises:
        SimulationError: One does not.
    """
    machine = dynamics.machine
    held = np.where(machine.driven, forces, 0.0)
    units = machine.closure.units[machine.closure.active] / machine.closure.pace**2
    moved = np.abs(dynamics.forward(q_a, v_a, held + outside, friction=True)) / units
    if moved.max() > _HANGS:
        worst = int(np.argmax(np.abs(forces - held)))
        joint = machine.active[worst]
        unit = FORCE_UNITS[machine.unit(joint)]
        raise SimulationError(
            f"free joint '{joint}' does not stay there, {forces[worst]:.3g} {unit} would have to "
            "hold it: linearize where it hangs still"
        )


class _Trim:
    """What is left of an equilibrium on valves, over their states and signals z.

    Joints at rest have their valves closed: the pressure of the chamber that bears the load holds
    the machine for now, whatever leaks, and springs in series bear what their cylinders do. All
    else has to stay what it is.

    Args:
        dynamics: Of the machine.
        drive: The circuit.
        q_a: (n,).
        v_a: (n,).
        outside: See `trimmed`.
        shared: Whether states of no joint, of pumps and lines, have to stay what they are, too.

    Attributes:
        start: (k + m,) closed valves.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        drive: Drive,
        q_a: Array,
        v_a: Array,
        outside: Array,
        shared: bool = True,
    ):
        self._dynamics, self.drive, self._q_a, self.v_a = dynamics, drive, q_a, v_a
        self._outside = outside
        closure = dynamics.machine.closure
        n, k = len(q_a), len(drive.states)
        pressure = np.array([unit == "Pa" for unit in drive.states.values()])
        spring = np.array([name.startswith("spring_") for name in drive.states])
        volume = np.array([unit == "m3" for unit in drive.states.values()])
        scales = np.select([pressure, spring, volume], [_BAR, _MILLIMETRE, _THIMBLE], 1.0)
        moving = drive.moving(v_a, shared)
        loaded = drive.loaded(dynamics.inverse(q_a, v_a, np.zeros(n)) - outside)
        self._free = np.flatnonzero(np.concatenate([loaded | spring | moving[:k], moving[k:]]))
        self._rows = np.concatenate([np.arange(n), n + np.flatnonzero(spring | moving[:k])])
        self._scales = np.concatenate([scales, np.ones(len(drive.u))])
        # pressures of bars within tenths of a second are as much as such accelerations
        accelerations = closure.units[closure.active] / closure.pace**2
        self._units = np.concatenate([accelerations, scales / _SOON])[self._rows]
        self.start = np.concatenate([drive.own, drive.u])

    def rates(self, z: Array) -> Array:
        """(k,) of the states."""
        n, k = len(self._q_a), len(self.drive.states)
        return self.drive.at(self._q_a, self.v_a, z[:k], z[k:])[0][n : n + k]

    def left(self, z: Array) -> tuple[Array, Array]:
        """Accelerations and rates in their units, and their derivatives by z."""
        drive, n, k = self.drive, len(self._q_a), len(self.drive.states)
        values, slopes = drive.at(self._q_a, self.v_a, z[:k], z[k:])
        state = self._q_a, self.v_a, values[:n] + self._outside
        a_a = self._dynamics.forward(*state, friction=True)
        found = self._dynamics.derivatives("forward", *state, friction=True, by=["tau_a"])
        by = slopes[:, 2 * n :]
        rows = np.vstack([found["tau_a"] @ by[:n], by[n : n + k]])
        left = np.concatenate([a_a, values[n : n + k]])
        return left[self._rows] / self._units, rows[self._rows] / self._units[:, None]

    def polished(self, z: Array, damped: bool = False) -> Array | None:
        """The nearest z at which nothing is left, by Newton's method; None if there is none.

        Damped, its steps are halved until less is left: over a throttle between two nodes it goes
        back and forth else, root(x) having its zero half the step ahead.
        """
        z, free = z.copy(), self._free
        for _ in range(_ROUNDS):
            left, slopes = self.left(z)
            if np.abs(left).max() < _STILL:
                return z
            rows = (slopes * self._scales)[:, free]
            step = np.linalg.lstsq(rows, left, rcond=1e-10)[0]
            if not np.isfinite(step).all():
                return None
            way = np.zeros(len(z))
            way[free] = step * self._scales[free]
            share = 1.0
            while damped and share > _SHORT and not self._less(z - share * way, left):
                share *= 0.5
            z -= share * way
        return None

    def _less(self, z: Array, left: Array) -> bool:
        """Whether less is left at another z."""
        return bool(np.linalg.norm(self.left(z)[0]) < np.linalg.norm(left))

    def searched(self, share: float) -> Array:
        """The best z from valves that are open by a share of their stroke, and stay open."""
        from scipy.optimize import least_squares

        z, ways, lower, upper = self.drive.opened(self.v_a, share)

        def left(x: Array) -> Array:
            return self.left(z + ways @ x)[0]

        def slopes(x: Array) -> Array:
            found: Array = self.left(z + ways @ x)[1] @ ways
            return found

        scales = 1.0 / (np.abs(ways) / self._scales[:, None]).max(axis=0)
        start = np.zeros(len(lower))
        found = least_squares(left, start, slopes, (lower, upper), x_scale=scales)
        return z + ways @ found.x


def _on_valves(trim: _Trim) -> tuple[Array, Array] | None:
    drive, k = trim.drive, len(trim.drive.states)
    starts = (trim.searched(share) for share in (0.2, 0.5, 0.8)) if trim.v_a.any() else ()
    done = next(
        (
            z
            for start in itertools.chain(starts, [trim.start])
            for damped in (False, True)
            if (z := trim.polished(start, damped)) is not None
        ),
        None,
    )
    if done is None:
        return None
    rates = np.abs(trim.rates(done))
    worst = int(np.argmax(np.where(rates > 1e-3 * drive.scales, rates / drive.scales, 0.0)))
    if rates[worst] > _BAR * _STILL:
        name, unit = list(drive.states.items())[worst]
        warnings.warn(
            f"linearized where it does not stay: {name} changes by {rates[worst]:.3g} {unit}/s "
            "with closed valves, through leakage or relief valves",
            CraneWarning,
            stacklevel=4,
        )
    return done[:k], done[k:]
