"""The page of a live view: sliders, buttons and numbers beside the machine."""

import time
from queue import SimpleQueue
from typing import Any

import numpy as np

from crane.common.errors import CraneError
from crane.common.samples import Array
from crane.recordings.summary import READING_UNITS
from crane.view.live.playback import Playback
from crane.view.live.session import Readout, Session, round_up
from crane.view.live.stage import Stage
from crane.view.live.words import numbers, warning

_LOAD, _TIME, _PLAY, _HOME = "load", "time", "play", "home"
_GRADES = 1000  # of a slider


class Page:
    """Widgets on a viser server that act on a session.

    Callbacks of the server only leave a note in a queue; `work` does what the notes say, in the
    one thread that calls it, the last note of each slider alone.

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
        self._playing, self._told = False, time.perf_counter()
        self._recorded: Array | None = None
        machine, gui = session.machine, server.gui
        self._stage = Stage(server, session)
        server.on_client_connect(self._aim)
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(machine.name)
        self._warning = gui.add_html("")
        self._sliders: dict[str, Any] = {}
        with gui.add_folder("Active joints"):
            for joint, low, high, value in zip(
                machine.active, session.lower, session.upper, session.posture.q_a, strict=True
            ):
                unit, scale = READING_UNITS[machine.unit(joint)]
                label = f"{joint} [{unit}]"
                self._slider(f"joint {joint}", label, scale * low, scale * high, scale * value)
            self._button(_HOME, "Home")
        if machine.tip is not None:
            with gui.add_folder("Payload"):
                self._slider(_LOAD, "mass [kg]", 0.0, session.heaviest, 0.0)
        if playback is not None:
            self._stage.add_path(self._path(playback))
            with gui.add_folder("Recording"):
                self._slider(_TIME, "time [s]", playback.start, playback.end, playback.start)
                self._play = self._button(_PLAY, "Play")
        with gui.add_folder("Numbers"):
            self._numbers = gui.add_html("")
        self._show(session.posture)
        if playback is not None:
            self.work([(_TIME, playback.start)])

    def _aim(self, client: Any) -> None:
        """Turn the camera of a window that has come to where it sees the machine."""
        if client.camera.aspect < 1:
            look_at, position = self._stage.view(client.camera.aspect)
            with client.atomic():
                client.camera.position = position  # which takes what is looked at along
                client.camera.look_at = look_at

    @property
    def playing(self) -> bool:
        """Whether `advance` moves the machine."""
        return self._playing

    def work(self, notes: list[tuple[str, float]]) -> None:
        """Do what notes say: of the sliders only the last of each."""
        for key, value in dict(notes).items():
            try:
                posture = self._do(key, value)
                self._show(posture)
            except Exception as error:  # one window's mistake does not end it for the others
                said = str(error) if isinstance(error, CraneError) else f"not done: {error!r}"
                self._warning.content = warning(said)

    def advance(self) -> None:
        """Go on in the recording by the time since the last call."""
        assert self._playback is not None
        now = time.perf_counter()
        at = self._sliders[_TIME].value + now - self._told
        self._told = now
        if at >= self._playback.end:
            at, self._playing = self._playback.end, False
        self._show(self._go_to(at))

    def _do(self, key: str, value: float) -> Readout:
        session = self._session
        if key in self._sliders:
            slider = self._sliders[key]
            value = float(np.clip(value, slider.min, slider.max))
        if key == _LOAD:
            posture = session.load(value)
            self._stage.show_load()
            return posture
        if key == _TIME:
            return self._go_to(value)
        if key == _PLAY:
            return self._start_or_stop()
        self._playing, self._recorded = False, None
        if key == _HOME:
            return session.home()
        joint = key.removeprefix("joint ")
        index = session.machine.active.index(joint)
        _, scale = READING_UNITS[session.machine.unit(joint)]
        value = float(np.clip(value / scale, session.lower[index], session.upper[index]))
        return session.move(joint, value)

    def _start_or_stop(self) -> Readout:
        assert self._playback is not None
        self._playing = not self._playing
        self._told = time.perf_counter()
        at = self._sliders[_TIME].value
        return self._go_to(self._playback.start if at >= self._playback.end else at)

    def _go_to(self, at: float) -> Readout:
        """The posture at a time [s] of the recording."""
        assert self._playback is not None
        q_a, self._recorded = self._playback.at(at)
        self._sliders[_TIME].value = at
        return self._session.place(q_a)

    def _show(self, posture: Readout) -> None:
        """Send a posture: links, sliders that are not there, numbers."""
        machine = self._session.machine
        with self._server.atomic():
            self._stage.show()
            for joint, value in zip(machine.active, posture.q_a, strict=True):
                _, scale = READING_UNITS[machine.unit(joint)]
                _set(self._sliders[f"joint {joint}"], scale * value)
            if self._playback is not None:
                self._play.label = "Pause" if self._playing else "Play"
            self._warning.content = warning(posture.refused)
            self._numbers.content = numbers(
                machine, posture, self._session.payload, self._recorded
            )
        self._server.flush()

    def _slider(self, key: str, label: str, low: float, high: float, value: float) -> None:
        high = max(high, low + 1e-9)
        step = round_up((high - low) / _GRADES)
        # ends with few digits, within the range
        grain = step / 10
        low, high = (
            round(x, 9) for x in (np.ceil(low / grain) * grain, np.floor(high / grain) * grain)
        )
        value = min(max(value, low), high)
        slider = self._server.gui.add_slider(label, low, high, step, value)
        self._sliders[key] = slider

        async def note(event: Any) -> None:
            if event.client_id is not None:  # not one of our own
                self._requests.put((key, float(event.target.value)))

        slider.on_update(note)

    def _button(self, key: str, label: str) -> Any:
        button = self._server.gui.add_button(label)

        async def note(_: Any) -> None:
            self._requests.put((key, 1.0))

        button.on_click(note)
        return button

    def _path(self, playback: Playback) -> Array:
        """(k, 3) where the tip goes [m], every so many samples."""
        return self._session.tips(playback.q[:: max(len(playback.q) // 2000, 1)])


def _set(slider: Any, value: float) -> None:
    """Put a slider at the value in its range that is nearest, if it is not there."""
    shown = float(np.clip(value, slider.min, slider.max))
    if abs(slider.value - shown) > 1e-6 * (slider.max - slider.min):
        slider.value = shown
