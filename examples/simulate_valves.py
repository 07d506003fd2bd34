"""How do the pressures change when an operator opens the lift valve of a log crane?"""

import numpy as np

import crane

held = {"slew": 0.0, "X_tilt": 0.246, "X_ext": 0.1}  # [rad], [m]
machine = crane.load("patu655", changes={"payload.mass": 200.0}, lock=held)

# 5.8 V is neutral, 2.8 V is fully open; the valve opens after half a second for two seconds
time = np.array([0.0, 0.5, 0.7, 2.7, 2.9])  # [s]
volts = np.array([5.8, 5.8, 4.6, 4.6, 5.8])
recording = crane.simulate(
    machine, crane.control.ValveSignals(machine, time, {"X_lift": volts}), duration=5.0, step=0.005
)
print(recording)

piston, rod_side = (recording[f"pressure_X_lift_{x}"] for x in "ab")  # [Pa], absolute
way = recording["X_lift"][-1] - recording["X_lift"][0]
print(f"the cylinder extends by {1e3 * way:.0f} mm")
print(f"its piston side has {piston[0] / 1e5:.0f} bar at rest, {piston.max() / 1e5:.0f} at most")
print(f"the pump delivers {1e3 * recording['oil_pumped'][-1]:.2f} l")

# at rest A p_A - B p_B equals the gravity force
cylinder = machine.hydraulics.cylinders["X_lift"]
force = cylinder.area_a * piston[0] - cylinder.area_b * rod_side[0]
assert np.isclose(force, crane.Dynamics(machine).gravity(recording.q[0, :1])[0], rtol=1e-9)
# the pump's work is lifted, lost in throttles and friction, or stored in the oil
given = recording["pump_work"]
left = given - recording["work"] - recording["hydraulic_loss"] - recording["oil_energy"]
assert np.abs(left).max() < 1e-4 * given[-1]
