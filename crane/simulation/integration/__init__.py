"""Motion in time: Runge-Kutta, Radau and Rosenbrock methods in machine code, and scipy's.

Each integrates in one chart (`charts`); `ChartedSteps` goes from one to the next.
"""

from crane.simulation.integration.adaptive import ADAPTIVE, AdaptiveSteps
from crane.simulation.integration.charted import ChartedSteps
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.controlled_steps import ControlledSteps
from crane.simulation.integration.explicit import ExplicitStepper
from crane.simulation.integration.halt import HaltedError, explained
from crane.simulation.integration.radau import RadauStepper
from crane.simulation.integration.rosenbrock import StiffStepper
from crane.simulation.integration.runge_kutta import CompiledStepper
from crane.simulation.integration.state import row_layout, state_layout
from crane.simulation.integration.steps import Steps
from crane.simulation.integration.stepwise import PythonStepper

__all__ = [
    "ADAPTIVE", "AdaptiveSteps", "Chart", "ChartedSteps", "CompiledStepper", "ControlledSteps",
    "ExplicitStepper", "HaltedError", "PythonStepper", "RadauStepper", "Steps", "StiffStepper",
    "explained", "row_layout", "state_layout",
]  # fmt: skip
