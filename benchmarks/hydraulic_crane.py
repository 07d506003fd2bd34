"""Two arms on hydraulic cylinders: crane, Exudyn, and equations by hand.

The arms are those of Exudyn's example HydraulicActuator2Arms by J. Gerstmayr; the cylinders have
the volumes of real ones, and the valves follow given signals: all engines have the same model.
Orifices become laminar below 0.1 bar in crane and in the equations by hand, not in Exudyn; that
concerns the first instants of the motion and changes the reference by 1e-8 m.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from engines.exudyn_engine import Exudyn
from multibody import Array
from problem import load_machine
from report import table
from scipy.integrate import solve_ivp

import crane

MACHINE = "two_arm_crane/two_arm_crane.yaml"
DURATION, OUTPUTS = 6.0, 12
SIGNAL_TIMES = np.array([0.0, 0.5, 2.0, 2.5, 4.0, 4.5, 6.0])
SIGNALS = {
    "lift": np.array([0.0, 0.4, 0.4, 0.0, -0.3, 0.0, 0.0]),
    "tilt": np.array([0.0, 0.0, 0.5, 0.5, -0.4, -0.4, 0.0]),
}
MASS, INERTIA, LENGTH = 120.0, 10.0, 1.0
AREA, VOLUME, BULK_MODULUS, FLOW_COEFFICIENT = 0.01, 1e-3, 1e9, 2e-7
SUPPLY, TANK, DAMPING = 200e5, 1e5, 2e4
LAMINAR = 1e4  # pressure drop below which an orifice is laminar [Pa]
GROUND_EYE, BOOM_EYE = np.array([0.0, -0.30]), np.array([0.25, -0.05])
BOOM_EYE_2, STICK_EYE = np.array([0.75, -0.05]), np.array([0.25, -0.05])
DEAD_LENGTHS = np.sqrt(2.0) * np.array([0.25, 0.20])
STROKES = 0.7 * DEAD_LENGTHS
TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
STEPS = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4)


@dataclass(frozen=True)
class Run:
    """A run of an engine: CPU time [s] and largest error of the strokes at the outputs [m]."""

    engine: str
    setting: float
    time: float
    error: float


def rotation(angle: float) -> Array:
    """Rotation (2, 2) in the plane."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def lengths(q: Array) -> tuple[Array, Array]:
    """Distances of the eyes of both cylinders (2,) and their derivatives by the own joint (2,)."""
    pairs = (
        (rotation(q[0]) @ BOOM_EYE - GROUND_EYE, rotation(q[0] + np.pi / 2) @ BOOM_EYE),
        (
            np.array([LENGTH, 0.0]) + rotation(q[1]) @ STICK_EYE - BOOM_EYE_2,
            rotation(q[1] + np.pi / 2) @ STICK_EYE,
        ),
    )
    distances = np.array([np.linalg.norm(way) for way, _ in pairs])
    slopes = np.array([way @ slope for way, slope in pairs]) / distances
    return distances, slopes


def accelerations(q: Array, v: Array, torques: Array) -> Array:
    """Joint accelerations (2,) of two slender arms, q absolute angle and relative angle."""
    half = LENGTH / 2
    coupling = MASS * LENGTH * half * np.cos(q[1])
    m22 = INERTIA + MASS * half**2
    m12 = m22 + coupling
    m11 = INERTIA + MASS * (half**2 + LENGTH**2) + m22 + 2 * coupling
    speed_term = MASS * LENGTH * half * np.sin(q[1])
    bias = np.array([-speed_term * v[1] * (2 * v[0] + v[1]), speed_term * v[0] ** 2])
    weight = 9.81 * MASS
    outer = weight * half * np.cos(q[0] + q[1])
    gravity = np.array([weight * (half + LENGTH) * np.cos(q[0]) + outer, outer])
    return np.linalg.solve(np.array([[m11, m12], [m12, m22]]), torques - bias - gravity)


def root(drop: float, laminar: float) -> float:
    """Signed square root; below `laminar` the odd cubic with the same value and slope there."""
    if abs(drop) >= laminar:
        return float(np.sign(drop) * np.sqrt(abs(drop)))
    x = drop / laminar
    return float(np.sqrt(laminar) * x * (1.25 - 0.25 * x * x))


def rate(t: float, state: Array, laminar: float) -> Array:
    """Derivative of the state: two angles, their rates, pressures A and B of both cylinders."""
    q, v, pressures = state[:2], state[2:4], state[4:].reshape(2, 2)
    distances, slopes = lengths(q)
    speeds = slopes * v
    forces = AREA * (pressures[:, 0] - pressures[:, 1]) - DAMPING * speeds
    out = np.empty(8)
    out[:2], out[2:4] = v, accelerations(q, v, slopes * forces)
    for i, values in enumerate(SIGNALS.values()):
        u = float(np.interp(t, SIGNAL_TIMES, values))
        a, b = pressures[i]
        stroke = distances[i] - DEAD_LENGTHS[i]
        high = root(SUPPLY - (a if u > 0 else b), laminar)
        low = root((b if u > 0 else a) - TANK, laminar)
        flow_a = FLOW_COEFFICIENT * (u * high if u > 0 else u * low)
        flow_b = FLOW_COEFFICIENT * (-u * low if u > 0 else -u * high)
        volumes = VOLUME + AREA * stroke, VOLUME + AREA * (STROKES[i] - stroke)
        out[4 + 2 * i] = BULK_MODULUS / volumes[0] * (flow_a - AREA * speeds[i])
        out[5 + 2 * i] = BULK_MODULUS / volumes[1] * (flow_b + AREA * speeds[i])
    return out


@cache
def start() -> tuple[crane.Machine, Array]:
    """The machine, and the state (8,) that crane starts in: pressures that carry the arms."""
    machine = load_machine(MACHINE)
    recording = simulate_crane(machine, 1e-6)
    pressures = [
        recording.channels[f"pressure_{joint}_{side}"][0]
        for joint in ("lift", "tilt")
        for side in "ab"
    ]
    q = [machine.home[machine.column(joint)] for joint in ("boom", "stick")]
    return machine, np.array([*q, 0.0, 0.0, *pressures])


@cache
def reference(laminar: float = LAMINAR) -> Array:
    """Lengths of the cylinders (k, 2) at the outputs, by scipy's DOP853 on the equations [m]."""
    times, state, found = output_times(), start()[1], []
    breaks = np.union1d(times, SIGNAL_TIMES)
    scale = 1e-13 * np.array([1, 1, 1, 1, 1e7, 1e7, 1e7, 1e7])
    for begin, end in zip(breaks[:-1], breaks[1:], strict=True):
        run = solve_ivp(
            rate, (begin, end), state, "DOP853", rtol=1e-12, atol=scale, args=(laminar,)
        )
        state = run.y[:, -1]
        if end in times:
            found.append(lengths(state[:2])[0])
    return np.array(found)


def output_times() -> Array:
    """Instants of outputs after the start (k,) [s]."""
    return DURATION / OUTPUTS * np.arange(1, OUTPUTS + 1)


def simulate_crane(machine: crane.Machine, tolerance: float) -> crane.Recording:
    """The run of crane, recorded at the outputs."""
    command = crane.control.ValveSignals(machine, SIGNAL_TIMES, SIGNALS)
    return crane.simulate(
        machine, command, duration=DURATION, step=DURATION / OUTPUTS, tolerance=tolerance
    )


def crane_runs(rounds: int) -> list[Run]:
    """Runs of crane over its tolerances."""
    machine = start()[0]
    found = []
    for tolerance in TOLERANCES:
        spent, recording = timed(lambda value=tolerance: simulate_crane(machine, value), rounds)
        error = float(np.abs(recording.q[1:] - reference()).max())
        found.append(Run("crane rosenbrock", tolerance, spent, error))
    return found


def timed(call: Callable[[], Any], rounds: int) -> tuple[float, Any]:
    """Median CPU time of a call [s] after one that does not count, and its result."""
    result, times = call(), []
    for _ in range(rounds):
        begin = time.process_time()
        result = call()
        times.append(time.process_time() - begin)
    return statistics.median(times), result


def exudyn_runs(rounds: int, longest: float = 5.0) -> list[Run]:
    """Runs of Exudyn over its step lengths, none longer than about a time [s]."""
    found: list[Run] = []
    for step in STEPS:
        if found and found[-1].time > longest:
            break
        crane_in_exudyn = ExudynCrane(step)
        spent, strokes = timed(crane_in_exudyn.run, rounds)
        error = np.inf if strokes is None else float(np.abs(strokes - reference()).max())
        found.append(Run("Exudyn GeneralizedAlpha", step, spent, error))
    return found


class ExudynCrane:
    """The arms as planar bodies with Exudyn's hydraulic actuators, as in its example.

    Before each step the valves get the signal of its end, which is of order 2.

    Args:
        step: Length of a step [s].
    """

    def __init__(self, step: float):
        import exudyn
        import exudyn.itemInterface as item_interface  # noqa: N813

        exudyn.config.suppressWarnings = True
        self._exudyn: Any = exudyn
        container = exudyn.SystemContainer()
        mbs = self._mbs = container.AddSystem()
        self._container = container
        _, state = start()
        items: Any = item_interface
        ground = mbs.AddObject(items.ObjectGround())
        angles = state[0], state[0] + state[1]
        origin, bodies = np.zeros(2), []
        for angle in angles:
            centre = origin + rotation(angle) @ [LENGTH / 2, 0.0]
            node = mbs.AddNode(items.Rigid2D(referenceCoordinates=[*centre, angle]))
            body = mbs.AddObject(
                items.RigidBody2D(physicsMass=MASS, physicsInertia=INERTIA, nodeNumber=node)
            )
            marker = mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=body))
            mbs.AddLoad(items.Force(markerNumber=marker, loadVector=[0, -MASS * 9.81, 0]))
            bodies.append(body)
            origin = origin + rotation(angle) @ [LENGTH, 0.0]

        def marker_at(body: Any, x: float, y: float) -> Any:
            return mbs.AddMarker(
                items.MarkerBodyPosition(bodyNumber=body, localPosition=[x, y, 0])
            )

        half = LENGTH / 2
        joints = (
            (marker_at(ground, 0, 0), marker_at(bodies[0], -half, 0)),
            (marker_at(bodies[0], half, 0), marker_at(bodies[1], -half, 0)),
        )
        for pair in joints:
            mbs.AddObject(items.RevoluteJoint2D(markerNumbers=list(pair)))
        eyes = (
            (
                marker_at(ground, *GROUND_EYE),
                marker_at(bodies[0], BOOM_EYE[0] - half, BOOM_EYE[1]),
            ),
            (
                marker_at(bodies[0], BOOM_EYE_2[0] - half, BOOM_EYE_2[1]),
                marker_at(bodies[1], STICK_EYE[0] - half, STICK_EYE[1]),
            ),
        )
        self._actuators = []
        for i, pair in enumerate(eyes):
            node = mbs.AddNode(
                items.NodeGenericODE1(
                    referenceCoordinates=[0, 0], numberOfODE1Coordinates=2,
                    initialCoordinates=list(state[4 + 2 * i : 6 + 2 * i]),
                )
            )  # fmt: skip
            self._actuators.append(mbs.AddObject(
                items.HydraulicActuatorSimple(
                    markerNumbers=list(pair), nodeNumbers=[node], offsetLength=DEAD_LENGTHS[i],
                    strokeLength=STROKES[i], chamberCrossSection0=AREA, chamberCrossSection1=AREA,
                    hoseVolume0=VOLUME, hoseVolume1=VOLUME, valveOpening0=0, valveOpening1=0,
                    oilBulkModulus=BULK_MODULUS, actuatorDamping=DAMPING,
                    nominalFlow=FLOW_COEFFICIENT, systemPressure=SUPPLY, tankPressure=TANK,
                    useChamberVolumeChange=True,
                )
            ))  # fmt: skip
        kind = exudyn.OutputVariableType.Distance
        self._sensors = [
            mbs.AddSensor(
                items.SensorObject(objectNumber=one, storeInternal=True, outputVariableType=kind)
            )
            for one in self._actuators
        ]
        mbs.Assemble()
        instants = step * np.arange(round(DURATION / step) + 1)
        tables = [
            np.interp(instants, SIGNAL_TIMES, values).tolist() for values in SIGNALS.values()
        ]

        def open_valves(system: Any, t: float) -> bool:
            i = round(t / step)  # the end of the step, where its equations are met
            for actuator, values in zip(self._actuators, tables, strict=True):
                system.SetObjectParameter(actuator, "valveOpening0", values[i])
                system.SetObjectParameter(actuator, "valveOpening1", -values[i])
            return True

        mbs.SetPreStepUserFunction(open_valves)
        self._settings = self._solver_settings(step)

    def _solver_settings(self, step: float) -> Any:
        settings = self._exudyn.SimulationSettings()
        integration = settings.timeIntegration
        integration.endTime, integration.numberOfSteps = DURATION, round(DURATION / step)
        integration.verboseMode, integration.adaptiveStep = 0, False
        integration.newton.useModifiedNewton = True
        integration.newton.relativeTolerance = integration.newton.absoluteTolerance = 1e-8
        integration.newton.numericalDifferentiation.minimumCoordinateSize = 1
        integration.generalizedAlpha.spectralRadius = 0.9
        settings.solutionSettings.writeSolutionToFile = False
        settings.solutionSettings.sensorsWritePeriod = DURATION / OUTPUTS
        settings.displayComputationTime = False
        return settings

    def run(self) -> Array | None:
        """Lengths of the cylinders (k, 2) at the outputs [m]; None if the solver gives up."""
        try:
            self._mbs.SolveDynamic(self._settings)
        except Exception:
            return None
        columns = [self._mbs.GetSensorStoredData(sensor)[1:, 1] for sensor in self._sensors]
        return np.column_stack(columns)


def measure(quick: bool) -> list[Run]:
    """Runs of crane and, where it is installed, of Exudyn."""
    rounds = 1 if quick else 3
    return crane_runs(rounds) + (exudyn_runs(rounds) if Exudyn.version() else [])


def tables(runs: Sequence[Run]) -> list[str]:
    """Errors and times of all settings."""
    head = ["engine", "step [s] or tolerance", "error of the strokes [m]", "time [ms]",
            "times real time"]  # fmt: skip
    rows = [
        [run.engine, f"{run.setting:g}", f"{run.error:.1e}", f"{1e3 * run.time:.3g}",
         f"{DURATION / run.time:.0f}"]
        for run in runs
    ]  # fmt: skip
    return [table(head, rows)]
