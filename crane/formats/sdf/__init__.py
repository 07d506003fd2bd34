"""SDF of Gazebo and Drake, translated into URDF with loops."""
