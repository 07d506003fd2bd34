"""Time series as CSV and npz files: reading, writing and errors."""

import io
import math
import os
import struct
import zipfile

import numpy as np
import pytest

from crane.common.errors import RecordingError
from crane.recordings import npz, table_reader
from crane.recordings.table_reader import read_csv, read_log_arrays, read_npz, read_table
from crane.recordings.timeseries import Table, accepted_units, write_table

GOOD = "time [s],a [m],b\n0,1,2\n0.5,3,4\n"


def read_text(tmp_path, text, **kwargs):
    path = tmp_path / "table.csv"
    path.write_text(text, **kwargs)
    return read_table(path)


@pytest.mark.parametrize(
    "text",
    [
        GOOD.replace("\n", "\r\n"),
        GOOD + "\n\n",
        "\n" + GOOD,
        GOOD.replace(",", " , "),
        '"time [s]","a [m]","b"\n0,1,2\n0.5,3,4\n',
        "\ufeff" + GOOD,
        GOOD.rstrip("\n"),
    ],
    ids=["crlf", "blank end", "blank start", "blanks", "quotes", "byte order mark", "no newline"],
)
def test_other_ways_to_write_the_same(tmp_path, text):
    table = read_text(tmp_path, text, encoding="utf-8", newline="")
    assert table.units == {"time": "s", "a": "m", "b": ""}
    np.testing.assert_array_equal(table.values, [[0, 1, 2], [0.5, 3, 4]])


def test_notes_keep_what_follows_the_first_colon(tmp_path):
    notes = read_text(tmp_path, "# machine: C:\\cranes\\big.yaml\n#task:lift\n" + GOOD).notes
    assert notes == {"machine": "C:\\cranes\\big.yaml", "task": "lift"}


@pytest.mark.parametrize(
    "read",
    [read_table, lambda path: read_log_arrays(path, ["time [s]", "a [m]", "b"])],
    ids=["as recording", "as log"],
)
def test_a_file_that_is_cut_short_anywhere_is_told(tmp_path, read):
    path, whole = tmp_path / "cut.csv", tmp_path / "whole.csv"
    values = np.array([[0.0, 1.25, -3e-5], [0.5, 1.5, 22.75]])
    write_table(whole, Table({"time": "s", "a": "m", "b": ""}, values, {"machine": "x"}))
    data = whole.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(RecordingError):
            read(path)
    path.write_bytes(data[:-2])
    with pytest.raises(RecordingError, match=r"cut.csv: is cut short in its last line, copy it"):
        read(path)
    path.write_bytes(data[: data.rindex(b"0.5")])
    with pytest.raises(
        RecordingError, match=r"cut.csv: has 1 of the 2 samples that it says, copy"
    ):
        read(path)
    path.write_bytes(data.replace(b"# crane samples: 2\n", b"")[:-2])
    assert read(path) is not None  # whoever removes the count has said so


# What is written, and the line that the user sees after the name of the file.
BROKEN = {
    "empty": ("", "is empty, write a header row and one row per sample"),
    "comments only": ("# machine: x\n\n", "is empty, write a header row"),
    "no header": ("0,1,2\n", "has no header, name the columns in the first row"),
    "no samples": ("time [s],a [m]\n\n", "has a header and no samples, write one row per sample"),
    "no time": ("t [s],a [m]\n0,1\n", "no column 'time' in the header, add 'time [s]'"),
    "semicolons": ("time [s];a [m]\n0;1\n", "separates columns by ';', use commas"),
    "tabs": ("time [s]\ta [m]\n0\t1\n", r"separates columns by '\t', use commas"),
    "time without unit": ("time,a\n0,1\n", "column 'time' has no unit, give 'time [s]' or"),
    "days": ("time [d],a\n0,1\n", "column 'time' is in [d], give 'time [s]' or 'time [ms]'"),
    "milliseconds stand": ("time [ms],a\n5,1\n5,1\n", "time goes from 5.0 to 5.0 ms, give"),
    "twice": ("time [s],a [m],a [m]\n0,1,1\n", "column 'a' is there twice, rename or remove one"),
    "nameless": ("time [s],,b\n0,1,2\n", "column 2 is headed '', write 'name [unit]'"),
    "brackets": ("time [s],a [m\n0,1\n", "column 2 is headed 'a [m', write 'name [unit]'"),
    "comma in a name": ('time [s],"a,b"\n0,1\n', "'a,b' cannot be the name of a column"),
    "short row": (GOOD + "1,2\n", "line 4 has 2 cells, give 3 as in the header"),
    "long row": (GOOD + "1,2,3,\n", "line 4 has 4 cells, give 3 as in the header"),
    "all rows short": ("time [s],a,b\n0,1\n1,2\n", "line 2 has 2 cells, give 3"),
    "text": ("# x\n" + GOOD + "1,two,3\n", "line 5, column 'a': 'two' is not a finite number"),
    "blank cell": (GOOD + "1,,3\n", "line 4, column 'a': '' is not a finite number"),
    "underscore": (GOOD + "1,2_0,3\n", "line 4, column 'a': '2_0' is not a finite number"),
    "nan": (GOOD + "\n1,2,nan\n", "line 5, column 'b': 'nan' is not a finite number"),
    "infinite": (GOOD + "1,-inf,3\n", "line 4, column 'a': '-inf' is not a finite number"),
    "too large": (GOOD + "1,1e999,3\n", "line 4, column 'a': '1e999' is not a finite number"),
    "time stands": (GOOD + "0.5,5,6\n", "line 4: time goes from 0.5 to 0.5 s, give strictly"),
    "time goes back": (GOOD + "\n0.25,5,6\n", "line 5: time goes from 0.5 to 0.25 s, give"),
}


@pytest.mark.parametrize(("text", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_broken_files(tmp_path, text, message):
    with pytest.raises(RecordingError) as caught:
        read_text(tmp_path, text)
    line = str(caught.value)
    assert line.startswith(f"{tmp_path / 'table.csv'}: ")
    assert message in line
    assert "\n" not in line


def test_missing_file(tmp_path):
    with pytest.raises(RecordingError, match="no such file or directory, give the path of a CSV"):
        read_table(tmp_path / "none.csv")
    with pytest.raises(RecordingError, match="no such file, a recording is a .csv or .npz file"):
        read_table(tmp_path / "none.txt")


def test_folder(tmp_path):
    with pytest.raises(RecordingError, match="is a directory, give the path of a CSV file"):
        read_csv(tmp_path)


@pytest.mark.parametrize("rows", [b"", b"time [s],a\n0,1\n"], ids=["at once", "below the header"])
def test_binary_file(tmp_path, rows):
    path = tmp_path / "table.csv"
    path.write_bytes(rows + b"\x1f\x8b\xff\xfe\x00\n")
    with pytest.raises(RecordingError, match="is not text, give a file in UTF-8"):
        read_table(path)


# what a file may declare, the SI unit, and a number with what it is in SI units
CONVERTED = [
    ("bar", "Pa", 123.4, 123.4e5), ("kPa", "Pa", 101.325, 101325.0), ("MPa", "Pa", 0.7, 0.7e6),
    ("deg", "rad", 30.0, math.pi / 6), ("deg/s", "rad/s", -180.0, -math.pi),
    ("mm", "m", 12.3, 0.0123), ("cm", "m", 4.1, 0.041), ("mm/s", "m/s", 14.1, 0.0141),
    ("cm/s", "m/s", 1.41, 0.0141), ("kN", "N", 31.7, 31700.0), ("kN m", "N m", 8.5, 8500.0),
    ("l/min", "m3/s", 60.0, 1e-3), ("mV", "V", 5800.0, 5.8), ("ms", "s", 40.0, 0.04),
]  # fmt: skip


@pytest.mark.parametrize(("unit", "si", "number", "converted"), CONVERTED)
def test_declared_units_become_si(tmp_path, unit, si, number, converted):
    csv = read_text(tmp_path, f"time [s],a [{unit}],b\n0,{number},{number}\n")
    np.savez(tmp_path / "table.npz", **{"time [s]": [0.0], f"a [{unit}]": [number], "b": [number]})
    for table in (csv, read_npz(tmp_path / "table.npz")):
        assert table.units == {"time": "s", "a": si, "b": ""}
        assert table.values[0, 1] == pytest.approx(converted, rel=3e-16, abs=0)
        assert table.values[0, 2] == number
    assert unit in accepted_units(si)


def test_other_units_stay(tmp_path):
    table = read_text(tmp_path, "time [s],a [degC],b [Pa],c [Bar],d [1/s]\n0,20,1,2,3\n")
    assert table.units == {"time": "s", "a": "degC", "b": "Pa", "c": "Bar", "d": "1/s"}
    np.testing.assert_array_equal(table.values, [[0, 20, 1, 2, 3]])


LONG = {  # bytes, and what is told
    "heading": (b"time [s]," + b"a" * (1 << 17), "line 1, the header row, has 131081 characters"),
    "name": (
        b"time [s]," + b"a" * 300 + b"\n0,1\n",
        "...', write 'name [unit]', at most 200 characters",
    ),
    "blanks": (b"time [s]," + b" " * 60_000 + b"]\n0,1\n", "column 2 is headed ']', write"),
    "columns": (b"time [s]" + b",a" * 5000 + b"\n", "has 5001 columns, give at most 4096"),
    "line": (GOOD.encode() + b"1" * (3 << 20), "line 4 has more than 1048576 bytes, write one"),
    "lines of zeros": (b"\0" * (3 << 20), "line 1 has more than 1048576 bytes"),
    "notes": (b"# note\n" * 200_000, "has no header row within 1048576 characters"),
    "cell": (GOOD.encode() + b"1,2," + b"x" * 90_000, "'" + "x" * 60 + "...' is not a finite"),
}


@pytest.mark.parametrize(("data", "message"), LONG.values(), ids=LONG)
def test_long_lines(tmp_path, data, message):
    path = tmp_path / "table.csv"
    path.write_bytes(data)
    with pytest.raises(RecordingError) as caught:
        read_table(path)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("end", ["\n", "\r", "\r\n"])
def test_lines_across_blocks_are_counted(tmp_path, monkeypatch, end):
    """Whatever the size of the blocks that are looked at, and however lines end."""
    (tmp_path / "table.csv").write_text(GOOD.replace("\n", end), newline="")
    for size in range(16, 40):  # the header row has 16 characters
        monkeypatch.setattr("crane.recordings.table_reader._BLOCK_BYTES", size)
        assert table_reader._count_lines(tmp_path / "table.csv") in (3, 4)
    monkeypatch.setattr("crane.recordings.table_reader._BLOCK_BYTES", 15)
    with pytest.raises(RecordingError, match="line 1 has more than 15 bytes"):
        table_reader._count_lines(tmp_path / "table.csv")


def test_more_numbers_than_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("crane.recordings.table_reader.MAX_NUMBERS", 8)
    with pytest.raises(RecordingError, match="holds 3 lines of 3 columns, give at most 8 numbers"):
        read_text(tmp_path, GOOD + "1,2,3\n")
    assert len(read_text(tmp_path, GOOD).values) == 2


def test_numbers_beyond_all_that_is_measured(tmp_path):
    """Pages keep float32, and what is computed squares them."""
    with pytest.raises(RecordingError, match="table.csv: 'b' is 1e\\+308 at sample 2, beyond all"):
        read_text(tmp_path, GOOD + "1,2,1e308\n")
    np.savez(tmp_path / "table.npz", **{"time [s]": [0.0, 1.0], "a [bar]": [1e30, 1e20]})
    with pytest.raises(RecordingError, match="table.npz: 'a' is 1e\\+35 at sample 0, beyond all"):
        read_table(tmp_path / "table.npz")


def test_a_pipe_is_no_file(tmp_path):
    """A named pipe is refused, since reading it would block."""
    for name in ("table.csv", "table.npz"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(RecordingError, match="is no plain file, copy it into one"):
            read_table(tmp_path / name)


@pytest.mark.parametrize("count", [1, 3, 5000])
def test_columns_that_stay_the_same_are_written_like_others(tmp_path, count):
    """To the sign of a zero, and where they change between blocks of rows."""
    same = [0.0, -0.0, 0.1, 1e-300, np.nan, np.pi, 0.0]
    rows = np.tile(same, (count, 1))
    rows[count // 2 :, -1] = -0.0
    names = [f"c{i}" for i in range(len(same))]
    write_table(tmp_path / "a.csv", Table(dict.fromkeys(names, ""), rows, {}))
    lines = (tmp_path / "a.csv").read_text().splitlines()
    body = lines[lines.index(",".join(names)) + 1 :]
    assert body == [",".join("" if x != x else repr(x) for x in row) for row in rows.tolist()]


# --- npz ----------------------------------------------------------------------------------------


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
