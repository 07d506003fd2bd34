"""Selection of parameters by blocks left out, several starts, and payloads by statics."""

from types import SimpleNamespace

import numpy as np
import pytest

import crane
from crane.common.errors import SimulationError
from crane.formats.machine_loading import MachineVariants
from crane.identification.calibration import model_selection, multi_start
from crane.identification.calibration.levenberg_marquardt import LevenbergMarquardt
from crane.identification.calibration.model_selection import (
    LinearizedSelection,
    training_blocks,
)
from crane.identification.calibration.multi_start import sample
from crane.identification.calibration.normal_equations import bounded_step, scaled_inverse
from crane.identification.calibration.plausibility import (
    StaticPayload,
    implausible_values,
    static_payload,
)
from crane.identification.calibration.unknowns import Unknown
from crane.recordings.sensor_kinematics import cylinder_pins
from crane.recordings.timeseries import Table

NAMES = ["gain", "offset", "nothing", "twin", "weak"]


def test_a_steep_unknown_hides_no_flat_one():
    """An unknown 1e9 times as steep, one without effect, and twins that share theirs."""
    J = np.random.default_rng(2).normal(size=(40, 4)) * [1e9, 1.0, 1e-3, 0.0]
    J = np.column_stack([J, J[:, 2]])
    variances = np.diag(scaled_inverse(J.T @ J))
    exact = np.linalg.inv((J / [1e9, 1, 1e-3, 1, 1]).T[:3] @ (J / [1e9, 1, 1e-3, 1, 1])[:, :3])
    np.testing.assert_allclose(variances[:2], np.diag(exact)[:2] / [1e18, 1.0], rtol=1e-6)
    assert variances[3] == 0.0 and variances[2] == pytest.approx(exact[2, 2] * 1e6 / 4, rel=1e-6)


class Problem:
    """Unknowns without a machine."""

    def __init__(self, unknowns):
        self.unknowns = unknowns

    def variant(self, unknowns):
        return Problem(unknowns)


def linear_search(seed=0, noise=0.1, count=1200):
    """A linear model of two channels: two parameters, one without effect, a twin, noise alone."""
    random, time = np.random.default_rng(seed), np.linspace(0.0, 12.0, count)
    gain, offset = np.sin(time), np.ones(count)
    columns = np.column_stack([gain, offset, 0 * time, gain + 1e-4 * offset, np.cos(9 * time)])
    J = np.repeat(columns, 2, axis=0) * np.tile([1.0, 0.5], count)[:, None]
    residual = J @ np.array([-2.0, 1.0, 0.0, 0.0, 0.0]) + noise * random.normal(size=2 * count)
    unknowns = [Unknown(x, 0.0, -9.0, 9.0, 1.0, prior=1.0) for x in NAMES]
    return SimpleNamespace(
        jacobian=J, residual=residual, blocks=np.repeat(time, 2),
        redundancies={"x": 1.0, "y": 1.0},
        channels=np.tile([0, 1], count), channel_scales={"x": 0.5, "y": 2.0},
        weight_divisors={"x": 0.5, "y": 2.0},
        prior=np.ones(5), low=np.full(5, -9.0), high=np.full(5, 9.0),
        problem=Problem(unknowns),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
def test_what_the_data_need_is_selected(seed):
    """Neither a column of zeros, nor one of a pair, nor what fits noise."""
    search = linear_search(seed)
    chosen, steps = LinearizedSelection(search, np.zeros(5), []).path()
    assert sorted(chosen) in ([0, 1], [1, 3])
    assert [step.name for step in steps[1:3]] in (["gain", "offset"], ["twin", "offset"])
    assert steps[2].score < steps[1].score < steps[0].score
    # where they are left out, noise alone remains, in the units of the channels
    assert steps[2].errors["x"] == pytest.approx(0.5 * 0.1, rel=0.1)
    assert steps[2].errors["y"] == pytest.approx(2.0 * 0.1, rel=0.1)


def test_errors_in_blocks_are_those_of_fits_without_them():
    """The normal equations give what least squares over the other rows gives."""
    search = linear_search()
    z = np.array([0.5, -0.2, 0.0, 0.1, 0.0])
    selection, both = LinearizedSelection(search, z, [4]), [0, 1]
    blocks = training_blocks(search.blocks)
    assert len(np.unique(blocks)) == 4
    squares = np.zeros(2)
    J, r = search.jacobian[:, both], search.residual - search.jacobian @ z
    for b in range(4):
        rest = blocks != b
        fitted = np.linalg.lstsq(np.vstack([J[rest], np.eye(2)]), -np.append(r[rest], [0.0, 0.0]))[
            0
        ]
        np.testing.assert_allclose(selection.fit(both, b)[both], fitted, rtol=1e-9)
        error = (r + J @ fitted)[~rest]
        squares += np.bincount(search.channels[~rest], error**2) / 1200
    np.testing.assert_allclose(selection.mean_squares(both, True), squares, rtol=1e-9)
    assert selection.path()[0][0] == 4  # what is named by hand stays


def test_a_steep_unknown_holds_no_flat_one():
    """Steps of unknowns in any units; one without effect stays, whatever gradients round to."""
    random, sizes = np.random.default_rng(4), np.array([1e9, 1.0, 1e-6, 0.0])
    A, b = random.normal(size=(30, 4)) * sizes, random.normal(size=30)
    far = np.full(4, np.inf)
    step = bounded_step(A.T @ A, A.T @ b + [0.0, 0.0, 0.0, 1e-17], -far, far)
    alike = np.linalg.lstsq(A[:, :3] / sizes[:3], -b)[0]
    np.testing.assert_allclose(step * sizes, [*alike, 0.0], rtol=1e-9)
    assert step[3] == 0.0


def test_steps_stay_within_bounds():
    """The step to the corner of a quadratic is that of scipy's bounded least squares."""
    from scipy.optimize import lsq_linear

    random = np.random.default_rng(3)
    for _ in range(20):
        A, b = random.normal(size=(30, 4)), random.normal(size=30)
        low, high = np.full(4, -0.05), np.full(4, 0.1)
        step = bounded_step(A.T @ A, A.T @ b, low, high)
        best = lsq_linear(A, -b, (low, high)).x
        assert np.all((step >= low) & (step <= high))
        costs = [float(np.sum((A @ x + b) ** 2)) for x in (step, best)]
        assert costs[0] <= 1.02 * costs[1]


@pytest.mark.parametrize("blocks_decide", [False, True])
def test_blocks_decide_between_sets_that_are_about_as_good(monkeypatch, blocks_decide):
    sign = 1.0 if blocks_decide else -1.0
    monkeypatch.setattr(
        model_selection, "_block_score", lambda search, z: sign * len(search.problem.unknowns)
    )
    monkeypatch.setattr(  # with fewer parameters worse by 24 in the score
        SimulatedSearch, "training_errors",
        lambda self, z: {"x": 0.1 + 1e-3 * (len(self.problem.unknowns) < 5), "y": 0.1},
    )  # fmt: skip
    linear = linear_search()
    linear.residual -= linear.jacobian @ np.array([-2.0, 1.0, 0.0, 0.0, 0.0])
    search, rejected = SimulatedSearch(NAMES, linear), []
    z = np.array([2.0, -1.0, 0.0, 0.5, 0.0])
    fewer, _, _ = model_selection._fewer_parameters(search, z, [], rejected)
    assert (len(fewer.problem.unknowns) < len(NAMES)) == blocks_decide
    assert bool(rejected) != blocks_decide


@pytest.mark.parametrize(
    ("has_stiction", "start", "found"), [(True, 3.0, 2.0), (False, 3.0, 3.0), (True, 0.0, 0.0)]
)
def test_a_kink_of_friction_is_left_for_a_lower_minimum(has_stiction, start, found):
    """Smoothed friction moves the search by one; at the lowest minimum that is no gain."""
    problem = SimpleNamespace(smooth=0.0, slopes=0.0)
    search = SimpleNamespace(
        problem=problem, has_stiction=has_stiction, cost=lambda z: float(z @ z),
        minimize=lambda z, tolerance: SimpleNamespace(z=z - 0.5 * bool(problem.smooth)),
    )  # fmt: skip
    z = model_selection._released_minimum(search, np.array([start]))
    assert z == [found] and not problem.smooth


def test_a_simulation_that_fails_with_smoothed_friction_keeps_the_minimum():
    def fail(z, tolerance):
        raise SimulationError("halts")

    problem = SimpleNamespace(smooth=0.0, slopes=0.0)
    search = SimpleNamespace(
        problem=problem, has_stiction=True, cost=lambda z: float(z @ z), minimize=fail
    )
    assert model_selection._released_minimum(search, np.array([3.0])) == [3.0]
    assert not problem.smooth


def test_samples_of_starts():
    """A prior's quantiles; a factor of a positive value; the range between bounds."""
    known = Unknown("a", 2.0, 0.0, 9.0, 0.5, prior=1.0)
    assert sample(known, 0.5) == pytest.approx(0.0, abs=1e-12)
    assert sample(known, 1.0) == -sample(known, 0.0) == pytest.approx(2.33, abs=0.01)
    positive = Unknown("b", 4.0, 4e-3, np.inf, 4.0)
    assert [4.0 + 4.0 * sample(positive, x) for x in (0, 1)] == pytest.approx([4 / 3, 12.0])
    bounded = Unknown("c", 0.0, -1.0, 3.0, 4.0)
    assert [4.0 * sample(bounded, x) for x in (0, 0.5, 1)] == pytest.approx([-1.0, 1.0, 3.0])


def test_what_is_not_believable_is_said(mini):
    """A zero far from its prior; bounds, and the thousand scales of an unknown without."""
    unknowns = [
        Unknown("sensor.p.zero", 0.0, -9e9, 9e9, 2e5, prior=1.0), Unknown("a", 1.0, 0.0, 2.0, 1.0),
        Unknown("valve.c1", 1e-7, 1e-10, np.inf, 1e-7),
    ]  # fmt: skip
    problem = SimpleNamespace(unknowns=unknowns, unknown_count=4, cases=[], machine=mini)
    search = LevenbergMarquardt(problem, print, None)
    assert list(implausible_values(search, np.array([2.9, 0.5, 999.0, 0.0]))) == []
    zero, *bounds = implausible_values(search, np.array([18.0, 1.0, 1e3, 0.0]))
    assert "sensor.p.zero = 3.6e+06 is not believable, 18 deviations from 0" in zero
    assert bounds == ["a = 2 is on its bound.", "valve.c1 = 0.0001001 is on its bound."]


class SimulatedSearch:
    """A search of a linear model, whose simulation without its second parameter is bad."""

    def __init__(self, names, linear):
        self.__dict__ |= vars(linear)
        unknowns = [x for x in linear.problem.unknowns if x.name in names]
        self.problem = Problem(unknowns)
        self.prior, self.scale_bounds = np.ones(len(unknowns)), dict.fromkeys("xy", (1e-9, 1.0))
        self.training_cases = [
            SimpleNamespace(train_mask=np.ones(1200, dtype=bool), sensors=["x", "y"])
        ]

    def restricted_search(self, problem):
        return SimulatedSearch([x.name for x in problem.unknowns], self)

    def cost(self, z):
        return float(z @ z)

    def minimize(self, z, tolerance, max_iterations, highest_cost):
        assert highest_cost == pytest.approx(1.05 * 5.25)  # of the larger set
        return SimpleNamespace(z=z)

    def training_errors(self, z):
        known = "twin" in [x.name for x in self.problem.unknowns]
        return {"x": 0.1 if known else 0.2, "y": 0.1}


@pytest.mark.parametrize("is_simulated", [False, True])
def test_what_a_simulation_needs_stays(monkeypatch, is_simulated):
    """The twin costs nothing by linearization, which does not hold as far as its old value."""
    linear = linear_search()
    linear.residual -= linear.jacobian @ np.array([-2.0, 1.0, 0.0, 0.0, 0.0])  # noise, at z
    search = SimulatedSearch(NAMES, linear)
    if not is_simulated:
        monkeypatch.setattr(SimulatedSearch, "training_errors", lambda *_: {"x": 0.1, "y": 0.1})
    z = np.array([2.0, -1.0, 0.0, 0.5, 0.0])  # the twin was moved
    fewer, _, steps = model_selection._fewer_parameters(search, z, [], [])
    names = [x.name for x in fewer.problem.unknowns]
    assert names[:2] == ["gain", "offset"] and ("twin" in names) == is_simulated
    assert [x.name for x in steps[1:3]] == ["gain", "offset"]


class RaceSearch:
    """A search of one unknown that found minima with smoothed friction; sharp ones lie at z^2."""

    prior, start, scale_bounds = np.array([0.5]), np.zeros(1), {"x": (1e-9, 5.0)}
    training_cases = (SimpleNamespace(train_mask=np.arange(5) > 0, sensors=["x"]),)

    def __init__(self, minima, errors):
        self.minima = [SimpleNamespace(z=np.array([z])) for z in minima]
        self.channel_scales, self.redundancies = {"x": 1.0}, {"x": 2.0}
        self._errors, self.sharpened = errors, []

    def sharpen_friction(self, z):
        assert (self.channel_scales, self.redundancies) == ({"x": 1.0}, {"x": 2.0})
        self.sharpened.append(float(z[0]))
        if self._errors[float(z[0])] is None:
            raise SimulationError("no motion")
        self.channel_scales, self.redundancies = {"x": 2.0 + z[0]}, {"x": 1.0 + z[0]}
        return z**2

    def training_errors(self, z):
        return {"x": self._errors[float(np.sqrt(z[0]))]}


@pytest.mark.parametrize(
    "minima, errors, best, tried",
    [
        ([1.0, 3.0], {1.0: 1.0, 3.0: 0.1}, 1.0, [1.0, 3.0]),  # 0.25 against 20.25 - 9.2
        ([1.0, 2.0], {1.0: 1.0, 2.0: 0.01}, 2.0, [1.0, 2.0]),  # 0.25 against 4 - 18.4
        ([1.0, 1.01, 2.0], {1.0: 1.0, 2.0: 0.01}, 1.0, [1.0]),  # the same one twice
        ([1.0, 2.0], {1.0: 1.0, 2.0: None}, 1.0, [1.0, 2.0]),
        ([1.0, 2.0], {1.0: 50.0, 2.0: 5.0}, 2.0, [1.0, 2.0]),  # beyond the bound of the scale
    ],
)
def test_the_friction_model_decides_between_two_minima(minima, errors, best, tried):
    """By the squares of independent samples and the prior, each minimum with its own scales."""
    search = RaceSearch(minima, errors)
    assert multi_start.lowest_minimum(search, search.minima[0].z) == best**2
    assert search.sharpened == tried and search.channel_scales == {"x": 2.0 + best}
    assert search.minima[0].z == best and len(search.minima) == len(minima)
    search.redundancies = {"x": 2.0}
    expected = 4 / 2.0 * (np.log(errors[best] ** 2) + 1.0) + (0.5 * best**2) ** 2
    assert multi_start.simulated_score(search, np.array([best**2])) == pytest.approx(expected)


class ReserveSearch:
    """A search whose residuals are noise with what was left in reserve, and maybe without it."""

    def __init__(self, problem, levels):
        self.problem, self.levels = problem, levels

    def restricted_search(self, problem):
        return ReserveSearch(problem, self.levels)

    def leaves_noise(self, z, names, level=1.5):
        assert names == {"X", "pressure_X_a"}
        return self.levels[z] < level


@pytest.mark.parametrize(
    "levels, expected",
    [
        ({"smoothed": 2.0, "weighted": 1.1}, ["a", "b"]),
        ({"smoothed": 2.0, "weighted": 1.6}, ["a", "b", "c"]),
        ({"smoothed": 20.0}, ["a", "b", "c"]),  # not followed to the friction model
    ],
)
def test_a_reserve_joins_where_more_than_noise_is_left(monkeypatch, levels, expected):
    tried, smoothed = [], []

    def lowest(search, z):
        tried.append([x.name for x in search.problem.unknowns])
        return z

    def smooth(search):
        smoothed.append([x.name for x in search.problem.unknowns])
        return "smoothed"

    monkeypatch.setattr(model_selection, "smoothed_minimum", smooth)
    monkeypatch.setattr(model_selection, "lowest_minimum", lowest)
    monkeypatch.setattr(model_selection, "_weighted_minimum", lambda search, z: "weighted")
    unknowns = [Unknown(x, 1.0, 0.0, 2.0, 1.0) for x in "abc"]
    search = ReserveSearch(Problem(unknowns), levels)
    reserve = {"c": {"X", "pressure_X_a"}, "d": {"Y"}}
    found, z = model_selection._candidates_minimum(search, reserve)
    assert [x.name for x in found.problem.unknowns] == expected and z == "weighted"
    assert tried[-1] == expected and len(tried) == 1 + (levels.get("weighted", 0) > 1.5)
    # without the reserve only where noise alone is left with it
    assert smoothed == [["a", "b", "c"], ["a", "b"]][: 1 + (levels["smoothed"] < 10.0)]


def test_pins_of_a_cylinder():
    """Those on the boom that it lifts, in its plane; not its own, which are its stroke."""
    machine = crane.load("patu655")
    assert cylinder_pins(machine, "X_lift") == ["lift_boom_rod.x", "lift_boom_rod.y"]


def test_a_payload_that_the_file_lacks_is_a_candidate():
    weighed = StaticPayload(210.0, 6.0, 190.0)
    (found,) = weighed.candidates(0.0)
    assert (found.start, found.scale, found.prior) == (210.0, 6.0, 1.0)
    assert weighed.finding(0.0) == (
        "By statics the pressures carry 210 kg at the tip, 190 kg if no friction acts at rest; "
        "the machine file has payload.mass 0."
    )
    assert weighed.finding(200.0) == "" and StaticPayload(5.0, 6.0, 5.0).candidates(0.0) == []
    (known,) = weighed.candidates(200.0)
    assert (known.start, known.scale) == (200.0, 10.0)
    assert weighed.candidates(150.0)[0].start == 210.0  # of statics, not of the file


def test_a_load_is_weighed_through_friction():
    """Standing on its friction, then rising against it: the mean of both is the weight."""
    machine = crane.load("patu655", lock={"slew": 0.0, "X_ext": 0.0})
    loaded = crane.load(machine.path, lock=machine.locked_joints, changes={"payload.mass": 180.0})
    time = np.linspace(0.0, 10.0, 501)
    stroke = 0.12 + 0.014 * np.maximum(time - 2.0, 0.0)
    q = np.column_stack([stroke, np.full(501, 0.23)])
    friction = 3000.0 * np.where(time < 2.0, -1.0, 1.0)
    force = crane.Dynamics(loaded).gravity(q)
    force[:, 0] += friction
    units, columns = {"X_lift": "m", "X_tilt": "m"}, [*q.T]
    pressures = {}
    for joint, F in zip(machine.active, force.T, strict=True):
        cylinder = machine.hydraulics.cylinders[joint]
        low = 3e5 + np.maximum(-F, 0.0) / cylinder.area_b
        high = (F + cylinder.area_b * low) / cylinder.area_a
        columns += [high, low]
        units |= {f"pressure_{joint}_{side}": "Pa" for side in "ab"}
        pressures[joint] = high[0], low[0]
    inputs = SimpleNamespace(initial=(q[0], np.zeros(2)), pressures=pressures)
    case = SimpleNamespace(inputs=inputs, table=Table(units, np.column_stack(columns), {}))
    found = static_payload(MachineVariants(machine), {}, [case])
    assert found.mass == pytest.approx(180.0, abs=1.0)
    empty = crane.load(machine.path, lock=machine.locked_joints, changes={"payload.mass": 0.0})
    gravity = [crane.Dynamics(x).gravity(q[0]) for x in (loaded, empty)]
    lift, tilt = (gravity[0] - gravity[1]) / 180.0  # [N/kg], of which the lift misses 3000 N
    rest = 180.0 - 3000.0 * lift / (lift**2 + tilt**2)
    assert found.rest_mass == pytest.approx(rest, abs=0.1) and rest < 165.0
    moving = SimpleNamespace(inputs=SimpleNamespace(initial=(q[0], np.ones(2))), table=case.table)
    assert static_payload(MachineVariants(machine), {}, [moving]) is None
