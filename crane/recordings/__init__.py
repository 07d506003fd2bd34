"""Recordings of a motion, simulated or measured.

For programs that read logs, compare runs or look for limit cycles in them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
