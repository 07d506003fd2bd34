"""The section `tasks` of a machine file."""

import dataclasses

from crane.description.findings import Anything, flag, recoverable
from crane.description.spec import Task
from crane.formats.machine_file.outside import read_loads
from crane.formats.machine_file.section import Section
from crane.formats.machine_file.tree_builder import TreeBuilder


def read_tasks(
    top: Section,
    tree: TreeBuilder,
    active: tuple[str, ...],
    tip: str | None,
    valves: tuple[str, ...],
) -> dict[str, Task]:
    """Named motions.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    tasks = {}
    keys = ("description", "duration", "tip", "active", "joystick", "loads")
    for name, item in top.mappings("tasks", "task", *keys):
        with recoverable():
            spaces = {"tip": ("x", "y", "z"), "active": active, "joystick": valves}
            task = _task(name, item, spaces, tip)
            tasks[name] = dataclasses.replace(task, loads=tuple(read_loads(item, tree)))
    return tasks


def _task(name: str, item: Section, spaces: dict[str, tuple[str, ...]], tip: str | None) -> Task:
    """A task of one of the spaces, each of which is given with the names of its coordinates."""
    duration = item.number("duration", minimum=0.0)
    if duration == 0:
        flag(item.fail("duration", f"task '{name}' takes no time, give a duration"))
    given = [
        (space, section)
        for space in spaces
        if (section := item.section(space, f"'{space}' of task '{name}'")) is not None
    ]
    if len(given) != 1:
        count = "more than one" if given else "none"
        raise item.fail(
            None, f"task '{name}' has {count} of 'tip', 'active', 'joystick', give one"
        )
    space, motion = given[0]
    if space == "tip" and tip is None:
        raise item.fail("tip", f"task '{name}' moves the tip, name its frame under 'tip:'")
    if not isinstance(spaces[space], Anything):
        motion.only(*spaces[space])
    description = item.text("description", "")
    if space == "joystick":
        return Task(name, description, duration, space, {}, _levers(motion, duration))
    return Task(name, description, duration, space, _polynomials(motion, spaces[space]))


def _polynomials(section: Section, names: tuple[str, ...]) -> dict[str, tuple[float, ...]]:
    found = {}
    for name in names:
        with recoverable():
            found[name] = section.numbers(name)
    return found


def _levers(section: Section, duration: float) -> dict[str, tuple[tuple[float, float], ...]]:
    found = {}
    for joint in section:
        with recoverable():
            found[joint] = _lever(section, joint, duration)
    return found


def _lever(section: Section, joint: str, duration: float) -> tuple[tuple[float, float], ...]:
    """A polygon [time, lever, time, lever, ...]."""
    numbers = section.numbers(joint)
    times, levers = numbers[::2], numbers[1::2]
    if len(times) != len(levers):
        raise section.fail(
            joint, f"'{joint}' has {len(numbers)} numbers, give time, lever, time .."
        )
    rising = all(a < b for a, b in zip(times, times[1:], strict=False))
    if not rising or times[0] < 0 or times[-1] > duration:
        raise section.fail(joint, f"times of '{joint}' do not increase within 0 to {duration:g} s")
    if max(map(abs, levers)) > 1:
        raise section.fail(
            joint, f"a lever of '{joint}' is beyond -1 to 1, the valve's whole flow"
        )
    return tuple(zip(times, levers, strict=True))
