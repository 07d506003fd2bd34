"""Orifices, valves, and the friction of cylinders."""
