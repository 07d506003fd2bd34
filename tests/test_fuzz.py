"""Files with changed bytes and with odd graphs are read, or refused in one line.

`fuzz.py` demands an error of the package or a closed machine within a bound on the executed lines,
and the same machine as before exactly if another parser finds the same words and numbers in the
file. `fuzz_graphs.py` demands that every cycle of a graph that is no tree is reported.
"""

import copy
import random
import warnings
from pathlib import Path

import pytest
import yaml
from fuzz_process import judge

import crane
from crane.common.errors import CraneError
from crane.description.machine_lookup import bundled_machines

FORMATS = ("machine", "urdf", "urdf+", "parallel", "mjcf", "sdf", "xacro")
GRAPHS = FORMATS[:-1]


def run(kind, first, count, program="fuzz.py"):
    if kind in ("mjcf", "xacro"):
        pytest.importorskip({"mjcf": "mujoco"}.get(kind, kind))
    if kind == "xacro":  # each in a process of its own
        first, count = first // 10, count // 10
    assert judge(program, kind, first, count) == count


@pytest.mark.slow
@pytest.mark.parametrize("count", [25, pytest.param(200, marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", GRAPHS)
def test_odd_graphs(kind, count):
    run(kind, 0, count, "fuzz_graphs.py")


@pytest.mark.slow
@pytest.mark.parametrize(("first", "count"), [
    (30, 30), pytest.param(0, 700, marks=pytest.mark.long),
    pytest.param(2500, 700, marks=pytest.mark.long),
])  # fmt: skip
@pytest.mark.parametrize("kind", FORMATS)
def test_more_changed_files(kind, first, count):
    """Still more by hand: python tests/fuzz.py KIND FIRST COUNT."""
    run(kind, first, count)


# --- options ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_calls_that_were_reported():
    assert judge("fuzz_options.py", "reported") > 30


@pytest.mark.slow
@pytest.mark.parametrize("part", (0, 1, 2, 3))
@pytest.mark.long
def test_options_at_the_edge(part):
    assert judge("fuzz_options.py", 1000 + 250 * part, 20) == 20


# --- damaged inputs -----------------------------------------------------------------------------


COUNTS = {"visuals": 120, "meshes": 10, "npz": 50, "csv": 90}  # meshes: 20 files each


def judge_inputs(kind, first, count):
    pytest.importorskip("resource")  # not on Windows
    assert judge("fuzz_inputs.py", kind, first, count) == count


@pytest.mark.slow
@pytest.mark.parametrize("part", [16, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", COUNTS)
def test_damaged_inputs(kind, part):
    judge_inputs(kind, 0, COUNTS[kind] // part)


# --- changed values of machine files ------------------------------------------------------------


VALUES = ("two", [1, 2], {"strange": 1}, True, None, -1, 0, 1e30, "", [])
# a posture, a link or a pin that was changed, and where the loops do not close any more
_OPEN = "stays open", "cannot be closed", "it stays"


class _Plain(yaml.SafeDumper):
    def ignore_aliases(self, data):
        return True


def places(node, way=()):
    """Ways down to all values of a YAML document, with the lines that they take up."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            inner = (*way, key.value)
            yield inner, key.start_mark.line + 1, max(value.end_mark.line, key.start_mark.line + 1)
            yield from places(value, inner)
    elif isinstance(node, yaml.SequenceNode):
        for i, value in enumerate(node.value):
            inner = (*way, i)
            first = value.start_mark.line + 1
            yield inner, first, max(value.end_mark.line, first)
            yield from places(value, inner)


def mutated(data, way, value):
    """A copy with another value."""
    data = inner = copy.deepcopy(data)
    for key in way[:-1]:
        inner = inner[key]
    inner[way[-1]] = value
    return data


def verdict(folder, name, data, way, value):
    """What is wrong about what is said of a mutation, else None."""
    path = folder / f"{name}.yaml"
    path.write_text(yaml.dump(mutated(data, way, value), Dumper=_Plain, sort_keys=False))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            report = crane.check(path)
        except CraneError as error:  # a line on its own
            return None if str(error).isprintable() else repr(str(error))
    where = {inner: (first, last) for inner, first, last in places(yaml.compose(path.read_text()))}
    first, last = where[way]
    outer = {where[way[:i]][0] for i in range(1, len(way))} | {1}
    words = {key.removesuffix("s") for key in way if isinstance(key, str)} | {str(value)}
    for found in report.findings:
        if not found.is_error or any(text in found.message for text in _OPEN):
            continue
        here = found.file == path.name and (first <= found.line <= last or found.line in outer)
        if not here and not any(word in found.message for word in words if word):
            return f"{way} = {value!r}: {found}"
    return None


def cases(name, count, seed):
    """Ways and values of a machine file, all of them or some."""
    data = yaml.safe_load(Path(bundled_machines()[name]).read_text())
    ways = [way for way, *_ in places(yaml.compose(yaml.dump(data, Dumper=_Plain)))]
    kept = [x for x in VALUES if x is not None or "extends" not in data]
    every = [(way, value) for way in ways for value in kept]
    rng = random.Random(seed)
    return data, every if count is None else rng.sample(every, min(count, len(every)))


def judge_mutations(tmp_path, name, count, seed=0):
    source = Path(bundled_machines()[name]).parent
    (tmp_path / "urdf").symlink_to(source / "urdf")
    data, chosen = cases(name, count, seed)
    if "extends" in data and not (tmp_path / data["extends"]).exists():
        data["extends"] = data["extends"].removesuffix(".yaml")  # bundled
    wrong = [text for way, value in chosen if (text := verdict(tmp_path, name, data, way, value))]
    assert not wrong, "\n".join(wrong[:40])


@pytest.mark.slow
@pytest.mark.parametrize("count", [25, pytest.param(None, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", sorted(bundled_machines()))
def test_mutations(tmp_path, name, count):
    judge_mutations(tmp_path, name, count, seed=1)
