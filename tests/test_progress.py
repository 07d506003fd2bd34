"""Long computations show progress on a terminal only."""

import os
import pty
import subprocess
import sys

PROGRAM = """
import sys
import time
from crane.cli import entry
from crane.common import progress
from crane.cli import terminal
from crane.cli.command import app
from crane.cli.terminal import progress_bar

progress.REPORT_DELAY, progress.REPORT_INTERVAL = float(sys.argv.pop()), 0.05

@app.command()
def wait(seconds: float, bar: bool = False, served: bool = False):
    if served:
        with terminal.hide_activity_line():
            time.sleep(seconds)
        return
    if bar:
        with progress_bar("counting") as tell:
            for share in range(10):
                time.sleep(seconds / 10)
                tell(share / 10)
        return
    exec(compile("time.sleep(seconds)", "there", "exec"),
         {"__name__": "crane.closure.there", "time": time, "seconds": seconds})
    print("half a", end=" ", flush=True)
    time.sleep(seconds)
    print("line")

sys.argv = ["crane", "wait", *sys.argv[1:]]
entry.main()
"""


def on_terminal(*words, out=None, after="0.3"):
    """What a command writes to a terminal, both streams unless the output goes elsewhere."""
    ours, theirs = pty.openpty()
    done = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *words, after],
        stdout=theirs if out is None else out,
        stderr=theirs,
        env=os.environ | {"TERM": "xterm"},
    )
    os.close(theirs)
    told = b""
    try:
        while part := os.read(ours, 4096):
            told += part
    except OSError:  # its other end is closed
        pass
    finally:
        os.close(ours)
    assert done.wait() == 0
    return told.decode()


def left(told):
    """What stands on the screen in the end: each line from its last erasure on."""
    return [line.rsplit("\x1b[2K", 1)[-1] for line in told.replace("\r\n", "\n").split("\n")]


def test_a_terminal_is_told_what_goes_on_and_the_line_goes():
    told = on_terminal("0.8")
    assert "crane wait: closing the loops, " in told
    assert left(told) == ["half a line", ""]


def test_output_into_a_file_stays_as_it_is(tmp_path):
    with (tmp_path / "out").open("w") as out:
        told = on_terminal("0.8", out=out)
    assert "closing the loops" in told and left(told) == [""]
    assert (tmp_path / "out").read_text() == "half a line\n"


def test_what_is_quick_says_nothing():
    assert on_terminal("0.01", after="60") == "half a line\r\n"


def test_a_bar_stands_alone():
    told = on_terminal("0.9", "--bar", after="0.1")
    before, after = told.split("counting", 1)
    assert "crane wait:" in before and "crane wait:" not in after
    assert left(told)[-1] == ""


def test_a_bar_is_only_for_what_takes_a_while():
    assert "counting" not in on_terminal("0.01", "--bar")


def test_what_waits_for_the_user_says_nothing():
    told = on_terminal("0.8", "--served", after="0.6")
    assert left(told) == [""] and told.count("crane wait:") == 0


def test_pipes_hear_nothing():
    words = [sys.executable, "-c", PROGRAM, "0.8", "0.3"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("half a line\n", "")
