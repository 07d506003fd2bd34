"""Static equilibrium of the oil of a machine at rest: pressures that go with its loads."""

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from crane.common.samples import Array
from crane.hydraulics.circuit_elements import TANK_NODE
from crane.hydraulics.circuit_equations import CircuitEquations
from crane.hydraulics.hydraulic_circuit import Hydraulics

_RATE_TOLERANCE = 1.0  # rate of a pressure that counts as rest [Pa/s]
_RELAXATION_TIME, _RELAXATION_TOLERANCE = 1e6, 1e-6  # [s], relative
_LOAD_ITERATIONS, _POLISHING_ITERATIONS = 2, 3
_RANK_TOLERANCE = 1e-9  # share of the largest derivative that counts as zero
_NULL_TOLERANCE = 1e-5  # size of a direction of rows of unit size that counts as zero
_NAMED_SHARE = 0.1  # share of a direction from which on a node is named
_LEAKS = ("_leakage", "_leakage_a", "_leakage_b")


class OilEquilibrium:
    """Pressures at which no oil flows, while the pistons stand still and carry their loads.

    The loaded chamber of each cylinder has the pressure that carries the load F,

        p_A = (F + A_B p_B) / A_A, or p_B = (A_A p_A - F) / A_B.

    Oil flows from it and to it until the unloaded chambers, lines and accumulators are at rest,
    with the rates of the circuit, the valves at their neutral signals, and no leakage of
    cylinders or to the tank. Where valves are closed the chambers keep their initial pressures.

    Args:
        circuit: The circuit.
        state: (state_count,) initial state, whose chambers carry the loads.
        positions: (m,) coordinates above the lower limits [m], [rad].
        fixed_joints: Joints whose chambers keep their pressures.

    Attributes:
        state: (state_count,) state at equilibrium, after `find`.
        undetermined: Pressures that may change together at rest, after `find`.
    """

    def __init__(
        self,
        circuit: CircuitEquations,
        state: Array,
        positions: Sequence[float],
        fixed_joints: Collection[str] = (),
    ):
        self._circuit, self.state, self._positions = circuit, state.copy(), positions
        self.undetermined: list[str] = []
        self._names = list(circuit.state_units)
        self._vapour = circuit.hydraulics.oil.vapour_pressure
        leaks = [
            f"elements_{x}_gain"
            for x, element in circuit.hydraulics.elements.items()
            if element.kind == "leak" and TANK_NODE in (element.source, element.target)
        ]
        is_leak = [x.endswith(_LEAKS) or x in leaks for x in circuit.constant_names]
        self._constants = np.where(is_leak, 0.0, circuit.constants).tolist()
        self._loads = []
        tank = circuit.hydraulics.supply.tank
        for (cylinder, *_), first in zip(
            circuit.cylinders_and_valves, circuit.cylinder_state_starts, strict=True
        ):
            a, b = self._vapour + np.maximum(state[first : first + 2], 0.0)
            force = cylinder.area_a * a - cylinder.area_b * b
            loaded_side = int(force < tank * (cylinder.area_a - cylinder.area_b))
            if cylinder.joint not in fixed_joints:
                self._loads.append((cylinder, first, force, loaded_side))

    def rates(self, state: Array) -> Array:
        """Rates (k,) of the stiff states: pistons at rest, valves at their neutral signals."""
        circuit = self._circuit
        moves = [name.startswith(("play_", "spool_")) for name in self._names]
        resting = np.where(np.append(moves, np.zeros(len(state) - len(moves), bool)), 0.0, state)
        values = circuit.evaluate(
            self._constants,
            self._positions,
            [0.0] * len(circuit.joints),
            resting.tolist(),
            [spool.neutral for spool in circuit.hydraulics.spools.values()],
            [circuit.hydraulics.supply.pressure, circuit.hydraulics.supply.tank],
        )
        return np.array(values.state_rates[: len(self._names)], dtype=np.float64)

    def find(self, stores: Iterable[str]) -> str:
        """Find the equilibrium.

        Args:
            stores: Lines and accumulators that leave their initial pressures; the unloaded
                chambers do so, too.

        Returns:
            What does not rest, leakage and pumps aside; "" if all does.
        """
        names = {f"{kind}_{node}" for node in stores for kind in ("pressure", "oil")}
        unknown = [first + 1 - side for _, first, _, side in self._loads]
        self._relax(unknown)  # so that stores do not fill them
        unknown += [i for i, name in enumerate(self._names) if name in names]
        for _ in range(_LOAD_ITERATIONS):
            self._relax(unknown)
            for cylinder, first, force, side in self._loads:
                areas = cylinder.area_a, cylinder.area_b
                other = self._vapour + max(self.state[first + 1 - side], 0.0)
                push = (force, -force)[side] + areas[1 - side] * other
                self.state[first + side] = max(push / areas[side] - self._vapour, 0.0)
        pumps = [f"pressure_{name}" for name in self._circuit.pumps]
        rests = [not x.startswith("pressure_") or x in pumps for x in self._names]
        rates = np.where(rests, 0.0, self.rates(self.state))
        worst = int(np.argmax(np.abs(rates)))
        if abs(rates[worst]) < _RATE_TOLERANCE:
            return ""
        return f"{self._names[worst]} changes by {rates[worst]:.3g} Pa/s while the machine stands"

    def _relax(self, unknown: list[int]) -> None:
        """Let the unknown states come to rest, the others constant."""
        from scipy.integrate import solve_ivp  # slow to import

        scales = self._circuit.scales[unknown]

        def rates(y: Array) -> Array:
            state = self.state.copy()
            state[unknown] = y
            return self.rates(state)[unknown]

        def derivatives(y: Array) -> Array:
            rows = [rates(y + h) - rates(y) for h in np.diag(scales)]
            return np.array(rows).reshape(len(y), -1).T / scales[:, None]

        y = self.state[unknown]
        if np.abs(rates(y)).max(initial=0.0) > 0.0:
            y = solve_ivp(
                lambda _, y: rates(y), (0.0, _RELAXATION_TIME), y, "BDF",
                t_eval=[_RELAXATION_TIME], rtol=_RELAXATION_TOLERANCE, atol=scales,
            ).y[:, -1]  # fmt: skip
        for _ in range(_POLISHING_ITERATIONS):
            step = np.linalg.lstsq(derivatives(y), rates(y) / scales, rcond=_RANK_TOLERANCE)[0]
            y = y - step * scales
        self.state[unknown] = y
        rows = derivatives(y)
        rows /= np.maximum(np.abs(rows).max(axis=1, initial=0.0), 1e-300)[:, None]
        _, sizes, directions = np.linalg.svd(rows)
        names = np.array([self._names[i].partition("_")[2] for i in unknown])
        self.undetermined = [
            ", ".join(names[np.abs(row) > _NAMED_SHARE * np.abs(row).max()].tolist())
            for row in (directions * scales)[sizes <= _NULL_TOLERANCE]
        ]


def open_nodes(hydraulics: Hydraulics) -> set[str]:
    """Lines and accumulators that are open to a chamber while all valves are closed."""
    stores = {*hydraulics.lines, *hydraulics.accumulators}
    paths = []
    for element in hydraulics.elements.values():
        if not element.joints and element.kind != "relief":
            paths.append((element.source, element.target))
            paths += [(element.target, element.source)] * (element.kind != "check")
    chambers = {f"{joint}.{side}" for joint in hydraulics.joints for side in "ab"}
    found: set[str] = set()
    while reached := {y for x, y in paths if x in chambers | found and y in stores} - found:
        found |= reached
    return found
