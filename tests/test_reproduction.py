"""The reproduction of the reduced-scale forwarder paper runs and confirms its statements."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.long
def test_the_page_is_complete(tmp_path):
    page = tmp_path / "validation" / "page.md"
    script = ROOT / "scripts" / "reproduce_mini_forwarder.py"
    command = [sys.executable, str(script), "--draws", "4", "--rigs", "2", "--write", str(page)]
    subprocess.run(command, check=True, capture_output=True, timeout=600)
    text = page.read_text()
    for picture in re.findall(r"\]\((images/.*?)\)", text):
        assert (page.parent / picture).read_bytes()[:4] == b"\x89PNG"
    board = text.split("## ")[1]
    rows = re.findall(r"^\| (\d(?:, times five)?: \w+) \[", board, re.M)
    assert len(rows) == 12 and len(set(rows)) == 12
    # every number outside has its sentence
    explained = board.split("Outside, with friction that brakes:")[1]
    for row in re.findall(r"^\| \d.*\|$", board, re.M):
        name, *_, exact, decoupled, _, _ = (cell.strip() for cell in row.strip("|").split("|"))
        number, signal = name.split(": ")
        line = f"- Trajectory {number}, {signal.split(' ')[0]}:"
        outside = [value for value in (exact, decoupled) if "**" not in value]
        found = [text for text in explained.splitlines() if text.startswith(line)]
        assert len(found) == bool(outside)
        assert all(value in found[0] for value in outside)


def test_the_published_page_is_of_this_code():
    """The page in docs has the numbers that the machine gives now (one of them, to its digits)."""
    import crane

    text = (ROOT / "docs" / "validation" / "mini_forwarder.md").read_text()
    machine = crane.load("mini_forwarder")
    gap = crane.Dynamics(machine).gravity([0, 0.03, 0.0175])
    gap -= crane.Dynamics(machine, formulation="decoupled").gravity([0, 0.03, 0.0175])
    (shown,) = re.findall(r"^\| static: F_A1 \[N\] \| ([\d.]+) ", text, re.M)
    assert abs(gap[1]) == pytest.approx(float(shown), rel=5e-3)
