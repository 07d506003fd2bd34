"""Parameters that a recording does not determine are reported, with their deviations."""

import dataclasses
import re
import warnings
from functools import partial

import forwarder_motions
import numpy as np
import pytest
from broken_machines import DATA
from forwarder_motions import NOISE, noisy

import crane
from crane.common.errors import CraneWarning, RecordingError
from crane.identification.mechanics.feasible_parameters import (
    body_parameters,
    pseudo_inertia,
    thicken_body,
)
from crane.identification.mechanics.identifiability import weak_directions
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.identify import identify
from crane.identification.mechanics.smoothed_motion import smoothed_motion
from crane.identification.signals.signal_processing import Motion

motion = partial(forwarder_motions.motion, period=8.0, duration=16.0)


@pytest.fixture(scope="module")
def plain(mini):
    with pytest.warns(CraneWarning, match="does not determine .* of 75 base parameters"):
        return identify(mini, noisy(motion(mini), 1))


def columns(text):
    """The table of parameters in a text, cells as words."""
    lines = text[text.index("\nparameter ") :].splitlines()[2:]
    return [line.split() for line in lines[: lines.index("") if "" in lines else None]]


def test_what_is_not_determined_is_marked(plain):
    vague = plain.std > plain.magnitude
    assert 10 < vague.sum() < 70
    assert [mark == "not determined" for mark in plain.marks] == vague.tolist()
    shown = {row[0]: row[-2:] == ["not", "determined"] for row in columns(plain.to_text())}
    assert shown == dict(zip(plain.names, vague.tolist(), strict=True))
    assert "1975040" not in plain.to_text()  # shares beyond 1000 % are no numbers
    shares = [row[3] for row in columns(plain.to_text()) if row[4] == "%"]
    assert max(map(float, shares)) < 1000


def test_the_direction_that_is_named_hardly_moves_the_forces(mini, plain):
    """By forces that were not learned from: one magnitude along it is below the noise."""
    unit = np.diag(1 / plain.magnitude)
    values, vectors = np.linalg.eigh(unit @ plain.covariance @ unit)
    other = motion(mini, duration=4.0)
    W = plain.model.regressor(plain.model.samples(other.q, other.v, other.a))
    W = W[:, :, plain.base.independent] * plain.magnitude
    effect = np.sqrt(np.mean((W @ vectors[:, -1]) ** 2, axis=0)) / NOISE
    assert effect.max() < 1e-2 and values[-1] > 1e4
    std, words = plain.undetermined_directions[0]
    assert std == pytest.approx(np.sqrt(values[-1]), rel=1e-6)
    named = words.replace("- ", "+ ").split(" + ")
    assert {name.split()[1] for name in named} <= set(plain.names)
    largest = plain.names[np.abs(vectors[:, -1]).argmax()]
    assert named[0].split() == [f"{np.abs(vectors[:, -1]).max():.2f}", largest]
    assert f"  +- {std:.2g}  {words}\n" in plain.to_text()


def test_two_that_act_alike_are_named_together():
    """The sum of two is known, their difference is not."""
    weak, strong = np.array([1, -1]) / np.sqrt(2), np.array([1, 1]) / np.sqrt(2)
    covariance = 1e12 * np.outer(weak, weak) + 1e-4 * np.outer(strong, strong)
    ((std, words),) = weak_directions(["boom.mx", "stick.mx"], covariance, np.ones(2))
    assert std == pytest.approx(1e6) and words in (
        "0.71 boom.mx - 0.71 stick.mx", "0.71 stick.mx - 0.71 boom.mx",
    )  # fmt: skip
    assert weak_directions(["boom.mx", "stick.mx"], 0.5 * np.eye(2), np.ones(2)) == []


def test_a_combination_of_what_is_determined_is_named_without_a_warning(plain):
    """All known to 0.7 of what can be, and hanging together: their sum is known to more than 1."""
    alike = 0.49 * (0.9 + 0.1 * np.eye(len(plain.names)))
    found = dataclasses.replace(
        plain,
        values=np.zeros(len(plain.names)),
        covariance=alike * np.outer(plain.magnitude, plain.magnitude),
    )
    assert not any(found.marks) and found.warning == ""
    ((std, words),) = found.undetermined_directions
    assert std > 5 and f"  +- {std:.2g}  {words}\n" in found.to_text()
    # as soon as one is not determined, the warning counts it
    vague = found.covariance.copy()
    vague[3] *= 2
    vague[:, 3] *= 2
    found = dataclasses.replace(found, covariance=vague)
    assert found.warning.startswith("this motion does not determine 1 of 75 base parameters, ")
    assert "75 base parameters, 1 not determined, " in repr(found)
    # a motion last: excite may have found the best that the limits allow
    assert re.search(
        ": give a prior, require physically feasible bodies, or record a motion that ",
        found.warning,
    )


def test_what_cannot_be_is_called_impossible(plain):
    values, std = plain.values.copy(), plain.std
    i = int(np.argmin(std / plain.magnitude))
    values[i] = 1e3 * plain.magnitude[i]
    found = dataclasses.replace(plain, values=values)
    assert found.marks[i] == "impossible" and plain.marks[i] == ""
    assert f"{plain.names[i]} is beyond what such a machine can have" in found.warning


@pytest.mark.parametrize("size", [1e-300, 1e-12, 1.0, 1e12, 1e300])
def test_columns_of_the_table_stay_apart(plain, size):
    scaled = {"values": -size * np.abs(plain.values), "covariance": 1e8 * plain.covariance}
    rows = columns(dataclasses.replace(plain, **scaled).to_text())
    for row, value in zip(rows, scaled["values"], strict=True):
        assert float(row[1]) == pytest.approx(value, rel=1e-5)
        float(row[2])


def test_a_recording_that_tells_all_is_told_without_a_word():
    arm = crane.load("ur5_robot")
    time = np.arange(0, 10, 4e-3)
    rng = np.random.default_rng(0)
    w = np.arange(1, 6)
    a, b = rng.normal(size=(2, 5, 6))
    phase = time[:, None] * w
    q = np.sin(phase) @ (a / w[:, None]) - np.cos(phase) @ (b / w[:, None])
    v, acc = np.cos(phase) @ a + np.sin(phase) @ b, np.cos(phase) @ (b * w[:, None])
    acc = acc - np.sin(phase) @ (a * w[:, None])
    tau = crane.Dynamics(arm).inverse(q, v, acc) + 1e-3 * rng.normal(size=q.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("error", CraneWarning)
        found = identify(arm, Motion(time, q, v, acc, tau))
    assert found.warning == "" and not any(found.marks) and found.undetermined_directions == []


# --- standard deviations ---------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
def test_a_feasible_estimate_is_as_known_as_its_own_objective_says(mini, plain):
    """With the prior, bodies are known to its share at least, and never worse than without."""
    found = identify(mini, noisy(motion(mini), 1), prior=0.3, feasible=True)
    bodies = [i for i, name in enumerate(found.names) if not name.endswith(("viscous", "offset"))]
    size = found.magnitude[bodies]
    assert (found.std[bodies] < 0.7 * size).all()
    assert plain.std[bodies].max() > 1e3 * found.std[bodies].max()
    # on what forces alone tell well, both agree
    well = plain.std < 0.01 * plain.magnitude
    assert well.sum() > 3
    ratio = found.std[well] / plain.std[well]
    assert ratio.max() < 3 and np.median(ratio) > 0.4
    assert ratio.min() > 0.1  # where few stretches of the recording tell, the prior tells more


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@pytest.mark.parametrize("prior", [None, 0.3])
def test_feasible_intervals_cover_machines_that_are_not_as_described(mini, prior):
    """Bodies and friction drawn by 30 % about the description: 90 to 99 % of the intervals."""
    model, given, covered = IdentificationModel(mini), motion(mini), []
    at = model.samples(given.q, given.v, given.a)
    W, offset = model.regressor(at), model.known_forces(at)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth = model.nominal.copy()
        for i in range(0, 10 * len(model.bodies), 10):
            L = np.linalg.cholesky(pseudo_inertia(thicken_body(truth[i : i + 10])))
            E = rng.normal(size=(4, 4))
            values, vectors = np.linalg.eigh(0.15 * (E + E.T))
            X = vectors @ np.diag(np.exp(values)) @ vectors.T
            truth[i : i + 10] = body_parameters(L @ X @ L.T)
        truth[10 * len(model.bodies) :] *= np.exp(0.3 * rng.normal(size=len(truth) - i - 10))
        recorded = noisy(dataclasses.replace(given, tau=W @ truth + offset), seed)
        found = identify(mini, recorded, prior=prior, feasible=True, bandwidth=30.0)
        low, high = found.confidence_interval().T
        wanted = found.base.values(truth)
        covered.append(np.mean((low <= wanted) & (wanted <= high)))
    assert 0.90 < np.mean(covered) <= 0.99


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_a_motion_that_determines_nothing_is_refused_unless_trusted():
    """A crank that creeps one way at one speed: weight and all friction are one, but for noise."""
    crank = crane.load(DATA / "four_bar.yaml")
    time = 0.01 * np.arange(1500)
    q = 0.5 + 1e-3 * time + 1e-6 * np.sin(2 * time)
    v, a = 1e-3 + 2e-6 * np.cos(2 * time), -4e-6 * np.sin(2 * time)
    q, v, a = q[:, None], v[:, None], a[:, None]
    tau = crane.Dynamics(crank).inverse(q, v, a)
    given = Motion(time, q, v, a, tau + 0.1 * np.random.default_rng(0).normal(size=tau.shape))
    with pytest.raises(RecordingError, match=r"does not determine (\d+) of \1 base parameters"):
        identify(crank, given, bandwidth=5.0)
    assert set(identify(crank, given, bandwidth=5.0, trust=True).marks) == {"not determined"}


def test_a_joint_that_only_trembles_stands_still(mini):
    """Rows at rest carry no information, since friction can balance any force."""
    rng, time = np.random.default_rng(1), 0.01 * np.arange(3000)
    home = mini.home[mini.closure.active]
    q = home + np.outer(np.sin(1.5 * time), [0.3, 5e-3, 0.0]) + 1e-5 * rng.normal(size=(3000, 3))
    tau = crane.Dynamics(mini).inverse(q, 0 * q, 0 * q) + 1e-3 * rng.normal(size=(3000, 3))
    units = {joint: mini.unit(joint) for joint in mini.active}
    recording = crane.Recording(time, mini.active, q, 0 * q, tau, units)
    with pytest.warns(CraneWarning) as told:
        motion = smoothed_motion(mini, recording)
    still = [str(one.message) for one in told if "stands still" in str(one.message)]
    assert len(still) == 1 and still[0].startswith("'X2' stands still but for noise: its forces ")
    assert not motion.v[:, 2].any() and motion.v[:, :2].any(axis=0).all()
