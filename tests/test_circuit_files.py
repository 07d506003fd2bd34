"""Circuits in machine files: reading, writing, changes, locked joints, linear models, errors."""

import re
import textwrap
from pathlib import Path

import numpy as np
import pytest
from command_line import typed
from full_circuit import ALL, SIGNALS, TIMES, everything, gaps
from hydraulic_rig import rig
from warned import without_a_word

import crane
from crane.common.errors import CraneError, DescriptionError, InputError
from crane.control import ValveSignals
from crane.recordings import timeseries

PUMP = {"control": "load-sensing", "pressure": 2e7, "flow": 6e-4, "margin": 2e6}
LEAK = {"type": "leak", "from": "supply", "to": "tank", "gain": 1e-12}


def test_everything_is_written_and_read_to_the_last_bit(tmp_path):
    machine = everything(tmp_path)
    out = tmp_path / "out"
    crane.write_machine(machine, out)
    again = crane.load(out / "rig.yaml")
    assert again.hydraulics == machine.hydraulics
    assert list(again.hydraulics.cylinders) == list(machine.hydraulics.cylinders)
    crane.write_machine(again, tmp_path / "twice")
    one, two = ((tmp_path / x / "rig.yaml").read_text() for x in ("out", "twice"))
    assert one.splitlines()[-60:] == two.splitlines()[-60:]


def test_all_numbers_are_named_and_can_be_changed(tmp_path):
    machine = without_a_word(everything, tmp_path)
    told = typed("info", tmp_path / "rig.yaml", "--names")
    assert told.returncode == 0, told.stderr
    for name in (
        "supply.margin", "supply.second.signal", "supply.pilot.pressure", "engine.inertia",
        "line.block.volume", "accumulator.warm.time_constant", "element.cooler.coefficient",
        "valve.y.regeneration", "cylinder.z.cross_relief", "oil.air", "supply.tank",
    ):  # fmt: skip
        assert name in told.stdout, name
    assert "supply.second.tank" not in told.stdout
    changes = {
        "supply.second.signal": 1.8e6, "engine.speed_droop": 9.0, "line.block.volume": 7e-4,
        "accumulator.warm.precharge": 2.5e6, "element.drain.gain": 2e-11, "valve.y.c1": 4e-7,
        "supply.pilot.pressure": 1.7e7,
    }  # fmt: skip
    other = crane.load(tmp_path / "rig.yaml", changes)
    circuit = other.hydraulics
    assert circuit.supplies["second"].signal == 1.8e6 and circuit.engine.speed_droop == 9.0
    assert circuit.lines["block"].volume == 7e-4
    assert circuit.accumulators["warm"].precharge == 2.5e6
    assert circuit.elements["drain"].gain == 2e-11
    assert circuit.valves["y"].curves == machine.hydraulics.valves["y"].curves
    words = [f"--set={name}={value}" for name, value in changes.items()]
    run = tmp_path / "run"
    told = typed("simulate", tmp_path / "rig.yaml", "--out", run, "--duration", 0.05, *words)
    assert told.returncode == 0, told.stderr


def test_every_number_of_the_circuit_acts(tmp_path):
    """Every parameter that can be set is a constant of the formulas."""
    from circuit_state import circuit_of

    machine = everything(tmp_path)
    usual = circuit_of(machine).constants
    for name, value in {
        "supply.pilot.pressure": 1.7e7, "engine.torque": 140.0, "line.block.volume": 6e-4,
        "accumulator.quick.volume": 6e-4, "element.feed.pressure": 2e6, "supply.second.throttle":
        7e-7, "valve.y.float_from": 0.7, "valve.x.hysteresis": 0.03, "cylinder.x.rupture_a": 1e-3,
    }.items():  # fmt: skip
        other = circuit_of(crane.load(tmp_path / "rig.yaml", {name: value})).constants
        assert 1 <= np.sum(other != usual) <= 2, name


def test_names_of_supplies_do_not_hide_those_of_the_first(tmp_path):
    leak = {"type": "leak", "from": "pressure", "to": "tank", "gain": 1e-13}
    rig(tmp_path, supplies={"pressure": {"pressure": 2e7, "flow": 1e-3}}, elements={"drip": leak})
    machine = crane.load(tmp_path / "rig.yaml", {"supply.pressure": 1e7})
    assert machine.hydraulics.supply.pressure == 1e7
    assert machine.hydraulics.supplies["pressure"].pressure == 2e7


@pytest.mark.parametrize("held", [["x"], ["y"], ["z"], ["w"], ["x", "y"], ["y", "z", "w"]])
def test_locked_joints_take_their_elements_along(tmp_path, held):
    everything(tmp_path)
    machine = crane.load(tmp_path / "rig.yaml", lock=dict.fromkeys(held, 0.1))
    circuit = machine.hydraulics
    assert ("suspension" in circuit.elements) == ("x" not in held)
    assert ("quick" in circuit.accumulators) == ("x" not in held)
    assert circuit.elements.keys() >= {"cooler", "fill", "feed"}
    left = {joint: SIGNALS[joint] for joint in machine.active}
    run = crane.simulate(machine, ValveSignals(machine, TIMES, left), duration=0.8)
    oil, energy = gaps(run, machine)
    assert oil < 1e-12 and energy < 1e-6


def test_a_motor_is_written_as_one_or_not_at_all(tmp_path):
    everything(tmp_path)
    machine = crane.load(tmp_path / "rig.yaml", {"cylinder.z.area_a": 4e-4})
    with pytest.raises(InputError) as caught:
        crane.write_machine(machine, tmp_path / "out")
    assert "area_b of the motor of 'z'" in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_linear_model_of_two_pumps_at_rest_and_moving(tmp_path):
    """Its states are those of pumps and lines, too, and its matrix that of differences."""
    machine = rig(
        tmp_path, supply=PUMP | {"response": 0.1, "least": 0.01}, joints=("x", "y"),
        supplies={"second": PUMP}, valves={"y": {"supply": "second"}},
        accumulators={"gas": {"volume": 1e-3, "precharge": 2e6, "pressure": 3e6}},
        elements={
            "leak": LEAK | {"gain": 2e-12},
            "throttle": {"type": "orifice", "from": "x.a", "to": "gas", "coefficient": 1e-7},
        },
        axis="1 0 0", friction={"viscous": 5e4},
    )  # fmt: skip
    with pytest.warns(crane.CraneWarning, match="linearized where it does not stay"):
        model = crane.linearize(machine)  # gas drives it
    for name in ("pressure_supply", "share_supply", "pressure_second", "pressure_gas"):
        assert name in model.states
    assert np.isfinite(model.A).all()
    rig(
        tmp_path, supply=PUMP | {"response": 0.1, "least": 0.01}, axis="1 0 0",
        elements={"leak": LEAK | {"gain": 2e-12}},
    )  # fmt: skip
    model = without_a_word(crane.linearize, tmp_path / "rig.yaml")
    # V / B p' = Q e - (gain) p with its own time constant, e' = -e / T beside its least
    values = np.linalg.eigvals(model.A)
    for wanted in (-2e-12 * 1.2e9 / 2e-3, -10.0):
        assert np.abs(values - wanted).min() < 1e-9 * abs(wanted)


def test_what_knows_cylinders_alone_says_so(tmp_path):
    machine = everything(tmp_path)
    told = typed(
        "simulate", tmp_path / "rig.yaml", "--out", tmp_path / "run", "--controller",
        "valve-feedforward",
    )  # fmt: skip
    assert told.returncode == 2 and not (tmp_path / "run").exists()
    assert "'x' has a valve that shares its flow: take valve-pd" in told.stderr
    two = crane.load("excavator_two_pumps")
    with pytest.raises(InputError, match="'slew' has a motor: take valve-pd"):
        crane.control.ValveFeedforward(two, crane.task_trajectory(two, "grade"))
    with pytest.raises(InputError, match="that of 'rig' has load-sensing control"):
        crane.identification.excite_valves(machine, ["oil.bulk_modulus"], trials=2)


@pytest.mark.slow
@pytest.mark.long
def test_calibration_finds_numbers_of_pumps_and_elements(tmp_path):
    """From a recording of the truth, by a machine whose throttles are 7 and 15 % off."""
    machine = everything(tmp_path)
    run = crane.simulate(machine, ValveSignals(machine, TIMES, SIGNALS), duration=2.0)
    names = [f"pressure_{joint}_{side}" for joint in "xyzw" for side in "ab"]
    units = {"time": "s", **{f"voltage_{x}": "V" for x in "xyzw"}}
    units |= {x: machine.unit(x) for x in "xyzw"} | dict.fromkeys(names, "Pa")
    columns = [run.channels[x] for x in (*(f"voltage_{x}" for x in "xyzw"), *names)]
    values = np.column_stack([run.time, *columns[:4], *run.q.T, *columns[4:]])
    timeseries.write_table(tmp_path / "run.csv", timeseries.Table(units, values, {}))
    true = {"element.cooler.coefficient": 2e-6, "supply.second.throttle": 6e-7}
    wrong = crane.load(
        tmp_path / "rig.yaml",
        {"element.cooler.coefficient": 2.3e-6, "supply.second.throttle": 6.4e-7},
    )
    found = crane.calibrate(wrong, tmp_path / "run.csv", dict.fromkeys(true)).values
    for name, value in true.items():
        assert found[name] == pytest.approx(value, rel=1e-5)


def test_sensitivities_by_numbers_of_the_circuit(tmp_path):
    """Beside differences of simulations."""
    options = {
        "supply": PUMP | {"response": 0.1},
        "supplies": {"pilot": {"pressure": 1.5e7}},
        "joints": ("x", "y"),
        "valves": {"y": {"supply": "pilot"}},
        "lines": {"back": {"volume": 1e-3}},
        "elements": {
            "cooler": {"type": "orifice", "from": "back", "to": "tank", "coefficient": 3e-7},
        },
        "friction": {"viscous": 1e5},
        "axis": "1 0 0",
    }  # fmt: skip
    options["valves"]["x"] = {"return_b": "back", "return_a": "back"}
    machine = rig(tmp_path, **options)
    signals = {"x": [0.0, 0.0, 0.5], "y": [0.0, 0.0, 0.5]}

    def end(changes):
        other = crane.load(tmp_path / "rig.yaml", changes)
        control = ValveSignals(other, [0.0, 0.1, 0.2], signals)
        return crane.simulate(other, control, duration=0.6, tolerance=1e-11).q[-1]

    names = ("supply.margin", "supply.pilot.pressure", "element.cooler.coefficient")
    found = crane.sensitivities(
        machine,
        ValveSignals(machine, [0.0, 0.1, 0.2], signals),
        duration=0.6,
        parameters=list(names),
    )
    for name in names:
        head = found.values[names.index(name)]
        step = 1e-4 * head
        slope = (end({name: head + step}) - end({name: head - step})) / (2 * step)
        assert slope.any()
        one = [found.derivative(joint, name)[-1] for joint in "xy"]
        np.testing.assert_allclose(one, slope, rtol=2e-3, atol=1e-4 * np.abs(slope).max())


REFUSED = {
    "unknown node": (
        {"elements": {"e": LEAK | {"to": "nowhere"}}}, "to: nowhere", "leads to 'nowhere'"),
    "to itself": ({"elements": {"e": LEAK | {"to": "supply"}}}, "to: supply", "to itself"),
    "node twice": (
        {"lines": {"gas": {"volume": 1e-3}}, "accumulators": {"gas": {"volume": 1e-3,
         "precharge": 1e6}}, "elements": {"e": LEAK | {"to": "gas"}}},
        "gas:", "two nodes are called 'gas'"),
    "node as a chamber": (
        {"lines": {"x_a": {"volume": 1e-3}}, "elements": {"e": LEAK | {"to": "x_a"}}},
        "x_a:", "two nodes are called 'x_a'"),
    "line called tank": (
        {"lines": {"tank": {"volume": 1e-3}}}, "tank:", "two nodes are called 'tank'"),
    "no margin": (
        {"supply": {"control": "load-sensing", "flow": 1e-3}}, "supply:", "has no 'margin'"),
    "no throttle": (
        {"supply": {"control": "negative", "flow": 1e-3, "signal": 1e6, "relief": 2e7}},
        "supply:", "no 'throttle'"),
    "no signal": (
        {"supply": {"control": "negative", "flow": 1e-3, "throttle": 1e-6, "relief": 2e7}},
        "supply:", "no 'signal'"),
    "no relief": (
        {"supply": {"control": "fixed", "flow": 1e-3}}, "supply:", "no 'relief'"),
    "fixed with power": (
        {"supply": {"control": "fixed", "flow": 1e-3, "relief": 2e7, "power": 1e4}},
        "power:", "limits the power of a fixed pump"),
    "no flow": ({"supply": PUMP | {"flow": 0.0}}, "flow:", "has no 'flow'"),
    "control": ({"supply": PUMP | {"control": "sensing"}}, "control:", "'sensing' is unknown, "),
    "summed with nobody": (
        {"supply": PUMP | {"power": 1e4, "summed": ["supply", "third"]}},
        "summed:", "names 'third', give pumps with a power, known: supply"),
    "summed without power": (
        {"supply": PUMP | {"summed": ["supply"]}}, "summed:", "has no 'power'"),
    "curve back": (
        {"valves": {"x": {"c1": [[0, 0], [0.5, 1e-7], [0.5, 2e-7]]}}}, "c1:", "do not increase"),
    "curve outside": (
        {"valves": {"x": {"c1": [[0, 0], [1.5, 1e-7]]}}}, "c1:", "from 0 to 1"),
    "curve empty": ({"valves": {"x": {"c1": []}}}, "c1:", "'c1'"),
    "curve of one": ({"valves": {"x": {"c1": [[0.5, 1e-7]]}}}, "c1:", "two points"),
    "curve of zeros": ({"valves": {"x": {"c1": [[0, 0], [1, 0]]}}}, "c1:", "all values"),
    "curve negative": ({"valves": {"x": {"c1": [[0, 0], [1, -1e-7]]}}}, "c1:", "negative"),
    "curve without drop": (
        {"valves": {"x": {"c1": {"flow": [[0, 0], [1, 1e-3]]}}}}, "c1:", "'drop'"),
    "csv": ({"valves": {"x": {"c1": {"file": "bad.csv", "drop": 1e6}}}}, "c1:", "bad.csv:3"),
    "csv columns": (
        {"valves": {"x": {"c1": {"file": "names.csv", "drop": 1e6}}}}, "c1:", "no columns u and"),
    "csv missing": (
        {"valves": {"x": {"c1": {"file": "no.csv", "drop": 1e6}}}}, "file:", "no file 'no.csv'"),
    "float": ({"valves": {"x": {"float_from": 0.8}}}, "float_from:", "give both"),
    "sharing with margin": (
        {"valves": {"x": {"type": "sharing", "margin": 1e6}}}, "margin:", "'margin'"),
    "exponent": (
        {"accumulators": {"gas": {"volume": 1e-3, "precharge": 1e6, "exponent": 1.0,
         "time_constant": 1.0}}, "elements": {"e": LEAK | {"to": "gas"}}}, "exponent:", "above 1"),
    "unknown supply": ({"valves": {"x": {"supply": "third"}}}, "supply: third", "'third'"),
    "unknown return": (
        {"valves": {"x": {"return_a": "bank"}}}, "return_a:", "leads to 'bank'"),
    "return into a chamber": (
        {"valves": {"x": {"return_a": "x.b"}}}, "return_a:", "leads to 'x.b'"),
    "percent": ({"supply": PUMP | {"least": 5.0}}, "least:", "below 1"),
    "tank again": (
        {"supplies": {"second": PUMP | {"tank": 2e5}}}, "tank:", "unknown key 'tank'"),
    "below the tank": (
        {"supply": {"tank": 3e5}, "supplies": {"second": {"pressure": 2e5}}}, "pressure: 200000",
        "not above the tank's"),
    "floating line": (
        {"lines": {"m": {"volume": 1e-3}}}, "m:", "nothing is joined to the line 'm'"),
    "floating accumulator": (
        {"accumulators": {"gas": {"volume": 1e-3, "precharge": 1e6}}}, "gas:",
        "nothing is joined to the accumulator 'gas'"),
    "side alone": ({"elements": {"e": LEAK | {"side": "out"}}}, "side:", "give their 'joints'"),
    "joint of nobody": ({"elements": {"e": LEAK | {"joints": ["q"]}}}, "joints:", "'q'"),
    "kind": ({"elements": {"e": LEAK | {"type": "valve"}}}, "type:", "'valve' is unknown, known:"),
    "no gain": (
        {"elements": {"e": {"type": "leak", "from": "supply", "to": "tank"}}}, "e:", "'gain'"),
    "name": ({"lines": {"a b": {"volume": 1e-3}}}, "a b:", "use letters, digits, _"),
    "motor and cylinder": (
        {"motors": {"y": {"displacement": 1e-5, "volume": 1e-4}}, "joints": ("x", "y"),
         "cylinders": {"y": {}}}, "y:", "a cylinder and a motor"),
    "engine": ({"engine": {"speed": 0.0, "torque": 1.0, "inertia": 1.0}}, "speed:", "positive"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_is_refused_in_one_line(tmp_path, what):
    more, at, text = REFUSED[what]
    (tmp_path / "bad.csv").write_text("u,flow\n0,0\n0.5,much\n")
    (tmp_path / "names.csv").write_text("stroke,flow\n0,0\n")
    more = dict(more)
    with pytest.raises(DescriptionError) as caught:
        rig(tmp_path, **{"joints": ("x",)} | more)
    line = str(caught.value)
    assert text in line and "\n" not in line, line
    name, number, _ = line.split(":", 2)
    written = (tmp_path / name).read_text().splitlines()[int(number) - 1]
    assert at in written, (written, line)
    before = sorted(tmp_path.iterdir())
    told = typed("simulate", "rig.yaml", "--out", "run", cwd=tmp_path)
    assert told.returncode == 2 and text in told.stderr
    assert len([x for x in told.stderr.splitlines() if x.startswith("error")]) == 1
    assert sorted(tmp_path.iterdir()) == before


def test_everything_is_all_that_there_is():
    """The machine of these tests has every section and every kind of element."""
    assert {"supplies", "engine", "lines", "accumulators", "elements", "motors"} <= ALL.keys()
    kinds = {x["type"] for x in ALL["elements"].values()}
    assert kinds == {"orifice", "check", "relief", "leak"}


# --- short forms --------------------------------------------------------------------------------


MANUAL = Path(__file__).parents[1] / "docs" / "machine_file.md"


@pytest.fixture
def crane_of(tmp_path):
    """The PATU 655 with another circuit."""
    (tmp_path / "bare.yaml").write_text(
        "extends: patu655\nname: bare\nhydraulics: null\ntasks: null\n"
    )

    def load(text):
        path = tmp_path / "own.yaml"
        path.write_text(f"extends: bare.yaml\nname: own\n{textwrap.dedent(text)}")
        return crane.load(path)

    return load


def test_the_crane_of_the_manual_is_ten_lines_and_moves(crane_of):
    text = MANUAL.read_text().split("described in ten lines:\n\n")[1].split("\n\n")[0]
    assert len(text.splitlines()) == 10
    machine = crane_of(text)
    circuit = machine.hydraulics
    assert circuit.joints == machine.active == ("slew", "X_lift", "X_tilt", "X_ext")
    bores = {"X_lift": (0.11, 0.06), "X_tilt": (0.10, 0.056), "X_ext": (0.063, 0.036)}
    for joint, (bore, rod) in bores.items():
        cylinder = circuit.cylinders[joint]
        assert cylinder.area_a == pytest.approx(np.pi / 4 * bore**2, rel=1e-15)
        assert cylinder.area_b == pytest.approx(np.pi / 4 * (bore**2 - rod**2), rel=1e-15)
        assert (cylinder.hose_a, cylinder.relief) == (2e-4, 2.3e7)
    assert circuit.cylinders["slew"].area_a == 60 * 5e-5
    assert all(valve.sharing and valve.bandwidth == 30 for valve in circuit.valves.values())
    levers = {"X_lift": [(0, 0), (1, 0.4), (3, 0.4), (3.2, 0)]}
    run = crane.simulate(machine, crane.joystick(machine, levers), duration=4.0, step=1e-2)
    flow = 0.0  # c y sqrt(p_S - p_LS) with the margin less what the pump droops by
    for _ in range(20):
        flow = 5e-7 * 0.4 * np.sqrt(2e6 - 2e5 * flow / 2.5e-3)
    speed = flow / circuit.cylinders["X_lift"].area_a
    assert run.v[250, 1] == pytest.approx(speed, rel=2e-3)


def test_what_an_item_says_itself_stands(crane_of):
    machine = crane_of("""
        hydraulics:
          supply: {pressure: 2.0e+7}
          cylinders:
            all: {hose_a: 2.0e-4, hose_b: 3.0e-4}
            X_lift: {bore: 0.1, rod: 0.05, count: 2, hose_b: 1.0e-4}
            X_tilt: {area_a: 0.01, area_b: 0.005}
          valves:
            all: {type: orifice, c1: 1.0e-7, c2: 1.0e-7, c3: 1.0e-7, c4: 1.0e-7}
            X_tilt: {c3: 2.0e-7, dead_band: 0.2}
          control:
            all: {kp: 10, kd: 0.1}
        """)
    lift, tilt = machine.hydraulics.cylinders.values()
    assert (lift.hose_a, lift.hose_b, tilt.hose_b) == (2e-4, 1e-4, 3e-4)
    assert lift.area_a == pytest.approx(2 * np.pi / 4 * 0.1**2) and tilt.area_a == 0.01
    one, other = machine.hydraulics.valves.values()
    assert (one.c3, other.c3, one.dead_band, other.dead_band) == (1e-7, 2e-7, 0.0, 0.2)
    assert machine.hydraulics.control["X_lift"].kp == 10


@pytest.mark.parametrize(
    ("lift", "line"),
    [
        ("bore: 0.05, rod: 0.1", r":7: 'bore' .* more than the rod"),
        ("bore: 0.1, area_a: 0.1", r":7: 'area_a' stands beside 'bore'"),
        ("rod: 0.1, area_a: 0.1", r":7: 'rod' .* goes with 'bore'"),
        ("bore: 0.1, count: 1.5", r":7: 'count' .* a whole number"),
        ("bore: 0.1, tube: 0.1", r":7: tube of .* is 0.1 m, it must be more than the bore"),
        ("bor: 0.1", r":7: unknown key 'bor' .*did you mean"),
    ],
)  # fmt: skip
def test_wrong_bores_are_told(crane_of, lift, line):
    text = f"""
        hydraulics:
          supply: {{pressure: 2.0e+7}}
          cylinders:
            X_lift: {{{lift}, hose_a: 1.0e-4, hose_b: 1.0e-4}}
          valves:
            all: {{type: orifice, c1: 1.0e-7, c2: 1.0e-7, c3: 1.0e-7, c4: 1.0e-7}}
        """
    with pytest.raises(CraneError) as caught:
        crane_of(text)
    assert re.search(line, str(caught.value)), caught.value
