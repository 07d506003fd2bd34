"""The section `sensors` of machine files."""

from crane.common.errors import InputError, suggest_names
from crane.common.units import accepted_units
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
    """Sensors by the quantity that they measure."""

    def read_sensor(name: str, item: YamlSection) -> Sensor:
        unit = quantity_unit(tree.tree, name)
        if unit is None:
            known = suggest_names(quantity_names(tree.tree), name)
            problem = f"'{name}' is no quantity of this machine, {known}"
            raise tree.unknown_name_error(str(item.error_at(None, problem)))
        units = accepted_units(unit)
        if "unit" in item and (given := item.text("unit")) not in units:
            problem = f"'{name}' is in [{given}], give {' or '.join(units) or 'no unit'}"
            raise item.error_at("unit", problem)
        if name == TIME and any(key in item for key in SENSOR_PARAMETERS):
            raise item.error_at(None, "time has a column and a unit, and no numbers of a sensor")
        if name.startswith(VALVE_SIGNAL_PREFIX) and "delay" in item:
            raise item.error_at("delay", str(signal_delay_error(name, name)))
        try:
            return Sensor(**item.values())
        except InputError as error:
            raise item.error_at(None, f"'{name}': {error}") from None

    return top.read_map("sensors", read_sensor)
