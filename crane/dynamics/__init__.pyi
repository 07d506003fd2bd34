from .buckling import Buckling as Buckling
from .dynamics import Dynamics as Dynamics
from .reactions import Reactions as Reactions
from .section_forces import SectionChart as SectionChart
from .section_forces import SectionForces as SectionForces
from .section_forces import section_chart as section_chart
from .tipping_stability import TippingStability as TippingStability
