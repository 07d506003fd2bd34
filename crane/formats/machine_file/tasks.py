"""The section `tasks` of a machine file."""

from crane.description.findings import Anything, flag, recoverable
from crane.description.spec import Task
from crane.formats.machine_file.section import Section


def read_tasks(
    top: Section, active: tuple[str, ...], tip: str | None, valves: tuple[str, ...]
) -> dict[str, Task]:
    """Named motions.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    tasks = {}
    keys = ("description", "duration", "tip", "active", "joystick")
    for name, item in top.mappings("tasks", "task", *keys):
        with recoverable():
            duration = item.number("duration", minimum=0.0)
            if duration == 0:
                flag(item.fail("duration", f"task '{name}' takes no time, give a duration"))
            spaces = {"tip": ("x", "y", "z"), "active": active, "joystick": valves}
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
            space, polynomials = given[0]
            if space == "tip" and tip is None:
                raise item.fail("tip", f"task '{name}' moves the tip, name its frame under 'tip:'")
            if not isinstance(spaces[space], Anything):
                polynomials.only(*spaces[space])
            description = item.text("description", "")
            if space == "joystick":
                levers = {}
                for joint in polynomials:
                    with recoverable():
                        levers[joint] = _lever(polynomials, joint, duration)
                tasks[name] = Task(name, description, duration, space, {}, levers)
                continue
            coefficients = {}
            for key in spaces[space]:
                with recoverable():
                    coefficients[key] = polynomials.numbers(key)
            tasks[name] = Task(name, description, duration, space, coefficients)
    return tasks


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
