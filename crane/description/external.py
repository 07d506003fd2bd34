"""Forces from outside: wrenches at frames of a machine, by time, place and velocity."""

from collections.abc import Callable, Sequence
from copy import copy
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen.scalar import Number, times
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.common.shown import Brief

AXES = ("world", "frame")
PARTS = tuple(f"{kind}_{axis}" for kind in ("force", "moment") for axis in "xyz")


class Here(NamedTuple):
    """What a force from outside sees: floats, or formulas while it becomes machine code.

    Attributes:
        place: (3,) origin of its frame in the world [m].
        turn: (3, 3) its axes, columns in the world.
        velocity: (3,) of the origin, in the world [m/s].
        spin: (3,) angular velocity, in the world [rad/s].
        reference: (c,) its row of `references`.
        states: (s,) its own, see `ExternalForce.states`.
    """

    place: list[Number]
    turn: list[list[Number]]
    velocity: list[Number]
    spin: list[Number]
    reference: list[Number]
    states: Sequence[Number] = ()


class ExternalForce(Brief):
    """A wrench at a frame. What depends on more than time writes `wrench` in a class of its own.

    Its formulas become machine code: `wrench` is called with numbers and, once, with formulas.
    `crane.Wrench` is one by time, `crane.Pushing` calls a function in Python.

    Args:
        frame: A link of the machine.
        name: What it is called in recordings; its frame's name if not given.

    Attributes:
        frame: The same.
        name: Likewise.
    """

    traced: ClassVar[bool] = True  # else `wrench` reads its answer behind the references

    def __init__(self, frame: str, name: str = ""):
        self.frame, self.name = frame, name or frame

    def references(self, times: Array) -> Array:
        """All that depends on time alone, (N, c) at times (N,) [s]."""
        return np.zeros((len(times), 0))

    def breaks(self) -> Array:
        """Times (k,) [s] at which that jumps or turns sharply, in order."""
        return np.zeros(0)

    def edges(self, here: Here) -> Sequence[Number]:
        """Lengths [m] at whose signs the wrench bends sharply: steps end there; none yet."""
        return ()

    @property
    def channels(self) -> list[tuple[str, str]]:
        """Names and units of what `look` tells; nothing yet."""
        return []

    def look(self, here: Here) -> Sequence[Number]:
        """What is recorded besides the wrench, in the order of `channels`."""
        return ()

    @property
    def states(self) -> int:
        """How many lengths [m] it remembers, which are 0 at the start; none yet."""
        return 0

    def rates(self, here: Here) -> Sequence[Number]:
        """How fast those change [m/s]."""
        return ()

    def wrench(self, here: Here) -> tuple[Sequence[Number], Sequence[Number]]:
        """Force (3,) [N] and moment (3,) [N m] about the frame's origin, in the world's axes."""
        raise NotImplementedError


class Wrench(ExternalForce):
    """A wrench by time: constant, or straight between given times and held before and after.

    Args:
        frame: See `ExternalForce`.
        force: (3,) or (N, 3) [N].
        moment: (3,) or (N, 3) about the frame's origin [N m].
        times: (N,) rising [s]; none of what is constant. Two may be equal, where it jumps.
        axes: "world", or "frame" of what turns with it.
        name: See `ExternalForce`.

    Attributes:
        times: (N,), one of what is constant.
        values: (N, 6) force and moment.
        axes: As given.

    Raises:
        InputError: Wrong shapes, no numbers, times that do not rise, or other axes.
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
        what = f"the load on '{frame}'"
        if axes not in AXES:
            raise InputError(f"{what} has axes '{axes}', give 'world' or 'frame'")
        self.axes = axes
        self.times = _numbers([0.0] if times is None else times, f"the list of times of {what}", 1)
        parts = []
        for name_, given in (("force", force), ("moment", moment)):
            part = _numbers(given, f"the {name_} of {what}", None)
            if part.shape not in ((3,), (len(self.times), 3)):
                raise InputError(
                    f"{what}: {name_} has the shape {part.shape}, give (3,), or with times (N,) "
                    "(N, 3)"
                )
            parts.append(np.broadcast_to(part, (len(self.times), 3)))
        if not len(self.times) or (np.diff(self.times) < 0).any():
            raise InputError(f"{what}: times do not rise, give them in order")
        self.values: Array = np.hstack(parts)

    def references(self, times: Array) -> Array:
        """See `ExternalForce`."""
        columns = [np.interp(times, self.times, column) for column in self.values.T]
        return np.stack(columns, axis=1)

    def breaks(self) -> Array:
        """See `ExternalForce`."""
        return np.unique(self.times) if len(self.times) > 1 else np.zeros(0)

    def wrench(self, here: Here) -> tuple[Sequence[Number], Sequence[Number]]:
        """See `ExternalForce`."""
        force, moment = here.reference[:3], here.reference[3:]
        if self.axes == "frame":
            return times(here.turn, force), times(here.turn, moment)
        return force, moment


class PhasedWrench(Wrench):
    """A wrench over the phases of a task of levers in place of time, straight in between.

    Args:
        frame: See `ExternalForce`.
        force: See `Wrench`.
        moment: See `Wrench`.
        phases: (N,) rising: 0 as the first phase begins, 1.5 when the second is half done.
        axes: See `Wrench`.
        name: See `ExternalForce`.

    Attributes:
        clock: Tells the phase (N,) at times (N,) [s]; None until a run has one, see `ticking`.
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

    def ticking(self, clock: Callable[[Array], Array]) -> "PhasedWrench":
        """The same by the clock of a run."""
        found = copy(self)
        found.clock = clock
        return found

    def references(self, times: Array) -> Array:
        """See `ExternalForce`."""
        return super().references(times if self.clock is None else self.clock(times))

    def breaks(self) -> Array:
        """See `ExternalForce`: when phases end is not known before."""
        return np.zeros(0)


class Pushing(ExternalForce):
    """A wrench by a function in Python, which is called at every stage of a step.

    Args:
        frame: See `ExternalForce`.
        function: (t, place (3,), turn (3, 3), velocity (3,), spin (3,)) -> (6,) force and moment
            about the frame's origin in the world's axes [N], [N m]; see `Here`.
        name: See `ExternalForce`.
    """

    traced = False

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

    def wrench(self, here: Here) -> tuple[Sequence[Number], Sequence[Number]]:
        """See `ExternalForce`.

        Raises:
            InputError: The function does not give six numbers.
        """
        if len(here.reference) > 1:  # asked already
            return here.reference[1:4], here.reference[4:]
        time = float(here.reference[0])  # type: ignore[arg-type]
        seen = (np.array(part, dtype=np.float64) for part in here[:4])
        given = np.asarray(self._function(time, *seen))
        if given.shape != (6,) or given.dtype.kind not in "fiu" or not np.isfinite(given).all():
            raise InputError(
                f"the load '{self.name}' gives {np.array2string(given, separator=', ')} at "
                f"t = {time:g} s, give six numbers: force [N] and moment [N m]"
            )
        return given[:3].tolist(), given[3:].tolist()


def _numbers(given: ArrayLike, what: str, axes: int | None) -> Array:
    try:
        found = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.array(np.nan)
    if not np.isfinite(found).all() or (axes is not None and found.ndim != axes):
        raise InputError(f"{what} holds what is no finite number, correct it")
    return found
