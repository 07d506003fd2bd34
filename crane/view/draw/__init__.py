"""A page on which a machine is drawn by its pins, over a picture, and moves."""
