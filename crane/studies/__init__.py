"""Studies of variants of a machine: measures over parameters, optimization, power balance.

For design decisions: what a parameter changes, which values are best, where the power goes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
