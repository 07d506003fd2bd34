"""Logs of other programs read as recordings."""

import functools
from pathlib import Path

import numpy as np
import pytest
from command_line import typed

import crane
from crane.common.errors import CraneWarning, RecordingError
from crane.recordings import table_reader, timeseries
from crane.recordings.logs import read_log
from crane.recordings.recording import Recording

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"
COLUMNS = Path(__file__).parents[1] / "scripts" / "columns"
recorded = pytest.mark.skipif(
    not DATA.is_dir(), reason="the recordings, ../shared/data, are not there"
)

TIME = np.arange(5) * 0.5
MOTORS = np.arange(10.0).reshape(5, 2)
GOOD = """# machine: two_links
# task: a test

time [ms] = 1e3 * t
q1 [deg] = motors[0] / 32 - 90
q2 [rad] = (motors[1] - 2 * motors[0]) / -gear[1] + pi / 2
q1_force [N m] = 'torque 1 (Nm)' * gear[0]
hold [V] = 5.8
"""


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, **{"t": TIME, "motors": MOTORS, "gear": [32, 45], "torque 1 (Nm)": TIME**2})
    return path


def columns(folder, text):
    path = folder / "columns.txt"
    path.write_text(text)
    return path


def test_columns_are_combined_and_converted(log, tmp_path):
    table = read_log(log, columns(tmp_path, GOOD))
    assert table.notes == {"machine": "two_links", "task": "a test"}
    assert table.units == {
        "time": "s", "q1": "rad", "q2": "rad", "q1_force": "N m", "hold": "V",
    }  # fmt: skip
    wanted = [
        TIME,
        np.deg2rad(MOTORS[:, 0] / 32 - 90),
        (2 * MOTORS[:, 0] - MOTORS[:, 1]) / 45 + np.pi / 2,
        32 * TIME**2,
        np.full(5, 5.8),
    ]
    np.testing.assert_allclose(table.values, np.transpose(wanted), rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("between", [",", ";", "\t"])
def test_csv_of_other_programs(tmp_path, between):
    path = tmp_path / "log.csv"
    rows = [["t_s", "s1 (mm)"], ["0", "820.5"], ["0.01", "821.0"]]
    path.write_text("\n".join(between.join(row) for row in rows) + "\n")
    table = read_log(path, columns(tmp_path, "time [s] = t_s\nX [mm] = 's1 (mm)' - 820\n"))
    np.testing.assert_allclose(table.values, [[0, 0.5e-3], [0.01, 1e-3]], rtol=1e-12)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
@pytest.mark.parametrize("between", [";", "\t"])
def test_csv_of_european_programs(tmp_path, between, encoding):
    rows = [["Zeit", "Neigung [°]"], ["0", "-1,5"], ["0,01", "2,5E+1"]]
    text = "# crane samples: 2\n" + "\n".join(between.join(row) for row in rows) + "\n"
    (tmp_path / "log.csv").write_text(text, encoding)
    described = columns(tmp_path, "time [s] = Zeit\nX [deg] = 'Neigung [°]'\n")
    table = read_log(tmp_path / "log.csv", described)
    np.testing.assert_allclose(table.values, [[0, np.deg2rad(-1.5)], [0.01, np.deg2rad(25)]])
    (tmp_path / "log.csv").write_text(text[:-1], encoding)
    with pytest.raises(RecordingError, match="cut short in its last line"):
        read_log(tmp_path / "log.csv", described)


@pytest.mark.parametrize("cell", ["1.234,5", "1,234.5"])
def test_thousands_are_not_taken_for_decimals(tmp_path, cell):
    (tmp_path / "log.csv").write_text(f"t;x\n0;1\n1;{cell}\n")
    described = columns(tmp_path, "time [s] = t\nX [m] = x\n")
    with pytest.raises(RecordingError, match=f"line 3, column 'x': '{cell}' is not a number"):
        read_log(tmp_path / "log.csv", described)


def change(old, new):
    return GOOD.replace(old, new)


BROKEN = {
    "unknown": (change("= 1e3 * t", "= 1e3 * tt"), ":4: the log has no 'tt', known: gear, motors"),
    "a table": (
        change("motors[0] / 32", "motors"),
        ":5: 'motors - 90' has the shape (5, 2), choo",
    ),
    "too far": (
        change("gear[0]", "gear[2]"),
        ":7: 'gear[2]' is not there, give numbers from 0 to",
    ),
    "a list": (change("* gear[0]", "* gear"), ":7: ''torque 1 (Nm)' * gear' cannot be computed"),
    "a call": (change("1e3 * t", "abs(t)"), ":4: 'abs(t)' cannot be computed, combine columns"),
    "an attribute": (change("1e3 * t", "t.real"), ":4: 't.real' cannot be computed"),
    "no expression": (change("= 5.8", ""), ":8: is no column, write 'name [unit] = expression'"),
    "twice": (change("hold [V]", "q1 [deg]"), ":8: column 'q1 [deg]' is there twice, remove one"),
    "unit twice": (change("hold [V]", "q1 [rad]"), "column 'q1' is there twice"),
    "no time": (
        change("time [ms]", "t [s]"),
        "does not say which column of log.npz is 'time', kno",
    ),
    "digits": (change("1e3 * t", "t - 1" + "0" * 400), ":4: 't - 1000"),
    "standing": (
        change("1e3 * t", "0 * t"),
        "'time' is 0.0 at sample 1, give strictly increasing",
    ),
    "infinite": (change("/ 32", "/ 0"), "'q1' is nan at sample 0, give finite numbers"),
    "nothing": ("# machine: x\n", "names no columns, write 'name [unit] = expression'"),
    "deep": (change("1e3 * t", "(" * 400 + "t" + ")" * 400), ":4: '((("),
}


@pytest.mark.parametrize(("text", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_broken_files_of_columns(log, tmp_path, text, message):
    with pytest.raises(RecordingError) as caught:
        read_log(log, columns(tmp_path, text))
    assert message in str(caught.value) and str(caught.value).isprintable()


def test_logs_that_cannot_be_read(log, tmp_path):
    good = columns(tmp_path, "time [s] = t\nq1 [rad] = x\n")
    for path, text, message in (
        ("gone.npz", None, "no such file"),
        ("gone.csv", None, "no such file"),
        ("words.csv", "t,x\n0,up\n", "words.csv: line 2, column 'x': 'up' is not a number"),
        ("empty.csv", "# a: 1\nt;x\n0;1\n1;\n", "line 4, column 'x': '' is not a number, corr"),
        ("short_row.csv", "t;x\n0;1\n1\n", "line 3 has 1 cells, none for 'x'"),
        ("twice.csv", "t,x,x\n0,1,2\n", "'x' heads 2 columns, give the .* one instead, .* '#2'"),
        ("short.csv", "t\n0,1\n", "1 names head 2 columns, name each"),
    ):
        if text is not None:
            (tmp_path / path).write_text(text)
        with pytest.raises(RecordingError, match=message):
            read_log(tmp_path / path, good)
    with pytest.raises(RecordingError, match="no such file or directory, give a file of columns"):
        read_log(log, tmp_path / "gone.txt")
    with pytest.raises(RecordingError, match="/dev/zero: it is no plain file, copy it into one"):
        read_log(log, "/dev/zero")


# as dSPACE ControlDesk writes them: rows of properties, names in two of them, and a label before
DESK = """descriptions,General,User,"me, too"
trace_size,3

trace_names,,In1,In1,duty,
path,,Pressures/rod,Pressures/head,Valve,Valve
min,,-1e308,-1e308,0,0
trace_values,0.5,1.25,2.5,10,up
,0.6,1.5,2.25,20,down
,0.7,1.75,2,30,"up, again"
"""


def test_only_the_columns_in_use_need_names_and_numbers(tmp_path):
    path, text = tmp_path / "desk.csv", (
        "# samples from line: 7\ntime [s] = '#2'\nrod [bar] = 'Pressures/rod'\n"
        "head [bar] = '#4'\nduty = duty / 10\n"
    )  # fmt: skip
    path.write_text(DESK)
    table = read_log(path, columns(tmp_path, text))
    wanted = [[0.5, 1.25e5, 2.5e5, 1], [0.6, 1.5e5, 2.25e5, 2], [0.7, 1.75e5, 2e5, 3]]
    np.testing.assert_allclose(table.values, wanted, rtol=1e-14)
    assert table.notes == {}
    for old, new, message in (
        ("'#4'", "In1", "desk.csv: 'In1' heads 2 columns, give the number of one .* '#3'"),
        ("'#4'", "Valve", "'Valve' heads 2 columns"),
        ("'#4'", "'#6'", "desk.csv: line 7, column '#6': 'up' is not a number"),
        ("'#4'", "'#7'", "columns.txt:4: the log has no '#7'"),
        ("'#4'", "'#0'", "columns.txt:4: the log has no '#0'"),
        ("'#4'", "tail", "columns.txt:4: the log has no 'tail'"),
        ("7", "6", "desk.csv: line 6, column '#2': '' is not a number"),
        ("7", "10", "desk.csv: has 9 lines, samples cannot begin on line 10"),
        ("7", "x", "desk.csv: has 9 lines, samples cannot begin on line x"),
    ):
        with pytest.raises(RecordingError, match=message):
            read_log(path, columns(tmp_path, text.replace(old, new)))


def test_rows_may_end_before_their_header_does_and_with_a_separator(tmp_path):
    path, text = tmp_path / "log.csv", columns(tmp_path, "time [s] = t\nq1 [rad] = x\n")
    path.write_text("t,x,note\n0,1\n1,3\n")  # the logger did not write the last column
    with pytest.warns(CraneWarning, match="log.csv: 3 names head 2 columns, 'note' is"):
        short = read_log(path, text)
    path.write_text("t,x\n0,1,\n1,3,\n")
    for table in (short, read_log(path, text)):
        np.testing.assert_array_equal(table.values, [[0, 1], [1, 3]])


def test_command_line(log, tmp_path):
    run = functools.partial(typed, "import")

    given = log, "--columns", columns(tmp_path, GOOD), "--out", tmp_path / "run.csv"
    done = run(*given)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"5 samples of 5 columns written to {tmp_path / 'run.csv'}\n"
    found = Recording.read(tmp_path / "run.csv")
    assert found.joints == ("q1",) and found.machine == "two_links"
    np.testing.assert_array_equal(found.tau[:, 0], 32 * TIME**2)
    again = run(*given)
    assert again.returncode == 2 and "exists already" in again.stderr
    assert "give a file with a line per column" in run(log, *given[3:]).stderr
    assert "name it so" in run(*given[:-1], tmp_path / "run.npz").stderr


PATU = """# machine: patu655
time [s] = t
X_lift [m] = motors[0] / 100
q2 [rad] = motors[1] / 100
pressure_X_lift_a [bar] = 100
reference_q2 [rad] = 0
pressure_X_grip_a [bar] = 50
pressure_pump [bar] = 200
X_9 [m] = 0
"""


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("X_lfit", "X_lift"), ("x_lift", "X_lift"), ("Xlift", "X_lift"), ("X_liftt", "X_lift"),
        ("X_lift_velocty", "X_lift_velocity"), ("X_lift_forces", "X_lift_force"),
        ("presure_X_lift_b", "pressure_X_lift_b"), ("pressure_X_lif_b", "pressure_X_lift_b"),
        ("voltage_X_titl", "voltage_X_tilt"), ("inclination_lift_bom", "inclination_lift_boom"),
        ("Q3", "q3"), ("pressure_suply", "pressure_supply"),
    ],
)  # fmt: skip
def test_a_misspelt_quantity_is_refused_where_the_machine_is_named(log, tmp_path, written, meant):
    described = columns(tmp_path, f"{PATU}{written} = t\n")
    done = typed("import", log, "--columns", described, "--out", tmp_path / "run.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        f"error: {described}: '{written}' is no quantity of 'patu655', did you mean '{meant}'? "
        "If it is a channel of its own, give it another name\n"
    )
    assert not (tmp_path / "run.csv").exists()
    with pytest.raises(RecordingError, match=f"did you mean '{meant}'"):
        crane.recordings.read_measured(crane.load("patu655"), log, columns=described)


def test_channels_of_their_own_are_kept(log, tmp_path):
    """What differs by more than a slip, by a number, or is a node of the circuit."""
    machine = crane.load("patu655")
    nodes = [f"pressure_{x.replace('.', '_')}" for x in machine.hydraulics.node_names]
    own = [name for name in nodes if name not in PATU]
    text = PATU + "".join(f"{name} [bar] = 1\n" for name in own)
    done = typed(
        "import", log, "--columns", columns(tmp_path, text), "--out", tmp_path / "run.csv"
    )
    assert (done.returncode, done.stderr) == (0, "")
    units = table_reader.read_table(tmp_path / "run.csv").units
    assert {"pressure_X_grip_a", "pressure_pump", "X_9", *own} < set(units)


def test_names_are_not_checked_where_the_machine_is_not_found(log, tmp_path):
    done = typed(
        "import", log, "--columns", columns(tmp_path, GOOD), "--out", tmp_path / "run.csv"
    )
    assert done.returncode == 0
    assert (
        done.stderr.startswith("warning: ") and "names of columns are not checked" in done.stderr
    )


@recorded
def test_the_measured_arms_come_as_their_owners_wrote_them():
    """Against the conversion written out in numpy; limits of the machines hold."""
    table = read_log(DATA / "kr300" / "kr300_A.npz", COLUMNS / "kr300.txt")
    with np.load(DATA / "kr300" / "kr300_A.npz") as file:
        q = np.deg2rad(file["motor_position_deg"] + [0, -90, 90, 0, 0, 0])
        tau = file["motor_torque"] * file["gear_ratio"]
    np.testing.assert_allclose(table.values[:, 1:7], q, atol=1e-12)
    np.testing.assert_allclose(table.values[:, 7:], tau, rtol=1e-14)
    crane.load("kr300").check_limits(table.values[:, 1:7])

    table = read_log(DATA / "tx40" / "tx40_recording.npz", COLUMNS / "tx40.txt")
    ratio = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    ratio[5, 4] = 32.0
    with np.load(DATA / "tx40" / "tx40_recording.npz") as file:
        q = np.linalg.solve(ratio, file["motor_position"].T).T
        tau = file["motor_torque"] @ ratio
    zero = [0, -np.pi / 2, np.pi / 2, 0, 0, 0]
    np.testing.assert_allclose(table.values[:, 1:7], q + zero, atol=1e-12)
    np.testing.assert_allclose(table.values[:, 7:], tau, rtol=1e-12, atol=1e-12)

    table = read_log(DATA / "patu655" / "lifting_first_half.csv", COLUMNS / "patu655.txt")
    assert timeseries.accepted_units("m")[0] == table.units["X_lift"]
    assert table.values[0, 1] == pytest.approx(0.942197 - 0.820)
