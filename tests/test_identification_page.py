"""The commands, the program and the figures of docs/identification.md agree with the page."""

import contextlib
import io
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from command_line import typed

PAGE = Path(__file__).parents[1] / "docs" / "identification.md"
NUMBER = r"-?\d+(?:\.\d*)?(?:e[+-]\d+)?"

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::crane.CraneWarning")]


def alike_in_size(one, other):
    return abs(one - other) < 0.03 or 1 / 3 < one / other < 3


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

    # the optimised motion, and with it all errors, depend on how a processor rounds; what is
    # identified does not
    *figures, described, identified = figures
    for line in figures:
        alike = [[*map(float, re.findall(rf"(?<!\w){NUMBER}", x))] for x in told
                 if words(x) == words(line)]  # fmt: skip
        shown = [*map(float, re.findall(rf"(?<!\w){NUMBER}", line))]
        assert any(all(map(alike_in_size, x, shown)) for x in alike), (line, alike)
        if re.match(r" +X1\.", line):
            assert any(x[0] == pytest.approx(shown[0], rel=0.02) for x in alike), (line, alike)
    # weights trade with the offsets of friction, whose intervals say how much
    deviations = np.sqrt(np.diag(names["found"].covariance))
    named = dict(zip(names["found"].names, deviations, strict=True))
    worse, better = (
        [*map(float, re.findall(NUMBER, line.split(" by ")[1]))]
        for line in told if "weights off" in line
    )  # fmt: skip
    assert "described" in described and "identified" in identified
    for joint, one, other in zip(names["machine"].active, better, worse, strict=True):
        assert one <= max(other, 1e-3) and one < 3 * named[f"{joint}.coulomb_offset"] + 0.1
    # of what explains the forces, the nearest to the description, which forces do not tell
    mass = names["found"].parameters[names["found"].model.names.index("link3.m")]
    assert 0.2 < mass < 0.3 and "0.282 kg, and 0.216 kg" in section
    assert "(true value 0.25" in section
