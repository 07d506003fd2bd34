"""The section `sensors` of machine files."""

from crane.common.errors import InputError, suggest_names
from crane.common.units import accepted_units
from crane.description.findings import error_recovery
from crane.description.sensors import (
    SENSOR_PARAMETERS,
    TIME,
    VALVE_SIGNAL_PREFIX,
    Sensor,
    quantity_names,
    quantity_unit,
    signal_delay_error,
)
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection


def read_sensors(top: YamlSection, tree: TreeBuilder) -> dict[str, Sensor]:
    """Sensors by what they measure."""
    found: dict[str, Sensor] = {}
    for name, item in top.mappings("sensors", "sensor", "column", "unit", *SENSOR_PARAMETERS):
        with error_recovery(harmless=True):
            found[name] = _read_sensor(name, item, tree)
    return found


def _read_sensor(name: str, item: YamlSection, tree: TreeBuilder) -> Sensor:
    unit = quantity_unit(tree.tree, name)
    if unit is None:
        problem = (
            f"'{name}' is no quantity of this machine, "
            f"{suggest_names(quantity_names(tree.tree), name)}"
        )
        raise tree.unknown_name_error(str(item.error_at(None, problem)))
    given_unit = item.text("unit", "")
    if given_unit and given_unit not in accepted_units(unit):
        problem = (
            f"'{name}' is in [{given_unit}], give {' or '.join(accepted_units(unit)) or 'no unit'}"
        )
        raise item.error_at("unit", problem)
    if name == TIME and any(key in item for key in SENSOR_PARAMETERS):
        raise item.error_at(None, "time has a column and a unit, and no numbers of a sensor")
    if name.startswith(VALVE_SIGNAL_PREFIX) and "delay" in item:
        raise item.error_at("delay", str(signal_delay_error(name, name)))
    default = Sensor()
    numbers = {key: item.number(key, getattr(default, key)) for key in SENSOR_PARAMETERS}
    try:
        return Sensor(item.text("column", ""), given_unit, **numbers)
    except InputError as error:
        raise item.error_at(None, f"'{name}': {error}") from None
