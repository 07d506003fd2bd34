"""Check a machine: read, assemble and close it, and test whether its values are plausible."""

import re
import shlex
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from crane.closure.closure import Closure
from crane.common.atomic_output import portable_file_name
from crane.common.errors import CraneWarning, format_one_line, message_kind
from crane.common.package_search import (
    check_argument_values,
    check_package_folders,
    load_options,
    use_load_options,
)
from crane.description.findings import collect_findings, error_recovery
from crane.description.machine_lookup import command_line_arguments, find_machine_file
from crane.description.parameter_changes import set_active_joints
from crane.description.rotation_vectors import add_floating_base
from crane.description.specification import MachineSpec
from crane.formats.additions.open_loop_search import LoopProposal, propose_loops
from crane.formats.checks.mechanism_check import check_mechanism
from crane.formats.checks.plausibility_check import (
    flow_shortages,
    warn_about_circuit,
    warn_about_implausible_values,
)
from crane.formats.machine_file.machine_reader import read_machine_spec
from crane.formats.robot_files import is_simulator_file
from crane.machine.machine_checks import has_mass

# "four_bar.yaml:12: message", or a file name without a line
_LOCATION_PATTERN = re.compile(
    r"(?P<file>.+?)(?::(?P<line>\d+)|(?<=\.yaml|\.urdf)|(?<=\.xml|\.yml|\.sdf)|"
    r"(?<=\.xacro|\.world)): "
)
_MAX_FINDINGS = 500  # in a report
_MAX_SHOWN_KINDS = 14  # of findings in the printed report
_MAX_SHOWN_LOOPS = 8  # proposed loops in the printed report
_MAX_SHOWN_LINES = 6  # numbers of lines with findings of one kind


@dataclass(frozen=True)
class Finding:
    """One error or warning.

    Attributes:
        file: Name of the file, without its folder.
        line: Line in the file; 0 if the finding is about the whole file.
        is_error: Whether it prevents loading the machine.
        message: The problem, and how to correct it.
    """

    file: str
    line: int
    is_error: bool
    message: str

    def __str__(self) -> str:
        location = f"{self.file}:{self.line}" if self.line else self.file
        return f"{location}: {'error' if self.is_error else 'warning'}: {self.message}"


@dataclass(frozen=True)
class CheckReport:
    """Result of a check.

    Attributes:
        findings: Errors and warnings, sorted by file and line.
        summary: One line about the machine, None if it cannot be loaded.
        is_truncated: Whether there are more findings than listed.
        next_command: The suggested next command.
        proposals: Loops that the description seems to leave open.
        notes: Information that is neither an error nor unusual.
    """

    findings: tuple[Finding, ...]
    summary: str | None
    is_truncated: bool
    next_command: str
    proposals: tuple[LoopProposal, ...] = ()
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return the text that `crane check` prints."""
        texts = [*self.finding_lines, self.summary, *self.notes, self.counts * bool(self.findings)]
        return "\n".join(
            [*filter(None, texts), *self.proposed_loop_lines, f"next: {self.next_command}"]
        )

    @property
    def proposed_loop_lines(self) -> list[str]:
        """The proposed loops as lines of a machine file."""
        if not self.proposals:
            return []
        lines = [f"  {proposal}" for proposal in self.proposals[:_MAX_SHOWN_LOOPS]]
        more = len(self.proposals) - len(lines)
        remainder_lines = [f"  # and {more} more, all are written by crane add loops"] * bool(more)
        return ["loops:  # proposed, nothing closes them yet", *lines, *remainder_lines]

    @property
    def finding_lines(self) -> list[str]:
        """Each kind of finding once with the lines of similar ones, errors first."""
        groups: dict[tuple[str, bool, str], list[Finding]] = {}
        for finding in sorted(self.findings, key=lambda one: not one.is_error):
            groups.setdefault(
                (finding.file, finding.is_error, message_kind(finding.message)), []
            ).append(finding)
        lines = [_format_group(some) for some in groups.values()]
        if len(lines) > _MAX_SHOWN_KINDS:
            remaining_count = sum(len(some) for some in list(groups.values())[_MAX_SHOWN_KINDS:])
            lines[_MAX_SHOWN_KINDS:] = [
                f"{remaining_count} more, of {len(groups) - _MAX_SHOWN_KINDS} other kinds"
            ]
        return lines

    @property
    def errors(self) -> int:
        """Number of errors."""
        return sum(finding.is_error for finding in self.findings)

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
        return ", ".join(
            [
                f"{number or 'no'} {word}{'s' * (number != 1)}"
                for number, word in ((self.errors, "error"), (self.warnings, "warning"))
            ]
        ) + ("; there may be more, correct these first" if self.is_truncated else "")


def check(
    name: str | Path,
    active: Sequence[str] | None = None,
    free: Sequence[str] | None = None,
    floating: bool = False,
    packages: Sequence[str | Path] = (),
    arguments: Mapping[str, object] | None = None,
) -> CheckReport:
    """Read a machine as far as possible, and report all errors and warnings.

    The first error that `load` would raise is among the findings.

    Args:
        name: As for `load`.
        active: As for `load`.
        free: As for `load`.
        floating: As for `load`.
        packages: As for `load`.
        arguments: As for `load`.

    Returns:
        Findings with file and line, a summary, and the next command.

    Raises:
        DescriptionError: There is no such file.
        InputError: A joint is unknown.
    """
    with use_load_options(
        check_package_folders(packages), check_argument_values(arguments), floating
    ):
        return _check_machine(name, active, free, floating)


def _check_machine(
    name: str | Path, active: Sequence[str] | None, free: Sequence[str] | None, floating: bool
) -> CheckReport:
    path = find_machine_file(name)
    spec: MachineSpec | None = None
    closure: Closure | None = None
    with (
        warnings.catch_warnings(record=True, action="always", category=CraneWarning) as caught,
        collect_findings() as collected,
    ):
        with error_recovery():
            spec = read_machine_spec(path)
            spec = add_floating_base(spec) if floating else spec
        if spec is not None and (active is not None or free is not None):
            with error_recovery():
                spec = set_active_joints(spec, active, free)
        if spec is not None and collected.can_be_assembled:
            with error_recovery():
                closure = check_mechanism(spec, collected)
        warn_about_implausible_values(collected.parsed_files, spec)
        if spec is not None:
            warn_about_circuit(spec)
    findings = [_parse_finding(str(error), True, path.name) for error in collected.errors]
    findings += [
        _parse_finding(str(one.message), False, path.name)
        for one in caught
        if issubclass(one.category, CraneWarning)
    ]
    ordered = sorted(set(findings), key=lambda x: (not x.is_error, x.file, x.line, x.message))
    is_truncated = collected.is_truncated or len(ordered) > _MAX_FINDINGS
    listed = sorted(ordered[:_MAX_FINDINGS], key=lambda x: (x.file, x.line))
    command_arguments = command_line_arguments(name, active, free)
    report = CheckReport(
        tuple(listed),
        None,
        is_truncated,
        f"crane check {command_arguments} again, once the errors are mended",
    )
    if spec is None or closure is None:
        return report
    open_loops = propose_loops(spec, closure.model, closure.home)
    if collected.errors:
        return replace(report, proposals=open_loops)
    next_command = _next_command(command_arguments, spec, closure)
    if open_loops:  # active joints are those of the closed machine
        options = replace(load_options(), floating_root=False)
        next_command = f"crane add loops {command_line_arguments(name, options=options)}"
    return replace(
        report,
        summary=_machine_summary(spec, closure),
        next_command=next_command,
        proposals=open_loops,
        notes=tuple(flow_shortages(spec)),
    )


def _format_group(findings: list[Finding]) -> str:
    other_lines = [str(one.line) for one in findings[1:] if one.line]
    if len(findings) == 1:
        return str(findings[0])
    dots = ["..."] if len(other_lines) > _MAX_SHOWN_LINES else []
    lines = f", lines {', '.join(other_lines[:_MAX_SHOWN_LINES] + dots)}" if other_lines else ""
    return f"{findings[0]} ({len(findings)} such{lines})"


def _next_command(command_arguments: str, spec: MachineSpec, closure: Closure) -> str:
    if closure.home_search is not None and is_simulator_file(spec.path):
        return f"crane convert {command_arguments} {portable_file_name(spec.name)}"
    if closure.home_search is not None:
        return f"crane check {command_arguments} --write-home"
    if not has_mass(closure.model):
        return f"crane live {command_arguments}"
    for task in spec.tasks.values():
        return (
            f"crane simulate {command_arguments} --task {shlex.quote(task.name)} --out "
            f"{portable_file_name(task.name)}"
        )
    return f"crane simulate {command_arguments} --duration 2 --out {portable_file_name(spec.name)}"


def _parse_finding(message: str, is_error: bool, file: str) -> Finding:
    message = format_one_line(message)
    location = _LOCATION_PATTERN.match(message)
    if location is None:
        return Finding(format_one_line(file), 0, is_error, message)
    return Finding(
        Path(location["file"]).name,
        int(location["line"] or 0),
        is_error,
        message[location.end() :],
    )


def _machine_summary(spec: MachineSpec, closure: Closure) -> str:
    residual = float(closure.residual(closure.home))
    joints, mobility = closure.model.njoints - 1, closure.degrees_of_freedom
    frame_element_count = sum(x.between is not None for x in spec.force_elements)
    elements_text = (
        f"{frame_element_count} element{'s' * (frame_element_count > 1)} between frames, "
        if frame_element_count
        else ""
    )
    return (
        f"{format_one_line(spec.name)}: {joints} joints, {len(spec.loops)} loops, "
        f"{mobility} degrees of freedom, {elements_text}loops closed to {residual:.1e} m at home"
    )
