"""Machine files, URDF, SDF and MJCF: reading, checking, writing, adding cylinders and loops.

For programs that convert machines or change what a file describes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
