"""Valve signals for calibration: limits are kept, and the information that they carry."""

import numpy as np
import pytest
from command_line import typed
from hydraulic_rig import COMPENSATED, ORIFICE, rig
from warned import quiet

import crane
from crane.common.errors import CraneError
from crane.identification.excitation.exchange_algorithm import full_opening_speed
from crane.identification.excitation.signal_information import SignalInformation
from crane.recordings import timeseries

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")
VALVE = COMPENSATED | {"bandwidth": 60.0, "damping": 0.9}
FIT = ["valve.x.neutral", "friction.x.viscous", "oil.bulk_modulus", "load_x.mass"]
NOISE = {"x": 2e-4, "pressure_x_a": 2e4, "pressure_x_b": 2e4}
QUICK = {"duration": 6.0, "step": 0.004, "noise": NOISE}


def simple(folder):
    return rig(
        folder, VALVE, {"refill": 6e-6}, supply={"pressure": 140e5, "tank": 8e5},
        friction={"viscous": 600.0},
    )  # fmt: skip


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    return simple(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="module")
def found(machine):
    fit = [*FIT, "oil.gas_exponent"]
    return crane.identification.excite_valves(
        machine, fit, duration=5.0, step=0.005, noise=NOISE, trials=8
    )


def test_a_notebook_shows_signals_and_what_they_tell(found):
    html = found._repr_html_()
    assert repr(found).startswith("SignalExcitation of 'rig', 5 s: ") and len(repr(found)) <= 200
    assert (
        html.count("<img ") == 1
        and "std, optimized signals" in html
        and "largest pressure" in html
    )


def strokes(machine, signals, time):
    """Of a machine that the signals drive, and its velocities."""
    run = crane.simulate(
        machine,
        crane.control.ValveSignals(machine, time, signals),
        None,
        time[-1],
        time[1] - time[0],
    )
    return run.q[:, 0], run.v[:, 0]


# --- limits ----------------------------------------------------------------------------------


@pytest.mark.parametrize("valve", [ORIFICE, COMPENSATED], ids=["orifice", "compensated"])
@pytest.mark.parametrize("backwards", [False, True])
def test_the_steady_velocity_at_full_opening(tmp_path, valve, backwards):
    """Of a hanging load, up, and down where it pulls: what the simulation settles at."""
    machine = rig(tmp_path, valve, friction={"viscous": 1.0})
    circuit = machine.hydraulics
    part = circuit.valves["x"]
    signal = part.neutral + (part.full - part.neutral) * (-1 if backwards else 1)
    start = 0.45 if backwards else 0.05
    run = crane.simulate(
        machine, crane.control.ValveSignals(machine, [0.0], {"x": [signal]}), [start], 1.0
    )
    settled = np.abs(run.v[-300:, 0]).mean()
    force = 2000.0 * 9.81
    speed = full_opening_speed(circuit.cylinders["x"], part, circuit.supply, force, backwards)
    assert speed == pytest.approx(settled, rel=0.02)


def test_strokes_rates_and_rest_are_kept(machine, found):
    time, signals = found.run.time, found.signals
    q, v = strokes(machine, signals, time)
    span = machine.upper[0] - machine.lower[0]
    assert min(q.min() - machine.lower[0], machine.upper[0] - q.max()) >= 0.1 * span - 1e-6
    rates = np.abs(np.diff(signals["x"])) / (time[1] - time[0])
    assert rates.max() <= 2.0 * 3.0 * (1 + 1e-9)  # strokes per second, volts per stroke
    assert signals["x"][0] == signals["x"][-1] == 5.8
    assert np.abs(v[time > time[-1] - 0.5]).max() < 0.1 * np.abs(v).max()
    assert np.ptp(q) > 0.05 * span


@pytest.mark.parametrize("number", ["load_x.mass", "oil.bulk_modulus", "friction.x.viscous"])
@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_strokes_hold_though_a_number_is_off(machine, found, number, factor):
    value = next(one.start for one in found.unknowns if one.name == number)
    other = crane.load(machine.path, changes={number: factor * value})
    q, _ = strokes(other, found.signals, found.run.time)
    span = machine.upper[0] - machine.lower[0]
    left = min(q.min() - machine.lower[0], machine.upper[0] - q.max()) / span
    assert left >= found.worst_case_stroke_margins[0] - 1e-6 > 0


@pytest.mark.slow
def test_the_pump_delivers_what_is_asked_for(tmp_path):
    """Two cylinders that ask for 80 l/min of a pump of 30; alone one asks for more than that."""
    machine = rig(
        tmp_path, VALVE, joints=("x", "y"), friction={"viscous": 600.0},
        supply={"pressure": 140e5, "tank": 8e5, "flow": 30 / 6e4, "droop": 2e5, "volume": 2e-3},
    )  # fmt: skip
    found = crane.identification.excite_valves(
        machine, ["load_x.mass"], duration=6.0, trials=3, rate=4.0
    )
    assert 0.5 < found.pump_flow_share <= 1.0
    flows = found.run.channels
    drawn = sum(np.maximum(flows[f"flow_{x}_{y}"], 0.0) for x in "xy" for y in "ab")
    assert drawn.max() < 1.05 * 30 / 6e4


# --- what they tell --------------------------------------------------------------------------


def test_the_information_is_that_of_derivatives_by_hand(machine, found):
    """Central differences of separately loaded machines; what is compared are from one side."""
    names, time = ["load_x.mass", "oil.bulk_modulus"], found.run.time
    told = SignalInformation(machine, names, None, NOISE, 0)
    columns = []
    for one in told.unknowns:
        ends = []
        for side in (1.0, -1.0):
            other = crane.load(machine.path, changes={one.name: one.start * (1 + side * 1e-3)})
            drive = crane.control.ValveDrive(
                other, crane.control.ValveSignals(other, time, found.signals),
                {"x": (found.run.channels["pressure_x_a"][0],
                       found.run.channels["pressure_x_b"][0])},
            )  # fmt: skip
            run = crane.simulate(
                other, drive, None, time[-1], time[1] - time[0], tolerance=1e-10
            ).columns()
            ends.append(np.column_stack([run[x] / s for x, s in NOISE.items()]).ravel())
        columns.append((ends[0] - ends[1]) / 2e-3)
    J = np.column_stack(columns)
    rows = told.information_factor(found.run, estimate_start=False)
    assert rows.T @ rows == pytest.approx(J.T @ J, rel=0.05)
    alone, whole = (np.linalg.inv(x.T @ x) for x in (rows, told.information_factor(found.run)))
    assert (np.diag(whole) > np.diag(alone)).all()  # of a start that has to be found, too


def test_they_tell_more_than_plain_ones_and_what_is_not_told(found):
    assert found.optimized_information.logdet > found.initial_information.logdet + np.log(2)
    assert found.unidentifiable == ["oil.gas_exponent"]  # there is no gas
    assert found.std["oil.gas_exponent"] == np.inf
    text = found.to_text()
    assert "not determined by these sensors in this time: oil.gas_exponent" in text
    assert "load_x.mass" in text and "std, optimized signals" in text


def test_a_start_that_is_given_is_what_the_machine_has(machine):
    given = {"load_x.mass": 2100.0, "valve.x.neutral": (5.9, 5.8, 6.0)}
    told = SignalInformation(machine, given, None, NOISE, 0)
    assert told.machine.parameter_changes == {"load_x.mass": 2100.0, "valve.x.neutral": 5.9}
    assert SignalInformation(machine, FIT, None, NOISE, 0).machine is machine
    assert (
        told.perturbed_machine({"load_x.mass": 1900.0}).parameter_changes["load_x.mass"] == 1900.0
    )


@pytest.mark.long
def test_estimates_spread_as_expected_and_less_than_of_a_joystick(machine, tmp_path):
    """Of twenty recordings, fitted from numbers that are wrong, by chi-square bounds of 99.9 %.

    Against a lever that goes half out and back in the same time, as an operator moves it.
    """
    from scipy.stats import chi2

    count, found = 20, crane.identification.excite_valves(machine, FIT, trials=40, **QUICK)
    wrong = crane.load(machine.path, changes={
        "load_x.mass": 2010.0, "oil.bulk_modulus": 1.19e9, "friction.x.viscous": 700.0,
    })  # fmt: skip
    time = found.run.time
    lever = crane.joystick(machine, {
        "x": [(0, 0), (0.6, 0), (1.4, 0.3), (2.2, 0.3), (3, 0), (3.8, -0.3), (4.6, -0.3), (5.4, 0),
              (6, 0)],
    })  # fmt: skip
    plain = crane.simulate(machine, lever, None, 6.0, time[1] - time[0])
    told = SignalInformation(machine, FIT, None, NOISE, 0)
    errors = {}
    for what, table in (
        ("designed", found.expected_readings),
        ("joystick", told.expected_readings(plain)),
    ):
        errors[what] = []
        for seed in range(count):
            values = table.values.copy()
            noise = np.random.default_rng(900 + seed).normal(size=values[:, 2:].shape)
            values[:, 2:] += noise * list(NOISE.values())
            path = tmp_path / "run.csv"
            timeseries.write_table(path, timeseries.Table(table.units, values, {}))
            fitted = crane.calibrate(wrong, path, FIT).values
            errors[what].append([fitted[one.name] - one.start for one in found.unknowns])
    std = np.array([found.std[name] for name in FIT])
    squares = (np.square(errors["designed"]) / std**2).sum(axis=0)
    assert (squares < chi2.ppf(0.999, count)).all() and (squares > chi2.ppf(0.001, count)).all()
    spread = {what: np.sqrt(np.mean(np.square(x), axis=0)) for what, x in errors.items()}
    gain = spread["joystick"] / spread["designed"]
    assert np.prod(gain) > 2.0 ** len(FIT)  # a volume: one number may be given up for another


@pytest.mark.long
def test_of_a_log_crane_they_tell_more_than_its_task_of_levers():
    """In the twenty seconds of the machine's own task, ln det and every deviation."""
    machine = crane.load("patu655", lock={"slew": 0.0}, changes={"payload.mass": 211.4})
    fit = ["payload.mass", "oil.bulk_modulus", "friction.X_lift.viscous", "valve.X_lift.neutral"]
    found = crane.identification.excite_valves(machine, fit, duration=20.0, trials=30)
    told = SignalInformation(machine, fit, None, None, 0)
    stir = crane.simulate(machine, crane.joystick(machine, "stir"), None, 20.0, 0.01)
    usual = told.measures(stir)
    assert found.optimized_information.logdet > usual.logdet + len(fit) * np.log(2)
    assert (found.optimized_information.std < usual.std).all()
    heavy = crane.load("patu655", lock={"slew": 0.0}, changes={"payload.mass": 1.3 * 211.4})
    run = crane.simulate(
        heavy, crane.control.ValveSignals(heavy, found.run.time, found.signals), None, 20.0, 0.01
    )
    assert (run.q.min(axis=0) > heavy.lower).all() and (run.q.max(axis=0) < heavy.upper).all()


# --- files and errors ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, said",
    [
        ({"fit": []}, "nothing is to be fitted"),
        ({"fit": ["load.mass"]}, "parameter 'load.mass' is unknown"),
        ({"criterion": "det"}, "criterion 'det' is unknown, known: condition"),
        ({"duration": 1.0}, "give a duration of at least 2 s"),
        ({"step": 0.5}, "the step is 0.5 s, give a number from"),
        ({"rate": 0.0}, "the rate is 0.0 1/s, give a number above 0"),
        ({"rate": 1e-3}, "do not leave the dead band of 'x' in a pulse of"),
        ({"margin": 0.5}, "the margin is 0.5, give a share"),
        ({"sensors": []}, "no sensor is named, choose among x"),
        ({"sensors": ["voltage_x"]}, "'voltage_x' cannot be compared, "),
        ({"sensors": ["inclination_boom"]}, "is of no link"),
        ({"sensors": ["x_force"]}, "noise of 'x_force' is not known, give its deviation in N"),
        ({"noise": {"y": 1.0}}, "noise of 'y', which is not measured, known"),
        ({"noise": {"x": 0.0}}, "noise of 'x' is 0.0 m, give a number above 0"),
    ],
)
def test_what_cannot_be_is_one_line(machine, options, said):
    with pytest.raises(CraneError) as error:
        crane.identification.excite_valves(machine, options.pop("fit", FIT), trials=2, **options)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_no_signals_within_the_limits(tmp_path):
    """The load alone needs 27 bar, and relief valves open at 20."""
    machine = rig(tmp_path, VALVE, {"relief": 20e5}, supply={"pressure": 140e5, "tank": 8e5})
    text = "none of 2 random signals keeps 'rig' within its limits, lastly for the .*: lower"
    with pytest.raises(CraneError, match=text):
        crane.identification.excite_valves(machine, ["load_x.mass"], duration=3.0, trials=2)


def test_a_machine_without_valves(slider_crank):
    with pytest.raises(CraneError, match="has no valves, describe its circuit"):
        crane.identification.excite_valves(slider_crank, ["crank.mass"])


@pytest.mark.slow
def test_the_command_writes_signals_that_can_be_played(machine, tmp_path):
    out = tmp_path / "found"
    words = ("excite", machine.path, "--fit", "load_x.mass", "--duration", 4, "--out", out)
    done = typed(*words)
    assert done.returncode == 0, done.stderr
    assert "std, optimized signals" in done.stdout and f"--inputs {out}/signals.csv" in done.stdout
    assert sorted(x.name for x in out.iterdir()) == ["signals.csv", "signals.png"]
    played = typed(
        "simulate", machine.path, "--inputs", out / "signals.csv", "--out", tmp_path / "run"
    )
    assert played.returncode == 0, played.stderr
    _, comparison = quiet(crane.replay, machine, out / "signals.csv", 0.01)
    assert {channel.name: channel.relative_rms < 1e-3 for channel in comparison.channels} == {
        "x": True, "pressure_x_a": True, "pressure_x_b": True
    }  # fmt: skip
    for extra, said in (
        ((), "is not empty, choose another folder or add --force"),
        (("--force", "--period", 3), "--period does not go with --fit, leave it out"),
        (("--force", "--fit", "x=1~2"), "--fit is 'x=1~2', write NAME"),
    ):
        done = typed(*words, *extra)
        assert done.returncode == 2 and said in done.stderr
    done = typed("excite", machine.path, "--duration", 3, "--out", tmp_path / "other")
    assert done.returncode == 2 and "--duration only goes with --fit" in done.stderr
