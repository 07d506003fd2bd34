"""Identification of inertial parameters, friction and payloads."""
