"""Exudyn's kinematic tree: coordinates of the joints, loops as joints between its links."""

from collections.abc import Callable
from typing import Any

import numpy as np
from multibody import Array, Loop, Mount
from problem import Problem

from engines.engine import Engine, TreeSimulator
from engines.exudyn_engine import (
    Setting,
    rotation_to_z,
    settings_of_newton,
    single_step,
    solve,
    solver_settings,
)


class ExudynTree(Engine):
    """An implicit solver of Exudyn on an `ObjectKinematicTree`.

    Args:
        solver: "GeneralizedAlpha" or "TrapezoidalIndex2".
    """

    package, module = "exudyn", "exudyn"
    advice = "ObjectKinematicTree and MarkerKinematicTreeRigid, 'realization of closed loops'"

    def __init__(self, solver: str):
        self.name, self._solver = f"Exudyn tree {solver}", solver

    def settings(self, problem: Problem) -> list[Setting]:
        """See `engines.exudyn_engine.settings_of_newton`."""
        return settings_of_newton(problem)

    def build(self, problem: Problem, setting: Setting) -> "ExudynTreeSimulator":
        """See `Engine.build`."""
        return ExudynTreeSimulator(problem, self._solver, *setting)


class ExudynTreeSimulator(TreeSimulator):
    """Steps of one length; outputs by sensors that Exudyn stores itself."""

    def __init__(self, problem: Problem, solver: str, step: float, tolerance: float, linear: str):
        super().__init__(problem.system)
        import exudyn
        import exudyn.itemInterface as item_interface  # noqa: N813
        import exudyn.utilities

        self._exudyn, self._items = exudyn, item_interface
        exudyn.config.suppressWarnings = True
        self._container = exudyn.SystemContainer()
        self._mbs: Any = self._container.AddSystem()
        self._ground = self._mbs.CreateGround()
        # axes of the links with z along their joint
        self._turns = [rotation_to_z(body.axis).T for body in self.system.bodies]
        self._tree = self._add_tree()
        for loop in self.system.loops:
            self._add_loop(loop)
        for spring in self.system.springs:
            self._mbs.AddObject(
                item_interface.SpringDamper(
                    markerNumbers=[self._marker(mount) for mount in spring.ends],
                    referenceLength=spring.rest, stiffness=spring.stiffness,
                    damping=spring.damping,
                )
            )  # fmt: skip
        kinds = exudyn.OutputVariableType
        self._sensors = [
            self._mbs.AddSensor(
                item_interface.SensorNode(
                    nodeNumber=self._node, storeInternal=True, outputVariableType=kind
                )
            )
            for kind in (kinds.Coordinates, kinds.Coordinates_t)
        ]
        self._mbs.Assemble()
        self._settings = solver_settings(exudyn, problem, step, tolerance, linear)
        self._type = getattr(exudyn.DynamicSolverType, solver)

    def _add_tree(self) -> Any:
        system, turns = self.system, self._turns
        n = len(system.bodies)
        self._node = self._mbs.AddNode(
            self._items.NodeGenericODE2(
                referenceCoordinates=[0.0] * n, initialCoordinates=list(system.q),
                initialCoordinates_t=list(system.v), numberOfODE2Coordinates=n,
            )
        )  # fmt: skip
        exudyn, kinds = self._exudyn, self._exudyn.JointType
        rotations, offsets, inertias, centres = [], [], [], []
        for body, turn in zip(system.bodies, turns, strict=True):
            parent = np.eye(3) if body.parent < 0 else turns[body.parent]
            rotations.append(parent.T @ body.placement[:3, :3] @ turn)
            offsets.append(parent.T @ body.placement[:3, 3])
            inertias.append(turn.T @ body.inertia @ turn)
            centres.append(turn.T @ body.com)
        stiffness, rest, damping, force = system.joint_force_parameters
        return self._mbs.AddObject(
            self._items.ObjectKinematicTree(
                nodeNumber=self._node,
                gravity=system.gravity,
                jointTypes=[
                    kinds.RevoluteZ if body.is_revolute else kinds.PrismaticZ
                    for body in system.bodies
                ],
                linkParents=np.array([body.parent for body in system.bodies]),
                jointTransformations=exudyn.Matrix3DList(rotations),
                jointOffsets=exudyn.Vector3DList(offsets),
                linkInertiasCOM=exudyn.Matrix3DList(inertias),
                linkCOMs=exudyn.Vector3DList(centres),
                linkMasses=np.array([body.mass for body in system.bodies]),
                jointForceVector=force,
                jointPositionOffsetVector=rest,
                jointVelocityOffsetVector=np.zeros(n),
                jointPControlVector=stiffness,
                jointDControlVector=damping,
            )
        )

    def _marker(self, mount: Mount) -> Any:
        point = mount.placement[:3, 3]
        if mount.body < 0:
            return self._mbs.AddMarker(
                self._items.MarkerBodyRigid(bodyNumber=self._ground, localPosition=point)
            )
        return self._mbs.AddMarker(
            self._items.MarkerKinematicTreeRigid(
                objectNumber=self._tree, linkNumber=mount.body,
                localPosition=self._turns[mount.body].T @ point,
            )
        )  # fmt: skip

    def _add_loop(self, loop: Loop) -> None:
        planar = self.system.is_planar_loop(loop)  # whose other equations are redundant
        axis = np.array([0.0, 0.0, 1.0]) if loop.axis is None else loop.axis
        ends = loop.predecessor, loop.successor
        turns = [np.eye(3) if end.body < 0 else self._turns[end.body] for end in ends]
        one, two = (
            turn.T @ end.placement[:3, :3] @ rotation_to_z(axis).T
            for turn, end in zip(turns, ends, strict=True)
        )
        turning = 0 if planar or loop.axis is None else 1
        self._mbs.AddObject(
            self._items.GenericJoint(
                markerNumbers=[self._marker(end) for end in ends],
                constrainedAxes=[1, 1, 0 if planar else 1, turning, turning, 0],
                rotationMarker0=one, rotationMarker1=two,
            )
        )  # fmt: skip

    def single_call(self) -> Callable[[], object]:
        """A step, as a run of one step."""
        return single_step(self._mbs, self._settings, self._type)

    def run(self) -> list[tuple[Array, Array]]:
        """See `Simulator.run`."""
        solve(self._mbs, self._settings, self._type)
        q, v = (self._mbs.GetSensorStoredData(sensor)[1:, 1:] for sensor in self._sensors)
        return list(zip(q, v, strict=True))
