"""The section `sensors` of machine files."""

from crane.common.errors import InputError, known
from crane.common.units import spellings
from crane.description.findings import recoverable
from crane.description.sensors import (
    NUMBERS,
    SIGNAL,
    TIME,
    Sensor,
    late_signal,
    quantities,
    unit_of,
)
from crane.formats.machine_file.section import Section
from crane.formats.machine_file.tree_builder import TreeBuilder


def read_sensors(top: Section, tree: TreeBuilder) -> dict[str, Sensor]:
    """Sensors by what they measure."""
    found: dict[str, Sensor] = {}
    for name, item in top.mappings("sensors", "sensor", "column", "unit", *NUMBERS):
        with recoverable(harmless=True):
            found[name] = _sensor(name, item, tree)
    return found


def _sensor(name: str, item: Section, tree: TreeBuilder) -> Sensor:
    unit = unit_of(tree.tree, name)
    if unit is None:
        problem = f"'{name}' is no quantity of this machine, {known(quantities(tree.tree), name)}"
        raise tree.unknown(str(item.fail(None, problem)))
    given = item.text("unit", "")
    if given and given not in spellings(unit):
        problem = f"'{name}' is in [{given}], give {' or '.join(spellings(unit)) or 'no unit'}"
        raise item.fail("unit", problem)
    if name == TIME and any(key in item for key in NUMBERS):
        raise item.fail(None, "time has a column and a unit, and no numbers of a sensor")
    if name.startswith(SIGNAL) and "delay" in item:
        raise item.fail("delay", str(late_signal(name, name)))
    default = Sensor()
    numbers = {key: item.number(key, getattr(default, key)) for key in NUMBERS}
    try:
        return Sensor(item.text("column", ""), given, **numbers)
    except InputError as error:
        raise item.fail(None, f"'{name}': {error}") from None
