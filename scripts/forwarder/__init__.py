"""The reduced-scale forwarder paper, computed again; see scripts/reproduce_mini_forwarder.py."""
