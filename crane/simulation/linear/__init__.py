"""Linear models of a machine about an operating point, its modes and frequency responses."""
