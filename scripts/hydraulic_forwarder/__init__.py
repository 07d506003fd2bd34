"""Repetition of the electro-hydraulic paper; see scripts/reproduce_hydraulic_forwarder.py."""
