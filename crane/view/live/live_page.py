"""The page of a live view: sliders, buttons and numbers beside the machine."""

import time
from queue import SimpleQueue
from typing import Any

import numpy as np

from crane.common.errors import CraneError
from crane.common.samples import Array
from crane.recordings.recording_summary import DISPLAY_UNITS
from crane.view.live.live_scene import LiveScene
from crane.view.live.live_session import Readout, Session, round_up_to_nice
from crane.view.live.playback import Playback
from crane.view.live.readout_panel import readout_html, warning_html

_LOAD_KEY, _TIME_KEY, _PLAY_KEY, _HOME_KEY = "load", "time", "play", "home"
_SLIDER_STEPS = 1000  # of a slider


class LivePage:
    """Widgets on a viser server that act on a session.

    Callbacks of the server only leave a note in a queue; `process_requests` does what the notes
    say, in the one thread that calls it, the last note of each slider alone.

    Args:
        server: A viser server.
        session: What is shown.
        playback: A recording to play.
        requests: The queue, where notes are a widget's key and value.
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
        self._playing, self._last_update = False, time.perf_counter()
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
                machine.active, session.lower, session.upper, session.posture.q_a, strict=True
            ):
                unit, scale = DISPLAY_UNITS[machine.unit(joint)]
                label = f"{joint} [{unit}]"
                self._add_slider(
                    f"joint {joint}", label, scale * lower, scale * upper, scale * value
                )
            self._add_button(_HOME_KEY, "Home")
        if machine.tip is not None:
            with gui.add_folder("Payload"):
                self._add_slider(_LOAD_KEY, "mass [kg]", 0.0, session.max_payload, 0.0)
        if playback is not None:
            self._scene.add_path(self._tip_path(playback))
            with gui.add_folder("Recording"):
                self._add_slider(
                    _TIME_KEY, "time [s]", playback.start, playback.end, playback.start
                )
                self._play_button = self._add_button(_PLAY_KEY, "Play")
        with gui.add_folder("Numbers"):
            self._readout_html = gui.add_html("")
        self._update_widgets(session.posture)
        if playback is not None:
            self.process_requests([(_TIME_KEY, playback.start)])

    def _aim_camera(self, client: Any) -> None:
        """Turn the camera of a window that has come to where it sees the machine."""
        if client.camera.aspect < 1:
            look_at, position = self._scene.camera_view(client.camera.aspect)
            with client.atomic():
                client.camera.position = position  # which takes what is looked at along
                client.camera.look_at = look_at

    @property
    def is_playing(self) -> bool:
        """Whether `advance_playback` moves the machine."""
        return self._playing

    def process_requests(self, pending_requests: list[tuple[str, float]]) -> None:
        """Do what notes say: of the sliders only the last of each."""
        for key, value in dict(pending_requests).items():
            try:
                readout = self._process_request(key, value)
                self._update_widgets(readout)
            except Exception as error:  # one window's mistake does not end it for the others
                message = str(error) if isinstance(error, CraneError) else f"not done: {error!r}"
                self._warning_html.content = warning_html(message)

    def advance_playback(self) -> None:
        """Go on in the recording by the time since the last call."""
        assert self._playback is not None
        now = time.perf_counter()
        playback_time = self._sliders[_TIME_KEY].value + now - self._last_update
        self._last_update = now
        if playback_time >= self._playback.end:
            playback_time, self._playing = self._playback.end, False
        self._update_widgets(self._seek(playback_time))

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
            return self._toggle_playback()
        self._playing, self._recorded_forces = False, None
        if key == _HOME_KEY:
            return session.go_home()
        joint = key.removeprefix("joint ")
        index = session.machine.active.index(joint)
        _, scale = DISPLAY_UNITS[session.machine.unit(joint)]
        value = float(np.clip(value / scale, session.lower[index], session.upper[index]))
        return session.move(joint, value)

    def _toggle_playback(self) -> Readout:
        assert self._playback is not None
        self._playing = not self._playing
        self._last_update = time.perf_counter()
        slider_time = self._sliders[_TIME_KEY].value
        return self._seek(
            self._playback.start if slider_time >= self._playback.end else slider_time
        )

    def _seek(self, playback_time: float) -> Readout:
        """The posture at a time [s] of the recording."""
        assert self._playback is not None
        q_a, self._recorded_forces = self._playback.interpolate(playback_time)
        self._sliders[_TIME_KEY].value = playback_time
        return self._session.set_active_coordinates(q_a)

    def _update_widgets(self, readout: Readout) -> None:
        """Send a posture: links, sliders that are not there, numbers."""
        machine = self._session.machine
        with self._server.atomic():
            self._scene.update_poses()
            for joint, value in zip(machine.active, readout.q_a, strict=True):
                _, scale = DISPLAY_UNITS[machine.unit(joint)]
                _set_slider(self._sliders[f"joint {joint}"], scale * value)
            if self._playback is not None:
                self._play_button.label = "Pause" if self._playing else "Play"
            self._warning_html.content = warning_html(readout.refusal)
            self._readout_html.content = readout_html(
                machine, readout, self._session.payload_mass, self._recorded_forces
            )
        self._server.flush()

    def _add_slider(self, key: str, label: str, lower: float, upper: float, value: float) -> None:
        upper = max(upper, lower + 1e-9)
        step = round_up_to_nice((upper - lower) / _SLIDER_STEPS)
        # ends with few digits, within the range
        rounding_step = step / 10
        lower, upper = (
            round(x, 9)
            for x in (
                np.ceil(lower / rounding_step) * rounding_step,
                np.floor(upper / rounding_step) * rounding_step,
            )
        )
        value = min(max(value, lower), upper)
        slider = self._server.gui.add_slider(label, lower, upper, step, value)
        self._sliders[key] = slider

        async def note(event: Any) -> None:
            if event.client_id is not None:  # not one of our own
                self._requests.put((key, float(event.target.value)))

        slider.on_update(note)

    def _add_button(self, key: str, label: str) -> Any:
        button = self._server.gui.add_button(label)

        async def note(_: Any) -> None:
            self._requests.put((key, 1.0))

        button.on_click(note)
        return button

    def _tip_path(self, playback: Playback) -> Array:
        """(k, 3) where the tip goes [m], every so many samples."""
        return self._session.tip_positions(
            playback.configurations[:: max(len(playback.configurations) // 2000, 1)]
        )


def _set_slider(slider: Any, value: float) -> None:
    """Put a slider at the value in its range that is nearest, if it is not there."""
    clipped_value = float(np.clip(value, slider.min, slider.max))
    if abs(slider.value - clipped_value) > 1e-6 * (slider.max - slider.min):
        slider.value = clipped_value
