"""Options with extreme values give an answer, or one line that says what is wrong.

What counts as well is in fuzz_options.py: exit status 0 to 2, no traceback, within 60 s of
computing and 2 GB, an error alone on its line and nothing left behind it, and of a call that
succeeds no figure that no machine has.
"""

import pytest
from fuzz_process import judge


@pytest.mark.slow
@pytest.mark.long
def test_some_options_at_the_edge():
    assert judge("fuzz_options.py", 0, 12) == 12


@pytest.mark.slow
def test_calls_that_were_reported():
    assert judge("fuzz_options.py", "reported") > 30


@pytest.mark.slow
@pytest.mark.parametrize("part", (0, 1, 2, 3))
@pytest.mark.long
def test_options_at_the_edge(part):
    assert judge("fuzz_options.py", 1000 + 250 * part, 20) == 20
