"""Power balance of hydraulic runs: closed forms, balances, figures and table."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from command_line import typed
from executed_lines import at_most
from full_circuit import ALL, SIGNALS, TIMES, everything
from hydraulic_rig import AREA_A, AREA_B, COMPENSATED, ORIFICE, rig

import crane
from crane.recordings import Recording
from crane.studies.power_balance_result import PowerComparison
from crane.view.plots.power_figure import power_comparison_figure, power_figure
from crane.view.plots.sankey_diagram import sankey_figure

G, SUPPLY, TANK, SPEED = 9.81, 9.25e6, 1e5, 0.05


def lifted(folder, valve, pressure_b, **more):
    """A recording made by hand: a mass rises at constant speed; machine, recording, its weight."""
    force = AREA_A * 6e6 - AREA_B * pressure_b
    machine = rig(folder, valve, mass=(force - 300.0 * SPEED) / G)
    time = np.linspace(0.0, 0.5, 51)
    constant = {"pressure_x_a": 6e6, "pressure_x_b": pressure_b, **more}
    recording = Recording(
        time=time, joints=("x",), q=0.1 + SPEED * time[:, None], v=np.full((51, 1), SPEED),
        tau=np.full((51, 1), force), units={"x": "m"},
        channels={name: np.full(51, value) for name, value in constant.items()},
    )  # fmt: skip
    return machine, recording, force - 300.0 * SPEED


@pytest.mark.parametrize("kind", ["orifice", "compensated"])
def test_a_mass_that_rises_at_constant_speed(tmp_path, kind):
    """By hand: Q dp at every edge, m g v, and what leaves the tank and comes back to it."""
    into, out = AREA_A * SPEED, AREA_B * SPEED
    if kind == "orifice":
        u = into / (4e-7 * np.sqrt(SUPPLY - 6e6))
        back, edge, given = TANK + (out / (5e-7 * u)) ** 2, SUPPLY - 6e6, {"voltage_x": u}
        valve = ORIFICE
    else:
        y = into / (40 / 6e4)
        back, edge = TANK + (out / (y * 40 / 6e4 / np.sqrt(7e5))) ** 2, 7e5
        given = {"spool_x": 0.1143 + (1 - 0.1143) * y}
        valve = COMPENSATED
    machine, recording, weight = lifted(tmp_path, valve, back, **given)
    account = crane.power_balance(machine, recording)
    expected = {
        "supply.shaft": into * (SUPPLY - TANK),
        "x.inlet": into * edge,
        "x.compensator": into * (SUPPLY - 6e6 - edge),
        "x.outlet": out * (back - TANK),
        "x.friction": 300.0 * SPEED**2,
        "x.load": weight * SPEED,
        "tank.stored": TANK * (out - into),
    }
    zero = np.zeros_like(account.time)
    for name, power in expected.items():
        found = account.powers.get(name, zero)
        np.testing.assert_allclose(found, power, rtol=1e-6, atol=1e-9, err_msg=name)
        assert account.integrate_energy(found) == pytest.approx(0.5 * power, rel=1e-6, abs=1e-9)
    others = [x for name, x in account.powers.items() if name not in expected]
    assert all(np.abs(x).max() < 1e-9 * account.shaft_power[0] for x in others)
    assert account.mean_power(account.shaft_power) == pytest.approx(
        expected["supply.shaft"], rel=1e-6
    )
    totals = account.totals
    assert totals["load"] == pytest.approx(0.5 * weight * SPEED, rel=1e-6)
    lost = 0.5 * sum(expected[f"x.{what}"] for what in ("inlet", "compensator", "outlet"))
    assert totals["lost"] == pytest.approx(lost + 0.5 * 300.0 * SPEED**2, rel=1e-6)


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """Pumps on an engine, and one of everything that a circuit can have."""
    cylinders = ALL["cylinders"] | {"x": ALL["cylinders"]["x"] | {"seal_friction": 2e-4}}
    friction = {"viscous": 2e4, "coulomb": 200.0, "smoothing": 1e-3}
    folder = tmp_path_factory.mktemp("mixed")
    machine = everything(folder, cylinders=cylinders, friction=friction)
    signals = crane.control.ValveSignals(machine, TIMES, SIGNALS)
    return machine, crane.simulate(machine, signals, duration=3.0, step=2e-4)


@pytest.fixture(scope="module")
def patu():
    machine = crane.load("patu655")
    levers = crane.joystick(machine, "stir")
    return machine, crane.simulate(machine, levers, duration=6.0, step=1e-3)


@pytest.fixture(scope="module")
def digging():
    machine = crane.load("excavator")
    levers = crane.joystick(machine, "dig")
    return machine, crane.simulate(machine, levers, duration=4.0, step=1e-2)


@pytest.mark.parametrize("which", ["mixed", "patu", "digging"])
def test_shafts_are_the_sum_of_all_others(request, which):
    machine, recording = request.getfixturevalue(which)
    account = crane.power_balance(machine, recording)
    largest = max(np.abs(power).max() for power in account.powers.values())
    assert np.abs(account.residual).max() <= 1e-9 * largest
    totals = account.totals
    others = sum(energy for kind, energy in totals.items() if kind != "shaft")
    assert totals["shaft"] == pytest.approx(others, rel=1e-9)
    assert totals["shaft"] > 0
    assert totals["lost"] > 0


def test_everything_is_told(mixed):
    """A circuit with one of everything has power in all of it, and losses are losses."""
    account = crane.power_balance(*mixed)
    busy = {name for name, power in account.powers.items() if np.abs(power).max() > 0.1}
    assert busy >= {
        "supply.shaft", "second.shaft", "supply.friction", "supply.slip", "second.bypass",
        "x.inlet", "x.compensator", "x.outlet", "x.damper", "x.spring", "x.stored", "x.leak",
        "x.refill", "x.friction", "x.load", "y.inlet", "y.outlet", "y.load", "w.relief", "z.leak",
        "cooler.element", "fill.element", "drain.element", "suspension.element", "warm.stored",
        "return.stored", "warm.cooling", "tank.stored",
    }  # fmt: skip
    signed = ("shaft", "load", "stored", "spring", "cooling")
    for name, power in account.powers.items():
        if name.rpartition(".")[2] not in signed:
            assert power.min() >= -1e-9 * np.abs(account.shaft_power).max(), name


@pytest.mark.parametrize("which", ["mixed", "patu"])
def test_energies_are_the_integrals_of_the_simulation(request, which):
    """The trapezoidal rule at 1 ms and finer, beside what was integrated along.

    But for the first tenth of a second, in which pumps fill their lines within a few samples.
    """
    machine, recording = request.getfixturevalue(which)
    recording = recording.between(0.1, recording.time[-1])
    account = crane.power_balance(machine, recording)
    energy, pumps = account.energies, account.pumps
    gained = {name: x[-1] - x[0] for name, x in recording.channels.items()}

    def total(kind):
        return sum(x for name, x in energy.items() if kind(*name.rsplit(".", 1)))

    heat = total(lambda owner, what: owner in pumps and what == "friction")
    tank = energy["tank.stored"]
    friction = total(lambda owner, what: owner in machine.active and what == "friction")
    work = friction + account.totals["load"]
    found = {
        "pump_work": account.totals["shaft"] - heat - tank,
        "hydraulic_loss": account.totals["lost"] - heat - friction,
        "oil_energy": account.totals["stored"] - tank,
        "work": work,
    }
    for name, value in found.items():
        assert value == pytest.approx(gained[name], abs=1e-4 * gained["pump_work"]), name


def test_an_engine_turns_its_pumps_and_itself(mixed):
    """What it gives: the shafts, and J/2 w^2 of its own inertia; fuel by that and by time."""
    machine, recording = mixed
    account = crane.power_balance(machine, recording)
    speed = recording.channels["engine_speed"]
    kinetic = 0.5 * 1.5 * (speed[-1] ** 2 - speed[0] ** 2)
    given = account.integrate_energy(account.engine_power)
    shafts = account.energies["supply.shaft"] + account.energies["second.shaft"]
    assert given == pytest.approx(shafts + kinetic, rel=1e-4)
    assert abs(kinetic) > 1e-2 * given
    assert account.fuel_mass == pytest.approx(3e-4 * 3.0 + 6e-8 * given, rel=1e-9)
    assert account.fuel_volume == pytest.approx(account.fuel_mass / 840.0)
    assert f"{1e6 * account.fuel_mass / 840:.4g} ml" in account.to_markdown()


def test_no_engine_no_fuel(patu):
    account = crane.power_balance(*patu)
    assert account.engine_power is None
    assert account.fuel_mass is None
    assert "fuel" not in account.to_markdown()


@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_a_recording_that_was_read_tells_the_same(patu, tmp_path, suffix):
    machine, recording = patu
    path = tmp_path / f"run.{suffix}"
    if suffix == "csv":
        recording.to_csv(path)
    else:
        units = {name: "" for name in recording.columns()} | recording.channel_units
        units |= {"time": "s"} | recording.units
        for joint, unit in recording.units.items():
            units |= {f"{joint}_velocity": f"{unit}/s"}
            units |= {f"{joint}_force": "N m" if unit == "rad" else "N"}
        columns = recording.columns()
        np.savez(path, **{f"{x} [{unit}]" if unit else x: columns[x] for x, unit in units.items()})
    first = crane.power_balance(machine, recording)
    again = crane.power_balance(machine, Recording.read(path))
    assert [*again.powers] == [*first.powers]
    for name, power in first.powers.items():
        np.testing.assert_allclose(again.powers[name], power, rtol=1e-12, atol=1e-9)


def test_a_measured_supply_is_taken_as_it_is(patu):
    """Without a record of its pump: the line gives what the valves draw, and stores nothing."""
    machine, recording = patu
    first = crane.power_balance(machine, recording)
    there = {x: y for x, y in recording.channels.items() if x not in ("share_supply",)}
    there.pop("shaft_supply")
    measured = replace(recording, channels=there, channel_units={})
    account = crane.power_balance(machine, measured)
    drawn = first.shaft_power - first.powers["supply.stored"]
    net = first.powers["supply.stored"] / recording.channels["pressure_supply"]
    drawn += net * recording.channels["pressure_tank"]  # oil that the line kept leaves no tank
    np.testing.assert_allclose(account.shaft_power, drawn, atol=1e-9 * first.shaft_power.max())
    assert np.abs(account.residual).max() <= 1e-9 * first.shaft_power.max()
    assert np.abs(drawn - first.shaft_power).max() > 1e-6 * first.shaft_power.max()


@pytest.mark.parametrize(("which", "joint"), [("patu", "X_lift"), ("mixed", "x")])
def test_friction_is_the_machine_s_where_none_is_recorded(request, which, joint):
    """That of seals under pressure, too."""
    machine, recording = request.getfixturevalue(which)
    first = crane.power_balance(machine, recording)
    kept = {x: y for x, y in recording.channels.items() if not x.startswith("friction_")}
    account = crane.power_balance(machine, replace(recording, channels=kept, channel_units={}))
    moving = np.abs(recording.v[:, machine.active.index(joint)]) > 1e-2
    assert moving.any()
    for name in (f"{joint}.friction", f"{joint}.load"):
        found, expected = account.powers[name][moving], first.powers[name][moving]
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6, err_msg=name)


def test_missing_channels_are_refused_in_one_line(patu):
    machine, recording = patu
    gone = ("pressure_X_lift_a", "spring_X_lift", "spool_X_ext")
    kept = {name: x for name, x in recording.channels.items() if name not in gone}
    with pytest.raises(crane.CraneError) as error:
        crane.power_balance(machine, replace(recording, channels=kept, channel_units={}))
    text = str(error.value)
    assert text == (
        "columns are missing: 'pressure_X_lift_a', 'spring_X_lift', 'spool_X_ext' "
        "(power_balance needs what a simulation on valves records)"
    )


def test_the_wrong_machine_is_refused(patu, digging, tmp_path):
    with pytest.raises(crane.CraneError, match=r"'X_boom'.* of 'excavator' not recorded"):
        crane.power_balance(digging[0], patu[1])
    with pytest.raises(crane.CraneError, match="has no valves"):
        crane.power_balance(crane.load("mini_forwarder"), patu[1])
    machine = rig(tmp_path)
    time = np.linspace(0, 1, 5)
    column = np.ones((5, 1))
    turned = Recording(time, ("x",), column, column, column, {"x": "rad"})
    with pytest.raises(crane.CraneError, match=r"'x' is in \[rad\]"):
        crane.power_balance(machine, turned)
    moved = {"pressure_x_a": time + 1e6, "pressure_x_b": time + 1e6, "spool_x": time}
    bars = Recording(time, ("x",), column, column, column, {"x": "m"}, moved,
                     {"pressure_x_a": "bar"})  # fmt: skip
    with pytest.raises(crane.CraneError, match=r"'pressure_x_a' is in \[bar\]"):
        crane.power_balance(machine, bars)


def test_samples_cost_no_python(patu):
    """The number of executed lines is independent of the number of samples."""
    machine, recording = patu
    crane.power_balance(machine, recording)
    lines = []
    for part in (recording.between(0.0, 1.0), recording):
        with at_most(10_000_000) as work:
            crane.power_balance(machine, part)
        lines.append(work.lines)
    assert lines[1] <= 1.05 * lines[0]


def test_the_command_writes_all(patu, tmp_path):
    patu[1].to_csv(tmp_path / "recording.csv")
    done = typed(
        "power", "patu655", tmp_path, "--from", "2", "--until", "4", "--out", tmp_path / "out"
    )
    assert done.returncode == 0, done.stderr
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["power.csv", "power.md", "power.png", "sankey.png"]
    assert "| X_lift: compensator |" in done.stdout
    assert "\n2 s; share" in done.stdout
    assert (tmp_path / "out/power.md").read_text() in done.stdout
    table = crane.recordings.table_reader.read_csv(tmp_path / "out/power.csv")
    columns = dict(zip(table.units, table.values.T, strict=True))
    others = sum(x for name, x in columns.items() if name not in ("time", "supply.shaft"))
    np.testing.assert_allclose(columns["supply.shaft"], others, rtol=1e-9, atol=1e-6)
    assert set(table.units.values()) == {"s", "W"}


def test_the_command_refuses_in_one_line(patu, tmp_path):
    recording = patu[1]
    kept = {name: x for name, x in recording.channels.items() if "pressure" not in name}
    replace(recording, channels=kept, channel_units={}).to_csv(tmp_path / "run.csv")
    done = typed("power", "patu655", tmp_path / "run.csv", "--out", tmp_path / "out")
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert "'pressure_X_lift_a'" in done.stderr
    assert not (tmp_path / "out").exists()


def test_one_sample_and_a_machine_at_rest_have_tables_and_pictures(patu, tmp_path):
    """A duration or an energy of zero causes no division by zero."""
    machine, recording = patu
    account = crane.power_balance(machine, recording.between(0.0, 0.0))
    assert account.mean_power(account.shaft_power) == account.shaft_power[0]
    assert set(account.totals.values()) == {0.0}
    for shown in (account, crane.power_balance(machine, recording.between(0.0, 0.5))):
        assert "nan" not in shown.to_markdown()
        sankey_figure(shown)
        power_figure(shown)


@pytest.mark.parametrize("which", ["mixed", "digging"])
def test_pictures_have_words_that_do_not_overlap(request, which):
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    account = crane.power_balance(*request.getfixturevalue(which))
    for draw in (sankey_figure, power_figure):
        figure = draw(account)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        shown = [x for axes in figure.axes for x in axes.texts if x.get_text()]
        boxes = [x.get_window_extent(canvas.get_renderer()) for x in shown]
        for (one, box), (other, beside) in itertools.combinations(
            zip(shown, boxes, strict=True), 2
        ):
            assert not box.overlaps(beside), (one.get_text(), other.get_text())
        for text, box in zip(shown, boxes, strict=True):
            assert box.x0 >= 0, text
            assert box.x1 <= figure.bbox.x1, text
            assert box.y0 >= 0, text
    shaft = account.energies["supply.shaft"] / 1e3
    assert any(f"{shaft:.3g} kJ" in x.get_text() for x in sankey_figure(account).axes[0].texts)


def compared(patu, **more):
    account = crane.power_balance(*patu)
    half = crane.power_balance(patu[0], patu[1].between(0.0, 3.0))
    return PowerComparison({"whole run": account, "half": half}, **more)


def test_runs_beside_each_other(patu):
    """Each one's classes sum to its shafts; time, peak, work per mass as by hand."""
    found = compared(patu, moved_mass=500.0)
    for run, account in found.balances.items():
        assert sum(found.energy_by_class(run).values()) == pytest.approx(
            account.totals["shaft"], rel=1e-9
        )
    whole = found.balances["whole run"]
    assert found.energy_by_class("whole run")["load"] == pytest.approx(
        whole.totals["load"], rel=1e-12
    )
    rows = {
        cells[0]: cells[1:]
        for line in found.to_markdown().splitlines()
        if len(cells := [cell.strip() for cell in line.strip("|").split("|")]) == 3
    }
    assert rows["time [s]"] == ["6.00", "3.00"]
    peaks = [f"{x.shaft_power.max() / 1e3:.1f}" for x in found.balances.values()]
    assert rows["peak of them [kW]"] == peaks
    work = np.trapezoid(whole.shaft_power, whole.time)
    assert rows["work per kg of 500 [J/kg]"][0] == f"{work / 500:.0f}"
    assert "fuel [g]" not in rows


def test_a_picture_of_runs_beside_each_other(patu, mixed):
    """Its words do not overlap, and stay within."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    four = {name: crane.power_balance(*mixed) for name in "abcd"}
    for comparison in (compared(patu), PowerComparison(four)):
        figure = power_comparison_figure(comparison)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        bars = figure.axes[1]
        words = [*bars.texts, *bars.get_yticklabels(), *figure.legends[0].get_texts()]
        boxes = [x.get_window_extent(canvas.get_renderer()) for x in words]
        for one, other in itertools.combinations(boxes, 2):
            assert not one.overlaps(other)
        for box in boxes:
            assert box.x0 >= 0 and box.y0 >= 0
            assert box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1
    assert f"| fuel [g] | {1e3 * four['a'].fuel_mass:.1f} |" in PowerComparison(four).to_markdown()


def test_the_command_compares(patu, tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        patu[1].to_csv(tmp_path / name / "recording.csv")
    paths = tmp_path / "one", "--compare", tmp_path / "two"
    done = typed("power", "patu655", *paths, "--moved-mass", "211", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert sorted(x.name for x in (tmp_path / "out").iterdir()) == [
        "comparison.md", "comparison.png",
    ]  # fmt: skip
    assert "| one | two |" in done.stdout
    for options, line in (
        (
            ("--moved-mass", "211"),
            "--moved-mass is for a comparison, name the other runs with --compare",
        ),
        (("--compare", tmp_path / "one"), "is given twice, leave one out"),
        (("--compare", tmp_path / "no"), "no"),
        (
            ("--compare", tmp_path / "two", "--moved-mass", "0"),
            "the moved mass is 0.0 kg, give a number above 0",
        ),
    ):
        done = typed("power", "patu655", tmp_path / "one", *options, "--out", tmp_path / "bad")
        assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
        assert line in done.stderr and not (tmp_path / "bad").exists()
