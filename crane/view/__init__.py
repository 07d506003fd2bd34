"""Views of machines and results: pages, figures, sketches, and a live view."""
