"""Which torques hold the stretched arm of a URDF?"""

import numpy as np
import pinocchio as pin

import crane

machine = crane.load("ur5_robot")  # of example-robot-data; or the path of your own file
print(machine)

q = np.zeros(6)  # [rad], the arm is stretched horizontally
torque = crane.Dynamics(machine).gravity(q)  # [N m]
for joint, value in zip(machine.active, torque, strict=True):
    print(f"{joint:20} {value:z8.3f} N m")
lift = machine.active.index("shoulder_lift_joint")
print(f"the shoulder holds {abs(torque[lift]):.1f} N m")

# the same by hand: weight of the arm times the distance of its centre of mass from the shoulder
model, data = machine.model, machine.model.createData()
pin.centerOfMass(model, data, q)
joint = model.getJointId("shoulder_lift_joint")
ahead = (data.oMi[joint].rotation @ data.com[joint])[0]  # [m]
assert np.isclose(abs(torque[lift]), data.mass[joint] * 9.81 * ahead, rtol=1e-9)
