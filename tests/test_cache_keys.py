"""Keys of cached programs contain everything that the formulas depend on."""

import copy
import dataclasses
import json
import os
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from test_compiled import dressed

import crane
from crane.closure import compiled_closure as loops
from crane.closure.constraint_tolerances import RedundancyGap
from crane.closure.kinematics_formulas import folding_pattern
from crane.codegen import Program
from crane.codegen.llvm.machine_code import emit_module
from crane.codegen.program_cache import cache_entry_name
from crane.dynamics import compiled_dynamics as quantities
from crane.motion.frame_kinematics import CompiledFrame, CompiledPoint

DATA = Path(__file__).parent / "data"
MACHINES = ("slider_crank.yaml", "five_bar.urdf", "stewart.urdf")
# what formulas may read of a machine: `CompiledClosure._cache_key` has it, or follows from what
# it has
READ = {
    "equations": {
        "axis_of_frame1", "axis_of_frame2", "is_translation", "loop_of_row", "sign",
        "coupling_factors", "coupling_offsets", "loops", "coordinates",
    },
    "coordinates": {"parents"},
    "loop": {"type"},
    "structure": {"independent_rows", "redundant_rows", "blocks", "redundancy"},
    "redundancy": {"tolerance"},
    "geometry": {
        "parents", "is_revolute", "floating_bases", "body_rotations", "constants", "frame_bodies",
        "reference_body", "series_of_body", "rotation_bodies", "massless_bodies",
        "supporting_bodies", "partly_active_joints",
    },
}  # fmt: skip


class Spy:
    """Something of a machine that tells what is read of it."""

    def __init__(self, inner, kind, seen):
        self.__dict__.update(_inner=inner, _kind=kind, _seen=seen)

    def __getattr__(self, name):
        if not name.startswith("__"):
            self._seen.add((self._kind, name))
        found = getattr(self._inner, name)
        if (self._kind, name) == ("equations", "loops"):
            return tuple(Spy(loop, "loop", self._seen) for loop in found)
        return Spy(found, name, self._seen) if name in READ else found


def load(name, **more):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", crane.CraneWarning)
        return crane.load(DATA / name if (DATA / name).exists() else name, **more)


def text(build):
    """The formulas that a program is built of."""
    program = Program()
    build(program)
    return emit_module(program.functions.values())


def formulas(machine, fast):
    """All kinds of formulas that come from a machine: name and what builds them."""
    dynamics = crane.Dynamics(machine)
    n = len(machine.active)
    yield "loops", lambda program: fast._build(program, fast._determinant_signs(fast._home))
    for name in quantities.QUANTITIES:
        rest = dynamics.constant_pattern, n, dynamics.formula_structure
        yield (
            name,
            lambda p, name=name, rest=rest: quantities.build_quantity(p, name, fast, *rest),
        )
    if machine.tip:
        for kind in (CompiledPoint, CompiledFrame):
            frame = kind(machine, machine.frame(machine.tip))
            frame._compiled_closure = fast
            yield kind.__name__, frame._build_program


@pytest.mark.parametrize("name", [*MACHINES, "mini_forwarder"])
def test_formulas_read_nothing_else(name):
    machine, seen = load(name), set()
    fast = copy.copy(machine.closure.compiled_closure)
    fast._equations = Spy(fast._equations, "equations", seen)
    fast._structure = Spy(fast._structure, "structure", seen)
    fast.geometry = Spy(fast.geometry, "geometry", seen)
    for _, build in formulas(machine, fast):
        text(build)
    assert not {(kind, name) for kind, name in seen if name not in READ[kind]}


def keys(fast, equations=None, structure=None, geometry=None, signs=None, **own):
    """The key of the loops with some of what it is made of changed."""
    other = copy.copy(fast)
    other._equations, other._structure, other.geometry = (
        copy.copy(x) for x in (fast._equations, fast._structure, fast.geometry)
    )
    for part, changes in (
        (other._equations, equations), (other._structure, structure), (other.geometry, geometry),
    ):  # fmt: skip
        for attribute, value in (changes or {}).items():
            object.__setattr__(part, attribute, value)
    for attribute, value in own.items():
        setattr(other, attribute, value)
    return other._cache_key(fast._determinant_signs(fast._home) if signs is None else signs)


def alone(part, owner, *names):
    """Changes of some attributes, one at a time."""
    return [{part: {name: changed(getattr(owner, name))}} for name in names]


def changed(value):
    """Another value of the same kind."""
    if isinstance(value, tuple):
        return (*value[:-1], changed(value[-1]))
    array = np.array(value)
    array.flat[-1] = not array.flat[-1] if array.dtype == bool else array.flat[-1] + 1
    return array if isinstance(value, np.ndarray) else array.item()


def test_whatever_changes_of_a_machine_changes_the_key(place, tmp_path):
    fast = load("stewart.urdf").closure.compiled_closure
    coupled = load_coupled(tmp_path).closure.compiled_closure
    equations, structure, geometry = fast._equations, fast._structure, fast.geometry
    (rows, columns), *blocks = structure.blocks
    loop = dataclasses.replace(equations.loops[0], type="fixed")
    different = [
        *alone(
            "equations",
            equations,
            "axis_of_frame1",
            "axis_of_frame2",
            "is_translation",
            "loop_of_row",
            "sign",
        ),
        *alone("geometry", geometry, "parents", "is_revolute", "body_rotations", "frame_bodies"),
        {"equations": {"loops": (loop, *equations.loops[1:])}},
        {"structure": {"independent_rows": structure.independent_rows[::-1]}},
        {"structure": {"redundant_rows": np.append(structure.redundant_rows, 0)}},
        {"structure": {"blocks": ((rows[::-1], columns), *blocks)}},
        {"structure": {"blocks": ((rows, columns[::-1]), *blocks)}},
        {"structure": {"blocks": (*structure.blocks, (rows, columns))}},
        {"structure": {"redundancy": RedundancyGap(2.0 * structure.redundancy.tolerance)}},
        {"geometry": {"floating_bases": (1,)}},
        {"geometry": {"rotation_bodies": (1,)}},
        {"_active_columns": fast._active_columns[::-1]},
        {"_passive_columns": fast._passive_columns[::-1]},
        {"signs": -fast._determinant_signs(fast._home)},
    ]
    for index in (0, 9, -1):
        for value in (0.0, 1.0, -1.0, -0.0, 0.5):
            numbers = with_entry(geometry.constants, index, value)
            if folding_pattern(numbers) != folding_pattern(geometry.constants):
                different.append({"geometry": {"constants": numbers}})
    places = [
        cache_entry_name(keys(fast)),
        *(cache_entry_name(keys(fast, **change)) for change in different),
    ]
    for name in ("coupling_factors", "coupling_offsets"):
        values = changed(getattr(coupled._equations, name))
        places.append(cache_entry_name(keys(coupled, equations={name: values})))
    places.append(cache_entry_name(keys(coupled)))
    same = [different[i - 1] for i in range(1, len(places)) if places[i] in places[:i]]
    assert None not in places and not same and len(places) > 25
    assert cache_entry_name(keys(fast)) == places[0]


def load_coupled(folder):
    """A five-bar one of whose cranks follows the other."""
    text = (DATA / "five_bar.urdf").read_text()
    text = text.replace(
        '<joint name="b" type="continuous" independent="true">',
        '<joint name="b" type="continuous"><mimic joint="a" multiplier="1.5" offset="0.2"/>',
    )
    path = folder / "coupled.urdf"
    path.write_text(text)
    return load(path, active=["a"])


def with_entry(values, index, value):
    out = values.copy()
    out[index] = value
    return out


SPECIAL = (0.0, -0.0, 1.0, -1.0, 2.0, 0.3, -0.7, np.nan, np.inf, 1e300)


@pytest.mark.parametrize("name", ["loops", "inverse with friction", "energy", "regressor"])
def test_numbers_that_are_not_told_change_no_formula(name, dressed_crank):
    """Where numbers say the same to the key, the formulas are the same to the letter."""
    fast, dynamics = dressed_crank.closure.compiled_closure, crane.Dynamics(dressed_crank)
    base = fast.geometry.constants if name == "loops" else dynamics.formula_constants
    random, texts = np.random.default_rng(3), {}
    for _ in range(60):
        some = random.integers(len(base), size=random.integers(1, 4))
        for values in (base, with_entry(base, some, random.choice(SPECIAL, len(some)))):
            texts.setdefault(folding_pattern(values), set()).add(
                text_with(name, fast, dynamics, values)
            )
    for some in random.integers(len(base), size=20):  # and with numbers that are no special ones
        values = with_entry(base, some, base[some] * 1.25)
        texts.setdefault(folding_pattern(values), set()).add(
            text_with(name, fast, dynamics, values)
        )
    assert len(texts) > 30 and all(len(same) == 1 for same in texts.values())


def text_with(name, fast, dynamics, values):
    """The formulas where a machine has other numbers."""
    other = copy.copy(fast)
    if name == "loops":
        other.geometry = dataclasses.replace(fast.geometry, constants=values)
        try:
            return text(lambda program: other._build(program, fast._determinant_signs(fast._home)))
        except ZeroDivisionError:  # no machine
            return "singular"
    rest = values, len(dynamics.machine.active), dynamics.formula_structure
    return text(lambda program: quantities.build_quantity(program, name, fast, *rest))


@pytest.fixture(scope="module")
def dressed_crank():
    return dressed(load("slider_crank.yaml"))


def variants(folder):
    """Machines that share as much as machines can that differ."""
    crank = load("slider_crank.yaml")
    flat = load("mini_forwarder")
    for number, (old, new) in enumerate(
        (
            ("", ""), ("type: revolute", "type: spherical"), ("active: [theta]", "active: [phi]"),
            ("active: [theta]", "active: [s]"), ("phi: -0.5, s: 0.37", "phi: -2.6, s: -0.3"),
            ("rod_middle", "rod_eye"),
        )
    ):  # fmt: skip
        text = (DATA / "slider_crank.yaml").read_text().replace("urdf: ", f"urdf: {DATA}/")
        path = folder / f"{number}.yaml"
        path.write_text(text.replace(old, new) if old else text)
        yield load(path)
    yield from (dressed(crank, 3), dressed(crank, 4))
    yield crank.with_payload(crane.Payload(crank.tip, 2.0))
    urdf = (DATA / "five_bar.urdf").read_text()
    for old, new in (
        ("", ""), ('xyz="0.4 0 0" rpy', 'xyz="0.4 0.1 0" rpy'),
        ('mass value="0.4"', 'mass value="1"'),
        ('<axis xyz="0 0 1"/>\n  </joint>\n  <joint name="b"',
         '<axis xyz="0 0 -1"/>\n  </joint>\n  <joint name="b"'),
        ("0 0 -0.4", "0 0 1.6"),
    ):  # fmt: skip
        assert old in urdf
        path = folder / "five_bar.urdf"
        path.write_text(urdf.replace(old, new) if old else urdf)
        yield load(path)
    path.write_text(urdf)
    yield from (load(path, active=names) for names in (["b", "a"], ["a", "c"], ["c", "d"]))
    yield load_coupled(folder)
    yield load("stewart.urdf")
    yield flat
    yield flat.with_payload(crane.Payload(flat.tip, 0.3))


def results(machine):
    """Some of all that machine code computes, and the same without."""
    out, again, rng = [], [], np.random.default_rng(5)
    home = machine.home[machine.closure.active]
    n = len(home)
    q_a = home + np.linspace(-5e-4, 5e-4, 4)[:, None]
    v_a, x = rng.normal(size=(2, 4, n))
    for formulation in ("exact", "decoupled"):
        one, two = (
            crane.Dynamics(machine, formulation, backend) for backend in ("compiled", "pinocchio")
        )
        assert one.backend == "compiled"
        for name in quantities.QUANTITIES if formulation == "exact" else ("inverse", "forward"):
            q = machine.closure.solve(q_a)
            out.append(one.evaluate_closed(name, q, v_a, x))
            again.append(two.evaluate_closed(name, q, v_a, x).reshape(out[-1].shape))
    q = machine.closure.solve(q_a)
    out.append(machine.closure.gamma(q))
    again.append(np.array([machine.closure.motion(row, np.zeros(n))[0] for row in q]))
    if machine.tip is not None:
        tip = crane.Kinematics(machine)
        out += [tip.position(q_a), tip.jacobian(q_a), tip.bias(q_a, v_a)]
        again += [
            np.array([function(*row) for row in zip(*given, strict=True)])
            for function, *given in (
                (tip.position, q_a), (tip.jacobian, q_a), (tip.bias, q_a, v_a),
            )
        ]  # fmt: skip
    return out, again


def counted(kept, built, depends, build):
    """`Program.from_cache`, and what it depends on if it has to be built."""

    def told(program):
        built.append(depends)
        build(program)

    return kept(depends, told)


@pytest.mark.slow
@pytest.mark.long
def test_machines_that_differ_are_right_from_one_folder(place, tmp_path, monkeypatch):
    """Each machine finds only its own programs, and all of them the second time."""
    built, first = [], []
    # something of the standard library, so that the package does not look patched
    monkeypatch.setattr(Program, "from_cache", partial(counted, Program.from_cache, built))
    loops._SHARED_CODE.clear()  # machines of other tests may still be there
    for number, machine in enumerate(variants(tmp_path)):
        found, wanted = results(machine)
        for one, two in zip(found, wanted, strict=True):
            size = np.abs(two).max(initial=1e-12)
            assert np.abs(one - two).max(initial=0.0) <= 1e-9 * size, (number, machine)
        first.append(found)
    assert len(built) > 100
    built.clear()
    loops._SHARED_CODE.clear()
    for machine, found in zip(variants(tmp_path), first, strict=True):
        assert all(map(np.array_equal, results(machine)[0], found))
    assert not built


EVERYTHING = """
import json, sys, warnings
import numpy as np
import crane
from crane.codegen.program_cache import ProgramRecord
from crane.common import file_cache
warnings.simplefilter("ignore")
crane.LOADED += 3600.0
import test_cache_keys
notes = {}
for name in sys.argv[1:]:
    machine = test_cache_keys.load(name)
    for formulation in ("exact", "decoupled"):
        dynamics = crane.Dynamics(machine, formulation)
        for quantity in ("inverse with friction", "forward", "observation", "regressor"):
            dynamics.backend_of(quantity)
    if machine.tip:
        tip = crane.Kinematics(machine)
        tip._compiled_frame, tip._compiled_point
    crane.simulate(machine, duration=0.002)
    for name, task in machine.tasks.items():
        if task.space == "joystick":
            controllers = [crane.joystick(machine, name)]
        else:
            reference = crane.task_trajectory(machine, name)
            controllers = [crane.ComputedTorque(machine, reference)]
            usual = crane.control.default_controller_name(machine)
            controllers.append(crane.control.make_controller(usual, machine, reference))
        for controller in controllers:
            crane.simulate(machine, controller, duration=0.002)
for file in sorted(file_cache.cache_folder().glob("*.note")):
    note = ProgramRecord.from_cache(file.name)
    notes[file.name] = [note.code_name, note.max_formula_length, repr(note.signatures)]
print(json.dumps(notes))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        ("slider_crank.yaml", "stewart.urdf"),
        pytest.param(
            ("kr300", "mini_forwarder", "patu655", "five_bar.urdf"), marks=pytest.mark.long
        ),
    ],
)
def test_what_is_kept_is_what_would_be_traced_now(names, tmp_path):
    """Processes of their own, in other orders, one machine each: equal notes under equal names."""

    def notes(folder, seed, *machines):
        here = Path(__file__).parent
        paths = os.pathsep.join(map(str, (here, Path(crane.__file__).parents[1])))
        environment = os.environ | {"PYTHONPATH": paths, "PYTHONHASHSEED": str(seed)}
        environment["XDG_CACHE_HOME"] = str(tmp_path / folder)
        command = [sys.executable, "-c", EVERYTHING, *machines]
        run = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert not run.returncode, run.stderr
        return json.loads(run.stdout)

    together = notes("all", 1, *names)
    assert len(together) > 5 * len(names)
    alone = [notes(name, 2, name) for name in names]
    for some in alone:
        assert some.items() <= together.items()
    assert set().union(*alone) == set(together)
    assert notes("all", 3, *reversed(names)) == together  # nothing new, nothing changed
