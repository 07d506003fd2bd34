"""Random circuits on one to three cylinders and motors, also damaged and starved ones.

Every run has to balance its oil and its energy to 1e-6 of what went through, or to say in one line
why it cannot.
"""

import multiprocessing
import tempfile
import time
import warnings
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from full_circuit import gaps
from hydraulic_rig import rig

import crane
from crane.control import ValveSignals
from crane.machine import Machine

BALANCE = 1e-6
DURATION, STEP, LONGEST = 1.5, 2e-3, 60.0
Numbers = dict[str, Any]


class Outcome(NamedTuple):
    """What came of a seed: how it ended, its two balances, seconds, and what was said."""

    seed: int
    what: str
    oil: float = 0.0
    energy: float = 0.0
    seconds: float = 0.0
    said: str = ""

    @property
    def bad(self) -> bool:
        """Whether it is to be looked at."""
        ended = self.what in ("runs", "one line")
        return not ended or max(self.oil, self.energy) > BALANCE


class _Draw:
    """Numbers of a random circuit; one in ten is far off what is usual."""

    def __init__(self, seed: int):
        self.random = np.random.default_rng(seed)

    def often(self, share: float) -> bool:
        """Whether something is there."""
        return bool(self.random.random() < share)

    def size(self, usual: float, spread: float = 0.5, far: float = 3.0) -> float:
        """A number around a usual one, by decades."""
        away = far if self.often(0.1) else spread
        return float(usual * 10 ** self.random.uniform(-away, away))

    def pump(self, first: bool) -> Numbers:
        """A pump with its regulator."""
        kinds = ["pressure", "load-sensing", "negative", "positive", "fixed"]
        control = str(self.random.choice(kinds))
        out: Numbers = {"pressure": float(self.random.uniform(5e6, 35e6))}
        if control == "pressure" and self.often(0.4):
            return out
        out |= {"control": control, "flow": self.size(6e-4), "droop": self.size(5e5)}
        out["volume"] = self.size(2e-3)
        if control == "load-sensing":
            out |= {"margin": self.size(2e6, 0.3, 1.0), "standby": self.size(2e6, 0.3, 1.0)}
        if control == "negative":
            out |= {"signal": self.size(2e6, 0.3, 1.0), "throttle": self.size(5e-7)}
        if control not in ("pressure", "load-sensing") or self.often(0.3):
            out |= {"relief": out["pressure"] * 1.1, "relief_gain": self.size(1e-8)}
        for key, usual, share in (
            ("response", 0.1, 0.5), ("slip", 1e-12, 0.5), ("drag", 500.0, 0.3),
        ):  # fmt: skip
            if self.often(share):
                out[key] = self.size(usual)
        if self.often(0.4):
            out["friction"] = float(self.random.uniform(0, 0.2))
        if self.often(0.4):
            out["least"] = float(self.random.uniform(0, 0.3))
        if control != "fixed" and self.often(0.5):
            out["power"] = self.size(1e4)
        if first and self.often(0.3):
            out["tank"] = float(self.random.uniform(5e4, 1e6))
        return out

    def valve(self, pumps: list[str], nodes: list[str]) -> Numbers:
        """A valve of any type."""
        kind = str(self.random.choice(["orifice", "compensated", "sharing"]))
        out: Numbers = {"type": kind, "supply": str(self.random.choice(pumps))}
        for edge in ("c1", "c2", "c3", "c4"):
            out[edge] = self.size(4e-7)
            if self.often(0.2):
                u = np.sort(self.random.uniform(0, 1, 3))
                shares = out[edge] * np.sort(self.random.uniform(0, 1, 3))
                shares[0] = 0.0
                out[edge] = [[float(x), float(y)] for x, y in zip(u, shares, strict=True)]
        if kind == "compensated":
            out["margin"] = self.size(7e5, 0.3, 1.0)
        for key, usual, share in (
            ("centre", 3e-6, 0.4), ("regeneration", 5e-7, 0.3), ("bandwidth", 40.0, 0.5),
        ):  # fmt: skip
            if self.often(share):
                out[key] = self.size(usual)
        if self.often(0.3):
            out |= {"float_from": 0.7, "float_coefficient": self.size(1e-6)}
        if self.often(0.3):
            out["hysteresis"] = float(self.random.uniform(0, 0.1))
        if self.often(0.3):
            out["dead_band"] = float(self.random.uniform(-0.2, 0.3))
        for side in "ab":
            if nodes and self.often(0.3):
                out[f"return_{side}"] = str(self.random.choice(nodes))
        return out

    def cylinder(self) -> Numbers:
        """What a cylinder has besides its areas."""
        area = self.size(5e-3, 0.3, 1.0)
        out: Numbers = {"area_a": area, "area_b": area * self.random.uniform(0.4, 1.2)}
        out |= {"hose_a": self.size(2e-4), "hose_b": self.size(2e-4)}
        for key, usual, share in (
            ("leakage", 1e-13, 0.4), ("leakage_a", 1e-13, 0.2), ("gas_a", 1e-6, 0.2),
            ("refill", 1e-6, 0.5), ("relief", 25e6, 0.5), ("cross_relief", 1e7, 0.2),
            ("rupture_a", 3e-4, 0.2), ("rupture_b", 3e-4, 0.2), ("stiffness", 1e7, 0.2),
        ):  # fmt: skip
            if self.often(share):
                out[key] = self.size(usual, 0.3, 1.0)
        if self.often(0.2):
            out |= {"cushion": 0.03, "cushion_coefficient": self.size(1e-7)}
        if self.often(0.2):
            out["counterbalance_a"] = {
                "pressure": self.size(1e7, 0.2, 0.5), "pilot_ratio": self.size(4.0, 0.2, 0.5),
                "range": self.size(2e6, 0.3, 1.0), "coefficient": self.size(3e-7),
            }  # fmt: skip
        return {key: float(x) if isinstance(x, np.floating) else x for key, x in out.items()}

    def motor(self) -> Numbers:
        """A motor."""
        out = {"displacement": self.size(3e-5), "gear": self.size(10.0), "volume": self.size(2e-4)}
        for key, usual in (("cross_relief", 1e7), ("refill", 1e-6), ("leakage", 1e-13)):
            if self.often(0.5):
                out[key] = self.size(usual, 0.3, 1.0)
        return out

    def element(self, nodes: list[str], joints: list[str]) -> Numbers:
        """Something between two nodes."""
        one, two = (str(x) for x in self.random.choice(nodes, 2, replace=False))
        kind = str(self.random.choice(["orifice", "check", "relief", "leak"]))
        out: Numbers = {"type": kind, "from": one, "to": two}
        if kind in ("orifice", "check"):
            out["coefficient"] = self.size(2e-7)
        else:
            out["gain"] = self.size(1e-10 if kind == "relief" else 1e-12)
        if kind in ("check", "relief") and self.often(0.7):
            out["pressure"] = self.size(1e6)
        if self.often(0.3):
            out["joints"] = [str(self.random.choice(joints))]
            out["side"] = str(self.random.choice(["both", "out", "back"]))
        return out


def drawn(seed: int, folder: Path) -> tuple[Machine, ValveSignals]:
    """A machine, and signals of its valves."""
    draw = _Draw(seed)
    joints = ["x", "y", "z"][: int(draw.random.integers(1, 4))]
    motors = {joint: draw.motor() for joint in joints if draw.often(0.3)}
    pumps = {"supply": draw.pump(first=True)}
    for name in ("second", "third"):
        if draw.often(0.4):
            pumps[name] = draw.pump(first=False)
    limited = [name for name, pump in pumps.items() if pump.get("power")]
    if len(limited) > 1 and draw.often(0.6):
        for name in limited:
            pumps[name]["summed"] = limited
    lines: dict[str, Numbers] = {}
    gases: dict[str, Numbers] = {}
    for name in ("line", "back"):
        if draw.often(0.3):
            lines[name] = {"volume": draw.size(1e-3), "pressure": draw.size(1e6)}
    for name in ("gas", "bottle"):
        if draw.often(0.3):
            gases[name] = {
                "volume": draw.size(1e-3), "precharge": draw.size(3e6, 0.3, 1.0),
                "line": draw.size(1e-4),
            }  # fmt: skip
            if draw.often(0.5):
                gases[name]["time_constant"] = draw.size(3.0)
            if draw.often(0.5):
                gases[name]["pressure"] = draw.size(4e6, 0.3, 1.0)
    nodes = ["tank", *pumps, *lines, *gases, *(f"{joint}.{x}" for joint in joints for x in "ab")]
    elements = {f"e{i}": draw.element(nodes, joints) for i in range(draw.random.integers(0, 5))}
    for i, name in enumerate([*lines, *gases]):  # which nothing leads to would be refused
        other = str(draw.random.choice([x for x in nodes if x != name]))
        elements[f"to{i}"] = draw.element([name, other], joints)
    for name in (*[x for x in pumps if x != "supply"], *lines, *gases):  # likewise, no way back
        elements[f"drip_{name}"] = {
            "type": "leak", "from": name, "to": "tank", "gain": draw.size(1e-13),
        }  # fmt: skip
    machine = rig(
        folder,
        joints=tuple(joints),
        axis="0 0 1" if draw.often(0.5) else "1 0 0",
        mass=draw.size(1000.0, 0.3, 1.0),
        inertia=draw.size(50.0),
        motors=motors,
        supply=pumps.pop("supply"),
        supplies=pumps or None,
        valves={joint: draw.valve(["supply", *pumps], [*lines, *gases]) for joint in joints},
        cylinders={joint: draw.cylinder() for joint in joints if joint not in motors},
        lines=lines or None,
        accumulators=gases or None,
        elements=elements or None,
        engine={
            "speed": draw.size(190.0, 0.2, 0.5), "torque": draw.size(200.0), "speed_droop": 10.0,
            "inertia": draw.size(1.0),
        } if draw.often(0.4) else None,
        oil={"air": float(draw.random.uniform(0, 0.02))} if draw.often(0.3) else {},
        friction={"viscous": draw.size(3e3)},
    )  # fmt: skip
    times = np.linspace(0, DURATION, 7)
    wanted = {joint: draw.random.uniform(-1.1, 1.1, 7) for joint in joints}
    for joint in joints:
        wanted[joint][0] = 0.0
    return machine, ValveSignals(machine, times, wanted)


def run(seed: int) -> Outcome:
    """What comes of a seed."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", crane.CraneWarning)
        try:
            machine, signals = drawn(seed, Path(folder))
            found = crane.simulate(machine, signals, duration=DURATION, step=STEP)
        except crane.CraneError as error:
            what = "MORE LINES" if "\n" in str(error) else "one line"
            return Outcome(seed, what, seconds=time.perf_counter() - begun, said=str(error))
    seconds = time.perf_counter() - begun
    if not all(np.isfinite(x).all() for x in found.channels.values()):
        return Outcome(seed, "NOT FINITE", seconds=seconds)
    return Outcome(seed, "runs", *gaps(found, machine), seconds)


def _send(pipe: Connection, seed: int) -> None:
    try:
        pipe.send(run(seed))
    except Exception as error:  # whatever it is, it has to be told
        pipe.send(Outcome(seed, "BREAKS", said=repr(error)))


def bounded(seed: int, longest: float = LONGEST) -> Outcome:
    """The same in a process of its own, which is ended after some time [s]."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("fork").Process(target=_send, args=(theirs, seed))
    process.start()
    theirs.close()
    try:
        found: Outcome = ours.recv() if ours.poll(longest) else Outcome(seed, "TOO LONG")
    except EOFError:
        found = Outcome(seed, "DIES")
    process.kill()
    process.join()
    return found
