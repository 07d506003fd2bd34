"""Processes that SIGKILL ends between two system calls or at any instant."""

import os
import sys
import warnings

ENDED = 77


def killed_at(action, call):
    """Run an action in a process that ends before its n-th call on files; whether it did.

    Python tells of each such call (open, mkdir, rename, link, remove, rmdir, listdir, calls into C
    libraries), so that nothing has to be named here. Nothing is cleaned up in that process.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which nothing here has
        child = os.fork()
    if child == 0:
        left = call

        def hook(event, args):
            nonlocal left
            if event.split(".")[0] in ("open", "os", "shutil", "ctypes", "fcntl"):
                left -= 1
                if left < 0:
                    os._exit(ENDED)

        try:
            sys.addaudithook(hook)
            action()
        except BaseException:
            os._exit(1)
        os._exit(0)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status in (0, ENDED), f"the action failed at call {call}"
    return status == ENDED


def kill_simulations(folder, kills):
    """Kill `crane simulate --force` over its whole run and in its last 100 ms; counts by outcome.

    A process for each is forked off one that has all loaded.
    """
    import signal
    import time
    from pathlib import Path

    import crane
    from crane.cli import main

    machine = str(Path(__file__).parent / "data" / "four_bar.yaml")
    crane.simulate(crane.load(machine), duration=0.01)
    target = Path(folder) / "run"

    def start(step):
        child = os.fork()
        if child == 0:
            silence = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silence, 1)
            os.dup2(silence, 2)
            sys.argv = ["crane", "simulate", machine, "--out", str(target), "--force",
                        "--duration", "0.5", "--step", step]  # fmt: skip
            try:
                main()
            except SystemExit as end:
                os._exit(end.code or 0)
            os._exit(0)
        return child

    def whole(step):
        before = time.perf_counter()
        assert os.waitpid(start(step), 0)[1] == 0
        return time.perf_counter() - before

    def tree():
        return {x.relative_to(target): x.read_bytes() for x in target.rglob("*") if x.is_file()}

    whole("0.1")
    (target / "comparison.md").write_text("of the old run")
    (target / "notes").write_text("the user's own")
    old = tree()
    lasts = sorted(whole("0.001") for _ in range(5))[2]
    new = tree()
    assert old.keys() - new.keys() == {Path("comparison.md")}, (list(old), list(new))
    outcomes = {"old": 0, "new": 0}

    def kill(when):
        whole("0.1")
        (target / "comparison.md").write_text("of the old run")
        child = start("0.001")
        time.sleep(max(when, 0.0))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        found = tree()
        assert found in (old, new), f"killed after {when:.4f} s: {sorted(map(str, found))}"
        outcomes["old" if found == old else "new"] += 1

    for i in range(kills):
        share = (i // 2 + 0.5) / (kills / 2)
        kill(lasts * share if i % 2 else lasts - 0.1 * share)
    while not outcomes["new"] and lasts < 60.0:  # a busy machine has become slower
        lasts *= 1.5
        kill(lasts)
    whole("0.001")
    assert tree() == new and os.listdir(folder) == ["run"], os.listdir(folder)
    return outcomes


if __name__ == "__main__":
    print(kill_simulations(sys.argv[1], int(sys.argv[2])))
