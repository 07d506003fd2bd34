"""Identification from sway: rows of free joints, whose force is zero."""

import warnings

import hanging_loads
import numpy as np
import pytest
from command_line import typed

import crane
from crane.common.errors import CraneError, CraneWarning
from crane.control import ComputedTorque


class Sines(crane.motion.Trajectory):
    """Both driven joints, each by three sines."""

    duration, tip = 10.0, None
    middle = np.array([0.2, 0.3])
    size = np.array([[0.3, 0.1, 0.05], [0.1, 0.05, 0.03]])
    rate = np.array([[0.7, 1.3, 2.9], [0.9, 1.7, 2.3]])
    phase = np.array([[0.0, 1.0, 2.0], [0.5, 1.5, 2.5]])

    def __init__(self):
        pass

    def position(self, time):
        return self.middle + self._derivative(0, time)

    def _derivative(self, order, time):
        angle = self.rate * np.asarray(time)[..., None, None] + self.phase + order * np.pi / 2
        return (self.size * self.rate**order * np.sin(angle)).sum(axis=-1)

    def bounds(self):
        reach = self.size.sum(axis=1)
        return self.middle - reach, self.middle + reach

    def extremum_times(self):
        return np.linspace(0, self.duration, 100)

    def breaks(self):
        return np.array([0.0, self.duration])


def noisy(run, angle, force=0.0, seed=1):
    """Angles with noise [rad], forces with a share of 1 kN m; velocities not recorded."""
    random = np.random.default_rng(seed)
    q = run.q + angle * random.normal(size=run.q.shape)
    tau = run.tau + 1e3 * force * random.normal(size=run.q.shape) * (run.tau != 0)
    return crane.Recording(run.time, run.joints, q, 0 * q, tau, run.units, free=run.free)


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    return crane.load(hanging_loads.file(tmp_path_factory.mktemp("sway")))


@pytest.fixture(scope="module")
def driven(machine):
    path = Sines()
    start = np.append(path.position(0.0), [0.7, 0.3]), np.append(path.velocity(0.0), [0, 0])
    return crane.simulate(machine, ComputedTorque(machine, path), initial=start, step=2e-3)


def identified(*arguments, **named):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)  # of what this short motion tells badly
        return crane.identify(*arguments, **named)


def test_without_noise_everything_is_found(machine, driven):
    found = identified(machine, noisy(driven, 0.0))
    assert found.values == pytest.approx(found.nominal, rel=1e-4, abs=1e-2)
    assert "swing_x.viscous" in found.names and "swing_x.coulomb" not in found.names
    assert "free" in found.to_text()


@pytest.mark.parametrize(("angle", "force"), [(1e-4, 0.01), (1e-3, 0.05)])
def test_noise_in_the_sway_biases_nothing(machine, driven, angle, force):
    """As far off as said: |estimate - truth| in standard deviations, and sharp on the grapple."""
    found = identified(machine, noisy(driven, angle, force))
    off = (found.values - found.nominal) / found.std
    assert np.sqrt(np.mean(off**2)) < 1.6 and np.abs(off).max() < 4.5
    values = dict(zip(found.names, zip(found.values, found.nominal, strict=True), strict=True))
    for name, share in (("grapple.mz", 0.01), ("swing_y.viscous", 0.01), ("grapple.Ixx", 0.01)):
        value, truth = values[name]
        assert value == pytest.approx(truth, rel=share)


@pytest.mark.parametrize("how", [{"method": "huber"}, {"feasible": True}, {"prior": 0.3}])
def test_every_estimator_takes_sway(machine, driven, how):
    found = identified(machine, noisy(driven, 1e-4, 0.01), **how)
    values = dict(zip(found.names, zip(found.values, found.nominal, strict=True), strict=True))
    for name in ("grapple.mz", "grapple.Ixx", "swing_y.viscous"):
        value, truth = values[name]
        assert value == pytest.approx(truth, rel=0.01)


def still(machine, **changes):
    return crane.load(machine.path, lock={"slew": 0.2, "lift": 0.3}, changes=changes)


@pytest.mark.slow
def test_sway_alone_tells_ratios(machine):
    """Where all drives stand still: lengths of the pendulum, whatever the mass is said to be."""
    stands = still(machine)
    assert stands.free == stands.active == ("swing_x", "swing_y")
    run = crane.simulate(stands, initial=([0.9, 0.5], [0, 0]), duration=20.0, step=2e-3)
    with pytest.raises(CraneError) as caught:
        crane.identify(stands, noisy(run, 1e-4))
    assert str(caught.value).startswith(
        "nothing drives what moves in this recording: it determines ratios of masses only; give "
        "a prior of one mass, as prior={'grapple.m': "
    )
    for angle, share in ((0.0, 1e-5), (1e-4, 0.01)):
        for scale in (1.0, 2.0):  # of all masses
            prior = {"bodies": "1000 %", "grapple.mz": f"{-108 * scale} +- 0.1"}
            found = identified(stands, noisy(run, angle), prior=prior)
            values = dict(zip(found.names, found.values, strict=True))
            truth = dict(zip(found.names, found.nominal, strict=True))
            assert values["grapple.mz"] == pytest.approx(-108 * scale, rel=3e-3)
            for name in ("grapple.Iyy", "grapple.Ixx", "grapple.mx", "swing_x.viscous"):
                ratio = truth[name] / truth["grapple.mz"]
                assert values[name] / values["grapple.mz"] == pytest.approx(ratio, rel=share)


def test_sway_tells_a_load(machine):
    """Mass and centre of what the grapple holds, of a machine that is known; no force measured."""
    heavy = still(machine, **{"payload.mass": 120.0})
    run = crane.simulate(heavy, initial=([0.9, 0.5], [0, 0]), duration=20.0, step=2e-3)
    for angle, share in ((0.0, 1e-4), (2e-4, 0.02)):
        found = crane.identification.identify_payload(
            still(machine), noisy(run, angle), inertia=False
        )
        assert found.mass == pytest.approx(120.0, rel=share)


@pytest.mark.slow
def test_files_need_no_column_of_force(machine, driven, tmp_path):
    """A log without forces of free joints, read for the machine; one that names them channels."""
    path, table = tmp_path / "log.csv", noisy(driven, 0.0)
    columns = table.columns()
    kept = [x for x in columns if not x.endswith("_velocity")]
    units = {"time": "s", "slew_force": "N m", "lift_force": "N m"}
    rows = np.column_stack([columns[x] for x in kept])[::2]
    head = ",".join(f"{x} [{units.get(x, 'rad')}]" for x in kept)
    np.savetxt(path, rows, delimiter=",", header=head, comments="", fmt="%.15g")
    read = crane.recordings.read_measured(machine, path)
    assert read.free == machine.free
    plain = crane.Recording.from_csv(path)
    assert plain.joints == ("slew", "lift") and "swing_x" in plain.channels
    one, two = identified(machine, read), identified(machine, plain)
    assert one.values == pytest.approx(two.values, rel=1e-12)
    assert one.values == pytest.approx(one.nominal, rel=1e-3, abs=0.1)
    out = tmp_path / "found"
    done = typed("identify", machine.path, path, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "swing_x" in done.stdout
