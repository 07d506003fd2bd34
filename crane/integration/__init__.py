"""Motion in time: Runge-Kutta and Rosenbrock methods in machine code, and scipy's."""

from crane.integration.adaptive import ADAPTIVE, AdaptiveSteps
from crane.integration.halt import HaltedError, explained
from crane.integration.rosenbrock import StiffStepper
from crane.integration.runge_kutta import CompiledStepper
from crane.integration.state import row_layout, state_layout
from crane.integration.steps import Steps
from crane.integration.stepwise import PythonStepper
from crane.integration.stiff import StiffSteps

__all__ = [
    "ADAPTIVE", "AdaptiveSteps", "CompiledStepper", "HaltedError", "PythonStepper", "StiffStepper",
    "StiffSteps", "Steps", "explained", "row_layout", "state_layout",
]  # fmt: skip
