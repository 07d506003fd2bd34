"""Soil, and what it does to the edge of a blade that cuts it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen.scalar import Number, add, apply, dot, maximum, minimum, scale, times
from crane.common.errors import InputError
from crane.common.samples import as_number
from crane.description.external import ExternalForce, Here
from crane.description.ground import SMOOTHING, Ground

STEEPEST = 1.05  # friction [rad] that a soil may have
FLATTEST, MARGIN = 0.1, 0.35  # rake [rad] at least; left to where no wedge can slide, at least
_NEAR = 1e-12  # [N2], [1]: keeps quotients of what may vanish finite, and changes no digit else


@dataclass(frozen=True)
class Soil:
    """Soil that fails at a shear of cohesion + tan(friction) pressure (Mohr and Coulomb).

    Attributes:
        unit_weight: gamma [N/m3].
        cohesion: c [Pa].
        friction: phi [rad], 0 of clay that is cut without draining.
        tool_friction: delta of the soil on the tool [rad], at most phi.
        adhesion: c_a of the soil to the tool [Pa], at most c.
        surcharge: q on the surface [Pa].

    Raises:
        InputError: A number that no soil has.
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
            value = getattr(self, field.name)
            if as_number(value, f"the {field.name} of the soil", unit) < 0:
                raise InputError(
                    f"the {field.name} of the soil is {value:g}, it must not be negative"
                )
        if self.friction > STEEPEST:
            raise InputError(
                f"the friction of the soil is {self.friction:g} rad, give at most {STEEPEST} rad"
            )
        for part, whole in (("tool_friction", "friction"), ("adhesion", "cohesion")):
            if getattr(self, part) > getattr(self, whole):  # it would fail in the soil before
                raise InputError(
                    f"the {part} of the soil is {getattr(self, part):g}, above its {whole} "
                    f"{getattr(self, whole):g}, give at most that"
                )

    @property
    def steepest(self) -> float:
        """The rake that a steeper blade cuts with [rad], see `Cutting`."""
        left = math.pi - self.friction - self.tool_friction - MARGIN
        return min(0.5 * math.pi, left)

    def factors(self, cosine: Number, sine: Number) -> tuple[list[Number], Number]:
        """Factors of the fundamental equation of earth moving (Reece 1964; McKyes 1985).

        With the rake rho, a = rho + delta and the failure angle beta,

            D = cos a + sin a cot(beta + phi),
            N_gamma = (cot rho + cot beta) / (2 D),     N_c = (1 + cot beta cot(beta + phi)) / D,
            N_ca = (1 - cot rho cot(beta + phi)) / D,   N_q = (cot rho + cot beta) / D.

        N_gamma is least at cot beta = -t + sqrt((t - cot rho) (t - cot phi)), t = cot(a + phi),
        whose root is sqrt(sin a sin(delta + phi) / (sin phi sin rho)) / sin(a + phi). Without
        friction N_gamma is the same at all beta; what is left of the root then, 1 / sin rho, is
        where N_c is least.

        Args:
            cosine: Of the rake, which is between 0 and pi - delta - phi.
            sine: Of the rake.

        Returns:
            N_gamma, N_c, N_ca, N_q, and cot beta.
        """
        phi, delta = self.friction, self.tool_friction
        share = math.sin(delta + phi) / math.sin(phi) if phi else 1.0
        cosine_a = cosine * math.cos(delta) - sine * math.sin(delta)
        sine_a = sine * math.cos(delta) + cosine * math.sin(delta)
        cosine_all = cosine_a * math.cos(phi) - sine_a * math.sin(phi)
        sine_all = sine_a * math.cos(phi) + cosine_a * math.sin(phi)
        cot_rake = cosine / sine
        cot_beta = (apply("sqrt", share * sine_a / sine) - cosine_all) / sine_all
        cot_plane = (cot_beta * math.cos(phi) - math.sin(phi)) / (
            math.cos(phi) + cot_beta * math.sin(phi)
        )
        over = 1.0 / (cosine_a + sine_a * cot_plane)
        all_round = (cot_rake + cot_beta) * over
        found = [
            0.5 * all_round,
            (1.0 + cot_beta * cot_plane) * over,
            (1.0 - cot_rake * cot_plane) * over,
            all_round,
        ]
        return found, cot_beta

    @property
    def bearing(self) -> tuple[float, float]:
        """Factors of what a strip bears, c N_c + q N_q (Prandtl 1921; Reissner 1924).

        N_q = e^(pi tan phi) tan(pi/4 + phi/2)^2, N_c = (N_q - 1) cot phi, pi + 2 at phi = 0.
        """
        slope = math.tan(self.friction)
        logarithm = math.pi * slope + 2.0 * math.asinh(slope)
        return (math.expm1(logarithm) / slope if slope else math.pi + 2.0), math.exp(logarithm)


def _typical(unit_weight: float, cohesion: float, degrees: float, adhesion: float) -> Soil:
    """A soil of the table, with its tool friction."""
    phi = math.radians(degrees)
    return Soil(unit_weight, cohesion, phi, 2.0 / 3.0 * phi, adhesion)


# Cohesion and friction, P: J. Y. Wong, Theory of Ground Vehicles, 4th ed. (2008), Table 2.3, whose
# sources and contents of water [%] stand behind. Unit weights, A (+- 15 %). Tool friction, A: two
# thirds of the friction (half to all of it). Adhesion, A: none of sand, else half the cohesion
# (0.2 to 0.8 of it).
SOILS = {
    "dry sand": _typical(15.5e3, 1040.0, 28.0, 0.0),  # Land Locomotion Laboratory, 0
    "sandy loam": _typical(15.5e3, 1720.0, 29.0, 860.0),  # Land Locomotion Laboratory, 15
    "moist sandy loam": _typical(17.0e3, 13790.0, 22.0, 6895.0),  # Hanamoto, 26
    "clayey soil": _typical(17.5e3, 4140.0, 13.0, 2070.0),  # Thailand, 38
    "heavy clay": _typical(19.0e3, 68950.0, 34.0, 34475.0),  # Waterways Experiment Station, 25
    "lean clay": _typical(18.5e3, 68950.0, 20.0, 34475.0),  # Waterways Experiment Station, 22
}


class Cutting(ExternalForce):
    """A blade, flat and straight, that cuts soil with its edge: a bucket's lip or row of teeth.

    u points from the edge up the blade, m out of its face into the soil that it cuts, n out of the
    ground; d is how deep the edge is, D = min(d, length sin rho) how much of that the blade fills,
    L = min(d / sin rho, length) how much of the blade is in the soil, all seen across the edge,
    and v the velocity of the edge. Three forces act on the edge:

        R = P (sin(delta) u - cos(delta) m) + c_a width D / sin(rho) u,
        P = width (gamma D^2 N_gamma + c D N_c + c_a D N_ca + (q + gamma (d - D)) D N_q),
        B = width thickness (c N_c' + (q + gamma d) N_q') d / sqrt(d^2 + thickness^2) u,
        T = - 2 width (L - g D / sin(rho)) tau v.u / sqrt((v.u)^2 + smoothing^2) u,
        tau = c_a + (1 - sin phi) tan(delta) (q + gamma (d - D / 2)),

    what the wedge before the blade resists with (`Soil.factors`; P is not below 0), what the edge
    bears (`Soil.bearing`), and what rubs on both sides of the blade where it does not cut, pressed
    by soil at rest (Jaky 1944). R acts by g = s(v.m) s(-v.R/|R|) and B by s(-v.u), where s(x) is
    x^2 / (x^2 + smoothing^2) of x > 0, else 0: none of the three ever drives the edge, and R and B
    vanish as it is withdrawn. So soil carries nothing at rest: what leans on it creeps.

    A blade that is flatter than `FLATTEST` against the surface is taken as this one, with what it
    fills; before one that is steeper than upright (or than leaves pi - delta - phi by `MARGIN`,
    where no wedge could slide) a heap of soil stays, which cuts in its place, as steep as that.
    The surface is not changed. Soil beside the blade and its inertia are left out.

    Args:
        frame: The link whose origin is the middle of the edge.
        soil: What it cuts.
        width: Of the edge [m].
        length: Of the blade, up from the edge [m].
        blade: u (3,) in the frame's axes; of any length.
        cutting: (3,) whither it cuts in the frame's axes; m is what of it is across u.
        ground: Its surface.
        thickness: Of the edge [m], 0 of a sharp one.
        smoothing: [m/s].
        name: See `ExternalForce`.

    Raises:
        InputError: A number that is none, or too small, or directions along each other.
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
        smoothing: float = SMOOTHING,
        name: str = "",
    ):
        super().__init__(frame, name)
        self.soil, self.ground = soil, Ground() if ground is None else ground
        what = f"of the cutter at '{frame}'"
        if not isinstance(soil, Soil):
            raise InputError(f"the soil {what} is {soil!r}, give a crane.Soil")
        self.width = as_number(width, f"the width {what}", "m", above=0)
        self.length = as_number(length, f"the length {what}", "m", above=0)
        self.smoothing = as_number(smoothing, f"the smoothing {what}", "m/s", above=0)
        self.thickness = as_number(thickness, f"the thickness {what}", "m")
        if self.thickness < 0:
            raise InputError(f"the thickness {what} is {thickness:g}, it must not be negative")
        up = _direction(blade, f"the blade {what}")
        out = _direction(cutting, f"the cutting {what}")
        out = out - (out @ up) * up
        if np.linalg.norm(out) < 1e-6:
            raise InputError(f"the cutting {what} is along its blade, give one across it")
        self.blade: list[float] = up.tolist()
        self.cutting: list[float] = (out / np.linalg.norm(out)).tolist()

    def edges(self, here: Here) -> list[Number]:
        """See `ExternalForce`: the gap, and how far the blade is out of the soil."""
        above = self.ground.over(here.place)[0]
        return [above, above + self.length * self._section(here)[0]]

    @property
    def channels(self) -> list[tuple[str, str]]:
        """See `ExternalForce`: d, and the size of the force."""
        return [(f"depth_{self.name}", "m"), (f"resistance_{self.name}", "N")]

    def look(self, here: Here) -> Sequence[Number]:
        """See `ExternalForce`."""
        force = self.wrench(here)[0]
        depth = maximum(-1.0 * self.ground.over(here.place)[0], 0.0)
        return [depth, apply("sqrt", dot(force, force))]

    def _section(self, here: Here) -> tuple[Number, Number, list[Number], list[Number]]:
        """Sine and cosine of the rake, u and m in the world."""
        normal = self.ground.over(here.place)[1]
        up, out = times(here.turn, self.blade), times(here.turn, self.cutting)
        sine, cosine = dot(up, normal), dot(out, normal)
        over = 1.0 / apply("sqrt", sine * sine + cosine * cosine + _NEAR)
        return sine * over, cosine * over, up, out

    def wrench(self, here: Here) -> tuple[Sequence[Number], Sequence[Number]]:
        """See `ExternalForce`."""
        soil, width, velocity = self.soil, self.width, here.velocity
        depth = maximum(-1.0 * self.ground.over(here.place)[0], 0.0)
        sine, cosine, up, out = self._section(here)
        filled = minimum(depth, self.length * maximum(sine, 0.0))

        # the face that cuts: the blade's, or within the bounds of the rake
        least, most = math.cos(soil.steepest), math.cos(FLATTEST)
        cosine_cut = minimum(maximum(cosine, least), most)
        sine_cut = apply("sqrt", 1.0 - cosine_cut * cosine_cut)
        normal = add(scale(cosine, out), scale(sine, up))
        ahead = add(scale(sine, out), scale(-1.0 * cosine, up))
        up_cut = add(scale(-1.0 * cosine_cut, ahead), scale(sine_cut, normal))
        out_cut = add(scale(sine_cut, ahead), scale(cosine_cut, normal))

        factors, _ = soil.factors(cosine_cut, sine_cut)
        loads = [
            soil.unit_weight * filled, soil.cohesion, soil.adhesion,
            soil.surcharge + soil.unit_weight * (depth - filled),
        ]  # fmt: skip
        push = width * filled * maximum(dot(loads, factors), 0.0)
        length = minimum(depth / sine_cut, self.length)
        covered = minimum(filled / sine_cut, self.length)
        along = math.sin(soil.tool_friction) * push + soil.adhesion * width * covered
        resisting = add(scale(along, up_cut), scale(-math.cos(soil.tool_friction) * push, out_cut))
        cuts = self._gate(dot(velocity, out_cut), 1.0) * self._gate(
            -1.0 * dot(velocity, resisting), dot(resisting, resisting) + _NEAR
        )

        of_cohesion, of_pressure = soil.bearing
        strip = soil.cohesion * of_cohesion + of_pressure * (
            soil.surcharge + soil.unit_weight * depth
        )
        sliding = dot(velocity, up)
        bears: Number = 0.0
        if self.thickness:
            ramp = depth / apply("sqrt", depth * depth + self.thickness**2)
            bears = width * self.thickness * strip * ramp * self._gate(-1.0 * sliding, 1.0)
        pressed = (1.0 - math.sin(soil.friction)) * math.tan(soil.tool_friction)
        middle = soil.surcharge + soil.unit_weight * (depth - 0.5 * filled)
        shear = soil.adhesion + pressed * middle
        rubs = 2.0 * width * (length - cuts * covered) * shear
        slip = sliding / apply("sqrt", sliding * sliding + self.smoothing**2)
        force = add(scale(cuts, resisting), scale(bears - rubs * slip, up))
        return force, [0.0] * 3

    def _gate(self, speed: Number, unit: Number) -> Number:
        """The gate s of a speed, given times the root of a unit."""
        ahead = maximum(speed, 0.0)
        return ahead * ahead / (speed * speed + self.smoothing**2 * unit)


def _direction(given: ArrayLike, what: str) -> np.ndarray:
    """(3,) of length 1."""
    try:
        found = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.shape != (3,) or not np.isfinite(found).all() or not found.any():
        raise InputError(f"{what} is {given!r}, give a direction [x, y, z]")
    return found / np.linalg.norm(found)
