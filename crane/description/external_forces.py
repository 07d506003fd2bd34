"""External forces: wrenches at frames of a machine, as functions of time and of the motion."""

from collections.abc import Callable, Sequence
from copy import copy
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen.symbolic import Scalar, matvec
from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array

AXES = ("world", "frame")
WRENCH_COMPONENTS = tuple(f"{kind}_{axis}" for kind in ("force", "moment") for axis in "xyz")
TIP_WRENCH_NAME = "tip"  # of a force at the tip that an exported program or a page gives


class FrameMotion(NamedTuple):
    """Motion of the frame of an external force, as floats or as symbolic expressions.

    Attributes:
        position: (3,) origin of the frame in the world [m].
        rotation: (3, 3) axes of the frame, as columns in the world.
        velocity: (3,) of the origin, in the world [m/s].
        angular_velocity: (3,) in the world [rad/s].
        reference: (c,) the row of `references` at the instant.
        states: (s,) states of the force, see `ExternalForce.states`.
    """

    position: list[Scalar]
    rotation: list[list[Scalar]]
    velocity: list[Scalar]
    angular_velocity: list[Scalar]
    reference: list[Scalar]
    states: Sequence[Scalar] = ()


class ExternalForce(OneLineRepr):
    """A wrench at a frame. A subclass overrides `wrench` if it depends on more than time.

    `wrench` is called with numbers, and once with symbolic expressions to compile its formulas.
    `crane.Wrench` is a function of time, `crane.description.WrenchFunction` calls a function in
    Python.

    Args:
        frame: A link of the machine.
        name: Name in recordings; that of the frame if not given.

    Attributes:
        frame: The link.
        name: Name in recordings.
    """

    is_traceable: ClassVar[bool] = True  # else its value is appended to the references

    def __init__(self, frame: str, name: str = ""):
        self.frame, self.name = frame, name or frame

    def references(self, times: Array) -> Array:
        """Return all quantities that depend on time alone, (N, c) at times (N,) [s]."""
        return np.zeros((len(times), 0))

    def breaks(self) -> Array:
        """Return the sorted times (k,) [s] at which `references` or their derivatives jump."""
        return np.zeros(0)

    def event_distances(self, motion: FrameMotion) -> Sequence[Scalar]:
        """Return lengths [m] whose sign changes end a step; none by default."""
        return ()

    @property
    def channels(self) -> list[tuple[str, str]]:
        """Names and units of `outputs`; none by default."""
        return []

    def outputs(self, motion: FrameMotion) -> Sequence[Scalar]:
        """Return the values that are recorded besides the wrench, in the order of `channels`."""
        return ()

    @property
    def state_count(self) -> int:
        """Number of states [m], which are 0 initially; none by default."""
        return 0

    def state_rates(self, motion: FrameMotion) -> Sequence[Scalar]:
        """Return the rates of the states [m/s]."""
        return ()

    def wrench(self, motion: FrameMotion) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """Return force (3,) [N] and moment (3,) [N m] about the origin, in the world's axes."""
        raise NotImplementedError


class Wrench(ExternalForce):
    """A wrench as a function of time: constant, or piecewise linear between given times.

    Args:
        frame: See `ExternalForce`.
        force: (3,) or (N, 3) [N].
        moment: (3,) or (N, 3) about the frame's origin [N m].
        times: (N,) increasing [s]; None if constant. Two equal times are a jump.
        axes: "world", or "frame" for axes that rotate with the frame.
        name: See `ExternalForce`.

    Attributes:
        times: (N,), one time if constant.
        values: (N, 6) force and moment.
        axes: As given.

    Raises:
        InputError: Wrong shapes, values that are not finite, decreasing times, or other axes.
    """

    def __init__(
        self,
        frame: str,
        force: ArrayLike = (0.0, 0.0, 0.0),
        moment: ArrayLike = (0.0, 0.0, 0.0),
        times: ArrayLike | None = None,
        axes: str = "world",
        name: str = "",
    ):
        super().__init__(frame, name)
        label = f"the load on '{frame}'"
        if axes not in AXES:
            raise InputError(f"{label} has axes '{axes}', give 'world' or 'frame'")
        self.axes = axes
        self.times = _as_finite_array(
            [0.0] if times is None else times, f"the list of times of {label}", 1
        )
        components = []
        for name_, given in (("force", force), ("moment", moment)):
            component = _as_finite_array(given, f"the {name_} of {label}", None)
            if component.shape not in ((3,), (len(self.times), 3)):
                raise InputError(
                    f"{label}: {name_} has the shape {component.shape}, give (3,), or with "
                    "times (N,) (N, 3)"
                )
            components.append(np.broadcast_to(component, (len(self.times), 3)))
        if not len(self.times) or (np.diff(self.times) < 0).any():
            raise InputError(f"{label}: times do not rise, give them in order")
        self.values: Array = np.hstack(components)

    def references(self, times: Array) -> Array:
        """See `ExternalForce`."""
        return np.stack([np.interp(times, self.times, column) for column in self.values.T], axis=1)

    def breaks(self) -> Array:
        """See `ExternalForce`."""
        return np.unique(self.times) if len(self.times) > 1 else np.zeros(0)

    def wrench(self, motion: FrameMotion) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ExternalForce`."""
        force, moment = motion.reference[:3], motion.reference[3:]
        if self.axes == "frame":
            return matvec(motion.rotation, force), matvec(motion.rotation, moment)
        return force, moment


class PhasedWrench(Wrench):
    """A wrench as a function of the phases of a lever task instead of time, piecewise linear.

    Args:
        frame: See `ExternalForce`.
        force: See `Wrench`.
        moment: See `Wrench`.
        phases: (N,) increasing: 0 at the start of the first phase, 1.5 in the middle of the
            second.
        axes: See `Wrench`.
        name: See `ExternalForce`.

    Attributes:
        clock: Function from times (N,) [s] to phases (N,); None until a run sets it, see
            `with_phase_function`.
    """

    clock: Callable[[Array], Array] | None = None

    def __init__(
        self,
        frame: str,
        force: ArrayLike = (0.0, 0.0, 0.0),
        moment: ArrayLike = (0.0, 0.0, 0.0),
        phases: ArrayLike | None = None,
        axes: str = "world",
        name: str = "",
    ):
        super().__init__(frame, force, moment, phases, axes, name)

    def with_phase_function(self, clock: Callable[[Array], Array]) -> "PhasedWrench":
        """Return the same wrench with the clock of a run."""
        result = copy(self)
        result.clock = clock
        return result

    def references(self, times: Array) -> Array:
        """See `ExternalForce`."""
        return super().references(times if self.clock is None else self.clock(times))

    def breaks(self) -> Array:
        """See `ExternalForce`: none, because the ends of phases are not known in advance."""
        return np.zeros(0)


class WrenchFunction(ExternalForce):
    """A wrench by a function in Python, which is called at every stage of a step.

    Args:
        frame: See `ExternalForce`.
        function: (t, position (3,), rotation (3, 3), velocity (3,), angular velocity (3,)) -> (6,)
            force [N] and moment [N m] about the frame's origin in the world's axes; see
            `FrameMotion`.
        name: See `ExternalForce`.
    """

    is_traceable = False

    def __init__(
        self,
        frame: str,
        function: Callable[[float, Array, Array, Array, Array], ArrayLike],
        name: str = "",
    ):
        super().__init__(frame, name)
        if not callable(function):
            raise InputError(f"the load on '{frame}' is no function, give one of (t, place, ...)")
        self._function = function

    def references(self, times: Array) -> Array:
        """See `ExternalForce`."""
        return times[:, None]

    def wrench(self, motion: FrameMotion) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ExternalForce`.

        Raises:
            InputError: The function does not return six numbers.
        """
        if len(motion.reference) > 1:  # the function was called already
            return motion.reference[1:4], motion.reference[4:]
        time = float(motion.reference[0])  # type: ignore[arg-type]
        result = np.asarray(
            self._function(time, *(np.array(part, dtype=np.float64) for part in motion[:4]))
        )
        if result.shape != (6,) or result.dtype.kind not in "fiu" or not np.isfinite(result).all():
            raise InputError(
                f"the load '{self.name}' gives {np.array2string(result, separator=', ')} at "
                f"t = {time:g} s, give six numbers: force [N] and moment [N m]"
            )
        return result[:3].tolist(), result[3:].tolist()


def _as_finite_array(values: ArrayLike, label: str, dimensions: int | None) -> Array:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if not np.isfinite(array).all() or (dimensions is not None and array.ndim != dimensions):
        raise InputError(f"{label} holds what is no finite number, correct it")
    return array
