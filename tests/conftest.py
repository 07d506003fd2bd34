"""Machines that several modules test with, and settings of property tests."""

import dataclasses
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: two processes, two cores

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

import crane  # noqa: E402
from crane.codegen import program_cache  # noqa: E402
from crane.codegen.llvm import machine_code  # noqa: E402
from crane.common import file_cache  # noqa: E402

DATA = Path(__file__).parent / "data"

# postures take milliseconds, the first one of a machine more: time says nothing
settings.register_profile("crane", deadline=None, max_examples=40, derandomize=True)
settings.load_profile("crane")


def pytest_configure(config):
    """Fast tests translate without optimising, in a sixth of the time: they compile hundreds of
    programs that run for milliseconds. Slow ones, and all other processes, do as users do."""
    if config.option.markexpr == "not slow and not long":
        machine_code._OPTIMIZATION_LEVEL = 0


@pytest.fixture(scope="session")
def mini():
    return crane.load("mini_forwarder")


@pytest.fixture(scope="session")
def smooth(mini):
    """With friction that is stiff, not sticking."""
    laws = {
        joint: dataclasses.replace(mini.friction[joint], smoothing=smoothing)
        for joint, smoothing in {"q1": 1e-2, "X1": 1e-3, "X2": 1e-3}.items()
    }
    return mini.replace(friction={**mini.friction, **laws})


@pytest.fixture(scope="session")
def patu():
    return crane.load("patu655")


@pytest.fixture(scope="session")
def excavator():
    return crane.load("excavator")


@pytest.fixture(scope="session")
def kr300():
    return crane.load("kr300")


@pytest.fixture(scope="session")
def slider_crank():
    return crane.load(DATA / "slider_crank.yaml")


@pytest.fixture(scope="session")
def stewart():
    return crane.load(DATA / "stewart.urdf")


@pytest.fixture(scope="session")
def five_bar():
    return crane.load(DATA / "five_bar.urdf")


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder of its own for programs, in a process that has just loaded the package."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(crane, "LOADED", time.time() + 60.0)
    program_cache._files_digest.cache_clear()
    monkeypatch.setattr(machine_code, "_OPTIMIZATION_LEVEL", 1)  # as another process has it
    machine_code.compiler_settings.cache_clear()
    if tmp_path not in file_cache.cache_folder().parents:
        pytest.skip("folders of the user are elsewhere here")
    yield file_cache.cache_folder()
    program_cache._files_digest.cache_clear()
    machine_code.compiler_settings.cache_clear()


@pytest.fixture
def edited(tmp_path):
    """Load a machine file of tests/data with some text replaced: edited(name, old, new, ...)."""

    def load(name, *changes):
        text = (DATA / name).read_text().replace("urdf: ", f"urdf: {DATA}/")
        for old, new in zip(changes[::2], changes[1::2], strict=True):
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / name
        path.write_text(text)
        return crane.load(path)

    return load
