"""Design of periodic excitation trajectories for the identification of a machine."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import ArrayLike

from crane.common.atomic_output import replace_file
from crane.common.errors import InputError, check_name
from crane.common.progress import Progress, progress_reporter
from crane.common.result import Result
from crane.common.samples import Array, as_count, as_number, as_seed
from crane.common.threads import with_single_threaded_blas
from crane.common.units import format_table
from crane.dynamics.dynamics import Dynamics
from crane.identification.excitation.fisher_information import (
    CRITERIA,
    FisherInformation,
    InformationMeasures,
)
from crane.identification.excitation.fourier_trajectory import FourierTrajectory
from crane.identification.excitation.trajectory_optimizer import (
    COARSE_SAMPLES,
    QUANTITIES,
    TrajectoryLimits,
    TrajectoryOptimizer,
    joint_values,
    singularity_proximity,
    trajectory_limits,
)
from crane.identification.mechanics.base_parameters import (
    BaseParameters,
    base_parameters,
    random_samples,
)
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.model_terms import MotionSamples
from crane.machine.machine import Machine
from crane.recordings.recording import Recording

_NOISE_SHARE = 0.01  # default noise per force limit of a drive
_REPORTED_PARAMETERS = 5  # parameters in the table
_MAX_SAMPLES = 4_000_000  # samples of the recording
# of characteristic velocities, smoothing of friction in the optimization
_FRICTION_SMOOTHING = 5e-4
_MAX_MEMORY = 1e9  # [bytes] for the motions of an optimization


@dataclass(frozen=True, eq=False, repr=False)
class Excitation(Result):
    """Excitation trajectory for the identification of a machine.

    Attributes:
        trajectory: The trajectory, see `FourierTrajectory`.
        machine: The machine.
        base: Base parameters to be identified.
        nominal: (p,) parameters by the description of the machine.
        prior_std: (r,) prior standard deviations of the base parameters, see `FisherInformation`.
        initial_information: Information measures of the first random trajectory within the limits.
        optimized_information: Information measures of this trajectory.
        limits: Limits of the trajectory.
        limit_usage: (5, n) used share of the limits, by `QUANTITIES`.
        noise: (n,) standard deviations of the force noise [N], [N m].
        criterion: Optimization criterion.
        seed: Seed of the random trajectories.
        step: Step of the planned recording [s].
    """

    trajectory: FourierTrajectory
    machine: Machine
    base: BaseParameters
    nominal: Array
    prior_std: Array
    initial_information: InformationMeasures
    optimized_information: InformationMeasures
    limits: TrajectoryLimits
    limit_usage: Array
    noise: Array
    criterion: str
    seed: int
    step: float

    def _one_line(self) -> str:
        """Machine, duration and condition numbers."""
        return (
            f"Excitation of '{self.machine.name}', {self.trajectory.duration:.6g} s: condition "
            f"{self.initial_information.condition:.3g} random, "
            f"{self.optimized_information.condition:.3g} optimised"
        )

    def motion(self) -> tuple[Array, Array, Array, Array, Array]:
        """Times (N,), and q_A, v_A, a_A, tau_A (N, n) of the described machine."""
        count = int(self.trajectory.duration / self.step + 1e-9) + 1
        time = self.step * np.arange(count, dtype=np.float64)
        q, v, a = self.trajectory(time)
        return time, q, v, a, Dynamics(self.machine).inverse(q, v, a, friction=True)

    def least_identifiable(self, count: int = _REPORTED_PARAMETERS) -> list[int]:
        """Indices of the base parameters with the largest std per prior std."""
        return np.argsort(-self.optimized_information.std / self.prior_std, kind="stable")[
            :count
        ].tolist()

    def to_csv(self, path: str | Path) -> None:
        """Write the motion with the forces of the described machine, as a recording without noise.

        Raises:
            OutputError: The file cannot be written.
        """
        time, q, v, a, tau = self.motion()
        units = {joint: self.machine.unit(joint) for joint in self.machine.active}
        lead, period = self.trajectory.lead, self.trajectory.period
        Recording(
            time,
            self.machine.active,
            q,
            v,
            tau,
            units,
            {f"{joint}_acceleration": x for joint, x in zip(units, a.T, strict=True)},
            {f"{joint}_acceleration": f"{unit}/s2" for joint, unit in units.items()},
            machine=self.machine.load_expression,
            task=f"excitation, steady from {lead:g} s, period {period:g} s",
        ).to_csv(path)

    def to_yaml(self, path: str | Path) -> None:
        """Write the coefficients as YAML, see `FourierTrajectory`.

        Raises:
            OutputError: The file cannot be written.
        """
        K = self.trajectory.harmonics
        numbers = self.trajectory.coefficients.T.tolist()
        text = {
            "machine": self.machine.load_expression,
            "criterion": self.criterion,
            "seed": self.seed,
            "period": self.trajectory.period,
            "periods": self.trajectory.periods,
            "lead": self.trajectory.lead,
            "coefficients": {
                joint: {"c": row[0], "a": row[1 : K + 1], "b": row[K + 1 :]}
                for joint, row in zip(self.machine.active, numbers, strict=True)
            },
        }
        with replace_file(path) as part:
            part.write_text(yaml.safe_dump(text, sort_keys=False), encoding="utf-8")

    def to_text(self) -> str:
        """Tables of information measures, used limits, and the least identifiable parameters."""
        initial, optimized = self.initial_information, self.optimized_information
        figures: list[tuple[str, ...]] = [
            ("", "random", "optimised"),
            ("ln det (1 + M)", f"{initial.logdet:.1f}", f"{optimized.logdet:.1f}"),
            ("condition number", f"{initial.condition:.3g}", f"{optimized.condition:.3g}"),
            (
                "smallest singular value",
                f"{initial.smallest_singular_value:.3g}",
                f"{optimized.smallest_singular_value:.3g}",
            ),
        ]
        shares: list[tuple[str, ...]] = [("share of limits used", *QUANTITIES)]
        for joint, row, limit in zip(
            self.machine.active, self.limit_usage.T, self.limits.as_array.T, strict=True
        ):
            words = (
                f"{x:.0%}" if np.isfinite(y) else "-" for x, y in zip(row, limit, strict=True)
            )
            shares.append((joint, *words))
        nominal = self.base.values(self.nominal)
        least_identifiable: list[tuple[str, ...]] = [
            ("least known", "value", "std, random", "std, optimised")
        ]
        for i in self.least_identifiable():
            numbers = (nominal[i], initial.std[i], optimized.std[i])
            name = self.base.names[self.base.independent[i]]
            least_identifiable.append((name, *(f"{x:.3g}" for x in numbers)))
        return "\n\n".join(
            "\n".join(format_table(rows)) for rows in (figures, shares, least_identifiable)
        )


@with_single_threaded_blas
def excite(
    machine: Machine,
    model: IdentificationModel | None = None,
    *,
    period: float = 10.0,
    harmonics: int = 5,
    periods: int = 3,
    criterion: str = "logdet",
    noise: Mapping[str, float] | None = None,
    prior: ArrayLike | None = None,
    acceleration: Mapping[str, float] | None = None,
    margin: float = 0.05,
    step: float = 0.01,
    starts: int = 3,
    seed: int = 0,
    progress: Progress | None = None,
) -> Excitation:
    """Design a periodic trajectory with the most information about the base parameters.

    The best of random trajectories, scaled to the limits, are optimized by sequential quadratic
    programming over the coefficients of `FourierTrajectory`, then scaled to satisfy all limits at
    64 instants per period of the highest harmonic, including the parts from and to rest, with the
    factor 1 / cos(pi / 64) for maxima between the instants (Ehlich and Zeller, 1964).

    Args:
        machine: The machine.
        model: Model to be identified; default `IdentificationModel(machine)`.
        period: [s].
        harmonics: Number of harmonics K.
        periods: Number of periods.
        criterion: "logdet", the volume of the confidence ellipsoid, or "condition".
        noise: Standard deviations of the measured forces by active joint [N], [N m]; default 1 %
            of the force limit, 1 without a limit.
        prior: (p,) prior standard deviations of the parameters, see `FisherInformation`.
        acceleration: See `trajectory_limits`.
        margin: See `trajectory_limits`.
        step: Step of the recording [s].
        starts: Number of random trajectories that are optimized.
        seed: Seed of the random trajectories; the result is reproducible to the last bit.
        progress: Called with the finished share, 0 to 1.

    Raises:
        InputError: Arguments are out of range, or no trajectory is within the limits.
    """
    progress = progress_reporter(progress)
    check_name(criterion, CRITERIA, f"criterion '{criterion}' is unknown")
    for what, value in (("starts", starts), ("harmonics", harmonics), ("periods", periods)):
        as_count(value, f"the number of {what}")
    period = as_number(period, "the period", "s", greater_than=0)
    step = as_number(step, "the step", "s", greater_than=0)
    seed = as_seed(seed)
    if machine.free:
        held = " ".join(f"--lock {joint}=VALUE" for joint in machine.free)
        raise InputError(
            f"nothing drives {', '.join(map(repr, machine.free))}, and a planned motion needs all "
            f"joints where it wants them: hold what is free ({held})"
        )
    # discontinuous friction has no gradient
    smooth_model = model or IdentificationModel(_with_smooth_friction(machine))
    model = model or IdentificationModel(machine)
    _check_size(model, period, harmonics, periods, step)
    bounds = trajectory_limits(machine, acceleration, margin)
    deviation, force = _force_noise(machine, noise)
    base = base_parameters(model)
    if not base.rank:
        raise InputError(f"nothing of '{machine.name}' has an effect on its drives")
    time = np.arange(0.0, period, step)
    if len(time) * len(machine.active) < base.rank:
        raise InputError(
            f"{len(time)} samples in a period of {period:g} s do not determine {base.rank} base "
            "parameters, give a smaller step or a longer period"
        )
    random_motions = _random_motions(model, bounds, 2 * np.pi / period * harmonics)
    information = FisherInformation(model, base, deviation, force, random_motions, prior)
    count = periods * period / step
    smooth = FisherInformation(smooth_model, base, deviation, force, random_motions, prior)
    search = TrajectoryOptimizer(smooth, bounds, period, harmonics, count, CRITERIA[criterion])
    draws = search.random_references(np.random.default_rng(seed))
    best = _optimize_best(search, draws, starts, progress)
    initial_trajectory, trajectory = (
        FourierTrajectory(search.coefficients(x), period, periods) for x in (draws[0], best)
    )
    first, last = (
        information.measures(model.samples(*one(one.lead + time), float(time[1] - time[0])), count)
        for one in (initial_trajectory, trajectory)
    )
    return Excitation(
        trajectory=trajectory,
        machine=machine,
        base=base,
        nominal=model.nominal,
        prior_std=np.linalg.norm(information.scale, axis=1),
        initial_information=first,
        optimized_information=last,
        limits=bounds,
        limit_usage=search.limit_usage(trajectory),
        noise=deviation,
        criterion=criterion,
        seed=seed,
        step=step,
    )


def _force_noise(machine: Machine, noise: Mapping[str, float] | None) -> tuple[Array, Array]:
    """Standard deviations (n,) of the force noise, and force limits (n,) or their equivalents."""
    force = machine.model.effortLimit[machine.closure.active]
    default = np.where(np.isfinite(force), _NOISE_SHARE * force, 1.0)
    deviation = joint_values(machine, noise, "noise", default)
    for joint, force_limit, value in zip(machine.active, force, deviation, strict=True):
        if value > force_limit:
            raise InputError(
                f"noise of '{joint}' is {value:g}, above the {force_limit:g} of its drive: give "
                "less"
            )
    return deviation, np.where(np.isfinite(force), force, deviation / _NOISE_SHARE)


def _optimize_best(
    search: TrajectoryOptimizer, draws: Array, starts: int, progress: Progress
) -> Array:
    """The best vector after optimization of the best random ones (V, size)."""
    costs = search.evaluate(draws)[0]
    order = np.argsort(costs, kind="stable")[:starts]
    best, lowest_cost = draws[order[0]], float(costs[order[0]])
    for start_index, start in enumerate(draws[order]):

        def report(share: float, tried: int = start_index) -> None:
            progress((tried + share) / len(order))

        found = search.optimize(start, report)
        if (cost := float(search.evaluate(found[None])[0][0])) < lowest_cost:
            best, lowest_cost = found, cost
    return best


def _with_smooth_friction(machine: Machine) -> Machine:
    rates = machine.closure.units / machine.closure.characteristic_time
    laws = {
        joint: replace(law, smoothing=_FRICTION_SMOOTHING * float(rates[machine.column(joint)]))
        for joint, law in machine.friction.items()
        if law.has_stick_slip
    }
    return machine.replace(friction={**machine.friction, **laws})


def _check_size(
    model: IdentificationModel, period: float, harmonics: int, periods: int, step: float
) -> None:
    """Check that the optimization and the recording fit into memory.

    Raises:
        InputError: They do not; the message gives possible values.
    """
    n = len(model.machine.active)
    max_samples = _MAX_MEMORY / (24 * n * len(model.names))  # samples for three regressors
    min_step = max(period / max_samples, (periods + 1) * period / _MAX_SAMPLES)
    if step < min_step:
        raise InputError(
            f"{periods} periods of {period:g} s and the parts from and to rest are "
            f"{(periods + 1) * period / step:.3g} samples of {step:g} s, too many for the "
            f"memory: give a step of at least {min_step:.2g} s, or fewer or shorter periods"
        )
    # one motion per derivative
    max_harmonics = max(1, int((max_samples / (2 * n * COARSE_SAMPLES)) ** 0.5))
    if harmonics > max_harmonics:
        raise InputError(
            f"the number of harmonics is {harmonics}, too many for the memory with {n} active "
            f"joints: give at most {max_harmonics}"
        )


def _random_motions(
    model: IdentificationModel, bounds: TrajectoryLimits, max_frequency: float
) -> MotionSamples:
    """Random motions within the limits, with harmonics up to an angular frequency [rad/s]."""
    machine, rng = model.machine, np.random.default_rng(0)
    at = random_samples(model, 300)
    q_a = at.q_a[singularity_proximity(machine, at) <= 1]
    v_max = np.minimum(bounds.velocity, max_frequency * bounds.half_stroke)
    a_max = np.minimum(bounds.acceleration, max_frequency * v_max)
    v_a, a_a = (limit * rng.uniform(-1, 1, q_a.shape) for limit in (v_max, a_max))
    return model.samples(q_a, v_a, a_a, at.step)
