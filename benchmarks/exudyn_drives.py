"""Exudyn's models of the problems of drives for which it has elements, or laws in Python."""

import importlib.util
from collections.abc import Callable
from math import sqrt
from typing import Any

import numpy as np
from hand_equations import GRAVITY, Array, FallOnStop, HandEquations
from stick_slip import StickSlip
from two_arm_crane import ExudynTwoArms, TwoArms, solver_settings, stored_outputs

Setting = tuple[float, ...]
STEPS = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5)
STICKING_STIFFNESSES = (1e6, 1e7, 1e8)  # [N/m]
STICKING_DAMPING = 0.1  # over sqrt(stiffness mass), which 0.5 does not better


def settings(equations: HandEquations) -> list[Setting]:
    """Lengths of steps [s] to try, with the stiffness of the bristles where there is friction."""
    if importlib.util.find_spec("exudyn") is None:
        return []
    if isinstance(equations, StickSlip):
        return [(step, stiffness) for stiffness in STICKING_STIFFNESSES for step in STEPS[1:-1]]
    if isinstance(equations, TwoArms | FallOnStop):
        return [(step,) for step in STEPS]
    return []


def build(equations: HandEquations, interval: float, setting: Setting) -> Callable[[], Array]:
    """Function that runs a model and returns its strokes (k, n) at the outputs."""
    if isinstance(equations, TwoArms):
        return ExudynTwoArms(equations, interval, setting[0]).run
    model = Mass(equations, interval, setting[0])
    if isinstance(equations, StickSlip):
        model.pull(equations, setting[1])
    elif isinstance(equations, FallOnStop):
        model.fall(equations)
    return model.run


class Mass:
    """A mass that moves along one coordinate.

    Args:
        equations: The problem.
        interval: Interval of the outputs [s].
        step: Length of a step [s].
    """

    def __init__(self, equations: StickSlip | FallOnStop | Any, interval: float, step: float):
        import exudyn
        import exudyn.itemInterface as items  # noqa: N813

        exudyn.config.suppressWarnings = True
        self.items: Any = items
        self.container = exudyn.SystemContainer()
        self.mbs: Any = self.container.AddSystem()
        self.start, self.spring = float(equations.start[0]), None
        node = self.mbs.AddNode(items.Node1D(referenceCoordinates=[self.start]))
        self.mbs.AddObject(items.Mass1D(physicsMass=equations.mass, nodeNumber=node))
        ground = self.mbs.AddNode(items.NodePointGround())
        self.markers = [
            self.mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=one, coordinate=0))
            for one in (ground, node)
        ]
        kind = exudyn.OutputVariableType.Coordinates
        self.sensor = self.mbs.AddSensor(
            items.SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=kind)
        )
        duration = equations.data["duration"]
        self.settings = solver_settings(exudyn, duration, interval, step)

    def pull(self, equations: StickSlip, stiffness: float) -> None:
        """Add a spring with a moving end, and friction by bristles, as Exudyn's pages advise."""
        self.spring = spring = self.mbs.AddObject(
            self.items.CoordinateSpringDamper(
                markerNumbers=self.markers, stiffness=equations.spring
            )
        )
        data = self.items.NodeGenericData(numberOfDataCoordinates=3, initialCoordinates=[1, 0, 0])
        self.mbs.AddObject(
            self.items.CoordinateSpringDamperExt(
                markerNumbers=self.markers, nodeNumber=self.mbs.AddNode(data),
                dynamicFrictionForce=equations.friction,
                viscousFrictionFactor=-equations.falling, stickingStiffness=stiffness,
                stickingDamping=STICKING_DAMPING * sqrt(stiffness * equations.mass),
                frictionProportionalZone=0.0,
            )
        )  # fmt: skip

        def move_end(system: Any, t: float) -> bool:
            system.SetObjectParameter(spring, "offset", equations.speed * t)
            return True

        self.mbs.SetPreStepUserFunction(move_end)

    def fall(self, equations: FallOnStop) -> None:
        """Add the weight, and the stop as a spring with a force in Python: its own is linear."""
        load = -equations.mass * GRAVITY
        self.mbs.AddLoad(self.items.LoadCoordinate(markerNumber=self.markers[1], load=load))
        lowest = equations.lower - self.start
        stiffness, damping = equations.stop["stiffness"], equations.stop["damping"]

        def force(_: Any, __: float, ___: int, x: float, v: float, *____: float) -> float:
            depth = lowest - x
            return 0.0 if depth <= 0 else -stiffness * depth * max(0.0, 1.0 - damping * v)

        self.mbs.AddObject(
            self.items.CoordinateSpringDamper(
                markerNumbers=self.markers, stiffness=1.0, springForceUserFunction=force
            )
        )

    def run(self) -> Array:
        """Coordinate (k, 1) at the outputs [m]."""
        if self.spring is not None:  # an earlier run has moved its end
            self.mbs.SetObjectParameter(self.spring, "offset", 0.0)
        self.mbs.Assemble()
        self.mbs.SolveDynamic(self.settings)
        return np.asarray(self.start + stored_outputs(self.mbs, [self.sensor]))
