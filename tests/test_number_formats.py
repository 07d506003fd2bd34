"""Numbers in options, in output, and in lines of tables."""

import re

import numpy as np
import pytest
from command_line import typed

import crane
from crane.cli.parsing import parse_changes
from crane.common.errors import (
    CraneError,
    InputError,
    RecordingError,
    format_one_line,
    prefix_location,
)
from crane.common.samples import (
    MAX_COORDINATE,
    MAX_QUANTITY,
    MIN_QUANTITY,
    as_count,
    as_number,
    as_seed,
)
from crane.common.units import display_unit, format_number, format_quantity
from crane.description.estimation_settings import ParameterPrior
from crane.recordings.logs import read_log
from crane.recordings.recording_summary import recorded_machine_name, result_title
from crane.recordings.table_reader import read_csv
from crane.studies.optimization.measure_expressions import MeasureExpression
from crane.studies.variant_study import StudyJob, measure_variant


@pytest.mark.parametrize(
    ("value", "above", "told"),
    [
        (np.nan, -np.inf, "the size is nan m, give a number"),
        (np.inf, -np.inf, "the size is inf m, give a number"),
        ("2", -np.inf, "the size is not made of real numbers, give a number"),
        ([1.0], -np.inf, "the size is [1.0] m, give a number"),
        (0.0, 0, "the size is 0.0 m, give a number above 0"),
        (1e308, -np.inf, "the size is 1e+308 m, give a number from -1e+30 to 1e+30"),
        (-1e300, -np.inf, "the size is -1e+300 m, give a number from -1e+30 to 1e+30"),
        (1e31, 0, "the size is 1e+31 m, give a number from 1e-30 to 1e+30"),
        (1e-320, 0, "the size is 1e-320 m, give a number from 1e-30 to 1e+30"),
        (1e31, 3.0, "the size is 1e+31 m, give a number from 3 to 1e+30"),
    ],
)
def test_numbers_that_no_machine_has(value, above, told):
    with pytest.raises(InputError) as caught:
        as_number(value, "the size", "m", above)
    assert str(caught.value) == told


def test_numbers_within_bounds_are_kept():
    for value in (0.0, -MAX_QUANTITY, MAX_QUANTITY, MIN_QUANTITY, 1e-300):
        assert as_number(value, "x", "") == value
    assert as_number(MIN_QUANTITY, "x", "", greater_than=0) == MIN_QUANTITY
    assert np.isfinite(MAX_QUANTITY**2) and MIN_QUANTITY**2 > 0
    assert as_count(np.int64(3), "n") == 3 and as_seed(0) == 0


@pytest.mark.parametrize("value", [0, -1, 2**63, 1.0, np.nan, "3"])
def test_counts(value):
    with pytest.raises(InputError, match=f"the count is {value}, give a whole number from 1 to 9"):
        as_count(value, "the count", 1, 9)


ODD_NUMBERS = ["1_000", "\N{ARABIC-INDIC DIGIT THREE}", "1.\N{FULLWIDTH DIGIT FIVE}", "1e1_0"]


@pytest.mark.parametrize("text", ODD_NUMBERS)
def test_a_number_is_the_same_in_every_file_and_option(slider_crank, tmp_path, text):
    """All of them are numbers to Python, and none to a program that reads tables."""
    assert float(text) > 0
    urdf = slider_crank.chains[0].urdf.read_text()
    (tmp_path / "odd.urdf").write_text(re.sub('mass value="[^"]*"', f'mass value="{text}"', urdf))
    with pytest.raises(CraneError, match="is not a number, write digits"):
        crane.load(tmp_path / "odd.urdf")
    with pytest.raises(InputError, match="says no standard deviation|no known unit"):
        ParameterPrior.parse(text)
    (tmp_path / "odd.csv").write_text(f"time [s],q [m]\n0,1\n1,{text}\n")
    with pytest.raises(RecordingError, match="line 3, column 'q': .* is not a finite number"):
        read_csv(tmp_path / "odd.csv")
    with pytest.raises(InputError, match="is no expression|is not a number, write such as"):
        MeasureExpression(f"2 * mass + {text}")
    (tmp_path / "plain.csv").write_text("t,q\n0,1\n1,2\n")
    (tmp_path / "columns.txt").write_text(f"time [s] = t\nq [m] = q + {text}\n")
    with pytest.raises(RecordingError, match=r"columns.txt:2: .* cannot be computed"):
        read_log(tmp_path / "plain.csv", tmp_path / "columns.txt")
    path = slider_crank.path
    for words in (
        ["simulate", path, "--step", text],
        ["study", path, "--vary", "x=1~2", "--draws", text],
    ):
        done = typed(*words, "--out", tmp_path / "out")
        assert done.returncode == 2 and f"Invalid value for '{words[-2]}': {text!r}" in done.stderr
    done = typed("live", path, "--port", "65536")
    assert done.returncode == 2 and "65536 is not in the range 0 to 65535." in done.stderr


def test_joints_by_name():
    assert parse_changes("--lock", ["a=1", "b=-2e3", "a=b=0"]) == {"a": 1, "b": -2e3, "a=b": 0}
    for words, told in (
        (["a"], "--lock is 'a', write JOINT=VALUE"),
        (["=1"], "--lock is '=1', write"),
        (["a=1", "a=2"], "--lock names 'a' twice, give it once"),
        (["a=1e309"], "--lock a is inf, give a number"),
        (["a=nan"], "--lock a is nan, give a number"),
        (["a=1e308"], "--lock a is 1e.308, give a number from"),
    ):
        with pytest.raises(InputError, match=told):
            parse_changes("--lock", words)


@pytest.mark.parametrize("joint", ["s", "theta", "phi"])
@pytest.mark.parametrize("value", [1e308, -1e308, 2 * MAX_COORDINATE])
def test_locks_far_from_anything(slider_crank, joint, value):
    with pytest.raises(InputError, match=rf"lock '{joint}' at is .* m or rad, give a number from"):
        crane.load(slider_crank.path, lock={joint: value})


def test_work_beyond_all_bounds_is_refused_before_it_begins(slider_crank):
    for call, told in (
        (lambda: crane.study(slider_crank.path, {"crank.mass": [1.0]}, processes=2**31),
         "the number of processes is 2147483648, give a whole number from 1 to"),
        (lambda: crane.study(slider_crank.path, {"crank.mass": [1, 2]}, draws=2**31),
         "the number of variants is 2147483648, give a whole number from 1 to 100000"),
        (lambda: crane.workspace(slider_crank, 2**31), "from 100 to 1000000"),
        (lambda: crane.workspace(slider_crank, 100, seed=-1), "the seed is -1, give a whole"),
        (lambda: crane.simulate(slider_crank, duration=1e308), "duration is 1e.308 s, give"),
        (lambda: crane.simulate(slider_crank, duration=1.0, step=1e-300), "step is 1e-300 s"),
        (lambda: crane.simulate(slider_crank, duration=1.0, step=1e-9), "steps of 1e-09 s, at"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=told):
            call()


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (13360.4, "kg", "13.36 t"),
        (1336.4, "kg", "1336 kg"),
        (1.2871, "kg", "1.287 kg"),
        (28034.0, "N", "28.03 kN"),
        (-999.4, "N", "-999.4 N"),
        (50.0, "N", "50 N"),
        (3.5e7, "Pa", "350 bar"),
        (2.0e-3, "m3/s", "120 l/min"),
        (123456.7, "N m", "123.5 kN m"),
        (1234567.0, "V", "1234567 V"),
        (3.2e-5, "V", "0.000032 V"),
        (-1e-18, "N", "0 N"),
    ],
)
def test_quantities_are_read_without_exponents(value, unit, text):
    assert format_quantity(value, unit, 4) == text


def test_units_are_chosen_by_the_peak():
    assert display_unit("N", -2e3) == ("kN", 1e-3) and display_unit("N", 900.0) == ("N", 1.0)
    assert display_unit("m", 0.3) == ("mm", 1e3) and display_unit("V", 5.0) == ("V", 1.0)
    assert (
        format_number(2.0) == "2" and format_number(0.0) == "0" and format_number(100.0) == "100"
    )


def test_lines_can_be_read():
    assert format_one_line("a\nb\x1b[31m\udcff") == "a b [31m\\udcff"
    assert len(format_one_line("x" * 100_000)) < 1000
    assert len(str(CraneError("x y " * 100_000))) < 4000
    assert format_one_line("short and " + "y" * 900) == "short and " + "y" * 900


def test_a_place_is_told_once():
    assert (
        prefix_location("run.csv", RecordingError("line 3: no number"))
        == "run.csv: line 3: no number"
    )
    assert prefix_location("run.csv", RecordingError("run.csv: is empty")) == "run.csv: is empty"


def test_a_task_that_fails_in_a_study_is_named_once():
    """The row gives the reason once."""
    found, reason = measure_variant(
        StudyJob("patu655", {"X_lift.upper": 0.2}, {}, ("reach",), False)
    )
    assert not found and reason.count("task 'reach'") == 1 and "X_lift" in reason


def test_titles():
    run = crane.Recording([0.0], ("q",), [[0.0]], [[0.0]], [[0.0]], {"q": "rad"})
    assert (
        result_title("patu655", "swing") == "patu655: swing"
        and result_title("patu655") == "patu655"
    )
    assert recorded_machine_name(run) == ""
    for machine, name in (
        ("patu655", "patu655"),
        ('patu655 with {"changes": {"payload.mass": 200.5}, "lock": {"slew": 0.0}}', "patu655"),
        ("/data/machines/log_crane.yaml", "log_crane"),
    ):
        named = crane.Recording(
            [0.0], ("q",), [[0.0]], [[0.0]], [[0.0]], {"q": "rad"}, machine=machine
        )
        assert recorded_machine_name(named) == name
