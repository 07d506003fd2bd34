"""Numbers of a circuit as data sheets have them: bar, l/min, cm2, kW."""

import math


def format_number(value: float) -> str:
    """Three digits, without an exponent where that can be read."""
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
        text = f"{value:.{digits}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    return f"{value:.2e}"


def format_pressure(pressure: float) -> str:
    """A pressure."""
    return f"{format_number(pressure / 1e5)} bar"


def format_flow(flow: float) -> str:
    """A flow per minute, without its unit."""
    return format_number(flow * 6e4)


def format_volume(cubic: float) -> str:
    """A volume."""
    return (
        f"{format_number(cubic * 1e3)} l" if cubic >= 1e-4 else f"{format_number(cubic * 1e6)} cm³"
    )


def format_area(area: float) -> str:
    """An area, without its unit, cm2."""
    return format_number(area * 1e4)


def format_displacement(displacement: float) -> str:
    """A volume per angle as one per turn."""
    volume_per_turn = displacement * 2 * math.pi
    return (
        f"{format_number(volume_per_turn * 1e3)} l/rev"
        if volume_per_turn >= 1e-3
        else f"{format_number(volume_per_turn * 1e6)} cm³/rev"
    )
