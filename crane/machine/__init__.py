"""The machine: its description, assembled and closed.

`crane.load` returns one; everything else in the package takes it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
