"""Worker processes of a study end with the process that started them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PROGRAM = """
import crane
if __name__ == "__main__":
    masses = [1e-4 * i for i in range(3000)]
    crane.study("mini_forwarder", {"payload.mass": masses}, processes=2)
"""


def group(leader):
    """Process ids of a process group, those that only wait to be counted left out."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            state, _, of = (entry / "stat").read_text().rpartition(")")[2].split()[:3]
        except (OSError, ValueError):
            continue
        if entry.name.isdigit() and int(of) == leader and state != "Z":
            found.append(int(entry.name))
    return found


def until(holds, seconds):
    """Whether something comes true."""
    end = time.monotonic() + seconds
    while not (true := holds()) and time.monotonic() < end:
        time.sleep(0.05)
    return true


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are told by /proc")
@pytest.mark.parametrize("number", [
    signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.long)
])  # fmt: skip
def test_workers_end_with_their_parent(number, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(PROGRAM)
    parent = subprocess.Popen(
        [sys.executable, str(script)], stderr=subprocess.PIPE, start_new_session=True
    )
    try:
        # itself, two workers and what tracks their resources
        assert until(lambda: len(group(parent.pid)) >= 4 or parent.poll() is not None, 60)
        assert parent.poll() is None, parent.stderr.read().decode()
        time.sleep(3.0)  # at work
        parent.send_signal(number)
        parent.wait(10)
        assert until(lambda: not group(parent.pid), 10), group(parent.pid)
    finally:
        for process in group(parent.pid):
            os.kill(process, signal.SIGKILL)
