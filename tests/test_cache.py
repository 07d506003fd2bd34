"""The folder of cached machine code: location, bounds and permissions."""

import os
import subprocess
import sys

import numpy as np
import pytest

from crane.codegen import Program, Tape
from crane.codegen.llvm import machine_code
from crane.common import file_cache


@pytest.fixture
def place(tmp_path, monkeypatch):
    folder = tmp_path / "objects"
    monkeypatch.setattr(file_cache, "cache_folder", lambda: folder)
    return folder


@pytest.fixture
def translated(monkeypatch):
    """Texts that were translated."""
    texts, translate = [], machine_code._compile_to_object_code

    def counted(text, target):
        texts.append(text)
        return translate(text, target)

    monkeypatch.setattr(machine_code, "_compile_to_object_code", counted)
    return texts


def square_sum(factor=3.0):
    """x y + factor x of a compiled program."""
    tape, program = Tape(), Program()
    x, y = tape.load_vector(0, 0, 2)
    program.add_formula("formula", 1, [x * y + factor * x])
    program.compile()
    out = np.empty(1)
    program.call("formula", np.array([2.0, 5.0]), out)
    return out[0]


def test_what_was_translated_once_is_read(place, translated):
    assert square_sum() == 16.0
    assert square_sum() == 16.0
    assert len(translated) == 1
    assert square_sum(4.0) == 18.0  # another program
    assert len(translated) == 2 and len(list(place.iterdir())) == 2


def test_another_process_reads_it(place, translated):
    square_sum()
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from pathlib import Path\n"
        "import test_cache as t\n"
        "t.file_cache.cache_folder = lambda: Path(sys.argv[2])\n"
        "def never(*_): raise AssertionError('translated')\n"
        "t.machine_code._compile_to_object_code = never\n"
        f"t.machine_code._OPTIMIZATION_LEVEL = {machine_code._OPTIMIZATION_LEVEL}\n"
        "assert t.square_sum() == 16.0\n"
    )
    here = os.path.dirname(__file__)
    subprocess.run([sys.executable, "-c", program, here, str(place)], check=True)


@pytest.mark.parametrize("damage", [b"", b"\0" * 40, None])
def test_damaged_files_are_made_anew(place, translated, damage):
    square_sum()
    (file,) = place.iterdir()
    whole = file.read_bytes()
    changed = bytearray(whole)
    changed[-100] ^= 1
    file.write_bytes(bytes(changed) if damage is None else damage)
    assert square_sum() == 16.0
    assert len(translated) == 2 and file.read_bytes() == whole


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_folder_that_others_may_write_is_not_used(place, translated):
    place.mkdir(mode=0o700)
    place.chmod(0o777)
    assert square_sum() == square_sum() == 16.0
    assert len(translated) == 2 and not list(place.iterdir())


def test_without_a_folder_nothing_is_kept(place, translated):
    place.write_text("a file")
    assert square_sum() == square_sum() == 16.0
    assert len(translated) == 2


def test_what_was_used_least_lately_makes_room(place, monkeypatch):
    monkeypatch.setattr(file_cache, "MAX_CACHE_SIZE", 400)  # three of them
    for number, name in enumerate("abc"):
        file_cache.cached_object_code(name, lambda: b"x" * 100)
        for file in place.iterdir():
            if file.stat().st_mtime > 1e9:
                os.utime(file, (number, number))
    first = file_cache.cached_object_code("a", lambda: b"never")  # used now
    file_cache.cached_object_code("d", lambda: b"y" * 100)
    left = {file.read_bytes()[-1:] for file in place.iterdir()}
    assert first == b"x" * 100 and left == {b"x", b"y"}
    assert file_cache.cached_object_code("a", lambda: b"gone") == first
    assert file_cache.cached_object_code("b", lambda: b"gone") == b"gone"


def test_the_folder_is_not_looked_through_each_time(place, monkeypatch):
    looks, look = [], file_cache._cache_files

    def counted(folder):
        looks.append(folder)
        return look(folder)

    monkeypatch.setattr(file_cache, "_cache_files", counted)
    monkeypatch.setattr(file_cache, "MAX_CACHE_SIZE", 64 * 132)  # with their digests
    for number in range(100):
        file_cache.cached_object_code(str(number), lambda: b"x" * 100)
        assert len(list(place.iterdir())) == min(number + 1, 64 - (63 - number) % 4)
    assert len(looks) == 25
