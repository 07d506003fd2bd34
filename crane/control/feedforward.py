"""Valves opened as far as a reference's flows need, with feedback of position and of sway."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline

from crane.codegen import Number
from crane.codegen.scalar import add, apply
from crane.common.errors import InputError
from crane.common.samples import Array, as_number
from crane.control.base import At
from crane.control.valves import ValvePD, circuit_of
from crane.dynamics import Dynamics
from crane.hydraulics import Hydraulics, PDGains
from crane.hydraulics.components import Cylinder, Valve
from crane.hydraulics.flow import LAMINAR
from crane.machine import Machine
from crane.motion.sway import Sway, without_sway
from crane.motion.trajectories import Trajectory

_KNOTS_PER_SECOND = 50  # of forces and gains
_STEPS_PER_SECOND = 1000  # of openings
_BESIDE = 1e3  # [Pa] of difference quotients
_LEAST_DROP = 1e5  # [Pa] that an edge is taken to have
_JUMP = 0.003  # of the valve's flow, over which the dead band is jumped
_TURN = 0.02  # likewise, over which openings and friction change with the direction


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


def demanded(
    circuit: Hydraulics, time: Array, x: Array, v: Array, force: Array, strokes: Array
) -> Array:
    """Openings of all valves that move their cylinders as is said, under the forces that takes.

    The circuit turned round: with C = V / K of the chambers, r what suction valves let in, and
    Q = q y through the edges that are open,

        C_a p_a' = q_a y + r_a - A_a v,    C_b p_b' = A_b v - q_b y + r_b,    A_a p_a - A_b p_b = F,

    differentiated once gives y, and one pressure is left to be integrated. Where a chamber is sucked
    empty the other one sets the speed alone. Left out: leaks, cushions, relief and load-holding
    valves, and that the supply's pressure falls.

    Args:
        circuit: The circuit.
        time: (N,) [s], a millisecond or so apart.
        x: (N, m) strokes above the lower limits [m], [rad].
        v: (N, m) [m/s], [rad/s].
        force: (N, m) of the cylinders [N], [N m].
        strokes: (m,) distances between the limits.

    Returns:
        (N, m) openings y, -1 to 1 where the valve has that flow.
    """

    def of(items: Mapping[str, Any], *names: str) -> list[Array]:
        return [np.array([getattr(items[joint], x) for joint in circuit.joints]) for x in names]

    oil, tank, pump = circuit.oil, circuit.supply.tank, circuit.supply.pressure
    area_a, area_b, hose_a, hose_b, stiffness = of(
        circuit.cylinders, "area_a", "area_b", "hose_a", "hose_b", "stiffness"
    )
    c1, c2, c3, c4, margin = of(circuit.valves, "c1", "c2", "c3", "c4", "margin")
    margin = np.where(margin > 0, margin, pump)
    hose, steel = (1.0 / k if k else 0.0 for k in (oil.hose_modulus, oil.steel_modulus))
    rate = np.gradient(force, time, axis=0)
    # the spring between cylinder and joint gives way
    give = np.where(stiffness > 0, 1.0 / np.where(stiffness > 0, stiffness, 1.0), 0.0)
    x, v = x + give * force, v + give * rate
    inside_a, inside_b = area_a * x, area_b * (strokes - x)
    soft_a = hose_a * hose + inside_a * steel + (hose_a + inside_a) / oil.bulk_modulus
    soft_b = hose_b * hose + inside_b * steel + (hose_b + inside_b) / oil.bulk_modulus
    least = 0.5 * tank

    def at(i: int, p_b: Array) -> tuple[Array, Array]:
        """Openings, and the rate of the pressure in B."""
        f, w, ca, cb = force[i], v[i], soft_a[i], soft_b[i]
        p_a = (f + area_b * p_b) / area_a
        asked = rate[i] + (area_a**2 / ca + area_b**2 / cb) * w
        out = asked > 0
        fed_a = c1 * np.sqrt(np.clip(pump - p_a, _LEAST_DROP, margin))
        fed_b = c4 * np.sqrt(np.clip(pump - p_b, _LEAST_DROP, margin))
        q_a = np.where(out, fed_a, c3 * np.sqrt(np.maximum(p_a - tank, LAMINAR)))
        q_b = np.where(out, c2 * np.sqrt(np.maximum(p_b - tank, LAMINAR)), fed_b)
        y = asked / (area_a * q_a / ca + area_b * q_b / cb)
        # sucked empty, and not filled yet: the side that the load presses on sets the speed alone
        by_b = (area_b * w + cb * rate[i] / area_b) / q_b
        by_a = (area_a * w + ca * rate[i] / area_a) / q_a
        y = np.where(out & (p_a < tank) & (q_a * by_b < area_a * w), by_b, y)
        y = np.where(~out & (p_b < tank) & (q_b * by_a > area_b * w), by_a, y)
        return y, (area_b * w - q_b * y) / cb

    found = np.empty_like(v)
    held = force[0] - tank * (area_a - area_b)
    p_b = tank + np.maximum(-held, 0.0) / area_b
    steps = np.diff(time, append=2.0 * time[-1] - time[-2])
    for i in range(len(time)):
        p_b = np.maximum(p_b, np.maximum(least, (area_a * least - force[i]) / area_b))
        found[i], slope = at(i, p_b)
        _, beside = at(i, p_b + _BESIDE)
        # linearly implicit Euler: at low pressures the outlet's flow stiffens
        stiff = np.minimum((beside - slope) / _BESIDE, 0.0)
        p_b = p_b + steps[i] * slope / (1.0 - steps[i] * stiff)
    return found


class ValveFeedforward(ValvePD):
    """Valves opened for the reference's velocities, corrected by position and by sway.

    With y the openings that the reference demands of the circuit (`demanded`), tau = 2 zeta / omega
    the spool's lag, g the opening per velocity of `openings` under the reference's forces,

        w = y + tau y' + K_p (q_ref - q) + K_d (q_ref' - q') + g(v) K theta,
        u = (1 - d) w + d tanh(w / 0.003).

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
        q, v, _ = self._planned(times)
        open_ = [_held(times, self._times, column) for column in self._opening.T]
        known = [q[:, self._which], v[:, self._which], np.transpose(open_)]
        if self._damped:
            inside = np.clip(times, 0.0, self._knots[-1])
            table = [np.interp(inside, self._knots, column) for column in self._table.T]
            known += [np.transpose(table), q[:, self._free]]
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


def _held(times: Array, knots: Array, values: Array) -> Array:
    """Values between knots, nothing beyond them."""
    return np.interp(times, knots, values, left=0.0, right=0.0)
