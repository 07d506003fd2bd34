"""Simulation in time: single runs, batches, replays, sensitivities and linear models.

For all that integrates the equations of motion or differentiates the result.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
