"""Two arms on hydraulic cylinders, by hand and in Exudyn.

The arms are those of Exudyn's example HydraulicActuator2Arms by J. Gerstmayr; the cylinders have
the volumes of real ones, and the valves follow given signals.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from hand_equations import GRAVITY, PLAIN, Array, Function, Functions, HandEquations, Numbers

MASS, INERTIA, LENGTH = 120.0, 10.0, 1.0
# eyes of both cylinders, relative to the joint between the two bodies, and the joints' places
FIRST_EYES, SECOND_EYES = ((0.0, -0.30), (-0.25, -0.05)), ((0.25, -0.05), (0.25, -0.05))


class TwoArms(HandEquations):
    """Two slender arms: boom and stick with the angles q1 and q2 of their joints.

    State: q1, q2, their rates, pressures A and B of both cylinders.
    """

    def __init__(self, data: Numbers):
        super().__init__(data)
        self.joints: list[str] = self.machine["active"]
        self.functions = [Function(self, joint) for joint in self.joints]
        self.viscous = [self.machine["friction"][joint]["viscous"] for joint in self.joints]
        self.pressure_names = tuple(
            f"pressure_{joint}_{side}" for joint in self.joints for side in "ab"
        )
        q = [self.angle(i, data["start"][joint]) for i, joint in enumerate(self.joints)]
        pressures = [
            p
            for i, moment in enumerate(self.weights(*q))
            for p in self.functions[i].resting_pressures(moment / self.length(i, q[i])[1])
        ]
        self.start = np.array([*q, 0.0, 0.0, *pressures])

    def angle(self, i: int, length: float) -> float:
        """Angle of a joint with a length of its cylinder, by the law of cosines."""
        (x1, y1), (x2, y2) = FIRST_EYES[i], SECOND_EYES[i]
        r1, r2 = np.hypot(x1, y1), np.hypot(x2, y2)
        between = np.arccos((r1**2 + r2**2 - length**2) / (2.0 * r1 * r2))
        return float(between + np.arctan2(y1, x1) - np.arctan2(y2, x2))

    def length(self, i: int, q: float) -> tuple[float, float]:
        """Length of a cylinder and its derivative by the angle of its joint."""
        (x1, y1), (x2, y2) = FIRST_EYES[i], SECOND_EYES[i]
        cosine, sine = float(np.cos(q)), float(np.sin(q))
        x, y = cosine * x2 - sine * y2, sine * x2 + cosine * y2
        length = ((x - x1) ** 2 + (y - y1) ** 2) ** 0.5
        return length, ((x - x1) * -y + (y - y1) * x) / length

    def weights(self, q1: float, q2: float) -> tuple[float, float]:
        """Moments of the weights about both joints [N m]."""
        outer = GRAVITY * MASS * LENGTH / 2 * float(np.cos(q1 + q2))
        return GRAVITY * MASS * 1.5 * LENGTH * float(np.cos(q1)) + outer, outer

    def outputs(self, y: Array) -> Array:
        """See `HandEquations.outputs`."""
        return np.array([*(self.length(i, y[i])[0] for i in range(2)), *y[4:]])

    def rate(self, t: float, y: Sequence[float], functions: Functions = PLAIN) -> list[float]:
        """See `HandEquations.rate`."""
        q1, q2, v1, v2 = y[:4]
        moments, pressure_rates = [], []
        for i, function in enumerate(self.functions):
            states = y[4 + 2 * i : 6 + 2 * i]
            a, b = function.pressures(states, functions)
            length, slope = self.length(i, y[i])
            speed = slope * y[2 + i]
            moments.append(slope * (function.force(a, b) - self.viscous[i] * speed))
            openings = function.opening(function.signal(t), functions)
            flows = function.flows(openings, function.supply, a, b, functions)[:2]
            pressure_rates += function.chamber_rates(length, speed, states, flows, functions)
        half = LENGTH / 2
        coupling = MASS * LENGTH * half * float(np.cos(q2))
        m22 = INERTIA + MASS * half**2
        m12 = m22 + coupling
        m11 = INERTIA + MASS * (half**2 + LENGTH**2) + m22 + 2.0 * coupling
        turning = MASS * LENGTH * half * float(np.sin(q2))
        weights = self.weights(q1, q2)
        r1 = moments[0] - weights[0] + turning * v2 * (2.0 * v1 + v2)
        r2 = moments[1] - weights[1] - turning * v1 * v1
        determinant = m11 * m22 - m12 * m12
        accelerations = [
            (m22 * r1 - m12 * r2) / determinant,
            (m11 * r2 - m12 * r1) / determinant,
        ]
        return [v1, v2, *accelerations, *pressure_rates]


class ExudynTwoArms:
    """The arms as planar bodies with Exudyn's hydraulic actuators, as in its example.

    Before each step the valves get the signal of its end, which is of order 2.

    Args:
        equations: The problem.
        interval: Interval of the outputs [s].
        step: Length of a step [s].
    """

    def __init__(self, equations: TwoArms, interval: float, step: float):
        import exudyn
        import exudyn.itemInterface as items  # noqa: N813

        self.exudyn: Any = exudyn
        self.items: Any = items
        self.equations = equations
        exudyn.config.suppressWarnings = True
        self.container = exudyn.SystemContainer()
        self.mbs = self.container.AddSystem()
        self.ground = self.mbs.AddObject(items.ObjectGround())
        self.bodies = self.add_arms()
        self.actuators = [self.add_actuator(i) for i in range(2)]
        kind = exudyn.OutputVariableType.Distance
        self.sensors = [
            self.mbs.AddSensor(
                items.SensorObject(objectNumber=one, storeInternal=True, outputVariableType=kind)
            )
            for one in self.actuators
        ]
        self.mbs.Assemble()
        self.open_valves(step)
        self.settings = solver_settings(exudyn, equations.data["duration"], interval, step)

    def marker(self, body: Any, x: float, y: float) -> Any:
        """A marker on a body."""
        marker = self.items.MarkerBodyPosition(bodyNumber=body, localPosition=[x, y, 0])
        return self.mbs.AddMarker(marker)

    def add_arms(self) -> list[Any]:
        """Both arms with their joints."""
        q1, q2 = self.equations.start[:2]
        origin, bodies, mbs, items = np.zeros(2), [], self.mbs, self.items
        for angle in (q1, q1 + q2):
            along = LENGTH * np.array([np.cos(angle), np.sin(angle)])
            place = [*(origin + along / 2), angle]
            node = mbs.AddNode(items.Rigid2D(referenceCoordinates=place))
            body = mbs.AddObject(
                items.RigidBody2D(physicsMass=MASS, physicsInertia=INERTIA, nodeNumber=node)
            )
            marker = mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=body))
            mbs.AddLoad(items.Force(markerNumber=marker, loadVector=[0, -MASS * GRAVITY, 0]))
            before = (bodies[-1], LENGTH / 2) if bodies else (self.ground, 0.0)
            pair = [self.marker(before[0], before[1], 0), self.marker(body, -LENGTH / 2, 0)]
            mbs.AddObject(items.RevoluteJoint2D(markerNumbers=pair))
            bodies.append(body)
            origin = origin + along
        return bodies

    def add_actuator(self, i: int) -> Any:
        """A hydraulic actuator."""
        function, (x1, y1), (x2, y2) = (
            self.equations.functions[i],
            FIRST_EYES[i],
            SECOND_EYES[i],
        )
        first = self.marker(self.bodies[0], LENGTH / 2 + x1, y1) if i else None
        pair = [first or self.marker(self.ground, x1, y1),
                self.marker(self.bodies[i], x2 - LENGTH / 2, y2)]  # fmt: skip
        node = self.mbs.AddNode(
            self.items.NodeGenericODE1(
                referenceCoordinates=[0, 0], numberOfODE1Coordinates=2,
                initialCoordinates=list(self.equations.start[4 + 2 * i : 6 + 2 * i]),
            )
        )  # fmt: skip
        cylinder = function.cylinder
        return self.mbs.AddObject(
            self.items.HydraulicActuatorSimple(
                markerNumbers=pair, nodeNumbers=[node], offsetLength=function.lower,
                strokeLength=function.stroke, chamberCrossSection0=cylinder["area_a"],
                chamberCrossSection1=cylinder["area_b"], hoseVolume0=cylinder["hose_a"],
                hoseVolume1=cylinder["hose_b"], valveOpening0=0, valveOpening1=0,
                oilBulkModulus=function.modulus, actuatorDamping=self.equations.viscous[i],
                nominalFlow=function.valve["c1"], systemPressure=function.supply,
                tankPressure=function.tank, useChamberVolumeChange=True,
            )
        )  # fmt: skip

    def open_valves(self, step: float) -> None:
        """Set the signals before each step."""
        instants = step * np.arange(round(self.equations.data["duration"] / step) + 1)
        tables = [[one.signal(t) for t in instants] for one in self.equations.functions]

        def set_openings(system: Any, t: float) -> bool:
            i = round(t / step)  # the end of the step, where its equations are met
            for actuator, values in zip(self.actuators, tables, strict=True):
                system.SetObjectParameter(actuator, "valveOpening0", values[i])
                system.SetObjectParameter(actuator, "valveOpening1", -values[i])
            return True

        self.mbs.SetPreStepUserFunction(set_openings)

    def run(self) -> Array:
        """Lengths of the cylinders (k, 2) at the outputs [m]."""
        self.mbs.SolveDynamic(self.settings)
        return stored_outputs(self.mbs, self.sensors)


def solver_settings(exudyn: Any, duration: float, interval: float, step: float) -> Any:
    """Settings of generalized alpha."""
    settings = exudyn.SimulationSettings()
    integration = settings.timeIntegration
    integration.endTime, integration.numberOfSteps = duration, round(duration / step)
    integration.verboseMode, integration.adaptiveStep = 0, False
    integration.newton.useModifiedNewton = True
    integration.newton.relativeTolerance = integration.newton.absoluteTolerance = 1e-8
    integration.newton.numericalDifferentiation.minimumCoordinateSize = 1
    integration.generalizedAlpha.spectralRadius = 0.9
    settings.solutionSettings.writeSolutionToFile = False
    settings.solutionSettings.sensorsWritePeriod = interval
    settings.displayComputationTime = False
    return settings


def stored_outputs(mbs: Any, sensors: list[Any]) -> Array:
    """Values of sensors (k, n) after the start."""
    return np.column_stack([mbs.GetSensorStoredData(sensor)[1:, 1] for sensor in sensors])
