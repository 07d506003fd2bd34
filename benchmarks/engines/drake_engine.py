"""Drake: discrete MultibodyPlant, loops as ball constraints of its SAP solver."""

from collections.abc import Callable
from typing import Any

import numpy as np
from multibody import Array, Mount
from problem import Problem

from engines.engine import Engine, TreeSimulator
from engines.mujoco_engine import OFFSET


class Drake(Engine):
    """Steps of Drake's discrete plant.

    Continuous plants have no constraints: loops would be closed by stiff bushings.

    Args:
        approximation: "kSap", "kSimilar" or "kLagged".
    """

    package, module = "drake", "pydrake"
    advice = "MultibodyPlant, AddBallConstraint: discrete plants with the SAP solver"

    def __init__(self, approximation: str = "kSap"):
        self.name, self._approximation = "Drake SAP", approximation

    def build(self, problem: Problem, setting: float) -> "DrakeSimulator":
        """See `Engine.build`."""
        return DrakeSimulator(problem, self._approximation, setting)


class DrakeSimulator(TreeSimulator):
    """Steps of one length."""

    def __init__(self, problem: Problem, approximation: str, step: float):
        super().__init__(problem.system)
        from pydrake.multibody import plant as plants
        from pydrake.multibody import tree
        from pydrake.systems.analysis import Simulator

        plant: Any = plants.MultibodyPlant(step)
        plant.set_discrete_contact_approximation(
            getattr(plants.DiscreteContactApproximation, approximation)
        )
        plant.mutable_gravity_field().set_gravity_vector(self.system.gravity)
        self._plant, self._tree = plant, tree
        self._bodies = [plant.world_body()]
        self._joints = [self._add_body(i) for i in range(len(self.system.bodies))]
        self._add_loops()
        for spring in self.system.springs:
            (body1, point1), (body2, point2) = (self._end(mount) for mount in spring.ends)
            plant.AddForceElement(
                tree.LinearSpringDamper(
                    body1, point1, body2, point2, spring.rest, spring.stiffness, spring.damping
                )
            )
        plant.Finalize()
        self._simulator = Simulator(plant)
        self._root = self._simulator.get_mutable_context()
        forces = np.zeros(plant.num_velocities())
        for joint, body in zip(self._joints, self.system.bodies, strict=True):
            forces[joint.velocity_start()] = body.force
        plant.get_applied_generalized_force_input_port().FixValue(self._root, forces)
        self._q = [joint.position_start() for joint in self._joints]
        self._v = [joint.velocity_start() for joint in self._joints]
        self._times = problem.times[1:]

    def _add_body(self, i: int) -> Any:
        from pydrake.math import RigidTransform

        plant, tree, body = self._plant, self._tree, self.system.bodies[i]
        inertia = tree.SpatialInertia.MakeFromCentralInertia(
            body.mass, body.com, rotational_inertia(tree, body.inertia)
        )
        link = plant.AddRigidBody(f"body_{body.name}", inertia)
        self._bodies.append(link)
        parent = self._bodies[body.parent + 1]
        frame = plant.AddFrame(
            tree.FixedOffsetFrame(
                f"mount_{body.name}", parent.body_frame(), RigidTransform(body.placement)
            )
        )
        kind = tree.RevoluteJoint if body.is_revolute else tree.PrismaticJoint
        joint = plant.AddJoint(
            kind(body.name, frame, link.body_frame(), body.axis, damping=body.damping)
        )
        if body.stiffness:
            spring = tree.RevoluteSpring if body.is_revolute else tree.PrismaticSpring
            plant.AddForceElement(spring(joint, body.rest, body.stiffness))
        return joint

    def _end(self, mount: Mount, shift: Array | None = None) -> tuple[Any, Array]:
        point = mount.placement[:3, 3].copy()
        if shift is not None:
            point += mount.placement[:3, :3] @ shift
        return self._bodies[mount.body + 1], point

    def _add_loops(self) -> None:
        for loop in self.system.loops:
            axis = np.zeros(3) if loop.axis is None else loop.axis
            for k in range(1 if loop.axis is None or self.system.is_planar_loop(loop) else 2):
                ends = [
                    self._end(mount, k * OFFSET * axis)
                    for mount in (loop.predecessor, loop.successor)
                ]
                self._plant.AddBallConstraint(*ends[0], *ends[1])

    def single_call(self) -> Callable[[], object]:
        """A step."""
        advance, root, step = self._simulator.AdvanceTo, self._root, self._plant.time_step()
        return lambda: advance(root.get_time() + step)

    def run(self) -> list[tuple[Array, Array]]:
        """See `Simulator.run`."""
        plant, root, system = self._plant, self._root, self.system
        root.SetTime(0.0)
        q, v = np.zeros(plant.num_positions()), np.zeros(plant.num_velocities())
        q[self._q], v[self._v] = system.q, system.v
        plant.SetPositions(root, q)
        plant.SetVelocities(root, v)
        self._simulator.Initialize()
        found = []
        for time in self._times:
            self._simulator.AdvanceTo(float(time))
            found.append((plant.GetPositions(root)[self._q], plant.GetVelocities(root)[self._v]))
        return found


def rotational_inertia(tree: Any, tensor: Array) -> Any:
    """Drake's rotational inertia of a tensor (3, 3)."""
    return tree.RotationalInertia(
        tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[0, 2], tensor[1, 2]
    )
