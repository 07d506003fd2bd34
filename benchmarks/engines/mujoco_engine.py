"""MuJoCo: loops as `connect` constraints between sites, contacts off."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from lxml import etree
from multibody import Array, Mount, Multibody
from problem import Problem

from engines.engine import Engine, TreeSimulator

OFFSET = 0.3  # between the two points of a revolute loop in space [m]
# time constant of connections in steps, and their impedance; below two steps `refsafe` is off
STIFFNESSES = ((2.0, 0.9), (1.5, 0.999), (1.5, 0.9999), (0.45, 0.9999))
Setting = tuple[float, float, float]


class MuJoCo(Engine):
    """MuJoCo in its own loop, `mj_step` over many steps.

    Args:
        integrator: "Euler", "implicitfast" or "RK4".
    """

    package, module = "mujoco", "mujoco"
    advice = "Modeling, equality/connect and solver parameters in MuJoCo's documentation"

    def __init__(self, integrator: str):
        self.name, self._integrator = f"MuJoCo {integrator}", integrator

    def settings(self, problem: Problem) -> Sequence[Setting]:
        """Step [s], time constant of the connections in steps, impedance."""
        return [(step, *stiffness) for step in problem.steps for stiffness in STIFFNESSES]

    def build(self, problem: Problem, setting: Setting) -> "MuJoCoSimulator":
        """See `Engine.build`."""
        return MuJoCoSimulator(problem, self._integrator, *setting)


class MuJoCoSimulator(TreeSimulator):
    """Steps of one length."""

    def __init__(
        self, problem: Problem, integrator: str, step: float, constant: float, impedance: float
    ):
        super().__init__(problem.system)
        import mujoco

        self._mujoco: Any = mujoco
        mujoco.set_mju_user_warning(lambda text: None)
        text = mjcf(problem.system, integrator, step, constant * step, impedance)
        self.model = mujoco.MjModel.from_xml_string(text)
        self._data = mujoco.MjData(self.model)
        joints = [self.model.joint(body.name) for body in self.system.bodies]
        self._q = np.array([joint.qposadr[0] for joint in joints])
        self._v = np.array([joint.dofadr[0] for joint in joints])
        self._count = round(float(problem.times[1]) / step)
        self._outputs = len(problem.times) - 1

    def single_call(self) -> Callable[[], object]:
        """A step."""
        step, data = self._mujoco.mj_step, self._data
        return lambda: step(self.model, data)

    def run(self) -> list[tuple[Array, Array]]:
        """See `Simulator.run`."""
        mujoco, data, system = self._mujoco, self._data, self.system
        mujoco.mj_resetData(self.model, data)
        data.qpos[self._q], data.qvel[self._v] = system.q, system.v
        data.qfrc_applied[self._v] = system.joint_force_parameters[3]
        found = []
        for _ in range(self._outputs):
            mujoco.mj_step(self.model, data, self._count)
            if any(warning.number for warning in data.warning):
                break
            found.append((data.qpos[self._q].copy(), data.qvel[self._v].copy()))
        return found


def mjcf(
    system: Multibody, integrator: str, step: float, time_constant: float, impedance: float
) -> str:
    """The system in MJCF."""
    worldbody, equality = etree.Element("worldbody"), etree.Element("equality")
    tendons = etree.Element("tendon")
    elements = [worldbody]
    for body in system.bodies:
        parent = elements[body.parent + 1]
        element = etree.SubElement(
            parent, "body", name=f"body_{body.name}", **pose(body.placement)
        )
        elements.append(element)
        etree.SubElement(
            element, "joint", name=body.name, type="hinge" if body.is_revolute else "slide",
            axis=text(body.axis), stiffness=text(body.stiffness), springref=text(body.rest),
            damping=text(body.damping),
        )  # fmt: skip
        t = body.inertia
        etree.SubElement(
            element, "inertial", mass=text(body.mass), pos=text(body.com),
            fullinertia=text([t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2]]),
        )  # fmt: skip

    def site(mount: Mount, name: str, shift: Array) -> str:
        placement = mount.placement.copy()
        placement[:3, 3] += placement[:3, :3] @ shift
        etree.SubElement(elements[mount.body + 1], "site", name=name, **pose(placement))
        return name

    for i, loop in enumerate(system.loops):
        axis = np.zeros(3) if loop.axis is None else loop.axis
        for k in range(1 if loop.axis is None or system.is_planar_loop(loop) else 2):
            ends = [
                site(mount, f"loop{i}_{end}_{k}", k * OFFSET * axis)
                for end, mount in enumerate((loop.predecessor, loop.successor))
            ]
            etree.SubElement(
                equality, "connect", site1=ends[0], site2=ends[1],
                solref=text([time_constant, 1.0]), solimp=text([impedance, impedance, 1e-3]),
            )  # fmt: skip
    for i, spring in enumerate(system.springs):
        spatial = etree.SubElement(
            tendons, "spatial", stiffness=text(spring.stiffness), damping=text(spring.damping),
            springlength=text(spring.rest),
        )  # fmt: skip
        for end, mount in enumerate(spring.ends):
            name = site(mount, f"spring{i}_{end}", np.zeros(3))
            etree.SubElement(spatial, "site", site=name)
    root = etree.Element("mujoco")
    etree.SubElement(root, "compiler", angle="radian")
    option = etree.SubElement(
        root, "option", gravity=text(system.gravity), integrator=integrator, timestep=text(step),
        jacobian="dense" if len(system.bodies) < 60 else "sparse", tolerance="1e-12",
    )  # fmt: skip
    etree.SubElement(option, "flag", contact="disable", refsafe="disable")
    root.extend([worldbody, equality, tendons])
    return etree.tostring(root).decode()


def plane_normal(system: Multibody) -> Array | None:
    """Normal (3,) of the plane of a planar system, else None."""
    state = system.state(system.q, system.v)
    axes = np.array([system.joint_axis(state, i) for i in range(len(system.bodies))])
    rotates = np.array([body.is_revolute for body in system.bodies])
    normal = axes[rotates][0]
    across = np.abs(axes @ normal)
    planar = np.allclose(across[rotates], 1.0) and np.allclose(across[~rotates], 0.0)
    axes_of_loops = [
        system.direction(state, loop.predecessor, loop.axis)
        for loop in system.loops
        if loop.axis is not None
    ]
    planar = planar and all(abs(axis @ normal) > 1 - 1e-9 for axis in axes_of_loops)
    return normal if planar and abs(normal @ system.gravity) < 1e-9 else None


def text(values: Any) -> str:
    """Numbers of an attribute."""
    return " ".join(repr(float(value)) for value in np.ravel(values))


def pose(placement: Array) -> dict[str, str]:
    """Attributes of a placement (4, 4)."""
    x, y, z, w = pin.Quaternion(placement[:3, :3]).coeffs()
    return {"pos": text(placement[:3, 3]), "quat": text([w, x, y, z])}
