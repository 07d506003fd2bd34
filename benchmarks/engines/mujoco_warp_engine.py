"""MuJoCo Warp on the processor: the models of MuJoCo, in single precision."""

from collections.abc import Callable

from multibody import Array
from problem import Problem

from engines.engine import Engine, TreeSimulator
from engines.mujoco_engine import STIFFNESSES, Setting, mjcf


class MuJoCoWarp(Engine):
    """`mujoco_warp.step` in a loop in Python, with Runge-Kutta steps of order 4."""

    name = "MuJoCo Warp RK4"
    package, module = "mujoco-warp", "mujoco_warp"
    advice = "MuJoCo Warp (MJWarp) in MuJoCo's documentation: put_model, put_data, step"
    budget = 6.0

    def settings(self, problem: Problem) -> list[Setting]:
        """The two best ones of `MuJoCo` for each step."""
        return [(step, *stiffness) for step in problem.steps for stiffness in STIFFNESSES[-2:]]

    def build(self, problem: Problem, setting: Setting) -> "MuJoCoWarpSimulator":
        """See `Engine.build`."""
        return MuJoCoWarpSimulator(problem, *setting)


class MuJoCoWarpSimulator(TreeSimulator):
    """Steps of one length; kernels are compiled before the first run."""

    def __init__(self, problem: Problem, step: float, constant: float, impedance: float):
        super().__init__(problem.system)
        import mujoco
        import mujoco_warp

        self._warp = mujoco_warp
        text = mjcf(problem.system, "RK4", step, constant * step, impedance)
        self._model = mujoco.MjModel.from_xml_string(text)
        # connections make a quadratic problem: Newton's method ends after a step
        self._model.opt.iterations, self._model.opt.tolerance = 2, 1e-6
        self._start = mujoco.MjData(self._model)
        joints = [self._model.joint(body.name) for body in self.system.bodies]
        self._q = [joint.qposadr[0] for joint in joints]
        self._v = [joint.dofadr[0] for joint in joints]
        self._start.qpos[self._q], self._start.qvel[self._v] = self.system.q, self.system.v
        self._start.qfrc_applied[self._v] = self.system.joint_force_parameters[3]
        mujoco.mj_forward(self._model, self._start)
        self._device_model = mujoco_warp.put_model(self._model)
        self._device_model.opt.warn_overflow = 0
        self._count = round(float(problem.times[1]) / step)
        self._outputs = len(problem.times) - 1
        mujoco_warp.step(self._device_model, mujoco_warp.put_data(self._model, self._start))

    def single_call(self) -> Callable[[], object]:
        """A step."""
        data = self._warp.put_data(self._model, self._start)
        return lambda: self._warp.step(self._device_model, data)

    def run(self) -> list[tuple[Array, Array]]:
        """See `Simulator.run`."""
        data = self._warp.put_data(self._model, self._start)
        found = []
        for _ in range(self._outputs):
            for _ in range(self._count):
                self._warp.step(self._device_model, data)
            q, v = (values.numpy()[0].astype(float) for values in (data.qpos, data.qvel))
            found.append((q[self._q], v[self._v]))
        return found
