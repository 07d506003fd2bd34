"""Motion in time: Runge-Kutta and Rosenbrock methods in machine code, and scipy's."""

from crane.integration.adaptive import ADAPTIVE, integrate_adaptively
from crane.integration.halt import HaltedError, explained
from crane.integration.rosenbrock import StiffStepper
from crane.integration.runge_kutta import CompiledStepper
from crane.integration.stepwise import PythonStepper

__all__ = [
    "ADAPTIVE", "CompiledStepper", "HaltedError", "PythonStepper", "StiffStepper", "explained",
    "integrate_adaptively",
]  # fmt: skip
