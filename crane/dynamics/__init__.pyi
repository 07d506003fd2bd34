from .buckling import Buckling as Buckling
from .dynamics import Dynamics as Dynamics
from .reactions import Reactions as Reactions
from .tipping_stability import TippingStability as TippingStability
