"""Page of a live view: sliders, buttons and readout beside the machine."""

import time
from html import escape
from queue import SimpleQueue
from typing import Any

import numpy as np

from crane.common.errors import CraneError
from crane.common.samples import Array
from crane.common.units import format_quantity
from crane.machine.machine import Machine
from crane.recordings.recording import FORCE_UNITS
from crane.recordings.recording_summary import DISPLAY_UNITS
from crane.view.live.live_scene import LiveScene
from crane.view.live.live_session import Playback, Readout, Session
from crane.view.page.html_document import html_table
from crane.view.page.scene import round_up_to_nice

_STYLE = """<style>
.crane-readout { margin: 0 1em 0.6em; font-size: 0.8em; }
.crane-readout table { width: 100%; border-spacing: 0 0.15em; }
.crane-readout th { text-align: left; font-weight: normal; opacity: 0.6; }
.crane-readout .n { text-align: right; }
</style>"""
_WARNING_BOX_TAG = (
    '<div style="margin:0.3em 1em;padding:0.5em 0.7em;border-left:4px solid #d0401c;'
    'background:#d0401c22;font-size:0.8em">'
)


def readout_html(
    machine: Machine, readout: Readout, payload_mass: float, recorded_forces: Array | None = None
) -> str:
    """Return forces, tip, passive joints and the state of the loops as HTML.

    Args:
        machine: The machine.
        readout: Configuration with its forces.
        payload_mass: Mass at the tip [kg].
        recorded_forces: (n,) forces of a recording at this instant [N], [N m].
    """
    columns = {
        "holding force" if not payload_mass else "holding force with payload": readout.gravity
    }
    if recorded_forces is not None:
        columns["recorded"] = recorded_forces
    rows = []
    for joint, *forces in zip(machine.active, *columns.values(), strict=True):
        unit, is_free = FORCE_UNITS[machine.unit(joint)], joint in machine.free
        rows.append(
            [escape(joint), *("free" if is_free else format_quantity(x, unit) for x in forces)]
        )
    parts = [html_table(["joint*", *columns], rows)]
    if readout.tip is not None:
        position = [f"{round(1e3 * value, 1) + 0.0:.1f}" for value in readout.tip]
        parts.append(html_table(["tip x [mm]*", "y [mm]", "z [mm]"], [position]))
    rows = []
    for joint in machine.joints:
        if joint not in machine.active:
            unit, scale = DISPLAY_UNITS[machine.unit(joint)]
            value = scale * readout.configuration[machine.column(joint)]
            rows.append([escape(joint), f"{round(value, 2) + 0.0:.2f} {unit}"])
    if rows:
        parts.append(html_table(["passive joint*", "coordinate"], rows))
    if readout.gain_joints:
        passive_joint, active_joint = readout.gain_joints
        unit = f"{machine.unit(passive_joint)}/{machine.unit(active_joint)}"
        gain, condition_number = f"{readout.largest_gain:.3g}", f"{readout.condition_number:.3g}"
        rows = [
            ["largest gamma", f"{gain} {unit}", escape(f"{passive_joint} per {active_joint}")],
            ["condition number of J_P", condition_number, escape(f"loop {readout.weakest_loop}")],
            ["loops closed to", f"{readout.residual:.0e} m", ""],
        ]
        parts.append(html_table(["*", "", ""], rows))
    return _STYLE + "".join(f'<div class="crane-readout">{part}</div>' for part in parts)


def warning_html(text: str) -> str:
    """Return a message in a box as HTML; empty for an empty text."""
    return f"{_WARNING_BOX_TAG}{escape(text)}</div>" if text else ""


_LOAD_KEY, _TIME_KEY, _PLAY_KEY, _HOME_KEY = "load", "time", "play", "home"
_SLIDER_STEPS = 1000  # of a slider


class LivePage:
    """Widgets on a viser server that act on a session.

    Callbacks of the server put requests into a queue; `process_requests` processes them in one
    thread, of each slider only the last request.

    Args:
        server: A viser server.
        session: Session that is shown.
        playback: Recording that can be played.
        requests: Queue of requests: key and value of a widget.

    Attributes:
        is_playing: Whether the recording plays.
    """

    def __init__(
        self,
        server: Any,
        session: Session,
        playback: Playback | None,
        requests: "SimpleQueue[tuple[str, float] | None]",
    ):
        self._server, self._session, self._playback = server, session, playback
        self._requests = requests
        self.is_playing, self._last_update = False, time.perf_counter()
        self._recorded_forces: Array | None = None
        machine, gui = session.machine, server.gui
        self._scene = LiveScene(server, session)
        server.on_client_connect(self._aim_camera)
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(machine.name)
        self._warning_html = gui.add_html("")
        self._sliders: dict[str, Any] = {}
        with gui.add_folder("Active joints"):
            for joint, lower, upper, value in zip(
                machine.active, session.lower, session.upper, session.readout.q_a, strict=True
            ):
                unit, scale = DISPLAY_UNITS[machine.unit(joint)]
                self._add_slider(
                    f"joint {joint}",
                    f"{joint} [{unit}]",
                    scale * lower,
                    scale * upper,
                    scale * value,
                )
            self._add_button(_HOME_KEY, "Home")
        if machine.tip is not None:
            with gui.add_folder("Payload"):
                self._add_slider(_LOAD_KEY, "mass [kg]", 0.0, session.max_payload, 0.0)
        if playback is not None:
            stride = max(len(playback.configurations) // 2000, 1)
            self._scene.add_path(session.tip_positions(playback.configurations[::stride]))
            with gui.add_folder("Recording"):
                self._add_slider(
                    _TIME_KEY, "time [s]", playback.start, playback.end, playback.start
                )
                self._play_button = self._add_button(_PLAY_KEY, "Play")
        with gui.add_folder("Numbers"):
            self._readout_html = gui.add_html("")
        self._update_widgets(session.readout)
        if playback is not None:
            self.process_requests([(_TIME_KEY, playback.start)])

    def _aim_camera(self, client: Any) -> None:
        """Set the camera of a new client so that it shows the machine."""
        if client.camera.aspect < 1:
            look_at, position = self._scene.camera_view(client.camera.aspect)
            with client.atomic():
                client.camera.position = position  # moves the target along
                client.camera.look_at = look_at

    def process_requests(self, pending_requests: list[tuple[str, float]]) -> None:
        """Process requests; of several requests of one widget only the last."""
        for key, value in dict(pending_requests).items():
            try:
                self._update_widgets(self._process_request(key, value))
            except Exception as error:  # one window's mistake does not end it for the others
                message = str(error) if isinstance(error, CraneError) else f"not done: {error!r}"
                self._warning_html.content = warning_html(message)

    def advance_playback(self) -> None:
        """Advance the recording by the time since the last call."""
        assert self._playback is not None
        now = time.perf_counter()
        playback_time = self._sliders[_TIME_KEY].value + now - self._last_update
        self._last_update = now
        self.is_playing = playback_time < self._playback.end
        self._update_widgets(self._seek(min(playback_time, self._playback.end)))

    def _process_request(self, key: str, value: float) -> Readout:
        session = self._session
        if key in self._sliders:
            slider = self._sliders[key]
            value = float(np.clip(value, slider.min, slider.max))
        if key == _LOAD_KEY:
            readout = session.set_payload(value)
            self._scene.show_payload()
            return readout
        if key == _TIME_KEY:
            return self._seek(value)
        if key == _PLAY_KEY:
            assert self._playback is not None
            self.is_playing = not self.is_playing
            self._last_update = time.perf_counter()
            slider_time = self._sliders[_TIME_KEY].value
            is_at_end = slider_time >= self._playback.end
            return self._seek(self._playback.start if is_at_end else slider_time)
        self.is_playing, self._recorded_forces = False, None
        if key == _HOME_KEY:
            return session.go_home()
        joint = key.removeprefix("joint ")
        index = session.machine.active.index(joint)
        _, scale = DISPLAY_UNITS[session.machine.unit(joint)]
        value = float(np.clip(value / scale, session.lower[index], session.upper[index]))
        return session.move(joint, value)

    def _seek(self, playback_time: float) -> Readout:
        """Move to the configuration at a time of the recording [s]."""
        assert self._playback is not None
        q_a, self._recorded_forces = self._playback.interpolate(playback_time)
        self._sliders[_TIME_KEY].value = playback_time
        return self._session.set_active_coordinates(q_a)

    def _update_widgets(self, readout: Readout) -> None:
        """Send poses, sliders and readout to the clients."""
        machine = self._session.machine
        with self._server.atomic():
            self._scene.update_poses()
            for joint, value in zip(machine.active, readout.q_a, strict=True):
                _, scale = DISPLAY_UNITS[machine.unit(joint)]
                _set_slider(self._sliders[f"joint {joint}"], scale * value)
            if self._playback is not None:
                self._play_button.label = "Pause" if self.is_playing else "Play"
            self._warning_html.content = warning_html(readout.refusal)
            self._readout_html.content = readout_html(
                machine, readout, self._session.payload_mass, self._recorded_forces
            )
        self._server.flush()

    def _add_slider(self, key: str, label: str, lower: float, upper: float, value: float) -> None:
        upper = max(upper, lower + 1e-9)
        step = round_up_to_nice((upper - lower) / _SLIDER_STEPS)
        # ends with few digits, within the range
        lower = round(np.ceil(lower / (step / 10)) * (step / 10), 9)
        upper = round(np.floor(upper / (step / 10)) * (step / 10), 9)
        value = min(max(value, lower), upper)
        self._sliders[key] = self._server.gui.add_slider(label, lower, upper, step, value)

        async def note(event: Any) -> None:
            if event.client_id is not None:  # not one of our own
                self._requests.put((key, float(event.target.value)))

        self._sliders[key].on_update(note)

    def _add_button(self, key: str, label: str) -> Any:
        button = self._server.gui.add_button(label)

        async def note(_: Any) -> None:
            self._requests.put((key, 1.0))

        button.on_click(note)
        return button


def _set_slider(slider: Any, value: float) -> None:
    """Set a slider to the nearest value in its range."""
    nearest_value = float(np.clip(value, slider.min, slider.max))
    if abs(slider.value - nearest_value) > 1e-6 * (slider.max - slider.min):
        slider.value = nearest_value
