"""Valves opened as far as a reference's flows need, with feedback of position and of sway."""

from collections.abc import Mapping, Sequence

import numpy as np

from crane.codegen import Number
from crane.codegen.scalar import apply
from crane.common.errors import InputError
from crane.common.samples import Array, as_number
from crane.control.base import At
from crane.control.valves import ValvePD, circuit_of
from crane.dynamics import Dynamics
from crane.hydraulics import PDGains
from crane.hydraulics.components import Cylinder, Valve
from crane.machine import Machine
from crane.motion.sway import Sway, without_sway
from crane.motion.trajectories import Trajectory

_KNOTS_PER_SECOND = 50
_LEAST_DROP = 1e5  # [Pa] that an edge is taken to have
_JUMP = 0.01  # of the valve's flow, over which the dead band is jumped
_TURN = 0.01  # likewise, over which openings change with the direction


def openings(valve: Valve, cylinder: Cylinder, supply: float, force: Array) -> tuple[Array, Array]:
    """Opening of a valve that one metre (radian) per second takes, out and in.

    Flow comes through the inlet Q = c y sqrt(dp), with dp the compensator's margin or what the
    supply leaves; where the load pulls the piston along, through the outlet, which sets the speed.

    Args:
        valve: The valve.
        cylinder: Its cylinder.
        supply: Pressure of the supply [Pa].
        force: (N,) that the cylinder exerts [N], [N m].

    Returns:
        Two arrays (N,) [s/m], [s/rad], both positive.
    """
    found = []
    ways = (
        (1.0, valve.c1, cylinder.area_a, valve.c2, cylinder.area_b),
        (-1.0, valve.c4, cylinder.area_b, valve.c3, cylinder.area_a),
    )
    for sign, inlet, into, outlet, out in ways:
        drop = supply - np.maximum(sign * force, 0.0) / into
        if valve.margin:
            drop = np.minimum(drop, valve.margin)
        by_inlet = into / (inlet * np.sqrt(np.maximum(drop, _LEAST_DROP)))
        pull = np.maximum(-sign * force, 0.0) / out
        by_outlet = out / (outlet * np.sqrt(np.maximum(pull, _LEAST_DROP)))
        found.append(np.where(sign * force < 0, np.minimum(by_inlet, by_outlet), by_inlet))
    return found[0], found[1]


class ValveFeedforward(ValvePD):
    """Valves opened for the reference's velocities, corrected by position and by sway.

    With v_ref, a_ref the reference's velocities and accelerations, tau = 2 zeta / omega the spool's
    lag, g the opening per velocity of `openings` under the reference's forces,

        w = K_p (q_ref - q) + K_d (q_ref' - q') + g(v) v,    v = v_ref + tau a_ref + K theta,
        u = (1 - d) w + d tanh(w / 0.01).

    theta is the sway against the reference's: what two inclinometers on the grapple tell, less what
    is planned, theta = (q_f - q_f,ref) - E (q_d - q_d,ref) with E as in `crane.motion.sway`. In
    B of `Sway.shifts` a motion u of the tip makes theta'' + Omega^2 theta = u''; u'' = -2 zeta Omega
    theta' damps all modes by zeta, and a velocity of the tip gives it:

        K = -2 zeta B Omega,    Omega = Phi diag(omega) Phi^T M_ff,

    with the modes Phi of unit modal mass. Valves of 5 Hz delay that by 0.06 s, 15 to 20 degrees of a
    grapple's sway, and position control counteracts it below kp x the speed at full flow.

    Args:
        machine: The machine, with its payload.
        reference: Of the driven joints or of all; free joints hang still where it has none of them.
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
        self._planned, self._free = reference, np.flatnonzero(~machine.driven)
        valves = circuit.valves.values()
        lags = [2.0 * x.damping / x.bandwidth if x.bandwidth else 0.0 for x in valves]
        self._lags, self._damped = np.array(lags), damping > 0
        count = max(2, int(np.ceil(reference.duration * _KNOTS_PER_SECOND)) + 1)
        self._knots = np.linspace(0.0, reference.duration, count)
        q_a, v_a, a_a = reference(self._knots)
        force = Dynamics(machine).inverse(q_a, v_a, a_a, friction=True)[:, self._which]
        pairs = [
            openings(valve, circuit.cylinders[valve.joint], circuit.supply.pressure, force[:, i])
            for i, valve in enumerate(valves)
        ]
        columns = [x for pair in zip(*pairs, strict=True) for x in pair]
        if self._damped:
            columns += self._feedback(machine, q_a, damping)
        self._table = np.column_stack(columns)

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
        q, v, a = self._planned(times)
        ahead = v[:, self._which] + self._lags * a[:, self._which]
        inside = np.clip(times, 0.0, self._knots[-1])
        table = [np.interp(inside, self._knots, column) for column in self._table.T]
        known = (q[:, self._which], v[:, self._which], ahead, np.transpose(table), q[:, self._free])
        return np.hstack(known)

    def signals(self, at: At) -> Sequence[Number]:
        """See `Command`."""
        m, f = len(self._which), len(self._free)
        kp, kd, dead, neutral, span = (at.settings[i * m : (i + 1) * m] for i in range(5))
        q, v, ahead, out, back = (at.reference[i * m : (i + 1) * m] for i in range(5))
        error = [q[i] - at.q_a[joint] for i, joint in enumerate(self._which)]
        if self._damped:
            gains, follow = (at.reference[(5 + i * f) * m : (5 + (i + 1) * f) * m] for i in (0, 1))
            theta: list[Number] = []
            for k, joint in enumerate(self._free):
                sway = at.q_a[joint] - at.reference[(5 + 2 * f) * m + k]
                theta.append(sway + sum(follow[k * m + i] * error[i] for i in range(m)))
            ahead = [
                ahead[i] + sum(gains[i * f + k] * theta[k] for k in range(f)) for i in range(m)
            ]
        signals: list[Number] = []
        for i, joint in enumerate(self._which):
            turn = apply("tanh", ahead[i] * (0.5 * (out[i] + back[i])) * (1.0 / _TURN))
            per_speed = 0.5 * (out[i] + back[i]) + 0.5 * (out[i] - back[i]) * turn
            wanted = kp[i] * error[i] + kd[i] * (v[i] - at.v_a[joint]) + per_speed * ahead[i]
            jump = dead[i] * apply("tanh", wanted * (1.0 / _JUMP))
            signals.append(neutral[i] + span[i] * ((1.0 - dead[i]) * wanted + jump))
        return signals
