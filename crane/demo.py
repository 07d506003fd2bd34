"""The demonstration: every task of a bundled machine under its PI controllers."""

import warnings
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import Manager, get_context
from pathlib import Path
from queue import Empty
from time import monotonic
from typing import Any

from crane.control import PI
from crane.errors import CraneWarning
from crane.machine import load
from crane.output import replacing
from crane.paths import task_path
from crane.runs import SUMMARY, write_run, write_views
from crane.simulation import Progress, simulate

MACHINE = "mini_forwarder"


def run_demo(folder: Path, progress: Progress) -> str:
    """Simulate the three published trajectories of the reduced-scale forwarder.

    Args:
        folder: Where results go, one folder per task; created where there is none.
        progress: Called with the finished share, 0 to 1.

    Returns:
        The summary of all tasks, Markdown.
    """
    tasks = list(load(MACHINE).tasks)
    shares = dict.fromkeys(tasks, 0.0)
    context = get_context("spawn")  # forking a process that has threads may hang
    with Manager() as manager, ProcessPoolExecutor(2, mp_context=context) as pool:
        queue = manager.Queue()
        started = [pool.submit(_run_task, task, folder, queue) for task in tasks]
        while not all(future.done() for future in started):
            try:
                task, share = queue.get(timeout=0.2)
            except Empty:
                continue
            shares[task] = share
            progress(sum(shares.values()) / len(shares))
        texts = [future.result() for future in started]
    text = "\n".join(texts)
    with replacing(folder / SUMMARY) as part:
        part.write_text(text, encoding="utf-8")
    progress(1.0)
    return text


def _run_task(task: str, folder: Path, queue: Any) -> str:
    last = 0.0

    def report(share: float) -> None:
        nonlocal last
        if monotonic() - last > 0.5:
            last = monotonic()
            queue.put((task, 0.95 * share))

    with warnings.catch_warnings():  # the caller has told them
        warnings.simplefilter("ignore", CraneWarning)
        machine = load(MACHINE)
    recording = simulate(
        machine, PI(machine, task_path(machine, task)), task=task, progress=report
    )
    text = write_run(folder / task, recording, f"{machine.name}: {task}")
    write_views(folder / task, machine, recording)
    queue.put((task, 1.0))
    return text
