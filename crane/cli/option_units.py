"""Units of options: of a number, of what a name stands for."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import typer

from crane.common.unit_conversions import UnitError, parse_number

if TYPE_CHECKING:
    import crane

_METAVARS = {"s": "SECONDS", "Hz": "HZ", "m": "M", "kg": "KG", "deg": "DEG", "": "FRACTION"}
UnitsOf = Callable[[str], Sequence[str]]  # SI units that a name may have


def joint_units(machine: "crane.Machine", by_time: str = "") -> UnitsOf:
    """SI units of the coordinates of joints, or of their rates: both of what is no joint.

    Args:
        machine: The machine.
        by_time: As "/s" for rates, "/s2" for accelerations.
    """

    def units_of(name: str) -> Sequence[str]:
        units = [machine.unit(name)] if name in machine.joints else ["m", "rad"]
        return [f"{unit}{by_time}" for unit in units]

    return units_of


def parameter_units(machine: "crane.Machine") -> UnitsOf:
    """SI unit of each parameter."""
    from crane.description.machine_parameters import parameter_unit

    return lambda name: (parameter_unit(machine.tree, name),)


def number_option(unit: str, text: str, *names: str) -> Any:
    """An option whose value is a number in a unit, or with another one.

    Args:
        unit: The unit of a plain number.
        text: Its help.
        names: Its names, if not that of its parameter.
    """

    def parse(text: str | float) -> float:
        try:
            return parse_number(str(text), (unit,))
        except UnitError as error:
            raise typer.BadParameter(f"{text!r}, {error}") from None
        except ValueError:
            raise typer.BadParameter(f"{text!r} is not a valid float.") from None

    return typer.Option(*names, metavar=_METAVARS[unit], parser=parse, help=text)
