"""The demonstration: a crane under its PI controllers, and an excavator that digs."""

from pathlib import Path

from crane.cli.runs import SUMMARY, write_run, write_views
from crane.cli.simulate import control_of, under_task
from crane.common.atomic_output import replace_folder
from crane.formats import load
from crane.simulation import Progress, simulate

MACHINES = "mini_forwarder", "excavator"

_SIMULATED = 0.3  # share of a task's time when it has been simulated, but not yet drawn


def run_demo(folder: Path, progress: Progress, force: bool = True) -> str:
    """Simulate the tasks of the reduced-scale forwarder and of the excavator.

    Args:
        folder: Where results go, one folder per task; created where there is none. Nothing
            appears there before everything is done; files of the same names are replaced.
        progress: Called with the finished share, 0 to 1.
        force: Whether an earlier demonstration is replaced.

    Returns:
        The summary of all tasks, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    runs = [(machine, task) for machine in map(load, MACHINES) for task in machine.tasks]
    texts = []
    with replace_folder(folder, force) as part:
        for done, (machine, task) in enumerate(runs):

            def report(share: float, done: int = done) -> None:
                progress((done + _SIMULATED * share) / len(runs))

            control = control_of(machine, task, None)
            recording = simulate(under_task(machine, task), control, label=task, progress=report)
            texts.append(write_run(part / task, recording))
            write_views(part / task, machine, recording)
        text = "\n".join(texts)
        (part / SUMMARY).write_text(text, encoding="utf-8")
    progress(1.0)
    return text
