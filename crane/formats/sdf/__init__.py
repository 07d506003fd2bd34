"""SDF, the format of Gazebo and Drake, translated to URDF with loops."""
