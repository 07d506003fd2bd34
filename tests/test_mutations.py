"""Any changed value in a bundled machine file causes errors at its own place only.

An error is true if it points at what was changed, at what that is part of, or names it: a value
that is right by itself may not fit others. All else would follow from the error that was told.
Nothing in place of what a variant extends takes that off: what is left is another machine.
"""

import copy
import random
import warnings
from pathlib import Path

import pytest
import yaml

import crane
from crane.common.errors import CraneError
from crane.description.machine_lookup import bundled_machines

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


def judge(folder, name, data, way, value):
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


def run(tmp_path, name, count, seed=0):
    source = Path(bundled_machines()[name]).parent
    (tmp_path / "urdf").symlink_to(source / "urdf")
    data, chosen = cases(name, count, seed)
    if "extends" in data and not (tmp_path / data["extends"]).exists():
        data["extends"] = data["extends"].removesuffix(".yaml")  # bundled
    wrong = [text for way, value in chosen if (text := judge(tmp_path, name, data, way, value))]
    assert not wrong, "\n".join(wrong[:40])


@pytest.mark.slow
@pytest.mark.parametrize("count", [25, pytest.param(None, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", sorted(bundled_machines()))
def test_mutations(tmp_path, name, count):
    run(tmp_path, name, count, seed=1)
