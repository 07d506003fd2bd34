"""Equations of motion in the active coordinates, and reactions in joints and pins.

For forces, accelerations, mass matrices, reactions, buckling and tipping of a machine.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
