"""Circuits with every kind of component, on sliding loads, for tests of circuit diagrams."""

from dataclasses import replace

from hydraulic_rig import AREA_A, AREA_B, HOSE, rig

from crane.hydraulics.circuit_elements import (
    Accumulator,
    CircuitElement,
    Engine,
    Supply,
)
from crane.hydraulics.components import CounterbalanceValve, Cylinder, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics, Oil

SENSING = Supply(
    2.8e7, flow=3e-3, control="load-sensing", margin=2e6, standby=2.5e6, relief=3.2e7, power=9e4
)
NEGATIVE = Supply(
    3.4e7, flow=4e-3, control="negative", signal=3e6, throttle=1e-6, relief=3.6e7, power=9e4
)
POSITIVE = Supply(3.4e7, flow=4e-3, control="positive", relief=3.6e7)
FIXED = Supply(2e7, flow=1e-3, control="fixed", relief=2.1e7)
PLAIN = Supply(2e7)
ENGINE = Engine(188.0, 800.0, 2.0)
HELD = CounterbalanceValve(2.5e7, 4.0, 2e6, 1e-6)


def cylinder(joint, **more):
    return Cylinder(joint, AREA_A, AREA_B, HOSE, HOSE, **more)


def valve(joint, **more):
    return Valve(joint, **(dict.fromkeys(("c1", "c2", "c3", "c4"), 5e-7) | more))


def circuit(folder, supply, cylinders, valves, name="X{}", **others):
    """A machine with a circuit; cylinders and valves as keywords of each, in order."""
    joints = [name.format(i) for i in range(1, len(cylinders) + 1)]
    machine = rig(folder, joints=joints)
    parts = {j: cylinder(j, **more) for j, more in zip(joints, cylinders, strict=True)}
    spools = {j: valve(j, **more) for j, more in zip(joints, valves, strict=True)}
    return replace(machine, hydraulics=Hydraulics(supply, Oil(), parts, spools, **others))


EVERYTHING = {
    "relief": 2.1e7, "refill": 1e-6, "cross_relief": 1.5e7, "rupture_a": 2e-3, "rupture_b": 1e-3,
    "counterbalance_a": HELD, "counterbalance_b": HELD,
}  # fmt: skip


def sensing(folder, count=3):
    """Load sensing, with a compensator before the valves."""
    return circuit(folder, SENSING, [{"relief": 2.1e7}] * count, [{"margin": 1e6}] * count,
                   engine=ENGINE)  # fmt: skip


def sharing(folder, count=2):
    return circuit(folder, SENSING, [EVERYTHING] * count, [{"sharing": True}] * count)


def two_pumps(folder, count=8):
    """An excavator's: negative control and open centres, boom and arm by turns."""
    centre = [{"centre": 2e-6, "supply": ("supply", "second")[i % 2]} for i in range(count)]
    second = replace(NEGATIVE, summed=("supply", "second"))
    return circuit(
        folder, second, [{"relief": 3.6e7, "refill": 1e-6}] * count, centre, engine=ENGINE,
        supplies={"second": second},
    )  # fmt: skip


def long_names(folder):
    """Names of users: long, and with letters that mean something elsewhere."""
    first = "boom_swing_cylinder_of_the_$left$_side_1"
    last = "accumulator_of_the_boom_suspension"
    return circuit(
        folder,
        SENSING,
        [EVERYTHING] * 2,
        [{"sharing": True}, {"supply": "C"}],
        name="boom_swing_cylinder_of_the_$left$_side_{}",
        supplies={"C": POSITIVE, "pump_of_the_slewing_gear_motor": FIXED},
        accumulators={last: Accumulator(1e-3, 8e6)},
        elements={
            "ride_control_of_the_boom_on_roads": CircuitElement(
                "orifice", f"{first}.a", last, coefficient=1e-7, joints=(first,)
            ),
            "to": CircuitElement(
                "check", "pump_of_the_slewing_gear_motor", "supply", coefficient=1e-6
            ),
        },
    )


def everything_tapped(folder):
    """Whatever stands beside a chamber's line that leads down, with unequal flows."""
    valves = [{"sharing": True, "regeneration": 1e-6, "c1": 8.1e-6, "c4": 4.56e-6}]
    between = CircuitElement("orifice", "X1.a", "X1.b", coefficient=1e-7)
    return circuit(folder, SENSING, [EVERYTHING], valves, elements={"between": between})
