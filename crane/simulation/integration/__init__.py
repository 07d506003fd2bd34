"""Motion in time: Runge-Kutta, Radau and Rosenbrock methods in machine code, and scipy's.

Each integrates in one chart (`charts`); `ChartSwitchingIntegrator` goes from one to the next.
"""

from crane.simulation.integration.chart_switching import ChartSwitchingIntegrator
from crane.simulation.integration.charts import Chart, row_layout, state_layout
from crane.simulation.integration.error_controlled_stepper import DormandPrinceStepper
from crane.simulation.integration.integrators import ErrorControlledIntegrator, FixedStepIntegrator
from crane.simulation.integration.python_stepper import (
    IntegrationHaltError,
    PythonStepper,
    explain_halt,
)
from crane.simulation.integration.radau import RadauStepper
from crane.simulation.integration.rosenbrock import RosenbrockStepper
from crane.simulation.integration.runge_kutta import RungeKuttaStepper
from crane.simulation.integration.scipy_integrator import SCIPY_METHODS, ScipyIntegrator

__all__ = [
    "SCIPY_METHODS",
    "ScipyIntegrator",
    "Chart",
    "ChartSwitchingIntegrator",
    "RungeKuttaStepper",
    "ErrorControlledIntegrator",
    "DormandPrinceStepper",
    "IntegrationHaltError",
    "PythonStepper",
    "RadauStepper",
    "FixedStepIntegrator",
    "RosenbrockStepper",
    "explain_halt",
    "row_layout",
    "state_layout",
]
