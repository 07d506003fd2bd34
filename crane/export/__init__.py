"""Machines as programs for targets outside of Python.

For controllers, simulators and pages that take a machine along without this package.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
