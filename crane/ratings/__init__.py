"""Ratings of a machine: lifting capacity, tool and break-out forces, working range.

For load charts and data sheets of cranes and excavators.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
