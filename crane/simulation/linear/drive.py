"""What acts on a machine that is linearized: forces, or a circuit with its valves."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from crane.codegen import Expression, Number, Program, Tape
from crane.codegen.derivative import derivatives
from crane.codegen.scalar import subtract
from crane.common.samples import Array
from crane.control import At, Signals, ValveDrive
from crane.dynamics import Dynamics, JointForces
from crane.dynamics.law import sign_of
from crane.hydraulics.circuit import BALANCES
from crane.machine import Machine
from crane.recordings.recording import FORCE_UNITS
from crane.simulation.integration.traced import settings_of

_AJAR = 1e-6  # of a spool's stroke, beyond the dead band


class Drive:
    """What acts on the machine, its states and inputs: forces, or a circuit with its valves.

    Attributes:
        states: Names and units of the drive's own states.
        inputs: Names and units.
        seen: Names and units of what else can be an output.
        own: (k,) states where the machine stands still.
        u: (m,) inputs there.
    """

    def __init__(
        self,
        machine: Machine,
        dynamics: Dynamics,
        q: Array,
        valves: bool,
        pressures: Mapping[str, tuple[float, float]] | None,
    ):
        n = self._n = len(machine.active)
        self.states: dict[str, str] = {}
        self.inputs = {
            f"{joint}_force": FORCE_UNITS[machine.unit(joint)]
            for joint, driven in zip(machine.active, machine.driven, strict=True)
            if driven
        }
        self.seen: dict[str, str] = {}
        self.own, self.u = np.zeros(0), np.zeros(len(self.inputs))
        self.scales, self._vapour, self._idles = np.zeros(0), 0.0, 0.0
        self._control: ValveDrive | None = None
        self._spread = np.eye(n)[:, machine.driven]
        if valves:
            control = ValveDrive(machine, Signals(machine, [0.0], {}), pressures)
            self._control = control
            circuit = control.circuit
            self.states = dict(circuit.states)
            self._stiff, self.scales = circuit.stiff, circuit.scales[: circuit.stiff]
            engine = circuit.hydraulics.engine
            self._idles = engine.speed_droop / engine.speed if engine is not None else 0.0
            self._vapour = circuit.hydraulics.oil.vapour_pressure
            self._owner = {
                name: joint
                for joint, first, last in zip(
                    circuit.joints, circuit.starts, circuit.ends, strict=True
                )
                for name in list(self.states)[first:last]
            }
            self.inputs = {f"voltage_{name}": "V" for name in circuit.spools}
            self.seen = dict(control.channels) | {
                f"{joint}_force": FORCE_UNITS[machine.unit(joint)] for joint in circuit.joints
            }
            self._forces = [machine.active.index(joint) for joint in circuit.joints]
            self.own = control.start_at(dynamics, q)[: self._stiff]
            self.u = control.references(np.zeros(1))[0]
            self._program = self._built(machine)

    def moving(self, v_a: Array, shared: bool) -> Array:
        """(k + m,) which states and signals belong to joints that move, or perhaps to no joint."""
        assert self._control is not None
        joints = self._control.circuit.joints
        moving = {x for x, i in zip(joints, self._forces, strict=True) if v_a[i]}
        own = [
            self._owner[name] in moving if name in self._owner else shared for name in self.states
        ]
        spools = self._control.circuit.hydraulics.spools.values()
        mask: Any = np.array([*own, *(spool.joint in moving for spool in spools)])
        return mask

    def loaded(self, forces: Array) -> Any:
        """(k,) which states are pressures of the chambers that bear forces (n,)."""
        assert self._control is not None
        found = np.zeros(len(self.states), dtype=bool)
        for i, first in zip(self._forces, self._control.circuit.starts, strict=True):
            found[first + int(forces[i] < 0)] = True
        return found

    def opened(self, v_a: Array, share: float) -> tuple[Array, Array, Array, Array]:
        """States and signals z with valves open by a share of their stroke, and where they may go.

        Returns:
            z (k + m,); how it depends on pressures and openings (k + m, r); least and most of
            these (r,), which keep valves open and pumps within their droop.
        """
        assert self._control is not None
        hydraulics, names = self._control.circuit.hydraulics, list(self.states)
        supply, k = hydraulics.supply, len(names)
        z = np.concatenate([self.own, self.u])
        ways: list[Array] = []
        ends: list[tuple[float, float]] = []

        above: dict[str, int] = {}

        def free(name: str, value: float, least: float, most: float) -> None:
            z[at := names.index(name)] = value
            ways.append(np.eye(len(z))[at])
            ends.append((least - value, most - value))

        for name, pump in self._control.circuit.pumps.items():
            top = pump.pressure - self._vapour
            if pump.control == "pressure":
                free(f"pressure_{name}", top - 0.5 * pump.droop, top - pump.droop, top)
            elif pump.control == "load-sensing":  # above the loads that are guessed below
                base = 0.3 * supply.pressure + pump.margin - 0.5 * pump.droop
                free(f"pressure_{name}", base, base - 0.5 * pump.droop, base + 0.5 * pump.droop)
                above[name] = names.index(f"pressure_{name}")
            else:
                free(f"pressure_{name}", 0.4 * top, 0.0, np.inf)
            if f"share_{name}" in names:
                free(f"share_{name}", 0.5, 0.0, 1.0)
        for name in hydraulics.lines:
            free(f"pressure_{name}", self.own[names.index(f"pressure_{name}")], 0.0, np.inf)
        for name in hydraulics.accumulators:
            free(f"pressure_{name}", self.own[names.index(f"pressure_{name}")], 0.0, np.inf)
            if f"oil_{name}" in names:
                at = names.index(f"oil_{name}")
                free(f"oil_{name}", self.own[at], -np.inf, np.inf)
        if "engine" in names:
            free("engine", 1.0 + 0.5 * self._idles, 1.0, 1.0 + self._idles)
        for i, (joint, valve) in enumerate(hydraulics.valves.items()):
            if not (side := float(np.sign(v_a[self._forces[i]]))):
                continue
            for at, name in enumerate(names):
                if name in (f"pressure_{joint}_a", f"pressure_{joint}_b"):
                    z[at] = max(z[at], 0.3 * supply.pressure)
                    ways.append(np.eye(len(z))[at])
                    ends.append((-z[at], np.inf))
                    if valve.supply in above and name.endswith("a" if side > 0 else "b"):
                        ways[-1][above[valve.supply]] = 1.0
            dead, open_to = valve.dead_band, valve.dead_band + share * (1.0 - valve.dead_band)
            way = np.zeros(len(z))
            for name, spool in valve.spools.items():  # two open alike
                alike = (1.0 - spool.dead_band) / (1.0 - dead)
                at = k + self._control.circuit.spools.index(name)
                way[at] = side * alike * (spool.full - spool.neutral)
                own = spool.dead_band + share * (1.0 - spool.dead_band)
                z[at] = spool.neutral + own * side * (spool.full - spool.neutral)
                if f"spool_{name}" in names:
                    at = names.index(f"spool_{name}")
                    way[at], z[at] = side * alike, side * own
            ways.append(way)
            ends.append((dead + _AJAR - open_to, 1.0 - open_to))
        lower, upper = np.array(ends).T
        return z, np.array(ways).T, lower, upper

    @property
    def shown(self) -> Array:
        """(k,) what states are to be added for pressures to count from a vacuum."""
        return np.array([self._vapour * name.startswith("pressure_") for name in self.states])

    def _built(self, machine: Machine) -> Program:
        control, n, k, m = self._control, self._n, self._stiff, len(self.inputs)
        assert control is not None
        tape = Tape()
        q_a, v_a, own = tape.loads(0, 0, n), tape.loads(0, n, n), tape.loads(0, 2 * n, k)
        settings, u = settings_of(control, tape, 1, fold=True), tape.loads(0, 2 * n + k, m)
        integrals: list[Number] = [0.0] * len(BALANCES)
        at = At(q_a, v_a, [*own, *integrals], settings, u, _not_asked, _not_asked)
        tau, rates = control.trace(at)
        seen = [*control.look(at), *(tau[i] for i in self._forces)]
        if grip := control.grip(at):
            tau = subtract(tau, self._gripped(machine, grip, v_a))
        values = [*tau, *rates[:k], *seen]
        by = [x for x in (*q_a, *v_a, *own, *u) if isinstance(x, Expression)]
        slopes = [entry for row in derivatives(values, by) for entry in row]
        words = [x.index if isinstance(x, Expression) else float(x) for x in (*values, *slopes)]
        fast, key = machine.closure.fast, ("linear drive", repr((tape.operations, words)))

        def build(program: Program) -> None:
            program.add("formula", 2, {"values": values, "slopes": slopes})

        if key not in fast.programs:
            fast.programs[key] = fast.kept(key, build)
        return fast.programs[key]

    @staticmethod
    def _gripped(machine: Machine, grip: Sequence[Number], v_a: Sequence[Number]) -> list[Number]:
        """Friction (n,) that seals and brakes add, F_K sign(v), that of joints at rest being 0."""
        out: list[Number] = [0.0] * len(v_a)
        forces = JointForces(machine)
        for column, force in zip(forces.gripped, grip, strict=True):
            i = machine.active.index(machine.joints[column])
            sticks = column in forces.sticking
            out[i] = force * sign_of(forces.table[column].tolist(), v_a[i], sticks, False)
        return out

    def at(self, q_a: Array, v_a: Array, own: Array, u: Array) -> tuple[Array, Array]:
        """Forces (n,), rates (k,) and what is seen, and their derivatives by all arguments."""
        n = self._n
        if self._control is None:
            slopes = np.zeros((n, 2 * n + len(u)))
            slopes[:, 2 * n :] = self._spread
            return self._spread @ u, slopes
        layout = self._program.outputs("formula")
        out = np.empty(layout.size)
        settings = np.ascontiguousarray(self._control.settings)
        self._program.call("formula", np.concatenate([q_a, v_a, own, u]), settings, out)
        values, slopes = out[layout["values"]], out[layout["slopes"]]
        return values, slopes.reshape(len(values), -1)


def _not_asked(a_a: Sequence[Number] = (), friction: bool = False) -> list[Number]:
    raise AssertionError("signals that are given do not ask for forces")
