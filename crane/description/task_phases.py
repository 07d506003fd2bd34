"""Phases of a lever task, each of which ends when its joints reach positions."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from crane.common.errors import suggest_names


@dataclass(frozen=True)
class Phase:
    """Levers that are held until joints reach positions.

    Attributes:
        name: Name in messages about a phase that does not end.
        levers: By joint, -1 to 1, relative to the valve's flow.
        until: By joint the position [m], [rad] at which its lever returns to neutral. The phase
            ends when all joints have reached their positions.
        within: Largest duration [s].
    """

    name: str
    levers: Mapping[str, float]
    until: Mapping[str, float]
    within: float

    def without_joints(self, joints: Iterable[str]) -> "Phase":
        """Return the phase without some joints."""
        removed = set(joints)
        levers, until = (
            {joint: x for joint, x in part.items() if joint not in removed}
            for part in (self.levers, self.until)
        )
        return Phase(self.name, levers, until, self.within)

    def find_problems(
        self,
        valves: Iterable[str],
        limits: Mapping[str, tuple[float, float]],
        start_positions: Mapping[str, float],
    ) -> Iterator[tuple[str, str, str]]:
        """Yield the errors of a phase.

        Args:
            valves: Joints that have a valve.
            limits: Lower and upper limit by joint, as far as known.
            start_positions: Position before the phase by joint, as far as known.

        Yields:
            Key of the error ("levers", "until" or "within"), joint, message.
        """
        if not self.levers:
            yield "levers", "", f"phase '{self.name}' moves no lever, give it one"
        if not self.within > 0:
            text = f"phase '{self.name}' may take {self.within:g} s, give it a time above 0"
            yield "within", "", text
        valves = tuple(valves)
        for joint in self.levers:
            if text := self._lever_problem(joint, valves):
                yield "levers", joint, text
        for joint, position in self.until.items():
            if text := self._position_problem(
                joint, limits.get(joint, (position, position)), start_positions.get(joint)
            ):
                yield "until", joint, text

    def _lever_problem(self, joint: str, valves: tuple[str, ...]) -> str:
        lever, label = self.levers[joint], f"the lever of '{joint}' in phase '{self.name}'"
        if joint not in valves:
            return f"no valve for '{joint}', {suggest_names(valves, joint)}"
        if not 0 < abs(lever) <= 1:
            return f"{label} is {lever:g}, give it -1 to 1 and not 0"
        if joint not in self.until:
            return f"{label} has no position that it is held until, add it under 'until'"
        return ""

    def _position_problem(
        self, joint: str, limits: tuple[float, float], start_position: float | None
    ) -> str:
        if joint not in self.levers:
            others = suggest_names(self.levers, joint)
            return f"phase '{self.name}' moves no lever of '{joint}' and waits for it, {others}"
        label, position = f"phase '{self.name}' waits for '{joint}' at", self.until[joint]
        if not limits[0] <= position <= limits[1]:
            return f"{label} {position:g}, beyond its limits {limits[0]:g} to {limits[1]:g}"
        if start_position is not None and self.levers[joint] * (position - start_position) < 0:
            return (
                f"{label} {position:g}, away from which its lever moves it from "
                f"{start_position:g}: turn it"
            )
        return ""
