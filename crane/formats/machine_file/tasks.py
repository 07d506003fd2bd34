"""The section `tasks` of a machine file."""

import dataclasses
from collections.abc import Sequence

from crane.description.findings import Anything, flag, recoverable
from crane.description.spec import ATTITUDES, TIP, Task, Via
from crane.formats.machine_file.outside import read_loads
from crane.formats.machine_file.phases import phased_task
from crane.formats.machine_file.section import Section
from crane.formats.machine_file.tree_builder import TreeBuilder

_MOTIONS = "'tip', 'active', 'via', 'joystick', 'phases'"


def read_tasks(
    top: Section,
    tree: TreeBuilder,
    active: tuple[str, ...],
    tip: str | None,
    valves: tuple[str, ...],
    home: dict[str, float],
) -> dict[str, Task]:
    """Named motions.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    tasks = {}
    keys = (
        "description", "duration", "tip", "active", "via", "joystick", "phases", "ramp", "start",
        "loads",
    )  # fmt: skip
    for name, item in top.mappings("tasks", "task", *keys):
        with recoverable():
            spaces = {"tip": TIP, "active": active, "joystick": valves}
            phased = "phases" in item
            levers = "phases" if phased else "joystick"
            if levers in item and not valves:
                problem = f"task '{name}' moves levers of no valve, add 'hydraulics'"
                raise item.fail(levers, problem)
            if phased:
                task = phased_task(name, item, _start(name, item, active), valves, tree, home)
            else:
                task = _task(name, item, spaces, tip)
            tasks[name] = dataclasses.replace(task, loads=tuple(read_loads(item, tree, phased)))
    return tasks


def _task(name: str, item: Section, spaces: dict[str, tuple[str, ...]], tip: str | None) -> Task:
    """A task of one of the spaces, each of which is given with the names of its coordinates."""
    if "ramp" in item:
        raise item.fail("ramp", f"task '{name}' has no phases, leave 'ramp' to these")
    if "via" in item:
        return _via_task(name, item, spaces, tip)
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
        raise item.fail(None, f"task '{name}' has {count} of {_MOTIONS}, give one")
    space, motion = given[0]
    if space == "tip":
        _check_tip(name, item, "tip", tip)
    if not isinstance(spaces[space], Anything):
        motion.only(*spaces[space])
    description = item.text("description", "")
    if space == "joystick":
        start = _start(name, item, spaces["active"])
        return Task(name, description, duration, space, {}, _levers(motion, duration), start=start)
    if "start" in item:
        raise item.fail(
            "start", f"task '{name}' starts where its motion does, leave 'start' to levers"
        )
    return Task(name, description, duration, space, _polynomials(motion, spaces[space]))


def _check_tip(name: str, item: Section, key: str, tip: str | None) -> None:
    if tip is None:
        raise item.fail(key, f"task '{name}' moves the tip, name its frame under 'tip:'")


def _start(name: str, item: Section, active: tuple[str, ...]) -> dict[str, float]:
    """Active coordinates where levers begin."""
    section = item.section("start", f"'start' of task '{name}'")
    if section is None:
        return {}
    if not isinstance(active, Anything):
        section.only(*active)
    return {joint: section.number(joint) for joint in section}


def _via_task(
    name: str, item: Section, spaces: dict[str, tuple[str, ...]], tip: str | None
) -> Task:
    """A task through points, in the space of the coordinates that these name."""
    for key in ("tip", "active", "joystick"):
        if key in item:
            raise item.fail(key, f"task '{name}' has more than one of {_MOTIONS}, give one")
    for key, why in {"duration": "ends at its last point", "start": "starts at its first"}.items():
        if key in item:
            raise item.fail(key, f"task '{name}' {why}, leave '{key}' out")
    active, attitude = spaces["active"], tuple(x for group in ATTITUDES for x in group)
    every = active
    if not isinstance(active, Anything):
        every = (*active, *(x for x in (*TIP, *attitude) if x not in active))
    title = f"via point of task '{name}'"
    keys = () if isinstance(active, Anything) else ("time", "rates", *every)
    points = list(item.sections("via", title, *keys))
    if len(points) < 2:
        raise item.fail("via", f"task '{name}' has {len(points)} via points, give two at least")
    via = [_via(point, title, every) for point in points]
    named = {x: point for point, one in zip(points, via, strict=True) for x in one.point}
    strokes = [x for x in named if x in active]
    if strokes and len(strokes) < len(named):
        other = next(x for x in named if x not in active)
        problem = f"task '{name}' mixes '{strokes[0]}' with '{other}', name joints or x, y, z"
        raise named[other].fail(other, problem)
    for last, one, point in zip(via, via[1:], points[1:], strict=False):
        if one.time <= last.time:
            problem = f"times of task '{name}' go from {last.time:g} to {one.time:g} s"
            raise point.fail("time", f"{problem}, let them increase")
    if via[0].time != 0:
        problem = f"task '{name}' begins at {via[0].time:g} s, give its first point the time 0"
        raise points[0].fail("time", problem)
    space, wanted = "active", active
    if not strokes:
        _check_tip(name, item, "via", tip)
        space = "tip"
        wanted = (*TIP, *_attitude(name, named, list(zip(points, via, strict=True))))
    for point, one, which in ((points[0], via[0], "first"), (points[-1], via[-1], "last")):
        missing = [x for x in wanted if x not in one.point]
        if missing:
            raise point.fail(None, f"the {which} {title} has no '{missing[0]}', add it")
    ordered = tuple(
        Via(one.time, {x: one.point[x] for x in wanted if x in one.point}, one.rates)
        for one in via
    )
    return Task(name, item.text("description", ""), via[-1].time, space, {}, via=ordered)


def _via(point: Section, title: str, every: tuple[str, ...]) -> Via:
    """A via point with the coordinates that it names."""
    time = point.number("time", minimum=0.0)
    given = {x: point.number(x) for x in point if x not in ("time", "rates")}
    if not given:
        raise point.fail(None, f"a {title} has no coordinate, name some")
    rates = point.section("rates", f"'rates' of a {title}")
    if rates is None:
        return Via(time, given)
    if not isinstance(every, Anything):
        rates.only(*(x for x in every if x in given))
    return Via(time, given, {x: rates.number(x) for x in rates})


def _attitude(
    name: str, named: dict[str, Section], points: Sequence[tuple[Section, Via]]
) -> tuple[str, ...]:
    """Coordinates of the attitude that the points of a task name."""
    groups = [group for group in ATTITUDES if any(x in named for x in group)]
    if not groups:
        return ()
    if len(groups) > 1:
        problem = f"task '{name}' has an inclination and roll, pitch, yaw, give one of both"
        raise named["inclination"].fail("inclination", problem)
    for point, via in points:
        for given in (via.point, via.rates):
            if 0 < sum(x in given for x in groups[0]) < len(groups[0]):
                x = next(x for x in groups[0] if x in given)
                problem = f"task '{name}' has '{x}' without the others of roll, pitch, yaw"
                raise point.fail(x if given is via.point else "rates", f"{problem}, add them")
    return groups[0]


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
