"""A program that is cached between runs: its result, and whether it was built again.

Run as `python cached_program.py [die N] [late]` it checks the result and prints "built" or
"found". `die N` kills the process between writing its N-th file and putting it in place; `late`
simulates a package that was loaded long after its files changed.
"""

import os
import signal
import sys

import numpy as np

import crane
from crane.codegen import Program, Tape

LONG = 300  # operations of the toy, more or less


def toy(factor=3.0, built=None):
    """A compiled program, found by its factor."""

    def build(program):
        if built is not None:
            built.append(factor)
        tape = Tape()
        x, y = tape.load_vector(0, 0, 2)
        total = factor * x
        for _ in range(LONG // 2):
            total = y + total * 0.5
        program.add_formula("formula", 1, {"value": [total], "given": [x, y]})
        with program.add_routine("each", counts=("count",), arrays=("x", "out")) as r:
            with r.loop(r.count) as i:
                r.call("formula", r.x.row_pointer(i, 2), r.out.row_pointer(i, 3))
            r.return_value(r.count)

    return Program.from_cache(("toy", factor), build)


def value(program):
    """What it makes of 2 and 5 twice, if it is what it should be."""
    layout = program.formula_outputs("formula")
    x, out = np.array([[2.0, 5.0], [2.0, 5.0]]), np.empty((2, layout.size))
    assert program.call("each", 2, x, out) == 2
    assert (layout.view(out).given == x).all() and out[0, 0] == out[1, 0]
    return float(out[0, 0])


def wanted(factor=3.0):
    """The same in Python."""
    total = factor * 2.0
    for _ in range(LONG // 2):
        total = 5.0 + total * 0.5
    return total


def die_before(count):
    """Be killed instead of putting the count-th file in its place."""
    replace, left = os.replace, [count]

    def deadly(*paths):
        left[0] -= 1
        if not left[0]:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(*paths)

    os.replace = deadly


def main(arguments):
    """See the module's text."""
    if "die" in arguments:
        die_before(int(arguments[arguments.index("die") + 1]))
    if "late" in arguments:
        crane.LOADED += 3600.0
    built = []
    got = value(toy(built=built))
    assert abs(got - wanted()) < 1e-12 * wanted(), got
    print("built" if built else "found")


if __name__ == "__main__":
    main(sys.argv[1:])
