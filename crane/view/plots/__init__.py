"""Figures of recordings and results."""
