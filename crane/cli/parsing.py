"""Values of options and arguments from their text: NAME=VALUE, ranges, windows, loads, priors."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import crane
from crane.common.errors import InputError
from crane.common.number_text import parse_float
from crane.common.unit_conversions import UnitError, is_quantity, parse_number

if TYPE_CHECKING:
    from crane.common.samples import Array
    from crane.description.estimation_settings import ParameterPrior, TermValues

CONFIGURATION_FORM = "JOINT=VALUE,..., as in q1=0.1,X1=0.02"
_VALUE_FORM = "JOINT=VALUE, as in X1=0.5"
_FIT_FORM = "NAME, NAME=START, or NAME=START,LOW~HIGH"
_TERM_FORM = "NAME, NAME=NUMBERS or NAME=off, as in q1.presliding=1e-4"
_TRIAL_FORM = "each NAME=VALUES once, as bandwidth=2,5,10 or bodies=1%,10%"
_PRIOR_FORM = "NAME=STD, as in bodies=10%, q1.viscous=50 or q1.viscous=200+-50, a share, or none"
_GRID_FORM, _RANGE_FORM = "NAME=start:stop:count", "NAME=low~high"
_MAX_GRID_VALUES = 10_000  # of one parameter
_MAX_SLEW_ANGLES = 8  # that a page has room for
_Value = TypeVar("_Value")
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


def parse_names(text: str | None) -> list[str] | None:
    """Names in a list with commas; None if there is no list."""
    return None if text is None else [word.strip() for word in text.split(",") if word.strip()]


def _parse_named(
    option: str,
    texts: Sequence[str] | None,
    form: str,
    parse: Callable[[str, str | None], _Value],
) -> dict[str, _Value]:
    """Values by name from texts NAME=VALUE or NAME.

    Args:
        option: Name of the option, for errors.
        texts: The texts.
        form: The form that an error asks for.
        parse: Returns the value for a name and its text, None of a name alone.

    Raises:
        InputError: A text has another form, or a name is given twice.
    """
    values: dict[str, _Value] = {}
    for text in texts or ():
        name, equals, value = text.rpartition("=") if "=" in text else (text, "", "")
        name = name.strip()
        try:
            parsed = parse(name, value if equals else None)
        except UnitError as error:
            raise InputError(f"{option} is '{text}', {error}") from None
        except (InputError, TypeError, ValueError):
            name = ""
        if not name:
            raise InputError(f"{option} is '{text}', write {form}")
        if name in values:
            raise InputError(f"{option} names '{name}' twice, give it once")
        values[name] = parsed
    return values


def parse_changes(
    option: str, texts: Sequence[str] | None, form: str = _VALUE_FORM
) -> dict[str, float | str]:
    """Numbers by name from texts NAME=VALUE, those with units as texts for `crane.load`.

    Args:
        option: Name of the option, for errors.
        texts: The texts.
        form: The form that an error asks for.

    Raises:
        InputError: A text has another form, a name is given twice, or a number is out of range.
    """
    from crane.common.samples import as_number

    def parse(_: str, value: str | None) -> float | str:
        return str(value) if is_quantity(value or "") else parse_float(value or "")

    values = _parse_named(option, texts, form, parse)
    return {
        name: value if isinstance(value, str) else as_number(value, f"{option} {name}", "")
        for name, value in values.items()
    }


def parse_values(
    option: str,
    texts: Sequence[str] | None,
    units_of: UnitsOf,
    form: str = _VALUE_FORM,
) -> dict[str, float]:
    """Numbers by name from texts NAME=VALUE, in SI units.

    Args:
        option: Name of the option, for errors.
        texts: The texts.
        units_of: Returns the SI units that a name may have.
        form: The form that an error asks for.

    Raises:
        InputError: A text has another form, a name is given twice, or a number is out of range.
    """
    from crane.common.samples import as_number

    values = _parse_named(
        option, texts, form, lambda name, value: _named_number(name, value or "", units_of)
    )
    return {name: as_number(value, f"{option} {name}", "") for name, value in values.items()}


def parse_configuration(option: str, text: str | None, units_of: UnitsOf) -> dict[str, float]:
    """Numbers by joint from JOINT=VALUE,JOINT=VALUE.

    Raises:
        InputError: As `parse_values`.
    """
    return parse_values(option, text.split(",") if text else None, units_of, CONFIGURATION_FORM)


def _named_number(name: str, text: str, units_of: UnitsOf) -> float:
    """A plain number, of whatever it is, or one in a unit of what is named."""
    return parse_number(text, units_of(name) if is_quantity(text) else ())


def parse_arguments(texts: Sequence[str] | None) -> dict[str, str]:
    """Arguments of xacro files by name from NAME:=VALUE.

    Raises:
        InputError: A text has another form.
    """
    values = {}
    for text in texts or ():
        name, separator, value = text.partition(":=")
        if not separator or not name.strip():
            raise InputError(f"--arg is '{text}', write NAME:=VALUE")
        values[name.strip()] = value
    return values


def parse_window(text: str | None) -> tuple[float, float]:
    """Start and end [s] of the training data from FROM:TO; unbounded if there is no text.

    Raises:
        InputError: The text has another form.
    """
    first, colon, last = (text or ":").partition(":")
    try:
        start, end = (parse_number(text, ("s",)) for text in (first or "-inf", last or "inf"))
    except (UnitError, ValueError):
        start, end = 0.0, 0.0
    if not colon or not start < end:
        raise InputError(f"--train is '{text}', write FROM:TO in seconds, as 0:13.5")
    return start, end


def parse_numbers(texts: Sequence[str], message: str, units: Sequence[str]) -> list[float]:
    """Numbers of texts, in SI units.

    Args:
        texts: The texts.
        message: The error where a text is no number.
        units: SI units that they may have.

    Raises:
        InputError: A text is no number, or one of something else.
    """
    try:
        return [parse_number(text, units) for text in texts]
    except UnitError as error:
        raise InputError(f"{message}, {error}") from None
    except ValueError:
        raise InputError(message) from None


def parse_gravity(text: str) -> tuple[float, ...]:
    """Acceleration of gravity (3,) [m/s2] from X,Y,Z.

    Raises:
        InputError: The text has another form.
    """
    message = f"--gravity is '{text}', write X,Y,Z in m/s2, as 0,0,-1.62"
    numbers = parse_numbers(text.split(","), message, ("m/s2",))
    if len(numbers) != 3 or not all(map(isfinite, numbers)):
        raise InputError(message)
    return tuple(numbers)


def parse_slew_angles(text: str) -> list[float]:
    """Angles [deg] in a list with commas.

    Raises:
        InputError: The text has another form, or there are too many angles.
    """
    message = f"--slew is '{text}', write degrees, as 0,45,90"
    angles = parse_numbers(text.split(","), message, ("deg",))
    if len(angles) > _MAX_SLEW_ANGLES:
        raise InputError(
            f"--slew has {len(angles)} angles, a page has room for {_MAX_SLEW_ANGLES}"
        )
    return angles


def parse_fits(texts: Sequence[str], units_of: UnitsOf) -> dict[str, object]:
    """What is fitted, by name: None, an initial guess, or initial guess, lower and upper bound.

    Args:
        texts: The texts.
        units_of: Returns the SI units that a name may have.

    Raises:
        InputError: A text has another form, or a name is given twice.
    """

    def parse(name: str, text: str | None) -> object:
        if text is None:
            return None
        start, comma, bounds = text.partition(",")
        words = [start, *(bounds.split("~") if comma else ())]
        if "~" in start:
            raise ValueError
        numbers = [_named_number(name, word, units_of) for word in words]
        if len(numbers) == 2:
            raise ValueError
        return tuple(numbers) if comma else numbers[0]

    return _parse_named("--fit", texts, _FIT_FORM, parse)


def parse_terms(
    texts: Sequence[str] | None, turns: Mapping[str, bool]
) -> "dict[str, TermValues | None]":
    """Values of model terms by name; None of terms that are off.

    Args:
        texts: The texts.
        turns: Whether each joint turns, for the units of the values.

    Raises:
        InputError: A text has another form, or a name is given twice.
    """
    from crane.description.estimation_settings import estimation_units

    def parse(name: str, values: str | None) -> "TermValues | None":
        if values == "off":
            return None
        words = [] if values in (None, "on") else str(values).split(",")
        return tuple(
            parse_number(x, estimation_units(name, turns, i)) for i, x in enumerate(words)
        )

    return _parse_named("--term", texts, _TERM_FORM, parse)


def parse_priors(
    texts: Sequence[str] | None, turns: Mapping[str, bool]
) -> "dict[str, ParameterPrior] | None":
    """Priors by name, "*" of one without a name; None of the text "none".

    For the arguments see `parse_terms`.

    Raises:
        InputError: A text has another form, or a name is given twice.
    """
    from crane.description.estimation_settings import ParameterPrior, estimation_units

    if texts and list(texts) == ["none"]:
        return None
    priors: dict[str, ParameterPrior] = {}
    for text in texts or ():
        name, equals, value = text.rpartition("=")
        name = name.strip() if equals else "*"
        try:
            prior = ParameterPrior.parse(value, estimation_units(name, turns))
        except UnitError as error:
            raise InputError(f"--prior {name}: {error}") from None
        except InputError:
            raise InputError(f"--prior is '{text}', write {_PRIOR_FORM}") from None
        if name in priors:
            raise InputError(f"--prior says two things of '{name}', give one")
        is_whole = bool(equals) or prior.is_open
        priors[name] = prior if is_whole else dataclasses.replace(prior, relative=True, text="")
    return priors


def parse_trials(
    texts: Sequence[str] | None, turns: Mapping[str, bool]
) -> "dict[str, list[float | ParameterPrior]]":
    """Values for cross-validation by name: bandwidths, or priors of parameters.

    For the arguments see `parse_terms`.

    Raises:
        InputError: A text has another form, or a name is given twice.
    """
    from crane.description.estimation_settings import ParameterPrior, estimation_units

    def parse(name: str, values: str | None) -> "list[float | ParameterPrior]":
        words = (values or "").split(",")
        return [
            parse_number(x, ("Hz",))
            if name == "bandwidth"
            else ParameterPrior.parse(x, estimation_units(name, turns))
            for x in words
        ]

    return _parse_named("--try", texts, _TRIAL_FORM, parse)


def parse_grids(texts: Sequence[str] | None, units_of: UnitsOf) -> "dict[str, Array]":
    """Values by parameter from NAME=start:stop:count.

    Args:
        texts: The texts.
        units_of: Returns the SI units that a parameter may have.

    Raises:
        InputError: A text has another form, or a name is given twice.
    """
    import numpy as np

    def parse(text: str, values: str) -> "Array":
        if "~" in values:
            raise InputError(f"--vary {text}: a range is drawn from, say how often with --draws")
        words = values.split(":")
        if len(words) != 3:
            raise InputError(f"--vary {text}: '{values}' is no grid, give {_GRID_FORM}")
        start, stop = _finite_numbers(text, words[:2], _GRID_FORM, units_of)
        count = int(words[2]) if words[2].strip().isdecimal() and words[2].isascii() else 0
        if not 1 <= count <= _MAX_GRID_VALUES:
            raise InputError(
                f"--vary {text}: '{words[2]}' is no count of 1 to {_MAX_GRID_VALUES}, "
                f"give {_GRID_FORM}"
            )
        if count == 1 and start != stop:
            raise InputError(f"--vary {text}: one value cannot be both ends, give a larger count")
        return np.linspace(start, stop, count)

    return _parse_varied(texts, parse)


def parse_ranges(texts: Sequence[str], units_of: UnitsOf) -> dict[str, tuple[float, float]]:
    """Ends of ranges by parameter from NAME=low~high.

    Args:
        texts: The texts.
        units_of: Returns the SI units that a parameter may have.

    Raises:
        InputError: A text has another form, or a name is given twice.
    """

    def parse(text: str, values: str) -> tuple[float, float]:
        if "~" not in values:
            raise InputError(f"--vary {text}: give a range, {text.partition('=')[0]}=low~high")
        words = values.split("~")
        if len(words) != 2:
            raise InputError(f"--vary {text}: a range has two ends, give {_RANGE_FORM}")
        low, high = _finite_numbers(text, words, _RANGE_FORM, units_of)
        if not low < high:
            raise InputError(f"--vary {text}: {low:g} is not below {high:g}, give {_RANGE_FORM}")
        return low, high

    return _parse_varied(texts, parse)


def _parse_varied(
    texts: Sequence[str] | None, parse: Callable[[str, str], _Value]
) -> dict[str, _Value]:
    """Values by parameter; `parse` gets NAME=VALUES for errors, and VALUES."""

    def check(_: str, values: str | None) -> str:
        if not values or values.isspace():
            raise ValueError
        return values

    varied = _parse_named("--vary", texts, f"{_GRID_FORM}, or {_RANGE_FORM}", check)
    return {name: parse(f"{name}={values}", values) for name, values in varied.items()}


def _finite_numbers(text: str, words: list[str], form: str, units_of: UnitsOf) -> list[float]:
    message = f"--vary {text}: '{':'.join(words)}' are no numbers, give {form}"
    units = units_of(text.partition("=")[0]) if any(map(is_quantity, words)) else ()
    numbers = parse_numbers(words, message, units)
    if not all(map(isfinite, numbers)):
        raise InputError(message)
    return numbers


def parse_load(text: str) -> "crane.Wrench":
    """External force from FRAME=FX,FY,FZ, FRAME=FX,FY,FZ,MX,MY,MZ or FRAME=FILE.

    Raises:
        InputError: The text has another form.
        RecordingError: A file cannot be read.
    """
    head, equals, wrench = text.partition("=")
    frame, _, axes = head.partition("@")
    what = f"--load {text!r}"
    if not equals or not frame or not wrench:
        raise InputError(f"{what} is no FRAME=WRENCH, give one such as tip=0,0,-1000")
    axes = axes or "world"
    if Path(wrench).suffix.lower() in (".csv", ".npz"):
        from crane.recordings.wrench_file import read_wrench  # slow to import

        return read_wrench(Path(wrench), frame, axes)
    message = f"{what}: give 3 or 6 numbers with commas, or a CSV file"
    words = wrench.split(",")
    numbers = parse_numbers(words[:3], message, ("N",))
    numbers += parse_numbers(words[3:], message, ("N m",))
    if len(numbers) not in (3, 6):
        raise InputError(message)
    return crane.Wrench(frame, numbers[:3], numbers[3:] or (0.0, 0.0, 0.0), axes=axes)
