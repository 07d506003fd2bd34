"""Valves opened as far as a reference's flows need, with feedback of position and of sway."""

from collections.abc import Mapping, Sequence

import numpy as np

from crane.codegen import Number
from crane.codegen.scalar import add, apply
from crane.common.errors import InputError
from crane.common.samples import Array, as_number
from crane.control.base import At
from crane.control.openings import check_known, demanded, openings
from crane.control.valves import ValvePD, circuit_of
from crane.dynamics import Dynamics
from crane.hydraulics import Hydraulics, PDGains
from crane.machine import Machine
from crane.motion.curves import Trajectory
from crane.motion.sway import Sway, without_sway

_KNOTS_PER_SECOND = 50  # of forces and gains
_STEPS_PER_SECOND = 1000  # of openings
_JUMP = 0.003  # of the valve's flow, over which the dead band is jumped
_TURN = 0.02  # likewise, over which openings and friction change with the direction


class ValveFeedforward(ValvePD):
    """Valves opened for the reference's velocities, corrected by position and by sway.

    With y the openings that the reference demands of the circuit (`demanded`), tau the lag
    2 zeta / omega of the spool, g the opening per velocity of `openings` under the reference's
    forces,

        w = y + tau y' + K_p (q_ref - q) + K_d (q_ref' - q') + g(v) K theta,
        u = (1 - d) w + d tanh(w / 0.003).

    theta is the sway against the reference's: what two inclinometers on the grapple tell, less
    what is planned, theta = (q_f - q_f,ref) - E (q_d - q_d,ref) with E as in `crane.motion.sway`.
    A motion B u of the drives, B of `Sway.shifts`, makes theta'' + Omega^2 theta = u''. With
    u'' = -2 zeta Omega theta' all modes have the damping ratio zeta more, and velocities do that:

        K = -2 zeta B Omega,    Omega = Phi diag(omega) Phi^T M_ff,

    with the modes Phi of unit modal mass. A spool of 5 Hz delays that by 0.06 s, 10 to 16 degrees
    of a grapple's sway, and position control counteracts it at frequencies below kp x the speed at
    full flow. What limits zeta is what gives way between valve and tip: above the sway's frequency
    the load stands, and the feedback is one of position, with 2 zeta omega more of loop gain.

    Args:
        machine: The machine, with its payload.
        reference: Of the driven joints or of all; free joints that it has not hang still.
        gains: By joint; those of the machine file if not given.
        sway: Damping ratio zeta that is asked for; 0 for no feedback of sway.

    Raises:
        InputError: As `ValvePD`; or sway is to be damped, and nothing sways.
    """

    def __init__(
        self,
        machine: Machine,
        reference: Trajectory,
        gains: Mapping[str, PDGains] | None = None,
        sway: float = 0.0,
    ):
        damping = as_number(sway, "the damping ratio of sway", "", most=1.0)
        if damping < 0:
            raise InputError(f"the damping ratio of sway is {damping:g}, give 0 to 1")
        if damping and not machine.free:
            raise InputError(f"nothing sways on '{machine.name}': it has no free joints")
        if machine.free and len(reference.position(0.0)) < len(machine.active):
            reference = without_sway(machine, reference, "none")
        super().__init__(machine, reference, gains)
        circuit = circuit_of(machine)
        check_known(circuit)
        self.planned, self._free = reference, np.flatnonzero(~machine.driven)
        valves = circuit.valves.values()
        lags = [2.0 * x.damping / x.bandwidth if x.bandwidth else 0.0 for x in valves]
        self._damped = damping > 0
        count = max(8, int(np.ceil(reference.duration * _KNOTS_PER_SECOND)) + 1)
        self._knots = np.linspace(0.0, reference.duration, count)
        q_a, v_a, a_a = reference(self._knots)
        force = Dynamics(machine).inverse(q_a, v_a, a_a)[:, self._which]
        force += self._friction(machine, circuit, v_a[:, self._which])
        self._times, opening = self._opened(machine, reference, force)
        self._opening = opening + np.array(lags) * np.gradient(opening, self._times, axis=0)
        if self._damped:
            pairs = [
                openings(x, circuit.cylinders[x.joint], circuit.supply.pressure, force[:, i])
                for i, x in enumerate(valves)
            ]
            columns = [x for pair in zip(*pairs, strict=True) for x in pair]
            self._table = np.column_stack(columns + self._feedback(machine, q_a, damping))

    def _friction(self, machine: Machine, circuit: Hydraulics, v: Array) -> Array:
        """Friction (N, m) of the cylinders' joints; dry friction turns smoothly."""
        found = np.zeros_like(v)
        for i, joint in enumerate(circuit.joints):
            if (law := machine.friction.get(joint)) is not None:
                valve, cylinder = circuit.valves[joint], circuit.cylinders[joint]
                fastest = valve.c1 * np.sqrt(valve.margin or circuit.supply.pressure)
                turn = np.tanh(v[:, i] * cylinder.area_a / (_TURN * fastest))
                found[:, i] = law.viscous * v[:, i] + law.coulomb * turn + law.coulomb_offset
        return found

    def _opened(
        self, machine: Machine, reference: Trajectory, force: Array
    ) -> tuple[Array, Array]:
        """Times (N,) and the openings (N, m) that the reference demands."""
        from scipy.interpolate import make_interp_spline  # slow to import

        count = int(np.ceil(reference.duration * _STEPS_PER_SECOND)) + 1
        time = np.linspace(0.0, reference.duration, count)
        q_a, v_a, _ = reference(time)
        lower, upper = machine.lower[self._which], machine.upper[self._which]
        acting = make_interp_spline(self._knots, force)(time)
        x = q_a[:, self._which] - lower
        circuit = circuit_of(machine)
        return time, demanded(circuit, time, x, v_a[:, self._which], acting, upper - lower)

    def _feedback(self, machine: Machine, q_a: Array, damping: float) -> list[Array]:
        """K (m, f), then E (f, m), as columns (N,)."""
        sway, free = Sway(machine), self._free
        rest = sway.hanging(q_a)
        shifts = sway.shifts(rest)
        roots = np.array([sway.root(posture) for posture in rest])
        driven = np.flatnonzero(machine.driven).tolist()
        own = [driven.index(i) for i in self._which]
        gains = -2.0 * damping * (shifts @ roots)[:, own]
        stiffness = sway.stiffness(rest)
        follow = -np.linalg.solve(stiffness[:, :, free], stiffness[:, :, self._which])
        return [*gains.reshape(len(q_a), -1).T, *follow.reshape(len(q_a), -1).T]

    def references(self, times: Array) -> Array:
        """See `Command`."""
        q, v, last = self.planned.position(times), self.planned.velocity(times), self._knots[-1]
        opening = _between(times, last, self._opening)
        opening[(times < 0) | (times > last)] = 0.0
        known = [q[:, self._which], v[:, self._which], opening]
        if self._damped:
            known += [_between(times, last, self._table), q[:, self._free]]
        return np.hstack(known)

    def signals(self, at: At) -> Sequence[Number]:
        """See `Command`."""
        m = len(self._which)
        kp, kd, dead, neutral, span = (at.settings[i * m : (i + 1) * m] for i in range(5))
        q, v, opening = (at.reference[i * m : (i + 1) * m] for i in range(3))
        error = [q[i] - at.q_a[joint] for i, joint in enumerate(self._which)]
        if self._damped:
            opening = add(opening, self._against_sway(at, error))
        signals: list[Number] = []
        for i, joint in enumerate(self._which):
            wanted = opening[i] + kp[i] * error[i] + kd[i] * (v[i] - at.v_a[joint])
            jump = dead[i] * apply("tanh", wanted * (1.0 / _JUMP))
            signals.append(neutral[i] + span[i] * ((1.0 - dead[i]) * wanted + jump))
        return signals

    def _against_sway(self, at: At, error: list[Number]) -> list[Number]:
        """What the valves open for the velocity that damps sway (m,)."""
        m, f = len(self._which), len(self._free)
        out, back = (at.reference[i * m : (i + 1) * m] for i in (3, 4))
        gains, follow = (at.reference[(5 + i * f) * m : (5 + (i + 1) * f) * m] for i in (0, 1))
        theta: list[Number] = []
        for k, joint in enumerate(self._free):
            sway = at.q_a[joint] - at.reference[(5 + 2 * f) * m + k]
            theta.append(sway + sum(follow[k * m + i] * error[i] for i in range(m)))
        found: list[Number] = []
        for i in range(m):
            speed = sum(gains[i * f + k] * theta[k] for k in range(f))
            mean, half = 0.5 * (out[i] + back[i]), 0.5 * (out[i] - back[i])
            turn = apply("tanh", speed * mean * (1.0 / _TURN))
            found.append((mean + half * turn) * speed)
        return found


def _between(times: Array, last: float, table: Array) -> Array:
    """Rows (N, c) straight between those of a table, at even times from 0 to the last [s]."""
    at = np.clip(times / last, 0.0, 1.0) * (len(table) - 1)
    before = np.minimum(at.astype(int), len(table) - 2)
    share = (at - before)[:, None]
    found: Array = (1.0 - share) * table[before] + share * table[before + 1]
    return found
