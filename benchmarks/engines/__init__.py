"""Adapters of engines to one interface, see `engines.engine`."""

from engines.crane_engine import Crane
from engines.drake_engine import Drake
from engines.engine import Engine
from engines.exudyn_engine import Exudyn
from engines.mujoco_engine import MuJoCo
from engines.pinocchio_engine import Pinocchio

ENGINES: tuple[Engine, ...] = (
    Crane("DOP853"),
    Crane("Radau"),
    Crane("rk4"),
    Pinocchio("constraintDynamics"),
    Pinocchio("lcaba"),
    MuJoCo("Euler"),
    MuJoCo("implicitfast"),
    MuJoCo("RK4"),
    Exudyn("GeneralizedAlpha"),
    Exudyn("TrapezoidalIndex2"),
    Drake(),
)
