"""Lifting capacity with limits of pin forces and buckling, against statics by hand."""

import dataclasses
import re
import shutil

import numpy as np
import pytest
from broken_machines import MODELS
from free_bodies import balance
from scipy.optimize import brentq
from test_capacity import G, cells

import crane
from crane.description.machine_parameters import parameter_unit

PINS = {"boom": 260e3, "boom_eye": 250e3, "X_arm": 30e3}


@pytest.fixture(scope="module")
def excavator(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pins") / "models"
    shutil.copytree(MODELS, folder)
    text = f"\npins: {PINS}\n".replace("'", "")
    (folder / "excavator.yaml").write_text((folder / "excavator.yaml").read_text() + text)
    return crane.load(folder / "excavator.yaml")


@pytest.fixture(scope="module")
def chart(excavator):
    return crane.capacity(
        excavator, "bucket", rule=crane.ratings.Rule("own", "", structural=0.8), step=1.0
    )


def force(machine, q, load, name):
    return np.linalg.norm(balance(machine, q, G, load, "bucket")[1][name][:3])


def test_pins_end_loads_where_statics_by_hand_has_their_limit(excavator, chart):
    ends = {
        chart.limiting_factors[k].element
        for k in chart.active_factors
        if chart.limiting_factors[k].reason == "pin force"
    }
    assert ends == set(PINS)
    for cell in map(tuple, cells(chart, 25)):
        q = excavator.closure.solve(chart.q_a[cell])
        for k, cause in enumerate(chart.limiting_factors):
            if cause.reason != "pin force":
                continue
            found = chart.values_by_factor[cell][k] / 0.8
            if not found:
                assert force(excavator, q, 0.0, cause.element) >= PINS[cause.element]
                continue

            def left(load, name=cause.element, q=q):
                return force(excavator, q, load, name) - PINS[name]

            samples = [left(load) for load in np.linspace(0, found * (1 - 1e-9), 5)]
            assert max(samples) <= 0
            assert found == pytest.approx(brentq(left, 0, 2 * found, rtol=1e-12), rel=1e-9)


def test_pin_forces_and_margins_are_those_of_statics_by_hand(excavator, chart):
    forces, margins = chart.pin_forces(), chart.buckling()
    assert set(forces) == set(crane.dynamics.Reactions(excavator).names)
    assert set(margins) == {"X_boom", "X_arm", "X_bucket"}
    loads = crane.dynamics.Buckling(excavator)
    for cell in map(tuple, cells(chart, 5, seed=1)):
        q = excavator.closure.solve(chart.q_a[cell])
        drives, pins = balance(excavator, q, G, chart.loads[cell], "bucket")
        most = max(np.linalg.norm(pin[:3]) for pin in pins.values())
        for name, pin in pins.items():
            assert forces[name][cell] == pytest.approx(np.linalg.norm(pin[:3]), abs=1e-9 * most)
        for joint, column in loads.columns.items():
            load = column.buckling_load(q[excavator.column(joint)])
            pressed = column.compression_sign * drives[joint]
            margin = load / pressed if pressed > 0 else np.inf
            assert margins[joint][cell] == pytest.approx(float(margin), rel=1e-9)
    none = np.isnan(chart.loads)
    assert none.any()
    assert all(np.isnan(x[none]).all() for x in (*forces.values(), *margins.values()))
    text = chart.to_markdown()
    assert "X_arm 30 kN (pin force)" in text and "by tipping or by pins" in text
    name = max(set(forces) - {"X_boom", "X_arm", "X_bucket"}, key=lambda x: np.nanmax(forces[x]))
    assert re.search(f"in a pin: {name} +[|] +{np.nanmax(forces[name]) / 1e3:.1f} kN", text)
    first = min(margins, key=lambda x: np.nanmin(margins[x]))
    assert re.search(f"buckle: {first} +[|] +{np.nanmin(margins[first]):.3g} times", text)


def test_margins_on_a_slope_are_those_of_the_worst_side(excavator):
    """The worst direction of a slope equals that of many single directions."""
    slope = 0.1
    bare = crane.load("excavator")
    chart = crane.capacity(bare, "bucket", radii=[5.0, 7.0], heights=[0.0, 2.0], slope=slope)
    margins, columns = chart.buckling(), crane.dynamics.Buckling(bare).columns
    cell = tuple(np.argwhere(np.isfinite(chart.loads))[0])
    q = bare.closure.solve(chart.q_a[cell])
    least = dict.fromkeys(columns, np.inf)
    for side in np.linspace(0, 2 * np.pi, 181):
        way = [np.sin(slope) * np.cos(side), np.sin(slope) * np.sin(side), -np.cos(slope)]
        drives, _ = balance(bare, q, 9.81 * np.array(way), chart.loads[cell], "bucket")
        for joint, column in columns.items():
            if (pressed := column.compression_sign * drives[joint]) > 0:
                load = float(column.buckling_load(q[bare.column(joint)]))
                least[joint] = min(least[joint], load / pressed)
    for joint, margin in least.items():
        assert margins[joint][cell] == pytest.approx(margin, rel=1e-4)
    with pytest.raises(crane.CraneError, match="slopes by 5.73 degrees: rate without slope"):
        chart.pin_forces()
    assert "in a pin" not in chart.to_markdown() and "first to buckle" in chart.to_markdown()


def test_derivatives_are_left_out_where_a_pin_ends_the_load(excavator):
    more = {"pins.boom": 7e5, "pins.boom_eye": 9e5, "pins.X_arm": 9e5}
    machine, bare = crane.load(excavator.path, changes=more), crane.load("excavator")
    chart, without = (crane.capacity(x, "bucket", step=1.0, slews=[0.0]) for x in (machine, bare))
    slopes, free = (x.derivatives(["arm.mass"])[..., 0] for x in (chart, without))
    pins = np.array([cause.reason == "pin force" for cause in chart.limiting_factors] + [False])[
        chart.limiting_factor_index
    ]
    same = (chart.limiting_factor_index == without.limiting_factor_index) & (without.loads > 0)
    assert pins.sum() > 3 and np.isnan(slopes[pins]).all()
    assert same.sum() > 3 and slopes[same] == pytest.approx(free[same], rel=1e-9)


def test_pins_are_read_written_and_changed(excavator, tmp_path):
    assert dict(excavator.pin_capacities) == PINS
    written = crane.write_machine(excavator, tmp_path / "written", {"pins.boom": "from a drawing"})
    assert dict(crane.load(written).pin_capacities) == PINS
    assert re.search("boom: 260000.0 +# from a drawing", written.read_text())
    more = crane.load(excavator.path, changes={"pins.boom": 5e5})
    assert dict(more.pin_capacities) == PINS | {"boom": 5e5}
    assert "X_arm" not in crane.load(excavator.path, lock={"X_arm": 0.5}).pin_capacities
    assert not crane.load("excavator").pin_capacities


def test_pins_that_are_not_there_are_named(excavator):
    odd = dataclasses.replace(excavator, pin_capacities={"bom": 1e5})
    with pytest.raises(crane.CraneError, match="'bom' is no joint or loop, did you mean 'boom'"):
        crane.capacity(odd, "bucket", radii=[6.0], heights=[1.0])
    assert parameter_unit(excavator.tree, "pins.boom") == "N"


@pytest.mark.parametrize(
    ("change", "given", "said"),
    [
        ({"pins.boom": 0.0}, {}, "'pins.boom' is 0 N, give a force above 0"),
        ({"pins.bom": 1.0}, {}, "'pins.bom' is unknown, did you mean 'pins.boom'"),
        ({}, {"slope": 0.1}, "rated on level ground, but the ground slopes by 5.73 degrees"),
        ({}, {"rule": "sfs4677"}, "rated on level ground, but the ground slopes by 5 degrees"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(excavator, change, given, said):
    with pytest.raises(crane.CraneError, match=said) as error:
        crane.capacity(crane.load(excavator.path, changes=change), "bucket", **given)
    assert "\n" not in str(error.value)
