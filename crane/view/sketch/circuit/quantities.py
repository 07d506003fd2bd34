"""Numbers of a circuit as data sheets have them: bar, l/min, cm2, kW."""

import math


def figure(value: float) -> str:
    """Three digits, without an exponent where that can be read."""
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
        text = f"{value:.{digits}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    return f"{value:.2e}"


def bar(pressure: float) -> str:
    """A pressure."""
    return f"{figure(pressure / 1e5)} bar"


def litres(flow: float) -> str:
    """A flow per minute, without its unit."""
    return figure(flow * 6e4)


def volume(cubic: float) -> str:
    """A volume."""
    return f"{figure(cubic * 1e3)} l" if cubic >= 1e-4 else f"{figure(cubic * 1e6)} cm³"


def squared(area: float) -> str:
    """An area, without its unit, cm2."""
    return figure(area * 1e4)


def per_turn(displacement: float) -> str:
    """A volume per angle as one per turn."""
    turn = displacement * 2 * math.pi
    return f"{figure(turn * 1e3)} l/rev" if turn >= 1e-3 else f"{figure(turn * 1e6)} cm³/rev"
