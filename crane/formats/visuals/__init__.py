"""Shapes and meshes that links are drawn with."""
