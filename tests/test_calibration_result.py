"""Results of a calibration: ends of intervals, correlated directions, remaining errors."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hydraulic_rig import AREA_A, AREA_B, COMPENSATED, HOSE, STROKE, rig

import crane
from crane.common.errors import InputError
from crane.description.parameter_changes import parameters
from crane.formats.machine_loading import MachineVariants
from crane.identification.calibration.calibration_result import (
    Calibration,
    CalibrationChannel,
    FittedParameter,
    correlation_ratio,
    group_samples,
)
from crane.identification.calibration.calibration_statistics import (
    CalibrationEstimate,
    ProfileEnds,
    correlated_directions,
    estimate_with_profiles,
    evaluate_profile_ends,
)
from crane.identification.calibration.unknowns import build_unknowns, candidate_parameters


def test_numbers_keep_their_sign():
    """A piston that drives its joint backwards has a negative area."""
    spec = MachineVariants(crane.load("kr300")).spec
    numbers = parameters(spec)
    names = ["gas_spring.stroke.area", "gas_spring.stroke.pressure", "link2_anchor.x"]
    area, pressure, pin = build_unknowns(names, spec, numbers, {})
    assert area.start < area.high < 0 and area.low == -np.inf
    assert 0 < pressure.low < pressure.start and pressure.high == np.inf
    assert (pin.low, pin.high) == (-np.inf, np.inf)


def test_what_may_be_fitted_of_a_cylinder(tmp_path):
    """Its stiffness is bounded by that of its oil, K A^2 / V; gas dissolves under pressure."""
    machine = rig(tmp_path, COMPENSATED, friction={"viscous": 300.0})
    valve = machine.hydraulics.valves["x"]
    signals = {"x": np.array([valve.neutral, valve.full])}
    table = SimpleNamespace(units={"pressure_x_b": "Pa"}, values=np.array([[0.2e5], [2.2e5]]))
    case = SimpleNamespace(sensors=(), inputs=SimpleNamespace(signals=signals), table=table)
    numbers = parameters(MachineVariants(machine).spec)
    found = {x.name: x for x in candidate_parameters(machine, [case], numbers)}
    volumes = AREA_A * STROKE + HOSE, AREA_B * STROKE + HOSE
    stiffness = 1.2e9 * (AREA_A**2 / volumes[0] + AREA_B**2 / volumes[1])
    spring = found["cylinder.x.stiffness"]
    assert (spring.low, spring.high) == pytest.approx((stiffness / 20, 4 * stiffness), rel=1e-12)
    assert spring.start == spring.high  # as stiff as the file has it, about
    pressures = 0.5 * machine.hydraulics.supply.pressure, 1.2e5  # not measured, and measured
    for side, volume, pressure in zip("ab", volumes, pressures, strict=True):
        gas = found[f"cylinder.x.gas_{side}"].scale
        assert gas == pytest.approx(0.3e5 / pressure * volume, rel=1e-12)
    assert {"valve.x.c*"} < set(found) and "valve.x.neutral" not in found  # opened one way


def test_channels_that_fit_worse_than_before():
    """By a tenth more than before, and by more than their noise."""

    def channel(name, before, after, noise):
        return SimpleNamespace(
            name=name, recording="one", simulated_before=before, simulated_after=after,
            noise=noise, rms=lambda residual, training: residual,
        )  # fmt: skip

    channels = [channel("better", 2.0, 1.0, 0.1), channel("alike", 2.0, 2.1, 0.1)]
    channels += [channel("worse", 2.0, 2.3, 0.1), channel("noise", 0.01, 0.09, 0.1)]
    assert Calibration.degraded_channels.fget(SimpleNamespace(channels=channels)) == ["worse"]


@pytest.mark.parametrize("size, exceeds", [(0.0, False), (0.1, False), (0.6, True), (2.0, True)])
def test_residuals_that_are_more_than_noise(size, exceeds):
    """Slow ones show in their means, though RMS grows by a sixth only; and outside of training."""
    random, time = np.random.default_rng(3), np.arange(2000) / 100
    measured = np.sin(time) + 0.1 * random.normal(size=2000)
    error, mask = 0.1 * size * np.sqrt(2.0) * np.sin(3 * time), time < 15.0
    simulated = np.sin(time) + np.where(mask, error, 5.0)
    channel = CalibrationChannel(
        "file", "x", "m", time, mask, measured, measured, simulated,
    )  # fmt: skip
    assert channel.rms(simulated, True) == pytest.approx(0.1 * np.hypot(1, size), rel=0.03)
    assert channel.exceeds_noise == exceeds
    one = FittedParameter("a", 1.0, 2.0, 0.1, False, False, has_model_error=exceeds)
    assert one.remark == ("excludes model error" if exceeds else "")


class Fake:
    """A search whose residuals are a function, at minima that are given by their starts."""

    def __init__(self, left, minima, low=-np.inf, high=np.inf, prior=(0.0, 0.0)):
        self.weighted_residuals, self._minima = left, minima
        self.low, self.high = (np.broadcast_to(x, 2).astype(float) for x in (low, high))
        self.prior, self.starts = np.array(prior), []
        self.problem = SimpleNamespace(unknowns=["one", "two"])

    def run(self):
        return self.nearest_minimum(None)

    def nearest_minimum(self, start):
        self.starts.append(start)
        z = np.array(self._minima(start), dtype=float)
        columns = [self.weighted_residuals(z + 1e-20j * e).imag / 1e-20 for e in np.eye(2)]
        self.jacobian, self.residual = np.array(columns).T, self.weighted_residuals(z)
        return z

    def covariance(self, z):
        return np.linalg.inv(self.jacobian.T @ self.jacobian + np.diag(self.prior**2)), 1000


A = np.random.default_rng(0).normal(size=(50, 2)) @ np.array([[3.0, 0.0], [2.9, 0.4]])
NOISE = np.random.default_rng(1).normal(size=50)


def test_ends_of_a_quadratic_are_as_derivatives_say():
    """For any two numbers that go together, with a prior, whatever the width."""
    best = np.linalg.lstsq(A, NOISE, rcond=None)[0]
    search = Fake(lambda z: A @ z - NOISE, lambda _: best)
    z = search.run()
    for widths in ([0.1, 0.2], [7.0, 9.0]):
        ends, lower = evaluate_profile_ends(search, z, np.array(widths))
        np.testing.assert_allclose(ends, 1.0, rtol=1e-9)
        assert lower is None
        assert not any(one.remark for one in ends)


def test_the_other_numbers_keep_their_bounds():
    """What is held by its bound leaves the first number alone: the cost rises faster."""
    best = np.linalg.lstsq(A, NOISE, rcond=None)[0]
    search = Fake(lambda z: A @ z - NOISE, lambda _: best, low=(-np.inf, best[1]))
    (ends, other), _ = evaluate_profile_ends(search, search.run(), np.array([0.1, 0.2]))
    H = A.T @ A
    alone = np.sqrt(H[0, 0] * np.linalg.inv(H)[0, 0])
    assert ends.lower_rise == pytest.approx(alone) == ends.upper_rise and alone > 1.5
    assert np.isnan(other.lower_rise) and other.upper_rise > 0


def test_an_interval_that_reaches_farther_is_told():
    """What acts by one over itself: at the upper end the cost rises by less, and so it is said."""

    def left(z):
        return np.concatenate([10.0 / (1.0 + z[:1]) - 10.0, z[1:]]) * np.ones(2)

    search = Fake(left, lambda _: (0.0, 0.0))
    (ends, other), lower = evaluate_profile_ends(search, search.run(), np.array([0.8, 0.1]))
    assert ends.upper_rise == pytest.approx(1 / 1.8) and ends.lower_rise == pytest.approx(1 / 0.2)
    assert ends.remark == "reaches farther up" and lower is None
    assert other == pytest.approx((1.0, 1.0))
    one = FittedParameter("a", 1.0, 1.0, 0.8, False, True, profile_ends=ends)
    assert one.remark == "not determined by the recordings, reaches farther up"
    assert ProfileEnds().remark == "" and ProfileEnds(0.9, 2.0).remark == ""
    assert ProfileEnds(1.0, 4.0).remark == "derivatives do not hold over its interval"


def test_the_search_goes_on_where_the_cost_is_lower():
    """Two minima of sin: from the higher one it is sent on, and what is found is of the lower."""

    def left(z):
        return np.array([3.0 * np.cos(3.0 * z[0]) + 0.5 * (z[0] - 2.0), z[1]]) + 4.0

    def minima(start):
        return (0.0 if start is None else start[0], -4.0)

    search = Fake(left, minima)
    found = estimate_with_profiles(search, search.run())
    assert isinstance(found, CalibrationEstimate) and len(search.starts) > 1
    cost = [0.5 * np.sum(left(z) ** 2) for z in (np.array([0.0, -4.0]), found.z)]
    assert cost[1] < 0.5 * cost[0]
    assert np.sum(left(np.array([search.starts[1][0], -4.0])) ** 2) < 2.0 * cost[0]


class Linear(Fake):
    """A search of some columns, with those of others at hand."""

    def __init__(self, columns, names=("one", "two")):
        super().__init__(lambda z: self.jacobian @ z, lambda _: np.zeros(2))
        self.columns, self.prior = columns, np.ones(len(names))
        self.problem = SimpleNamespace(unknowns=list(names), variant=tuple)
        self.jacobian = np.column_stack([columns[x] for x in names])

    def nearest_minimum(self, start):
        return np.zeros(2)

    def restricted_search(self, problem):
        return Linear(self.columns, problem)

    def linearize_for_covariance(self, z):
        assert len(z) == self.jacobian.shape[1] and not z.any()
        if "cracked" in self.columns and len(z) > 2:
            raise InputError("its mass is negative")


def test_intervals_with_what_was_left_out():
    """A parameter beside one that acts alike is known by its prior alone, the other as before."""
    one, two = 100.0 * np.eye(50)[:2]
    columns = {"one": one, "two": two, "alike": one, "other": np.eye(50)[2]}
    search = Linear(columns)
    found = estimate_with_profiles(search, np.zeros(2), ["alike", "other"])
    widths = found.interval_half_widths
    np.testing.assert_allclose(widths, 1.9623 / np.sqrt(1e4 + 1), rtol=1e-4)
    H = np.array([[1e4 + 1, 1e4], [1e4, 1e4 + 1]])
    alike = 1.9623 * np.sqrt(np.linalg.inv(H)[0, 0])
    assert found.candidate_half_widths == pytest.approx([alike, widths[1]], rel=1e-4)
    assert estimate_with_profiles(search, np.zeros(2)).candidate_half_widths == pytest.approx(
        widths
    )
    failing = Linear(columns | {"cracked": one})  # the simulation of a candidate
    found = estimate_with_profiles(failing, np.zeros(2), ["alike"])
    assert found.candidate_half_widths == pytest.approx(widths)
    fitted = FittedParameter("a", 1.0, 1.5, 0.1, False, False, members=(("a", 1.0),))
    assert replace(fitted, candidate_half_width=0.14).remark == ""
    wider = replace(fitted, candidate_half_width=0.45)
    assert wider.remark == "±0.45 with all candidates"
    assert wider.notes == {"a": "fitted ±0.1, 95 %, ±0.45 with all candidates (was 1)"}


def test_numbers_that_go_together():
    """x and 2 x + y are known badly, z well: the direction holds the first two."""
    names, ends = ["mass", "area", "zero"], np.array([230.0, 9e-4, 0.1])
    R = np.array([[1.0, -0.99, 0.1], [-0.99, 1.0, 0.0], [0.1, 0.0, 1.0]])
    (direction,) = correlated_directions(names, R, ends)
    assert list(direction) == ["mass", "area"]
    assert direction["mass"] == pytest.approx(230.0, rel=0.02)
    assert direction["area"] == pytest.approx(-9e-4, rel=0.02)
    assert correlated_directions(names, np.eye(3), ends) == []
    assert correlated_directions(names[:1], np.eye(1), ends[:1]) == []
    mild = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert correlated_directions(names, mild, ends) == []
    # three of which two tell the third, no pair of which is close: R = I in two dimensions
    s = np.sqrt(0.5)
    R = np.array([[1.0, 0.0, s], [0.0, 1.0, s], [s, s, 1.0]])
    R += 0.02 * (np.eye(3) - R)
    (direction,) = correlated_directions(names, R, ends)
    assert set(direction) == set(names) and direction["zero"] == pytest.approx(0.1)
    assert direction["mass"] == pytest.approx(230.0 * s, rel=0.05)


def test_what_is_left_goes_with_what_it_is_made_of():
    random = np.random.default_rng(2)
    speed, noise = random.normal(size=4000), random.normal(size=4000)
    side = np.sign(speed) * (np.abs(speed) > 0.3)
    assert correlation_ratio(noise, speed) < 0.01 and correlation_ratio(noise, side) < 0.01
    assert correlation_ratio(side, side) == pytest.approx(1.0)
    assert correlation_ratio(side + noise, side) == pytest.approx(
        side.var() / (side.var() + 1), abs=0.03
    )
    assert 0.9 < correlation_ratio(2.0 * speed, speed) < 1.0
    assert correlation_ratio(np.ones(9), np.arange(9.0)) == 0.0
    assert sorted(np.concatenate(group_samples(speed)).tolist()) == list(range(4000))
    assert [len(x) for x in group_samples(side)] == [(side == x).sum() for x in (-1, 0, 1)]


def test_comments_of_numbers():
    one = FittedParameter("a.b", 1.0, 1.25, 0.03, False, False, "m", (("a.b", 1.1),))
    assert one.notes == {"a.b": "fitted ±0.03, 95 % (was 1.1)"} and one.changed_significantly
    shared = FittedParameter("a.*", 1.0, 0.5, 0.6, True, False, "", (("a.b", 1.1), ("a.c", 3.0)))
    assert shared.notes == {
        "a.b": "fitted by a.* = 0.5 ±0.6, 95 %, on its bound (was 1.1)",
        "a.c": "fitted by a.* = 0.5 ±0.6, 95 %, on its bound (was 3)",
    }
    assert shared.initial_value == 1.0 and not shared.changed_significantly
