"""The demonstration: every task of a bundled machine under its PI controllers."""

from pathlib import Path

from crane.cli.runs import SUMMARY, write_run, write_views
from crane.common.output import staging
from crane.control import PI
from crane.formats import load
from crane.motion.trajectories import task_trajectory
from crane.simulation import Progress, simulate

MACHINE = "mini_forwarder"

_SIMULATED = 0.3  # share of a task's time when it has been simulated, but not yet drawn


def run_demo(folder: Path, progress: Progress) -> str:
    """Simulate the three published trajectories of the reduced-scale forwarder.

    Args:
        folder: Where results go, one folder per task; created where there is none. Nothing
            appears there before everything is done; files of the same names are replaced.
        progress: Called with the finished share, 0 to 1.

    Returns:
        The summary of all tasks, Markdown.

    Raises:
        OutputError: The folder or a file cannot be written.
    """
    machine = load(MACHINE)
    texts = []
    with staging(folder) as part:
        for done, task in enumerate(machine.tasks):

            def report(share: float, done: int = done) -> None:
                progress((done + _SIMULATED * share) / len(machine.tasks))

            control = PI(machine, task_trajectory(machine, task))
            recording = simulate(machine, control, label=task, progress=report)
            texts.append(write_run(part / task, recording))
            write_views(part / task, machine, recording)
        text = "\n".join(texts)
        (part / SUMMARY).write_text(text, encoding="utf-8")
    progress(1.0)
    return text
