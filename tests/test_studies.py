"""Design studies: measures are correct and independent of the process that computes them."""

import os
import signal
import subprocess
import sys
import warnings
from contextlib import contextmanager

import numpy as np
import pytest

import crane
from crane.cli.parsing import parse_grids, parse_ranges
from crane.common.errors import ClosureError, InputError
from crane.studies import measures
from crane.studies.measures import measure_strokes
from crane.view.result_files import plot_result

pytestmark = [pytest.mark.filterwarnings("ignore::crane.CraneWarning"), pytest.mark.slow]
UNITS = lambda name: ("m",)  # noqa: E731 - of any parameter
PIN = {"link3_G.x": np.linspace(0.08, 0.11, 4), "link3_G.y": [-0.01, 0.0]}


def text_of(study, tmp_path):
    study.to_csv(tmp_path / "study.csv")
    return (tmp_path / "study.csv").read_bytes()


@pytest.fixture(scope="module")
def pins():
    return crane.study("mini_forwarder", PIN)


def test_measures_are_those_of_the_inverse_dynamics(mini):
    found = crane.study("mini_forwarder", {"payload.mass": [0.0, 0.1]}, ["lift"])
    for row, mass in zip(found.rows, (0.0, 0.1), strict=True):
        machine = mini.with_payload(crane.Payload(mini.tip, mass)) if mass else mini
        time = np.linspace(0, 10, 20001)
        q_a, v_a, a_a = crane.task_trajectory(machine, "lift")(time)
        tau = crane.Dynamics(machine).inverse(q_a, v_a, a_a, friction=True)
        power = tau * v_a
        assert row["peak_X2"] == pytest.approx(np.abs(tau[:, 2]).max(), rel=1e-5)
        square = np.trapezoid(tau[:, 1] ** 2, time) / 10
        assert row["rms_X1"] == pytest.approx(np.sqrt(square), rel=1e-6)
        assert row["work"] == pytest.approx(np.trapezoid(power.sum(axis=1), time), rel=1e-5)
        supplied = np.trapezoid(np.maximum(power, 0).sum(axis=1), time)
        assert row["energy"] == pytest.approx(supplied, rel=1e-4)
        assert row["energy"] >= row["work"] and row["reason"] == ""


def test_lifting_a_payload_takes_its_potential_energy(mini):
    """Work of two payloads differs by m g h, ends being slow: both move 3 mm/s vertically more."""
    light, heavy = crane.study(
        "mini_forwarder", {"payload.mass": [0.0, 0.2]}, ["lift"], ["work"]
    ).columns["work"]
    assert heavy - light == pytest.approx(0.2 * 9.81 * 0.1923, rel=1e-3)


def test_tasks_together(pins):
    rows = [row for row in pins.rows if not row["reason"]]
    assert rows
    for row in rows:
        tasks = [row[f"peak_X2 {task}"] for task in pins.tasks]
        assert row["peak_X2"] == max(tasks)
        squares = [row[f"rms_X1 {task}"] ** 2 for task in pins.tasks]
        assert row["rms_X1"] == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-12)
        assert row["energy"] == pytest.approx(sum(row[f"energy {task}"] for task in pins.tasks))
    best = pins.best_row("peak_X2")
    assert best["peak_X2"] == min(row["peak_X2"] for row in rows)
    assert pins.best_row("reach")["reach"] == np.nanmax(pins.columns["reach"])


def test_a_variant_that_cannot_is_a_row_with_its_reason(pins):
    unable = [row for row in pins.rows if row["reason"]]
    assert unable and all(np.isnan(row["peak_X2"]) for row in unable)
    assert all("cannot reach" in row["reason"] for row in unable)
    study = crane.study("mini_forwarder", {"link7.mass": [-1.0, 0.1]}, ["lift"], ["peak_X1"])
    assert study.failure_reasons == (
        "parameter 'link7.mass' is -1 kg, it must not be negative",
        "",
    )


def test_strokes_where_the_loops_close(monkeypatch):
    """Every cell equals the result of closing that variant alone."""
    monkeypatch.setattr(measures, "_COUPLED_GRID_SIZE", 125)
    machine = crane.load("mini_forwarder", {"link3_G.x": 0.11, "link3_G.y": -0.01})
    found = measure_strokes(machine)
    cells, closed = np.linspace(0, 0.03, 11), []
    for x1 in cells:
        for x2 in cells:
            try:
                machine.closure.solve([0.0, x1, x2])
                closed.append((x1, x2))
            except ClosureError:
                pass
    assert found["range"] == len(closed) / 121 < 0.7
    # the true ends lie up to a cell farther, see test_reach
    assert 0 < min(x2 for _, x2 in closed) - found["lower_X2"] < 0.003
    assert found["upper_X1"] == pytest.approx(max(x1 for x1, _ in closed))
    tip = crane.Kinematics(machine)
    coarse = max(np.hypot(*tip.position([0.0, *x])[:2]) for x in closed)
    assert coarse <= found["reach"] < coarse + 0.005


def test_an_open_arm_has_strokes_too():
    found = measure_strokes(crane.load("ur5_robot"))
    assert found["range"] == 1.0 and found["upper_elbow_joint"] > 3


@pytest.mark.slow
def test_rows_do_not_depend_on_what_was_computed_before(pins, tmp_path):
    """Rows are bitwise equal when computed alone, in another order, or in two processes."""
    backwards = crane.study("mini_forwarder", {k: v[::-1] for k, v in PIN.items()})
    for one, two in zip(pins.rows, reversed(backwards.rows), strict=True):
        assert str(one) == str(two)
    apart = crane.study("mini_forwarder", PIN, processes=2)
    assert text_of(apart, tmp_path) == text_of(pins, tmp_path)


def test_a_machine_is_varied_as_it_was_loaded():
    given = {"tasks": ["lift"], "measures": ["peak_X1"]}
    loaded = crane.load("mini_forwarder", {"link7.mass": 0.3})
    found = crane.study(loaded, {"payload.mass": [0.0, 0.1]}, **given)
    both = {"payload.mass": [0.0, 0.1], "link7.mass": [0.3]}
    wanted = crane.study("mini_forwarder", both, **given)
    plain = crane.study("mini_forwarder", {"payload.mass": [0.0, 0.1]}, **given)
    np.testing.assert_array_equal(found.columns["peak_X1"], wanted.columns["peak_X1"])
    assert (found.columns["peak_X1"] != plain.columns["peak_X1"]).all()
    with pytest.raises(InputError, match="is not what its files describe"):
        crane.study(loaded.replace(friction={}), {"payload.mass": [0.0]}, **given)


def test_draws_come_from_their_seed():
    vary = {"payload.mass": (0.0, 0.2), "link7.mass": (0.1, 0.2)}
    one, two, other = (
        crane.study("mini_forwarder", vary, ["lift"], ["peak_X1"], draws=5, seed=seed)
        for seed in (1, 1, 2)
    )
    assert np.array_equal(one.columns["peak_X1"], two.columns["peak_X1"])
    assert not np.array_equal(one.columns["payload.mass"], other.columns["payload.mass"])
    assert 0 <= one.columns["payload.mass"].min() <= one.columns["payload.mass"].max() <= 0.2


def test_table_and_picture(pins, tmp_path):
    lines = text_of(pins, tmp_path).decode().splitlines()
    assert lines[0] == "# machine: mini_forwarder" and len(lines) == 4 + len(pins)
    assert lines[1] == "# note: forces are taken every 5 ms of a task"
    assert lines[2] == "# note: range is counted on 31 values of each of 2 strokes"
    assert lines[3].startswith("link3_G.x [m],link3_G.y [m],peak_q1 [N m],")
    assert "* " in pins.to_text() and "cannot be measured" in pins.to_text()
    plot_result(pins, tmp_path / "map.png")
    for vary, draws in (
        ({"payload.mass": [0.0, 0.1, 0.2]}, None),
        ({"payload.mass": (0.0, 0.2), "link7.mass": (0.1, 0.2)}, 4),
    ):
        study = crane.study("mini_forwarder", vary, ["lift"], ["peak_X1"], draws=draws)
        plot_result(study, tmp_path / f"{len(vary)}.svg")
    assert len(list(tmp_path.glob("*.svg"))) == 2


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"vary": {}}, "nothing varies"),
        ({"vary": {"link3G.x": [1.0]}}, "'link3G.x' is unknown, did you mean 'link3_G.x'?"),
        ({"vary": {"control.X1.kp": [1.0]}}, "'control.X1.kp' changes nothing"),
        ({"vary": {"payload.mass": []}}, "has no list of values"),
        ({"vary": {"payload.mass": [np.nan]}}, "is nan"),
        ({"vary": {"payload.mass": [0, 1, 2]}, "draws": 3}, "is drawn between two values"),
        ({"vary": {"payload.mass": [0, 1]}, "draws": 0}, "the number of variants is 0, give"),
        ({"vary": {"payload.mass": [0]}, "tasks": ["lft"]}, "did you mean 'lift'?"),
        ({"vary": {"payload.mass": [0]}, "measures": ["peak_X"]}, "did you mean 'peak_X"),
        ({"vary": {"payload.mass": [-1.0]}}, "none of 1 variants can be measured"),
        ({"vary": {"payload.mass": (0, 1)}, "draws": 2, "seed": -1}, "the seed is -1"),
        ({"vary": {"payload.mass": [0]}, "processes": 0}, "the number of processes is 0"),
    ],
)
def test_what_cannot_be_studied(arguments, text):
    with pytest.raises(InputError) as caught:
        crane.study("mini_forwarder", **arguments)
    assert text in str(caught.value)


@pytest.mark.parametrize("name", ["supply.pressure", "oil.bulk_modulus", "valve.slew.dead_band"])
def test_hydraulics_change_no_forces_of_a_given_motion(name):
    with pytest.raises(InputError, match=f"'{name}' changes nothing"):
        crane.study("patu655", {name: [0.1, 0.2]}, ["swing"])


@pytest.mark.parametrize(
    ("text", "draws", "message"),
    [
        ("x", None, "write NAME=start:stop:count"),
        ("x=1:2", None, "'1:2' is no grid"),
        ("x=1:b:3", None, "'1:b' are no numbers"),
        ("x=1:2:0", None, "'0' is no count"),
        ("x=1:2:1", None, "one value cannot be both ends"),
        ("x=1~2", None, "say how often with --draws"),
        ("x=1:2:3", 5, "give a range, x=low~high"),
        ("x=2~1", 5, "2 is not below 1"),
        ("x=1~2~3", 5, "a range has two ends"),
    ],
)
def test_what_cannot_be_varied(text, draws, message):
    with pytest.raises(InputError) as caught:
        parse_grids([text], UNITS) if draws is None else parse_ranges([text], UNITS)
    assert message in str(caught.value)


def test_ranges():
    assert parse_grids(["a.x=0:1:3"], UNITS)["a.x"] == pytest.approx([0, 0.5, 1])
    assert parse_ranges(["a=-1~2e-1"], UNITS)["a"] == pytest.approx([-1, 0.2])
    with pytest.raises(InputError, match="--vary names 'a' twice, give it once"):
        parse_grids(["a=0:1:3", "a=0:1:3"], UNITS)


def test_a_cluster_needs_dask_and_a_scheduler(monkeypatch):
    with pytest.raises(InputError, match="'nowhere' is no address of a scheduler"):
        crane.study("mini_forwarder", {"payload.mass": [0]}, ["lift"], scheduler="nowhere")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"folder: pip install '\.\[cluster\]'"):
        crane.study("mini_forwarder", {"payload.mass": [0]}, ["lift"], scheduler="nowhere")


@contextmanager
def workers(nanny):
    """Two workers, each its own process; the scheduler's address and their process numbers."""
    from distributed import Client, LocalCluster

    with LocalCluster(n_workers=0, dashboard_address=None, silence_logs=50) as cluster:
        address = cluster.scheduler_address
        command = [
            sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1",
            "--no-dashboard", "--nanny" if nanny else "--no-nanny",
        ]  # fmt: skip
        started = [subprocess.Popen(command, stderr=subprocess.DEVNULL) for _ in range(2)]
        try:
            with Client(address) as client:
                client.wait_for_workers(2, timeout=300)
                pids = list(client.run(os.getpid).values())
            yield address, pids
        finally:
            for process in started:
                process.terminate()
                process.wait(300)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("nanny", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_worker_that_dies_loses_nothing(nanny, tmp_path):
    """One of two workers is killed at a third of the way, and started again or not."""
    vary = {"link3_G.x": np.linspace(0.09, 0.1, 6), "payload.mass": np.linspace(0, 0.1, 3)}
    local = crane.study("mini_forwarder", vary)
    killed = []
    with warnings.catch_warnings(), workers(nanny) as (address, pids):
        warnings.simplefilter("ignore")

        def kill(share):
            if share > 1 / 3 and not killed:
                killed.append(pids[0])
                os.kill(killed[0], signal.SIGKILL)

        cluster = crane.study("mini_forwarder", vary, scheduler=address, progress=kill)
    assert killed
    assert text_of(cluster, tmp_path) == text_of(local, tmp_path)


def test_expressions_and_measures_of_ones_own_are_columns():
    """As `crane.design` has them; a variant that fails a requirement says by how much."""
    vary = {"arm.mass": [600.0, 700.0], "bucket_lip.x": [1.3, 1.47]}
    measures = ["load(6, 1) / mass", "mass", "double"]
    own = {"double": lambda machine: 2 * machine.tree.links["arm"].inertial.mass}
    found = crane.study(
        "excavator",
        vary,
        [],
        measures,
        user_measures=own,
        frame="bucket_lip",
        require=["reach >= 9.9"],
    )
    assert found.measures == tuple(measures)
    assert "lacks" in found.failure_reasons[0] and found.failure_reasons[1] == ""
    assert found.columns["double"][1] == 1200.0 and np.isnan(found.columns["double"][0])
    variant = crane.load("excavator", changes={"arm.mass": 600.0, "bucket_lip.x": 1.47})
    chart = crane.capacity(variant, "bucket_lip", radii=[6.0], heights=[1.0])
    mass = sum(x.mass for x in variant.model.inertias)
    assert found.columns["load(6, 1) / mass"][1] == pytest.approx(chart.loads.min() / mass)
    with pytest.raises(crane.CraneError, match="function 'loat' is unknown"):
        crane.study("excavator", vary, [], ["loat(6, 1)"])
    with pytest.raises(crane.CraneError, match="measure 'mas' is unknown, did you mean 'mass'"):
        crane.study("excavator", vary, [], ["mas"])


def test_tasks_of_levers_are_done_with_their_circuit():
    """A pump of less pressure does less work in the same levers' time, and may vary."""
    vary = {"supply.pressure": [3.0e7, 3.5e7]}
    found = crane.study("excavator", vary, ["dig"], ["pump_work", "duration", "peak_X_boom"])
    assert found.failure_reasons == ("", "") and (found.columns["duration"] == 16.0).all()
    less, more = found.columns["pump_work"]
    run = crane.simulate(
        (machine := crane.load("excavator")).with_external_forces(*machine.tasks["dig"].loads),
        crane.joystick(machine, "dig"), duration=16.0, step=5e-3,
    )  # fmt: skip
    assert less < more == pytest.approx(run.channels["pump_work"][-1], rel=1e-9)
    with pytest.raises(crane.CraneError, match="take a task of levers"):
        crane.study("excavator", vary, ["grade"], ["peak_X_boom"])
