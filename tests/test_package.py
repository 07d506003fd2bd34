"""Metadata agrees everywhere, and a missing extra is an error of one line."""

import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
import yaml
from command_line import typed
from packaging.requirements import Requirement

import crane
from crane.common import optional_libraries
from crane.common.errors import InputError
from crane.description import machine_lookup

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
TOOLS = {"all", "dev", "docs", "referee"}  # what is for everybody, for developers, for the site

CONDA = {  # names on conda-forge that differ from those of Python's index
    "pin": "pinocchio-python", "meshcat": "meshcat-python", "matplotlib": "matplotlib-base",
    "mujoco": "mujoco-python",
}  # fmt: skip


def on_conda(requirements):
    parsed = map(Requirement, requirements)
    return {f"{CONDA.get(each.name, each.name)} {each.specifier}" for each in parsed}


def recipe():
    return yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text())


def test_the_recipe_needs_what_the_package_needs():
    needs = recipe()["requirements"]
    lowest, highest = PROJECT["requires-python"].removeprefix(">=").split(",")
    assert recipe()["context"]["python_min"] == lowest
    python = f"python >=${{{{ python_min }}}},{highest}"
    assert set(needs["run"]) == on_conda(PROJECT["dependencies"]) | {python}
    extra = {each for name in EXTRAS.keys() - TOOLS for each in EXTRAS[name]}
    assert set(needs["run_constraints"]) == on_conda(extra)
    built = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    assert on_conda(built) <= set(needs["host"])
    assert recipe()["build"]["python"]["entry_points"] == [
        f"{name} = {called}" for name, called in PROJECT["scripts"].items()
    ]


def test_one_version_and_one_day():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    released = re.findall(r"^## \[(\d.*)\] - (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert released[0] == (crane.__version__, cited["date-released"].isoformat())
    assert (cited["version"], recipe()["context"]["version"]) == (crane.__version__,) * 2
    assert (cited["license"], recipe()["about"]["license"]) == (PROJECT["license"],) * 2


def test_all_has_every_extra():
    (everything,) = map(Requirement, EXTRAS["all"])
    assert everything.name == PROJECT["name"]
    assert everything.extras == EXTRAS.keys() - TOOLS
    assert f"{PROJECT['name']}[all]" in EXTRAS["dev"]


@pytest.mark.parametrize("module", optional_libraries._LIBRARIES)
def test_a_library_that_is_not_there_is_told_with_its_extra(module, monkeypatch):
    name, extra = optional_libraries._LIBRARIES[module]
    assert module in [Requirement(each).name for each in EXTRAS[extra]]
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError) as caught:
        optional_libraries.import_optional_library(module, "this")
    assert str(caught.value) == (
        f"this needs {name}, install it in the repository's folder: pip install '.[{extra}]'"
    )


@pytest.mark.parametrize("tried", [(), ("--try", "bandwidth=2,5")])
def test_identify_says_at_once_what_feasible_bodies_need(tried, tmp_path, monkeypatch):
    """A missing extra is reported before the work, not by each of many trials."""
    typed("simulate", "mini_forwarder", "--task", "lift", "--out", tmp_path / "run")
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    result = typed(
        "identify", "mini_forwarder", "run/recording.csv", "--feasible", *tried, "--out", "found",
        cwd=tmp_path,
    )  # fmt: skip
    assert result.returncode == 2
    assert result.stderr.splitlines()[-1] == (
        "error: a feasible estimate needs CVXPY, install it in the repository's folder: "
        "pip install '.[feasible]'"
    )
    assert not (tmp_path / "found").exists()


def test_it_is_said_before_recordings_are_looked_at(monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(InputError, match="a feasible estimate needs CVXPY"):
        crane.identify(crane.load("mini_forwarder"), [], feasible=True)


def test_robots_are_found_where_conda_puts_them(monkeypatch, tmp_path):
    def unlisted(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.files", unlisted)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    assert machine_lookup.example_root.__wrapped__() is None
    robots = tmp_path / "share" / "example-robot-data" / "robots"
    robots.mkdir(parents=True)
    assert machine_lookup.example_root.__wrapped__() == robots


def test_tables_of_the_pages_are_whole():
    """No text stands against a row: Markdown would make a row of it, or no table of the rows."""
    for page in (*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md"):
        code, before = False, ""
        for number, line in enumerate(page.read_text().splitlines(), start=1):
            if line.startswith("```"):
                code = not code
            elif not code and line and before:
                assert line.startswith("|") == before.startswith("|"), f"{page.name}:{number}"
            before = "" if code else line
