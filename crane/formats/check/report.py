"""The check of a machine: reading, assembling and closing it, and whether its numbers fit."""

import re
import shlex
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from crane.closure import Closure
from crane.common.counted import kind
from crane.common.errors import CraneWarning
from crane.common.output import file_name
from crane.common.packages import given, giving, package_folders, values_by_name
from crane.description import MachineSpec, driven
from crane.description.findings import Findings, collecting, recoverable
from crane.description.floating import floated
from crane.description.sources import command_words, find
from crane.formats.adding.open_loops import Proposal, proposals
from crane.formats.check.circuit import shortage, warn_of_circuit
from crane.formats.check.mechanism import check_mechanism
from crane.formats.check.plausible import implausible
from crane.formats.machine_file.read import read
from crane.formats.opening import is_simulators
from crane.machine.masses import has_mass

# "four_bar.yaml:12: what", or a file that has no line to point at
_PLACE = re.compile(
    r"(?P<file>.+?)(?::(?P<line>\d+)|(?<=\.yaml|\.urdf)|(?<=\.xml|\.yml|\.sdf)|"
    r"(?<=\.xacro|\.world)): "
)
_MOST = 500  # findings in a report
_SHOWN = 14  # kinds of findings on a screen
_LOOPS = 8  # proposals on a screen
_LINES = 6  # that have a finding of one kind


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong or unusual.

    Attributes:
        file: Name of the file, without its folder.
        line: Its line; 0 where it is about the whole file.
        error: Whether it keeps the machine from being loaded.
        what: What it is, and what to do about it.
    """

    file: str
    line: int
    error: bool
    what: str

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {'error' if self.error else 'warning'}: {self.what}"


@dataclass(frozen=True)
class Report:
    """What a check found.

    Attributes:
        findings: By file and line.
        summary: One line on the machine, None where it cannot be loaded.
        full: Whether there was more than is listed.
        next: The command to type next.
        proposals: Loops that the description seems to leave open.
        notes: What is worth knowing, and neither wrong nor unusual.
    """

    findings: tuple[Finding, ...]
    summary: str | None
    full: bool
    next: str
    proposals: tuple[Proposal, ...] = ()
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        """All of it as the command prints it: what to mend, the machine, and what comes next."""
        told = [*self.lines, self.summary, *self.notes, self.counts * bool(self.findings)]
        return "\n".join([*filter(None, told), *self.proposed, f"next: {self.next}"])

    @property
    def proposed(self) -> list[str]:
        """The proposed loops as they are pasted into a machine file."""
        if not self.proposals:
            return []
        told = [f"  {proposal}" for proposal in self.proposals[:_LOOPS]]
        more = len(self.proposals) - len(told)
        rest = [f"  # and {more} more, all are written by crane add loops"] * bool(more)
        return ["loops:  # proposed, nothing closes them yet", *told, *rest]

    @property
    def lines(self) -> list[str]:
        """One screen: each kind of finding once, with the lines of those like it; errors first."""
        groups: dict[tuple[str, bool, str], list[Finding]] = {}
        for finding in sorted(self.findings, key=lambda one: not one.error):
            groups.setdefault((finding.file, finding.error, kind(finding.what)), []).append(
                finding
            )
        told = [_together(some) for some in groups.values()]
        if len(told) > _SHOWN:
            rest = sum(len(some) for some in list(groups.values())[_SHOWN:])
            told[_SHOWN:] = [f"{rest} more, of {len(groups) - _SHOWN} other kinds"]
        return told

    @property
    def errors(self) -> int:
        """Number of errors."""
        return sum(finding.error for finding in self.findings)

    @property
    def warnings(self) -> int:
        """Number of warnings."""
        return len(self.findings) - self.errors

    @property
    def status(self) -> int:
        """Exit status: 2 with errors, 1 with warnings only, else 0."""
        return 2 if self.errors else 1 if self.findings else 0

    @property
    def counts(self) -> str:
        """One line with the number of errors and of warnings."""
        words = [
            f"{number or 'no'} {word}{'s' * (number != 1)}"
            for number, word in ((self.errors, "error"), (self.warnings, "warning"))
        ]
        return ", ".join(words) + ("; there is more, mend these first" if self.full else "")


def check(
    name: str | Path,
    active: Sequence[str] | None = None,
    free: Sequence[str] | None = None,
    floating: bool = False,
    packages: Sequence[str | Path] = (),
    arguments: Mapping[str, object] | None = None,
) -> Report:
    """Read a machine as far as possible, and say all that is wrong or unusual about it.

    The first error that `load` would raise is among the findings.

    Args:
        name: As for `load`.
        active: As for `load`.
        free: As for `load`.
        floating: As for `load`.
        packages: As for `load`.
        arguments: As for `load`.

    Returns:
        Findings with file and line, a summary, and what to do next; printed as `crane check` does.

    Raises:
        DescriptionError: There is no such file.
        InputError: A joint is unknown.
    """
    with giving(package_folders(packages), values_by_name(arguments), floating):
        return _check(name, active, free, floating)


def _check(
    name: str | Path, active: Sequence[str] | None, free: Sequence[str] | None, floating: bool
) -> Report:
    path = find(name)
    spec: MachineSpec | None = None
    closure: Closure | None = None
    with warnings.catch_warnings(record=True) as caught, collecting() as found:
        warnings.simplefilter("always", CraneWarning)
        with recoverable():
            spec = read(path)
            spec = floated(spec) if floating else spec
        if spec is not None and (active is not None or free is not None):
            with recoverable():
                spec = driven(spec, active, free)
        if spec is not None:
            closure = _closed(spec, found)
        implausible(found.files, spec)
        if spec is not None:
            warn_of_circuit(spec)
    findings = [_finding(str(error), True, path.name) for error in found.errors]
    findings += [
        _finding(str(one.message), False, path.name)
        for one in caught
        if issubclass(one.category, CraneWarning)
    ]
    summary = None
    if spec is not None and closure is not None and not found.errors:
        summary = _summary(spec, closure)
    ordered = sorted(set(findings), key=lambda x: (x.file, x.line, not x.error, x.what))
    full = found.full or len(ordered) > _MOST
    open_loops: tuple[Proposal, ...] = ()
    if spec is not None and closure is not None:
        open_loops = proposals(spec, closure.model, closure.home)
    notes = tuple(shortage(spec)) if spec is not None and summary is not None else ()
    called = command_words(name, active, free)
    if open_loops and summary is not None:  # driven as the closed machine will be
        called = command_words(name, beside=replace(given(), floating=False))
    what_next = _next(called, spec, closure, summary, bool(open_loops))
    return Report(tuple(ordered[:_MOST]), summary, full, what_next, open_loops, notes)


def _together(alike: list[Finding]) -> str:
    """Findings of one kind as one line."""
    others = [str(one.line) for one in alike[1:] if one.line]
    if len(alike) == 1:
        return str(alike[0])
    dots = ["..."] if len(others) > _LINES else []
    lines = f", lines {', '.join(others[:_LINES] + dots)}" if others else ""
    return f"{alike[0]} ({len(alike)} such{lines})"


def _next(
    called: str,
    spec: MachineSpec | None,
    closure: Closure | None,
    summary: str | None,
    is_open: bool,
) -> str:
    """What to type next, with a machine as `command_words` has it."""
    if spec is None or closure is None or summary is None:
        return f"crane check {called} again, once the errors are mended"
    if is_open:
        return f"crane add loops {called}"
    if closure.sought is not None and is_simulators(spec.path):
        return f"crane convert {called} {file_name(spec.name)}"
    if closure.sought is not None:
        return f"crane check {called} --write-home"
    if not has_mass(closure.model):
        return f"crane live {called}"
    for task in spec.tasks.values():
        return (
            f"crane simulate {called} --task {shlex.quote(task.name)} --out {file_name(task.name)}"
        )
    return f"crane simulate {called} --duration 2 --out {file_name(spec.name)}"


def _closed(spec: MachineSpec, found: Findings) -> Closure | None:
    """The closure of what was read, None where what is wrong with it forbids one."""
    if not found.usable:
        return None
    with recoverable():
        return check_mechanism(spec, found)
    return None


def _finding(message: str, error: bool, file: str) -> Finding:
    message = _printable(message)
    place = _PLACE.match(message)
    if place is None:
        return Finding(_printable(file), 0, error, message)
    what = message[place.end() :]
    return Finding(Path(place["file"]).name, int(place["line"] or 0), error, what)


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)


def _summary(spec: MachineSpec, closure: Closure) -> str:
    residual = float(closure.residual(closure.home))
    joints, freedom = closure.model.njoints - 1, closure.degrees_of_freedom
    between = sum(x.between is not None for x in spec.elements)
    elements = f"{between} element{'s' * (between > 1)} between frames, " if between else ""
    return (
        f"{_printable(spec.name)}: {joints} joints, {len(spec.loops)} loops, {freedom} degrees of "
        f"freedom, {elements}loops closed to {residual:.1e} m at home"
    )
