"""A pump with its regulator as formulas."""

from collections.abc import Mapping, Sequence

from crane.codegen import Number, maximum
from crane.codegen.scalar import apply, minimum
from crane.hydraulics.driven_cylinder import DrivenCylinder
from crane.hydraulics.flow import Flow, clipped, root
from crane.hydraulics.sources import TANK, Supply

_SLIGHT = 1.0e4  # [Pa], below which power limits nothing
_CENTRED = "fixed", "negative", "positive"  # whose flow goes on to the throttle without valves
_CLOSED = 1.0e-40  # square of a coefficient that lets nothing pass


class Pump:
    """A pump at an instant, see `Supply`.

    Args:
        name: Of its node.
        supply: What it is.
        numbers: Its numbers.
        pressures: Of all nodes [Pa].
        load: Highest of its valves [Pa].
        limiting: Pressure that its power is divided by [Pa].
        fed: What it feeds.
        speed: Of the engine over its set speed.
        share: Of its displacement, where that takes time.
        sensed: What its load-sensing line tells it [Pa], where that takes time.

    Attributes:
        flows: Into its line, and out of it past the pump, the relief valve and open centres.
        asked: Share of the displacement that the regulator asks for.
        share: Share that it has.
        rates: Those of the share and of what it senses, where they take time.
        shaft: Power that turns the pump [W].
        torque: The same over the speed's share [W].
        heat: What is lost in it beside its slip [W].
    """

    def __init__(
        self,
        name: str,
        supply: Supply,
        numbers: Mapping[str, Number],
        pressures: Mapping[str, Number],
        load: Number,
        limiting: Number,
        fed: Sequence[DrivenCylinder],
        speed: Number,
        share: Number | None,
        sensed: Number | None,
    ):
        self._name, self._supply, self._numbers, self._fed = name, supply, numbers, fed
        self._p, self._tank = pressures[name], pressures[TANK]
        self.flows: list[Flow] = []
        before = self._bypass()
        late: list[Number] = []
        if sensed is not None:
            late, load = [(load - sensed) * numbers["per_sensing"]], sensed
        self.asked = self._regulated(load, limiting, before)
        self.share = self.asked if share is None else share
        self.rates = late
        if share is not None:
            self.rates = [(self.asked - share) * numbers["per_response"], *late]
        above = self._p - self._tank
        delivered = self.share * numbers["flow"] * speed
        self.flows.append(Flow(TANK, name, delivered, "pump"))
        if supply.slip > 0:
            self.flows.append(Flow(name, TANK, numbers["slip"] * above, "slip"))
        if supply.relief > 0:
            over = maximum(self._p - numbers["relief"], 0.0)
            self.flows.append(Flow(name, TANK, numbers["relief_gain"] * over, "relief"))
        moved = self.share * numbers["flow"] * above
        rubbed = numbers["friction"] * apply("abs", moved)  # also where the line drives the pump
        self.torque = moved + rubbed + numbers["drag"] * speed
        self.heat = rubbed * speed + numbers["drag"] * speed * speed
        self.shaft = delivered * above + self.heat

    def _bypass(self) -> Number:
        """Pressure over the tank's before the throttle behind its open centres [Pa].

        Throttles in series: 1 / c^2 = sum of 1 / c_i^2, and each has its share of the drop.
        """
        centres = [one.centre() for one in self._fed if one.valve.centre > 0]
        supply = self._supply
        if not centres and not (supply.throttle > 0 and supply.control in _CENTRED):
            return 0.0
        total: Number = 0.0
        for c in centres:
            total = total + 1.0 / (c * c + _CLOSED)
        last: Number = 0.0
        if supply.throttle > 0:
            last = 1.0 / (self._numbers["throttle"] * self._numbers["throttle"])
        total = total + last
        drop = self._p - self._tank
        rate = root(drop) / apply("sqrt", total)
        self.flows.append(Flow(self._name, TANK, rate, "bypass"))
        return drop * last / total

    def _regulated(self, load: Number, limiting: Number, before: Number) -> Number:
        """The share that the regulator asks for."""
        numbers, control, p = self._numbers, self._supply.control, self._p
        if control == "fixed":
            return 1.0
        cut_off = (numbers["pressure"] - p) * numbers["per_droop"]
        asked: Number = cut_off
        if control == "load-sensing":
            wanted = maximum(load + numbers["margin"], numbers["standby"])
            asked = (minimum(wanted, numbers["pressure"]) - p) * numbers["per_droop"]
        elif control == "negative":
            asked = minimum(1.0 - before / numbers["signal"], cut_off)
        elif control == "positive":
            asked = minimum(sum((one.demand for one in self._fed), 0.0), cut_off)
        if self._supply.power > 0:
            most = numbers["flow"] * maximum(limiting - self._tank, _SLIGHT)
            asked = minimum(asked, numbers["power"] / most)
        return clipped(asked, numbers["least"], 1.0)
