"""xacro: URDF and other XML written with macros, expanded by the package of that name."""
