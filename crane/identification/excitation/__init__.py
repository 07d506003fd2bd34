"""Design of excitations: trajectories and valve signals with most information."""
