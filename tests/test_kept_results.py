"""What is found once and kept between runs: home and structure of machines, motions of tasks."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.interpolate  # noqa: F401  what is spared
import scipy.linalg  # noqa: F401
from broken import DATA

import crane
from crane.codegen import kept_result, results
from crane.codegen.kept import place_of
from crane.common import cache
from crane.description import bundled

MINI = {
    "another length": {"changes": {"link3_G.x": 0.1}},
    "another payload": {"changes": {"payload.mass": 0.3}},
    "a lock": {"lock": {"q1": 0.2}},
    "another order": {"active": ("X2", "X1", "q1")},
    "a free joint": {"active": ("X1", "X2"), "free": ("q1",)},
}


@pytest.fixture
def fresh(monkeypatch):
    """Say that this is a process that has imported nothing."""

    def begin():
        monkeypatch.setattr(results, "sys", SimpleNamespace(modules={}))

    yield begin


def kept(place):
    return sorted(place.glob("[!.]*.result"))


def test_it_is_found_once(place):
    found = []

    def find():
        found.append(1)
        return {"x": np.array([0.1, np.nan, -0.0])}

    first = kept_result(("what", 1.0), find, "no.such.module")
    again = kept_result(("what", 1.0), find, "no.such.module")
    assert len(found) == len(kept(place)) == 1
    assert first["x"].tobytes() == again["x"].tobytes()
    kept_result(("what", 2.0), find, "no.such.module")
    assert len(found) == len(kept(place)) == 2
    kept(place)[0].write_bytes(b"damaged")
    for number in (1.0, 2.0):
        assert np.isnan(kept_result(("what", number), find, "no.such.module")["x"][1])
    assert len(found) == 3


def test_it_is_not_kept_where_its_module_is_there_already(place):
    found = []
    for _ in range(2):
        kept_result("what", lambda: found.append(1), "numpy")
    assert len(found) == 2 and not kept(place)


def test_what_fails_is_not_kept(place):
    def fail():
        raise crane.CraneError("no")

    for _ in range(2):
        with pytest.raises(crane.CraneError, match="no"):
            kept_result("what", fail, "no.such.module")
    assert not kept(place)


def test_another_build_of_what_finds_it_is_another_place(place, monkeypatch):
    kept_result("what", lambda: 1, "no.such.module")
    build = cache.build_of
    monkeypatch.setattr(cache, "build_of", _Newer(build("scipy")))
    assert kept_result("what", lambda: 2, "no.such.module") == 2


class _Newer:
    """No function of the tests', as which it would keep everything from being kept."""

    def __init__(self, build):
        self._build = build

    def __call__(self, package):
        time, size = self._build
        return time + (package == "scipy"), size


def variants():
    yield "mini_forwarder", {}
    yield from (("mini_forwarder", options) for options in MINI.values())
    for name in sorted(bundled()):
        if name != "mini_forwarder":
            yield name, {}
    for name in ("slider_crank.yaml", "five_bar.urdf", "stewart.urdf"):
        yield DATA / name, {}


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_machines_are_what_they_would_be_without(place, fresh):
    wanted = [crane.load(name, **options).closure for name, options in variants()]
    assert not kept(place)  # scipy is there
    fresh()
    counts = []
    for _ in range(2):
        for one, (name, options) in zip(wanted, variants(), strict=True):
            machine = crane.load(name, **options)
            assert _said(machine.closure.structure) == _said(one.structure), (name, options)
            assert machine.home.tobytes() == one.home.tobytes()
            assert _said(machine.closure.sought) == _said(one.sought)
        counts.append(len(kept(place)))
    assert counts[0] == counts[1] > len(MINI)


def _said(value):
    """Everything in it, to the last bit."""
    return repr(place_of(("all", value)))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_motions_are_what_they_would_be_without(place, fresh):
    wanted = [_moved(*one) for one in _tasks()]
    assert not kept(place)
    fresh()
    counts = []
    for _ in range(2):
        for one, motion in zip(_tasks(), wanted, strict=True):
            assert _moved(*one) == motion, (one[0].name, one[1])
        counts.append(len(kept(place)))
    found = [motion for motion in wanted if not isinstance(motion, str)]
    assert len(set(found)) <= counts[0] == counts[1]


def _tasks():
    """Machines that are new: where a search starts, its last bit depends on what was before."""
    some = [("mini_forwarder", options) for options in ({}, *MINI.values())]
    for name, options in (*some, ("patu655_grapple", {}), (DATA / "four_bar.yaml", {})):
        machine = crane.load(name, **options)
        for task, what in machine.tasks.items():
            if what.space != "joystick":
                yield machine, task
    mini = crane.load("mini_forwarder")
    longer = dataclasses.replace(mini.tasks["lift"], duration=9.0)
    yield dataclasses.replace(mini, tasks={"lift": longer}), "lift"
    yield dataclasses.replace(mini, upper=0.9 * mini.upper), "lift"


def _moved(machine, task):
    """The motion's numbers and those of its tip, or why there is none."""
    try:
        motion = crane.task_trajectory(machine, task)
    except crane.CraneError as error:
        return str(error)
    time = np.linspace(-0.1, motion.duration + 0.1, 37)
    tip = () if motion.tip is None else motion.tip(time)
    return motion.breaks().tobytes(), *(x.tobytes() for x in (*motion(time), *tip))
