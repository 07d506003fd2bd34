"""Components of the hydraulic circuit: pumps, valves, cylinders, accumulators, lines.

For programs that build or change a circuit; a machine has one as `Machine.hydraulics`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
