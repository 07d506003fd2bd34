"""A machine fitted to recordings through its simulation."""
