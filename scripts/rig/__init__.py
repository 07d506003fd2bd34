"""The virtual rig: a simulated experiment that stands in for the one that was never published.

The plant is the machine with parameters that a generator draws within tolerances, and with
stiction. A discrete PI controller moves it, and knows only what quantised and noisy sensors tell.
A recording of it says "virtual rig" in its task: it is no measurement of a real machine.
"""

from rig.plant import Tolerances
from rig.rig import Rig
from rig.sensors import Converter, Sensors, converter, default_sensors

__all__ = ["Converter", "Rig", "Sensors", "Tolerances", "converter", "default_sensors"]
