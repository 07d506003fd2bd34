"""Cached programs and results are found by their keys, also after damage to the files."""

import dataclasses
import os
import pickle
import shutil
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cached_program
import llvmlite.binding as llvm
import numpy as np
import pytest
import scipy.interpolate  # noqa: F401  what is spared
import scipy.linalg  # noqa: F401
from broken_machines import DATA
from executed_lines import at_most

import crane
import crane.closure.compiled_closure
import crane.dynamics.compiled_dynamics
import crane.dynamics.joint_force_formulas
from crane.closure.constraint_tolerances import RedundancyGap
from crane.closure.kinematics_formulas import PositionKinematics
from crane.codegen import FormulaTooLongError, cached_result, program, program_cache
from crane.codegen.llvm import machine_code
from crane.codegen.program_cache import cache_entry_name
from crane.common import file_cache
from crane.common.serialization import serialize
from crane.description import bundled_machines
from crane.dynamics.dynamics_formulas import DynamicsFormulas

PACKAGE = Path(crane.__file__).parent


@contextmanager
def another_processor():
    """One whose code happens to run here too."""

    class NoFeatures:
        def flatten(self):
            return ""

    def ask_again():
        machine_code.host_cpu.cache_clear()
        machine_code.compiler_settings.cache_clear()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(llvm, "get_host_cpu_name", lambda: "generic")
        patch.setattr(llvm, "get_host_cpu_features", NoFeatures)
        ask_again()
        yield
    ask_again()


def ask(factor=3.0):
    """Whether the program had to be built; its numbers are right either way."""
    built = []
    got = cached_program.value(cached_program.toy(factor, built))
    assert got == pytest.approx(cached_program.wanted(factor), rel=1e-12)
    return bool(built)


def files(place, kind="*"):
    return sorted(file for file in place.glob(f"*.{kind}") if not file.name.startswith("."))


def child(place, *arguments, **more):
    """The same in another process."""
    environment = os.environ | {"XDG_CACHE_HOME": str(place.parent.parent)}
    environment |= {"PYTHONPATH": str(more.get("package", PACKAGE).parent)}
    return subprocess.Popen(
        [sys.executable, cached_program.__file__, *map(str, arguments)],
        env=environment | more.get("env", {}),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def answer(process):
    out, error = process.communicate(timeout=300)
    assert process.returncode == 0 and not error, error
    return out.strip()


def test_a_later_program_is_found(place):
    assert ask() and not ask()
    assert ask(4.0) and not ask(4.0) and not ask()
    assert len(files(place, "note")) == len(files(place, "code")) == 2


def test_what_is_found_is_called_as_what_was_built(place):
    one, two = cached_program.toy(), cached_program.toy()
    assert two.formula_outputs("formula") == one.formula_outputs(
        "formula"
    ) and two.function_address("each")
    assert two.max_formula_length == one.max_formula_length > cached_program.LONG
    with pytest.raises(TypeError, match="'each' takes 3 arguments, not 2"):
        two.call("each", 1, np.zeros(2))
    with pytest.raises(KeyError):
        two.call("nothing", 1)


def test_other_processes_find_it(place):
    """The key does not depend on the order of sets."""
    assert answer(child(place, "late")) == "built"
    for seed in "12":
        assert answer(child(place, "late", env={"PYTHONHASHSEED": seed})) == "found"
    assert not ask()


def test_a_formula_that_is_too_long_is_known_to_be(place, monkeypatch):
    monkeypatch.setattr(program, "MAX_OPERATIONS", 100)
    built = []
    for _ in range(2):
        with pytest.raises(FormulaTooLongError):
            cached_program.toy(built=built)
    assert len(built) == 1
    monkeypatch.setattr(program, "MAX_OPERATIONS", 10_000)
    assert ask() and not ask()
    monkeypatch.setattr(program, "MAX_OPERATIONS", 100)
    with pytest.raises(FormulaTooLongError):
        ask()


def test_places_are_apart_where_programs_are(place):
    @dataclass(frozen=True)
    class Pair:
        one: object
        two: object

    told = [
        1, 1.0, True, "1", b"1", (1,), ((1,),), (1, 2), ((1, 2),), (1, (2,)), 0.0, -0.0, "",
        np.array([1]), np.array([1.0]), np.array([[1.0]]), np.array([1, 0]), np.array([[1], [0]]),
        np.int32(1), np.zeros(0), np.zeros((0, 1)), np.array([-0.0]), np.array([0.0]),
        Pair(1, 2), Pair(2, 1), Pair(1, (2,)), ("a", "b"), ("a, b",), ("a'", "b"), ("a", "'b"),
    ]  # fmt: skip
    places = [cache_entry_name(("toy", x)) for x in told]
    assert None not in places and len({*places}) == len(places)
    assert places == [cache_entry_name(("toy", x)) for x in told]
    assert cache_entry_name(None) is None


@pytest.mark.parametrize(
    "value", [object(), len, lambda: 0, [1], {1}, {1: 2}, Path(), int, np.array([object()])]
)
def test_what_says_nothing_lasting_is_refused(place, value):
    with pytest.raises(TypeError, match="cannot be written as data"):
        cache_entry_name(("toy", (1, value)))


DAMAGES = {
    "empty": lambda data: b"",
    "half of the digest": lambda data: data[:16],
    "digest alone": lambda data: data[:32],
    "cut": lambda data: data[:-1],
    "longer": lambda data: data + b"\0",
    "zeros": lambda data: bytes(len(data)),
    "bit of the digest": lambda data: flipped(data, 7),
    "bit of the beginning": lambda data: flipped(data, 33),
    "bit of the middle": lambda data: flipped(data, len(data) // 2),
    "bit of the end": lambda data: flipped(data, len(data) - 1),
}


def flipped(data, at):
    changed = bytearray(data)
    changed[at] ^= 1
    return bytes(changed)


@pytest.mark.parametrize("kind", ["note", "code"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_made_anew(place, kind, damage):
    assert ask()
    whole = {file: file.read_bytes() for file in files(place)}
    (file,) = files(place, kind)
    file.write_bytes(DAMAGES[damage](whole[file]))
    assert ask() and not ask()
    assert {file: file.read_bytes() for file in files(place)} == whole


@pytest.mark.parametrize("kind", ["note", "code"])
def test_missing_files_are_made_anew(place, kind):
    assert ask()
    (file,) = files(place, kind)
    file.unlink()
    assert ask() and not ask()


def test_files_of_another_name_are_not_taken(place):
    """A complete file of another program is rejected as well."""
    assert ask()
    one = {file.suffix: file for file in files(place)}
    assert ask(4.0)
    for file in files(place):
        if file not in one.values():
            shutil.copy(file, one[file.suffix])
    assert ask() and not ask()
    assert not ask(4.0)


def test_another_processor_has_its_own_files(place):
    assert ask()
    own = {file: file.read_bytes() for file in files(place)}
    with another_processor():
        assert ask() and not ask()
    others = {file.suffix: file.read_bytes() for file in files(place) if file not in own}
    assert len(others) == 2 and not ask()
    for file in own:  # under the names of ours
        file.write_bytes(others[file.suffix])
    assert ask() and not ask()
    assert {file: file.read_bytes() for file in own} == own


def test_what_the_user_may_not_write_is_not_kept(place):
    place.parent.mkdir(parents=True)
    place.write_text("a file")
    assert ask() and ask()
    assert place.read_text() == "a file"


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_folder_that_others_may_write_is_not_read(place):
    assert ask()
    place.chmod(0o777)
    assert ask()
    place.chmod(0o700)
    assert not ask()


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="nobody is root here")
def test_a_folder_that_may_only_be_read_serves(place):
    """Programs work also if the folder is full or cannot be written."""
    assert ask()
    place.chmod(0o500)

    def refused(*_, **__):
        raise PermissionError(13, "not allowed")

    with pytest.MonkeyPatch.context() as patch:  # root may all the same
        patch.setattr(os, "utime", refused)
        patch.setattr(os, "replace", refused)
        assert not ask() and ask(4.0) and ask(4.0)
    place.chmod(0o700)
    assert len(files(place)) == 2 and not list(place.glob(".*"))


def test_the_folder_is_bounded(place, monkeypatch):
    ask()
    one = sum(file.stat().st_size for file in place.iterdir())
    killed = place / ".left.1.part"
    killed.write_bytes(bytes(one))
    (place / "folder").mkdir()
    monkeypatch.setattr(file_cache, "MAX_CACHE_SIZE", 4 * one)
    monkeypatch.setattr(file_cache, "_remaining_bytes", {})  # a process that has not looked yet
    for factor in range(4, 12):
        for file in place.iterdir():  # a while later
            os.utime(file, (file.stat().st_mtime - 10,) * 2)
        assert ask(float(factor)) and not ask(float(factor))
        assert not ask()  # used each time
        assert sum(file.stat().st_size for file in place.iterdir() if file.is_file()) <= 4 * one
    assert not killed.exists() and ask(4.0)


@pytest.fixture
def objects(tmp_path, monkeypatch):
    folder = tmp_path / "objects"
    monkeypatch.setattr(file_cache, "cache_folder", lambda: folder)
    return folder


def test_what_was_used_least_lately_makes_room(objects, monkeypatch):
    monkeypatch.setattr(file_cache, "MAX_CACHE_SIZE", 400)  # three of them
    for number, name in enumerate("abc"):
        file_cache.cached_object_code(name, lambda: b"x" * 100)
        for file in objects.iterdir():
            if file.stat().st_mtime > 1e9:
                os.utime(file, (number, number))
    first = file_cache.cached_object_code("a", lambda: b"never")  # used now
    file_cache.cached_object_code("d", lambda: b"y" * 100)
    left = {file.read_bytes()[-1:] for file in objects.iterdir()}
    assert first == b"x" * 100 and left == {b"x", b"y"}
    assert file_cache.cached_object_code("a", lambda: b"gone") == first
    assert file_cache.cached_object_code("b", lambda: b"gone") == b"gone"


def test_the_folder_is_not_looked_through_each_time(objects, monkeypatch):
    looks, look = [], file_cache._cache_files

    def counted(folder):
        looks.append(folder)
        return look(folder)

    monkeypatch.setattr(file_cache, "_cache_files", counted)
    monkeypatch.setattr(file_cache, "MAX_CACHE_SIZE", 64 * 132)  # with their digests
    for number in range(100):
        file_cache.cached_object_code(str(number), lambda: b"x" * 100)
        assert len(list(objects.iterdir())) == min(number + 1, 64 - (63 - number) % 4)
    assert len(looks) == 25


def test_processes_that_compile_at_once(place):
    """Each process has a correct program, and the files are complete."""
    at_once = [child(place, "late") for _ in range(4)]
    assert set(map(answer, at_once)) <= {"built", "found"}
    assert len(files(place)) == 2 and len(list(place.iterdir())) == 2
    assert answer(child(place, "late")) == "found"


@pytest.mark.parametrize("count", [1, 2])
def test_a_killed_process_leaves_nothing_that_harms(place, count):
    process = child(place, "late", "die", count)
    process.communicate(timeout=300)
    assert process.returncode < 0
    assert len(files(place)) == count - 1 and len(list(place.glob(".*"))) == 1
    assert answer(child(place, "late")) == "built"
    assert answer(child(place, "late")) == "found"


def test_a_changed_package_finds_nothing(place, tmp_path):
    """Every change counts, also one that keeps the length and time of a file."""
    copy = tmp_path / "again" / "crane"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__", "models"))

    def run(*arguments):
        return answer(child(place, *arguments, package=copy, env={"PYTHONDONTWRITEBYTECODE": "1"}))

    assert run() == "built"  # just changed: who knows what was loaded
    assert not files(place, "note")
    assert run("late") == "built" and run("late") == "found"
    file = copy / "dynamics" / "dynamics_formulas.py"
    text, times = file.read_text(), file.stat()
    changed = text.replace("Dynamics", "dynamics", 1)
    assert len(changed) == len(text) and changed != text
    file.write_text(changed)
    os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert run("late") == "built" and run("late") == "found"
    file.write_text(text)
    assert run("late") == "found"
    (copy / "codegen" / "new.py").write_text("")
    assert run("late") == "built"


def test_a_package_that_changes_meanwhile_keeps_nothing(place, monkeypatch):
    class Changing(list):
        """As if all files became newer than what was loaded while a program is built."""

        def append(self, _):
            monkeypatch.setattr(crane, "LOADED", 0.0)

    cached_program.toy(built=Changing())
    assert not files(place, "note")


def test_a_package_that_changed_before_it_was_read_finds_nothing(place, monkeypatch):
    """Programs are not taken from the cache if the files are newer than the loaded package."""
    assert ask() and not ask()
    monkeypatch.setattr(crane, "LOADED", 0.0)
    program_cache._files_digest.cache_clear()
    assert ask() and ask()


def another(*_):
    return 0.0


@pytest.mark.parametrize(
    "owner, name, value",
    [
        (crane.dynamics.joint_force_formulas, "evaluate_force_law", another),
        (DynamicsFormulas, "mass_matrix", property(another)),
        (PositionKinematics, "loop_frame", staticmethod(another)),
        (DynamicsFormulas, "kinetic", cached_property(another)),
        (machine_code, "_target_machine", lambda: None),
        (crane.closure.compiled_closure, "LoopFormulas", type("LoopFormulas", (), {})),
        (crane.dynamics.compiled_dynamics, "QUANTITIES", {"inverse": another}),
    ],
)
def test_a_patched_package_finds_nothing(place, owner, name, value):
    assert ask() and not ask()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(owner, name, value)
        assert program_cache.package_digest() is None
    assert not ask()


def test_nor_does_one_with_another_entry_or_module(place, monkeypatch):
    assert ask() and not ask()
    table = crane.dynamics.compiled_dynamics.QUANTITIES
    with monkeypatch.context() as patch:
        patch.setitem(table, next(iter(table)), another)
        assert program_cache.package_digest() is None
    other = ModuleType("crane.dynamics.compiled_dynamics")
    other.effects = another
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, other.__name__, other)
        assert program_cache.package_digest() is None
    assert program_cache.package_digest()


# --- results: homes, structures, motions --------------------------------------------------------


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
