"""Loops of a machine and their closure: configurations, gamma and its drift.

For programs that close a machine's loops themselves; `Machine.closure` is one.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
