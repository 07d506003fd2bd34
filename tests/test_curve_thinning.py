"""Long curves are drawn with fewer points and the same appearance."""

import numpy as np
import pytest

from crane.view.plots import figure_style


@pytest.mark.parametrize("count", [1, 7, 100, 101, 999, 4321])
def test_an_envelope_has_all_that_can_be_seen(monkeypatch, count):
    monkeypatch.setattr(figure_style, "_MAX_POINTS", 100)
    rng = np.random.default_rng(count)
    time, values = np.arange(float(count)), rng.normal(size=count)
    at, kept = figure_style.envelope(time, values)
    assert len(at) <= max(2 * 100, 6) and (np.diff(at) > 0).all()
    np.testing.assert_array_equal(values[at.astype(int)], kept)
    assert (at[0], at[-1]) == (0, count - 1)
    assert (kept.min(), kept.max()) == (values.min(), values.max())
    # in every stretch of an eightieth of the time, lowest and highest are there
    edges = np.linspace(0, count, 81)
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        inside = values[(time >= low - count / 40) & (time < high + count / 40)]
        shown = kept[(at >= low - count / 40) & (at < high + count / 40)]
        whole = values[(time >= low) & (time < high)]
        if len(whole):
            assert shown.min() <= whole.min() and shown.max() >= whole.max()
            assert shown.min() >= inside.min()


def test_a_path_keeps_its_ends(monkeypatch):
    monkeypatch.setattr(figure_style, "_MAX_POINTS", 100)
    points = np.random.default_rng(0).normal(size=(1234, 3))
    path = figure_style.thin_path(points)
    assert len(path) <= 101
    np.testing.assert_array_equal(path[[0, -1]], points[[0, -1]])
    np.testing.assert_array_equal(figure_style.thin_path(points[:100]), points[:100])
