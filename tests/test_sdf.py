"""SDF: what it says, in whatever way and version, is the machine that a plain URDF describes."""

import warnings

import numpy as np
import pinocchio as pin
import pytest
from sdf_models import SdfWriter, draw, urdf

import crane
from crane.common.errors import CraneWarning


def load(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        return crane.load(path, **options)


def assert_same(one, two, rng):
    """Mass matrix, gravity and Coriolis forces of two trees, joint by joint."""
    assert set(one.joints) == set(two.joints)
    order = [two.joints.index(name) for name in one.joints]
    for _ in range(4):
        q, v = rng.uniform(-2, 2, (2, one.model.nv))
        other_q, other_v = np.empty_like(q), np.empty_like(v)
        other_q[order], other_v[order] = q, v
        here, there = one.model.createData(), two.model.createData()
        mass, other = (np.triu(pin.crba(*x)) for x in (
            (one.model, here, q), (two.model, there, other_q)))  # fmt: skip
        mass, other = (x + np.triu(x, 1).T for x in (mass, other))
        scale = np.abs(mass).max()
        assert np.abs(mass - other[np.ix_(order, order)]).max() < 1e-12 * scale
        bias = pin.nonLinearEffects(one.model, here, q, v)
        apart = bias - pin.nonLinearEffects(two.model, there, other_q, other_v)[order]
        assert np.abs(apart).max() < 1e-11 * max(1, np.abs(bias).max())


@pytest.mark.parametrize("version", [4, 5, 6, 7, 9, 11])
@pytest.mark.parametrize("seed", range(5))
def test_poses_and_axes_mean_what_they_say(version, seed, tmp_path):
    rng = np.random.default_rng([version, seed])
    drawn = draw(rng)
    (tmp_path / "drawn.sdf").write_text(SdfWriter(rng, drawn, version).text())
    (tmp_path / "drawn.urdf").write_text(urdf(drawn))
    assert_same(load(tmp_path / "drawn.sdf"), load(tmp_path / "drawn.urdf"), rng)
