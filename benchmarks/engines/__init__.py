"""Adapters of engines to one interface, see `engines.engine`."""

from engines.crane_engine import Crane
from engines.drake_engine import Drake
from engines.engine import Engine
from engines.exudyn_engine import Exudyn
from engines.exudyn_tree_engine import ExudynTree
from engines.mujoco_engine import MuJoCo
from engines.mujoco_warp_engine import MuJoCoWarp
from engines.newton_engine import Newton
from engines.pinocchio_admm_engine import PinocchioAdmm
from engines.pinocchio_engine import Pinocchio

ENGINES: tuple[Engine, ...] = (
    Crane("DOP853"),
    Crane("Radau"),
    Crane("rk4"),
    Crane("DOP853", backend="pinocchio"),
    Pinocchio("constraintDynamics"),
    Pinocchio("lcaba"),
    PinocchioAdmm(),
    MuJoCo("Euler"),
    MuJoCo("implicitfast"),
    MuJoCo("RK4"),
    Exudyn("GeneralizedAlpha"),
    Exudyn("TrapezoidalIndex2"),
    ExudynTree("GeneralizedAlpha"),
    ExudynTree("TrapezoidalIndex2"),
    Drake(),
    MuJoCoWarp(),
    Newton("Kamino"),
    Newton("XPBD"),
)
