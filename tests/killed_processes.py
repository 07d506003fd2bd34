"""A process that ends between two of its calls on files."""

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
