"""The section `tasks` of a machine file."""

import dataclasses

from crane.description.findings import error_recovery
from crane.description.machine_schema import MOTIONS
from crane.description.specification import (
    ATTITUDE_COORDINATES,
    TIP_COORDINATES,
    Phase,
    Task,
    ViaPoint,
)
from crane.formats.machine_file.force_sections import read_loads
from crane.formats.machine_file.structure_sections import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection

_TIP_HINT = "name its frame under 'tip:'"


def read_tasks(
    top: YamlSection,
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
    spaces = {"tip": TIP_COORDINATES, "active": active, "joystick": valves}

    def read_task(name: str, item: YamlSection) -> Task:
        has_phases = "phases" in item
        item.check_exclusive_keys()
        lever_key = "phases" if has_phases else "joystick"
        if lever_key in item and not valves:
            raise item.error_at(
                lever_key, f"task '{name}' moves levers of no valve, add 'hydraulics'"
            )
        if tip is None and "tip" in item:
            raise item.error_at("tip", f"task '{name}' moves the tip, {_TIP_HINT}")
        if has_phases:
            task = _read_phased_task(name, item, spaces, tree, home)
        elif "via" in item:
            task = _read_via_task(name, item, active, tip)
        else:
            task = _read_continuous_task(name, item, spaces)
        return dataclasses.replace(
            task, description=item.text("description"), loads=read_loads(item, tree, has_phases)
        )

    return top.read_map("tasks", read_task)


def _read_continuous_task(
    name: str, item: YamlSection, spaces: dict[str, tuple[str, ...]]
) -> Task:
    """A task of one of the spaces, each of which is given with the names of its coordinates."""
    duration = item.number("duration")
    space = next((key for key in spaces if key in item), None)
    motion = None if space is None else item.section(space, f"'{space}' of task '{name}'")
    if space is None or motion is None:
        raise item.error_at(None, f"task '{name}' has none of {MOTIONS}, give one")
    motion.check_keys(spaces[space])
    if space == "joystick":
        return Task(
            name,
            "",
            duration,
            space,
            {},
            item.value_map(space, lambda part, joint: _read_lever(part, joint, duration)),
            start=_read_start(name, item, spaces["active"]),
        )
    coefficients = {}
    for coordinate in spaces[space]:
        with error_recovery():
            coefficients[coordinate] = motion.numbers(coordinate)
    return Task(name, "", duration, space, coefficients)


def _read_start(name: str, item: YamlSection, active: tuple[str, ...]) -> dict[str, float]:
    """Active coordinates where levers begin."""
    title = f"'start' of task '{name}'"
    if (section := item.section("start", title)) is not None:
        section.check_keys(active)
    return item.value_map("start", YamlSection.number, title=title)


def _read_via_task(name: str, item: YamlSection, active: tuple[str, ...], tip: str | None) -> Task:
    """A task through points, in the space of the coordinates that these name."""
    tip_coordinates = sum(ATTITUDE_COORDINATES, TIP_COORDINATES)
    known_keys = active + ("time", "rates", *(x for x in tip_coordinates if x not in active))
    title = f"via point of task '{name}'"
    points = list(item.list_items("via", title))
    for point in points:
        point.check_keys(known_keys)
    if len(points) < 2:
        raise item.error_at(
            "via", f"task '{name}' has {len(points)} via points, give two at least"
        )
    via_points = [_read_via_point(point, title) for point in points]
    point_of_coordinate = {
        x: point for point, one in zip(points, via_points, strict=True) for x in one.point
    }
    joint_names = [x for x in point_of_coordinate if x in active]
    if joint_names and len(joint_names) < len(point_of_coordinate):
        other = next(x for x in point_of_coordinate if x not in active)
        raise point_of_coordinate[other].error_at(
            other, f"task '{name}' mixes '{joint_names[0]}' with '{other}', name joints or x, y, z"
        )
    for previous, via_point, point in zip(via_points, via_points[1:], points[1:], strict=False):
        if via_point.time <= previous.time:
            problem = f"times of task '{name}' go from {previous.time:g} to {via_point.time:g} s"
            raise point.error_at("time", f"{problem}, let them increase")
    if via_points[0].time != 0:
        raise points[0].error_at(
            "time",
            f"task '{name}' begins at {via_points[0].time:g} s, give its first point the time 0",
        )
    space, required = "active", active
    if not joint_names:
        if tip is None:
            raise item.error_at("via", f"task '{name}' moves the tip, {_TIP_HINT}")
        attitude = _attitude_coordinates(
            name, point_of_coordinate, list(zip(points, via_points, strict=True))
        )
        space, required = "tip", TIP_COORDINATES + attitude
    for i, which in ((0, "first"), (-1, "last")):
        missing = [x for x in required if x not in via_points[i].point]
        if missing:
            raise points[i].error_at(None, f"the {which} {title} has no '{missing[0]}', add it")
    return Task(
        name,
        "",
        via_points[-1].time,
        space,
        {},
        via=tuple(
            ViaPoint(one.time, {x: one.point[x] for x in required if x in one.point}, one.rates)
            for one in via_points
        ),
    )


def _read_via_point(point: YamlSection, title: str) -> ViaPoint:
    time = point.number("time")
    coordinates = {x: point.number(x) for x in point if x not in ("time", "rates")}
    if not coordinates:
        raise point.error_at(None, f"a {title} has no coordinate, name some")
    rates = point.section("rates", f"'rates' of a {title}")
    if rates is None:
        return ViaPoint(time, coordinates)
    rates.check_keys(coordinates)
    return ViaPoint(time, coordinates, {x: rates.number(x) for x in rates})


def _attitude_coordinates(
    name: str,
    point_of_coordinate: dict[str, YamlSection],
    points: list[tuple[YamlSection, ViaPoint]],
) -> tuple[str, ...]:
    groups = [
        group for group in ATTITUDE_COORDINATES if any(x in point_of_coordinate for x in group)
    ]
    if not groups:
        return ()
    if len(groups) > 1:
        raise point_of_coordinate["inclination"].error_at(
            "inclination",
            f"task '{name}' has an inclination and roll, pitch, yaw, give one of both",
        )
    for point, via in points:
        for values in (via.point, via.rates):
            if 0 < sum(x in values for x in groups[0]) < len(groups[0]):
                x = next(x for x in groups[0] if x in values)
                problem = f"task '{name}' has '{x}' without the others of roll, pitch, yaw"
                raise point.error_at(x if values is via.point else "rates", f"{problem}, add them")
    return groups[0]


def _read_lever(
    section: YamlSection, joint: str, duration: float
) -> tuple[tuple[float, float], ...]:
    """A polygon [time, lever, time, lever, ...]."""
    numbers = section.numbers(joint)
    times, levers = numbers[::2], numbers[1::2]
    if len(times) != len(levers):
        raise section.error_at(
            joint, f"'{joint}' has {len(numbers)} numbers, give time, lever, time .."
        )
    is_increasing = all(a < b for a, b in zip(times, times[1:], strict=False))
    if not is_increasing or times[0] < 0 or times[-1] > duration:
        raise section.error_at(
            joint, f"times of '{joint}' do not increase within 0 to {duration:g} s"
        )
    if max(map(abs, levers)) > 1:
        raise section.error_at(
            joint, f"a lever of '{joint}' is beyond -1 to 1, the valve's whole flow"
        )
    return tuple(zip(times, levers, strict=True))


def _read_phased_task(
    name: str,
    item: YamlSection,
    spaces: dict[str, tuple[str, ...]],
    tree: TreeBuilder,
    home: dict[str, float],
) -> Task:
    """A task of levers that are held until joints have reached their positions."""
    start_positions = _read_start(name, item, spaces["active"])
    limits = {x: (joint.limits.lower, joint.limits.upper) for x, joint in tree.joints.items()}
    positions = {  # values beyond the limits are reported at home
        joint: position
        for joint, position in (home | start_positions).items()
        if joint not in limits or limits[joint][0] <= position <= limits[joint][1]
    }
    phases: list[Phase] = []
    for section in item.list_items("phases"):
        with error_recovery():
            phase_name, within = section.text("name"), section.number("within")
            levers, until = (
                section.value_map(
                    key, YamlSection.number, title=f"'{key}' of phase '{phase_name}'"
                )
                for key in ("levers", "until")
            )
            phase = Phase(phase_name, levers, until, within)
            for part, joint, problem in phase.find_problems(spaces["joystick"], limits, positions):
                inner = section.section(part, part) if joint else None
                raise (inner or section).error_at(joint or part, problem)
            positions |= phase.until
            phases.append(phase)
    if not phases and not item.raw_value("phases"):
        raise item.error_at("phases", f"task '{name}' has no phases, give one at least")
    return Task(
        name, "", sum(phase.within for phase in phases), "joystick", {}, start=start_positions,
        phases=tuple(phases), ramp=item.number("ramp"),
    )  # fmt: skip
