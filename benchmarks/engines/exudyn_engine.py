"""Exudyn: rigid bodies in redundant coordinates, planar bodies where the problem is planar."""

import contextlib
import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from multibody import Array, Mount, State
from problem import Problem

from engines.engine import Engine, Simulator, UnsupportedError
from engines.mujoco_engine import plane_normal

NEWTON_TOLERANCES = (1e-5, 1e-8)
DENSE_BODIES = 10  # in a plane, below which the dense solver is the faster one
Setting = tuple[float, float, str]
GROUND = -1


class Exudyn(Engine):
    """An implicit solver of Exudyn, for index-3 or index-2 constraints.

    Args:
        solver: "GeneralizedAlpha" or "TrapezoidalIndex2".
    """

    package, module = "exudyn", "exudyn"
    advice = "Solvers in Exudyn; its examples fourBarMechanismIftomm and bricardMechanism"

    def __init__(self, solver: str):
        self.name, self._solver = f"Exudyn {solver}", solver

    def settings(self, problem: Problem) -> list[Setting]:
        """See `settings_of_newton`."""
        return settings_of_newton(problem)

    def build(self, problem: Problem, setting: Setting) -> "ExudynSimulator":
        """See `Engine.build`."""
        return ExudynSimulator(problem, self._solver, *setting)


class ExudynSimulator(Simulator):
    """Steps of one length; outputs by sensors that Exudyn stores itself."""

    def __init__(self, problem: Problem, solver: str, step: float, tolerance: float, linear: str):
        import exudyn
        import exudyn.utilities

        self._exudyn: Any = exudyn
        exudyn.config.suppressWarnings = True
        self.system = problem.system
        normal = plane_normal(self.system)
        self._planar = normal is not None
        self._turn = np.eye(3) if normal is None else rotation_to_z(normal)
        self._container = exudyn.SystemContainer()
        self._mbs = self._container.AddSystem()
        self._state = self.system.state(self.system.q, self.system.v)
        self._ground = self._mbs.CreateGround()
        self._bodies = [self._add_body(i) for i in range(len(self.system.bodies))]
        for i in range(len(self.system.bodies)):
            self._add_joint(i)
        for loop in self.system.loops:
            self._add_loop(loop)
        for spring in self.system.springs:
            self._add_spring(spring)
        self._sensors = [self._add_sensors(body) for body in self._bodies]
        self._mbs.Assemble()
        self._settings = solver_settings(exudyn, problem, step, tolerance, linear)
        self._type = getattr(exudyn.DynamicSolverType, solver)

    def _add_body(self, i: int) -> Any:
        body, state, turn = self.system.bodies[i], self._state, self._turn
        exudyn = self._exudyn
        with contextlib.redirect_stdout(io.StringIO()):  # of triangle inequalities, to rounding
            inertia = exudyn.utilities.RigidBodyInertia(
                mass=body.mass, inertiaTensor=self._local_inertia(i), com=[0, 0, 0]
            )
        return self._mbs.CreateRigidBody(
            referencePosition=turn @ state.position[i],
            referenceRotationMatrix=self._rotation(i),
            initialVelocity=turn @ state.velocity[i],
            initialAngularVelocity=turn @ state.angular_velocity[i],
            inertia=inertia,
            gravity=turn @ self.system.gravity,
            create2D=self._planar,
        )

    def _rotation(self, i: int) -> Array:
        """Initial rotation of a body: the identity for planar bodies, which then turn about z."""
        return np.eye(3) if self._planar else self._turn @ self._state.rotation[i]

    def _local_inertia(self, i: int) -> Array:
        to_local = self._rotation(i).T @ self._turn @ self._state.rotation[i]
        return to_local @ self.system.bodies[i].inertia @ to_local.T

    def _item(self, body: int) -> Any:
        return self._ground if body < 0 else self._bodies[body]

    def _local(self, body: int, point: Array) -> Array:
        """A point of the world (3,) in the frame of a body about its centre of mass."""
        if body < 0:
            return self._turn @ point
        offset = self._turn @ (point - self._state.position[body])
        return self._rotation(body).T @ offset

    def _add_joint(self, i: int) -> None:
        body, parent = self.system.bodies[i], self.system.bodies[i].parent
        point = self.system.joint_point(self._state, i)
        axis = self._turn @ self.system.joint_axis(self._state, i)
        items = [self._item(parent), self._item(i)]
        if self._planar:
            self._add_planar_joint(i, point, axis)
        else:
            create = (
                self._mbs.CreateRevoluteJoint if body.is_revolute
                else self._mbs.CreatePrismaticJoint
            )  # fmt: skip
            create(itemNumbers=items, position=self._turn @ point, axis=axis, useGlobalFrame=True)
        q = self.system.q[i]
        if body.stiffness or body.damping or (body.force and not self._planar):
            if self._planar:
                raise UnsupportedError("springs along planar joints")
            create_spring = (
                self._mbs.CreateTorsionalSpringDamper if body.is_revolute
                else self._mbs.CreateLinearSpringDamper
            )  # fmt: skip
            strength = {"torque" if body.is_revolute else "force": -body.force}
            create_spring(
                itemNumbers=items, position=self._turn @ point, axis=axis, offset=body.rest - q,
                stiffness=body.stiffness, damping=body.damping, **strength,
            )  # fmt: skip
        elif body.force:
            if not body.is_revolute or parent >= 0:
                raise UnsupportedError("a constant force between moving bodies")
            self._mbs.CreateTorque(
                itemNumber=self._item(i), loadVector=body.force * axis, bodyFixed=False
            )

    def _add_planar_joint(self, i: int, point: Array, axis: Array) -> None:
        import exudyn.itemInterface as item_interface  # noqa: N813

        mbs, parent = self._mbs, self.system.bodies[i].parent
        if self.system.bodies[i].is_revolute:
            self._add_pin(parent, i, point)
            return
        markers = [
            mbs.AddMarker(
                item_interface.MarkerBodyRigid(
                    bodyNumber=self._item(k), localPosition=self._local(k, point)
                )
            )
            for k in (parent, i)
        ]
        normal = np.array([-axis[1], axis[0], 0.0])
        mbs.AddObject(
            item_interface.ObjectJointPrismatic2D(
                markerNumbers=markers, axisMarker0=axis, normalMarker1=normal,
                constrainRotation=True,
            )
        )  # fmt: skip

    def _add_pin(self, one: int, two: int, point: Array) -> None:
        import exudyn.itemInterface as item_interface  # noqa: N813

        markers = [
            self._mbs.AddMarker(
                item_interface.MarkerBodyPosition(
                    bodyNumber=self._item(k), localPosition=self._local(k, point)
                )
            )
            for k in (one, two)
        ]
        self._mbs.AddObject(item_interface.ObjectJointRevolute2D(markerNumbers=markers))

    def _add_loop(self, loop: Any) -> None:
        one, two = loop.predecessor, loop.successor
        point = self.system.point(self._state, one)
        if self._planar:
            self._add_pin(one.body, two.body, point)
            return
        common = {
            "itemNumbers": [self._item(one.body), self._item(two.body)],
            "position": self._turn @ point,
            "useGlobalFrame": True,
        }
        if loop.axis is None:
            self._mbs.CreateSphericalJoint(**common)
            return
        axis = self._turn @ self.system.direction(self._state, one, loop.axis)
        if self.system.is_planar_loop(loop):  # the other equations are redundant
            self._mbs.CreateGenericJoint(
                rotationMatrixAxes=rotation_to_z(axis).T, constrainedAxes=[1, 1, 0, 0, 0, 0],
                **common,
            )  # fmt: skip
        else:
            self._mbs.CreateRevoluteJoint(axis=axis, **common)

    def _add_spring(self, spring: Any) -> None:
        def local(mount: Mount) -> Array:
            return self._local(mount.body, self.system.point(self._state, mount))

        one, two = spring.ends
        self._mbs.CreateSpringDamper(
            itemNumbers=[self._item(one.body), self._item(two.body)], localPosition0=local(one),
            localPosition1=local(two), referenceLength=spring.rest, stiffness=spring.stiffness,
            damping=spring.damping,
        )  # fmt: skip

    def _add_sensors(self, body: Any) -> list:
        import exudyn.itemInterface as item_interface  # noqa: N813

        kinds = self._exudyn.OutputVariableType
        names = ("Position", "RotationMatrix", "Velocity", "AngularVelocity")
        return [
            self._mbs.AddSensor(
                item_interface.SensorBody(
                    bodyNumber=body, storeInternal=True, outputVariableType=getattr(kinds, name)
                )
            )
            for name in names
        ]

    def single_call(self) -> Callable[[], object]:
        """A step, as a run of one step."""
        return single_step(self._mbs, self._settings, self._type)

    def run(self) -> list[Array]:
        """See `Simulator.run`."""
        solve(self._mbs, self._settings, self._type)
        return [
            [self._mbs.GetSensorStoredData(sensor) for sensor in sensors]
            for sensors in self._sensors
        ]

    def states(self, result: Sequence) -> list[State]:
        """See `Simulator.states`."""
        back = self._turn.T
        count = min(len(table) for sensors in result for table in sensors)
        found = []
        for k in range(1, count):
            rows = [[table[k, 1:] for table in sensors] for sensors in result]
            rotation = [
                back @ row[1].reshape(3, 3) @ self._rotation(i).T @ self._turn
                @ self._state.rotation[i] if self._planar else back @ row[1].reshape(3, 3)
                for i, row in enumerate(rows)
            ]  # fmt: skip
            parts = [np.array([back @ row[j] for row in rows]) for j in (0, 2, 3)]
            found.append(State(np.array(rotation), *parts))
        return found


def settings_of_newton(problem: Problem) -> list[Setting]:
    """Step [s], tolerance of Newton's method, linear solver.

    Overconstrained loops need the one that ignores redundant equations, which is slow.
    """
    system = problem.system
    is_small = len(system.bodies) < DENSE_BODIES and plane_normal(system) is not None
    solvers = ["EXUdense" if is_small else "EigenSparse"]
    if any(loop.axis is not None and not system.is_planar_loop(loop) for loop in system.loops):
        solvers.append("EigenDense")
    return [
        (step, tolerance, solver)
        for step in problem.steps
        for tolerance in NEWTON_TOLERANCES
        for solver in solvers
    ]


def solver_settings(
    exudyn: Any, problem: Problem, step: float, tolerance: float, linear: str
) -> Any:
    """Settings of a solver with steps of one length."""
    settings = exudyn.SimulationSettings()
    integration = settings.timeIntegration
    integration.endTime = problem.duration
    integration.numberOfSteps = round(problem.duration / step)
    integration.verboseMode = 0
    integration.adaptiveStep = False
    integration.newton.absoluteTolerance = tolerance
    integration.newton.relativeTolerance = tolerance
    integration.newton.useModifiedNewton = True
    settings.solution.file.write = False
    settings.solutionSettings.sensorsWritePeriod = float(problem.times[1])
    settings.displayComputationTime = False
    settings.linearSolver.solverType = getattr(exudyn.LinearSolverType, linear)
    settings.linearSolver.ignoreSingularJacobian = linear == "EigenDense"  # redundant equations
    return settings


def solve(mbs: Any, settings: Any, kind: Any) -> None:
    """Simulate.

    Raises:
        UnsupportedError: The solver gives up.
    """
    try:
        mbs.SolveDynamic(settings, solverType=kind)
    except Exception as error:
        raise UnsupportedError("the solver stops: " + str(error).splitlines()[0]) from None


def single_step(mbs: Any, settings: Any, kind: Any) -> Callable[[], object]:
    """A run of one step from the start."""
    integration = settings.timeIntegration
    step = integration.endTime / integration.numberOfSteps
    end, count = integration.endTime, integration.numberOfSteps

    def call() -> None:
        integration.endTime, integration.numberOfSteps = step, 1
        solve(mbs, settings, kind)
        integration.endTime, integration.numberOfSteps = end, count

    return call


def rotation_to_z(normal: Array) -> Array:
    """A rotation (3, 3) that takes a unit vector to z."""
    seed = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(seed, normal)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])
