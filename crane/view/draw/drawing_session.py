"""What the page of a drawing asks: checks, motions of its linkage, and the machine file."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from crane.common.errors import InputError, ignore_warnings
from crane.description.machine_schema import MACHINE
from crane.formats.checks.check_report import check
from crane.formats.drawing.drawing import read_drawing
from crane.formats.machine_file.yaml_edits import edit_yaml
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.machine_loading import load
from crane.motion.kinematics import Kinematics
from crane.recordings.recording import FORCE_UNITS
from crane.view.draw.drawing_file import ITEM_SECTIONS, DrawingFile, NewNames
from crane.view.live.live_session import Session
from crane.view.page.scene import link_poses

_DRAG_ITERATIONS = 12  # of a motion to the pointer, which the next one continues


class DrawingSession:
    """A drawing that is edited, and the machine that it is.

    Args:
        file: Its machine file.

    Attributes:
        file: As given.
    """

    def __init__(self, file: DrawingFile):
        self.file = file
        self._session: Session | None = None
        self._frames: dict[str, str] = {}  # by point

    def check(self, model: Mapping[str, Any]) -> dict[str, Any]:
        """Return the findings of a drawing, and its machine in the posture drawn."""
        self._session = None
        drawing = {key: value for key, value in model["drawing"].items() if key != "picture"}
        with tempfile.TemporaryDirectory() as folder, ignore_warnings():
            path = Path(folder) / "drawing.yaml"
            changes = {"drawing": drawing, "tip": model.get("tip")}
            path.write_text(edit_yaml("name: drawing\n", changes), encoding="utf-8")
            report, section = check(path), YamlSection.read(path, MACHINE).section("drawing")
            assert section is not None, "it has just been written"
            places = {
                place: [key, name]
                for key in ITEM_SECTIONS
                for name, place in section.item_locations(key).items()
            }
            findings = [
                {"where": places.get(f"{x.file}:{x.line}", []), "isError": x.is_error,
                 "text": x.message}
                for x in report.findings
            ]  # fmt: skip
            if report.errors:
                return {"findings": findings}
            self._session, drawn = Session(load(path)), read_drawing(section)
        self._frames = {
            point: drawn.frame_name(bodies[0], point)
            for point in drawn.points
            if (bodies := drawn.bodies_at(point))
        }
        masses = {name: body.inertia.mass for name, body in drawn.bodies.items()}
        return {"findings": findings, "masses": masses} | self._posture()

    def move(self, joint: str, value: float) -> dict[str, Any]:
        """Move an active joint, see `Session.move`."""
        self._moved_session.move(joint, value)
        return self._posture()

    def drag(self, point: str, x: float, z: float) -> dict[str, Any]:
        """Move a point as near as possible to a position [m]."""
        session = self._moved_session
        kinematics = Kinematics(session.machine, self._frames[point])
        target = kinematics.position_at_configuration(session.readout.configuration)
        target[[0, 2]] = x, z
        q = kinematics.nearest(target, session.readout.configuration, _DRAG_ITERATIONS)
        session.set_active_coordinates(q[session.machine.closure.active])
        return self._posture()

    def save(self, model: Mapping[str, Any], renames: NewNames) -> dict[str, Any]:
        """Write the machine file; return the findings of all of it."""
        self.file.write(model, renames)
        return {"findings": [str(x) for x in check(self.file.path).findings]}

    @property
    def _moved_session(self) -> Session:
        if self._session is None:
            raise InputError("the drawing is no machine yet, correct its errors first")
        return self._session

    def _posture(self) -> dict[str, Any]:
        """Return points [m] and active joints of the present configuration."""
        session = self._moved_session
        machine, readout = session.machine, session.readout
        poses = link_poses(machine, readout.configuration[None], self._frames.values())
        columns = session.lower, session.upper, readout.q_a, readout.gravity
        return {
            "points": {name: poses[x][0, [0, 2], 3].tolist() for name, x in self._frames.items()},
            "joints": [
                dict(zip(("lower", "upper", "value", "force"), map(float, row), strict=True))
                | {"name": name, "unit": machine.unit(name)}
                | {"forceUnit": FORCE_UNITS[machine.unit(name)]}
                for name, *row in zip(machine.active, *columns, strict=True)
            ],
            "refusal": readout.refusal,
        }
