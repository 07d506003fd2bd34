"""Shared libraries of an FMU from C sources: by ziglang for several platforms, else by cc."""

import os
import platform
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from typing import NamedTuple

from crane.common.errors import CraneWarning, InputError
from crane.common.optional_libraries import installation_hint


class LibraryPlatform(NamedTuple):
    """A platform of an FMU.

    Attributes:
        name_in_fmi2: Its folder in FMI 2.
        suffix: Of libraries.
        zig_target: Target of zig; "" where the compiler of that platform is needed.
    """

    name_in_fmi2: str
    suffix: str
    zig_target: str = ""


PLATFORMS = {
    "x86_64-linux": LibraryPlatform("linux64", ".so", "x86_64-linux-gnu.2.17"),
    "x86_64-windows": LibraryPlatform("win64", ".dll", "x86_64-windows-gnu"),
    "aarch64-linux": LibraryPlatform("aarch64-linux", ".so", "aarch64-linux-gnu.2.17"),
    "x86_64-darwin": LibraryPlatform("darwin64", ".dylib"),
    "aarch64-darwin": LibraryPlatform("aarch64-darwin", ".dylib"),
}
_FLAGS = (
    "-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden", "-shared",
)  # fmt: skip


def library_compilers() -> dict[str, list[str]]:
    """Commands that compile libraries, by platform.

    Raises:
        InputError: There are none.
    """
    processor = platform.machine().lower()
    processor = {"amd64": "x86_64", "arm64": "aarch64"}.get(processor, processor)
    own = f"{processor}-{platform.system().lower()}"
    found: dict[str, list[str]] = {}
    if find_spec("ziglang") is not None:
        zig = [sys.executable, "-m", "ziglang", "cc", "-s", "-target"]
        found = {key: [*zig, x.zig_target] for key, x in PLATFORMS.items() if x.zig_target}
    compiler = os.environ.get("CC") or next(filter(which, ("cc", "gcc", "clang")), "")
    if own in PLATFORMS and own not in found and compiler:
        found[own] = [*compiler.split(), "-fPIC"]
    if not found:
        raise InputError(
            f"no C compiler is here for the library of an FMU on {own}: install gcc or clang, or "
            f"ziglang: {installation_hint('fmu')}"
        )
    if [*found] == [own]:
        warnings.warn(
            f"the FMU has a library for {own} alone, and its C sources; for Windows and other "
            f"processors ziglang is needed, {installation_hint('fmu')}",
            CraneWarning,
            stacklevel=3,
        )
    return found


def compile_libraries(
    compilers: Mapping[str, list[str]], sources: Mapping[str, str], name: str
) -> dict[str, bytes]:
    """Libraries by platform, compiled at the same time.

    Args:
        compilers: See `library_compilers`.
        sources: Texts by file.
        name: Name of the libraries.

    Raises:
        InputError: A compiler fails.
    """
    files, processes = [x for x in sources if x.endswith(".c")], {}
    with tempfile.TemporaryDirectory() as folder:
        for file, text in sources.items():
            (Path(folder) / file).write_text(text, encoding="utf-8")
        for key, command in compilers.items():
            (Path(folder) / key).mkdir()
            processes[key] = subprocess.Popen(
                [*command, *_FLAGS, *files, "-o", f"{key}/{name}", "-lm"],
                cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
            )  # fmt: skip
        errors = {key: process.communicate()[1] for key, process in processes.items()}
        for key in (key for key, process in processes.items() if process.returncode):
            first = next(iter(errors[key].strip().splitlines()), "it gives no reason")
            raise InputError(f"the C compiler for {key} fails: {first}")
        return {key: (Path(folder) / key / name).read_bytes() for key in processes}
