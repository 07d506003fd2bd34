"""Simulations and inverse dynamics behind docs/validation/mini_forwarder.md."""

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import crane
from crane.codegen.symbolic import apply_function
from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.control import PI, ControllerInputs
from forwarder.paper import (
    CRUISE,
    DURATION,
    FRICTION,
    JOINTS,
    REVERSALS,
    SMOOTH,
    SMOOTHING,
    TASKS,
    VISCOUS,
    published,
)

FORMULATIONS = ("exact", "decoupled")
READINGS = ("braking", "as printed")
STEP = 1e-3  # [s]
_TURNS = np.array(list(SMOOTHING.values()))


def friction_as_printed(v: Array, sign: Array) -> Array:
    """F_F of the active joints, equation (5) with the values of Table 1, (N, 3)."""
    mean, offset, viscous, viscous_offset = np.array([FRICTION[joint] for joint in JOINTS]).T
    return mean * sign + offset + viscous * v + viscous_offset * np.abs(v)


class Pushed(PI):
    """PI control of a crane whose friction drives it, as printed: tau_PI - F_F acts.

    Args:
        machine: The crane with its viscous friction mu_v only.
        path: Reference.
        integral: (3,) see `PI`.
    """

    def __init__(self, machine: crane.Machine, path: crane.motion.Trajectory, integral: Array):
        super().__init__(machine, path, integral=integral)
        table = np.array([FRICTION[joint] for joint in JOINTS])
        self.settings = np.concatenate([self.settings, np.ravel(table)])

    def push(self, v_a: Array) -> Array:
        """F_F, (3,) or (N, 3)."""
        return friction_as_printed(v_a, np.tanh(v_a / _TURNS))

    def law(self, inputs: ControllerInputs) -> tuple[list, list]:
        """See `PI`."""
        n = len(inputs.q_a)
        tau, rate = super().law(inputs)
        table = inputs.settings[2 * n :]
        out = []
        for i, (force, v) in enumerate(zip(tau, inputs.v_a, strict=True)):
            mean, offset, viscous, viscous_offset = table[4 * i : 4 * i + 4]
            sign = apply_function("tanh", v / float(_TURNS[i]))
            out.append(force - mean * sign - offset - viscous * v - viscous_offset * (v * sign))
        return out, rate


@dataclass(frozen=True)
class Run:
    """One simulation of a task.

    Attributes:
        time: (N,) [s].
        q: (N, 3) [rad], [m].
        v: (N, 3).
        tau: (N, 3) of the actuators [N m], [N].
        tip: (N, 3) [m].
        wanted: (N, 3) reference of the tip [m].
    """

    time: Array
    q: Array
    v: Array
    tau: Array
    tip: Array
    wanted: Array

    @property
    def rms(self) -> Array:
        """(3,) of the forces."""
        return rms(self.time, self.tau)

    @property
    def tip_error(self) -> Array:
        """(N,) distance of the tip from its reference [m]."""
        return np.linalg.norm(self.tip - self.wanted, axis=1)


def rms(time: Array, values: Array) -> Array:
    """Root mean square over time."""
    return np.sqrt(np.trapezoid(values**2, time, axis=0) / (time[-1] - time[0]))


def percentage_error(time: Array, measured: Array, simulated: Array) -> tuple[Array, Array, Array]:
    """I_VD, I_VE and PE in percent, equation (9), by signal."""
    difference = np.trapezoid((measured - simulated) ** 2, time, axis=0)
    experiment = np.trapezoid(measured**2, time, axis=0)
    return difference, experiment, 100 * difference / experiment


def without_active_friction(machine: crane.Machine) -> crane.Machine:
    """The crane with the viscous friction mu_v of Table 1 alone."""
    others = {j: f for j, f in machine.friction.items() if j not in machine.active}
    viscous = {joint: crane.description.Friction(viscous=mu) for joint, mu in VISCOUS.items()}
    return machine.replace(friction=others | viscous)


def simulate(
    machine: crane.Machine, path: crane.motion.Trajectory, formulation: str, reading: str
) -> Run:
    """A task under the PI controllers, whose integrals carry the weight at the start."""
    q, v, _ = path(0.0)
    gains = np.array([machine.control[joint].ki for joint in machine.active])
    weight = crane.Dynamics(machine, formulation).inverse(q, 0 * v, 0 * v, friction=True)
    if reading == "braking":
        control = PI(machine, path, integral=weight / gains)
    else:
        plant = without_active_friction(machine)
        weight = crane.Dynamics(plant, formulation).inverse(q, 0 * v, 0 * v, friction=True)
        weight = weight + friction_as_printed(0 * v, 0 * v)
        machine, control = plant, Pushed(plant, path, weight / gains)
    recording = crane.simulate(machine, control, step=STEP, formulation=formulation)
    tau = recording.tau + control.push(recording.v) if reading != "braking" else recording.tau
    return run_of(recording, path, tau)


def run_of(recording: crane.Recording, path: crane.motion.Trajectory, tau: Array) -> Run:
    """A recording with its reference."""
    tip = np.column_stack([recording.channels[f"tip_{axis}"] for axis in "xyz"])
    return Run(recording.time, recording.q, recording.v, tau, tip, path.tip(recording.time)[0])


def tip_errors(machine: crane.Machine, path: crane.motion.Trajectory) -> dict[str, Array]:
    """Distance of the tip from its reference (N,) [m], and what remains of it without its causes.

    Without inertia and start, K_p e + K_i int e dt = F(t) gives K_p e' + K_i e = F': an error
    e = F' / K_i remains wherever the force keeps changing.
    """
    q, v, a = path(0.0)
    out = {"without changes": simulate(machine, path, "exact", "braking").tip_error}
    smooth = {
        joint: dataclasses.replace(friction, coulomb=0.0)
        for joint, friction in machine.friction.items()
    }
    for name, plant in (
        ("start with the reference's velocity and the force of that motion", machine),
        ("and without Coulomb friction", machine.replace(friction=smooth)),
    ):
        ki = np.array([plant.control[joint].ki for joint in plant.active])
        moving = crane.Dynamics(plant).inverse(q, v, a, friction=True)
        control = PI(plant, path, integral=moving / ki)
        recording = crane.simulate(plant, control, (q, v), step=STEP)
        out[name] = run_of(recording, path, recording.tau).tip_error
    time = STEP * np.arange(round(path.duration / STEP) + 1)
    q, v, a = path(time)
    force = crane.Dynamics(plant).inverse(q, v, a, friction=True)
    error = np.gradient(force, time, axis=0) / ki
    jacobian = crane.Kinematics(plant).jacobian(q)
    out["F' / K_i"] = np.linalg.norm(np.einsum("ijk,ik->ij", jacobian, error), axis=1)
    return out


def neglected(machine: crane.Machine) -> dict[str, tuple[Array, Array, Array]]:
    """Largest |exact - decoupled|, largest |exact| and where the first is, over the strokes.

    Static; at the largest velocities of the tasks in all directions; and with their largest
    accelerations on top.
    """
    grid = [
        np.linspace(low, high, 25) for low, high in zip(machine.lower, machine.upper, strict=True)
    ]
    grid[0] = np.zeros(1)
    postures = np.array(list(itertools.product(*grid)))
    bare = machine.replace(friction={}, end_stops=())
    exact, decoupled = (crane.Dynamics(bare, name) for name in FORMULATIONS)
    tops = []
    for task in TASKS:
        time = STEP * np.arange(round(DURATION / STEP) + 1)
        _, v, a = crane.task_trajectory(machine, task)(time)
        tops.append((np.abs(v).max(axis=0), np.abs(a).max(axis=0)))
    fastest, hardest = np.max(tops, axis=0)
    found = {}
    for name, speed, hurry in (
        ("static", 0.0, 0.0),
        ("at the tasks' largest velocities", 1.0, 0.0),
        ("and their largest accelerations", 1.0, 1.0),
    ):
        gaps, sizes = [], []
        for signs in itertools.product((-1, 1), repeat=3):
            for pushes in itertools.product((-1, 1), repeat=3):
                v = np.tile(speed * fastest * np.array(signs), (len(postures), 1))
                a = np.tile(hurry * hardest * np.array(pushes), (len(postures), 1))
                one, two = (way.inverse(postures, v, a) for way in (exact, decoupled))
                gaps.append(np.abs(one - two))
                sizes.append(np.abs(one))
        gap = np.max(gaps, axis=0)
        found[name] = gap.max(axis=0), np.max(sizes, axis=(0, 1)), postures[gap.argmax(axis=0)]
    return found


def cycle_work(machine: crane.Machine) -> dict[str, float]:
    """Work of the weights around the rectangle of the inner 80 % of the strokes [J].

    Zero if the forces come from a potential.
    """
    low = machine.lower + 0.1 * (machine.upper - machine.lower)
    high = machine.upper - 0.1 * (machine.upper - machine.lower)
    corners = [(low[1], low[2]), (high[1], low[2]), (high[1], high[2]), (low[1], high[2])]
    s, weights = np.polynomial.legendre.leggauss(40)
    out = {}
    for name in FORMULATIONS:
        dynamics, total = crane.Dynamics(machine, name), 0.0
        for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
            way = np.subtract(end, start)
            points = np.array([[0.0, *(start + 0.5 * (1 + x) * way)] for x in s])
            total += 0.5 * weights @ (dynamics.gravity(points)[:, 1:] @ way)
        out[name] = float(total)
    return out


@dataclass(frozen=True)
class Coarse:
    """A task at 10 Hz, for many variants.

    Attributes:
        time: (N,) [s].
        q: (N, 3).
        v: (N, 3).
        rms: By formulation, (3,).
    """

    time: Array
    q: Array
    v: Array
    rms: dict[str, Array]


def coarse(machine: crane.Machine, task: str) -> Coarse:
    """Forces of a task without control errors: inverse dynamics along its reference."""
    polynomials = machine.tasks[task].coefficients
    tip = crane.motion.polynomial([polynomials[axis] for axis in "xyz"], DURATION)
    time = np.linspace(0.0, DURATION, 101)
    x, x_rate, x_second = tip(time)
    kinematics = crane.Kinematics(machine)
    q = kinematics.inverse(x)
    jacobian = np.linalg.inv(kinematics.jacobian(q))
    v = np.einsum("ijk,ik->ij", jacobian, x_rate)
    a = np.einsum("ijk,ik->ij", jacobian, x_second - kinematics.bias(q, v))
    forces = {
        name: crane.Dynamics(machine, name).inverse(q, v, a, friction=True)
        for name in FORMULATIONS
    }
    return Coarse(time, q, v, {name: rms(time, tau) for name, tau in forces.items()})


def agrees_with_the_text(tasks: dict[str, Coarse]) -> bool:
    """Whether strokes reverse when the text says, and X1 cruises in trajectory 1 as it says.

    Half a second around the seconds of the text, and half a millimetre per second around 2.
    """
    for task, joint, second in REVERSALS:
        run = tasks[task]
        v = run.v[:, JOINTS.index(joint)]
        turns = run.time[1:][np.diff(np.sign(v)) != 0]
        if not np.any(np.abs(turns - second) <= 0.5):
            return False
    loading = tasks["loading"]
    cruising = loading.v[(loading.time >= 2) & (loading.time <= 8), 1]
    return bool(np.abs(cruising - CRUISE).max() < 0.5e-3)


def feasible_set(
    draws: int, seed: int
) -> Iterator[tuple[str, dict[str, float], dict[str, Coarse]]]:
    """Variants of G, K and the actuators' mass that the facts allow, with their tasks.

    G and K are drawn within 6 mm around the reconstruction, all tasks have to stay within the
    strokes and reverse when the text says; the actuators weigh 28 to 56 g, what the L12 family
    weighs. One thing varies at a time, then all.
    """
    rng = np.random.default_rng(seed)
    nominal = crane.load("mini_forwarder")
    base = {
        name: float(
            nominal.model.frames[nominal.frame(name[:-2])].placement.translation[
                "xy".index(name[-1])
            ]
        )
        for name in ("link3_G.x", "link3_G.y", "link7_K.x", "link7_K.y")
    }
    for what in ("G", "K", "actuator mass", "all"):
        for _ in range(draws):
            shift = dict(zip(base, rng.uniform(-6e-3, 6e-3, 4), strict=True))
            mass = rng.uniform(0.028, 0.056)
            changes = {
                name: base[name] + by
                for name, by in shift.items()
                if what == "all" or name.split(".")[0][-1] == what
            }
            if what in ("actuator mass", "all"):
                changes |= actuators_of(mass)
            try:
                machine = crane.load("mini_forwarder", changes | SMOOTH)
                tasks = {task: coarse(machine, task) for task in TASKS}
            except ClosureError:
                continue
            except crane.CraneError:  # out of reach within the strokes
                continue
            if agrees_with_the_text(tasks):
                yield what, changes, tasks


def actuators_of(mass: float) -> dict[str, float]:
    """Both actuators with another mass, 19 % of it in the rod, slender bodies."""
    nominal = crane.description.parameters(crane.formats.read_machine_spec("mini_forwarder"))
    changes = {}
    for actuator in ("A1", "A2"):
        for part in ("barrel", "rod"):
            name = f"{actuator}_{part}"
            for key in ("mass", "inertia.xx", "inertia.yy", "inertia.zz"):
                changes[f"{name}.{key}"] = nominal[f"{name}.{key}"] * mass / 0.034
    return changes


def inside(task: str, signal: int, value: float, times: float = 1.0) -> bool:
    """Whether a simulated RMS lies where the published one must."""
    bounds = published(task, signal, times)
    return bounds.low <= value <= bounds.high
