"""The schema of machine files: editors, tables and readers follow from one description."""

import dataclasses
import importlib.util
import json
import re
import textwrap
from pathlib import Path

import jsonschema
import pytest
from command_line import typed

from crane.description import bundled_machines
from crane.description.key_types import SectionKey, SectionSchema
from crane.description.machine_schema import MACHINE
from crane.formats.machine_file.json_schema import SCHEMA_PATH, schema_text
from crane.formats.machine_file.yaml_section import parse_with_base
from crane.formats.machine_file.yaml_text import parse_yaml_file

ROOT = Path(__file__).parents[1]
DATA = ROOT / "tests" / "data"
PAGE = (ROOT / "docs" / "machine_file.md").read_text(encoding="utf-8")
VALIDATOR = jsonschema.Draft202012Validator(json.loads(schema_text()))


def errors(data):
    return [error.message for error in VALIDATOR.iter_errors(data)]


def examples():
    """Machine files and parts of them in the documentation."""
    texts = []
    for page in (ROOT / "docs").rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        texts += re.findall(r"```yaml\n(.*?)```", text, re.S)
    texts += map(textwrap.dedent, re.findall(r"(?<=\n\n)((?:    .*\n+)+)", PAGE))
    heads = rf"({'|'.join(MACHINE.keys)}):"  # loads by phases are those of a task
    return [x for x in texts if re.match(heads, x) and not re.match("loads:.*phases", x, re.S)]


def sections(schema=MACHINE, path=""):
    """All sections below one, by their path."""
    yield path, schema
    for name, key in schema.keys.items():
        for part in (key, getattr(key, "item", key), *getattr(key, "types", ())):
            if isinstance(part, SectionKey):
                yield from sections(part.section, f"{path}.{name}")


def test_the_shipped_schema_is_current_and_printed():
    """Renew it by `crane schema > crane/formats/machine_file/machine_file.schema.json`."""
    jsonschema.Draft202012Validator.check_schema(VALIDATOR.schema)
    assert SCHEMA_PATH.read_text(encoding="utf-8") == schema_text()
    done = typed("schema")
    assert done.returncode == 0 and done.stdout == schema_text()


def test_the_tables_of_the_page_are_current():
    """Renew them by `python docs/key_tables.py`."""
    spec = importlib.util.spec_from_file_location("key_tables", ROOT / "docs" / "key_tables.py")
    tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tables)
    assert tables.with_tables(PAGE) == PAGE


@pytest.mark.parametrize("file", [*bundled_machines().values(), *DATA.glob("*.yaml")], ids=str)
def test_machine_files_validate(file):
    assert not errors(parse_yaml_file(file))
    assert not errors(parse_with_base(file, MACHINE, ()))


@pytest.mark.parametrize("text", examples())
def test_examples_of_the_documentation_validate(text, tmp_path):
    file = tmp_path / "example.yaml"
    is_whole = "chains:" in text or "extends:" in text
    file.write_text(text if is_whole else f"extends: patu655\n{text}")
    assert not errors(parse_yaml_file(file))


@pytest.mark.parametrize(
    "path, value, text",
    [
        (["hoem"], {}, "'hoem' was unexpected"),
        (["friction", "crank", "colomb"], 1.0, "'colomb' was unexpected"),
        (["friction", "crank", "coulomb"], -1.0, "less than the minimum"),
        (["friction", "crank", "coulomb"], "much", "does not match"),
        (["friction", "crank", "coulomb"], "2e5", None),
        (["friction", "crank", "stribeck"], 0, "less than or equal to the minimum of 0"),
        (["active"], "crank", "is not of type 'array'"),
        (["active"], ["crank", "crank"], "non-unique"),
        (["loops", 0, "type"], "hinge", "is not one of"),
        (["loops", 0, "axis"], [0, 1], "too short"),
        (["forces", 0, "between"], ["a", "b"], "should not be valid"),
        (["tasks", "swing", "active", "crank"], 1.0, "is not of type 'array'"),
        (["name"], None, "None is not of type 'string'"),
        (["extends"], "four_bar.yaml", None),
    ],
)
def test_wrong_keys_types_and_bounds_do_not_validate(path, value, text):
    data = json.loads(json.dumps(parse_yaml_file(DATA / "four_bar.yaml")))
    part = data
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    messages = errors(data)
    assert (text is None and not messages) or any(text in x for x in messages), messages


def test_required_keys_are_required_but_of_variants():
    data = json.loads(json.dumps(parse_yaml_file(DATA / "four_bar.yaml")))
    del data["name"], data["loops"][0]["type"], data["tasks"]["swing"]
    assert len(errors(data)) == 2
    assert not errors({"extends": "patu655", "tasks": {"lift": None}, "hydraulics": {"oil": {}}})


@pytest.mark.parametrize("path, schema", sections(), ids=lambda x: x if isinstance(x, str) else "")
def test_sections_describe_all_numbers_of_their_classes(path, schema: SectionSchema):
    assert all(key.text for key in schema.keys.values())
    if schema.content is not None and path not in (".hydraulics.motors", ".hydraulics.supplies"):
        numbers = {
            x.name for x in dataclasses.fields(schema.content) if x.type in (float, "float")
        }
        assert numbers <= {key.attribute or name for name, key in schema.keys.items()}
