"""The sections of a machine file on its sensors and on what an identification estimates."""

import math
from typing import Any

from crane.common.errors import InputError, suggest_names
from crane.common.units import accepted_units
from crane.description.estimation_settings import EstimationSettings, ParameterPrior, TermValues
from crane.description.sensors import (
    SENSOR_PARAMETERS,
    TIME,
    VALVE_SIGNAL_PREFIX,
    Sensor,
    quantity_names,
    quantity_unit,
    signal_delay_error,
)
from crane.formats.machine_file.structure_sections import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.machine_file.yaml_values import as_boolean, as_float
from crane.machine.machine import Machine


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
        raise section.error_at(name, f"{label}, give on, off, a number or a list of numbers")
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


def read_sensors(top: YamlSection, tree: TreeBuilder) -> dict[str, Sensor]:
    """Sensors by the quantity that they measure."""

    def read_sensor(name: str, item: YamlSection) -> Sensor:
        unit = quantity_unit(tree.tree, name)
        if unit is None:
            known = suggest_names(quantity_names(tree.tree), name)
            raise tree.unknown_name_error(
                str(item.error_at(None, f"'{name}' is no quantity of this machine, {known}"))
            )
        units = accepted_units(unit)
        if "unit" in item and (given := item.text("unit")) not in units:
            raise item.error_at(
                "unit", f"'{name}' is in [{given}], give {' or '.join(units) or 'no unit'}"
            )
        if name == TIME and any(key in item for key in SENSOR_PARAMETERS):
            raise item.error_at(None, "time has a column and a unit, and no numbers of a sensor")
        if name.startswith(VALVE_SIGNAL_PREFIX) and "delay" in item:
            raise item.error_at("delay", str(signal_delay_error(name, name)))
        try:
            return Sensor(**item.values())
        except InputError as error:
            raise item.error_at(None, f"'{name}': {error}") from None

    return top.read_map("sensors", read_sensor)
