"""Lifting capacity, pins and buckling against statics by hand and brute force."""

import dataclasses
import re
import shutil

import numpy as np
import pytest
import urdf_text
from broken_machines import MODELS
from free_bodies import balance, moment, places
from scipy.optimize import brentq, root

import crane
from crane.description.machine_parameters import parameter_unit
from crane.formats.machine_loading import MachineVariants
from crane.ratings.configuration_search import ConfigurationSearch
from crane.ratings.lifting_capacity import torques

G = np.array([0.0, 0.0, -9.81])
PUMP = 3.5e7  # of the excavator [Pa]


def cells(chart, count, seed=0):
    """Some that are reached: slew, height, radius."""
    reached = np.argwhere(np.isfinite(chart.loads))
    return reached[np.random.default_rng(seed).choice(len(reached), count, replace=False)]


def strength(machine, chart, joint, slope):
    """What a cylinder exerts at most against a load that asks for more with this sign."""
    cylinder, supply = machine.hydraulics.cylinders[joint], machine.hydraulics.supply
    pressure = supply.pressure if joint in chart.raising_joints else cylinder.relief
    a, b, tank = cylinder.area_a, cylinder.area_b, supply.tank
    return pressure * a - tank * b if slope > 0 else tank * a - pressure * b


def by_hand(machine, chart, q):
    """The load of every cause at a posture, from two balances of all links: [kg]."""
    (none, _), (some, _) = (balance(machine, q, G, m, chart.frame) for m in (0.0, 1000.0))
    found = {}
    for joint in machine.hydraulics.joints:
        slope = (some[joint] - none[joint]) / 1000.0
        if joint != "slew":  # which a level load does not turn
            end = strength(machine, chart, joint, slope)
            found[joint] = chart.rule.hydraulic * max((end - none[joint]) / slope, 0.0)
    at = places(machine, q)
    for cause in chart.limiting_factors:
        if cause.reason != "tips":
            continue
        one, two = (at[name][:3, 3] for name in cause.element.split(" to "))
        held, pulled = (moment(machine, q, G, m, chart.frame, one, two) for m in (0.0, 1000.0))
        slope = (pulled - held) / 1000.0
        found[cause.element] = chart.rule.tipping * (
            max(-held / slope, 0.0) if slope > 0 else np.inf
        )
    return found


def test_every_cell_is_what_statics_by_hand_give(excavator):
    """At the bucket's pin, by ISO 10567, over the front and over the side."""
    chart = crane.capacity(excavator, "bucket", rule="iso10567")
    assert chart.raising_joints == ("X_boom",) and len(chart.slews) == 2
    for cell in cells(chart, 40):
        s, b, a = cell
        found = by_hand(excavator, chart, excavator.closure.solve(chart.q_a[s, b, a]))
        for k, cause in enumerate(chart.limiting_factors):
            load = found.get(cause.element, np.inf)
            if load < 1e9:  # what has no lever but that of rounding has no load
                assert chart.values_by_factor[s, b, a, k] == pytest.approx(load, rel=1e-9)
        assert chart.loads[s, b, a] == pytest.approx(min(found.values()), rel=1e-9)
        tip = crane.Kinematics(excavator, "bucket").position(chart.q_a[s, b, a])
        away = [np.hypot(tip[0], tip[1]), tip[2]]
        assert away == pytest.approx([chart.radii[a], chart.heights[b]], abs=1e-9)


@pytest.mark.slow
def test_every_cause_is_reached(excavator):
    chart = crane.capacity(excavator, slews=[0.0, np.pi / 2, np.pi], rule="iso10567", step=1.0)
    ends = {str(chart.limiting_factors[k]) for k in chart.active_factors}
    assert {"X_boom: working pressure", "X_arm: holding pressure"} <= ends
    assert {"tips over track_front_right to track_front_left",
            "tips over track_front_left to track_rear_left",
            "tips over track_rear_left to track_rear_right"} <= ends  # fmt: skip
    held = crane.capacity(excavator, raising=["X_boom", "X_arm"], step=1.0)
    assert "X_bucket: holding pressure" in {
        str(held.limiting_factors[k]) for k in held.active_factors
    }
    slope = crane.capacity(
        crane.load("patu655", changes={"supply.pressure": 1.9e7}), slope=np.deg2rad(35), step=1.0
    )
    assert "slew: working pressure" in {
        str(slope.limiting_factors[k]) for k in slope.active_factors
    }


@pytest.mark.slow
def test_a_slope_is_the_worst_of_all_sides(excavator):
    """Gravity that leans to 180 sides, none worse and one as bad."""
    lean, joints = np.deg2rad(8.0), excavator.hydraulics.joints
    chart = crane.capacity(excavator, "bucket", rule="iso10567", slope=lean)
    for cell in cells(chart, 2, seed=1):
        q = excavator.closure.solve(chart.q_a[tuple(cell)])
        sides = np.linspace(0, 2 * np.pi, 181)
        least, gaps, ups = np.inf, [], []
        at = places(excavator, q)
        for axis in np.eye(3):  # all is linear in gravity
            (none, _), (some, _) = (balance(excavator, q, axis, m, "bucket") for m in (0, 1.0))
            gaps.append([none[joint] for joint in joints])
            ups.append([some[joint] - none[joint] for joint in joints])
        for side in sides:
            g = 9.81 * np.array(
                [np.sin(lean) * np.cos(side), np.sin(lean) * np.sin(side), -np.cos(lean)]
            )
            for joint, rest, slope in zip(joints, g @ gaps, g @ ups, strict=True):
                if abs(slope) < 1e-6:  # no lever but that of rounding
                    continue
                end = strength(excavator, chart, joint, slope)
                least = min(least, 0.87 * max((end - rest) / slope, 0.0))
            for cause in chart.limiting_factors:
                if cause.reason == "tips":
                    one, two = (at[name][:3, 3] for name in cause.element.split(" to "))
                    held = moment(excavator, q, g, 0.0, "bucket", one, two)
                    slope = moment(excavator, q, g, 1.0, "bucket", one, two) - held
                    if slope > 0:
                        least = min(least, 0.75 * max(-held / slope, 0.0))
        load = chart.loads[tuple(cell)]
        assert load <= least * (1 + 1e-9)
        assert load == pytest.approx(least, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "free"), [("excavator", "X_bucket"), ("patu655", "X_ext")])
def test_of_many_postures_it_is_the_one_that_carries_most(name, free):
    """Its third stroke moved to both sides by 30 steps, the tip held: nothing carries more."""
    machine = crane.load(name, changes={"supply.pressure": 1.9e7} if name == "patu655" else {})
    chart = crane.capacity(machine, slews=[0.0])
    kinematics, i = crane.Kinematics(machine), machine.active.index(free)
    span = machine.upper - machine.lower
    others = [k for k in (1, 2, 3) if k != i]
    tried = 0
    for _, b, a in cells(chart, 5):
        best, target = chart.q_a[0, b, a], np.array([chart.radii[a], chart.heights[b]])
        load = chart.loads[0, b, a]
        hand = min(by_hand(machine, chart, machine.closure.solve(best)).values())
        assert load == pytest.approx(hand, rel=1e-8)
        for step in (-1 / 30, 1 / 30, -1e-4, 1e-4):
            q_a = best.copy()
            for _ in range(30):
                q_a[i] += step * span[i]

                def miss(pair, q_a=q_a, target=target):
                    q_a = q_a.copy()
                    q_a[others] = pair
                    return kinematics.position(q_a)[[0, 2]] - target

                try:
                    found = root(miss, q_a[others], tol=1e-12)
                except crane.CraneError:
                    break
                q_a[others] = found.x
                if not found.success or (np.abs(q_a - machine.lower - span / 2) > span / 2).any():
                    break
                there = min(by_hand(machine, chart, machine.closure.solve(q_a)).values())
                assert there <= load * (1 + 1e-7)
                tried += 1
                if abs(step) < 1e-3:
                    break
    assert tried > 40


def test_friction_and_pressure_count(excavator):
    at = {"radii": [6.0], "heights": [1.5], "frame": "bucket", "raising": ["X_boom"]}
    free, rubbed = (crane.capacity(excavator, friction=x, **at) for x in (False, True))
    k = [str(cause) for cause in free.limiting_factors].index("X_boom: working pressure")
    q = excavator.closure.solve(free.q_a[0, 0, 0])
    (none, _), (some, _) = (balance(excavator, q, G, m, "bucket") for m in (0.0, 1.0))
    slope = some["X_boom"] - none["X_boom"]
    lost = free.values_by_factor[0, 0, 0, k] - rubbed.values_by_factor[0, 0, 0, k]
    assert lost == pytest.approx(20000.0 / slope, rel=1e-8)  # Coulomb and stiction of the file
    half = crane.capacity(crane.load("excavator", changes={"supply.pressure": PUMP / 2}), **at)
    less = free.values_by_factor[0, 0, 0, k] - half.values_by_factor[0, 0, 0, k]
    assert less == pytest.approx(PUMP / 2 * 2.2619467e-2 / slope, rel=1e-9)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"rule": "iso"}, "rule 'iso' is unknown"),
        ({"frame": "nothing"}, "frame 'nothing' is unknown"),
        ({"raising": ["boom"]}, "'boom' drives nothing"),
        ({"slope": 2.0}, "the slope is 2.0 rad"),
        ({"step": 1e-4}, "more than 400 cells"),
        ({"slews": [9.0]}, "'slew' turns from"),
        ({"radii": [3.0, 2.0]}, "radii must be numbers that rise"),
        ({"radii": [30.0]}, "reaches none of these positions"),
        ({"frame": "upper"}, "what moves .upper. in its section is nothing"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(excavator, given, said):
    with pytest.raises(crane.CraneError, match=said) as error:
        crane.capacity(excavator, **given)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "frame", "numbers", "given"),
    [
        ("excavator", "bucket", ["boom_lift.y", "arm.mass", "cylinder.X_boom.area_a"],
         {"rule": "iso10567", "slope": 0.05, "slews": [0.0, 1.0]}),
        pytest.param("patu655", None, ["lift_eye.x", "supply.pressure"], {},
                     marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_slopes_are_those_of_charts_beside(name, frame, numbers, given):
    """Each derivative equals the difference of capacities with the parameter a little changed."""
    machine = crane.load(name)
    chart = crane.capacity(machine, frame, step=1.0, **given)
    slopes = chart.derivatives(numbers)
    assert slopes.shape == (*chart.loads.shape, len(numbers))
    beside, at = (
        MachineVariants(machine),
        {**given, "radii": chart.radii, "heights": chart.heights},
    )
    for k, number in enumerate(numbers):
        value = beside.values[number]
        step = 1e-4 * (value or 0.1)
        more, less = (
            crane.capacity(beside.machine({number: value + way * step}), frame, **at)
            for way in (1, -1)
        )
        with np.errstate(invalid="ignore"):
            difference = (more.loads - less.loads) / (2 * step)
        same = (
            (more.limiting_factor_index == chart.limiting_factor_index)
            & (less.limiting_factor_index == chart.limiting_factor_index)
            & (chart.limiting_factor_index >= 0)
        )
        same &= (less.loads > 0) & np.isfinite(difference)
        assert same.sum() > 25 and np.abs(difference[same]).max() > 0
        gap = np.abs(difference - slopes[..., k])[same] / np.abs(difference[same]).max()
        assert np.median(gap) < 1e-7 and gap.max() < 1e-3


def test_slopes_refuse_what_moves_the_supports(excavator):
    chart = crane.capacity(excavator, "bucket", radii=[6.0], heights=[1.0])
    with pytest.raises(crane.CraneError, match="moves the supports"):
        chart.derivatives(["track_front_left.x"])
    with pytest.raises(crane.CraneError, match="boom_eye"):
        chart.derivatives(["boom_ey.x"])


def test_lifting_torque_is_force_times_lever():
    """The lever by the places of three pins; net at 4 m no less than what a chart has there."""
    machine = crane.load("patu655", changes={"supply.pressure": 1.9e7})
    found = torques(machine)
    assert (found.raising_joint, found.pivot_joint) == ("X_lift", "q2")
    q_a = machine.home[machine.closure.active].copy()
    i = machine.active.index("X_lift")
    levers = []
    for stroke in (*np.linspace(0.01, 0.52, 30), found.gross_stroke):
        q_a[i] = stroke
        at = places(machine, machine.closure.solve(q_a))
        pivot, base, eye = (at[x][:3, 3] for x in ("lift_boom", "lift_barrel", "lift_eye"))
        levers.append(
            np.linalg.norm(np.cross(base - pivot, eye - pivot)) / np.linalg.norm(eye - base)
        )
    cylinder, tank = machine.hydraulics.cylinders["X_lift"], 1.0e5
    force = 1.9e7 * cylinder.area_a - tank * cylinder.area_b
    assert found.gross_torque == pytest.approx(force * levers[-1], rel=1e-9)
    assert max(levers) == pytest.approx(levers[-1], rel=1e-12)
    chart = crane.capacity(machine, radii=[4.0], heights=np.linspace(-2, 6, 33))
    assert np.nanmax(chart.loads) <= found.load * (1 + 1e-9)
    assert np.nanmax(chart.loads) == pytest.approx(found.load, rel=0.01)
    assert found.net_torque == pytest.approx(found.load * 9.81 * 4.0)
    assert found.slewing_torque == pytest.approx((1.9e7 - tank) * 1.4137e-3)


def test_the_rule_for_timber_cranes_leans_the_ground(excavator):
    at = {"radii": [6.0], "heights": [1.0], "frame": "bucket", "slews": [1.5]}
    by_rule = crane.capacity(excavator, rule="sfs4677", **at)
    by_hand = crane.capacity(
        excavator, rule=crane.ratings.Rule("own", "", tipping=1 / 1.1), slope=np.deg2rad(5), **at
    )
    assert by_rule.loads[0, 0, 0] == by_hand.loads[0, 0, 0]
    assert by_rule.limiting_factors[by_rule.limiting_factor_index[0, 0, 0]].reason == "tips"


def test_what_moves_straight_up_ends_on_a_slope_too(tmp_path):
    """A mast: its lift holds effort / (g cos slope) less what it carries, whatever rounds."""
    slides = {"kind": "prismatic"}
    urdf_text.write(
        tmp_path, "mast", "ground", urdf_text.body("car", 37.0), urdf_text.body("fork", 11.0),
        urdf_text.joint("lift", "ground", "car", limits=(0, 2, 3333.3), **slides),
        urdf_text.joint("out", "car", "fork", axis=(1, 0, 0), limits=(0, 2, 1e6), **slides),
    )  # fmt: skip
    machine = crane.load(tmp_path / "mast.urdf")
    for slope in np.linspace(0.01, 0.4, 40):
        chart = crane.capacity(machine, "fork", radii=[1.0], heights=[0.5], slope=slope)
        wanted = 3333.3 / (9.81 * np.cos(slope)) - 48.0
        assert chart.loads.item() == pytest.approx(wanted, rel=1e-9), slope


# places [m] whose best posture is in a narrow range of the bucket's stroke; X_boom, X_arm and
# X_bucket of it, found by trying 129 strokes of the bucket
NARROW = {
    (2.0, -3.0): (0.00189, 0.75296, 1.07571),
    (2.5, -2.0): (0.11074, 0.98087, 1.06143),
    (3.0, -1.5): (0.19582, 1.03093, 1.07032),
    (3.0, -1.0): (0.21817, 1.16495, 1.07089),
    (3.5, 3.0): (0.85811, 1.47824, 1.08933),
}


@pytest.mark.slow
def test_no_narrow_peak_is_missed(excavator):
    """Postures that carry up to 39 % more than a peak beside; alone, and in a chart."""
    chart = crane.capacity(excavator, step=0.5, slews=[0.0])
    for place, strokes in NARROW.items():
        start = excavator.closure.solve(np.r_[0.0, strokes])[None]
        q, _, there = chart.places.move_to_targets(
            start, np.array([place]), chart.places.position_strokes
        )
        assert there.all()
        load = min(by_hand(excavator, chart, q[0]).values())
        a, b = np.abs(chart.radii - place[0]).argmin(), np.abs(chart.heights - place[1]).argmin()
        alone = chart.at_positions([place[0]], [place[1]]).loads[0, 0, 0]
        assert load <= chart.loads[0, b, a] * (1 + 1e-9) and load <= alone * (1 + 1e-9)
        assert load >= 0.995 * chart.loads[0, b, a]  # the same peak


def test_causes_that_end_a_load_together_are_all_told(excavator):
    """Where the best posture balances two, not that which rounding makes the less."""
    chart = crane.capacity(excavator, step=0.5, slews=[0.0])
    reached = np.isfinite(chart.loads)
    with np.errstate(invalid="ignore"):
        gaps = np.sort(
            np.nan_to_num(chart.values_by_factor / chart.loads[..., None] - 1, nan=np.inf)
        )[..., 1]
    both = chart.simultaneous_factors.sum(axis=-1) > 1
    assert both.sum() > 150 and np.array_equal(both[reached], gaps[reached] < 1e-6)
    assert not np.any((gaps[reached] > 1e-6) & (gaps[reached] < 1e-5))  # nothing in between
    assert np.array_equal(
        chart.limiting_factor_index[reached], chart.simultaneous_factors[reached].argmax(axis=-1)
    )


@pytest.mark.parametrize(
    "given",
    [{"radii": ["a"]}, {"slews": ["x"]}, {"rule": None}, {"radii": [[1, 2], [3]]}],
)
def test_odd_arguments_are_said_in_one_line(excavator, given):
    with pytest.raises(crane.CraneError):
        crane.capacity(excavator, "bucket", **given)


def test_a_column_behind_the_axis_has_a_table():
    chart = crane.capacity(crane.load("patu655"), radii=[-0.7], heights=[-0.4])
    assert np.isfinite(chart.loads).all() and "-0.4" in chart.to_markdown()


def test_places_at_folds_are_found():
    """Of a robot whose elbow goes through straight: each posture is among those of its place."""
    machine = crane.load("kr300", lock={"q4": 0.0, "q5": 0.0, "q6": 0.0})
    places_ = ConfigurationSearch(machine)
    random, closure = np.random.default_rng(0), machine.closure
    drawn = np.tile(closure.home[closure.active], (300, 1))
    for i in places_.position_strokes:
        drawn[:, i] = random.uniform(places_.low[i], places_.high[i], 300)
    q = closure.solve(drawn)
    where = places_.section.coordinates(places_.statics.evaluate(q).tip_positions)
    lost = 0
    for k in range(300):
        found = places_.find_all((where[k, :1], where[k, 1:]))
        gaps = np.abs(found.q[:, closure.active] - drawn[k]).max(axis=1)
        lost += not len(gaps) or gaps.min() > 1e-6
    assert lost <= 3


# --- pins and buckling --------------------------------------------------------------------------


PINS = {"boom": 260e3, "boom_eye": 250e3, "X_arm": 30e3}


@pytest.fixture(scope="module")
def pinned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pins") / "models"
    shutil.copytree(MODELS, folder)
    text = f"\npins: {PINS}\n".replace("'", "")
    (folder / "excavator.yaml").write_text((folder / "excavator.yaml").read_text() + text)
    return crane.load(folder / "excavator.yaml")


@pytest.fixture(scope="module")
def chart(pinned):
    return crane.capacity(
        pinned, "bucket", rule=crane.ratings.Rule("own", "", structural=0.8), step=1.0
    )


def force(machine, q, load, name):
    return np.linalg.norm(balance(machine, q, G, load, "bucket")[1][name][:3])


def test_pins_end_loads_where_statics_by_hand_has_their_limit(pinned, chart):
    ends = {
        chart.limiting_factors[k].element
        for k in chart.active_factors
        if chart.limiting_factors[k].reason == "pin force"
    }
    assert ends == set(PINS)
    for cell in map(tuple, cells(chart, 25)):
        q = pinned.closure.solve(chart.q_a[cell])
        for k, cause in enumerate(chart.limiting_factors):
            if cause.reason != "pin force":
                continue
            found = chart.values_by_factor[cell][k] / 0.8
            if not found:
                assert force(pinned, q, 0.0, cause.element) >= PINS[cause.element]
                continue

            def left(load, name=cause.element, q=q):
                return force(pinned, q, load, name) - PINS[name]

            samples = [left(load) for load in np.linspace(0, found * (1 - 1e-9), 5)]
            assert max(samples) <= 0
            assert found == pytest.approx(brentq(left, 0, 2 * found, rtol=1e-12), rel=1e-9)


def test_pin_forces_and_margins_are_those_of_statics_by_hand(pinned, chart):
    forces, margins = chart.pin_forces(), chart.buckling()
    assert set(forces) == set(crane.dynamics.Reactions(pinned).names)
    assert set(margins) == {"X_boom", "X_arm", "X_bucket"}
    loads = crane.dynamics.Buckling(pinned)
    for cell in map(tuple, cells(chart, 5, seed=1)):
        q = pinned.closure.solve(chart.q_a[cell])
        drives, pins = balance(pinned, q, G, chart.loads[cell], "bucket")
        most = max(np.linalg.norm(pin[:3]) for pin in pins.values())
        for name, pin in pins.items():
            assert forces[name][cell] == pytest.approx(np.linalg.norm(pin[:3]), abs=1e-9 * most)
        for joint, column in loads.columns.items():
            load = column.buckling_load(q[pinned.column(joint)])
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


def test_margins_on_a_slope_are_those_of_the_worst_side(pinned):
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


def test_derivatives_are_left_out_where_a_pin_ends_the_load(pinned):
    more = {"pins.boom": 7e5, "pins.boom_eye": 9e5, "pins.X_arm": 9e5}
    machine, bare = crane.load(pinned.path, changes=more), crane.load("excavator")
    chart, without = (crane.capacity(x, "bucket", step=1.0, slews=[0.0]) for x in (machine, bare))
    slopes, free = (x.derivatives(["arm.mass"])[..., 0] for x in (chart, without))
    pins = np.array([cause.reason == "pin force" for cause in chart.limiting_factors] + [False])[
        chart.limiting_factor_index
    ]
    same = (chart.limiting_factor_index == without.limiting_factor_index) & (without.loads > 0)
    assert pins.sum() > 3 and np.isnan(slopes[pins]).all()
    assert same.sum() > 3 and slopes[same] == pytest.approx(free[same], rel=1e-9)


def test_pins_are_read_written_and_changed(pinned, tmp_path):
    assert dict(pinned.pin_capacities) == PINS
    written = crane.write_machine(pinned, tmp_path / "written", {"pins.boom": "from a drawing"})
    assert dict(crane.load(written).pin_capacities) == PINS
    assert re.search("boom: 260000.0 +# from a drawing", written.read_text())
    more = crane.load(pinned.path, changes={"pins.boom": 5e5})
    assert dict(more.pin_capacities) == PINS | {"boom": 5e5}
    assert "X_arm" not in crane.load(pinned.path, lock={"X_arm": 0.5}).pin_capacities
    assert not crane.load("excavator").pin_capacities


def test_pins_that_are_not_there_are_named(pinned):
    odd = dataclasses.replace(pinned, pin_capacities={"bom": 1e5})
    with pytest.raises(crane.CraneError, match="'bom' is no joint or loop, did you mean 'boom'"):
        crane.capacity(odd, "bucket", radii=[6.0], heights=[1.0])
    assert parameter_unit(pinned.tree, "pins.boom") == "N"


@pytest.mark.parametrize(
    ("change", "given", "said"),
    [
        ({"pins.boom": 0.0}, {}, "'pins.boom' is 0 N, give a force above 0"),
        ({"pins.bom": 1.0}, {}, "'pins.bom' is unknown, did you mean 'pins.boom'"),
        ({}, {"slope": 0.1}, "rated on level ground, but the ground slopes by 5.73 degrees"),
        ({}, {"rule": "sfs4677"}, "rated on level ground, but the ground slopes by 5 degrees"),
    ],
)
def test_wrong_pins_are_said_in_one_line(pinned, change, given, said):
    with pytest.raises(crane.CraneError, match=said) as error:
        crane.capacity(crane.load(pinned.path, changes=change), "bucket", **given)
    assert "\n" not in str(error.value)
