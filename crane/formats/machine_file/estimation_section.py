"""The section of a machine file on what an identification estimates, `identification`."""

import math
from typing import Any

from crane.common.errors import InputError
from crane.description.estimation_settings import EstimationSettings, ParameterPrior, TermValues
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.machine_file.yaml_values import as_boolean, as_float
from crane.machine.machine import Machine

_TERM_HINT = "on, off, a number or a list of numbers"


def read_estimation(top: YamlSection) -> EstimationSettings:
    """Terms, prior knowledge and settings; an identification checks that the names exist."""
    section = top.section("identification")
    if section is None:
        return EstimationSettings()
    return EstimationSettings(
        section.value_map("terms", _read_term),
        section.value_map("prior", _read_prior),
        section.number("bandwidth") if "bandwidth" in section else None,
        section.value_map("slow", YamlSection.number),
    )


def estimation_data(machine: Machine) -> dict[str, Any]:
    """The section as it is written."""
    settings = machine.estimation
    data = {
        "terms": {name: _term_data(numbers) for name, numbers in settings.terms.items()},
        "prior": {name: str(known) for name, known in settings.prior.items()},
        "bandwidth": settings.bandwidth,
        "slow": dict(settings.slow),
    }
    return {key: value for key, value in data.items() if value}


def _read_term(section: YamlSection, name: str) -> TermValues | None:
    """() of `on`, None of `off`."""
    value = section.raw_value(name)
    if (is_wanted := as_boolean(value)) is not None:
        return () if is_wanted else None
    if isinstance(value, str) and not math.isfinite(as_float(value)):
        label = f"'{name}' of {section.title} is '{value}'"
        raise section.error_at(name, f"{label}, give {_TERM_HINT}")
    return section.numbers(name) if isinstance(value, list) else (section.number(name),)


def _read_prior(section: YamlSection, name: str) -> ParameterPrior:
    try:
        return ParameterPrior.parse(section.raw_value(name))
    except InputError as error:
        raise section.error_at(name, f"'{name}' of 'prior': {error}") from None


def _term_data(values: TermValues | None) -> bool | float | list[float]:
    if not values:
        return values is not None
    return values[0] if len(values) == 1 else list(values)
