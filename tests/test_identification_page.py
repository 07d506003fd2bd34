"""The case of docs/identification.md: its commands, its program, and the figures on the page."""

import contextlib
import io
import re
import shlex
from pathlib import Path

import pytest
from typed import typed

PAGE = Path(__file__).parents[1] / "docs" / "identification.md"
NUMBER = r"-?\d+(?:\.\d*)?(?:e[+-]\d+)?"

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::crane.CraneWarning")]


def test_the_case_from_start_to_end(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    section = PAGE.read_text().split("## A case from start to end\n")[1].split("\n## ")[0]
    steps = re.findall(
        r"^    (crane .*?[^\\])$|^```python\n(.*?)^```$", section, re.DOTALL | re.MULTILINE
    )
    assert [bool(command) for command, _ in steps] == [True] * 4 + [False, True, False, False]
    names, told = {}, []
    for command, program in steps:
        if command:
            ran = typed(*shlex.split(command.replace("\\\n", ""))[1:])
            assert ran.returncode == 0, ran.stderr
            told += ran.stdout.splitlines()
        else:
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(program, str(PAGE), "exec"), names)
            told += out.getvalue().splitlines()
    assert Path("result/machine/mini_forwarder.yaml").is_file()
    assert Path("result/parameters.csv").read_text() == Path("parameters.csv").read_text()

    bare = re.sub(r"^```.*?^```$", "", section, flags=re.DOTALL | re.MULTILINE)
    bare = re.sub(r"^    crane .*?[^\\]$", "", bare, flags=re.DOTALL | re.MULTILINE)
    figures = [line for line in bare.splitlines() if line.startswith("    ")]
    assert len(figures) == 16

    def words(line):
        return re.sub(rf"(?<!\w){NUMBER}|[\[\]%]", "", line).split()

    for line in figures:
        # where the search ends depends on the processor's rounding
        close = {"rel": 1.0} if line.split()[0] in ("condition", "smallest") else {"rel": 0.05}
        alike = [[*map(float, re.findall(rf"(?<!\w){NUMBER}", x))] for x in told
                 if words(x) == words(line)]  # fmt: skip
        shown = [*map(float, re.findall(rf"(?<!\w){NUMBER}", line))]
        assert any(x == pytest.approx(shown, abs=2e-3, **close) for x in alike), line
    # of what explains the forces, the nearest to the description
    mass = names["found"].parameters[names["found"].model.names.index("link3.m")]
    assert mass == pytest.approx(0.282, abs=5e-3) and f"{mass:.3f} kg (0.25 in truth" in section
