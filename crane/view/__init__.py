"""Pages, figures, sketches and the live view of a machine.

For reports that open in a browser and pictures of a mechanism or a circuit.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
