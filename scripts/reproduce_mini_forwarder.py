"""Repeat the reduced-scale forwarder paper: compare its tables and figures with this package.

    python scripts/reproduce_mini_forwarder.py                        # print
    python scripts/reproduce_mini_forwarder.py --write docs/validation/mini_forwarder.md

Nothing is fitted to the published values except the two pins that the paper does not give.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
from forwarder import figures, page
from forwarder.paper import SMOOTH, TASKS
from forwarder.runs import (
    FORMULATIONS,
    READINGS,
    Run,
    cycle_work,
    feasible_set,
    neglected,
    percentage_error,
    run_of,
    simulate,
    tip_errors,
)
from rig import Rig

import crane
from crane.common.atomic_output import replace_file

SEED = 1  # of the virtual rig that is shown
RIGS = 12  # how many in all
DRAWS = 40  # of the feasible set, per kind of variation


def exact_wins(
    rig: Rig,
    paths: dict[str, crane.motion.Trajectory],
    runs: dict[str, dict[tuple[str, str], Run]],
) -> np.ndarray:
    """(3, 3) tasks and signals where the exact form comes closer to a rig's measurement."""
    out = []
    for task, path in paths.items():
        recording = rig.run(path, label=task)
        exact, decoupled = (
            percentage_error(recording.time, recording.tau, runs[task][name, "braking"].tau)[0]
            for name in FORMULATIONS
        )
        out.append(exact < decoupled)
    return np.array(out)


def main() -> None:
    """Compute, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="page to write, figures go beside it")
    parser.add_argument("--draws", type=int, default=DRAWS, help="of the feasible set")
    parser.add_argument("--rigs", type=int, default=RIGS, help="virtual rigs")
    options = parser.parse_args()
    warnings.simplefilter("ignore", crane.CraneWarning)
    machine, rough = crane.load("mini_forwarder", SMOOTH), crane.load("mini_forwarder")
    rig = Rig(rough, SEED)
    paths = {task: crane.task_trajectory(machine, task) for task in TASKS}
    runs: dict[str, dict[tuple[str, str], Run]] = {}
    measured: dict[str, Run] = {}
    for task, path in paths.items():
        runs[task] = {
            (formulation, reading): simulate(machine, path, formulation, reading)
            for formulation in FORMULATIONS
            for reading in READINGS
        }
        recording = rig.run(path, label=task)
        measured[task] = run_of(recording, path, recording.tau)
    wins = {seed: exact_wins(Rig(rough, seed), paths, runs) for seed in range(1, options.rigs + 1)}
    sensitivity = page.Ranges(feasible_set(options.draws, seed=0), options.draws)
    parts = [
        page.scoreboard(runs, sensitivity),
        page.rig_errors(runs, measured, rig, wins),
        page.sensitivity(sensitivity),
        page.neglected(neglected(machine), cycle_work(machine)),
        page.tracking({task: tip_errors(machine, path) for task, path in paths.items()}),
        page.misprints(),
    ]
    text = page.whole(parts)
    print(text)
    if options.write is None:
        return
    folder = options.write.parent / "images"
    braking = {
        task: {name: runs[task][name, "braking"] for name in FORMULATIONS} for task in TASKS
    }
    for number, task in enumerate(TASKS, 1):
        shown = {"virtual rig": measured[task], **braking[task]}
        reference = paths[task](measured[task].time)[:2]
        figure = figures.trajectory(number, shown, reference)
        figures.save(figure, folder / f"mini_forwarder_{number}.png")
    rms = {task: {name: run.rms for name, run in both.items()} for task, both in braking.items()}
    ranges = {
        task: {name: np.array(sensitivity.over(task, name, "all")) for name in FORMULATIONS}
        for task in TASKS
    }
    figures.save(figures.scoreboard(rms, ranges), folder / "mini_forwarder_scoreboard.png")
    with replace_file(options.write) as part:
        part.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
