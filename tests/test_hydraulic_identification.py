"""Valves, oil and cylinder friction identified from independently simulated recordings."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import crane
from crane.common.errors import InputError, RecordingError
from crane.hydraulics.components import CounterbalanceValve
from crane.identification.hydraulics.cylinder_equations import (
    OrificeEquations,
    WeakFormWindows,
    chamber_terms,
    cylinder_signals,
    noise_std,
)
from crane.identification.hydraulics.cylinder_friction import (
    identify_cylinder_friction,
)
from crane.identification.hydraulics.orifice_coefficients import identify_orifices
from crane.identification.hydraulics.valve_curve import identify_valve
from crane.identification.signals.signal_quality import steady_means, steady_samples

pytestmark = pytest.mark.slow

# A lift of 8 t on one cylinder of the size of a forestry crane's; equations (21) to (23) below.
MASS, LOAD, STROKE, LOWER = 8000.0, 40e3, 0.5, -0.1
AREA_A, AREA_B, HOSE_A, HOSE_B = 7.854e-3, 5.391e-3, 0.8e-3, 0.9e-3
SUPPLY, TANK, BETA = 180e5, 2e5, 1.1e9
C1, C2, C3, C4 = 8.0e-7, 7.0e-7, 6.0e-7, 9.0e-7
X = np.array([1 / BETA, C1, C2, C3, C4])
NEUTRAL, FULL, DEAD = 6.0, 3.0, 0.1

# Sensors: pressures of 250 bar full scale with 0.08 % of it as noise and 12 bit, stroke 0.1 mm,
# signal 5 mV: industrial ones
NOISE = {"pressure": 2e4, "stroke": 1e-4, "voltage": 5e-3}
BITS = 250e5 / 4096

URDF = """<robot name="lift"><link name="base"/>
<link name="load"><inertial><mass value="8000"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="boom" type="prismatic"><parent link="base"/><child link="load"/><axis xyz="0 0 1"/>
<limit lower="-0.1" upper="0.4" effort="1e6" velocity="1"/></joint></robot>"""
YAML = """name: lift
chains: [{name: a, urdf: lift.urdf}]
active: [boom]
friction: {boom: {coulomb: 1, smoothing: 2.0e-4}}
hydraulics:
  supply: {pressure: 180.0e5, tank: 2.0e5}
  cylinders:
    boom: {area_a: 7.854e-3, area_b: 5.391e-3, hose_a: 0.8e-3, hose_b: 0.9e-3}
  valves:
    boom: VALVE
"""
ORIFICE = (
    "{type: orifice, c1: 1.0e-7, c2: 1.0e-7, c3: 1.0e-7, c4: 1.0e-7, neutral: 6.0, full: 3.0, "
    "dead_band: 0.1}"
)
COMPENSATED = "{type: compensated, flow: 1.0e-3, margin: 7.0e5, neutral: 6.0, full: 3.0}"


def loaded(folder, valve):
    (folder / "lift.urdf").write_text(URDF)
    (folder / "lift.yaml").write_text(YAML.replace("VALVE", valve))
    return crane.load(folder / "lift.yaml")


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    return loaded(tmp_path_factory.mktemp("orifice"), ORIFICE)


@pytest.fixture(scope="module")
def compensated(tmp_path_factory):
    return loaded(tmp_path_factory.mktemp("compensated"), COMPENSATED)


def with_parts(machine, cylinder=None, valve=None):
    """The machine with some numbers of its cylinder and valve changed."""
    circuit = machine.hydraulics
    changed = dataclasses.replace(
        circuit,
        cylinders={"boom": dataclasses.replace(circuit.cylinders["boom"], **(cylinder or {}))},
        valves={"boom": dataclasses.replace(circuit.valves["boom"], **(valve or {}))},
    )
    return dataclasses.replace(machine, hydraulics=changed)


# --- the cylinder, written down once more --------------------------------------------------


def multisine(centre, amplitudes, frequencies, phases):
    amplitudes, phases = np.array(amplitudes), np.array(phases)
    w = 2 * np.pi * np.array(frequencies)

    def reference(t):
        angle = w * t + phases
        return centre + amplitudes @ np.sin(angle), (amplitudes * w) @ np.cos(angle)

    return reference


def root(drop):
    return np.copysign(np.sqrt(np.abs(drop)), drop)


def simulate(reference, end, step, spool=0.0):
    """PD (37) past the dead band, flows (21), (22), chambers (23), a mass with friction.

    Columns time, x, v, p_A, p_B and the signal's wanted opening; `spool` [rad/s] makes the
    opening follow with damping 0.8.
    """

    def asked(t, x):
        wanted, rate = reference(t)
        return float(np.clip(4.0 * (wanted - x) + 3.0 * rate, -1, 1))

    def rates(t, state):
        x, v, p_a, p_b, y, y_rate = state
        if not spool:
            y = asked(t, x)
        if y >= 0:
            q_a, q_b = C1 * y * root(SUPPLY - p_a), -C2 * y * root(p_b - TANK)
        else:
            q_a, q_b = C3 * y * root(p_a - TANK), -C4 * y * root(SUPPLY - p_b)
        force = AREA_A * p_a - AREA_B * p_b - LOAD - 2e3 * np.tanh(v / 5e-3) - 2e4 * v
        return [
            v,
            force / MASS,
            BETA / (HOSE_A + AREA_A * x) * (q_a - AREA_A * v),
            BETA / (HOSE_B + AREA_B * (STROKE - x)) * (q_b + AREA_B * v),
            y_rate if spool else 0.0,
            spool**2 * (asked(t, x) - y) - 1.6 * spool * y_rate if spool else 0.0,
        ]

    x0 = reference(0)[0]
    start = [x0, 0.0, (LOAD + AREA_B * 30e5) / AREA_A, 30e5, asked(0, x0), 0.0]
    time = np.arange(round(end / step) + 1) * step
    solved = solve_ivp(
        rates, (0, end), start, "DOP853", time, rtol=1e-11, max_step=4e-3,
        atol=[1e-12, 1e-12, 1e-4, 1e-4, 1e-12, 1e-9],
    )  # fmt: skip
    assert solved.success
    x, v, p_a, p_b, *_ = solved.y
    return time, x, v, p_a, p_b, np.array([asked(t, x) for t, x in zip(time, x, strict=True)])


def voltage_of(y, dead=DEAD):
    return NEUTRAL + (FULL - NEUTRAL) * np.sign(y) * (dead + (1 - dead) * np.abs(y))


def recorded(data, noise=0.0, rng=None, bits=0.0, dead=DEAD, **extra):
    """A recording with white noise of `noise` times NOISE."""
    time, x, v, p_a, p_b, y = data

    def sensor(values, kind):
        values = np.broadcast_to(values, time.shape)
        if noise:
            values = values + noise * NOISE[kind] * rng.standard_normal(len(time))
        return np.round(values / bits) * bits if bits and kind == "pressure" else values

    pressures = [sensor(p, "pressure") for p in (p_a, p_b, SUPPLY, TANK)]
    channels = {
        "voltage_boom": sensor(voltage_of(y, dead), "voltage"),
        "pressure_boom_a": pressures[0],
        "pressure_boom_b": pressures[1],
        "pressure_supply": pressures[2],
        "pressure_tank": pressures[3],
    }
    return recording(
        time, LOWER + sensor(x, "stroke"), v, AREA_A * pressures[0] - AREA_B * pressures[1],
        **channels | extra,
    )  # fmt: skip


def recording(time, q, v, tau, **channels):
    return crane.Recording(
        time=time, joints=("boom",), q=q[:, None], v=v[:, None], tau=tau[:, None],
        units={"boom": "m"}, channels=channels,
    )  # fmt: skip


@pytest.fixture(scope="module")
def quick():
    """20 s over most of the stroke, 0.12 m/s, with the oil's oscillation at the start."""
    return simulate(multisine(0.25, [0.15, 0.03, 0.004], [0.05, 0.25, 1.3], [0.3, 1, 2]), 20, 1e-3)


@pytest.fixture(scope="module")
def other():
    """Another motion, to judge on."""
    return simulate(multisine(0.25, [0.12, 0.04, 0.003], [0.1, 0.2, 1.7], [1.3, 0, 0.5]), 20, 1e-3)


@pytest.fixture(scope="module")
def slow():
    """As slow as the paper's: 0.03 m/s, |u| up to 0.1; two periods of 40 s, the second settled."""
    return simulate(
        multisine(0.25, [0.12, 0.015, 0.002], [1 / 40, 0.1, 0.4], [0.3, 1, 2]), 80, 5e-3
    )


# --- orifices and oil: (29) to (32) --------------------------------------------------------


@pytest.mark.parametrize("method", ["weak", "chambers"])
def test_parameters_without_noise(machine, quick, other, method):
    # kinks at sign changes, test functions and sums: nothing of them may be left
    found = identify_orifices(machine, recorded(quick), "boom", method)
    np.testing.assert_allclose(found.values, X, rtol=1e-8)
    judged = found.predict(recorded(other))
    assert judged.relative_error < 1e-5 and found.training_sides[0].relative_error < 1e-5
    assert found.bulk_modulus == pytest.approx(BETA, rel=1e-8)
    assert len(judged.time) == len(judged.predicted) == len(judged.measured) > 500


@pytest.mark.parametrize("method", ["weak", "chambers", "ls"])
def test_rows_of_a_recording_are_made_once(machine, quick, method, monkeypatch):
    """And what both chambers' equations say together is (29)."""
    made, init = [], OrificeEquations.__init__
    monkeypatch.setattr(OrificeEquations, "__init__", lambda *a: made.append(a) or init(*a))
    run = recorded(quick)
    found = identify_orifices(machine, run, "boom", method)
    assert len(made) == 1
    (both,), alone = found.training_sides, found.predict(run)
    assert len(made) == 2
    for name in ("time", "predicted", "measured"):
        one, other = getattr(both, name), getattr(alone, name)
        assert np.abs(one - other).max() < 1e-12 * np.abs(other).max()


def test_the_paper_s_way_without_noise(machine, quick):
    found = identify_orifices(machine, recorded(quick), "boom", "ls")
    assert "misfit" not in found.to_text() and "nan" not in found.to_text()
    np.testing.assert_allclose(found.values, X, rtol=1e-4)


def test_several_recordings_count_together(machine, quick, other):
    rng = np.random.default_rng(0)
    runs = [recorded(data, 1.0, rng) for data in (quick, other)]
    one, both = (identify_orifices(machine, part, "boom") for part in (runs[0], runs))
    assert (both.std < 0.95 * one.std).all() and len(both.training_sides) == 2
    np.testing.assert_allclose(both.values[1:], X[1:], rtol=0.01)


def test_spool_channel_goes_before_voltage(machine, quick):
    y = quick[-1]
    spool = np.sign(y) * (DEAD + (1 - DEAD) * np.abs(y))
    right = recorded(quick, voltage_boom=0 * y, spool_boom=spool)
    np.testing.assert_allclose(identify_orifices(machine, right, "boom").values, X, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["weak", "chambers"])
def test_noise_like_the_paper_s(machine, slow, method):
    """Four periods of a slow motion, averaged, with 12 bit pressures."""
    count = round(40 / 5e-3)
    settled = [column[count : 2 * count] for column in slow]
    data = [np.tile(column, 4) for column in settled]
    data[0] = np.arange(4 * count) * 5e-3
    rng = np.random.default_rng(3)
    run = recorded(data, 1.0, rng, bits=BITS)
    found = identify_orifices(machine, run, "boom", method, period=40.0)
    np.testing.assert_allclose(found.values[1:], X[1:], rtol=0.05)
    low, high = found.confidence_interval().T
    assert ((low < X) & (high > X)).all()
    judged = found.predict(recorded([c[:count] for c in slow]))
    assert judged.relative_error < 0.01
    assert 0.7 < found.misfit < 1.5  # quantisation adds little to this noise


@pytest.mark.slow
@pytest.mark.parametrize("method", ["weak", "chambers"])
def test_intervals_cover_and_nothing_is_biased(machine, quick, method):
    data = [column[::5] for column in quick]
    rng, draws = np.random.default_rng(5), 80
    errors, inside = np.empty((draws, 5)), np.empty((draws, 5))
    for i in range(draws):
        found = identify_orifices(machine, recorded(data, 1.0, rng), "boom", method)
        low, high = found.confidence_interval().T
        errors[i], inside[i] = found.values / X - 1, (low < X) & (high > X)
    cover = inside.mean(axis=0)
    assert (cover >= 0.88).all() and (cover <= 0.995).all(), cover
    deviation = errors.std(axis=0)
    bias = np.abs(errors.mean(axis=0))
    assert (bias < 3.5 * deviation / np.sqrt(draws)).all()
    assert (bias[1:] < 1e-3).all() and bias[0] < 0.03


def test_least_squares_on_derivatives_is_biased(machine, quick):
    """Least squares on derivatives is biased, so the weak form is the default.

    The stroke's smoother takes the oil's oscillation, 0.02 mm, for noise, the force's does not:
    F' on the left has no counterpart on the right, and 1/beta goes to zero.
    """
    data = [column[::5] for column in quick]
    run = recorded(data, 1.0, np.random.default_rng(5))
    plain, weak = (identify_orifices(machine, run, "boom", m) for m in ("ls", "weak"))
    assert plain.values[0] < 0.5 * X[0]
    assert abs(weak.values[0] / X[0] - 1) < 0.3


def test_chambers_tell_more_than_their_difference(machine, quick):
    run = recorded(quick, 1.0, np.random.default_rng(2))
    force, chambers = (identify_orifices(machine, run, "boom", m) for m in ("weak", "chambers"))
    assert (chambers.std < 0.6 * force.std).all()
    assert chambers.condition < 2 < force.condition < 10


def test_model_error_widens_intervals(machine, quick):
    """A supply sensor 30 bar off bends the roots, which is no white noise."""
    run = recorded(quick, 1.0, np.random.default_rng(2))
    bent = run.channels | {"pressure_supply": run.channels["pressure_supply"] - 30e5}
    wrong = dataclasses.replace(run, channels=bent)
    right, off = (identify_orifices(machine, one, "boom") for one in (run, wrong))
    assert right.misfit < 1.1 and off.misfit > 1.5
    assert (off.std[1:] > 1.5 * right.std[1:]).all()


def test_spool_dynamics(machine):
    """Signal through the spool's second order, as it was recorded; without it c are wrong."""
    reference = multisine(0.25, [0.1, 0.03, 0.004], [0.1, 0.4, 1.9], [0.3, 1, 2])
    run = recorded(simulate(reference, 10, 1e-3, spool=60.0), dead=0.0)
    lagging = with_parts(machine, valve={"bandwidth": 60.0, "damping": 0.8, "dead_band": 0.0})
    at_once = with_parts(machine, valve={"dead_band": 0.0})
    found = identify_orifices(lagging, run, "boom", "chambers")
    np.testing.assert_allclose(found.values, X, rtol=1e-4)
    ignoring = identify_orifices(at_once, run, "boom", "chambers")
    assert np.abs(ignoring.values / X - 1).max() > 0.02


def one_way(quick, sense):
    """The longest stretch with the valve open to one side, or the other."""
    runs = np.split(np.arange(len(quick[0])), np.flatnonzero(np.diff(np.sign(quick[-1]))) + 1)
    longest = max((r for r in runs if sense * quick[-1][r[0]] > 0), key=len)
    return [column[longest] for column in quick]


@pytest.mark.parametrize(
    ("sense", "line"),
    [(1, "c3 and c4 of 'boom' cannot be determined: .*record retracting motion"),
     (-1, "c1 and c2 of 'boom' cannot be determined: .*record extending motion")],
)  # fmt: skip
def test_one_direction_is_refused(machine, quick, sense, line):
    with pytest.raises(InputError, match=line):
        identify_orifices(machine, recorded(one_way(quick, sense)), "boom")


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("method", ["weak", "chambers", "ls"])
def test_constant_pressures_do_not_tell_beta(machine, noise, method):
    # up and down at constant speed, to which constant pressures belong
    time = np.arange(0, 20, 2e-3)
    y = 0.1 * np.sign(np.sin(0.1 * np.pi * time + 0.01))
    p_a, p_b = np.full_like(time, 100e5), np.full_like(time, 60e5)
    v = 0.02 * np.sign(y)
    data = time, 0.1 + np.cumsum(v) * 2e-3, v, p_a, p_b, y
    with pytest.raises(InputError, match="1/beta of 'boom' cannot be determined: .*record faster"):
        identify_orifices(machine, recorded(data, noise, np.random.default_rng(1)), "boom", method)


def test_short_strokes_do_not_tell_c1_from_c2(machine):
    reference = multisine(0.25, [0.004, 0.001], [0.5, 1.3], [0.3, 1])
    rng = np.random.default_rng(4)
    run = recorded(simulate(reference, 6, 2e-3), 1.0, rng)
    run = dataclasses.replace(run, q=run.q + 2e-3 * rng.standard_normal(run.q.shape))
    with pytest.raises(InputError, match="cannot be separated along 0.2.*'chambers'"):
        identify_orifices(machine, run, "boom")
    found = identify_orifices(machine, run, "boom", "chambers")
    np.testing.assert_allclose(found.values[1:], X[1:], rtol=0.25)


def test_flows_at_reversed_pressure_differences(machine):
    """Signed roots: oil flows back, and nothing is nan; a compensator lets none back."""
    time = np.arange(100) * 1e-3
    one = np.ones(100)
    run = recorded((time, 0.2 * one, 0 * one, (SUPPLY + 4e5) * one, (TANK - 9e4) * one, one))
    rows = chamber_terms(machine, "boom", cylinder_signals(machine, run, "boom"))[1]
    assert rows[0, 0, 0] * (HOSE_A + AREA_A * 0.2) == pytest.approx(np.sqrt(4e5))
    assert rows[1, 1, 0] * (HOSE_B + AREA_B * 0.3) == pytest.approx(-np.sqrt(9e4))
    assert (rows[:, 2:] == 0).all()
    kept = with_parts(machine, valve={"margin": 7e5})
    assert (chamber_terms(kept, "boom", cylinder_signals(kept, run, "boom"))[1][0, 0] == 0).all()
    run = recorded((time, 0.2 * one, 0 * one, 50e5 * one, 50e5 * one, one))
    rows = chamber_terms(kept, "boom", cylinder_signals(kept, run, "boom"))[1]
    assert rows[0, 0, 0] * (HOSE_A + AREA_A * 0.2) == pytest.approx(-np.sqrt(7e5))


def holding(machine):
    valve = CounterbalanceValve(pressure=1e7, pilot_ratio=4, range=1e6, coefficient=1e-6)
    return with_parts(machine, cylinder={"counterbalance_a": valve})


def without(run, name):
    rest = {key: values for key, values in run.channels.items() if key != name}
    return dataclasses.replace(run, channels=rest, channel_units={})


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda m, r: (m, r, "tip", "weak"), "'tip' has no cylinder, known: boom"),
        (lambda m, r: (m, r, "boom", "lss"), "'lss' is unknown, did you mean 'ls'?"),
        (lambda m, r: (m, [], "boom", "weak"), "no recordings, give at least one"),
        (lambda m, r: (holding(m), r, "boom", "weak"), "counterbalance valve.*another cylinder"),
        (lambda m, r: (dataclasses.replace(m, hydraulics=None), r, "boom", "weak"),
         "'lift' has no hydraulics, add the section"),
        (lambda m, r: (m, without(r, "pressure_tank"), "boom", "weak"),
         "columns are missing: 'pressure_tank'"),
        (lambda m, r: (m, without(r, "voltage_boom"), "boom", "weak"),
         "columns are missing: 'voltage_boom' or 'spool_boom'"),
        (lambda m, r: (m, dataclasses.replace(r, channel_units={"pressure_boom_a": "bar"}),
                       "boom", "weak"), "'pressure_boom_a' is in bar, give Pa"),
        (lambda m, r: (m, dataclasses.replace(r, q=r.q + 0.4), "boom", "weak"),
         "'boom' goes from .* its limits are -0.1 and 0.4, check its zero"),
        (lambda m, r: (with_parts(m, valve={"bandwidth": 50.0, "rate": 0.01}), r, "boom", "weak"),
         "above its rate 0.01, record 'spool_boom'"),
    ],
)  # fmt: skip
def test_what_cannot_serve(machine, quick, change, line):
    machine, run, joint, method = change(machine, recorded(quick))
    with pytest.raises((InputError, RecordingError), match=line):
        identify_orifices(machine, run, joint, method)


def test_unknown_sensor(machine, quick):
    with pytest.raises(InputError, match="sensor 'p_c' is unknown, did you mean|known"):
        identify_orifices(machine, recorded(quick), "boom", noise={"p_c": 1.0})


# --- what it is made of --------------------------------------------------------------------


def test_windows_within_one_label():
    labels = np.zeros(1000)
    labels[430:] = 1
    w = WeakFormWindows.create(1000, 1e-3, 0.064)
    crossing = (w.centres - w.half_width < 430) & (w.centres + w.half_width >= 430)
    np.testing.assert_array_equal(w.are_uniform(labels), ~crossing)


def test_too_short_for_a_window():
    with pytest.raises(RecordingError, match="60 samples are fewer than the 65 of one window"):
        WeakFormWindows.create(60, 1e-2, 0.1)


def test_noise_level_sees_no_signal_and_no_jumps():
    rng = np.random.default_rng(0)
    time = np.arange(10000) * 1e-3
    signal = 1e6 * np.sin(20 * time) + 1e6 * (time > 5)
    noisy = signal + 2e3 * rng.standard_normal(10000)
    assert noise_std(noisy) == pytest.approx(2e3, rel=0.04)
    assert noise_std(signal) < 1.0


def test_steady_looks_back():
    time = np.arange(1000) * 1e-2
    step = (time >= 5).astype(float)
    kept = steady_samples(time, 0.5, step)
    assert not kept[:50].any() and kept[60:450].all() and kept[600:].all()
    assert not kept[500:545].any()
    with pytest.raises(RecordingError, match="no sample is steady for 0.5 s, record slower"):
        steady_samples(time, 0.5, np.sin(5 * time))
    with pytest.raises(InputError, match="settle is 0.01 s, give at least 0.02 s"):
        steady_samples(time, 0.01, step)


# --- compensated valve ---------------------------------------------------------------------

# a PVG32's: dead band 0.1143, 40 l/min at 3 V from the middle, which is at 5.8 V, not 6 V
MIDDLE, SHARE, FLOW = 5.8, 0.1143, np.array([40.0, 34.0]) / 6e4


def speed_of(U):
    u = (MIDDLE - U) / 3.0
    y = np.maximum((np.abs(u) - SHARE) / (1 - SHARE), 0)
    return np.where(u > 0, FLOW[0] * y / AREA_A, -FLOW[1] * y / AREA_B)


def driven(U, time, noise, rng, lag=0.05, speed=speed_of, **channels):
    """Speed that follows the signal with a lag."""
    from scipy.signal import lfilter

    share = np.exp(-(time[1] - time[0]) / lag)
    v = lfilter([1 - share], [1, -share], speed(U))
    if noise:
        v = v + noise * rng.standard_normal(len(time))
    q = np.full_like(time, 0.1)
    return recording(time, q, v, 0 * time, voltage_boom=U, **channels)


def staircase(time):
    levels = np.array([5.8, 5.5, 5.3, 5.0, 4.6, 4.2, 5.6, 6.0, 6.1, 6.3, 6.7, 7.1, 7.4, 5.9])
    return levels[np.minimum((time / 3).astype(int), len(levels) - 1)]


def ramps(time):
    return 5.8 + 1.6 * np.interp(time, [0, 40, 120, 160], [0, 1, -1, 0])


@pytest.mark.parametrize(("signal", "end"), [(staircase, 42), (ramps, 160)])
def test_valve_without_noise(compensated, signal, end):
    time = np.arange(0, end, 5e-3)
    found = identify_valve(compensated, driven(signal(time), time, 0, None), "boom")
    # a ramp's lag of 50 ms moves each edge by 2 mV, up and down oppositely
    assert found.neutral == pytest.approx(MIDDLE, abs=2e-3)
    assert found.dead_band == pytest.approx(SHARE, abs=1e-3)
    np.testing.assert_allclose(found.full_flows, FLOW, rtol=3e-3)
    assert found.values[0] == pytest.approx(MIDDLE - 3 * SHARE, abs=3e-3)
    assert found.values[1] == pytest.approx(MIDDLE + 3 * SHARE, abs=3e-3)
    grid = np.linspace(4.3, 7.3, 31)
    np.testing.assert_allclose(found.predict(grid), speed_of(grid), atol=4e-4)


@pytest.mark.slow
def test_valve_intervals_cover(compensated):
    time = np.arange(0, 42, 1e-2)
    U = staircase(time)
    rng, draws = np.random.default_rng(8), 150
    truth = {
        "neutral": MIDDLE, "dead_band": SHARE, "flow up": FLOW[0], "flow down": FLOW[1],
        "edge up": MIDDLE - 3 * SHARE, "edge down": MIDDLE + 3 * SHARE,
    }  # fmt: skip
    inside = dict.fromkeys(truth, 0)
    for _ in range(draws):
        table = identify_valve(
            compensated, driven(U, time, 5e-4, rng), "boom"
        ).parameter_intervals()
        for name, value in truth.items():
            inside[name] += table[name][1] < value < table[name][2]
    for name, count in inside.items():
        assert 0.88 <= count / draws <= 0.995, (name, count)


def test_valve_leaves_out_what_has_no_margin(compensated):
    """Supply too low for fast extending, and a load that runs ahead when retracting."""
    time = np.arange(0, 42, 5e-3)
    U, one = staircase(time), np.ones(len(time))

    def starved(U):
        v = speed_of(U)
        return np.where(v < -0.03, 1.6 * v, np.minimum(v, 0.035))

    v = starved(U)
    pressures = {
        "pressure_supply": 100e5 * one,
        "pressure_boom_a": np.where(v > 0.034, 96e5, 60e5),
        "pressure_boom_b": np.where(v < -0.03, 1e4, 30e5),
    }
    run = driven(U, time, 0, None, speed=starved)
    served = driven(U, time, 0, None, speed=starved, **pressures)
    found = identify_valve(compensated, served, "boom")
    np.testing.assert_allclose(found.full_flows, FLOW, rtol=3e-3)
    assert abs(identify_valve(compensated, run, "boom").full_flows[1] / FLOW[1] - 1) > 0.1


@pytest.mark.parametrize("sense", [1, -1])
def test_valve_needs_both_directions(compensated, sense):
    time = np.arange(0, 42, 1e-2)
    U = MIDDLE - sense * np.abs(staircase(time) - MIDDLE)
    word = "retracting" if sense > 0 else "extending"
    with pytest.raises(RecordingError, match=f"'boom' has no steady {word} at two signals"):
        identify_valve(compensated, driven(U, time, 0, None), "boom")


def long_steps(time):
    levels = np.array([5.8, 5.2, 4.6, 4.0, 5.8, 6.4, 7.0, 7.6])
    return levels[np.minimum((time / 12).astype(int), len(levels) - 1)]


@pytest.mark.parametrize("frequency", [1.37, 2.0, 3.1])
def test_valve_whose_load_rings(compensated, frequency):
    """Held for 12 s at a constant mean, about which the speed rings by a fifth of it."""
    time = np.arange(0, 96, 5e-3)
    U = long_steps(time)
    rng = np.random.default_rng(3)

    def ringing(U):
        return speed_of(U) * (1 + 0.2 * np.sin(2 * np.pi * frequency * time + 0.7))

    found = identify_valve(
        compensated, driven(U, time, 5e-4, rng, lag=1e-3, speed=ringing), "boom"
    )
    assert found.neutral == pytest.approx(MIDDLE, abs=3e-3)
    assert found.dead_band == pytest.approx(SHARE, abs=2e-3)
    np.testing.assert_allclose(found.full_flows, FLOW, rtol=5e-3)
    low, high, amplitude = found.ringing
    assert low == pytest.approx(frequency, rel=5e-3)
    assert high == pytest.approx(frequency, rel=5e-3)
    assert amplitude == pytest.approx(0.2 * np.abs(speed_of(U)).max(), rel=0.05)
    assert f"rings at {frequency:.3g}"[:11] in found.to_text()
    assert "means over its periods" in found.to_text()


def test_valve_whose_ringing_decays_below_ripple_of_the_sensor(compensated):
    """As the log crane's: 2 Hz decays within 12 s, below ripple of 5.7 Hz and of 13 Hz."""
    time = np.arange(0, 96, 1e-2)
    U = long_steps(time)
    rng = np.random.default_rng(4)
    ripple = 4e-3 * np.sin(2 * np.pi * 5.7 * time) + 0.01 * np.sin(2 * np.pi * 13 * time)

    def ringing(U):
        decay = np.exp(-(time % 12) / 20)
        return speed_of(U) * (1 + 0.3 * decay * np.sin(2 * np.pi * 2 * time)) + ripple

    run = driven(U, time, 5e-4, rng, lag=1e-3, speed=ringing)
    with pytest.raises(RecordingError, match="no sample is steady"):
        steady_samples(time, 0.5, U, run.v[:, 0])
    found = identify_valve(compensated, run, "boom")
    assert found.neutral == pytest.approx(MIDDLE, abs=5e-3)
    assert found.dead_band == pytest.approx(SHARE, abs=3e-3)
    np.testing.assert_allclose(found.full_flows, FLOW, rtol=0.01)
    low, high, _ = found.ringing
    assert low == pytest.approx(2.0, rel=0.02) and high == pytest.approx(5.7, rel=0.02)


def test_means_over_periods_leave_what_does_not_ring(compensated):
    """Noise, slow ramps and plain steps raise no warning of ringing."""
    time = np.arange(0, 42, 1e-2)
    run = driven(staircase(time), time, 5e-4, np.random.default_rng(0))
    found = identify_valve(compensated, run, "boom")
    assert found.ringing is None and "rings" not in found.to_text()
    U, v = run.channels["voltage_boom"], run.v[:, 0]
    means = steady_means(time, 0.5, U, v)
    np.testing.assert_array_equal(means.kept, steady_samples(time, 0.5, U, v))
    assert means.answer is v
    drift = np.where(time > 20, 0.05 * np.sin(0.3 * time), 0.0)  # no period within a held signal
    with pytest.raises(RecordingError, match="no sample is steady"):
        steady_means(time, 0.5, np.sin(5 * time), drift)


# --- friction ------------------------------------------------------------------------------

LAW = {"coulomb": 210.0, "coulomb_offset": 25.0, "viscous": 3300.0, "stiction": 90.0,
       "stribeck": 5e-3}  # fmt: skip


def friction_force(v, smoothing=2e-4):
    stick = LAW["coulomb"] + LAW["stiction"] * np.exp(-((v / LAW["stribeck"]) ** 2))
    return stick * np.tanh(v / smoothing) + LAW["coulomb_offset"] + LAW["viscous"] * v


def strokes(speeds, noise, rng, hold=4.0, step=5e-3):
    """Each speed up and down for `hold` seconds; (20) less (1) is friction."""
    knots, values = [0.0], [0.0]
    for speed in speeds:
        for sense in (1, -1):
            knots += [knots[-1] + 0.5, knots[-1] + 0.5 + hold, knots[-1] + 1 + hold]
            values += [sense * speed, sense * speed, 0.0]
    time = np.arange(0, knots[-1], step)
    fine = np.arange(0, knots[-1], step / 5)
    # rounded corners, so that acceleration is smooth
    bell = np.hanning(101) / np.hanning(101).sum()
    v_fine = np.convolve(np.interp(fine, knots, values), bell, mode="same")
    q_fine = -0.05 + np.concatenate([[0], np.cumsum(v_fine[1:] + v_fine[:-1]) * step / 10])
    a_fine = np.gradient(v_fine, fine)
    q, v, a = (x[::5][: len(time)] for x in (q_fine, v_fine, a_fine))
    force = MASS * (9.81 + a) + friction_force(v)
    if noise:
        force = force + noise * rng.standard_normal(len(time))
    return recording(time, q, v, force)


SPEEDS = [1e-3, 2e-3, 3e-3, 4.5e-3, 6e-3, 8e-3, 0.012, 0.02, 0.04, 0.06]


def test_friction_without_noise(machine):
    found = identify_cylinder_friction(machine, strokes(SPEEDS, 0, None), "boom")
    assert found.names == tuple(LAW) and not found.note
    np.testing.assert_allclose(found.values, list(LAW.values()), rtol=0.02)
    assert found.friction.smoothing == 2e-4
    assert found.friction.stiction == pytest.approx(90, rel=0.02)
    np.testing.assert_allclose(
        found.predict(np.array(SPEEDS)), friction_force(np.array(SPEEDS)), 5e-3
    )


@pytest.mark.slow
def test_friction_intervals_cover(machine):
    rng, draws = np.random.default_rng(2), 100
    inside = np.zeros(5)
    for _ in range(draws):
        run = strokes(SPEEDS, 60.0, rng, step=2e-2)
        low, high = (
            identify_cylinder_friction(machine, run, "boom", stribeck=True).confidence_interval().T
        )
        truth = np.array(list(LAW.values()))
        inside += (low < truth) & (truth < high)
    assert (inside >= 0.88 * draws).all() and (inside <= 0.995 * draws).all(), inside


def test_fast_speeds_tell_no_stiction(machine):
    found = identify_cylinder_friction(
        machine, strokes([0.02, 0.03, 0.045, 0.06], 0, None), "boom"
    )
    assert found.names == ("coulomb", "coulomb_offset", "viscous")
    assert "Coulomb and viscous friction only" in found.note and found.note in found.to_text()
    np.testing.assert_allclose(found.values, [210, 25, 3300], rtol=0.02)
    with pytest.raises(
        RecordingError, match="stiction of 'boom' cannot be determined: speeds from"
    ):
        identify_cylinder_friction(
            machine, strokes([0.02, 0.03, 0.045, 0.06], 0, None), "boom", stribeck=True
        )


def test_slow_speeds_alone_tell_no_stiction(machine):
    found = identify_cylinder_friction(machine, strokes([1e-3, 2e-3, 4e-3, 6e-3], 0, None), "boom")
    assert "do not exceed the Stribeck velocity twofold, record faster ones" in found.note


def test_friction_of_a_speed_that_rings(machine):
    """About a constant mean at a held valve, by a fifth: means over its periods tell the law."""
    speeds = [0.012, 0.018, 0.027, 0.04]
    run = strokes(speeds, 0, None, hold=8.0)
    time, v = run.time, run.v[:, 0]
    swing = 0.2 * v * np.sin(2 * np.pi * 2.0 * time)
    a = np.gradient(v + swing, time)
    q = run.q[:, 0] + np.concatenate(
        [[0], np.cumsum(0.5 * np.diff(time) * (swing[1:] + swing[:-1]))]
    )
    force = MASS * (9.81 + a) + friction_force(v + swing)
    rings = recording(time, q, v + swing, force)
    with pytest.raises(
        RecordingError, match="no speed of 'boom' is steady|never extends steadily"
    ):
        identify_cylinder_friction(machine, rings, "boom")
    held = dataclasses.replace(
        rings, channels={"voltage_boom": 5.8 - 20.0 * v}, channel_units={"voltage_boom": "V"}
    )
    found = identify_cylinder_friction(machine, held, "boom", stribeck=False)
    np.testing.assert_allclose(found.values, [210, 25, 3300], rtol=0.03)


def test_friction_needs_both_ways(machine):
    time = np.arange(0, 20, 5e-3)
    v = np.interp(time, [0, 1, 9, 10, 19, 20], [0, 0.01, 0.01, 0.02, 0.02, 0.0])
    q = -0.05 + np.cumsum(v) * 5e-3
    run = recording(time, q, v, MASS * 9.81 + friction_force(v))
    with pytest.raises(RecordingError, match="'boom' never retracts steadily at two speeds"):
        identify_cylinder_friction(machine, run, "boom")
    with pytest.raises(InputError, match="'tip' is not an active joint, known: boom"):
        identify_cylinder_friction(machine, run, "tip")
