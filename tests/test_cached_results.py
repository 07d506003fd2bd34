"""Cached results: home and structure of machines, motions of tasks."""

import dataclasses
import pickle
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.interpolate  # noqa: F401  what is spared
import scipy.linalg  # noqa: F401
from broken_machines import DATA
from executed_lines import at_most

import crane
from crane.closure.constraint_tolerances import RedundancyGap
from crane.codegen import cached_result, program_cache
from crane.codegen.program_cache import cache_entry_name
from crane.common import file_cache
from crane.common.serialization import serialize
from crane.description import bundled_machines

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
        monkeypatch.setattr(program_cache, "sys", SimpleNamespace(modules={}, version=sys.version))

    yield begin


def kept(place):
    return sorted(place.glob("[!.]*.result"))


def test_it_is_found_once(place):
    found = []

    def find():
        found.append(1)
        return ("x", np.array([0.1, np.nan, -0.0]))

    first = cached_result(("what", 1.0), find, "no.such.module", ())
    again = cached_result(("what", 1.0), find, "no.such.module", ())
    assert len(found) == len(kept(place)) == 1
    assert first[0] == again[0] and first[1].tobytes() == again[1].tobytes()
    cached_result(("what", 2.0), find, "no.such.module", ())
    assert len(found) == len(kept(place)) == 2
    kept(place)[0].write_bytes(b"damaged")
    for number in (1.0, 2.0):
        assert np.isnan(cached_result(("what", number), find, "no.such.module", ())[1][1])
    assert len(found) == 3


def test_it_is_not_kept_where_its_module_is_there_already(place):
    found = []
    for _ in range(2):
        cached_result("what", lambda: found.append(1), "numpy", ())
    assert len(found) == 2 and not kept(place)


def test_what_fails_is_not_kept(place):
    def fail():
        raise crane.CraneError("no")

    for _ in range(2):
        with pytest.raises(crane.CraneError, match="no"):
            cached_result("what", fail, "no.such.module", ())
    assert not kept(place)


def test_another_build_of_what_finds_it_is_another_place(place, monkeypatch):
    cached_result("what", lambda: 1, "no.such.module", ())
    build = file_cache.package_build
    monkeypatch.setattr(file_cache, "package_build", _Newer(build("scipy")))
    assert cached_result("what", lambda: 2, "no.such.module", ()) == 2


class _Newer:
    """No function of the tests', as which it would keep everything from being kept."""

    def __init__(self, build):
        self._build = build

    def __call__(self, package):
        time, size = self._build
        return time + (package == "scipy"), size


@pytest.mark.parametrize("content", [b"", b"12345678{", serialize(RedundancyGap())])
def test_an_entry_that_cannot_be_read_is_made_anew(place, content):
    cached_result("what", lambda: (1.0, None), "no.such.module", ())
    name = kept(place)[0].name
    file_cache.write_entry(name, content)
    assert cached_result("what", lambda: (2.0, None), "no.such.module", ()) == (2.0, None)
    assert cached_result("what", lambda: (3.0, None), "no.such.module", ()) == (2.0, None)


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_a_single_call_takes_the_short_way_in_a_later_process(place, fresh):
    """Arrays that are read from a file have numpy's type."""
    fresh()
    for name in ("mini_forwarder", "patu655", "excavator", "kr300"):
        lines = []
        for _ in range(3):
            machine = crane.load(name)
            dynamics = crane.Dynamics(machine)
            q = machine.home[machine.closure.active]
            v, tau = np.zeros_like(q), dynamics.gravity(q)
            dynamics.forward(q, v, tau)
            with at_most(1000) as work:
                found = dynamics.forward(q, v, tau)
            lines.append(work.lines)
            assert machine.home.dtype is np.dtype(np.float64)
        assert lines[0] == lines[1] == lines[2], (name, lines)
        unpickled = [pickle.loads(pickle.dumps(x)) for x in (q, v, tau)]
        assert unpickled[0].dtype is not np.dtype(np.float64)  # as of a worker, or a copy of one
        with at_most(1000) as work:
            assert (dynamics.forward(*unpickled) == found).all()
        assert work.lines == lines[0], name


def variants():
    yield "mini_forwarder", {}
    yield from (("mini_forwarder", options) for options in MINI.values())
    for name in sorted(bundled_machines()):
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
            assert _said(machine.closure.home_search) == _said(one.home_search)
        counts.append(len(kept(place)))
    assert counts[0] == counts[1] > len(MINI)


def _said(value):
    """Everything in it, to the last bit."""
    return repr(cache_entry_name(("all", value)))


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
