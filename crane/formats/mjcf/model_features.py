"""Friction, springs, rotor inertias and drives of a MJCF file.

A fixed tendon or an actuator of one joint has the length L = c q, so a stiffness, damping or rotor
inertia s along L is c^2 s at the joint, and a friction s is |c| s. A tendon of several joints
couples them, which no force element of a machine does. The spring and damper of a tendon straight
from site to site are a force element between frames, or a rope if the spring is slack from 0 on. A
tendon over sites that an actuator drives has a joint for its length, see
`crane.formats.mjcf.actuator_cylinders`.
"""

from collections.abc import Mapping, Sequence

from crane.description.force_elements import ForceElement, Friction, Rope
from crane.description.specification import Drive
from crane.formats.mjcf.actuator_cylinders import MjcfCylinders
from crane.formats.mjcf.mujoco_file import MujocoFile, nonzero_rows

_TENDON_FIELDS = {  # fields of tendons by the feature that they define
    "stiffness": ("tendon_stiffness", "tendon_stiffnesspoly"),
    "damping": ("tendon_damping", "tendon_dampingpoly"),
    "friction": ("tendon_frictionloss",),
    "armature": ("tendon_armature",),
    "limits": ("tendon_limited", "tendon_actfrclimited"),
}


def fixed_tendon_factors(mjcf: MujocoFile, tendon: int) -> dict[int, float] | None:
    """Return the factors of a fixed tendon by joint of MuJoCo, None for a spatial tendon."""
    found: dict[int, float] = {}
    for kind, joint, factor in mjcf.tendon_path(tendon):
        if kind != "JOINT":
            return None
        found[joint] = found.get(joint, 0.0) + factor
    return {joint: factor for joint, factor in found.items() if factor}


def straight_tendon_sites(mjcf: MujocoFile, tendon: int) -> tuple[int, int] | None:
    """Return the sites of a straight tendon between two bodies, None for other tendons."""
    path = mjcf.tendon_path(tendon)
    if [kind for kind, _, _ in path] != ["SITE", "SITE"]:
        return None
    first, second = (site for _, site, _ in path)
    bodies = mjcf.model.body_weldid[mjcf.model.site_bodyid[[first, second]]]
    return None if bodies[0] == bodies[1] else (first, second)


class ModelFeatures:
    """Friction, force elements, rotor inertias and drives; what is left out is noted.

    The drives are what actuators act along: joints, tendons, sliders, a part of a joint. The
    translations of a free joint are along axes of the world, as the forces of its actuators are;
    torques of ball and free joints are about axes of the child in both. Each drive is there once,
    whatever the force law of its actuators, with the gear of the first.

    Args:
        mjcf: The file.
        series_joints: Names of the joints of the machine by joint of MuJoCo.
        sites: Name of the link by site.
        cylinders: Its cylinders.

    Attributes:
        springs: Force elements along joints and between frames.
        ropes: Ropes between frames.
        rotor_inertias: Rotor inertias by joint [kg], [kg m2].
        drives: Drives by name.
    """

    def __init__(
        self,
        mjcf: MujocoFile,
        series_joints: Mapping[int, Sequence[str]],
        sites: Mapping[int, str],
        cylinders: MjcfCylinders,
    ):
        self._mjcf, self._model, self._series_joints = mjcf, mjcf.model, series_joints
        self._sites, self._cylinders = sites, cylinders
        self._viscous: dict[str, float] = {}
        self._coulomb: dict[str, float] = {}
        self.springs: list[ForceElement] = []
        self.ropes: list[Rope] = []
        self.rotor_inertias: dict[str, float] = {}
        self.drives: dict[str, Drive] = {}
        for joint, names in series_joints.items():
            self._add_joint_effects(joint, names)
        for tendon in range(self._model.ntendon):
            self._add_tendon_effects(tendon)
        for actuator in range(self._model.nu):
            self._add_actuator(actuator)

    @property
    def friction(self) -> dict[str, Friction]:
        """Friction laws by joint."""
        return {
            x: Friction(viscous=self._viscous.get(x, 0.0), coulomb=self._coulomb.get(x, 0.0))
            for x in dict.fromkeys((*self._viscous, *self._coulomb))
        }

    def _add_along(
        self,
        joint: str,
        factor: float = 1.0,
        *,
        damping: float = 0.0,
        friction: float = 0.0,
        armature: float = 0.0,
        stiffness: float = 0.0,
        rest: float = 0.0,
    ) -> None:
        """Add effects along a length that is a factor times the coordinate of a joint."""
        square = factor * factor
        for values, value in (
            (self._viscous, square * damping),
            (self._coulomb, abs(factor) * friction),
            (self.rotor_inertias, square * armature),
        ):
            if value:
                values[joint] = values.get(joint, 0.0) + value
        if square * stiffness:
            self.springs.append(
                ForceElement(joint, stiffness=square * stiffness, rest=rest / factor)
            )

    def _add_joint_effects(self, joint: int, names: Sequence[str]) -> None:
        model, dof = self._model, int(self._model.jnt_dofadr[joint])
        dofs = range(dof, dof + len(names))
        damping, friction = model.dof_damping[dofs], model.dof_frictionloss[dofs]
        stiffness = float(model.jnt_stiffness[joint])
        has_translation_friction = bool(friction[:-3].any())  # of a free joint
        if len(names) > 1 and (has_translation_friction or stiffness):
            stiffness = 0.0
            self._mjcf.note_unsupported_elements(
                "friction of free joints, stiffness of ball and free joints", "JOINT", [joint]
            )
        for i, name in enumerate(names):
            self._add_along(
                name,
                damping=float(damping[i]),
                friction=0.0 if has_translation_friction else float(friction[i]),
                armature=float(model.dof_armature[dof]),
                stiffness=stiffness,
                rest=float(model.qpos_spring[model.jnt_qposadr[joint]]),
            )

    def _tendon_factors(self, tendon: int) -> dict[str, float] | None:
        """Return the factors of joints in the length of a tendon; None if no joints have it."""
        if tendon in self._cylinders.tendon_factors:
            return self._cylinders.tendon_factors[tendon]
        factors = fixed_tendon_factors(self._mjcf, tendon)
        if factors is None:
            return None
        return {self._series_joints[joint][0]: factor for joint, factor in factors.items()}

    def _add_tendon_effects(self, tendon: int) -> None:
        model, factors = self._model, self._tendon_factors(tendon)
        slack_length, taut_length = (float(x) for x in model.tendon_lengthspring[tendon])
        is_spring, supported = slack_length == taut_length, set[str]()
        ends = straight_tendon_sites(self._mjcf, tendon)
        links = None if ends is None else (self._sites[ends[0]], self._sites[ends[1]])
        is_rope = links is not None and slack_length == 0
        if (is_spring or is_rope) and tendon not in nonzero_rows(model, "tendon_stiffnesspoly"):
            supported.add("stiffness")
        if tendon not in nonzero_rows(model, "tendon_dampingpoly"):
            supported.add("damping")
        stiffness = float(model.tendon_stiffness[tendon]) * ("stiffness" in supported)
        damping = float(model.tendon_damping[tendon]) * ("damping" in supported)
        if stiffness and links is not None and not is_spring:
            self.ropes.append(Rope(links, length=taut_length, stiffness=stiffness))
            stiffness = 0.0
        if factors is not None and len(factors) == 1:
            supported |= {"friction", "armature"}
            ((joint, factor),) = factors.items()
            if tendon in self._cylinders.tendon_factors and not model.tendon_actfrclimited[tendon]:
                supported.add("limits")
            self._add_along(
                joint,
                factor,
                damping=damping,
                friction=float(model.tendon_frictionloss[tendon]),
                armature=float(model.tendon_armature[tendon]),
                stiffness=stiffness,
                rest=slack_length - self._cylinders.tendon_offsets.get(tendon, 0.0),
            )
        if factors is None and links is not None and (stiffness or damping):
            rest = taut_length if stiffness else 0.0
            self.springs.append(ForceElement("", stiffness, rest, damping, between=links))
        if links is None and (factors is None or len(factors) != 1):
            supported.clear()
        for feature, fields in _TENDON_FIELDS.items():
            if feature not in supported and any(
                tendon in nonzero_rows(model, name) for name in fields
            ):
                self._mjcf.note_unsupported_elements(f"{feature} of tendons", "TENDON", [tendon])

    def _add_actuator(self, actuator: int) -> None:
        """Add the drive of an actuator, and the effects along its length."""
        mjcf, (kind, target) = self._mjcf, self._mjcf.transmission(actuator)
        gears = self._model.actuator_gear[actuator].tolist()
        name = mjcf.name(*(("TENDON", target) if kind == "TENDON" else ("ACTUATOR", actuator)))
        factors: dict[str, float] = {}
        if kind == "TENDON":
            factors = self._tendon_factors(target) or {}
        if kind == "SLIDERCRANK" and actuator in self._cylinders.actuator_joints:
            factors = {self._cylinders.actuator_joints[actuator]: 1.0}
        factors = {joint: gears[0] * x for joint, x in factors.items() if gears[0] * x}
        parts = self._series_joints[target] if kind == "JOINT" else ()
        factors |= {joint: gear for joint, gear in zip(parts, gears, strict=False) if gear}
        if kind == "JOINT" and len(factors) == 1:
            (name,) = factors
        damping = float(self._model.actuator_damping[actuator])
        armature = float(self._model.actuator_armature[actuator])
        if (armature or damping) and len(factors) == 1 and len(parts) < 2:
            ((joint, ratio),) = factors.items()
            self._add_along(joint, ratio, damping=damping, armature=armature)
        elif armature or damping:
            mjcf.note_unsupported_elements(
                "armature and damping of actuators", "ACTUATOR", [actuator]
            )
        if factors:
            self.drives.setdefault(name, Drive(name, factors))
            return
        mjcf.note_unsupported_elements(
            "actuators by sites, bodies, tendons around geoms and cranks that break",
            "ACTUATOR",
            [actuator],
        )
