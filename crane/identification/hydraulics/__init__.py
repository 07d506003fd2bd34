"""Identification of orifice coefficients, valve curves and cylinder friction."""
