"""One self-contained page that shows a machine in any browser, without a server or a network."""

import base64
import json
import webbrowser
from html import escape
from importlib.resources import files
from math import cos, sin
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

from crane.errors import OutputError
from crane.machine import Machine
from crane.output import replacing
from crane.view.scene import TRACES, Scene, build_scene

if TYPE_CHECKING:
    from crane.recording import Recording

SUFFIXES = (".html", ".htm")

# Directions from the machine to the camera; x forward (see `Scene.heading`), z up.
VIEWS = {"iso": (1.0, -1.6, 0.75), "side": (0.0, -1.0, 0.0), "front": (1.0, 0.0, 0.0)}


def write_page(machine: Machine, path: str | Path, recording: "Recording | None" = None) -> Path:
    """Write a machine, moving as recorded or in its home posture, as one HTML file.

    The page holds the viewer and the scene; nothing is loaded from anywhere. It plays the motion
    in the recording's time, with a slider. "front" looks at the machine from where its tip points
    at the start, "side" at right angles to that, so at the plane of a crane.

    Args:
        machine: The machine.
        path: The file to write; replaced if it exists.
        recording: The motion; None for the home posture.

    Returns:
        The path.

    Raises:
        RecordingError: The recording lacks an active joint of the machine.
        ClosureError: The loops cannot be closed at a recorded sample.
        InputError: A posture is not finite.
        OutputError: The file's suffix is not .html or .htm, or it cannot be written.
    """
    if Path(path).suffix.lower() not in SUFFIXES:
        raise OutputError(f"{path}: a page is for a browser, end the name in .html")
    scene = build_scene(machine, recording)
    text = _html(scene, machine.name, "home posture" if recording is None else recording.task)
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
    return Path(path)


def open_in_browser(path: str | Path) -> bool:
    """Open a page in the user's browser; False where there is none."""
    return webbrowser.open(Path(path).resolve().as_uri())


def _html(scene: Scene, name: str, task: str) -> str:
    import meshcat
    import umsgpack  # type: ignore[import-untyped]

    about = {
        "machine": name,
        "task": task,
        "start": scene.start,
        "duration": scene.duration,
        "lower": scene.lower.tolist(),
        "upper": scene.upper.tolist(),
        "views": {name: _turned(view, scene.heading) for name, view in VIEWS.items()},
        "traces": {name: f"#{TRACES[name]:06x}" for name in scene.traces},
    }
    blobs = [base64.b64encode(umsgpack.packb(c)).decode() for c in scene.commands]
    viewer = files(meshcat) / "viewer" / "dist" / "main.min.js"
    template = Template((files("crane.view") / "page.html").read_text(encoding="utf-8"))
    return template.substitute(
        title=escape(f"{name}: {task}" if task else name),
        viewer=viewer.read_text(encoding="utf-8"),
        page=_script(about),
        commands=_script(blobs),
    )


def _turned(view: tuple[float, float, float], heading: float) -> list[float]:
    x, y, z = view
    return [
        x * cos(heading) - y * sin(heading),
        x * sin(heading) + y * cos(heading),
        z,
    ]


def _script(value: Any) -> str:
    """JSON that may stand inside of a script element."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")
