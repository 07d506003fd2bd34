"""One self-contained page that shows a machine, its forces and its numbers in any browser."""

import json
import webbrowser
from html import escape
from importlib.resources import files
from math import cos, sin
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

from crane.common.errors import OutputError, RecordingError
from crane.common.output import replacing
from crane.machine import Machine
from crane.recordings.overlay import differences, shift_of
from crane.recordings.summary import label, points, title
from crane.view.page.arrays import packed
from crane.view.page.channels import Grid, groups
from crane.view.page.marks import actuators, loads, springs
from crane.view.page.motion import (
    check_joints,
    frame_rows,
    motion,
    payload_place,
    place,
    postures,
    tree,
)
from crane.view.page.scene import Scene, build_scene
from crane.view.page.summary import run_summary

if TYPE_CHECKING:
    from crane.recordings.recording import Recording

SUFFIXES = (".html", ".htm")

# Directions from the machine to the camera; x forward (see `Scene.heading`), z up.
VIEWS = {
    "iso": (1.0, -1.6, 0.75), "side": (0.0, -1.0, 0.0), "front": (1.0, 0.0, 0.0),
    "top": (0.0, -1e-3, 1.0),
}  # fmt: skip
# In the order in which they use each other.
SCRIPTS = ("data", "kinematics", "timeline", "scene", "marks", "plots", "channels", "main")


def report(
    machine: Machine,
    recording: "Recording | None",
    path: str | Path,
    other: "Recording | None" = None,
) -> Path:
    """Write a machine, moving as recorded or in its home posture, as one HTML file.

    The page holds the viewer, the motion and all columns of the recording; nothing is loaded from
    anywhere. Space plays, the arrow keys step, and every recorded instant is shown as recorded.

    Args:
        machine: The machine.
        recording: What it did; None for the home posture.
        path: The file to write; replaced if it exists.
        other: A second recording of the machine: a ghost, and second lines in the plots. Where
            its times do not overlap with those of the first, both start together.

    Returns:
        The path.

    Raises:
        RecordingError: A recording is of a machine with other joints.
        ClosureError: The loops cannot be closed at a recorded sample.
        InputError: A posture is not finite.
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    if Path(path).suffix.lower() not in SUFFIXES:
        raise OutputError(f"{path}: a page is for a browser, end the name in .html")
    text = page(machine, recording, other)
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
    return Path(path)


def page(
    machine: Machine,
    recording: "Recording | None",
    other: "Recording | None" = None,
    share: float = 1.0,
) -> str:
    """The page of `report`, as HTML.

    Args:
        machine: See there.
        recording: See there.
        other: See there.
        share: Of the frames and spans of time that a page has at most.
    """
    scene = build_scene(machine, recording, share)
    about = _about(machine, scene, recording)
    if recording is not None:
        about |= _runs(machine, scene, recording, other, share)
    return _html(about, scene)


def open_in_browser(path: str | Path) -> bool:
    """Open a page in the user's browser; False where there is none."""
    return webbrowser.open(Path(path).resolve().as_uri())


def _about(machine: Machine, scene: Scene, recording: "Recording | None") -> dict[str, Any]:
    """What is known of the machine itself."""
    return {
        "machine": machine.name,
        "task": "home posture" if recording is None else label(recording),
        "tree": tree(machine),
        "tip": None if machine.tip is None else place(machine, machine.tip),
        "payload": payload_place(machine),
        "pins": [place(machine, loop.predecessor) for loop in machine.closure.equations.loops],
        "actuators": [],
        "loads": [],
        "springs": springs(machine, scene.q),
        "lower": scene.lower.tolist(),
        "upper": scene.upper.tolist(),
        "ground": scene.ground,
        "views": {name: _turned(view, scene.heading) for name, view in VIEWS.items()},
        "summary": run_summary(machine, recording),
        "runs": [{"motion": motion(scene.time, scene.q)}],
        "groups": [],
        "differences": [],
        "reference": "",
    }


def _runs(
    machine: Machine,
    scene: Scene,
    recording: "Recording",
    other: "Recording | None",
    share: float,
) -> dict[str, Any]:
    """What was recorded, once or twice."""
    spans = share * (1.0 if other is None else 0.5)
    grid = Grid.of(recording, scene.rows, spans)
    runs: list[dict[str, Any]] = [
        {"motion": motion(scene.time, scene.q), "axis": grid.axis(), "label": label(recording)}
    ]
    second, apart = None, []
    if other is not None:
        try:
            check_joints(machine, other)
        except RecordingError as error:
            raise RecordingError(f"the second recording: {error}") from None
        rows = frame_rows(other.time, share)
        over = Grid.of(other, rows, spans)
        runs.append(
            {
                "motion": motion(other.time[rows], postures(machine, other, rows)),
                "axis": over.axis(),
                "label": label(other),
                "shift": shift_of(recording, other),
            }
        )
        second = (other, over)
        apart = [(one.joint, *one.words) for one in differences(recording, other)]
    wanted = points(recording, "reference_tip")
    return {
        "actuators": actuators(machine, recording, scene.rows),
        "loads": loads(machine, recording, scene.rows),
        "runs": runs,
        "groups": groups(machine, recording, grid, second),
        "differences": apart,
        "reference": "" if wanted is None else packed(wanted[scene.rows], "f4"),
    }


def _html(about: dict[str, Any], scene: Scene) -> str:
    import base64

    import meshcat
    import umsgpack  # type: ignore[import-untyped]

    assets = files("crane.view.page") / "assets"
    blobs = [base64.b64encode(umsgpack.packb(c)).decode() for c in scene.commands]
    viewer = files(meshcat) / "viewer" / "dist" / "main.min.js"
    template = Template((assets / "page.html").read_text(encoding="utf-8"))
    return template.substitute(
        title=escape(title(about["machine"], about["task"])),
        style=(assets / "page.css").read_text(encoding="utf-8"),
        viewer=viewer.read_text(encoding="utf-8"),
        data=_json(about),
        commands=_json(blobs),
        script="\n".join((assets / f"{name}.js").read_text(encoding="utf-8") for name in SCRIPTS),
    )


def _turned(view: tuple[float, float, float], heading: float) -> list[float]:
    x, y, z = view
    return [
        x * cos(heading) - y * sin(heading),
        x * sin(heading) + y * cos(heading),
        z,
    ]


def _json(value: Any) -> str:
    """JSON that may stand inside of a script element."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
