"""Long computations go on after interruptions and deaths of processes, to the same result."""

import hashlib
import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
import warnings
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

import numpy as np
import pytest
from command_line import MAIN, typed
from test_studies import workers

import crane
from crane.common import checkpoint
from crane.common.checkpoint import Checkpoint
from crane.common.errors import CraneWarning, InputError, OutputError, TerminatedWorkerError
from crane.studies import worker_processes
from crane.studies.parallel_jobs import compute_on_cluster
from crane.studies.worker_processes import WorkerPool

FOUR_BAR = Path(__file__).parent / "data" / "four_bar.yaml"
MASSES = {"crank_arm.mass": np.linspace(0.5, 1.0, 12), "coupler_arm.mass": [0.5, 1.0]}
DEPENDENCIES = {"machine data": {"mass": 1.0}, "settings": (np.arange(3), frozenset("ab"), abs)}


def opened(path, dependencies=DEPENDENCIES, columns=("a", "b", "c")):
    return Checkpoint(path, dependencies, columns, 1)


def test_rows_are_there_again_up_to_the_last_complete_one(tmp_path):
    path = tmp_path / "new" / "folder" / "part.csv"
    with opened(path) as table:
        assert table.rows == {}
        table.append(("1",), (0.1, 'a, "b"'))
        table.append(("2",), (float("nan"), ""))
    whole = path.read_bytes()
    for cut in range(1, len(whole)):
        path.write_bytes(whole[:cut])
        with opened(path) as table:
            count = max(0, whole[:cut].count(b"\n") - 5)
            assert list(table.rows) == [("1",), ("2",)][:count]
            table.append(("3",), ("x", "y"))
        assert path.read_bytes().endswith(b"\n3,x,y\n")
        with opened(path) as table:
            assert len(table.rows) == count + 1
            assert table.rows.get(("1",), ["0.1", 'a, "b"']) == ["0.1", 'a, "b"']


def test_without_a_row_nothing_is_left(tmp_path):
    (tmp_path / "there").mkdir()
    with pytest.raises(KeyboardInterrupt), opened(tmp_path / "there" / "new" / "x" / "part.csv"):
        raise KeyboardInterrupt
    assert [x.name for x in tmp_path.rglob("*")] == ["there"]


@pytest.mark.parametrize(
    ("error", "stays"),
    [(KeyboardInterrupt(), True), (TerminatedWorkerError("x"), True), (OutputError("x"), True),
     (InputError("x"), False), (RuntimeError(), True)],
)  # fmt: skip
def test_what_is_of_no_use_is_removed(tmp_path, error, stays):
    with pytest.raises(type(error)), opened(tmp_path / "part.csv") as table:
        table.append(("1",), ("x", "y"))
        raise error
    assert (tmp_path / "part.csv").exists() is stays


def test_rows_of_another_computation_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "part.csv"
    with opened(path) as table:
        table.append(("1",), ("x", "y"))
    whole = path.read_bytes()
    others = {
        "machine data": DEPENDENCIES | {"machine data": {"mass": 1.0 + 1e-15}},
        "settings": DEPENDENCIES | {"settings": (np.arange(4), frozenset("ab"), abs)},
    }
    for what, other in others.items():
        with pytest.raises(InputError, match=f"was begun with other {what}: go on with the same"):
            opened(path, other)
    with pytest.raises(InputError, match="was begun with other columns"):
        opened(path, columns=("a", "b", "d"))
    monkeypatch.setattr(crane, "__version__", "9")
    with pytest.raises(InputError, match="was begun with other version of crane"):
        opened(path)
    monkeypatch.undo()
    with opened(path), pytest.raises(InputError, match="another process computes this"):
        opened(path)
    assert path.read_bytes() == whole
    for content in (b"my table\n1,2\n", b"x" * 10 + b"\n"):
        path.write_bytes(content)
        with pytest.raises(InputError, match="is no unfinished result"):
            opened(path)
        assert path.read_bytes() == content
    os.mkfifo(tmp_path / "pipe")
    for name in (tmp_path / "pipe", "/dev/zero"):
        with pytest.raises(InputError, match="is no plain file"):
            opened(name)
    with pytest.raises(OutputError, match="cannot be written"):
        opened(tmp_path)


def test_functions_count_by_what_they_do():
    first, second, third = (
        eval(text) for text in ("lambda x: x + 1", "lambda y: y + 1", "lambda x: x + 2")
    )  # noqa: S307
    contents = [checkpoint._plain({"f": f}) for f in (first, second, third)]
    assert contents[0] == contents[1] != contents[2]


def as_text(study, folder):
    study.to_csv(folder / "compared.csv")
    return (folder / "compared.csv").read_bytes()


@contextmanager
def quiet():
    with warnings.catch_warnings(action="ignore", category=CraneWarning):
        yield


def own_workers():
    return [x.pid for x in multiprocessing.active_children()]


class Interruptions:
    """Called with the finished share: interrupts at some of them, and kills workers at others."""

    def __init__(self, stops=(), kills=(), workers=own_workers):
        self.stops, self.kills, self.workers = sorted(stops), sorted(kills), workers

    def __call__(self, share):
        if self.kills and share >= self.kills[0]:
            del self.kills[0]
            os.kill(random.choice(self.workers()), signal.SIGKILL)
        if self.stops and share >= self.stops[0]:
            del self.stops[0]
            raise KeyboardInterrupt


def until_done(compute, interruptions):
    """The result, and how often it was interrupted."""
    for count in range(100):
        try:
            with quiet():
                return compute(progress=interruptions), count
        except KeyboardInterrupt:
            continue
    raise AssertionError("never done")


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_a_study_goes_on_to_the_same_table(tmp_path, processes):
    whole = crane.study(FOUR_BAR, MASSES, measures=["mass", "range"])
    seen, file = [], tmp_path / "study" / "unfinished.csv"
    kills = [0.2, 0.4, 0.6, 0.8] if processes > 1 else []
    interruptions = Interruptions([0.3, 0.7], kills)

    def compute(progress):
        rows = file.read_text().count("\n") if file.exists() else 0
        seen.append(rows)
        return crane.study(FOUR_BAR, MASSES, measures=["mass", "range"], processes=processes,
                           checkpoint=file, progress=progress)  # fmt: skip

    found, count = until_done(compute, interruptions)
    assert count == 2 and not interruptions.kills
    assert 0 == seen[0] < seen[1] < seen[2] < 24 + 4
    assert as_text(found, tmp_path) == as_text(whole, tmp_path)
    # the rows of the table, in the order in which they came
    head, rows = file.read_text().splitlines()[4], file.read_text().splitlines()[5:]
    table = (tmp_path / "compared.csv").read_text().splitlines()
    table = table[table.index(head) :]
    assert table[0] == head and sorted(rows) == sorted(table[1:])
    # damaged rows are computed again
    file.write_text(file.read_text().replace(rows[3], "x" + rows[3]).replace(rows[5], rows[5][3:]))
    again, done = compute(None), []
    assert as_text(again, tmp_path) == as_text(whole, tmp_path)
    compute(done.append)
    assert not done  # all are known


@pytest.mark.slow
def test_an_optimization_goes_on_to_the_same_front(tmp_path):
    """With two objectives: first each alone, then the front."""
    vary = {"coupler_arm.mass": (0.1, 1.0), "rocker_arm.mass": (0.1, 1.0)}

    def compute(progress=None, file=None):
        return crane.design(
            FOUR_BAR, vary, minimise=["mass"], maximise=["coupler_arm.mass * rocker_arm.mass"],
            require=["coupler_arm.mass <= 0.8"], starts=3, points=4, checkpoint=file,
            progress=progress,
        )  # fmt: skip

    whole = compute()
    file = tmp_path / "unfinished.csv"
    found, count = until_done(
        lambda progress: compute(progress, file), Interruptions([0.1, 0.5, 0.8])
    )
    assert count == 3
    for one, two in zip(whole.solutions, found.solutions, strict=True):
        assert one.message == two.message and one.is_feasible is two.is_feasible
        for name in ("initial_values", "values", "objectives", "slacks"):
            assert getattr(one, name).tobytes() == getattr(two, name).tobytes(), name
    whole.to_csv(tmp_path / "one.csv")
    found.to_csv(tmp_path / "two.csv")
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    "fit", [["load_x.mass", "valve.x.neutral", "friction.x.coulomb"], ["auto"]]
)
def test_a_calibration_goes_on_to_the_same_machine(tmp_path, fit):
    """To the last bit, wherever it is interrupted, and with the number of its simulations."""
    from test_calibration import recorded, simple

    machine = simple(tmp_path)
    path, other = (recorded(machine, tmp_path / f"run{i}.csv", i) for i in (0, 1))

    def compute(progress=None, file=None):
        return crane.calibrate(
            machine, path, fit, train=(0.0, 2.0), validation=[other], checkpoint=file,
            progress=progress,
        )  # fmt: skip

    with quiet():
        whole = compute()
    file = tmp_path / "unfinished.csv"
    found, count = until_done(
        lambda progress: compute(progress, file), Interruptions([0.05, 0.2, 0.4, 0.6])
    )
    assert count == 4
    assert found.to_text() == whole.to_text()
    assert found.changes == whole.changes and found.simulation_count == whole.simulation_count
    rows = [line.split(",") for line in file.read_text().splitlines()[6:]]
    assert len(rows) > count and all(len(row) == 8 for row in rows)

    def begin_anew(fit, train):
        crane.calibrate(machine, path, fit, train=train, validation=[other], checkpoint=file)

    with pytest.raises(InputError, match="was begun with other settings"), quiet():
        begin_anew(["load_x.mass"], (0.0, 2.0))
    with pytest.raises(InputError, match="was begun with other recordings"), quiet():
        begin_anew(fit, (0.0, 2.1))


def study_command(out, *words):
    return ["study", FOUR_BAR, "--vary", "crank_arm.mass=0.5:1:40", "--measure", "mass",
            "--out", out, *words]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_the_command_goes_on(tmp_path, number):
    """Worker processes end with it; a table that is complete says nothing of how it came."""
    assert typed(*study_command(tmp_path / "whole", "--processes", 1)).returncode == 0
    out = tmp_path / "run"
    code = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {MAIN}"
    command = [sys.executable, "-c", code, *map(str, study_command(out, "--processes", 2))]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        end = time.monotonic() + 60
        while time.monotonic() < end and process.poll() is None:
            if (out / "unfinished.csv").exists() and len(finished(out)) > 3:
                break
            time.sleep(0.02)
        process.send_signal(number)
        error = process.communicate(timeout=60)[1].splitlines()
    if number == signal.SIGKILL:
        assert process.returncode == -number
    else:
        assert process.returncode == 128 + number
        assert error == [
            f"what is finished is kept in {out}/unfinished.csv: add --resume to go on",
            "error: interrupted, no result was written",
        ]
    assert os.listdir(out) == ["unfinished.csv"] and 3 < len(finished(out)) < 40
    done = typed(*study_command(out))
    assert done.returncode == 2 and done.stderr == (
        f"error: {out}: holds an unfinished result, add --resume to go on with it, or --force to "
        "begin anew\n"
    )
    done = typed(*study_command(out, "--resume", "--rule", "iso10567"))
    assert done.returncode == 2 and "was begun with other settings" in done.stderr
    before = finished(out)
    done = typed(*study_command(out, "--resume", "--processes", 1))
    assert (done.returncode, done.stderr) == (0, "") and len(before) > 3
    assert sorted(os.listdir(out)) == ["study.csv", "study.png"]
    whole = tmp_path / "whole" / "study.csv"
    assert (out / "study.csv").read_bytes() == whole.read_bytes()


def finished(out):
    return (out / "unfinished.csv").read_text().splitlines()[5:]


def test_resume_needs_a_folder_and_begins_where_there_is_none(tmp_path):
    done = typed("calibrate", FOUR_BAR, tmp_path / "run.csv", "--fit", "x", "--resume")
    assert done.returncode == 2
    assert done.stderr == "error: --resume needs the folder, add --out FOLDER\n"
    words = study_command(tmp_path / "new", "--processes", 1)
    words[3] = "crank_arm.mass=0.5:1:2"
    assert typed(*words, "--resume").returncode == 0
    done = typed(*words, "--resume")
    assert done.returncode == 2 and "is not empty, choose another folder" in done.stderr
    (tmp_path / "new" / "unfinished.csv").write_text("of an earlier one")
    assert typed(*words, "--force").returncode == 0
    assert sorted(os.listdir(tmp_path / "new")) == ["study.csv", "study.png"]


def dies(job):
    """A job that ends its process, as often as its file says."""
    path, how = job
    left = int(path.read_text()) if path else 0
    if left:
        path.write_text(str(left - 1))
        if how == "memory":
            raise MemoryError
        os.kill(os.getpid(), how)
    return os.getpid()


@pytest.mark.slow
def test_what_ends_a_process_is_told_and_its_job_computed_again(tmp_path):
    causes = {
        signal.SIGKILL: r"killed by signal 9 \(SIGKILL\), as the system does when memory is short "
        r"\(the largest process used 0\.\d GB\)",
        signal.SIGSEGV: r"killed by signal 11 \(SIGSEGV\)",
        "memory": "refused more memory",
    }
    for number, (how, cause) in enumerate(causes.items()):
        path = tmp_path / str(number)
        path.write_text(str(worker_processes.MAX_TRIES - 1))
        pool = WorkerPool(dies, {0: (None, how), 5: (path, how), 7: (None, how)}, 2)
        try:
            with pytest.warns(CraneWarning, match=f"a process was {cause}.*is computed again"):
                found = dict(pool.results())
        finally:
            pool.close()
        assert found.keys() == {0, 5, 7} and os.getpid() not in found.values()
    path.write_text("100")
    jobs = {0: (path, signal.SIGKILL), **dict.fromkeys(range(1, 9), (None, None))}
    pool, found = WorkerPool(dies, jobs, 2), {}
    message = "1 of 9 could not be computed, number 0 first: 3 processes were begun with it"
    with pytest.raises(TerminatedWorkerError, match=message), quiet():
        for index, result in pool.results():
            found[index] = result
    pool.close()
    assert found.keys() == set(range(1, 9))  # all others are finished before


CRASH = """
import crane
if {guard}:
    crane.study({machine!r}, {{"crank_arm.mass": [0.5, 0.6, 0.7]}}, measures=["mass"], processes=2)
"""


@pytest.mark.slow
def test_a_script_without_a_guard_is_told_so(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(CRASH.format(guard="True", machine=str(FOUR_BAR)))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert "InputError: a process could not import your script: guard what it runs with" in last


@pytest.mark.slow
def test_a_scheduler_that_ends_leaves_what_is_finished(tmp_path):
    pytest.importorskip("distributed")
    contact = tmp_path / "scheduler.json"  # written by the scheduler once it answers
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard"]
    command += ["--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(contact)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, cwd=tmp_path) as scheduler:
        address = scheduler_address(contact)
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1"]
        worker += ["--no-dashboard", "--no-nanny", "--death-timeout", "60"]
        with subprocess.Popen(worker, stderr=subprocess.DEVNULL, cwd=tmp_path) as process:
            file = tmp_path / "unfinished.csv"

            def end(share):
                if share > 0.2 and scheduler.poll() is None:
                    scheduler.kill()

            try:
                with (
                    pytest.raises(TerminatedWorkerError, match="the scheduler at .* is gone"),
                    quiet(),
                ):
                    crane.study(FOUR_BAR, MASSES, measures=["mass"], scheduler=address,
                                checkpoint=file, progress=end)  # fmt: skip
            finally:
                scheduler.kill()
                process.kill()
    rows = file.read_text().splitlines()[5:]
    assert 24 * 0.2 <= len(rows) < 24
    found = crane.study(FOUR_BAR, MASSES, measures=["mass"], checkpoint=file)
    whole = crane.study(FOUR_BAR, MASSES, measures=["mass"])
    assert as_text(found, tmp_path) == as_text(whole, tmp_path)


@pytest.mark.slow
def test_a_scheduler_that_ends_while_it_hands_over_a_result_is_told(monkeypatch):
    """The connection breaks after the job is reported as finished, before its result is here."""
    distributed = pytest.importorskip("distributed")

    def broken(self, timeout=None):
        raise distributed.comm.CommClosedError("in <TCP (closed) ConnectionPool.gather>")

    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None,
               "protocol": "tcp"}  # fmt: skip
    with distributed.LocalCluster(processes=False, **options) as cluster:
        monkeypatch.setattr(distributed.Future, "result", broken)
        results = compute_on_cluster(abs, {0: -1}, cluster.scheduler_address)
        with pytest.raises(TerminatedWorkerError, match="the scheduler at .* is gone"):
            list(results)


def scheduler_address(file):
    """Address in the file of a scheduler, which chose a free port."""
    for _ in range(600):
        with suppress(OSError, ValueError):  # no file yet, or half of one
            return json.loads(file.read_text())["address"]
        time.sleep(0.1)
    raise TimeoutError(f"no scheduler has written {file}")


def cluster_workers():
    """Processes that nannies have started."""
    psutil = pytest.importorskip("psutil")
    for _ in range(300):  # none while they are started again
        if found := [
            x.pid
            for x in psutil.Process().children(recursive=True)
            if x.is_running() and any("spawn_main" in word for word in x.cmdline())
        ]:
            return found
        time.sleep(0.1)
    raise AssertionError("no workers")


def digest(study, folder):
    return hashlib.sha256(as_text(study, folder)).hexdigest()


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("where", ["processes", "cluster"])
def test_two_thousand_variants_with_twenty_deaths_and_three_interruptions(tmp_path, where):
    vary = {
        "crank_arm.mass": np.linspace(0.5, 1.0, 50),
        "rocker_arm.mass": np.linspace(0.5, 1, 40),
    }
    random.seed(48)
    stops, kills = np.sort(random.sample(range(100, 1900), 3)), random.sample(range(50, 1950), 20)
    file = tmp_path / "unfinished.csv"

    def compute(**options):
        return crane.study(FOUR_BAR, vary, measures=["mass"], **options)

    whole = digest(compute(processes=2), tmp_path)
    shares = [x / 2000 for x in stops], [x / 2000 for x in kills]
    with workers(True) if where == "cluster" else nullcontext((None, ())) as (address, _):
        interruptions = Interruptions(*shares, cluster_workers if address else own_workers)
        found, count = until_done(
            lambda progress: compute(
                processes=2, scheduler=address, checkpoint=file, progress=progress
            ),
            interruptions,
        )
    assert count == 3 and not interruptions.kills and not interruptions.stops
    assert digest(found, tmp_path) == whole
    assert len(file.read_text().splitlines()) == 5 + 2000
