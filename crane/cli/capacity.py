"""The command on what a machine lifts: capacity."""

import dataclasses
import warnings
from typing import TYPE_CHECKING, Annotated

import typer

from crane.cli.shared import (
    BY_COMMAND,
    Active,
    Argument,
    Change,
    Force,
    Free,
    Lock,
    MachineName,
    Out,
    Packages,
    app,
    load,
    status,
)
from crane.common.errors import CraneWarning, InputError

if TYPE_CHECKING:
    from crane.ratings import Rule

_MOST = 8  # slew angles that a page shows


@app.command()
def capacity(
    machine: MachineName,
    out: Out = BY_COMMAND,
    frame: Annotated[
        str | None,
        typer.Option(metavar="LINK", help="Where the load hangs; the tip if not given."),
    ] = None,
    rule: Annotated[str, typer.Option(help="none, iso10567, en12999 or sfs4677.")] = "none",
    hydraulic: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="Of what drives lift, in place of the rule's."),
    ] = None,
    tipping: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="Of what tips it, in place of the rule's."),
    ] = None,
    raising: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT",
            help="Drives that raise, others hold; may be repeated. As the rule says if not given.",
        ),
    ] = None,
    slew: Annotated[
        str | None,
        typer.Option(metavar="DEG,...", help="Slew angles; home and a quarter turn if it tips."),
    ] = None,
    slope: Annotated[
        float, typer.Option(metavar="DEG", help="Of the ground, to its worst side.")
    ] = 0.0,
    friction: Annotated[
        bool, typer.Option("--friction", help="What raises has to overcome friction.")
    ] = False,
    step: Annotated[float | None, typer.Option(metavar="M", help="Between places.")] = None,
    torque: Annotated[
        float | None,
        typer.Option(
            metavar="RADIUS",
            help="Tell the lifting torque, gross and of the load at this radius, and the slewing.",
        ),
    ] = None,
    by: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Write how each load changes with this number; may be repeated."
        ),
    ] = None,
    change: Change = None,
    lock: Lock = None,
    active: Active = None,
    free: Free = None,
    packages: Packages = None,
    argument: Argument = None,
    force: Force = False,
) -> None:
    """Tell the largest load all over the reach, and what ends it: tables, charts, a page."""
    from math import radians

    from crane.cli.runs import check_folder, write_capacity
    from crane.common.samples import as_number
    from crane.dynamics.tipping_stability import has_supports
    from crane.ratings import capacity as rate
    from crane.ratings import torques

    check_folder(out, force)
    shares = _rule(rule, hydraulic, tipping)
    lean = radians(as_number(slope, "--slope", "degrees", max_magnitude=45.0))
    slews = None if slew is None else [radians(x) for x in _angles(slew)]
    loaded = load(machine, lock, change, active, free, False, packages, argument)
    if shares.tipping < 1 and not has_supports(loaded):
        text = (
            f"'{loaded.name}' has no supports, so that nothing tips and the rule's "
            f"{100 * shares.tipping:.3g} % of the tipping load are left out: name what it stands "
            "on under 'supports' of the machine file"
        )
        warnings.warn(text, CraneWarning, stacklevel=2)
    with status("rating"):
        chart = rate(
            loaded, frame, rule=shares, raising=raising or None, slews=slews,
            slope=lean, friction=friction, step=step,
        )  # fmt: skip
        found = None
        if torque is not None:
            found = torques(
                loaded, frame, radius=torque, rule=shares, raising=raising or None, slews=slews,
                slope=lean, friction=friction,
            )  # fmt: skip
    with status("drawing"):
        text = write_capacity(out, chart, found, by or (), force)
    print(f"{text}\nwritten to {out}")


def _rule(name: str, hydraulic: float | None, tipping: float | None) -> "Rule":
    """A rule with shares of one's own.

    Raises:
        InputError: An unknown rule, or a share that is none.
    """
    from crane.common.samples import as_number
    from crane.ratings.rating_rules import find_rule

    rule, words = find_rule(name), []
    for what, share in (("hydraulic", hydraulic), ("tipping", tipping)):
        if share is not None:
            share = as_number(share, f"--{what}", "", greater_than=0.0, max_magnitude=1.0)
            rule = dataclasses.replace(rule, **{what: share})  # type: ignore[arg-type]
            words.append(f"{100 * share:g} % of the {what} load")
    if words:
        rule = dataclasses.replace(
            rule, description=f"{rule.description}; here {' and '.join(words)}"
        )
    return rule


def _angles(text: str) -> list[float]:
    """Degrees.

    Raises:
        InputError: Something else is written.
    """
    try:
        angles = [float(word) for word in text.split(",")]
    except ValueError:
        raise InputError(f"--slew is '{text}', write degrees, as 0,45,90") from None
    if len(angles) > _MOST:
        raise InputError(f"--slew has {len(angles)} angles, a page has room for {_MOST}")
    return angles
