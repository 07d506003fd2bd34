"""The gallery: results of commands, made while the site is built."""

import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from sphinx.application import Sphinx

GENERATED = Path(__file__).parent / "generated"
RUN = "from crane.cli import main; main()"


class Entry(NamedTuple):
    """One figure or page, and its commands."""

    title: str
    text: str
    commands: str  # one per line
    result: str  # the file that is shown

    @property
    def file(self) -> str:
        """Its name within the site."""
        name = self.title.lower().replace(" ", "_").replace(",", "")
        return f"gallery/{name}{Path(self.result).suffix}"


PAGES = (
    Entry(
        "A log crane of laboratory size",
        "The published trajectory that picks up a log and places it into the bunk. Press play, "
        "turn the view with the mouse or a finger, and switch forces on.",
        "simulate mini_forwarder --task loading --out loading\nview loading --no-open",
        "loading/view.html",
    ),
    Entry(
        "A log crane on its valves",
        "The crane lifts, stretches and extends by valve commands: signals in volt, pressures in "
        "bar, flows.",
        "simulate patu655 --task reach --out reach\nview reach --no-open",
        "reach/view.html",
    ),
    Entry(
        "An excavator grades",
        "The teeth move horizontally towards the machine, 50 mm above the ground, by valves.",
        "simulate excavator --task grade --out grade\nview grade --no-open",
        "grade/view.html",
    ),
    Entry(
        "A grapple that does not sway",
        "A quarter turn with a log in the grapple; the reference suppresses the sway.",
        "simulate patu655_grapple --task swing --sway flat --out swing\nview swing --no-open",
        "swing/view.html",
    ),
    Entry(
        "A robot with a parallel linkage",
        "A machine without a run: the page closes the loops while you move the sliders.",
        "view kr300 --out kr300.html --no-open",
        "kr300.html",
    ),
    Entry(
        "What an excavator lifts",
        "Rated loads over the reach with their limiting factors: drives, tipping, pins. Point at "
        "a position.",
        "capacity excavator --out capacity",
        "capacity/capacity.html",
    ),
)
PICTURES = (
    Entry(
        "How far it works",
        "Reach, depth and heights, each an exact optimum over all strokes.",
        "working-range excavator --out range",
        "range/working_range.png",
    ),
    Entry(
        "Its mechanism",
        "A drawing for publications, from the description.",
        "sketch patu655 --com --out mechanism.svg",
        "mechanism.svg",
    ),
    Entry(
        "Its hydraulic circuit",
        "With the graphic symbols of ISO 1219-1.",
        "sketch patu655 --circuit --out circuit.svg",
        "circuit.svg",
    ),
)


def setup(app: Sphinx) -> dict[str, bool]:
    """Make all results before pages are read."""
    app.connect("config-inited", lambda *_: write())
    return {"parallel_read_safe": True}


def write() -> None:
    """Run all commands and write the page that shows their results."""
    pages = GENERATED / "pages"
    shutil.rmtree(pages, ignore_errors=True)
    (pages / "gallery").mkdir(parents=True)
    for entry in (*PAGES, *PICTURES):
        with tempfile.TemporaryDirectory() as folder:
            for command in entry.commands.splitlines():
                _run(command, folder)
            shutil.copy(Path(folder, entry.result), pages / entry.file)
    text = (
        "# Gallery\n\nResults of commands. Each is a single file that needs no network; the "
        "commands are below it.\n"
    )
    shown = [_page(entry) for entry in PAGES] + [_picture(entry) for entry in PICTURES]
    (GENERATED / "gallery.md").write_text("\n".join([text, *shown]))


def _run(command: str, folder: str) -> None:
    words = [sys.executable, "-c", RUN, *shlex.split(command)]
    run = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(f"crane {command}: {run.stderr}")


def _page(entry: Entry) -> str:
    frame = (
        f'<iframe class="page" src="../{entry.file}" title="{entry.title}" loading="lazy">'
        "</iframe>\n"
        f'<p><a href="../{entry.file}">Open in the whole window</a></p>'
    )
    return _shown(entry, frame)


def _picture(entry: Entry) -> str:
    return _shown(entry, f'<img src="../{entry.file}" alt="{entry.title}">')


def _shown(entry: Entry, html: str) -> str:
    commands = "\n".join(f"crane {line}" for line in entry.commands.splitlines())
    return (
        f"## {entry.title}\n\n{entry.text}\n\n```{{raw}} html\n{html}\n```\n\n"
        f"```console\n{commands}\n```\n"
    )
