"""Angles of joints that turn on, recorded within one revolution."""

import dataclasses
import warnings

import numpy as np
import pytest
import spinning_arm
from command_line import typed

import crane
from crane.common.errors import CraneWarning
from crane.identification.mechanics.smoothed_motion import smoothed_motion
from crane.recordings.angle_unwrapping import unwrap_angles
from crane.recordings.measured_recordings import read_run


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return spinning_arm.load(tmp_path_factory.mktemp("arm"))


def wrapped(recording, low=-np.pi):
    q = recording.q.copy()
    q[:, 0] = (q[:, 0] - low) % (2 * np.pi) + low
    return dataclasses.replace(recording, q=q, v=np.gradient(q, recording.time, axis=0))


@pytest.mark.parametrize("low", [-np.pi, 0.0])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_log_that_wraps_is_identified_as_one_that_does_not(arm, tmp_path, low, noise):
    """From memory and from a file, whose velocities are computed from the angles."""
    whole = spinning_arm.recording(arm, noise=(noise, 0.05))
    given = wrapped(whole, low)
    for name, recording in (("whole", whole), ("wrapped", given)):
        columns = [recording.time, *recording.q.T, *recording.tau.T]
        heading = "time [s],ja [rad],jb [rad],ja_force [N m],jb_force [N m]"
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack(columns), header=heading,
                   delimiter=",", comments="", fmt="%.17g")  # fmt: skip
    wanted = crane.identify(arm, whole)
    with pytest.warns(CraneWarning) as caught:
        found = crane.identify(arm, given)
    (line,) = {str(one.message) for one in caught}
    jumps = np.abs(np.diff(given.q[:, 0])) > 3
    assert line == (
        f"angles jump by a revolution and are made continuous: 'ja' {jumps.sum()} times "
        f"(the first at {given.time[jumps.argmax() + 1]:.6g} s)"
    )
    np.testing.assert_allclose(found.values, wanted.values, rtol=0, atol=1e-6)
    with pytest.warns(CraneWarning, match="angles jump by a revolution"):
        read = read_run(tmp_path / "wrapped.csv", arm)
    whole_turns = (read.q - whole.q)[:, 0] / (2 * np.pi)
    np.testing.assert_allclose(whole_turns, whole_turns[0].round(), atol=1e-12)
    np.testing.assert_allclose(read.v, read_run(tmp_path / "whole.csv", arm).v, atol=1e-9)
    done = typed("identify", arm.path, tmp_path / "wrapped.csv", "--out", tmp_path / "out")
    assert done.returncode == 0 and done.stderr.count("\n") == 1
    assert "made continuous" in done.stderr


def test_nothing_else_is_unwrapped(arm):
    """A joint with limits, jumps of other sizes, and an angle of several revolutions."""
    time = 0.01 * np.arange(1000)
    saw = (3 * time) % (2 * np.pi) - np.pi
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert unwrap_angles(arm, time, {"jb": saw, "other": saw}) == {}
        for angle in (0.7 * saw, np.where(time > 5, 3.0, -1.0) + 0.1 * np.sin(time), 1.3 * saw):
            assert unwrap_angles(arm, time, {"ja": angle}) == {}
        back = np.where(time < 5, time * (2 * np.pi + 0.5) / 5, 0.5)  # after more than one
        assert unwrap_angles(arm, time, {"ja": back}) == {}
        # a jolt of a revolution in an angle of several
        jolted = 3 * time + np.where((time > 4) & (time < 4.02), 2 * np.pi, 0.0)
        assert unwrap_angles(arm, time, {"ja": jolted}) == {}
    with pytest.warns(CraneWarning, match="'ja' 4 times"):
        (found,) = unwrap_angles(arm, time, {"ja": saw, "jb": saw}).values()
    np.testing.assert_allclose(found, 3 * time - np.pi, atol=1e-12)


def test_a_derived_velocity_is_not_blamed(arm):
    """An angle that jumps by 4.5 rad is not compared with its own derivative."""
    given = spinning_arm.recording(arm)
    q = given.q.copy()
    q[:, 0] = np.sin(given.time) + 4.5 * (np.floor(given.time / 5) % 2)
    spoilt = dataclasses.replace(given, q=q, v=np.gradient(q, given.time, axis=0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        smoothed_motion(arm, spoilt)
    recorded = dataclasses.replace(spoilt, v=spoilt.v[::-1])
    with pytest.raises(crane.CraneError, match="'ja_velocity' is not the derivative of 'ja'"):
        smoothed_motion(arm, recorded)
