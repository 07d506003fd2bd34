"""Newton: maximal coordinates in single precision, loops as joints outside of the tree."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from multibody import Array, Loop, State
from problem import Problem

from engines.engine import Engine, Simulator, UnsupportedError

UNLIMITED = 1e9  # limits of joints
Setting = tuple[float, float]


class Newton(Engine):
    """A solver of Newton on the processor; its kernels are compiled before the first run.

    Args:
        solver: "Kamino" or "XPBD".
    """

    package, module = "newton", "newton"
    advice = "Solvers: Kamino for kinematic loops, there DVI for mechanisms with few contacts"
    budget = 6.0

    def __init__(self, solver: str):
        self.name, self._solver = f"Newton {solver}", solver

    def settings(self, problem: Problem) -> Sequence[Setting]:
        """Step [s]; share of the joints' errors corrected in a step, or iterations of XPBD."""
        seconds = (2, 20) if self._solver == "XPBD" else (0.01, 0.1)
        return [(step, second) for step in problem.steps for second in seconds]

    def build(self, problem: Problem, setting: Setting) -> "NewtonSimulator":
        """See `Engine.build`."""
        return NewtonSimulator(problem, self._solver, *setting)


class NewtonSimulator(Simulator):
    """Steps of one length."""

    def __init__(self, problem: Problem, solver: str, step: float, second: float):
        import newton
        import warp

        warp.config.quiet = True
        self.system, self._newton, self._step = problem.system, newton, step
        if self.system.springs:
            raise UnsupportedError("no springs between points of bodies")
        self._builder = newton.ModelBuilder(gravity=tuple(self.system.gravity))
        start = self.system.start
        self._poses = [
            pose(rotation, position - rotation @ body.com)
            for body, rotation, position in zip(
                self.system.bodies, start.rotation, start.position, strict=True
            )
        ]
        self._links = [-1]
        joints = [self._add_body(i) for i in range(len(self.system.bodies))]
        self._builder.add_articulation(joints)
        for loop in self.system.loops:
            self._add_loop(loop)
        self._model = self._builder.finalize()
        self._control = self._model.control()
        forces = np.zeros(self._model.joint_dof_count)
        forces[: len(joints)] = [body.force for body in self.system.bodies]
        self._control.joint_f.assign(forces)
        self._solver = self._create_solver(solver, second)
        self._states = self._model.state(), self._model.state()
        self._count = round(float(problem.times[1]) / step)
        self._outputs = len(problem.times) - 1
        self._reset()
        self._solver.step(*self._states, self._control, None, step)

    def _create_solver(self, solver: str, second: float) -> Any:
        solvers = self._newton.solvers
        if solver == "XPBD":
            return solvers.SolverXPBD(self._model, iterations=int(second))
        config = solvers.SolverKamino.Config(dynamics_solver="dvi", sparse_dynamics=True)
        config.constraints.alpha = second
        return solvers.SolverKamino(self._model, config=config)

    def _add_body(self, i: int) -> int:
        builder, body = self._builder, self.system.bodies[i]
        link = builder.add_link(
            xform=self._poses[i], com=tuple(body.com), inertia=body.inertia.ravel(),
            mass=body.mass, lock_inertia=True,
        )  # fmt: skip
        parent = self._links[body.parent + 1]
        self._links.append(link)
        modes = self._newton.JointTargetMode
        mode = modes.EFFORT if body.force else modes.NONE
        if body.stiffness or body.damping:
            mode = modes.POSITION_VELOCITY
        add = builder.add_joint_revolute if body.is_revolute else builder.add_joint_prismatic
        return add(
            parent, link, parent_xform=matrix_pose(body.placement), axis=tuple(body.axis),
            target_q=body.rest, target_qd=0.0, target_ke=body.stiffness,
            target_kd=body.damping, actuator_mode=mode, limit_lower=-UNLIMITED,
            limit_upper=UNLIMITED, effort_limit=UNLIMITED, armature=0.0, friction=0.0,
        )  # fmt: skip

    def _add_loop(self, loop: Loop) -> None:
        one, two = loop.predecessor, loop.successor
        ends = self._links[one.body + 1], self._links[two.body + 1]
        frames = {
            "parent_xform": matrix_pose(one.placement),
            "child_xform": matrix_pose(two.placement),
        }
        if loop.axis is None or self.system.is_planar_loop(loop):
            self._builder.add_joint_ball(*ends, **frames, armature=0.0)
            return
        self._builder.add_joint_revolute(
            *ends, **frames, axis=tuple(loop.axis), armature=0.0, limit_lower=-UNLIMITED,
            limit_upper=UNLIMITED,
        )  # fmt: skip

    def _reset(self) -> None:
        start = self.system.start
        for state in self._states:
            state.body_q.assign(np.array(self._poses))
            state.body_qd.assign(np.hstack([start.velocity, start.angular_velocity]))
            self._newton.eval_ik(self._model, state, state.joint_q, state.joint_qd)

    def single_call(self) -> Callable[[], object]:
        """A step from the start."""
        self._reset()
        one, two = self._states
        return lambda: self._solver.step(one, two, self._control, None, self._step)

    def run(self) -> list[tuple[Array, Array]]:
        """See `Simulator.run`."""
        self._reset()
        (one, two), found = self._states, []
        for _ in range(self._outputs):
            for _ in range(self._count):
                one.clear_forces()
                self._solver.step(one, two, self._control, None, self._step)
                one, two = two, one
            q, v = (values.numpy().astype(float) for values in (one.body_q, one.body_qd))
            if not np.isfinite(q).all():
                break
            found.append((q, v))
        return found

    def states(self, result: Sequence[tuple[Array, Array]]) -> list[State]:
        """See `Simulator.states`."""
        centres = np.array([body.com for body in self.system.bodies])
        found = []
        for q, v in result:
            rotation = np.array(
                [pin.Quaternion(row).normalized().toRotationMatrix() for row in q[:, 3:]]
            )
            position = q[:, :3] + np.einsum("ijk,ik->ij", rotation, centres)
            found.append(State(rotation, position, v[:, :3], v[:, 3:]))
        return found


def pose(rotation: Array, position: Array) -> tuple[float, ...]:
    """Position and quaternion x, y, z, w of a frame."""
    return *map(float, position), *map(float, pin.Quaternion(rotation).coeffs())


def matrix_pose(placement: Array) -> tuple[float, ...]:
    """Position and quaternion x, y, z, w of a placement (4, 4)."""
    return pose(placement[:3, :3], placement[:3, 3])
