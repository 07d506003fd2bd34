"""Recordings as npz: the declared content is compared with the data before it is read."""

import io
import struct
import zipfile

import numpy as np
import pytest

from crane.common.errors import RecordingError
from crane.recordings import npz
from crane.recordings.table_reader import read_table

TIME = np.arange(5) / 100


def npy(header, data=b""):
    """An array file of numpy with any header."""
    text = header.encode("latin1") + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def declared(count, kind="<f8", data=b""):
    return npy(f"{{'descr': '{kind}', 'fortran_order': False, 'shape': ({count},), }}", data)


def written(folder, method=zipfile.ZIP_STORED, **arrays):
    """An npz of given bytes, or arrays; "time [s]" stands beside them unless it is given."""
    arrays = {"time": TIME} | arrays
    names = {"time": "time [s].npy"}
    with zipfile.ZipFile(folder / "run.npz", "w", method) as archive:
        for name, array in arrays.items():
            if not isinstance(array, bytes):
                file = io.BytesIO()
                np.save(file, array, allow_pickle=True)
                array = file.getvalue()
            archive.writestr(names.get(name, f"{name}.npy"), array)
    return folder / "run.npz"


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA])
def test_columns_of_any_number_type(method, tmp_path):
    path = written(
        tmp_path, method, a=np.arange(5, dtype=np.int16), b=np.array([True, False, True, 0, 1]),
        c=np.linspace(0, 1, 5).astype(">f4"), d=np.arange(5, dtype=np.uint64),
    )  # fmt: skip
    table = read_table(path)
    assert list(table.units) == ["time", "a", "b", "c", "d"]
    expected = np.column_stack(
        [TIME, np.arange(5), [1, 0, 1, 0, 1], np.linspace(0, 1, 5).astype("f4"), np.arange(5)]
    )
    np.testing.assert_array_equal(table.values, expected)


def test_long_columns_are_read_in_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr(npz, "_BLOCK_NUMBERS", 7)
    time = np.sqrt(np.arange(100))
    table = read_table(written(tmp_path, time=time, a=time[::-1]))
    np.testing.assert_array_equal(table.values, np.column_stack([time, time[::-1]]))


BAD = {  # arrays, and what is told
    "pickled": ({"a": np.array([None] * 5)}, "'a' has the shape (5,) of object, give (5,) num"),
    "text": ({"a": np.array(["x"] * 5)}, "'a' has the shape (5,) of <U1, give (5,) numbers"),
    "complex": ({"a": TIME + 0j}, "of complex128, give (5,) numbers"),
    "a table": ({"a": np.zeros((5, 2))}, "'a' has the shape (5, 2) of float64"),
    "other length": ({"a": np.zeros(4)}, "'a' has the shape (4,) of float64, give (5,) num"),
    "beyond memory": (
        {"time": declared(1 << 45), "a": declared(1 << 45)},
        "declares 35184372088832 samples of 2 columns, give at most 536870912 numbers",
    ),
    "beyond any number": ({"a": declared("9" * 40)}, f"give ({'9' * 40},) numbers per column"),
    "more than there is": (
        {"time": declared(1000, data=TIME.tobytes())}, "'time [s]' is cut short, save the file",
    ),
    "less than there is": ({"a": declared(5, data=bytes(48))}, "'a' holds more than it declares"),
    "negative": ({"a": declared(-5, data=TIME.tobytes())}, "'a' has the shape (-5,), save"),
    "no shape": ({"a": npy("{'descr': '<f8'}")}, "is no npz file of arrays (Header does not con"),
    "brackets": ({"a": npy("(" * 9000)}, "is no npz file of arrays ("),
    "code": ({"a": npy("__import__('os').abort()")}, "is no npz file of arrays ("),
    "no array": ({"a": b"hello"}, "is no npz file of arrays ("),
    "empty": ({"a": b""}, "is no npz file of arrays ("),
    "long header": ({"a": b"\x93NUMPY\x02\x00\xff\xff\xff\xff"}, "(not of numbers alone), give"),
    "no samples": ({"time": np.zeros(0)}, "holds no samples, give an array per column"),
    "no time": ({"time": None}, "no column 'time' in the header, add 'time [s]'"),
}  # fmt: skip


@pytest.mark.parametrize(("arrays", "message"), BAD.values(), ids=BAD)
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_what_is_no_recording(arrays, message, method, tmp_path):
    path = written(tmp_path, method, **arrays)
    if arrays.get("time", 0) is None:
        path = tmp_path / "run.npz"
        np.savez(path, a=TIME)
    with pytest.raises(RecordingError) as caught:
        read_table(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ") and line.isprintable() and len(line) < 300
    assert message in line


def changed(path, at, value):
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(bytes(data))


def test_encrypted_and_damaged_archives(tmp_path):
    """Bits of the zip format: 1 of the flags is encryption, 99 is no method of compression."""
    for offsets, value, message in [
        ((6, 8), b"\x01\x00", "is encrypted, save the file without a pass"),
        ((8, 10), b"\x63\x00", "compression method is not supported"),
    ]:
        path = written(tmp_path, zipfile.ZIP_DEFLATED, a=TIME)
        data = path.read_bytes()
        changed(path, data.find(b"PK\x03\x04") + offsets[0], value)
        changed(path, data.find(b"PK\x01\x02") + offsets[1], value)
        with pytest.raises(RecordingError, match=message):
            read_table(path)
    path = written(tmp_path, zipfile.ZIP_DEFLATED, a=np.random.default_rng(1).normal(size=5))
    data = path.read_bytes()
    changed(path, data.find(b"NUMPY", 200) - 4, bytes(20))
    with pytest.raises(RecordingError, match="run.npz: .*(is no npz file|is cut short)"):
        read_table(path)
    for length in (0, 30, len(data) // 2, len(data) - 5):
        path.write_bytes(data[:length])
        with pytest.raises(RecordingError, match="is no npz file of arrays"):
            read_table(path)


def test_a_small_file_of_many_numbers(tmp_path, monkeypatch):
    """Zeros take no space in a zip: what they would take in memory is what counts."""
    monkeypatch.setattr(npz, "MAX_NUMBERS", 1000)
    path = written(tmp_path, zipfile.ZIP_DEFLATED, time=np.arange(600.0), a=np.zeros(600))
    with pytest.raises(RecordingError, match="600 samples of 2 columns, give at most 1000 num"):
        read_table(path)
    monkeypatch.setattr(npz, "MAX_COLUMNS", 1)
    with pytest.raises(RecordingError, match="holds 2 arrays, give at most 1"):
        read_table(path)
