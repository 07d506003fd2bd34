"""Selection of bandwidth, slow rows and prior width by blocks of time that are left out."""

import dataclasses

import numpy as np
import pytest
from test_model_terms import moved
from warned import quiet

import crane
from crane.common.errors import InputError
from crane.description.estimation_settings import EstimationSettings, ParameterPrior
from crane.identification.mechanics.base_parameters import base_parameters
from crane.identification.mechanics.identifiability import prior_from_names, read_priors
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.identify import identify
from crane.identification.mechanics.regression_equations import RegressionEquations
from crane.identification.mechanics.settings_selection import FOLD_COUNT, _BlockProducts


@pytest.fixture(scope="module")
def arm():
    machine = crane.load("tx40")
    return machine.replace(estimation=EstimationSettings())


def noisy(arm, off, noise=0.05, seed=1):
    """A motion of an arm whose bodies are off by a share of the description, with noise."""
    rng = np.random.default_rng(seed)
    model = IdentificationModel(arm)
    truth, count = model.nominal.copy(), 10 * len(model.bodies)
    truth[:count] *= 1 + off * rng.standard_normal(count)
    motion = moved(arm, parameters=truth)
    spread = noise * motion.tau.std(axis=0)
    draws = spread * rng.standard_normal(motion.tau.shape)
    return dataclasses.replace(motion, tau=motion.tau + draws)


@pytest.mark.slow
def test_blocks_that_are_left_out_are_predicted_as_by_all_their_rows(arm):
    """Products of blocks against least squares of the rows themselves."""
    model, motion = IdentificationModel(arm), noisy(arm, 0.05)
    base = base_parameters(model)
    slow = np.full(6, 0.05)
    training = RegressionEquations(model, base, [motion], 30.0, slow)
    score = RegressionEquations(model, base, [motion], 15.0, slow, near_rest=True)
    assert (score.in_motion == score.is_moving).all() and (~training.is_moving).any()
    assert (training.is_moving <= training.in_motion).all()
    prior = prior_from_names(model, read_priors({"bodies": "5 %"}, arm), np.ones(len(model.names)))
    found, overall = _BlockProducts.of(training).held_out_errors(prior, _BlockProducts.of(score))

    def rows(equations):
        W = np.concatenate([block for _, block in equations.blocks()]) @ base.grouping
        return W, equations.forces - equations.offset, equations.is_moving

    def fitted(W, y, used, noise):
        A = np.concatenate([*(W[used[:, j], j] / noise[j] for j in range(6)), np.diag(1 / std)])
        right = [y[used[:, j], j] / noise[j] for j in range(6)]
        return np.linalg.lstsq(A, np.concatenate([*right, mean / std]), rcond=None)[0]

    (mean, std), (W, y, used) = prior, rows(training)
    noise = np.ones(6)
    for _ in range(6):
        gap = y - W @ fitted(W, y, used, noise)
        noise = np.array([np.sqrt(np.mean(gap[used[:, j], j] ** 2)) for j in range(6)])
    other_W, other_y, judged = rows(score)
    squares, forces = np.zeros((2, 6))
    for k in range(FOLD_COUNT):
        mine, other = (np.arange(len(x)) * FOLD_COUNT // len(x) == k for x in (y, other_y))
        b = fitted(W, y, used & ~mine[:, None], noise)
        here = judged & other[:, None]
        squares += (np.where(here, other_y - other_W @ b, 0) ** 2).sum(axis=0)
        forces += (np.where(here, score.forces, 0) ** 2).sum(axis=0)
    np.testing.assert_allclose(found, np.sqrt(squares / forces), rtol=1e-4)
    assert overall == pytest.approx(np.sqrt(squares.sum() / forces.sum()), rel=1e-4)


@pytest.mark.slow
def test_the_width_is_as_wide_as_the_description_is_wrong(arm):
    near, far = (
        quiet(identify, arm, noisy(arm, off), prior={"bodies": "auto"}).selection
        for off in (0.0, 0.3)
    )
    assert near.best.width <= 0.01 and far.best.width >= 0.1
    assert near.best.criterion == min(trial.criterion for trial in near.trials)
    again = quiet(identify, arm, noisy(arm, 0.3), prior={"bodies": "auto"})
    assert again.selection.to_text() == far.to_text()
    text = again.to_text()
    assert "settings by cross-validation within the training: errors of 5 blocks" in text
    assert f"below {again.bandwidth:.3g} Hz (zero phase)" in text
    assert text.count("all rows in motion") == 2
    assert again.bandwidth == far.best.bandwidth and again.parameters is not None


def test_what_is_given_holds(arm):
    motion = noisy(arm, 0.1)
    given = quiet(
        identify,
        arm,
        motion,
        prior={"bodies": "auto"},
        feasible=False,
        bandwidth=20.0,
        min_speed={"q*": 0.03},
    )
    assert given.bandwidth == 20.0 and (given.min_speed == 0.03).all()
    assert [trial.bandwidth for trial in given.selection.trials] == [20.0]
    closed = quiet(identify, arm, motion, prior={"bodies": "10 %"})
    assert closed.selection is None
    fixed = arm.replace(
        estimation=dataclasses.replace(
            arm.estimation, bandwidth=25.0, prior={"bodies": ParameterPrior.parse("auto")}
        )
    )
    found = quiet(identify, fixed, motion)
    assert found.feasible and not given.feasible and not closed.feasible
    assert found.bandwidth == 25.0 and str(fixed.estimation.prior["bodies"]) == "auto"
    with pytest.raises(InputError, match="min_speed of 'q1' is -1, it must not be negative"):
        identify(arm, motion, prior={"bodies": "auto"}, min_speed={"q1": -1.0})


def test_errors_of_all_rows_in_motion(arm):
    found = quiet(identify, arm, noisy(arm, 0.0), prior={"bodies": "5 %"}).training
    rows = found.in_motion
    gap, size = (
        np.linalg.norm(np.where(rows, x, 0), axis=0) for x in (found.residuals, found.measured)
    )
    np.testing.assert_allclose(found.motion_error, gap / size, rtol=1e-12)
