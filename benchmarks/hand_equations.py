"""Equations of hydraulic drives, friction and stops written by hand, without crane.

Numbers come from the machine files and URDFs, which are read as plain YAML and XML. The equations
are those of the textbooks, as docs/hydraulics.md has them.
"""

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from numpy.typing import NDArray

Array = NDArray[np.float64]
Numbers = Mapping[str, Any]

GRAVITY = 9.81
LAMINAR = 1e4  # pressure drop below which an orifice is laminar [Pa]
PRESSURE_SCALE = 1e7  # of tolerances [Pa]
MACHINES = Path(__file__).parent / "problems" / "machines"


class Functions:
    """Functions with kinks."""

    def clip(self, x: float, lower: float = 0.0, upper: float = 1.0) -> float:
        """A value limited to an interval."""
        return min(max(x, lower), upper)

    def positive(self, x: float) -> float:
        """The positive part."""
        return max(x, 0.0)

    def sign(self, x: float) -> float:
        """1 for positive values, else -1."""
        return 1.0 if x > 0 else -1.0

    def root(self, drop: float) -> float:
        """Signed square root; below `LAMINAR` the odd cubic with the value and slope there."""
        if drop >= LAMINAR:
            return drop**0.5
        if drop <= -LAMINAR:
            return -((-drop) ** 0.5)
        x = drop / LAMINAR
        return LAMINAR**0.5 * x * (1.25 - 0.25 * x * x)


class RecordingFunctions(Functions):
    """The same, which note the values whose signs change at their kinks.

    Attributes:
        values: The values.
    """

    def __init__(self) -> None:
        self.values: list[float] = []

    def clip(self, x: float, lower: float = 0.0, upper: float = 1.0) -> float:
        """See `Functions`."""
        self.values += [x - lower, x - upper]
        return super().clip(x, lower, upper)

    def positive(self, x: float) -> float:
        """See `Functions`."""
        self.values.append(x)
        return super().positive(x)

    def sign(self, x: float) -> float:
        """See `Functions`."""
        self.values.append(x)
        return super().sign(x)

    def root(self, drop: float) -> float:
        """See `Functions`."""
        self.values += [drop - LAMINAR, drop + LAMINAR]
        return super().root(drop)


PLAIN = Functions()


class HandEquations(ABC):
    """Equations of a problem.

    Args:
        data: Its file.

    Attributes:
        start: State at the start.
        pressure_names: Channels of crane that have the pressures among the outputs.
    """

    start: Array
    pressure_names: tuple[str, ...] = ()

    def __init__(self, data: Numbers):
        self.data = data
        path = MACHINES / data["machine"]
        self.machine: Numbers = yaml.safe_load(path.read_text(encoding="utf-8"))
        urdf = path.parent / self.machine["chains"][0]["urdf"]
        robot = ElementTree.parse(urdf).getroot()
        links = {link.get("name"): link for link in robot.iter("link")}
        self.masses: dict[str, float] = {}
        self.limits: dict[str, tuple[float, float]] = {}
        for joint in robot.iter("joint"):
            mass, limit = _find(links[_find(joint, "child").get("link")], "inertial/mass"), None
            name = str(joint.get("name"))
            self.masses[name] = float(mass.get("value", 0.0))
            limit = _find(joint, "limit")
            self.limits[name] = float(limit.get("lower", 0)), float(limit.get("upper", 0))

    @abstractmethod
    def rate(self, t: float, y: Sequence[float], functions: Functions = PLAIN) -> list[float]:
        """Derivative of the state."""

    @abstractmethod
    def outputs(self, y: Array) -> Array:
        """Strokes [m], then pressures [Pa]."""

    @property
    def scales(self) -> Array:
        """Sizes of the states, to which tolerances are relative."""
        return np.where(np.abs(self.start) > 1e4, PRESSURE_SCALE, 1.0)

    def kinks(self, t: float, y: Sequence[float]) -> Array:
        """Values whose signs change at the kinks of the rate."""
        functions = RecordingFunctions()
        self.rate(t, y, functions)
        return np.array(functions.values)

    @cached_property
    def corners(self) -> list[float]:
        """Instants at which signals have corners, within the duration [s]."""
        times = self.data.get("time", ())
        return [t for t in times if 0 < t < self.data["duration"]]

    def signal(self, name: str) -> Callable[[float], float]:
        """A signal over time, linear between its corners."""
        times, values = self.data["time"], self.data["signals"][name]
        slopes = [
            (u1 - u0) / (t1 - t0)
            for t0, t1, u0, u1 in zip(times, times[1:], values, values[1:], strict=False)
        ]

        def evaluate(t: float) -> float:
            i = min(max(bisect_left(times, t) - 1, 0), len(slopes) - 1)
            return values[i] + slopes[i] * (t - times[i])

        return evaluate


def _find(element: ElementTree.Element, path: str) -> ElementTree.Element:
    found = element.find(path)
    return ElementTree.Element("none") if found is None else found


class Function:
    """A valve with its spool and cylinder.

    Args:
        equations: The problem.
        joint: Name of the joint.
    """

    def __init__(self, equations: HandEquations, joint: str):
        circuit = equations.machine["hydraulics"]
        self.signal = equations.signal(joint)
        self.cylinder: Numbers = circuit["cylinders"].get("all", {}) | circuit["cylinders"][joint]
        self.valve: Numbers = circuit["valves"].get("all", {}) | (
            circuit["valves"].get(joint) or {}
        )
        self.lower, upper = equations.limits[joint]
        self.stroke = upper - self.lower
        self.tank, self.supply = (float(circuit["supply"][key]) for key in ("tank", "pressure"))
        self.modulus = float(circuit["oil"]["bulk_modulus"])
        self.vapour = float(circuit["oil"].get("vapour_pressure", 1e3))

    def opening(self, u: float, functions: Functions) -> tuple[float, float]:
        """Openings for positive and negative positions of the spool, beyond the dead band."""
        band = self.valve.get("dead_band", 0.0)
        return (
            functions.clip((u - band) / (1.0 - band)),
            functions.clip((-u - band) / (1.0 - band)),
        )

    def spool_rate(self, t: float, u: float, speed: float) -> list[float]:
        """Rate u'' = w^2 (signal - u) - 2 D w u'."""
        w, damping = self.valve["bandwidth"], self.valve["damping"]
        return [speed, w * w * (self.signal(t) - u) - 2.0 * damping * w * speed]

    def flows(
        self, openings: tuple[float, float], p: float, a: float, b: float, functions: Functions
    ) -> tuple[float, float, float]:
        """Flows into A and B, and the flow from the supply at the pressure p [m3/s]."""
        valve, (out, back) = self.valve, openings
        drops = p - a, p - b
        if valve["type"] == "compensated":  # the compensator takes what is above the margin
            drops = tuple(functions.clip(drop, 0.0, valve["margin"]) for drop in drops)
        into_a = valve["c1"] * out * functions.root(drops[0])
        into_b = valve["c4"] * back * functions.root(drops[1])
        from_a = self.outlet_a(valve["c3"] * back, a, b, functions) * functions.root(a - self.tank)
        from_b = valve["c2"] * out * functions.root(b - self.tank)
        return into_a - from_a, into_b - from_b, into_a + into_b

    def outlet_a(self, edge: float, a: float, b: float, functions: Functions) -> float:
        """Coefficient of the outlet of A, in series with a counterbalance valve if there is one.

        Both see the same flow, and their drops (Q / c)^2 add up.
        """
        valve = self.cylinder.get("counterbalance_a")
        if valve is None:
            return edge
        excess = a + valve["pilot_ratio"] * b - valve["pressure"]
        holding = valve["coefficient"] * functions.clip(excess / valve["range"])
        if not edge * holding:
            return 0.0
        return 1.0 / (edge**-2 + holding**-2) ** 0.5

    def pressures(self, y: Sequence[float], functions: Functions) -> list[float]:
        """Pressures in A and B of their states, which are less than that of vapour in a void."""
        return [self.vapour + functions.positive(state - self.vapour) for state in y]

    def chamber_rates(
        self, x: float, v: float, y: Sequence[float], inflows: Sequence[float], f: Functions
    ) -> list[float]:
        """Rates p' = K / V (Q - V') of both chambers, with leakage and shock valves.

        A void has V of the piston in the middle. Its size is (p_vapour - state) V / K.
        """
        (a, b), c, stroke = self.pressures(y, f), self.cylinder, x - self.lower
        leak = c.get("leakage", 0.0) * (a - b)
        relief = [0.0, 0.0]
        if "relief" in c:
            relief = [c["relief_gain"] * f.positive(p - c["relief"]) for p in (a, b)]
        middle = 0.5 * self.stroke
        x_a, x_b = (
            middle if f.sign(state - self.vapour) < 0 else length
            for state, length in zip(y, (stroke, self.stroke - stroke), strict=True)
        )
        return [
            self.modulus / (c["hose_a"] + c["area_a"] * x_a)
            * (inflows[0] - leak - relief[0] - c["area_a"] * v),
            self.modulus / (c["hose_b"] + c["area_b"] * x_b)
            * (inflows[1] + leak - relief[1] + c["area_b"] * v),
        ]  # fmt: skip

    def force(self, a: float, b: float) -> float:
        """Force of the cylinder [N]."""
        return float(self.cylinder["area_a"] * a - self.cylinder["area_b"] * b)

    def resting_pressures(self, force: float) -> tuple[float, float]:
        """Pressures in A and B that carry a force, one of them that of the tank."""
        area_a, area_b, tank = self.cylinder["area_a"], self.cylinder["area_b"], self.tank
        excess = force - tank * (area_a - area_b)
        return tank + max(excess, 0.0) / area_a, tank + max(-excess, 0.0) / area_b


class LoadsOnCylinders(HandEquations):
    """Vertical loads on cylinders, on a supply of constant pressure or on a pump.

    State: x, v, p_A, p_B, spool, its speed of each function; pressure of the line; displacement
    and sensed load of a load-sensing pump.
    """

    def __init__(self, data: Numbers):
        super().__init__(data)
        self.joints: list[str] = self.machine["active"]
        self.pump: Numbers = self.machine["hydraulics"]["supply"]
        self.functions = [Function(self, joint) for joint in self.joints]
        self.viscous = [self.machine["friction"][joint]["viscous"] for joint in self.joints]
        self.senses = self.pump.get("control") == "load-sensing"
        start: list[float] = []
        for joint, function in zip(self.joints, self.functions, strict=True):
            a, b = function.resting_pressures(GRAVITY * self.masses[joint])
            start += [data["start"][joint], 0.0, a, b, function.signal(0.0), 0.0]
        tank = float(self.pump["tank"])
        if self.senses:
            idle = max(tank + self.pump["margin"], self.pump["standby"])
            start += [min(idle, self.pump["pressure"]), 0.0, tank]
        elif "flow" in self.pump:
            start.append(self.pump["pressure"])
        self.start = np.array(start)
        self.pressure_names = tuple(
            f"pressure_{joint}_{side}" for joint in self.joints for side in "ab"
        )
        if "flow" in self.pump:
            self.pressure_names += ("pressure_supply",)

    def outputs(self, y: Array) -> Array:
        """See `HandEquations.outputs`."""
        per_function = [y[i : i + 6] for i in range(0, 6 * len(self.joints), 6)]
        strokes = [part[0] for part in per_function]
        pressures = [
            p
            for function, part in zip(self.functions, per_function, strict=True)
            for p in function.pressures(part[2:4], PLAIN)
        ]
        if "flow" in self.pump:
            pressures.append(y[6 * len(self.joints)])
        return np.array(strokes + pressures)

    def rate(self, t: float, y: Sequence[float], functions: Functions = PLAIN) -> list[float]:
        """See `HandEquations.rate`."""
        count = 6 * len(self.joints)
        p = y[count] if len(y) > count else self.pump["pressure"]
        rates: list[float] = []
        drawn, load = 0.0, self.pump["tank"]
        for i, function in enumerate(self.functions):
            x, v, *states, u, speed = y[6 * i : 6 * i + 6]
            a, b = function.pressures(states, functions)
            openings = function.opening(u, functions)
            into_a, into_b, supplied = function.flows(openings, p, a, b, functions)
            drawn += supplied
            force = function.force(a, b) - self.viscous[i] * v
            rates += [v, force / self.masses[self.joints[i]] - GRAVITY]
            rates += function.chamber_rates(x, v, states, (into_a, into_b), functions)
            rates += function.spool_rate(t, u, speed)
            if self.senses:
                load = self.largest_load(load, openings, (a, b), functions)
        if len(y) == count:
            return rates
        return rates + self.pump_rates(y[count:], drawn, load, functions)

    def largest_load(
        self,
        load: float,
        openings: Sequence[float],
        pressures: Sequence[float],
        functions: Functions,
    ) -> float:
        """The highest of the load pressures that open valves report, in full from 1 % on."""
        tank = self.pump["tank"]
        for opening, pressure in zip(openings, pressures, strict=True):
            own = tank + functions.clip(100.0 * opening) * (pressure - tank)
            load += functions.positive(own - load)
        return load

    def pump_rates(
        self, y: Sequence[float], drawn: float, load: float, functions: Functions
    ) -> list[float]:
        """Rates of the line's pressure, of the displacement, and of the sensed load."""
        pump, p, tank = self.pump, y[0], self.pump["tank"]
        line = self.machine["hydraulics"]["oil"]["bulk_modulus"] / pump["volume"]
        if not self.senses:
            share = functions.clip((pump["pressure"] - p) / pump["droop"])
            return [line * (share * pump["flow"] - drawn)]
        share, sensed = y[1], y[2]
        wanted = sensed + pump["margin"]
        wanted += functions.positive(pump["standby"] - wanted)
        wanted -= functions.positive(wanted - pump["pressure"])
        requested = functions.clip((wanted - p) / pump["droop"])
        relief = pump["relief_gain"] * functions.positive(p - pump["relief"])
        slip = pump["slip"] * (p - tank)
        response = pump["response"]
        return [
            line * (share * pump["flow"] - drawn - relief - slip),
            (requested - share) / response,
            (load - sensed) / (pump["sensing"] * response),
        ]


class FallOnStop(HandEquations):
    """A load that falls onto the lower stop: m x'' = k d max(0, 1 - c x') - m g, d below it."""

    def __init__(self, data: Numbers):
        super().__init__(data)
        ((joint, self.stop),) = self.machine["end_stops"].items()
        self.mass, (self.lower, _) = self.masses[joint], self.limits[joint]
        self.start = np.array([data["start"][joint], 0.0])

    def rate(self, t: float, y: Sequence[float], functions: Functions = PLAIN) -> list[float]:
        """See `HandEquations.rate`."""
        x, v = y
        depth = functions.positive(self.lower - x)
        harder = functions.positive(1.0 - self.stop["damping"] * v)
        return [v, self.stop["stiffness"] * depth * harder / self.mass - GRAVITY]

    def outputs(self, y: Array) -> Array:
        """See `HandEquations.outputs`."""
        return y[:1]
