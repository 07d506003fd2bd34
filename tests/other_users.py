"""Actions as other users, each in a process of its own that root forks."""

import os
import shutil
import signal
import tempfile
import traceback
import warnings
from contextlib import contextmanager
from pathlib import Path

import pytest

ME, STRANGER = 64001, 64002  # users without a name
LIMIT = 60  # seconds, after which an action hangs


def as_user(user, action, *arguments):
    """Run an action as another user; it may neither raise an error nor hang."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which nothing here has
        child = os.fork()
    if child == 0:
        status = 1
        try:
            os.setgroups([])
            os.setgid(user)
            os.setuid(user)
            signal.alarm(LIMIT)
            action(*arguments)
            status = 0
        except BaseException:
            traceback.print_exc()
        os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status == 0, f"as user {user}: {status}"


@contextmanager
def home_folder():
    """A folder of the user `ME` in a shared one; skips where this process is not root."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("only root can act as other users")
    place = Path(tempfile.mkdtemp(prefix="crane-users-"))
    try:
        place.chmod(0o1777)
        as_user(ME, (place / "me").mkdir, 0o755)
        yield place / "me"
    finally:
        shutil.rmtree(place)
