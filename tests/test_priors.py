"""Errors of priors name the parameters that they concern."""

import numpy as np
import pytest
from broken_machines import DATA

import crane
from crane.common.errors import InputError
from crane.description import Friction
from crane.description.estimation_settings import ParameterPrior
from crane.identification.mechanics.identifiability import prior_from_names
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.identify import Motion, identify

TIME = np.arange(0, 8, 0.01)
W = np.pi


@pytest.fixture(scope="module")
def four_bar():
    return crane.load(DATA / "four_bar.yaml")


def turning(machine, q, v, a):
    q, v, a = (np.asarray(x)[:, None] for x in (q, v, a))
    tau = crane.Dynamics(machine).inverse(q, v, a, friction=True)
    return Motion(TIME, q, v, a, tau + 1e-4 * np.random.default_rng(0).normal(size=tau.shape))


@pytest.fixture(scope="module")
def one_way(four_bar):
    """The crank never turns back: Coulomb friction and its offset are one."""
    return turning(
        four_bar,
        0.2 + 0.15 * TIME + 0.02 * np.sin(W * TIME),
        0.15 + 0.02 * W * np.cos(W * TIME),
        -0.02 * W**2 * np.sin(W * TIME),
    )


def test_what_neither_prior_nor_motion_tells_is_named(four_bar, one_way):
    assert identify(four_bar, one_way).parameters is None  # base parameters come out
    names = IdentificationModel(four_bar).names
    bodies = np.array([0.1 if "_arm" in name or "coupler" in name else np.inf for name in names])
    with pytest.raises(InputError) as caught:
        identify(four_bar, one_way, prior=(IdentificationModel(four_bar).nominal, bodies))
    assert str(caught.value) == (
        "there is no finite prior of crank.coulomb, crank.coulomb_offset, crank.viscous, "
        "crank.viscous_offset, and this motion does not determine them separately: move the "
        "joints both ways and at several speeds, give prior=(means, deviations) with finite "
        "ones for them, or omit the prior to estimate base parameters"
    )
    std = np.array([1.0 if name.startswith("crank.") or "_arm" in name else np.inf
                    for name in names])  # fmt: skip
    assert len(identify(four_bar, one_way, prior=(np.zeros(len(names)), std)).parameters) == 36


@pytest.mark.parametrize(
    ("prior", "feasible", "message"),
    [
        (([0.0] * 10, [1.0] * 10), False, "the prior is about the 10 base parameters, give means "
         "and standard deviations of all 36 parameters"),
        (([0.0] * 9, [1.0] * 9), False, "the prior's means has the shape"),
        (([0.0] * 36, [0.0] * 36), False, "the prior's deviation of 'crank_arm.m' is 0, give one"),
        (([np.nan] * 36, [1.0] * 36), False, "the prior's means is nan at crank_arm.m"),
        (([0.0] * 36, [np.nan] * 36), False, "the prior's deviations is nan at crank_arm.m"),
        (([0.0] * 36, [1.0] * 36), True, "the prior's mean of 'crank_arm' has the mass 0 kg"),
        ((1, 2, 3), False, "the prior is no pair, give means"),
        ({"crank_arm": 0.1}, False, "prior 'crank_arm' is 0.1, of bodies give a share of mass and "
         "size, as 10 %, or name one of their parameters, such as crank_arm.m"),
        ({"crank.viscous": "0 %"}, False, "'0 %' says no standard deviation of 1e-12 or more"),
        ({"crank.viscuos": 1}, False, "prior 'crank.viscuos' is unknown, did you mean"),
        (-1.0, False, "the prior's relative standard deviation is -1.0, give a number above"),
    ],
)  # fmt: skip
def test_a_prior_that_is_none(four_bar, one_way, prior, feasible, message):
    with pytest.raises(InputError) as caught:
        identify(four_bar, one_way, prior=prior, feasible=feasible)
    assert str(caught.value).startswith(message) and str(caught.value).isprintable()


def test_a_share_of_the_description_is_about_friction_too(four_bar, one_way):
    """The prior of friction is its described value, that of an offset is the friction's."""
    rough = four_bar.replace(
        friction={"crank": Friction(coulomb=4.0, viscous=0.5, smoothing=1e-3)}
    )
    model = IdentificationModel(rough)
    _, std = prior_from_names(
        model, {"*": ParameterPrior(0.3, relative=True)}, np.ones(len(model.names))
    )
    by = dict(zip(model.names, std, strict=True))
    assert by["crank.coulomb"] == by["crank.coulomb_offset"] == pytest.approx(1.2)
    assert by["crank.viscous"] == by["crank.viscous_offset"] == pytest.approx(0.15)
    found = identify(rough, one_way, prior=0.3)  # Coulomb friction and offset apart, by the prior
    values = dict(zip(found.model.names, found.parameters, strict=True))
    assert abs(values["crank.coulomb_offset"]) < abs(values["crank.coulomb"] + 4.0) + 3 * 1.2
    assert len(found.parameters) == 36
