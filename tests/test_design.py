"""Design optimisation against known optima; derivatives against differences."""

import numpy as np
import pytest
from command_line import typed
from urdf_text import body, joint, write

import crane
from crane.formats.machine_loading import MachineVariants
from crane.studies.optimization.measure_expressions import (
    DUAL_FUNCTIONS,
    DualNumber,
    MeasureExpression,
    parse_requirement,
)
from crane.studies.optimization.variant_measures import MeasureOptions, VariantEvaluation

pytestmark = pytest.mark.slow

FILE = """
name: four_bar
source: a test
chains: [{name: all, urdf: four_bar.urdf}]
loops:
  - {name: pin, type: revolute, predecessor: coupler_end, successor: rocker_end, axis: [0, 0, 1]}
active: [crank]
home: {crank: 1.2, coupler: -0.2, rocker: 1.6}
tip: coupler_end
"""
MEASURES = '''
"""Of a crank-rocker: how far its transmission angle is from a right one, its swing and timing."""
import numpy as np


def _lengths(machine):
    """Of ground, crank, coupler and rocker."""
    joints = machine.tree.joints
    x = [joints[name].xyz[0] for name in ("rocker", "coupler", "coupler_end", "rocker_end")]
    return np.abs(x)


def _angle(a, b, c):
    """Between sides a and b of a triangle, in degrees."""
    return np.degrees(np.arccos((a * a + b * b - c * c) / (2 * a * b)))


def deviation(machine):
    g, r, c, k = _lengths(machine)
    return max(abs(_angle(c, k, g - r) - 90), abs(_angle(c, k, g + r) - 90))


def swing(machine):
    g, r, c, k = _lengths(machine)
    return _angle(g, k, c + r) - _angle(g, k, c - r)


def timing(machine):
    g, r, c, k = _lengths(machine)
    return 180 + _angle(g, c - r, k) - _angle(g, c + r, k)
'''


def bar(name):
    return body(name, 1, moments=(0.1, 0.1, 0.1))


@pytest.fixture
def four_bar(tmp_path):
    write(
        tmp_path, "four_bar", "ground", *(bar(x) for x in ("crank", "coupler", "rocker")),
        '<link name="coupler_end"/><link name="rocker_end"/>',
        joint("crank", "ground", "crank", limits=(-7, 7)),
        joint("coupler", "crank", "coupler", (0.35, 0, 0), limits=(-7, 7)),
        joint("rocker", "ground", "rocker", (1, 0, 0), limits=(-7, 7)),
        joint("coupler_end", "coupler", "coupler_end", (0.9, 0, 0), "fixed"),
        joint("rocker_end", "rocker", "rocker_end", (0.85, 0, 0), "fixed"),
    )  # fmt: skip
    (tmp_path / "four_bar.yaml").write_text(FILE)
    (tmp_path / "measures.py").write_text(MEASURES)
    return tmp_path / "four_bar.yaml"


@pytest.mark.slow
def test_the_classical_transmission_angle_problem(four_bar):
    """Freudenstein and Primrose: 45 degrees of swing, 200 of the crank, from ten starts.

    The optimum is one root of a cubic, t = tan(phi/2), u = tan((phi - psi)/2),
    Q^3 + 2 Q^2 - t^2 Q - (t^2/u^2)(1 + t^2) = 0, coupler/crank = |t| / sqrt(Q).
    """
    found = crane.design(
        four_bar,
        {"coupler.x": (0.2, 0.5), "coupler_end.x": (0.6, 1.2), "rocker_end.x": (0.6, 1.3)},
        minimise=["deviation"],
        require=["swing == 45", "timing == 200"],
        measures=four_bar.parent / "measures.py",
        starts=10,
    )
    t, u = np.tan(np.deg2rad(100.0)), np.tan(np.deg2rad(77.5))
    roots = np.roots([1.0, 2.0, -(t**2), -(t**2) / u**2 * (1 + t**2)])
    q = max(x.real for x in roots if abs(x.imag) < 1e-9 and x.real > 0)
    assert sum(x.is_feasible for x in found.solutions) >= 8
    for x in found.solutions:
        if x.is_feasible:
            crank, coupler, rocker = x.values
            assert coupler / crank == pytest.approx(abs(t) / np.sqrt(q), rel=1e-4)
            assert x.objectives[0] == pytest.approx(48.1868, abs=1e-3)
            assert (crank, coupler, rocker) == pytest.approx(
                (0.345671, 0.833634, 0.966648), abs=1e-4
            )


@pytest.mark.slow
@pytest.mark.long
def test_a_front_of_two_goals_is_that_of_a_grid():
    """Bucket linkage: the more swing of the bucket, the less its force; 7 by 7 variants beside.

    The rocker's length and where it stands on the arm; two goals of our own, exact by the closure.
    """
    vary = {"arm_rocker.x": (2.40, 2.55), "bucket_link.y": (0.42, 0.56)}
    goals = ["force", "swing"]

    def at(machine, *strokes):
        """Angle of the bucket, and its slope by the stroke of its cylinder."""
        q_a = np.tile(machine.home[machine.closure.active], (len(strokes), 1))
        q_a[:, 3] = strokes
        q = machine.closure.solve(q_a)
        column = machine.column("bucket")
        return q[:, column], machine.closure.gamma(q)[:, column, 3]

    own = {
        "force": lambda machine: 391.0 / abs(at(machine, 0.5)[1][0]),  # kN m
        "swing": lambda machine: np.degrees(np.ptp(at(machine, 0.1, 1.0)[0])),
    }
    found = crane.design("excavator", vary, maximise=goals, measures=own, starts=1, points=5)
    front = np.array([x.objectives for x in found.solutions])
    assert len(front) >= 3 and (np.ptp(front, axis=0) > 0.01 * front.mean(axis=0)).all()
    variants = MachineVariants(crane.load("excavator"))
    low, high = np.array(list(vary.values())).T
    expressions = [MeasureExpression(goal) for goal in goals]
    grid = []
    for a in np.linspace(low[0], high[0], 7):
        for b in np.linspace(low[1], high[1], 7):
            try:
                point = VariantEvaluation(
                    variants,
                    dict(zip(vary, (a, b), strict=True)),
                    MeasureOptions(user_measures=own),
                )
                grid.append([point.evaluate(x).value for x in expressions])
            except crane.CraneError:
                continue
    grid = np.array(grid)
    assert len(grid) > 25
    for solution in front:  # nothing of the grid is better in both
        assert not (grid > solution * (1 + 1e-5)).all(axis=1).any()
    best = grid[[not (grid > row).all(axis=1).any() for row in grid]]
    for row in best:  # and none of its best is far beyond all of the front
        assert (front >= row - np.ptp(best, axis=0) / len(front)).all(axis=1).any()


@pytest.mark.parametrize(
    "text",
    ["reach", "highest", "lowest", "nearest(11, 0, 3)", "mass",
     pytest.param("peak_X_boom", marks=pytest.mark.slow),
     pytest.param("load(6, 0)", marks=pytest.mark.slow),
     "sqrt(mass) * reach / (2 + highest**2) - min(reach, mass)",
     "arm.mass + number('boom_lift.x')"],
)  # fmt: skip
def test_slopes_are_those_of_variants_beside(text):
    names = ["boom_lift.x", "arm.mass", "bucket_lip.x", "upper_boom.z"]
    variants = MachineVariants(crane.load("excavator"))
    here = np.array([variants.values[name] for name in names])
    ranges = np.array([0.5, 100.0, 0.3, 0.2])
    terms, expression = MeasureOptions(tasks=("grade",)), MeasureExpression(text)

    def at(values, exact=False):
        point, intervals = (dict(zip(names, x.tolist(), strict=True)) for x in (values, ranges))
        return VariantEvaluation(variants, point, terms, ranges=intervals if exact else None)

    found = at(here, exact=True).evaluate(expression)
    for i, step in enumerate(1e-3 * ranges):
        more, less = (here + sign * step * np.eye(4)[i] for sign in (1, -1))
        difference = at(more).evaluate(expression).value - at(less).evaluate(expression).value
        difference /= 2 * step
        scale = max(abs(difference), abs(found.value) * 1e-2 / ranges[i])
        assert found.derivatives[i] == pytest.approx(difference, abs=2e-4 * scale)


def test_dual_numbers_are_exact():
    """By complex steps."""
    random, step = np.random.default_rng(0), 1e-30
    text = "exp(0.1*x)*sqrt(y) - x**3/(1 + y) + log(y)*sin(x)*cos(y) + abs(-x) + 2**y + x**y"
    text += " + max(x, y)"
    for x, y in random.uniform(0.3, 2.0, (20, 2)):
        names = {
            "x": DualNumber(x, np.array([1.0, 0.0])),
            "y": DualNumber(y, np.array([0.0, 1.0])),
        }
        found = MeasureExpression(text)(
            names.__getitem__,
            lambda f, a: DUAL_FUNCTIONS[f](*a),
            lambda c: DualNumber(c, np.zeros(2)),
        )
        numpy = {name: getattr(np, name) for name in ("exp", "sqrt", "log", "sin", "cos")}
        numpy |= {
            "abs": lambda z: -z if z.real < 0 else z,
            "max": lambda a, b: max(a, b, key=np.real),
        }
        for i, (dx, dy) in enumerate(((step, 0), (0, step))):
            value = eval(text, numpy, {"x": x + 1j * dx, "y": y + 1j * dy})
            assert found.derivatives[i] == pytest.approx(value.imag / step, rel=1e-12)
        assert found.value == pytest.approx(value.real, rel=1e-14)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, "no objective is given"),
        ({"minimise": ["mass +"]}, "is no expression"),
        ({"minimise": ["__import__('os')"]}, "function '__import__' is unknown"),
        ({"minimise": ["mass.real.imag"]}, "measure 'mass.real.imag' is unknown"),
        ({"minimise": ["[1]"]}, r"has '\[1\]'"),
        ({"minimise": ["load(1)"]}, "takes 2 or 3 arguments"),
        ({"minimise": ["mas"]}, "measure 'mas' is unknown, did you mean 'mass'"),
        ({"minimise": ["mass"], "require": ["mass"]}, "requires nothing"),
        ({"minimise": ["mass"], "require": ["reach >= 50"]}, "'reach >= 50' lacks 39.97"),
        ({"minimise": ["mass"], "tasks": ["walk"]}, "task 'walk' is unknown"),
        ({"minimise": ["mass"], "rule": "iso"}, "rule 'iso' is unknown"),
        (
            {"minimise": ["own"], "measures": {"own": lambda machine: 1 / 0}},
            "measure 'own': ZeroDiv",
        ),
    ],
)
def test_what_cannot_be_designed_is_said_in_one_line(given, told):
    with pytest.raises(crane.CraneError, match=told) as error:
        crane.design("excavator", {"arm.mass": (700.0, 900.0)}, starts=1, **given)
    assert "\n" not in str(error.value)


def test_requirements_are_differences():
    for text, value, equal in (("3 >= 2", 1, False), ("3 <= 2", -1, False), ("3 == 2", 1, True)):
        expression, same = parse_requirement(text)
        assert (expression(float, None), same) == (value, equal)


def test_the_command_writes_machine_table_and_picture(four_bar, tmp_path):
    out = tmp_path / "out"
    run = typed(
        "design", str(four_bar), "--vary", "coupler.x=0.3~0.4", "--minimise", "deviation",
        "--require", "swing >= 40", "--measures", str(four_bar.parent / "measures.py"),
        "--starts", "2", "--processes", "1", "--out", str(out),
    )  # fmt: skip
    assert run.returncode == 0 and "minimise deviation" in run.stdout, run.stderr
    best = crane.load(next((out / "machine").glob("*.yaml")))
    assert 0.3 <= best.tree.joints["coupler"].xyz[0] <= 0.4
    assert (out / "design.png").stat().st_size > 5000
    rows = (out / "solutions.csv").read_text().splitlines()
    assert len([x for x in rows if not x.startswith("#")]) == 3


def test_loads_before_and_after_are_drawn(tmp_path):
    run = typed(
        "design", "excavator", "--vary", "boom_lift.y=0.64~0.68", "--maximise", "load(4, 0, 0)",
        "--frame", "bucket", "--starts", "1", "--processes", "1", "--out", tmp_path / "out",
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    for name in ("before.png", "after.png"):
        assert (tmp_path / "out" / name).read_bytes()[:4] == b"\x89PNG"


@pytest.fixture
def pendulum(tmp_path):
    """Two links that hang on each other: without loops a variant is made in little time."""
    return write(
        tmp_path, "pendulum", "ground", bar("upper"), bar("lower"),
        joint("a", "ground", "upper", limits=(-7, 7)),
        joint("b", "upper", "lower", (1, 0, 0), limits=(-7, 7)),
    )  # fmt: skip


def test_a_wall_does_not_take_what_was_found(pendulum):
    """A measure that cannot be had on one side: the best of the other side stays."""

    def wall(machine):
        x, y = (machine.tree.links[name].inertial.mass for name in ("upper", "lower"))
        if x + y < 0.8:
            raise ValueError("wall")
        return x + y * y

    vary = {"upper.mass": (0.05, 1.0), "lower.mass": (0.05, 1.0)}
    found = crane.design(pendulum, vary, minimise=["wall"], measures={"wall": wall}, starts=4)
    assert all(np.isfinite(x.objectives).all() and x.is_feasible for x in found.solutions)
    assert found.solutions[0].objectives[0] == pytest.approx(0.55, abs=0.08)  # x = 0.3, y = 0.5
    assert len({x.initial_values.tobytes() for x in found.solutions}) == 4


def test_measures_that_are_no_number_do_not_fit(pendulum):
    def odd(machine):
        mass = machine.tree.links["upper"].inertial.mass
        return np.nan if mass > 0.5 else mass

    vary = {"upper.mass": (0.05, 1.0)}
    found = crane.design(pendulum, vary, maximise=["odd"], measures={"odd": odd}, starts=3)
    assert 0.2 < found.solutions[0].objectives[0] <= 0.5


def test_a_machine_that_is_not_its_files_is_refused():
    machine = crane.load("mini_forwarder", active=["q1", "q2", "q3"])
    with pytest.raises(crane.CraneError, match="is not what its files describe"):
        crane.design(machine, {"link7.mass": (0.1, 0.2)}, minimise=["mass"])
    loaded = crane.load("excavator", changes={"arm.mass": 700.0})
    found = crane.study(loaded, {"bucket_lip.x": [1.3, 1.4]}, [], ["mass"])
    assert found.columns["mass"] == pytest.approx(sum(x.mass for x in loaded.model.inertias))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("load", r"'load' is a function, write load\(...\)"),
        ("'abc'", "no number"),
        ("degrees('a')", "takes numbers, not 'a'"),
        ("sqrt(1, 2)", "takes one argument"),
        ("(mass - 1e6)**0.5", "no value|no finite number"),
        ("mass) + (reach", "is no expression"),
        ("1" + "+1" * 3000, "characters"),
        ("+".join(["1"] * 999), "more than 500 parts"),
        ("1" + 400 * "0", "a number that is not finite"),
    ],
)
def test_expressions_end_in_one_line(text, told):
    with pytest.raises(crane.CraneError, match=told) as error:
        crane.design("mini_forwarder", {"link7.mass": (0.1, 0.2)}, maximise=[text], starts=1)
    assert "\n" not in str(error.value)


def test_own_measures_have_names_of_their_own_and_stay_here_if_they_must():
    vary, own = {"link7.mass": (0.1, 0.2)}, {"mass": lambda machine: 1.0}
    with pytest.raises(crane.CraneError, match="a measure 'mass' exists already"):
        crane.design("mini_forwarder", vary, minimise=["mass"], measures=own)
    with pytest.raises(crane.CraneError, match="stay in one process"):
        crane.design(
            "mini_forwarder", vary, minimise=["mine"], measures={"mine": own["mass"]}, processes=2
        )
