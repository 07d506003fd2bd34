"""Tasks of levers that are held until joints have come somewhere: `phases`."""

from crane.description.findings import UnknownNames, error_recovery
from crane.description.specification import DEFAULT_RAMP_TIME, Task
from crane.description.task_phases import Phase
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection

_OTHER_MOTION_KEYS = ("tip", "active", "via", "joystick")


def read_phased_task(
    name: str,
    item: YamlSection,
    start_positions: dict[str, float],
    valves: tuple[str, ...],
    tree: TreeBuilder,
    home: dict[str, float],
) -> Task:
    """A task of phases, which begins at home but for `start_positions`.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    for key in _OTHER_MOTION_KEYS:
        if key in item:
            raise item.error_at(key, f"task '{name}' has phases and '{key}', give one of both")
    if "duration" in item:
        raise item.error_at(
            "duration", f"task '{name}' ends when its last phase does, leave 'duration' out"
        )
    limits = {x: (joint.limits.lower, joint.limits.upper) for x, joint in tree.joints.items()}
    positions = {  # what is beyond the limits is told at home
        joint: position
        for joint, position in (home | start_positions).items()
        if joint not in limits or limits[joint][0] <= position <= limits[joint][1]
    }
    phases: list[Phase] = []
    for section in item.sections("phases", "phase", "name", "levers", "until", "within"):
        with error_recovery():
            phase = _read_phase(section)
            if not isinstance(valves, UnknownNames):
                for part, joint, problem in phase.find_problems(valves, limits, positions):
                    inner = section.section(part, part) if joint else None
                    raise (inner or section).error_at(joint or part, problem)
            positions |= phase.until
            phases.append(phase)
    if not phases and not item.raw_value("phases"):
        raise item.error_at("phases", f"task '{name}' has no phases, give one at least")
    ramp = item.number("ramp", DEFAULT_RAMP_TIME, minimum=0.0)
    max_duration = sum(phase.within for phase in phases)
    return Task(
        name, item.text("description", ""), max_duration, "joystick", {}, start=start_positions,
        phases=tuple(phases), ramp=ramp,
    )  # fmt: skip


def _read_phase(section: YamlSection) -> Phase:
    name, within = section.text("name"), section.number("within")
    levers, until = (
        {joint: part.number(joint) for joint in part}
        if (part := section.section(key, f"'{key}' of phase '{name}'")) is not None
        else {}
        for key in ("levers", "until")
    )
    return Phase(name, levers, until, within)
