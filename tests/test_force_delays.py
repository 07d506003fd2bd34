"""Forces that are late or early: found with their deviation, told, and taken out."""

import numpy as np
import pytest
import spinning_arm
from command_line import typed
from warned import told

import crane
from crane.common.errors import InputError
from crane.recordings import shift_columns


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return spinning_arm.load(tmp_path_factory.mktemp("arm"))


@pytest.mark.parametrize("seconds", [-0.06, -0.03, -0.008, 0.008, 0.03])
def test_forces_that_are_late_or_early_are_told(arm, seconds):
    given = spinning_arm.recording(arm, seconds)
    result, (line,) = told(lambda: crane.identify(arm, given))
    np.testing.assert_allclose(result.delays[0].seconds, seconds, rtol=0, atol=3e-4)
    side = "behind" if seconds > 0 else "ahead of"
    assert line.startswith("'ja_force' is ") and f" ms (+- 0.04) {side} its motion" in line
    found = result.delays[0].seconds
    mean = found @ result.delays[0].std ** -2 / (result.delays[0].std ** -2).sum()
    assert f"(--shift '*_force={mean:.3g}', in Python crane.recordings.shift_columns)" in line
    # as it says
    shifted = shift_columns(given, {"*_force": mean})
    again, lines = told(lambda: crane.identify(arm, shifted))
    values = dict(zip(again.names, again.values, strict=True))
    assert lines == []
    for i, joint in enumerate(arm.active):
        assert values[f"{joint}.coulomb"] == pytest.approx(spinning_arm.COULOMB[i], rel=0.03)
        assert values[f"{joint}.viscous"] == pytest.approx(spinning_arm.VISCOUS[i], rel=0.05)


def test_each_recording_is_told_apart(arm):
    given = [spinning_arm.recording(arm), spinning_arm.recording(arm, 0.03, seed=1)]
    result, (line,) = told(lambda: crane.identify(arm, given))
    assert "behind its motion" in line and line == result.delays[1].warning
    assert not result.delays[0].warning


def test_forces_on_time_are_not(arm):
    for seed in range(5):
        assert (
            told(lambda s=seed: crane.identify(arm, spinning_arm.recording(arm, seed=s)))[1] == []
        )


@pytest.mark.parametrize(("delay", "noise"), [(-0.03, (1e-4, 0.3)), (0.012, (5e-4, 0.5))])
def test_the_deviation_is_that_of_twenty_recordings(arm, delay, noise):
    off = []
    for seed in range(20):
        given = spinning_arm.recording(arm, delay, noise, seed, friction=False)
        found, _ = told(lambda given=given: crane.identify(arm, given).delays[0])
        off.append((found.seconds - delay) / found.std)
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    # of 20 normal numbers, 0.74 to 1.27 in 90 %, those of a t distribution are larger
    assert (rms > 0.65).all() and (rms < 1.6).all()


def test_nothing_hides_a_delay(arm, tmp_path):
    """Negative friction comes of the delay: feasible parameters are not proposed for it."""
    given = spinning_arm.recording(arm, -0.03)
    given.to_csv(tmp_path / "early.csv")
    result, _ = told(lambda: crane.identify(arm, given, prior=0.3))
    assert result.parameters[result.model.names.index("ja.viscous")] < -1
    with pytest.raises(InputError) as caught:
        crane.identification.write_identified(result, tmp_path / "out")
    text = str(caught.value)
    assert text.startswith("'ja': viscous of friction is -2.") and "feasible" not in text
    assert text.endswith("ahead of its motion, take that out first")
    command = ["identify", arm.path, tmp_path / "early.csv", "--prior", "0.3"]
    one, two, three = (
        typed(*command, *options, "--out", tmp_path / f"{i}")
        for i, options in enumerate(
            ((), ("--shift", "*_force=-0.03"), ("--shift", "ja_torque=-0.03"))
        )
    )
    assert one.returncode == 0 and "ahead of its motion" in one.stderr
    assert "feasible" not in one.stdout + one.stderr
    assert two.returncode == 0 and two.stderr == "" and list(tmp_path.glob("1/machine/*.yaml"))
    assert three.stderr.startswith(
        "error: no column to shift is named 'ja_torque', known: ja, ja_f"
    )
    assert three.returncode == 2


def test_columns_are_shifted_exactly(arm):
    """A line stays one; the time that is left is that which both columns cover."""
    time = 0.01 * np.arange(200)
    line = np.column_stack([time, 2 * time])
    given = crane.Recording(time, arm.active, line, 0 * line, line, {"ja": "rad", "jb": "rad"})
    found = shift_columns(given, {"ja_force": 0.025, "jb*": -0.013})
    assert found.time[0] >= 0.013 and found.time[-1] <= 1.99 - 0.025
    assert len(found.time) == len(time) - 2 - 3
    np.testing.assert_allclose(found["ja_force"], found.time + 0.025, rtol=1e-14)
    for name in ("jb", "jb_force"):
        np.testing.assert_allclose(found[name], 2 * (found.time - 0.013), rtol=1e-14)
    np.testing.assert_array_equal(found["ja"], found.time)
    with pytest.raises(crane.CraneError, match="nothing is left of a recording"):
        shift_columns(given, {"ja": 5.0})
