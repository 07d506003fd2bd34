"""Loaders and a lift that are drawn by their pins, for their ratings; positions in m."""

import re
import textwrap
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "loader_ratings.md"


def drawings():
    """The machine files that the page on loaders has, by name."""
    blocks = re.findall(r"(?m)^    name: .*\n(?:(?:    .*)?\n)*", PAGE.read_text())
    return {text.split()[1]: textwrap.dedent(text) for text in blocks}


SCISSOR = """
name: scissor
drawing:
  base: base
  points:
    A: [0, 0]
    B: [2.4, 0]
    C: [2.4, 1]
    D: [0, 1]
    M: [1.2, 0.5]
    K: [-0.3, 0]
    R: [0.2, 0]
    S: [0.2, 1]
    deck: [1.2, 1.2]
  bodies:
    base: {points: [A, K, R], mass: 500}
    rising: {points: [A, M, C], mass: 80, centre: M, inertia: 40}
    falling: {points: [D, M, B], mass: 80, centre: M, inertia: 40}
    roller: {points: [B], mass: 20, centre: B, inertia: 1}
    upper: {points: [C], mass: 20, centre: C, inertia: 1}
    platform: {points: [D, S, deck], mass: 300, centre: deck, inertia: 100}
  slides:
    X_roller: {bodies: [base, roller], points: [R, B], shortest: 0.5, longest: 3}
    X_upper: {bodies: [platform, upper], points: [S, C], shortest: 0.5, longest: 3}
  cylinders:
    X_lift: {points: [K, B], bore: 0.1, rod: 0.05, shortest: 1.6, longest: 2.78}
tip: deck
"""
