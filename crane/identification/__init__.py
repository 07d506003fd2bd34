"""Identification of inertial, friction and hydraulic parameters from recordings.

For excitation trajectories, least-squares identification, calibration and payload estimation.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
