"""Description of a machine: force elements, external forces, contacts, tasks, sensors.

For programs that add forces, loads or contacts to a machine, or read what a file says of it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
