"""Limit cycles: detected in samples, reported for runs, predicted for load sensing."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hydraulic_rig import AREA_A, AREA_B, COMPENSATED, HOSE, STROKE, rig
from scipy.integrate import solve_ivp
from warned import told

import crane
from crane.hydraulics.circuit_elements import Supply
from crane.hydraulics.pump_equations import least_sensing_ratio, unstable_frequency_range
from crane.recordings.limit_cycle_detection import (
    limit_cycle_message,
    limit_cycles,
    sustained_oscillation,
)
from crane.recordings.recording_summary import summarize

TIME = np.arange(0.0, 10.0, 2e-3)
SENSING = {
    "control": "load-sensing", "pressure": 20e6, "flow": 2e-3, "margin": 1.2e6, "standby": 2.5e6,
    "response": 0.1, "relief": 22e6,
}  # fmt: skip
VALVE = {"type": "compensated", "flow": 2e-3, "margin": 2e6, "bandwidth": 31.4, "dead_band": 0.1}
MODULUS = 1.2e9  # of the rig's oil [Pa]


def lifted(folder, mass=3000.0, level=0.8, duration=4.0, **supply):
    machine = rig(folder, valve=VALVE, mass=mass, supply=SENSING | supply)
    lever = crane.control.ValveSignals(
        machine, [0.0, 0.1, 0.3, duration], {"x": [0.0, 0.0, level, level]}
    )
    return machine, crane.simulate(machine, lever, duration=duration, step=1e-3)


@pytest.mark.parametrize(("frequency", "amplitude"), [(0.9, 3e6), (7.0, 2e6), (40.0, 5e5)])
def test_a_sine_on_a_drift_is_found(frequency, amplitude):
    found = sustained_oscillation(
        TIME, 1e7 + 1e5 * TIME + amplitude * np.sin(6.3 * frequency * TIME), 1e5
    )
    assert found.frequency == pytest.approx(6.3 * frequency / (2 * np.pi), rel=1e-2)
    assert found.amplitude == pytest.approx(amplitude, rel=0.05)
    assert found.start < 1.0 and found.end > 8.8


@pytest.mark.parametrize("mu", [0.1, 1.0])
def test_the_cycle_of_van_der_pol(mu):
    """Of amplitude 2 whatever mu is, from far inside; period 2 pi (1 + mu^2 / 16) to 1 percent."""
    time = np.arange(0.0, 400.0, 0.05)
    run = solve_ivp(lambda t, y: [y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]], (0, 400), [0.01, 0.0],
                    t_eval=time, rtol=1e-8)  # fmt: skip
    found = sustained_oscillation(time, run.y[0], 0.1)
    assert found.amplitude == pytest.approx(2.0, rel=0.02)
    assert found.frequency == pytest.approx(1 / (2 * np.pi * (1 + mu**2 / 16)), rel=0.012)


@pytest.mark.parametrize("damping", [0.005, 0.02, 0.1])
def test_what_decays_is_none(damping):
    w = 2 * np.pi * 7.0
    swing = 2e6 * np.exp(-damping * w * TIME) * np.sin(w * TIME)
    assert sustained_oscillation(TIME, 1e7 + swing, 1e5) is None


def test_noise_steps_and_ramps_are_none():
    rng = np.random.default_rng(3)
    for values in (
        2e5 * rng.standard_normal(len(TIME)), np.cumsum(1e5 * rng.standard_normal(len(TIME))),
        1e6 * np.floor(TIME), 1e6 * TIME, np.zeros(len(TIME)),
    ):  # fmt: skip
        assert sustained_oscillation(TIME, 1e7 + values, 1e5) is None


@pytest.mark.parametrize("harmonic", [1, 2, 3])
def test_what_is_commanded_is_none(harmonic):
    swing, command = np.sin(2 * np.pi * 3 * harmonic * TIME), np.sin(2 * np.pi * 3 * TIME)
    assert sustained_oscillation(TIME, 2e6 * swing, 1e5, [command]) is None
    assert sustained_oscillation(TIME, 2e6 * swing, 1e5, [TIME, np.ones_like(TIME)]) is not None


def test_load_sensing_without_damping_rings_and_is_told(tmp_path):
    machine, run = lifted(tmp_path, sensing=0.0)
    largest = limit_cycles(run)[0]
    assert largest.channel == "pressure_supply"
    # independent of how it is found: the spectrum of the same second
    part = slice(600, 1600)
    left = run["pressure_supply"][part]
    left = left - np.polyval(np.polyfit(run.time[part], left, 2), run.time[part])
    lines = np.abs(np.fft.rfft(left * np.hanning(len(left)), 16 * len(left)))
    peak = np.fft.rfftfreq(16 * len(left), 1e-3)[lines.argmax()]
    assert largest.frequency == pytest.approx(peak, rel=0.06) and 10 < peak < 15
    assert largest.amplitude == pytest.approx(np.ptp(left) / 2, rel=0.25) and np.ptp(left) > 3e6
    assert "sustained pressure oscillation (limit cycle)" in summarize(run).to_markdown()
    report = crane.check(machine.path)
    (told,) = [one.message for one in report.findings if "'sensing'" in one.message]
    assert "0 to 39 Hz" in told and "0.08 or more" in told and report.status == 1


@pytest.mark.parametrize("changes", [{}, {"margin": 2.4e6}, {"droop": 1e6}, {"volume": 5e-3}])
@pytest.mark.parametrize("mass", [3000.0, 10000.0])
def test_load_sensing_as_it_is_by_default_is_quiet(tmp_path, mass, changes):
    machine, run = lifted(tmp_path, mass, **changes)
    assert limit_cycle_message(run) == "" and "ring" not in summarize(run).to_markdown()
    assert not crane.check(machine.path).findings


def test_peak_forces_are_smaller_without_the_cycle(tmp_path):
    peaks = []
    for sensing in (0.0, 0.3):
        (folder := tmp_path / f"{sensing}").mkdir()
        _, run = lifted(folder, 10000.0, margin=2.4e6, sensing=sensing)
        moving = run.time > 0.5
        peaks.append(np.abs(run.tau[moving]).max())
    assert peaks[0] > 1.1 * peaks[1]


@pytest.mark.parametrize(("frequency", "damping"), [(7.0, 0.002), (30.0, 0.008)])
def test_a_transient_that_grows_and_fades_is_none(frequency, damping):
    """While the command stands still; eight periods about its top hardly change."""
    phase = 2 * np.pi * frequency * TIME
    hump = 2e6 * (damping * phase) * np.exp(1 - damping * phase) * np.sin(phase)
    lever = np.interp(TIME, [0.0, 0.01], [0.0, 1.0])
    assert damping * phase[-1] > 0.7
    fading = hump * np.exp(-np.maximum(TIME - 2.0, 0.0) * 4.0)
    assert sustained_oscillation(TIME, 1e7 + fading, 1e5, [lever]) is None
    assert sustained_oscillation(TIME, 1e7 + 2e6 * np.sin(phase), 1e5, [lever]) is not None


@pytest.mark.parametrize("kind", ["white", "smooth", "resonant"])
def test_coloured_noise_is_none(kind):
    t = np.arange(200)
    kernel = {
        "white": np.ones(1), "smooth": np.hanning(15),
        "resonant": np.exp(-t / 20) * np.sin(2 * np.pi * t / 30),
    }[kind]  # fmt: skip
    for seed in range(15):
        noise = np.convolve(np.random.default_rng(seed).normal(size=len(TIME)), kernel, "same")
        assert sustained_oscillation(TIME, 1e7 + 2e5 * noise / noise.std(), 1e5) is None


def test_a_cycle_of_uneven_halves_and_jolts_is_found():
    """Short peaks over a flat bottom; every sixth period is another one."""
    pulses = np.maximum(np.sin(2 * np.pi * 5 * TIME), 0.0) ** 4
    pulses = np.where(np.floor(5 * TIME) % 6 == 5, 0.2 * pulses, pulses)
    found = sustained_oscillation(TIME, 1e7 + 4e6 * pulses, 1e5)
    assert found.frequency == pytest.approx(5.0, rel=0.02)
    assert found.amplitude == pytest.approx(2e6, rel=0.1)
    assert found.start < 1.0 and found.end > 8.5


@pytest.mark.parametrize("order", [2, 3])
def test_a_cycle_whose_period_doubles_or_triples_is_found(order):
    """As of bouncing loads: one large swing, then smaller ones."""
    size = np.where(np.floor(5 * TIME) % order == 0, 4e6, 1e6)
    found = sustained_oscillation(TIME, 1e7 + size * np.sin(2 * np.pi * 5 * TIME), 1e5)
    assert found.frequency == pytest.approx(5.0, rel=0.02) and found.end - found.start > 8


def test_revolutions_are_no_cycle():
    """Pressures of a crank that turns on, at one and two ripples per revolution."""
    turned = 2 * np.pi * 1.5 * TIME
    for harmonic in (1, 2):
        run = crane.Recording(
            TIME, ("a",), turned[:, None], np.zeros((len(TIME), 1)), np.zeros((len(TIME), 1)),
            {"a": "rad"}, {"pressure_p": 1e7 + 2e6 * np.sin(harmonic * turned)},
            {"pressure_p": "Pa"},
        )  # fmt: skip
        assert limit_cycles(run) == []
        still = replace(run, q=0.05 * np.sin(run.q))  # it swings with the pressure
        (found,) = limit_cycles(still)
        assert found.frequency == pytest.approx(1.5 * harmonic, rel=0.01)


@pytest.mark.parametrize(
    ("ratio", "coefficient", "hertz"), [(4.0, 2e-6, 9.2), (4.0, 4e-7, 11.6), (1.5, 4e-7, 12.1)]
)
def test_a_counterbalance_valve_that_swings_is_told(tmp_path, ratio, coefficient, hertz):
    """A load of 6 t that is lowered over it: the pump side cavitates, the valve opens, shuts."""
    holding = {"pressure": 9.7e6, "pilot_ratio": ratio, "range": 3e6, "coefficient": coefficient}
    machine = rig(
        tmp_path, COMPENSATED, {"counterbalance_a": holding}, {"pressure": 20e6}, mass=6000.0
    )
    lever = crane.control.ValveSignals(machine, [0, 0.2, 0.3, 5], {"x": [5.8, 5.8, 7.3, 7.3]})
    run = crane.simulate(machine, lever, [0.5], duration=5.0, step=1e-3)
    (found,) = [x for x in limit_cycles(run) if x.channel == "pressure_x_a"]
    part = run["pressure_x_a"][1000:4000]
    assert found.amplitude == pytest.approx(np.ptp(part) / 2, rel=0.1) and np.ptp(part) > 6e6
    lines = np.abs(np.fft.rfft((part - part.mean()) * np.hanning(len(part)), 16 * len(part)))
    peak = np.fft.rfftfreq(16 * len(part), 1e-3)[lines.argmax()]
    assert found.frequency == pytest.approx(peak, rel=0.05) == pytest.approx(hertz, rel=0.05)
    assert f"pressure_x_a by {1e-5 * found.amplitude:.3g} bar at" in summarize(run).to_markdown()


def lowered_by_hand(holding, mass, start, duration):
    """The same load by equations that are written here, and scipy's Radau.

    A chamber at the vapour pressure has a void, which its state counts in other units.
    """
    supply, tank, vapour, dead_band = 20e6, 1e5, 1e3, 0.1143
    flow, margin = COMPENSATED["flow"], COMPENSATED["margin"]

    def root(drop):
        size = abs(drop)
        laminar = 1.25e-2 * drop - 0.25e-10 * drop**3
        return laminar if size < 1e4 else np.copysign(size**0.5, drop)

    def rates(t, state):
        x, v, *excess = state
        a, b = (vapour + 1e5 * max(s, 0.0) for s in excess)
        u = np.interp(t, [0.2, 0.3], [0.0, 0.5])
        y = max(u - dead_band, 0.0) / (1 - dead_band)
        opening = (a + holding["pilot_ratio"] * b - holding["pressure"]) / holding["range"]
        spool = flow / margin**0.5 * y
        valve = holding["coefficient"] * min(max(opening, 0.0), 1.0)
        series = spool * valve / max(np.hypot(spool, valve), 1e-300)
        net = [
            -series * root(a - tank) - AREA_A * v,
            spool * root(min(max(supply - b, 0.0), margin)) + AREA_B * v,
        ]
        volumes = [HOSE + AREA_A * x, HOSE + AREA_B * (STROKE - x)]
        compliances = [
            1e5 / MODULUS * (w if s > 0 else 2e-3) for w, s in zip(volumes, excess, strict=True)
        ]
        force = AREA_A * a - AREA_B * b - 300.0 * v
        return [v, force / mass - 9.81, net[0] / compliances[0], net[1] / compliances[1]]

    time = np.arange(0.0, duration + 5e-4, 1e-3)
    carried = (mass * 9.81 + AREA_B * tank) / AREA_A
    first = [start, 0.0, (carried - vapour) / 1e5, (tank - vapour) / 1e5]
    run = solve_ivp(
        rates, (0, duration), first, "Radau", t_eval=time, rtol=1e-8, atol=1e-8, max_step=5e-3
    )
    return run.y[0], vapour + 1e5 * np.maximum(run.y[2], 0.0)


def test_a_counterbalance_valve_swings_as_by_equations_of_its_own(tmp_path):
    holding = {"pressure": 9.7e6, "pilot_ratio": 4.0, "range": 3e6, "coefficient": 4e-7}
    machine = rig(
        tmp_path, COMPENSATED, {"counterbalance_a": holding}, {"pressure": 20e6}, mass=6000.0
    )
    lever = crane.control.ValveSignals(machine, [0, 0.2, 0.3, 3], {"x": [5.8, 5.8, 7.3, 7.3]})
    run = crane.simulate(machine, lever, [0.5], duration=3.0, step=1e-3)
    x, pressure = lowered_by_hand(holding, 6000.0, 0.5, 3.0)
    assert np.abs(run.q[:, 0] - x).max() < 1e-6
    assert np.abs(run["pressure_x_a"] - pressure).max() < 1e-3 * np.ptp(pressure)
    (found,) = [one for one in limit_cycles(run) if one.channel == "pressure_x_a"]
    swing = pressure[1000:]
    up = np.flatnonzero((swing[:-1] < swing.mean()) & (swing[1:] >= swing.mean()))
    ranges = [np.ptp(one) for one in np.split(swing, up)[1:-1]]
    assert found.frequency == pytest.approx(1e3 / np.diff(up).mean(), rel=0.01)
    assert found.amplitude == pytest.approx(np.median(ranges) / 2, rel=0.05) and found.end > 2.9
    assert min(ranges) > 5e6


def test_a_counterbalance_valve_that_cannot_open_is_told(tmp_path):
    """Closed chambers carry the load on an oil spring: both pressures follow from the statics."""
    load, supply, tank = 3000.0 * 9.81, 60e5, 1e5

    def lower(ratio, level=6.2, duration=2.0):
        holding = {"pressure": 2.1e7, "pilot_ratio": ratio, "range": 3e6, "coefficient": 4e-7}
        valve = {"type": "orifice", **dict.fromkeys(("c1", "c2", "c3", "c4"), 1e-7)}
        machine = rig(
            tmp_path, valve, {"counterbalance_a": holding}, {"pressure": supply}, mass=3000.0,
            friction={"viscous": 2e5},
        )  # fmt: skip
        lever = crane.control.ValveSignals(machine, [0, 0.2, 0.5], {"x": [0, 0, level]})
        return told(crane.simulate, machine, lever, [0.3], duration=duration, step=1e-3)

    run, (line,) = lower(1.5, -0.5)
    held = (load + AREA_B * supply) / AREA_A
    needed = (2.1e7 - held) / 1.5
    assert run.q[-1, 0] == pytest.approx(0.3, abs=2e-3)
    numbers = [1e5 * float(x) for x in re.findall(r"([\d.]+) bar", line)]
    assert numbers == pytest.approx([held, needed, supply], rel=2e-3)
    assert line.startswith("the counterbalance valve of chamber A of 'x' stays closed")
    assert needed > supply > tank + (2.1e7 - held) / 4.0
    for ratio, level, duration in ((4.0, -0.5, 2.0), (1.5, 0.5, 2.0), (1.5, 0.0, 2.0)):
        assert lower(ratio, level, duration)[1] == []
    assert lower(1.5, -0.5, 0.4)[1] == []  # the pilot pressure still rises


def test_a_counterbalance_valve_that_settles_is_not(tmp_path):
    """The same with little flow through it: eight even periods, then rest."""
    holding = {"pressure": 1.5e7, "pilot_ratio": 8.0, "range": 3e6, "coefficient": 1.45e-7}
    machine = rig(
        tmp_path, COMPENSATED, {"counterbalance_a": holding}, {"pressure": 9.25e6}, mass=6000.0
    )
    lever = crane.control.ValveSignals(machine, [0, 0.2, 0.3, 8], {"x": [5.8, 5.8, 7.3, 7.3]})
    run = crane.simulate(machine, lever, [0.5], duration=8.0, step=1e-3)
    assert np.ptp(run["pressure_x_b"][:600]) > 6e6 and np.ptp(run["pressure_x_b"][-3000:]) < 2e5
    assert limit_cycle_message(run) == ""


def supplies(count=40):
    rng = np.random.default_rng(11)
    for _ in range(count):
        droop, volume = 10 ** rng.uniform(4.5, 6.5), 10 ** rng.uniform(-4, -2)
        yield Supply(
            20e6, flow=10 ** rng.uniform(-4, -2), droop=droop, volume=volume, margin=2e6,
            response=10 ** rng.uniform(-2, 0), control="load-sensing",
            sensing=rng.choice([0.0, 10 ** rng.uniform(-2.5, 0.5)]),
        )  # fmt: skip


def test_driven_swings_are_where_the_admittance_is_active():
    """By the transfer function itself, over openings of all sizes."""
    s = 2j * np.pi * np.logspace(-3, 3, 4001)
    for supply in supplies():
        a, late, b = 1 / supply.response, supply.sensing_time, MODULUS / supply.volume
        square = b * supply.flow * a / supply.droop
        g = np.logspace(-16, -6, 40)[:, None] * supply.volume / MODULUS * 1e9
        flow = -g * (s * (s + a) + square * late * s / (1 + late * s))
        flow = flow / (s * s + (a + b * g) * s + square + a * b * g)
        active = (flow.real > 1e-9 * np.abs(flow)).any(axis=0)
        band = unstable_frequency_range(supply, MODULUS)
        if band is None:
            assert not active.any()
            continue
        found = np.abs(s[active]) / (2 * np.pi)
        if len(found) < 3:  # narrower than the frequencies that are tried
            continue
        assert found.max() == pytest.approx(min(band[1], 1e3), rel=0.02)
        assert found.min() == pytest.approx(max(band[0], 1e-3), rel=0.02)


def test_no_load_swings_up_from_the_least_sensing_on():
    """Eigenvalues of pump, valve and a mass on a cylinder, whatever they are; some do below it."""
    rng, grown = np.random.default_rng(5), 0
    for supply in supplies(60):
        least = least_sensing_ratio(supply, MODULUS)
        for share in (0.02, 1.01):
            some = replace(supply, sensing=max(share * least, 1e-6))
            for _ in range(20):
                stiff, area = MODULUS / 10 ** rng.uniform(-4, -2), 10 ** rng.uniform(-3, -1.5)
                mass, g = 10 ** rng.uniform(2, 5), 10 ** rng.uniform(-12, -8)
                a, b, late = 1 / some.response, MODULUS / some.volume, some.sensing_time
                system = np.array([  # share, sensed, supply [1e6 Pa], load, speed
                    [-a, a * 1e6 / some.droop, -a * 1e6 / some.droop, 0, 0],
                    [0, -1 / late, 0, 1 / late, 0],
                    [b * some.flow * 1e-6, 0, -b * g, b * g, 0],
                    [0, 0, stiff * g, -stiff * g, -stiff * area * 1e-6],
                    [0, 0, 0, area * 1e6 / mass, 0],
                ])  # fmt: skip
                growth = np.linalg.eigvals(system).real.max()
                scale = np.abs(np.linalg.eigvals(system)).max()
                if share > 1:
                    assert growth < 1e-9 * scale
                grown += share < 1 and growth > 1e-6 * scale
    assert grown > 20


@pytest.mark.slow
@pytest.mark.parametrize(("name", "task", "droop"), [
    ("patu655_ls", "stir", None),
    *(pytest.param(*machine, droop, marks=pytest.mark.long)
      for machine in (
          ("excavator_ls", "dig"), ("excavator_ls", "load_truck"), ("excavator_two_pumps", "dig"),
          ("excavator_two_pumps", "load_truck"), ("patu655_ls", "stir"), ("excavator", "dig"),
          ("patu655", "stir"),
      ) for droop in (None, 2e5, 1e6)),
])  # fmt: skip
def test_bundled_machines_do_not_ring(name, task, droop):
    changes = {"supply.droop": droop} if droop else {}
    machine = crane.load(name, changes=changes)
    loaded = machine.with_external_forces(*machine.tasks[task].loads)
    duration = machine.tasks[task].duration or None
    run = crane.simulate(loaded, crane.joystick(loaded, task), duration=duration, step=5e-3)
    assert limit_cycle_message(run) == ""
