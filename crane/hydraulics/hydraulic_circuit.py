"""The hydraulic circuit of a machine: its components, and which of its nodes are connected."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from crane.common.plausible_ranges import suggested_units_text
from crane.hydraulics.circuit_elements import (
    MAIN_PUMP,
    TANK_NODE,
    Accumulator,
    CircuitElement,
    CircuitLine,
    CircuitParameterError,
    Engine,
    Supply,
    check_conditions,
    check_parameters,
    check_pump_pressures,
    check_reference,
    check_summed_pumps,
    positive_field,
)
from crane.hydraulics.components import Cylinder, Spool, Valve


@dataclass(frozen=True)
class Oil:
    """Properties of the oil, and of the volumes that it fills.

    Attributes:
        bulk_modulus: Bulk modulus of the oil [Pa].
        hose_modulus: Pressure per relative change of the volume of hoses [Pa]; 0 for rigid hoses.
        steel_modulus: Pressure per relative change of the volume of cylinders [Pa]; 0 for rigid
            cylinders.
        vapour_pressure: Vapour pressure, the least pressure of a chamber [Pa].
        gas_exponent: Polytropic exponent of entrapped gas.
        air: Volume of free air at 1e5 Pa, as a share of the volume of the oil.
    """

    bulk_modulus: float = positive_field(1.65e9)
    hose_modulus: float = 0.0
    steel_modulus: float = 0.0
    vapour_pressure: float = 1.0e3
    gas_exponent: float = positive_field(1.4)
    air: float = 0.0

    def __post_init__(self) -> None:
        check_parameters(self, "the oil")


@dataclass(frozen=True)
class PDGains:
    """Gains of the PD controller of a valve, equation (37) of the electro-hydraulic forwarder.

    Attributes:
        kp: Spool position per error of the position [1/m] or [1/rad].
        kd: Spool position per error of the velocity [s/m] or [s/rad].
    """

    kp: float
    kd: float

    def __post_init__(self) -> None:
        check_parameters(self, "PD gains")


@dataclass(frozen=True)
class Hydraulics:
    """The hydraulic circuit of a machine: pumps, and a valve and a cylinder or motor per joint.

    Pressures are absolute. Forces are those of equation (20) of the electro-hydraulic forwarder
    paper, F = area_a p_A - area_b p_B.

    Attributes:
        supply: Main pump and tank.
        oil: Properties of the oil.
        cylinders: Cylinders by joint, in the order of the active joints.
        valves: Valves by joint, in the same order.
        control: Gains of the valve controllers by joint; of all valves or of none.
        supplies: Further pumps by the names of their nodes.
        engine: The engine that drives all pumps; without one their speed is constant.
        lines: Lines by the names of their nodes.
        accumulators: Accumulators by the names of their nodes.
        elements: Elements between nodes, by name.

    Raises:
        CircuitParameterError: Components that do not fit together.
    """

    supply: Supply
    oil: Oil
    cylinders: Mapping[str, Cylinder]
    valves: Mapping[str, Valve]
    control: Mapping[str, PDGains] = field(default_factory=dict)
    supplies: Mapping[str, Supply] = field(default_factory=dict)
    engine: Engine | None = None
    lines: Mapping[str, CircuitLine] = field(default_factory=dict)
    accumulators: Mapping[str, Accumulator] = field(default_factory=dict)
    elements: Mapping[str, CircuitElement] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_tank_pressure(self.supply, self.oil)
        for cylinder in self.cylinders.values():
            check_relief_pressure(self.supply, cylinder)
        check_pump_pressures(self.pumps)
        check_summed_pumps(self.pumps)
        channels = [name.replace(".", "_") for name in self.node_names]  # of recorded pressures
        for section in ("supplies", "lines", "accumulators"):
            repeated = [x for x in getattr(self, section) if channels.count(x) > 1]
            if repeated:
                raise CircuitParameterError(
                    (section, repeated[0]),
                    f"two nodes are called '{repeated[0]}', give them names",
                )
        return_nodes = [x for x in self.node_names if x not in self._chamber_nodes]
        for joint, valve in self.valves.items():
            path, label = ("valves", joint), f"valve of '{joint}'"
            fed = f"{label} is fed by '{valve.supply}'"
            check_reference((*path, "supply"), valve.supply, self.pumps, fed)
            if valve.spool_b and f"{joint}_b" in self.valves:
                raise CircuitParameterError(
                    (*path, "spool_b"),
                    f"the second spool of '{joint}' is called as the joint '{joint}_b', give that "
                    "another name",
                )
            for key in ("return_a", "return_b"):
                node = getattr(valve, key)
                check_reference((*path, key), node, return_nodes, f"{label} leads to '{node}'")
        for name, element in self.elements.items():
            path, label = ("elements", name), f"element '{name}'"
            for key, node in (("from", element.source), ("to", element.target)):
                check_reference((*path, key), node, self.node_names, f"{label} leads to '{node}'")
            for joint in element.joints:
                check_reference(
                    (*path, "joints"), joint, self.valves, f"{label} is opened by '{joint}'"
                )

    @property
    def pumps(self) -> dict[str, Supply]:
        """All pumps by the names of their nodes."""
        return {MAIN_PUMP: self.supply, **self.supplies}

    @property
    def node_names(self) -> list[str]:
        """Names of all nodes: tank, pumps, lines, accumulators, chambers JOINT.a and JOINT.b."""
        return [TANK_NODE, *self.pumps, *self.lines, *self.accumulators, *self._chamber_nodes]

    @property
    def _chamber_nodes(self) -> list[str]:
        return [f"{joint}.{side}" for joint in self.cylinders for side in "ab"]

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints that the circuit drives."""
        return tuple(self.cylinders)

    @property
    def spools(self) -> dict[str, Spool]:
        """Spools by the names of their signals: JOINT, and JOINT_b for a second spool."""
        return {name: x for valve in self.valves.values() for name, x in valve.spools.items()}

    @property
    def circuit_friction_joints(self) -> tuple[str, ...]:
        """Joints to whose Coulomb friction seals or brakes add."""
        return tuple(joint for joint, cylinder in self.cylinders.items() if cylinder.adds_friction)

    def select_joints(self, joints: Iterable[str]) -> "Hydraulics | None":
        """The circuit of some joints, in their order; None if it drives none of them.

        Elements at removed chambers are removed, and lines and accumulators that are no longer
        connected.
        """
        kept = [joint for joint in joints if joint in self.cylinders]
        if not kept:
            return None
        removed_nodes = {
            f"{joint}.{side}" for joint in self.cylinders if joint not in kept for side in "ab"
        }
        circuit = replace(
            self,
            cylinders={joint: self.cylinders[joint] for joint in kept},
            valves={joint: self.valves[joint] for joint in kept},
            control={joint: self.control[joint] for joint in kept if self.control},
            elements={
                name: replace(x, joints=tuple(joint for joint in x.joints if joint in kept))
                for name, x in self.elements.items()
                if not removed_nodes & {x.source, x.target}
                and (not x.joints or any(joint in kept for joint in x.joints))
            },
        )
        nodes = connected_nodes(circuit)
        return replace(
            circuit,
            lines={name: x for name, x in self.lines.items() if name in nodes},
            accumulators={name: x for name, x in self.accumulators.items() if name in nodes},
        )


def check_tank_pressure(supply: Supply, oil: Oil) -> None:
    """Check that the oil does not boil in the tank.

    Raises:
        CircuitParameterError: The pressure of the tank is not above the vapour pressure.
    """
    hint = ": pressures count from a vacuum, write 1e5 for an open tank"
    check_conditions(
        (
            supply.tank <= oil.vapour_pressure,
            "tank",
            f"pressure of the tank is {supply.tank:g} Pa, the oil boils at "
            f"{oil.vapour_pressure:g} Pa{suggested_units_text('tank', supply.tank) or hint}",
        )
    )


def check_relief_pressure(supply: Supply, cylinder: Cylinder) -> None:
    """Check that the relief valves of a cylinder can close.

    Raises:
        CircuitParameterError: Their pressure is not above that of the tank.
    """
    check_conditions(
        (
            0 < cylinder.relief <= supply.tank,
            "relief",
            f"relief of the cylinder of '{cylinder.joint}' is {cylinder.relief:g} Pa, not above "
            f"the tank's {supply.tank:g} Pa, so that it would never close"
            f"{suggested_units_text('relief', cylinder.relief) or ', give a higher one'}",
        )
    )


def connected_nodes(hydraulics: Hydraulics) -> set[str]:
    """Nodes to which a valve or an element is connected, chambers apart."""
    valves, elements = hydraulics.valves.values(), hydraulics.elements.values()
    nodes = {node for valve in valves for node in (valve.supply, valve.return_a, valve.return_b)}
    return nodes | {node for element in elements for node in (element.source, element.target)}


def _flow_paths(hydraulics: Hydraulics) -> list[tuple[str, str]]:
    """Pairs of nodes between which oil can flow, pumps apart, with all valves open.

    Valves lead from the pump into the chambers, and from the chambers to their returns.
    """
    paths: list[tuple[str, str]] = []
    for joint, valve in hydraulics.valves.items():
        cylinder = hydraulics.cylinders[joint]
        a, b = f"{joint}.a", f"{joint}.b"
        paths += [(valve.supply, a), (valve.supply, b), (a, valve.return_a), (b, valve.return_b)]
        if valve.centre > 0:
            paths.append((valve.supply, TANK_NODE))
        if valve.regeneration > 0:
            paths.append((b, a))
        if cylinder.leakage > 0 or cylinder.cross_relief > 0:
            paths += [(a, b), (b, a)]
        leakages = {a: cylinder.leakage_a, b: cylinder.leakage_b}
        paths += [(x, TANK_NODE) for x in (a, b) if leakages[x] > 0 or cylinder.relief > 0]
        if cylinder.refill > 0:
            paths += [(TANK_NODE, a), (TANK_NODE, b)]
    for element in hydraulics.elements.values():
        paths.append((element.source, element.target))
        if element.kind in ("orifice", "leak"):
            paths.append((element.target, element.source))
    for name, supply in hydraulics.pumps.items():
        if supply.relief > 0 or supply.slip > 0:
            paths.append((name, TANK_NODE))
    return paths


def nodes_draining_to_tank(hydraulics: Hydraulics) -> set[str]:
    """Nodes from which oil can flow to the tank."""
    return _reachable_nodes(
        [TANK_NODE], [(target, source) for source, target in _flow_paths(hydraulics)]
    )


def nodes_fed_by_pumps(hydraulics: Hydraulics) -> set[str]:
    """Nodes into which oil can flow from a pump, not only from the tank."""
    return _reachable_nodes(
        hydraulics.pumps, [path for path in _flow_paths(hydraulics) if TANK_NODE not in path]
    )


def _reachable_nodes(starts: Iterable[str], paths: list[tuple[str, str]]) -> set[str]:
    reachable = set(starts)
    while further := {target for source, target in paths if source in reachable} - reachable:
        reachable |= further
    return reachable


def full_opening_flow(hydraulics: Hydraulics, name: str) -> float:
    """Total flow of the compensated valves of a pump at full opening [m3/s]."""
    margin = hydraulics.pumps[name].margin
    return sum(
        max(valve.c1, valve.c4) * (valve.margin or (margin if valve.sharing else 0.0)) ** 0.5
        for valve in hydraulics.valves.values()
        if valve.supply == name
    )
