"""Identification and calibration of machines from recordings, and design of excitations."""
