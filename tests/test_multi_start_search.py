"""Multi-start search of a closed home: random mechanisms, against scipy and all assembly modes."""

import numpy as np
import pytest
from closing_from_anywhere import Task, rows, tables

from crane.closure.multi_start_search import periodic_coordinates, remove_revolutions
from crane.formats import check

NAMED = 0.05  # difference of distances from the start that counts [rad], or machine's size


def test_angles_alone_are_periodic(mini, slider_crank):
    for machine in (mini, slider_crank):
        turns = [machine.unit(joint) == "rad" for joint in machine.joints]
        assert periodic_coordinates(machine.closure.equations).tolist() == turns
        assert set(turns) == {True, False}


def assert_closed(count):
    told = rows(count)
    closed = [one for one in told if one.closed["search"]]
    beside = sum(one.closed["scipy"] for one in told)
    assert len(closed) >= max(beside, 0.95 * count), tables(told)[0]
    assert max(one.gap for one in closed) < 2e-13  # rounding, at sizes of 1 m to 4 m


def test_as_many_close_as_with_scipy():
    assert_closed(12)


@pytest.mark.slow
@pytest.mark.long
def test_two_hundred_close():
    assert_closed(200)


def apart(task, one, two):
    """Joint by joint, in units of 1 rad and of the largest distance of neighbouring joints."""
    model = task.equations.model
    size = max(np.abs(place.translation).max() for place in model.jointPlacements)
    off = np.abs(one - two)
    slides = task.equations.coordinates.is_translation
    endless = np.isinf(task.lower) & ~slides
    off[endless] = np.abs(np.angle(np.exp(1j * (one - two))))[endless]
    off[slides] /= size
    return off


def far(task, q):
    """The farthest joint from the start, and the sum of squares."""
    off = apart(task, q, task.start)
    return off.max(), np.linalg.norm(off)


def assemblies(task, count):
    """All postures within limits that scipy finds from many starts, one of each."""
    random = np.random.default_rng(7)
    found = []
    for _ in range(count):
        said = task.mechanism.start(random)
        q = task.by_scipy(np.array([said[name] for name in task.equations.coordinates.names]))
        if q is None or not task.within(q):
            continue
        if all(apart(task, q, other).max() > 1e-3 for other in found):
            found.append(q)
    return found


def undecided(task, q, home):
    """Whether an assembly is less than twice as far off as home, of joints that differ."""
    differ = apart(task, q, home) > 1e-3
    one, two = (apart(task, x, task.start)[differ].max() for x in (q, home))
    return one < 2 * two - NAMED


def assert_nearest_and_told(kind, seed, tmp_path):
    task = Task(kind, seed)
    path = tmp_path / "mechanism.urdf"
    path.write_text(task.mechanism.urdf(task.said))
    home = task.by_search()
    told = [finding.message for finding in check(path).findings]
    others = [q for q in assemblies(task, 60) if apart(task, q, home).max() > 1e-3]
    away = far(task, home)
    for q in others:
        distance = far(task, q)
        assert distance[0] > away[0] - 2e-3
        if distance[0] < away[0] + 1e-6:  # a joint that no assembly moves is the farthest
            assert distance[1] > away[1] - 2e-3
    if any(undecided(task, q, home) for q in others):
        assert any("can be assembled another way" in what for what in told), (kind, seed)
    if away[0] > 0.5 + NAMED and others:
        assert any("far from the home of the file" in what for what in told), (kind, seed)
    return len(others)


@pytest.mark.parametrize("kind", ["four_bar", "bucket", "rssr"])
def test_the_nearest_assembly_is_taken_and_others_are_told(kind, tmp_path):
    assert sum(assert_nearest_and_told(kind, seed, tmp_path) for seed in range(2))


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    ["bucket", "crane", *(pytest.param(x, marks=pytest.mark.long)
                          for x in ("four_bar", "rssr", "six_bar", "platform"))],
)  # fmt: skip
def test_no_silent_second_branch(kind, tmp_path):
    assert sum(assert_nearest_and_told(kind, seed, tmp_path) for seed in range(2, 9))


def test_whole_turns_come_out_where_limits_let_them():
    turn = 2 * np.pi
    q = np.array([0.2 + turn, 3.0, -3.0, 0.5 + 2 * turn, 1.0, 7.0])
    lower = np.array([-1.0, -np.inf, 2.0, 4.0, 2.0, -1.0])
    upper = np.array([1.0, np.inf, 4.0, 7.0, 3.0, 1.0])
    winds = np.array([True, True, True, True, True, False])
    found = remove_revolutions(q, np.array([0.0, -3.0, 0.0, 0.0, 0.0, 0.0]), winds, lower, upper)
    np.testing.assert_allclose(found, [0.2, 3 - turn, turn - 3, 0.5 + turn, 1.0, 7.0], atol=1e-14)
