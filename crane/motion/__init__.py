"""Kinematics, trajectories, transmission, sway and workspaces.

For references of controllers, inverse kinematics and what a machine's frames can reach.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
