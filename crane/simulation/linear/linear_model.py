"""Linear model x' = A x + B u, y = C x + D u: modes, responses, files."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from crane.common.atomic_output import replace_file
from crane.common.errors import OutputError
from crane.common.one_line_repr import format_count, shorten_to_line
from crane.common.optional_libraries import import_optional_library
from crane.common.result import Result
from crane.common.samples import Array, as_sample
from crane.machine.machine import Machine
from crane.recordings.recording import Recording

_FRAMES_PER_SECOND = 50  # of mode animations
_SWING_AMPLITUDE = 0.05  # of mode animations [share of the range], [coordinate units]
_MIN_IMAGINARY_SHARE = 1e-3  # least imaginary part of an oscillatory pole, relative to its size
_DAMPING_ROUNDING = 1e-13  # real part by rounding, as a share of the fastest pole
_INTEGRATOR_ROUNDING = 1e-7  # size of a pole at zero by rounding, as a share of the fastest pole


class Mode(NamedTuple):
    """A pole, or a pair of complex ones.

    Attributes:
        pole: The eigenvalue, of a pair that with a positive imaginary part [1/s].
        frequency: |pole| / 2 pi [Hz].
        damping: -Re(pole) / |pole|; 1 of a real stable one, 0 at zero.
        shape: (nq,) complex motion of all joints; the largest in coordinate units is 1.
        state: (k,) complex eigenvector.
    """

    pole: complex
    frequency: float
    damping: float
    shape: Array
    state: Array

    @property
    def is_oscillatory(self) -> bool:
        """Whether it oscillates, and is no pair of real poles separated by rounding errors."""
        return self.pole.imag > _MIN_IMAGINARY_SHARE * abs(self.pole)


@dataclass(frozen=True, eq=False, repr=False)
class LinearModel(Result):
    """x' = A x + B u, y = C x + D u, deviations from an operating point.

    Attributes:
        A: (k, k).
        B: (k, m).
        C: (p, k).
        D: (p, m).
        states: Names of x: active joints, their velocities, pressures and spools of the circuit.
        inputs: Names of u.
        outputs: Names of y.
        units: By name.
        x: (k,) operating point.
        u: (m,).
        y: (p,).
        rate: (k,) x' at the operating point, 0 for an equilibrium.
        machine: The machine.
        configuration: (nq,) configuration of the operating point.
        gamma: (nq, n) its derivatives by q_A.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    x: Array
    u: Array
    y: Array
    rate: Array
    machine: Machine
    configuration: Array
    gamma: Array

    def _one_line(self) -> str:
        rings = [mode.frequency for mode in self.modes if mode.is_oscillatory]
        ends = dict.fromkeys(f"{frequency:.3g}" for frequency in rings[:1] + rings[-1:])
        words = f", rings at {' to '.join(ends)} Hz" if rings else ""
        return (
            f"LinearModel of '{self.machine.name}': {format_count(len(self.x), 'state')}, "
            f"{format_count(len(self.u), 'input')}, {format_count(len(self.y), 'output')}{words}"
        )

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """Modes from the slowest to the fastest."""
        from scipy.linalg import eig

        poles, vectors = eig(self.A)
        fastest = np.abs(poles).max(initial=0.0)
        units = self.machine.closure.units
        found = []
        for pole, vector in zip(poles, vectors.T, strict=True):
            if pole.imag < 0:
                continue
            size = abs(pole)
            if size < _INTEGRATOR_ROUNDING * fastest:
                pole, size = 0j, 0.0
            if abs(pole.real) < _DAMPING_ROUNDING * fastest:
                pole = complex(0.0, pole.imag)
            moved = self.gamma @ vector[: self.gamma.shape[1]]
            at = np.argmax(np.abs(moved / units))
            largest = moved[at] / units[at]
            if abs(largest) > 1e-12 * np.abs(vector).max():
                moved = moved / largest
            damping = float((0.0 - pole.real) / size if size else 0.0)
            found.append(Mode(complex(pole), size / (2 * np.pi), damping, moved, vector))
        return tuple(sorted(found, key=lambda mode: (mode.frequency, mode.pole.imag)))

    def response(self, frequencies: ArrayLike) -> Array:
        """G = C (i w - A)^-1 B + D (f, p, m), complex, at frequencies (f,) [Hz]."""
        s = 2j * np.pi * np.asarray(frequencies, dtype=np.float64)[:, None, None]
        return np.asarray(
            self.C @ np.linalg.solve(s * np.eye(len(self.A)) - self.A, self.B) + self.D
        )

    def simulate(self, times: ArrayLike, start: ArrayLike, inputs: ArrayLike) -> Array:
        """Deviations y (N, p) from a start x (k,) under constant inputs u (m,), exactly.

        Args:
            times: (N,) [s].
            start: (k,) deviation from the operating point.
            inputs: (m,) deviation.
        """
        from scipy.linalg import expm

        k, m = self.B.shape
        start, u = as_sample(start, k, "start", self.states), as_sample(inputs, m, "inputs")
        whole = np.zeros((k + m, k + m))
        whole[:k, :k], whole[:k, k:] = self.A, self.B
        states = [
            expm(whole * time) @ np.concatenate([start, u])
            for time in np.asarray(times, dtype=np.float64)
        ]
        return np.asarray(np.array(states) @ np.hstack([self.C, self.D]).T)

    def dominant_state(self, mode: Mode) -> str:
        """The state that a mode moves most: a joint, or else a pressure or spool."""
        n = self.gamma.shape[1]
        units = self.machine.closure.units
        if np.abs(mode.shape / units).max() > 0.5:
            return self.machine.joints[int(np.argmax(np.abs(mode.shape / units)))]
        return self.states[2 * n + int(np.argmax(np.abs(mode.state[2 * n :])))]

    def to_text(self) -> str:
        """A table of the modes, Markdown."""
        lines = [
            f"{self.machine.name} in small motions about "
            + ", ".join(
                f"{name} {value:.4g} {self.units[name]}"
                for name, value in zip(self.machine.active, self.x, strict=False)
            ),
            "",
            "| frequency [Hz] | damping [%] | time constant [s] | moves most |",
            "| ---: | ---: | ---: | --- |",
        ]
        for mode in self.modes:
            if not mode.frequency:
                continue
            lasting = f"{1.0 / abs(mode.pole.real):.3g}" if mode.pole.real else ""
            frequency = f"{mode.frequency:.4g}" if mode.is_oscillatory else ""
            damping = f"{100 * mode.damping:.3g}" if mode.is_oscillatory else ""
            grows = " (grows)" if mode.pole.real > 0 else ""
            lines.append(
                f"| {frequency} | {damping} | {lasting}{grows} | {self.dominant_state(mode)} |"
            )
        if zeros := sum(mode.frequency == 0 for mode in self.modes):
            lines += ["", f"{zeros} poles at zero: what stays where it is put"]
        still = [name for name, way in zip(self.inputs, self.B.T, strict=True) if not way.any()]
        if still:
            lines += ["", f"nothing answers {', '.join(still)} there; a velocity opens valves"]
        return "\n".join(lines)

    def mode_animation(self, seconds: float = 3.0, max_modes: int = 8) -> Recording | None:
        """Animation of the oscillatory modes in slow motion, one after another, as a recording.

        Args:
            seconds: Duration of each mode, which oscillates three times [s].
            max_modes: Largest number of modes, from the slowest.

        Returns:
            The recording with the channel `mode_frequency`; None without oscillatory modes.
        """
        machine, n = self.machine, self.gamma.shape[1]
        oscillatory_modes = [mode for mode in self.modes if mode.is_oscillatory][:max_modes]
        if not oscillatory_modes:
            return None
        phase = np.linspace(0.0, 6.0 * np.pi, int(_FRAMES_PER_SECOND * seconds))
        columns, span = machine.closure.active, machine.upper - machine.lower
        max_displacements = np.minimum(np.where(np.isfinite(span), span, np.inf), 2.0)
        q_a, frequencies = [], []
        for mode in oscillatory_modes:
            shape = mode.shape[columns]
            largest_share = np.abs(shape / machine.closure.units[columns]).max(initial=0.0)
            largest_range_share = np.abs(shape / max_displacements).max(initial=0.0)
            if not largest_share:
                continue
            size = min(_SWING_AMPLITUDE / largest_share, _SWING_AMPLITUDE / largest_range_share)
            swing = size * np.real(np.outer(np.exp(1j * phase), shape))
            swing *= np.sin(phase / 6.0)[:, None]  # from rest to rest, so that modes join
            q_a.append(np.clip(self.x[:n] + swing, machine.lower, machine.upper))
            frequencies.append(np.full(len(phase), mode.frequency))
        time = np.arange(len(q_a) * len(phase)) / _FRAMES_PER_SECOND
        q = np.vstack(q_a)
        return Recording(
            time=time,
            joints=machine.active,
            q=q,
            v=np.gradient(q, time, axis=0),
            tau=np.zeros_like(q),
            units={joint: machine.unit(joint) for joint in machine.active},
            channels={"mode_frequency": np.concatenate(frequencies)},
            channel_units={"mode_frequency": "Hz"},
            machine=machine.load_expression,
            task="modes in slow motion",
            free=machine.free,
            machine_name=shorten_to_line(machine.name).strip(),
        )

    def to_control(self) -> Any:
        """The model as a `StateSpace` of python-control.

        Raises:
            InputError: python-control is not installed.
        """
        control = import_optional_library("control", "to_control")
        names = {"states": self.states, "inputs": self.inputs, "outputs": self.outputs}
        return control.StateSpace(
            self.A, self.B, self.C, self.D, **{key: list(value) for key, value in names.items()}
        )

    def save(self, path: str | Path) -> Path:
        """Write matrices, names and operating point as .mat (MATLAB, Octave) or .npz.

        Raises:
            OutputError: Another suffix, or it cannot be written.
        """
        path = Path(path)
        if path.suffix not in (".mat", ".npz"):
            raise OutputError(f"{path}: a linear model is written as .mat or .npz")
        kind = object if path.suffix == ".mat" else str
        values: dict[str, Any] = {
            name: np.array(getattr(self, name), dtype=kind)
            for name in ("states", "inputs", "outputs")
        }
        values |= {name: getattr(self, name) for name in ("A", "B", "C", "D", "x", "u", "y")}
        values["rate"] = self.rate
        with replace_file(path) as part:
            if path.suffix == ".mat":
                from scipy.io import savemat

                savemat(str(part), values, appendmat=False)
            else:
                with open(part, "wb") as file:
                    np.savez(file, **values)
        return path
