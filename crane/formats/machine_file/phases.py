"""Tasks of levers that are held until joints have come somewhere: `phases`."""

from crane.description.findings import Anything, recoverable
from crane.description.phases import Phase
from crane.description.spec import RAMP, Task
from crane.formats.machine_file.section import Section
from crane.formats.machine_file.tree_builder import TreeBuilder

_OTHERS = ("tip", "active", "via", "joystick")


def phased_task(
    name: str,
    item: Section,
    start: dict[str, float],
    valves: tuple[str, ...],
    tree: TreeBuilder,
    home: dict[str, float],
) -> Task:
    """A task of phases, which begins at home but for `start`.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    for key in _OTHERS:
        if key in item:
            raise item.fail(key, f"task '{name}' has phases and '{key}', give one of both")
    if "duration" in item:
        raise item.fail(
            "duration", f"task '{name}' ends when its last phase does, leave 'duration' out"
        )
    limits = {x: (joint.limits.lower, joint.limits.upper) for x, joint in tree.joints.items()}
    before = {  # what is beyond the limits is told at home
        joint: at
        for joint, at in (home | start).items()
        if joint not in limits or limits[joint][0] <= at <= limits[joint][1]
    }
    phases: list[Phase] = []
    for section in item.sections("phases", "phase", "name", "levers", "until", "within"):
        with recoverable():
            phase = _phase(section)
            if not isinstance(valves, Anything):
                for part, joint, problem in phase.problems(valves, limits, before):
                    inner = section.section(part, part) if joint else None
                    raise (inner or section).fail(joint or part, problem)
            before |= phase.until
            phases.append(phase)
    if not phases and not item.raw("phases"):
        raise item.fail("phases", f"task '{name}' has no phases, give one at least")
    ramp = item.number("ramp", RAMP, minimum=0.0)
    within = sum(phase.within for phase in phases)
    return Task(
        name, item.text("description", ""), within, "joystick", {}, start=start,
        phases=tuple(phases), ramp=ramp,
    )  # fmt: skip


def _phase(section: Section) -> Phase:
    name, within = section.text("name"), section.number("within")
    levers, until = (
        {joint: part.number(joint) for joint in part}
        if (part := section.section(key, f"'{key}' of phase '{name}'")) is not None
        else {}
        for key in ("levers", "until")
    )
    return Phase(name, levers, until, within)
