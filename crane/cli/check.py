"""The command that says what is wrong with a machine."""

import typer

from crane.cli.shared import Active, Free, MachineName, app, names


@app.command()
def check(file: MachineName, active: Active = None, free: Free = None) -> None:
    """Say all that is wrong with a machine; exit status 0, 1 with warnings only, 2 with errors."""
    from crane.formats.check import check as check_machine

    report = check_machine(file, names(active), names(free))
    for finding in report.findings:
        print(finding)
    if report.summary is not None:
        print(report.summary)
    if report.findings:
        print(report.counts)
    raise typer.Exit(report.status)
