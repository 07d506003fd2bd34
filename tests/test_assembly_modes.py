"""Machines with several assembly modes: the nearest one is taken, and ambiguity is reported."""

import math
import re
import warnings

import bucket_linkage
import numpy as np
import pytest
from broken_machines import DATA, LOOPED, copy_machine, swap
from command_line import typed
from executed_lines import at_most
from warned import quiet, told

import crane
from crane.closure.assembly_modes import find_alternative_assembly_modes
from crane.common.errors import CraneError, CraneWarning
from crane.description import bundled_machines
from crane.formats import check

STROKES = np.arange(0.14, 0.96, 0.02).round(2).tolist()
CHOICES = re.compile(r"under 'home:' write (.+) for the other \(.+\) or (.+) to keep this one")


def apart(one, two):
    """Largest difference of angles."""
    return max(abs(math.remainder(a - b, 2 * math.pi)) for a, b in zip(one, two, strict=True))


def assembly(path, stroke, zero=bucket_linkage.ZERO):
    """Which of the four it is, and what was said of it."""
    machine, lines = told(crane.load, path)
    q = [machine.home[machine.column(joint)] for joint in bucket_linkage.PASSIVE]
    (which,) = (
        i for i, a in enumerate(bucket_linkage.assemblies(stroke, zero)) if apart(a, q) < 1e-9
    )
    return which, lines


def lines(text):
    return "".join(f"  {item}\n" for item in text.split(", "))


def test_two_strokes_that_differ_little_are_assembled_differently_and_both_are_told(tmp_path):
    (one, told), (two, also) = (
        assembly(bucket_linkage.write(tmp_path, stroke), stroke) for stroke in (0.20, 0.25)
    )
    assert one != two
    for lines_told in (told, also):
        assert len(lines_told) == 1
        assert lines_told[0].endswith("; 1 more such: crane check lists them")
    for stroke in (0.20, 0.25):
        assert check(bucket_linkage.write(tmp_path, stroke)).status == 1


def test_the_line_names_the_other_and_how_to_choose_it(tmp_path):
    report = check(bucket_linkage.write(tmp_path, 0.25))
    assert report.errors == 0
    assert [finding.line for finding in report.findings] == [8, 8]
    assert str(report.findings[1]) == (
        "bucket.yaml:8: warning: loop 'pin' can be assembled another way at home, and the file "
        "does not say which is meant; under 'home:' write bucket: 2.143, link: 1.633 for the "
        "other (bucket 2.14 rad off) or bucket: 0.8118, link: 2.632 to keep this one "
        "(link 2.63 rad off what it says)"
    )
    now, _ = assembly(bucket_linkage.write(tmp_path, 0.25), 0.25)
    reached = set()
    for finding in report.findings:
        for k, choice in enumerate(CHOICES.search(finding.message).groups()):
            path = bucket_linkage.write(tmp_path, 0.25, home=lines(choice))
            which, _ = assembly(path, 0.25)
            assert (which == now) == (k == 1)
            reached.add(which)
    assert len(reached) == 3  # as it is, and one other for each loop


@pytest.mark.parametrize("which", range(4))
def test_a_file_that_says_what_is_meant_gets_it_without_a_word(which, tmp_path):
    for stroke in (0.20, 0.5, 0.9):
        values = bucket_linkage.assemblies(stroke, bucket_linkage.ZERO)[which]
        said = lines(", ".join(
            f"{joint}: {value + 0.1:.3f}"
            for joint, value in zip(bucket_linkage.PASSIVE, values, strict=True)
        ))  # fmt: skip
        path = bucket_linkage.write(tmp_path, stroke, home=said)
        assert assembly(path, stroke) == (which, [])
        if stroke != 0.5:
            continue
        told = [one.message for one in check(path).findings]
        assert [line for line in told if "of the strokes within" not in line] == []


@pytest.mark.parametrize("which", range(4))
def test_what_is_named_in_part_is_taken_or_told(which, tmp_path):
    """One joint of each loop decides, but what it leads to may be another assembly."""
    silent = 0
    for stroke in STROKES[::8]:
        _, rocker, link, pin = bucket_linkage.assemblies(stroke, bucket_linkage.ZERO)[which]
        for name, value in (("bucket", pin), ("link", link)):
            named = f"  rocker: {rocker:.2f}\n  {name}: {value:.2f}\n"
            found, told = assembly(bucket_linkage.write(tmp_path, stroke, home=named), stroke)
            assert told or found == which
            silent += not told
    assert silent


def test_a_guess_far_from_all_is_told(tmp_path):
    """Between the two assemblies, whichever it leads to."""
    one, two = (bucket_linkage.assemblies(0.25, bucket_linkage.ZERO)[i] for i in (0, 2))
    middle = lines(", ".join(
        f"{joint}: {a + 0.45 * math.remainder(b - a, 2 * math.pi):.3f}"
        for joint, a, b in zip(bucket_linkage.PASSIVE, one, two, strict=True)
    ))  # fmt: skip
    path = bucket_linkage.write(tmp_path, 0.25, home=middle)
    assert any(
        "'eye' can be assembled another way" in line.message for line in check(path).findings
    )


def test_limits_decide(tmp_path):
    """An assembly outside of limits is none; one within is told where home is outside."""
    rockers = [q[1] for q in bucket_linkage.assemblies(0.25, bucket_linkage.ZERO)]
    for which, wide in ((0, 2), (2, 0)):
        low, high = rockers[which] - 0.5, rockers[which] + 0.5
        assert not low <= rockers[wide] <= high
        limits = round(low, 3), round(high, 3), 1e9, 1e9
        path = bucket_linkage.write(tmp_path, 0.25, limits=limits)
        told = [finding.message for finding in check(path).findings]
        eye = [what for what in told if what.startswith("loop 'eye'")]
        outside = [what for what in told if "outside of its limits" in what]
        assert len(eye) == len(outside)
        assert all("keep this one (outside of limits)" in what for what in eye)


@pytest.mark.slow
def test_nearby_homes_never_differ_silently(tmp_path):
    """Holds for any orientation of the frames at zero, and for all strokes."""
    random = np.random.default_rng(0)
    flips = 0
    for _ in range(4):
        zero = (0.0, *random.uniform(-math.pi, math.pi, 3).tolist())
        before = None
        for stroke in STROKES[::2]:
            which, told = assembly(bucket_linkage.write(tmp_path, stroke, zero=zero), stroke, zero)
            if before is not None and which != before[0]:
                flips += 1
                assert told or before[1], (zero, stroke)
            before = which, told
    assert flips > 1


def test_all_others_are_found(tmp_path):
    """Of each loop the one mirror image, which circles that cross tell."""
    random = np.random.default_rng(1)
    for stroke in random.choice(STROKES, 12):
        zero = (0.0, *random.uniform(-math.pi, math.pi, 3).tolist())
        path = bucket_linkage.write(tmp_path, float(stroke), zero=zero)
        machine = quiet(crane.load, path)
        columns = [machine.column(joint) for joint in bucket_linkage.PASSIVE]
        four = bucket_linkage.assemblies(float(stroke), zero)
        at_home = [apart(a, machine.home[columns]) < 1e-9 for a in four].index(True)
        guess = machine.home + np.pi / 2  # which says nothing
        found = find_alternative_assembly_modes(
            machine.closure, guess, np.zeros(0, dtype=np.intp), 6
        )
        others = [[apart(a, x.q[columns]) < 1e-9 for a in four].index(True) for x in found]
        assert [x.loops for x in found] == [("eye",), ("pin",)]
        assert others[0] // 2 != at_home // 2  # the other triangle
        assert others[1] // 2 == at_home // 2 and others[1] != at_home


@pytest.mark.parametrize(
    "name", [*bundled_machines(), *sorted(path.name for path in DATA.glob("*.urdf"))]
)
def test_machines_that_say_so_cost_no_search(name):
    path = name if name in bundled_machines() else DATA / name
    machine = crane.load(path)
    with at_most(6_000):  # lines; one block of the linkage above takes 2,000
        again = find_alternative_assembly_modes(
            machine.closure, machine.home, np.zeros(0, dtype=np.intp), 100
        )
    assert again == []


def test_a_urdf_says_it_in_its_own_words(tmp_path):
    """The four-bar linkage with a rocker that is straight up at zero."""
    path = copy_machine(LOOPED, tmp_path)
    swap('rpy="0 0 1.4"', 'rpy="0 0 0"', LOOPED).apply(tmp_path)
    (finding,) = check(path).findings
    assert finding.message.startswith("loop 'pin' can be assembled another way at home")
    chosen = re.search(
        r'in <group_state name="home"> write (<.+?/>) for the other', finding.message
    )
    before = home_of(path)
    swap(
        "</robot>",
        f'<group_state name="home" group="all">{chosen[1]}</group_state></robot>',
        LOOPED,
    ).apply(tmp_path)
    assert check(path).findings == ()
    assert np.abs(home_of(path) - before).max() > 0.5


def home_of(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        return crane.load(path).home


def test_a_home_far_from_what_the_file_says_is_refused_unless_asked_for(tmp_path):
    """The nearest assembly is 0.9 rad off."""
    _, rocker, link, pin = bucket_linkage.assemblies(0.25, bucket_linkage.ZERO)[0]
    for off in (0.2, 0.9):
        said = f"  rocker: {rocker + off:.3f}\n  link: {link - off:.3f}\n  bucket: {pin:.3f}\n"
        path = bucket_linkage.write(tmp_path, 0.25, home=said)
        if off < 0.5:
            assert assembly(path, 0.25)[0] == 0
            continue
        with pytest.raises(CraneError) as caught:
            crane.load(path)
        assert re.match(
            r"bucket\.yaml:8: the loops close only far from the home of the file: \w+ is 0\.9 "
            r"rad off; at the home of the file loop 'pin' is 539 mm open, and would close with "
            r"no other length alone; correct home or the frames; if what was found is meant, "
            r"keep it with crane check --write-home, or take it with --arg nearest_assembly:=true",
            str(caught.value),
        )
        with pytest.warns(
            CraneWarning, match=r"searched for, because .* closes far off; the driven"
        ):
            crane.load(path, arguments={"nearest_assembly": True})
        assert "home written" in typed("check", path, "--write-home").stdout
        assert assembly(path, 0.25) == (0, [])


def test_the_sketch_shows_all_that_are_near(tmp_path):
    path = bucket_linkage.write(tmp_path, 0.25)
    done = typed("sketch", path, "--out", tmp_path / "all.svg")
    assert done.stdout.startswith(
        "dashed: 2 other assemblies that the file does not rule out; crane check shows how to "
        "choose\n"
    )
    drawn = (tmp_path / "all.svg").read_text()
    for index in (1, 2):
        assert f'id="assembly {index}"' in drawn and f"other assembly {index}" in drawn
    values = bucket_linkage.assemblies(0.25)[0]
    home = lines(
        ", ".join(f"{x}: {v:.3f}" for x, v in zip(bucket_linkage.PASSIVE, values, strict=True))
    )
    path = bucket_linkage.write(tmp_path, 0.25, home=home)
    done = typed("sketch", path, "--out", tmp_path / "one.svg")
    assert "dashed" not in done.stdout
    assert "assembly" not in (tmp_path / "one.svg").read_text()


def test_machines_without_masses_are_told_of_other_assemblies(tmp_path):
    path = bucket_linkage.write(tmp_path, 0.25)
    urdf = tmp_path / "bucket_linkage.urdf"
    urdf.write_text(re.sub(r"<inertial>.*?</inertial>", "", urdf.read_text()))
    told = [finding.message for finding in check(path).findings]
    assert sum("can be assembled another way" in what for what in told) == 2
