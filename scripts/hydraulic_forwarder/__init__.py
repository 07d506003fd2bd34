"""The electro-hydraulic forwarder paper again; see scripts/reproduce_hydraulic_forwarder.py."""
