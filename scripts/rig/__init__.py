"""The virtual rig: a simulated experiment that replaces the unpublished one.

The plant is the machine with random parameters within tolerances, and with stiction. A discrete PI
controller moves it, using only quantised and noisy sensor readings. A recording of it has "virtual
rig" in its task: it is not a measurement of a real machine.
"""

from rig.plant import Tolerances
from rig.rig import Rig
from rig.sensors import Converter, Sensors, converter, default_sensors

__all__ = ["Converter", "Rig", "Sensors", "Tolerances", "converter", "default_sensors"]
