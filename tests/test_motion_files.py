"""Motions from files: points, recordings, noisy samples, and lever tasks with a start."""

import warnings

import numpy as np
import pytest
from command_line import typed
from hydraulic_rig import STROKE, rig

import crane
from crane.common.errors import CraneError, CraneWarning, InputError, LimitError


def written(folder, text, name="path.csv"):
    path = folder / name
    path.write_text(text)
    return path


def test_a_path_of_the_tip_with_its_inclination(tmp_path):
    """Time may begin anywhere, angles and lengths are converted."""
    machine = crane.load("excavator")
    path = written(
        tmp_path,
        "time [s],x [mm],y [m],z [m],inclination [deg]\n"
        "3,8000,0,0.3,-70\n5,7000,0.5,0.3,-80\n8,6000,0,0.3,-70\n",
    )
    motion = crane.motion.read_path(machine, path)
    kinematics = crane.Kinematics(machine)
    q_a, v_a, _ = motion([0.0, 2.0, 5.0])
    places = kinematics.positions_at_configurations(machine.closure.solve(q_a))
    np.testing.assert_allclose(places, [[8, 0, 0.3], [7, 0.5, 0.3], [6, 0, 0.3]], atol=1e-9)
    angles = [float(np.rad2deg(kinematics.inclination(q))) for q in q_a]
    np.testing.assert_allclose(angles, [-70, -80, -70], atol=1e-8)
    assert motion.duration == 5.0 and np.abs(v_a[[0, 2]]).max() < 1e-9 < np.abs(v_a[1]).max()


def test_what_a_run_recorded_is_a_path(tmp_path):
    """Columns beside the driven joints are those of a recording, and what it did is exact."""
    machine = crane.load("mini_forwarder")
    task = crane.task_trajectory(machine, "lift")
    drive = crane.ComputedTorque(machine, task)
    run = crane.simulate(machine, drive, step=0.01, duration=2.0)
    run.to_csv(tmp_path / "run.csv")
    with warnings.catch_warnings():
        warnings.simplefilter("error", CraneWarning)
        motion = crane.motion.read_path(machine, tmp_path / "run.csv")
    np.testing.assert_allclose(motion.position(run.time), run.q, rtol=0, atol=1e-12)
    between = np.linspace(0.5, 1.5, 777)
    assert np.abs(motion.position(between) - task.position(between)).max() < 1e-6


def test_noise_is_taken_off(tmp_path):
    """1 s of a known motion under noise of 0.1 mm: what is left is far less, in rates, too."""
    machine = rig(tmp_path)
    truth = crane.point_to_point([0.1], [0.4], 4.0)
    time = np.arange(0, 4.0005, 0.005)
    noisy = truth.position(time)[:, 0] + np.random.default_rng(1).normal(0, 1e-4, len(time))
    rows = "".join(f"{t:.4f},{x:.7f}\n" for t, x in zip(time, noisy, strict=True))
    path = written(tmp_path, f"time [s],x [m]\n{rows}")
    told = r"path\.csv: 'x' scatters by (0\.0001|9\.\d+e-05) m, followed up to [\d.]+ Hz"
    with pytest.warns(CraneWarning, match=told):
        motion = crane.motion.read_path(machine, path)
    inside = time[100:-100]
    x, v, a = (np.array(part)[:, 0] for part in motion(inside))
    x_true, v_true, a_true = (np.array(part)[:, 0] for part in truth(inside))
    assert np.sqrt(np.mean((x - x_true) ** 2)) < 2.5e-5
    assert np.abs(v - v_true).max() < 0.02 * np.abs(v_true).max()
    assert np.abs(a - a_true).max() < 0.15 * np.abs(a_true).max()


JOINTS = "time [s],q1 [rad],X1 [m],X2 [m]"
TIP = "time [s],x [m],y [m],z [m]"
BAD = {
    "missing joint": ("time [s],X1 [m],X2 [m]\n0,0.01,0.02\n1,0.02,0.02\n", "'q1' is missing"),
    "unknown": (f"{JOINTS},X3\n0,0,0.01,0.02,1\n1,0,0.02,0.02,1\n", "'X3' is unknown"),
    "nothing": ("time [s],a [m]\n0,1\n1,2\n", "has no column of a path, give time and q1, X1, X2"),
    "axis": ("time [s],x [m],z [m]\n0,1,1\n1,2,1\n", "'y' is missing"),
    "unit": ("time [s],q1 [bar],X1 [m],X2 [m]\n0,0,0.01,0.02\n1,0,0.02,0.02\n", "in [Pa], give"),
    "back": (f"{JOINTS}\n0,0,0.01,0.02\n2,0,0.02,0.02\n1,0,0.02,0.02\n", "increasing"),
    "one": (f"{JOINTS}\n0,0,0.01,0.02\n", "give two"),
    "word": (f"{JOINTS}\n0,0,0.01,0.02\n1,0,much,0.02\n", "line 3"),
    "limit": (f"{JOINTS}\n0,0,0.01,0.02\n1,0,0.05,0.02\n", "beyond its limit 0.03 m"),
    "reach": (f"{TIP}\n0,9,0,0\n1,9,0,1\n", "cannot reach (9, 0, 0) m at t = 0 s"),
    "attitude": (f"{TIP},roll [rad]\n0,0.3,0,0,0\n1,0.3,0,0.01,0\n", "'pitch' is missing"),
    "both": (f"{TIP},roll,inclination [rad]\n0,0.3,0,0,0,0\n1,0.3,0,0,0,0\n", "one of both"),
    "drives": (f"{TIP},inclination [rad]\n0,0.3,0,0,0\n1,0.3,0,0,0\n", "too few drives"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_bad_paths_are_refused_in_one_line(tmp_path, what):
    text, line = BAD[what]
    path = written(tmp_path, text)
    done = typed("simulate", "mini_forwarder", "--path", path, "--out", tmp_path / "run")
    assert done.returncode == 2 and line in done.stderr, done.stderr
    (error,) = (x for x in done.stderr.splitlines() if x.startswith("error"))
    assert what == "reach" or "path.csv" in error
    assert not (tmp_path / "run").exists()


def test_a_path_does_not_go_with_a_task(tmp_path):
    path = written(tmp_path, "time [s],q1 [rad],X1 [m],X2 [m]\n0,0,0.01,0.02\n1,0,0.02,0.02\n")
    for option in ("--task", "--inputs"):
        done = typed(
            "simulate", "mini_forwarder", "--path", path, option, "lift", "--out", tmp_path / "run"
        )
        assert done.returncode == 2 and "--path" in done.stderr and not (tmp_path / "run").exists()


def test_a_run_along_a_path_keeps_to_it(tmp_path):
    """By forces on the command line: a path of 1.2345 s takes whole steps."""
    path = written(
        tmp_path, "time [s],q1 [rad],X1 [m],X2 [m]\n0,0,0.01,0.02\n1.2345,0.1,0.02,0.02\n"
    )
    out = tmp_path / "run"
    done = typed(
        "simulate", "mini_forwarder", "--path", path, "--controller", "computed-torque",
        "--out", out,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    run = crane.Recording.from_csv(next(out.glob("*.csv")))
    assert run.time[-1] == pytest.approx(1.235) and run.task == "path"
    np.testing.assert_allclose(run.q[-1], [0.1, 0.02, 0.02], atol=1e-6)


def test_levers_begin_where_their_task_says(tmp_path):
    machine = rig(tmp_path)
    text = (tmp_path / "rig.yaml").read_text()

    def with_start(value):
        levers = f"duration: 1, start: {{x: {value}}}, joystick: {{x: [0, 0, 1, 0]}}"
        task = f"tasks:\n  up: {{{levers}}}\n"
        (tmp_path / "rig.yaml").write_text(text + task)
        return crane.load(tmp_path / "rig.yaml")

    machine = with_start(0.35)
    run = crane.simulate(machine, crane.joystick(machine, "up"), duration=0.1)
    assert run.q[0, 0] == pytest.approx(0.35, abs=1e-12)
    own = crane.simulate(machine, crane.joystick(machine, "up"), [0.1], duration=0.1)
    assert own.q[0, 0] == pytest.approx(0.1, abs=1e-12)
    crane.write_machine(machine, tmp_path / "again")
    assert crane.load(next((tmp_path / "again").glob("*.yaml"))).tasks["up"].start == {"x": 0.35}
    far = with_start(STROKE + 0.1)
    with pytest.raises(LimitError, match="the start of task 'up': x = 0.635 is outside"):
        crane.joystick(far, "up")
    with pytest.raises(InputError):
        crane.motion.read_path(machine, written(tmp_path, "time [s],y\n0,1\n1,2\n"))
    with pytest.raises(CraneError):
        with_start("high")
