"""Controllers: forces of the active joints or valve signals, from time and motion.

For simulations with a controller other than `PI` and `ComputedTorque`, or with one of your own.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
