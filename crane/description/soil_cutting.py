"""Soil, and the forces on the edge of a blade that cuts it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    apply_function,
    dot,
    matvec,
    maximum,
    minimum,
    scale_vector,
)
from crane.common.errors import InputError
from crane.common.samples import as_number
from crane.description.external_forces import ExternalForce, FrameMotion
from crane.description.force_elements import as_nonnegative_number
from crane.description.ground_contact import DEFAULT_SMOOTHING, Ground

MAX_FRICTION_ANGLE = 1.05  # [rad] of a soil
MIN_RAKE, MIN_WEDGE_ANGLE = 0.1, 0.35  # [rad]
_REGULARIZATION = 1e-12  # [N2], [1]: keeps quotients finite, without effect on other values


@dataclass(frozen=True)
class Soil:
    """Soil that fails at a shear stress of cohesion + tan(friction) pressure (Mohr and Coulomb).

    Attributes:
        unit_weight: gamma [N/m3].
        cohesion: c [Pa].
        friction: phi [rad], 0 for undrained clay.
        tool_friction: delta between soil and tool [rad], at most phi.
        adhesion: c_a between soil and tool [Pa], at most c.
        surcharge: q on the surface [Pa].

    Raises:
        InputError: A value is not possible for soil.
    """

    unit_weight: float
    cohesion: float
    friction: float
    tool_friction: float = 0.0
    adhesion: float = 0.0
    surcharge: float = 0.0

    def __post_init__(self) -> None:
        units = ("N/m3", "Pa", "rad", "rad", "Pa", "Pa")
        for field, unit in zip(fields(self), units, strict=True):
            as_nonnegative_number(getattr(self, field.name), f"the {field.name} of the soil", unit)
        if self.friction > MAX_FRICTION_ANGLE:
            raise InputError(
                f"the friction of the soil is {self.friction:g} rad, give at most "
                f"{MAX_FRICTION_ANGLE} rad"
            )
        for limited, limiting in (("tool_friction", "friction"), ("adhesion", "cohesion")):
            # otherwise the soil would fail first
            if getattr(self, limited) > getattr(self, limiting):
                raise InputError(
                    f"the {limited} of the soil is {getattr(self, limited):g}, above its "
                    f"{limiting} {getattr(self, limiting):g}, give at most that"
                )

    @property
    def max_rake(self) -> float:
        """Rake angle that replaces a steeper blade [rad], see `SoilCutting`."""
        return min(0.5 * math.pi, math.pi - self.friction - self.tool_friction - MIN_WEDGE_ANGLE)

    def cutting_factors(
        self, cosine_rake: Scalar, sine_rake: Scalar
    ) -> tuple[list[Scalar], Scalar]:
        """Factors of the fundamental equation of earth moving (Reece 1964; McKyes 1985).

        With the rake angle rho, a = rho + delta and the failure angle beta,

            D = cos a + sin a cot(beta + phi),
            N_gamma = (cot rho + cot beta) / (2 D),     N_c = (1 + cot beta cot(beta + phi)) / D,
            N_ca = (1 - cot rho cot(beta + phi)) / D,   N_q = (cot rho + cot beta) / D.

        N_gamma is smallest at cot beta = -t + sqrt((t - cot rho) (t - cot phi)), t = cot(a + phi),
        whose root is sqrt(sin a sin(delta + phi) / (sin phi sin rho)) / sin(a + phi). Without
        friction N_gamma does not depend on beta; the limit of the root, 1 / sin rho, minimizes
        N_c.

        Args:
            cosine_rake: Of the rake angle, which is between 0 and pi - delta - phi.
            sine_rake: Of the rake angle.

        Returns:
            N_gamma, N_c, N_ca, N_q, and cot beta.
        """
        phi, delta = self.friction, self.tool_friction
        sine_ratio = math.sin(delta + phi) / math.sin(phi) if phi else 1.0
        cosine_a = cosine_rake * math.cos(delta) - sine_rake * math.sin(delta)
        sine_a = sine_rake * math.cos(delta) + cosine_rake * math.sin(delta)
        cosine_a_phi = cosine_a * math.cos(phi) - sine_a * math.sin(phi)
        sine_a_phi = sine_a * math.cos(phi) + cosine_a * math.sin(phi)
        cot_rake = cosine_rake / sine_rake
        cot_beta = (
            apply_function("sqrt", sine_ratio * sine_a / sine_rake) - cosine_a_phi
        ) / sine_a_phi
        cot_beta_phi = (cot_beta * math.cos(phi) - math.sin(phi)) / (
            math.cos(phi) + cot_beta * math.sin(phi)
        )
        inverse_d = 1.0 / (cosine_a + sine_a * cot_beta_phi)
        surcharge_factor = (cot_rake + cot_beta) * inverse_d
        factors = [
            0.5 * surcharge_factor,
            (1.0 + cot_beta * cot_beta_phi) * inverse_d,
            (1.0 - cot_rake * cot_beta_phi) * inverse_d,
            surcharge_factor,
        ]
        return factors, cot_beta

    @property
    def bearing_factors(self) -> tuple[float, float]:
        """Factors of the bearing capacity of a strip, c N_c + q N_q (Prandtl 1921; Reissner 1924).

        N_q = e^(pi tan phi) tan(pi/4 + phi/2)^2, N_c = (N_q - 1) cot phi, pi + 2 at phi = 0.
        """
        slope = math.tan(self.friction)
        logarithm = math.pi * slope + 2.0 * math.asinh(slope)
        return math.expm1(logarithm) / slope if slope else math.pi + 2.0, math.exp(logarithm)


def _typical_soil(unit_weight: float, cohesion: float, degrees: float, adhesion: float) -> Soil:
    phi = math.radians(degrees)
    return Soil(unit_weight, cohesion, phi, 2.0 / 3.0 * phi, adhesion)


# Cohesion and friction, P: J. Y. Wong, Theory of Ground Vehicles, 4th ed. (2008), Table 2.3, whose
# sources and contents of water [%] stand behind. Unit weights, A (+- 15 %). Tool friction, A: two
# thirds of the friction (half to all of it). Adhesion, A: none of sand, else half the cohesion
# (0.2 to 0.8 of it).
SOILS = {
    "dry sand": _typical_soil(15.5e3, 1040.0, 28.0, 0.0),  # Land Locomotion Laboratory, 0
    "sandy loam": _typical_soil(15.5e3, 1720.0, 29.0, 860.0),  # Land Locomotion Laboratory, 15
    "moist sandy loam": _typical_soil(17.0e3, 13790.0, 22.0, 6895.0),  # Hanamoto, 26
    "clayey soil": _typical_soil(17.5e3, 4140.0, 13.0, 2070.0),  # Thailand, 38
    "heavy clay": _typical_soil(
        19.0e3, 68950.0, 34.0, 34475.0
    ),  # Waterways Experiment Station, 25
    "lean clay": _typical_soil(18.5e3, 68950.0, 20.0, 34475.0),  # Waterways Experiment Station, 22
}


class SoilCutting(ExternalForce):
    """A flat and straight blade that cuts soil with its edge: a bucket's lip or row of teeth.

    u points from the edge up the blade, m out of its face into the soil that it cuts, n out of the
    ground; d is the depth of the edge, D = min(d, length sin rho) the part of it that the blade
    fills, L = min(d / sin rho, length) the part of the blade in the soil, all in the section
    across the edge, and v is the velocity of the edge. Three forces act on the edge:

        R = P (sin(delta) u - cos(delta) m) + c_a width D / sin(rho) u,
        P = width (gamma D^2 N_gamma + c D N_c + c_a D N_ca + (q + gamma (d - D)) D N_q),
        B = width thickness (c N_c' + (q + gamma d) N_q') d / sqrt(d^2 + thickness^2) u,
        T = - 2 width (L - g D / sin(rho)) tau v.u / sqrt((v.u)^2 + smoothing^2) u,
        tau = c_a + (1 - sin phi) tan(delta) (q + gamma (d - D / 2)),

    the resistance of the wedge before the blade (`Soil.cutting_factors`; P is not below 0), the
    bearing force on the edge (`Soil.bearing_factors`), and the friction on both sides of the blade
    where it does not cut, under the pressure of soil at rest (Jaky 1944). R acts by g = s(v.m)
    s(-v.R/|R|) and B by s(-v.u), where s(x) is x^2 / (x^2 + smoothing^2) for x > 0, else 0: none
    of the three ever drives the edge, and R and B vanish as it is withdrawn. So soil carries
    nothing at rest: a machine that leans on it creeps.

    A rake angle below `MIN_RAKE` is replaced by that, with the filled depth of the blade. Before a
    blade that is steeper than upright (or than pi - delta - phi less `MIN_WEDGE_ANGLE`, where no
    wedge can slide) a heap of soil remains, which cuts in its place at that angle. The surface
    does not change. Soil beside the blade and its inertia are neglected.

    Args:
        frame: The link whose origin is the middle of the edge.
        soil: The soil.
        width: Of the edge [m].
        length: Of the blade, up from the edge [m].
        blade: u (3,) in the frame's axes; of any length.
        cutting: (3,) cutting direction in the frame's axes; m is its component normal to u.
        ground: Surface of the soil.
        thickness: Of the edge [m], 0 for a sharp one.
        smoothing: [m/s].
        name: See `ExternalForce`.

    Raises:
        InputError: A value is not finite or too small, or the directions are parallel.
    """

    def __init__(
        self,
        frame: str,
        soil: Soil,
        width: float,
        length: float,
        blade: ArrayLike,
        cutting: ArrayLike,
        ground: Ground | None = None,
        thickness: float = 0.0,
        smoothing: float = DEFAULT_SMOOTHING,
        name: str = "",
    ):
        super().__init__(frame, name)
        self.soil, self.ground = soil, Ground() if ground is None else ground
        label = f"of the cutter at '{frame}'"
        if not isinstance(soil, Soil):
            raise InputError(f"the soil {label} is {soil!r}, give a crane.description.Soil")
        self.width = as_number(width, f"the width {label}", "m", greater_than=0)
        self.length = as_number(length, f"the length {label}", "m", greater_than=0)
        self.smoothing = as_number(smoothing, f"the smoothing {label}", "m/s", greater_than=0)
        self.thickness = as_nonnegative_number(thickness, f"the thickness {label}", "m")
        blade_direction = _unit_direction(blade, f"the blade {label}")
        face_normal = _unit_direction(cutting, f"the cutting {label}")
        face_normal = face_normal - (face_normal @ blade_direction) * blade_direction
        if np.linalg.norm(face_normal) < 1e-6:
            raise InputError(f"the cutting {label} is along its blade, give one across it")
        self.blade: list[float] = blade_direction.tolist()
        self.cutting: list[float] = (face_normal / np.linalg.norm(face_normal)).tolist()

    def event_lengths(self, motion: FrameMotion) -> list[Scalar]:
        """See `ExternalForce`: the gap, and the height of the blade above the soil."""
        height = self.ground.distance_and_normal(motion.position)[0]
        return [height, height + self.length * self._rake_and_directions(motion)[0]]

    @property
    def channels(self) -> list[tuple[str, str]]:
        """See `ExternalForce`: d, and the magnitude of the force."""
        return [(f"depth_{self.name}", "m"), (f"resistance_{self.name}", "N")]

    def outputs(self, motion: FrameMotion) -> Sequence[Scalar]:
        """See `ExternalForce`."""
        force = self.wrench(motion)[0]
        depth = maximum(-1.0 * self.ground.distance_and_normal(motion.position)[0], 0.0)
        return [depth, apply_function("sqrt", dot(force, force))]

    def _rake_and_directions(
        self, motion: FrameMotion
    ) -> tuple[Scalar, Scalar, list[Scalar], list[Scalar]]:
        """Return sine and cosine of the rake angle, u and m in the world."""
        normal = self.ground.distance_and_normal(motion.position)[1]
        blade_direction, face_normal = (
            matvec(motion.rotation, self.blade),
            matvec(motion.rotation, self.cutting),
        )
        sine, cosine = dot(blade_direction, normal), dot(face_normal, normal)
        normalization = 1.0 / apply_function(
            "sqrt", sine * sine + cosine * cosine + _REGULARIZATION
        )
        return sine * normalization, cosine * normalization, blade_direction, face_normal

    def wrench(self, motion: FrameMotion) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ExternalForce`."""
        soil, width, velocity = self.soil, self.width, motion.velocity
        depth = maximum(-1.0 * self.ground.distance_and_normal(motion.position)[0], 0.0)
        sine, cosine, blade_direction, face_normal = self._rake_and_directions(motion)
        filled = minimum(depth, self.length * maximum(sine, 0.0))

        # the cutting face: the blade, or a face within the bounds of the rake angle
        min_cosine, max_cosine = math.cos(soil.max_rake), math.cos(MIN_RAKE)
        cosine_cut = minimum(maximum(cosine, min_cosine), max_cosine)
        sine_cut = apply_function("sqrt", 1.0 - cosine_cut * cosine_cut)
        normal = add_vectors(
            scale_vector(cosine, face_normal), scale_vector(sine, blade_direction)
        )
        horizontal = add_vectors(
            scale_vector(sine, face_normal), scale_vector(-1.0 * cosine, blade_direction)
        )
        cut_direction = add_vectors(
            scale_vector(-1.0 * cosine_cut, horizontal), scale_vector(sine_cut, normal)
        )
        cut_normal = add_vectors(
            scale_vector(sine_cut, horizontal), scale_vector(cosine_cut, normal)
        )

        factors, _ = soil.cutting_factors(cosine_cut, sine_cut)
        loads = [
            soil.unit_weight * filled, soil.cohesion, soil.adhesion,
            soil.surcharge + soil.unit_weight * (depth - filled),
        ]  # fmt: skip
        wedge_force = width * filled * maximum(dot(loads, factors), 0.0)
        length = minimum(depth / sine_cut, self.length)
        covered = minimum(filled / sine_cut, self.length)
        tangential_force = (
            math.sin(soil.tool_friction) * wedge_force + soil.adhesion * width * covered
        )
        wedge_resistance = add_vectors(
            scale_vector(tangential_force, cut_direction),
            scale_vector(-math.cos(soil.tool_friction) * wedge_force, cut_normal),
        )
        cutting_share = self._direction_gate(
            dot(velocity, cut_normal), 1.0
        ) * self._direction_gate(
            -1.0 * dot(velocity, wedge_resistance),
            dot(wedge_resistance, wedge_resistance) + _REGULARIZATION,
        )

        cohesion_factor, surcharge_factor = soil.bearing_factors
        bearing_pressure = soil.cohesion * cohesion_factor + surcharge_factor * (
            soil.surcharge + soil.unit_weight * depth
        )
        sliding = dot(velocity, blade_direction)
        edge_force: Scalar = 0.0
        if self.thickness:
            depth_share = depth / apply_function("sqrt", depth * depth + self.thickness**2)
            edge_force = (
                width
                * self.thickness
                * bearing_pressure
                * depth_share
                * self._direction_gate(-1.0 * sliding, 1.0)
            )
        side_friction_factor = (1.0 - math.sin(soil.friction)) * math.tan(soil.tool_friction)
        middle_pressure = soil.surcharge + soil.unit_weight * (depth - 0.5 * filled)
        shear = soil.adhesion + side_friction_factor * middle_pressure
        side_friction = 2.0 * width * (length - cutting_share * covered) * shear
        sliding_share = sliding / apply_function("sqrt", sliding * sliding + self.smoothing**2)
        force = add_vectors(
            scale_vector(cutting_share, wedge_resistance),
            scale_vector(edge_force - side_friction * sliding_share, blade_direction),
        )
        return force, [0.0] * 3

    def _direction_gate(self, speed: Scalar, squared_scale: Scalar) -> Scalar:
        """Return the gate s of a speed, which has the unit of the root of the scale."""
        forward_speed = maximum(speed, 0.0)
        return forward_speed * forward_speed / (speed * speed + self.smoothing**2 * squared_scale)


def _unit_direction(values: ArrayLike, label: str) -> np.ndarray:
    try:
        direction = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        direction = np.zeros(0)
    if direction.shape != (3,) or not np.isfinite(direction).all() or not direction.any():
        raise InputError(f"{label} is {values!r}, give a direction [x, y, z]")
    return direction / np.linalg.norm(direction)
