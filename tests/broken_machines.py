"""Valid machines, small edits that break them, and assertions about the errors."""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

import crane
from crane.common.errors import CraneError
from crane.formats import check

DATA = Path(__file__).parent / "data"
MODELS = Path(__file__).parents[1] / "models"

MACHINE = "four_bar.yaml"
GROUND = "four_bar/ground.urdf"
ROCKER = "four_bar/rocker.urdf"
LOOPED = "four_bar_loop.urdf"
MINI = "mini_forwarder.yaml"


@dataclass(frozen=True)
class Edit:
    """Text of a file replaced by another, all of it where `old` is None."""

    file: str
    old: str | None
    new: str | bytes

    def apply(self, folder: Path) -> None:
        path = folder / self.file
        if self.old is None:
            path.write_bytes(self.new if isinstance(self.new, bytes) else self.new.encode())
            return
        assert isinstance(self.new, str)
        before = path.read_text()
        assert before.count(self.old) == 1, f"{self.old!r} is {before.count(self.old)} times there"
        path.write_text(before.replace(self.old, self.new))


@dataclass(frozen=True)
class Broken:
    """A machine that must be refused with this line.

    `{line of TEXT}` after a file's name in the message is the line of the file that has TEXT,
    for files whose other lines may come and go.
    """

    message: str
    edits: tuple[Edit, ...]
    machine: str = MACHINE
    strict: bool = False  # otherwise it is loaded, with a warning
    alone: bool = True  # no other error is found


def swap(old: str, new: str, file: str = MACHINE) -> Edit:
    return Edit(file, old, new)


def whole(new: str | bytes, file: str = MACHINE) -> Edit:
    return Edit(file, None, new)


def case(message: str, *edits: Edit, **options):
    return pytest.param(Broken(message, edits, **options), id=re.sub(r"\W+", "-", message)[:60])


def copy_machine(machine: str, folder: Path) -> Path:
    """Copy a machine with all its URDFs into a folder."""
    if machine == MINI:
        shutil.copytree(MODELS / "urdf" / "mini_forwarder", folder / "urdf" / "mini_forwarder")
        return Path(shutil.copy(MODELS / machine, folder))
    if machine == MACHINE:
        shutil.copytree(DATA / "four_bar", folder / "four_bar", dirs_exist_ok=True)
    return Path(shutil.copy(DATA / machine, folder))


def assert_refused(broken: Broken, folder: Path) -> None:
    """`load` refuses the machine with the message, and `check` reports it, and nothing else."""
    path = copy_machine(broken.machine, folder)
    for edit in broken.edits:
        edit.apply(folder)
    with pytest.raises(CraneError) as caught:
        crane.load(path, strict=broken.strict)
    message = str(caught.value)
    assert message == with_line(broken.message, folder)
    assert message.isprintable()
    assert type(caught.value) is not CraneError
    report = check(path)
    findings = [str(finding).replace(": error: ", ": ", 1) for finding in report.findings]
    found = message.split(": it stays")[0]  # of open loops `check` tells the smallest gap
    assert any(finding.startswith(found) for finding in findings), findings
    assert (report.status, report.summary) == (2, None)
    if broken.machine != MINI and broken.alone:
        assert report.errors == 1, findings


def with_line(message: str, folder: Path) -> str:
    if (found := re.match(r"(.+?):\{line of (.+?)\}: ", message)) is None:
        return message
    (file,) = folder.rglob(found[1])
    (line,) = (i for i, text in enumerate(file.read_text().splitlines(), 1) if found[2] in text)
    return f"{found[1]}:{line}: {message[found.end() :]}"
