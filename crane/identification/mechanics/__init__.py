"""Inertial and friction parameters, and payloads."""
