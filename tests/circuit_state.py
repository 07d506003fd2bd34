"""The state of a hydraulic circuit at given pressures, without a machine around it."""

import numpy as np

from crane.hydraulics.circuit_equations import CircuitEquations


def circuit_of(machine):
    joints = machine.hydraulics.joints
    which = [machine.active.index(joint) for joint in joints]
    strokes = [
        0.0 if machine.hydraulics.cylinders[joint].motor else machine.upper[i] - machine.lower[i]
        for joint, i in zip(joints, which, strict=True)
    ]
    return CircuitEquations(machine.hydraulics, strokes)


def now(machine, signals=(0.0,), x=0.2, v=0.0, **states):
    """The circuit at an instant, and the rates of its states by name.

    Args:
        machine: The machine.
        signals: Of its valves.
        x: Of all joints.
        v: Of all joints.
        states: By name, pressures from a vacuum; those that are not given are 1e5 Pa, and 0.
    """
    circuit = circuit_of(machine)
    state = np.zeros(circuit.state_count)
    vapour = machine.hydraulics.oil.vapour_pressure
    for i, name in enumerate(circuit.state_units):
        pressure = name.startswith("pressure_")
        state[i] = states.pop(name, 1e5 if pressure else 0.0) - vapour * pressure
    assert not states, states
    m = len(circuit.joints)
    found = circuit.evaluate(
        circuit.constants.tolist(), [x] * m, [v] * m, state.tolist(), list(signals), []
    )
    return found, dict(zip(circuit.state_units, found.state_rates, strict=False))


def flow(instant, through, source=None, target=None):
    """The sum of what flows through something, perhaps between two nodes."""
    return sum(
        x.rate
        for x in instant.flows
        if x.path == through and source in (None, x.source) and target in (None, x.target)
    )
