"""Repeat the experiment of the electro-hydraulic forwarder paper on a simulated full-size crane.

    python scripts/reproduce_hydraulic_forwarder.py                # print
    python scripts/reproduce_hydraulic_forwarder.py --write docs/validation/hydraulic_forwarder.md

Motions, logger with noise, Kalman estimates, averages and least squares are those of the paper,
with the functions that are used for a real crane; the results are compared with the true values.
"""

import argparse
import tempfile
import warnings
from pathlib import Path

from hydraulic_forwarder import figures, page
from hydraulic_forwarder.results import Results, compute

import crane
from crane.common.atomic_output import replace_file
from crane.view.plots.identification_figures import equation_sides_figure


def draw(found: Results, folder: Path) -> None:
    """All figures of the page."""
    for number, name in ((4, "set 1"), (5, "set 2")):
        title = f"Validation {name}"
        shown = figures.data(found.motions[name], found.references[name], title)
        figures.save(shown, folder / f"hydraulic_forwarder_{number}.png")
        judged = found.judged["closed"][name]
        shown = figures.torques(judged, found.motions[name].tau, title)
        figures.save(shown, folder / f"hydraulic_forwarder_{number + 2}.png")
    figures.save(figures.lifting(found.lifting), folder / "hydraulic_forwarder_8.png")
    titles = {f"recording {name}": both for name, both in found.held_out.items()}
    figures.save(equation_sides_figure(titles), folder / "hydraulic_forwarder_9.png")
    shown = figures.valve_and_friction(found.valves["X_ext"], found.friction, found.law)
    figures.save(shown, folder / "hydraulic_forwarder_valve.png")


def main() -> None:
    """Compute, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="page to write, figures go to ../images")
    options = parser.parse_args()
    warnings.simplefilter("ignore", crane.CraneWarning)
    with tempfile.TemporaryDirectory() as folder:
        found = compute(Path(folder))
    text = page.whole(found)
    print(text)
    if options.write is None:
        return
    draw(found, options.write.resolve().parents[1] / "images")
    with replace_file(options.write) as part:
        part.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
