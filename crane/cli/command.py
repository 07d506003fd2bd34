"""The program, the decorator of its commands, and blocks of options.

A command is a function. Its parameters are its own arguments and options, and option blocks:
classes whose fields are options. The decorator expands the blocks into the command's signature.
"""

import functools
import inspect
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import MISSING, Field, dataclass, fields
from typing import Annotated, Any, ClassVar, TypeVar, get_args, get_origin

import typer

from crane.common.errors import InputError
from crane.common.number_text import check_digits
from crane.common.unit_conversions import UnitError, parse_number

# Commands import what they need when they run, so that `crane --help` answers at once.

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_METAVARS = {"s": "SECONDS", "Hz": "HZ", "m": "M", "kg": "KG", "deg": "DEG", "": "FRACTION"}
_Function = TypeVar("_Function", bound=Callable[..., None])


def command(
    name: str | None = None, registry: typer.Typer = app
) -> Callable[[_Function], _Function]:
    """Register a function as a command of the program.

    Arguments come first in the help, then the command's own options, then those of its blocks.

    Args:
        name: Name of the command; the function's name by default.
        registry: The program, or the group of commands that it belongs to.

    Returns:
        The decorator, which returns the function itself.
    """

    def register(function: _Function) -> _Function:
        own, shared, blocks = [], [], {}
        for parameter in inspect.signature(function).parameters.values():
            if inspect.isclass(kind := parameter.annotation) and issubclass(kind, OptionBlock):
                blocks[parameter.name] = kind
                shared += kind.parameters()
            else:
                own.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

        @functools.wraps(function)
        def run(**values: Any) -> None:
            for key, block in blocks.items():
                values[key] = block(**{x.name: values.pop(x.name) for x in fields(block)})
                values[key].check()
            function(**values)

        parameters = [
            x.replace(annotation=_with_plain_numbers(x.annotation)) for x in (*own, *shared)
        ]
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {x.name: x.annotation for x in parameters}
        registry.command(name)(run)
        return function

    return register


@dataclass(frozen=True, kw_only=True)
class OptionBlock:
    """Options that several commands share: the fields of a subclass, annotated for Typer.

    Attributes:
        panel: Heading of the options in the help of a command.
    """

    panel: ClassVar[str]

    def check(self) -> None:
        """Raise an error that is certain before anything is computed."""

    @classmethod
    def parameters(cls) -> list[inspect.Parameter]:
        """The options as parameters of a function."""
        return [
            inspect.Parameter(
                field.name, inspect.Parameter.KEYWORD_ONLY,
                default=inspect.Parameter.empty if field.default is MISSING else field.default,
                annotation=_in_panel(field.type, cls.panel),
            )
            for field in fields(cls)
        ]  # fmt: skip

    def given_options(self) -> dict[str, object]:
        """Values of the options that are given, by names as "--from"."""
        values = {field: getattr(self, field.name) for field in fields(self)}
        return {_option_name(x): y for x, y in values.items() if y not in (x.default, [], ())}

    def refuse(self, text: str) -> None:
        """Raise an error if any of the options is given.

        Args:
            text: What is wrong with it, and what to do.

        Raises:
            InputError: About the first option that is given.
        """
        refuse_options(self.given_options(), text)


def _in_panel(annotation: Any, panel: str) -> Any:
    assert get_origin(annotation) is Annotated, "options are annotated"
    kind, option = get_args(annotation)
    option = copy(option)
    option.rich_help_panel = panel
    return Annotated[kind, option]


def _with_plain_numbers(annotation: Any) -> Any:
    """The annotation of an option, whose number consists of digits as in files."""
    if get_origin(annotation) is not Annotated:
        return annotation
    kind, option = get_args(annotation)
    number = next((x for x in (int, float) if x in (kind, *get_args(kind))), None)
    if number is None or option.parser is not None:
        return annotation

    def parse(text: Any) -> float:
        try:
            check_digits(str(text))
            value: float = number(text)
        except ValueError:
            raise typer.BadParameter(f"{text!r} is not a valid {parse.__name__}.") from None
        if option.min is not None and not option.min <= value <= option.max:
            raise typer.BadParameter(f"{text} is not in the range {option.min} to {option.max}.")
        return value

    option, parse.__name__ = copy(option), number.__name__
    option.parser = parse
    return Annotated[kind, option]


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


def _option_name(field: "Field[Any]") -> str:
    declared = get_args(field.type)[1].default  # where Typer has the first name of an option
    return declared if isinstance(declared, str) else f"--{field.name.replace('_', '-')}"


def refuse_options(values: Mapping[str, object], text: str) -> None:
    """Raise an error about the first option that is given.

    Args:
        values: Values of options by name; None, False and [] are not given.
        text: What is wrong with it, and what to do.

    Raises:
        InputError: An option is given.
    """
    for name, value in values.items():
        if not (value is None or value is False or value == []):
            raise InputError(f"{name} {text}")
