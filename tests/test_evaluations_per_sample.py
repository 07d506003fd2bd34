"""Number of times that a sample is read, closed and evaluated during identification."""

import numpy as np
import pytest
from executed_lines import passes
from forwarder_motions import motion

import crane
from crane.dynamics import Dynamics
from crane.identification.mechanics import force_delays
from crane.identification.mechanics.force_delays import ForceDelays
from crane.identification.mechanics.identify import identify
from crane.identification.mechanics.identify_payload import identify_payload
from crane.recordings import Recording
from crane.recordings.measured_recordings import read_run

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")
ASIDE = 2000  # samples at random postures for the base parameters, and at home, about


@pytest.fixture(scope="module")
def mini():
    return crane.load("mini_forwarder")


@pytest.fixture(scope="module")
def recording(mini):
    given = motion(mini, duration=24.0)
    units = {joint: mini.unit(joint) for joint in mini.active}
    return Recording(given.time, mini.active, given.q, given.v, given.tau, units)


@pytest.fixture
def undelayed(monkeypatch):
    """Without the search for delays, which looks at samples of its own."""
    nothing = ForceDelays(("q1", "X1", "X2"), *np.full((3, 3), np.nan), 0)
    monkeypatch.setattr("crane.identification.mechanics.identify.force_delays", lambda *_: nothing)


def test_a_sample_is_closed_once_on_its_way_to_the_parameters(
    mini, recording, undelayed, monkeypatch
):
    N = len(recording.time)
    with passes(monkeypatch) as count:
        identify(mini, recording, feasible=True)
    assert set(count) == {"closed", "regressor"}
    assert N <= count["closed"] <= N + ASIDE
    assert N <= count["regressor"] <= N + ASIDE


def test_delays_are_looked_for_in_few_samples(mini, recording, monkeypatch):
    N = len(recording.time)
    with passes(monkeypatch) as count:
        identify(mini, recording)
    assert count["closed"] <= N + min(force_delays._MAX_SAMPLES, N) + ASIDE


def test_a_sample_is_closed_once_on_its_way_to_the_payload(mini, recording, monkeypatch):
    """Forces of the machine and of the load are computed at the same closed configurations."""
    N = len(recording.time)
    with passes(monkeypatch) as count:
        identify_payload(mini, recording)
    assert N <= count["closed"] <= N + ASIDE
    assert N <= count["inverse with friction"] <= N + ASIDE
    assert N <= count["regressor"] <= N + ASIDE


def test_strokes_from_angles_are_closed_twice(mini, recording, tmp_path, monkeypatch):
    """Closed once from angles to strokes, once back to verify that strokes give the angles."""
    N, q = len(recording.time), mini.closure.solve(recording.q)
    columns = {"time [s]": recording.time}
    columns |= {f"{x} [rad]": q[:, mini.column(x)] for x in ("q1", "q2", "q3")}
    for i, joint in enumerate(mini.active):
        columns[f"{joint}_force [{'N m' if i == 0 else 'N'}]"] = recording.tau[:, i]
    np.savez(tmp_path / "angles.npz", **columns)
    with passes(monkeypatch) as count:
        read = read_run(tmp_path / "angles.npz", mini)
    assert np.abs(read.q - recording.q).max() < 1e-9
    assert set(count) == {"closed"} and 2 * N <= count["closed"] <= 2 * N + 2 * ASIDE + 2000


def test_a_file_is_read_once(mini, recording, tmp_path, monkeypatch):
    """Also one that its machine completes, which the file names: by pressures without a force."""
    parsed, load = [], np.loadtxt
    monkeypatch.setattr(np, "loadtxt", lambda *a, **k: parsed.append(a) or load(*a, **k))
    plain, named = tmp_path / "plain.csv", tmp_path / "named.csv"
    recording.to_csv(plain)
    head, *rows = [x for x in plain.read_text().splitlines() if not x.startswith("#")]
    rows = [f"{head},pressure_pump_a [Pa]", *(f"{row},1e5" for row in rows)]
    named.write_text("\n".join(["# machine: mini_forwarder", *rows]))
    for file, machine in ((plain, mini), (plain, None), (named, mini), (named, None)):
        parsed.clear()
        assert np.array_equal(read_run(file, machine).q, recording.q)
        assert len(parsed) == -(-len(recording.time) // 4096)  # blocks, once each


@pytest.mark.parametrize("backend", ["compiled", "pinocchio"])
def test_quantities_at_closed_postures_are_those_of_their_strokes(mini, backend):
    given, dynamics = motion(mini, duration=0.2), Dynamics(mini, backend=backend)
    q = mini.closure.solve(given.q)
    found = dynamics.evaluate_closed("inverse with friction", q, given.v, given.a)
    wanted = dynamics.inverse(given.q, given.v, given.a, friction=True)
    assert np.abs(found - wanted).max() < 1e-12 * np.abs(wanted).max()
    one = dynamics.evaluate_closed("inverse with friction", q[3], given.v[3], given.a[3])
    assert np.abs(one - found[3]).max() <= 1e-14 * np.abs(wanted).max()
    # columns of a table that was solved or transposed stand the other way round
    turned = dynamics.evaluate_closed(
        "inverse with friction", *map(np.asfortranarray, (q, given.v, given.a))
    )
    np.testing.assert_array_equal(turned, found)
