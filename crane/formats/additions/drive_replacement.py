"""What a machine that is being written loses with the joint that was driven before."""

import warnings

from crane.common.errors import CraneWarning
from crane.formats.machine_file.machine_writer import MachineDraft
from crane.machine import Machine


def replace_drive(draft: MachineDraft, machine: Machine, name: str, joint: str | None) -> None:
    """Name the cylinder as driven, in place of a joint, and drop what belonged to that joint."""
    active, free = draft.data["active"], draft.data["free"]
    if joint in active:
        active[active.index(joint)] = name
    else:
        active.append(name)
    draft.data["free"] = [other for other in free if other != joint]
    removed = []
    if draft.data["control"]:
        draft.data["control"] = {}
        removed.append("gains")
    tasks = {key: task for key, task in draft.data["tasks"].items() if "tip" in task}
    if len(tasks) < len(draft.data["tasks"]):
        draft.data["tasks"] = tasks
        removed.append("tasks of active joints")
    cylinders = draft.data.get("hydraulics", {}).get("cylinders", {})
    if joint in cylinders:
        for section in draft.data["hydraulics"].values():
            section.pop(joint, None)
        removed.append(f"the hydraulics of {joint}")
        if not cylinders:
            del draft.data["hydraulics"]
    if removed:
        warnings.warn(
            f"{machine.name}: {', '.join(removed)} belonged to the active joints as they were, "
            f"left "
            "out: write those of the new ones",
            CraneWarning,
            stacklevel=4,
        )
