"""Shapes and meshes of links."""
