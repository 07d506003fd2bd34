"""Repetition of the reduced-scale forwarder paper; see scripts/reproduce_mini_forwarder.py."""
