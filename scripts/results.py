"""Results of measurements in a page between two marks, and what they were measured on."""

import importlib.metadata
import os
import platform
from pathlib import Path


def conditions() -> str:
    """What it was measured on."""
    names = ("pin", "mujoco", "numpy", "scipy", "llvmlite")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    return (
        f"Measured with Python {platform.python_version()}, {versions} on {platform.system()}, "
        f"{platform.machine()}, {os.cpu_count()} cores, with other work on them as of a load "
        f"average of {os.getloadavg()[0]:.1f}: wall times suffer from it, CPU times hardly."
    )


def put(page: Path, marks: tuple[str, str], parts: list[str]) -> None:
    """Put paragraphs between two marks of a page, in place of what is there."""
    begin, end = marks
    before, rest = page.read_text(encoding="utf-8").split(begin)
    _, after = rest.split(end)
    page.write_text("\n\n".join([before + begin, *parts, end + after]), encoding="utf-8")
