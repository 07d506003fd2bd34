"""Phases of a task of levers, each of which ends when its joints have come somewhere."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from crane.common.errors import known


@dataclass(frozen=True)
class Phase:
    """Levers that are held until joints have come to their positions.

    Attributes:
        name: What it is called where it does not end.
        levers: By joint, -1 to 1, a share of the valve's flow.
        until: By joint the position at which its lever goes back to neutral [m], [rad]. The phase
            ends when all joints have come to theirs.
        within: Time that it may take [s].
    """

    name: str
    levers: Mapping[str, float]
    until: Mapping[str, float]
    within: float

    def without(self, joints: Iterable[str]) -> "Phase":
        """The same without some joints."""
        gone = set(joints)
        levers, until = (
            {joint: x for joint, x in part.items() if joint not in gone}
            for part in (self.levers, self.until)
        )
        return Phase(self.name, levers, until, self.within)

    def problems(
        self,
        valves: Iterable[str],
        limits: Mapping[str, tuple[float, float]],
        before: Mapping[str, float],
    ) -> Iterator[tuple[str, str, str]]:
        """What cannot be: whether of "levers", "until" or "within", the joint, and what to say.

        Args:
            valves: Joints that have one.
            limits: Lower and upper of joints, as far as they are known.
            before: Where joints come from, as far as that is known.
        """
        if not self.levers:
            yield "levers", "", f"phase '{self.name}' moves no lever, give it one"
        if not self.within > 0:
            text = f"phase '{self.name}' may take {self.within:g} s, give it a time above 0"
            yield "within", "", text
        valves = tuple(valves)
        for joint in self.levers:
            if text := self._lever(joint, valves):
                yield "levers", joint, text
        for joint, end in self.until.items():
            if text := self._until(joint, limits.get(joint, (end, end)), before.get(joint)):
                yield "until", joint, text

    def _lever(self, joint: str, valves: tuple[str, ...]) -> str:
        lever, what = self.levers[joint], f"the lever of '{joint}' in phase '{self.name}'"
        if joint not in valves:
            return f"no valve for '{joint}', {known(valves, joint)}"
        if not 0 < abs(lever) <= 1:
            return f"{what} is {lever:g}, give it -1 to 1 and not 0"
        if joint not in self.until:
            return f"{what} has no position that it is held until, add it under 'until'"
        return ""

    def _until(self, joint: str, ends: tuple[float, float], before: float | None) -> str:
        if joint not in self.levers:
            others = known(self.levers, joint)
            return f"phase '{self.name}' moves no lever of '{joint}' and waits for it, {others}"
        what, end = f"phase '{self.name}' waits for '{joint}' at", self.until[joint]
        if not ends[0] <= end <= ends[1]:
            return f"{what} {end:g}, beyond its limits {ends[0]:g} to {ends[1]:g}"
        if before is not None and self.levers[joint] * (end - before) < 0:
            return f"{what} {end:g}, away from which its lever moves it from {before:g}: turn it"
        return ""
