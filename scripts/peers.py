"""The other engines of the benchmark: Pinocchio's constraint dynamics, and MuJoCo.

Both simulate a machine without friction and end stops, with springs and dampers at its joints,
from the same closed configuration and the same velocities as `crane.simulate`.
"""

from typing import Any

import numpy as np
import pinocchio as pin
from lxml import etree

import crane

Array = np.ndarray
INTEGRATORS = ("Euler", "implicitfast", "RK4")


class ConstraintDynamics:
    """pin.constraintDynamics with points of contact at each loop, one is enough in a plane.

    mu = 1e-4 and at most 3 iterations suit the mini forwarder best: the redundant rows of plane
    loops keep it from its residual for ever, and with these it gives the accelerations to
    rounding all the same.

    Args:
        machine: The machine.
        along: Where the points of a loop are, on its axis [m].
        mu: Of the proximal method.
        iterations: Its most.
    """

    def __init__(
        self,
        machine: crane.Machine,
        along: tuple[float, ...] = (0.0,),
        mu: float = 1e-4,
        iterations: int = 3,
    ):
        model = machine.model
        self.machine, self.model, self.data = machine, model, model.createData()
        self._models = pin.StdVec_RigidConstraintModel()
        self._datas = pin.StdVec_RigidConstraintData()
        for loop in machine.closure.equations.loops:
            one, two = (
                model.frames[machine.frame(name)] for name in (loop.predecessor, loop.successor)
            )
            for distance in along:
                offset = pin.SE3(np.eye(3), distance * np.array(loop.axis))
                self._models.append(
                    pin.RigidConstraintModel(
                        pin.ContactType.CONTACT_3D,
                        model,
                        one.parentJoint,
                        one.placement * offset,
                        two.parentJoint,
                        two.placement * offset,
                        pin.LOCAL,
                    )
                )
        for constraint in self._models:
            self._datas.append(constraint.createData())
        pin.initConstraintDynamics(model, self.data, self._models, self._datas)
        self._settings = pin.ProximalSettings(1e-12, mu, iterations)
        self._stiffness, self._rest, self._damping = np.zeros((3, model.nv))
        for element in machine.forces:
            column = machine.column(element.joint)
            self._stiffness[column] = element.stiffness
            self._rest[column] = element.rest
            self._damping[column] = element.damping

    def acceleration(self, q: Array, v: Array) -> Array:
        """Of all joints (nv,), with springs and dampers."""
        tau = self._stiffness * (self._rest - q) - self._damping * v
        return self.forward(q, v, tau)

    def forward(self, q: Array, v: Array, tau: Array) -> Array:
        """The call itself: accelerations of all joints (nv,) under joint forces tau (nv,)."""
        return pin.constraintDynamics(
            self.model, self.data, q, v, tau, self._models, self._datas, self._settings
        )


# Time constant of MuJoCo's connections in steps, and their impedance: what gives the least errors
# on the mini forwarder. Smaller time constants are stiffer, then unstable; MuJoCo takes impedances
# up to 0.9999.
BEST = {"Euler": (1.5, 0.999), "implicitfast": (1.5, 0.999), "RK4": (0.45, 0.9999)}


class MuJoCo:
    """The machine's tree of bodies in MuJoCo, its loops as connections between sites.

    Contacts are switched off. So is the rule that keeps time constants above two steps, which
    holds the Runge-Kutta method back.

    Args:
        machine: The machine.
        step: [s].
        integrator: "Euler", "implicitfast" or "RK4".
        impedance: Of the connections; the best for the integrator if not given.
    """

    def __init__(
        self, machine: crane.Machine, step: float, integrator: str, impedance: float | None = None
    ):
        import mujoco

        self._mujoco: Any = mujoco
        mujoco.set_mju_user_warning(lambda text: None)
        constant, best = BEST[integrator]
        impedance = impedance or best
        solref = [constant * step, 1.0]
        text = mjcf(machine, step, integrator, solref, [impedance, impedance, 1e-3])
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(name) for name in machine.joints]
        self._q = np.array([joint.qposadr[0] for joint in joints])
        self._v = np.array([joint.dofadr[0] for joint in joints])

    @property
    def mass(self) -> float:
        """Of all bodies [kg]."""
        return float(self.model.body_mass.sum())

    def start(self, q: Array, v: Array) -> None:
        """Put it in a state, without memory of an earlier one."""
        self._mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._q], self.data.qvel[self._v] = q, v

    def acceleration(self) -> Array:
        """Of all joints in the order of the machine's tree (nv,)."""
        self._mujoco.mj_forward(self.model, self.data)
        return self.data.qacc[self._v].copy()

    def run(self, steps: int) -> None:
        """Make steps, in MuJoCo's own loop."""
        self._mujoco.mj_step(self.model, self.data, steps)


def mjcf(
    machine: crane.Machine, step: float, integrator: str, solref: list[float], solimp: list[float]
) -> str:
    """A machine in MuJoCo's words."""
    model = machine.model
    worldbody, equality = etree.Element("worldbody"), etree.Element("equality")
    elements = {element.joint: element for element in machine.forces}
    bodies = [worldbody]
    for i in range(1, model.njoints):
        name, inertia = model.names[i], model.inertias[i]
        place = _pose(model.jointPlacements[i])
        body = etree.SubElement(bodies[model.parents[i]], "body", name=f"body_{name}", **place)
        bodies.append(body)
        slides = machine.unit(name) == "m"
        passive = elements.get(name, crane.description.ForceElement(name))
        memory = model.joints[i].createData()
        model.joints[i].calc(memory, np.zeros(1))
        etree.SubElement(
            body, "joint", name=name, type="slide" if slides else "hinge",
            axis=_text(memory.S[:3] if slides else memory.S[3:]),
            stiffness=_text(passive.stiffness), springref=_text(passive.rest),
            damping=_text(passive.damping),
        )  # fmt: skip
        t = inertia.inertia
        etree.SubElement(
            body, "inertial", mass=_text(inertia.mass), pos=_text(inertia.lever),
            fullinertia=_text([t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2]]),
        )  # fmt: skip
    loops = machine.closure.equations.loops
    ends = {end for loop in loops for end in (loop.predecessor, loop.successor)}
    for site in sorted({*ends, machine.tip}):
        frame = model.frames[machine.frame(site)]
        etree.SubElement(bodies[frame.parentJoint], "site", name=site, **_pose(frame.placement))
    for loop in loops:
        etree.SubElement(
            equality, "connect", site1=loop.predecessor, site2=loop.successor,
            solref=_text(solref), solimp=_text(solimp),
        )  # fmt: skip
    root = etree.Element("mujoco")
    etree.SubElement(root, "compiler", angle="radian")
    option = etree.SubElement(
        root, "option", gravity=_text(model.gravity.linear), integrator=integrator,
        timestep=_text(step), jacobian="dense",
    )  # fmt: skip
    etree.SubElement(option, "flag", contact="disable", refsafe="disable")
    root.extend([worldbody, equality])
    return etree.tostring(root).decode()


def _text(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def _pose(placement: pin.SE3) -> dict[str, str]:
    x, y, z, w = pin.Quaternion(placement.rotation).coeffs()
    return {"pos": _text(placement.translation), "quat": _text([w, x, y, z])}
