"""Buckling loads of cylinders against finite elements."""

from dataclasses import replace

import numpy as np
import pytest
from hanging_loads import joint, link
from scipy.linalg import eigh
from test_reactions import BEAM, load

import crane
from crane import Dynamics
from crane.common.errors import CraneError, InputError
from crane.dynamics import Buckling
from crane.dynamics.buckling import YOUNGS_MODULUS_STEEL, CylinderColumn
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.hydraulics.circuit_elements import Supply
from crane.hydraulics.components import Cylinder, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics, Oil

SHAPE = {
    "joint": "x",
    "count": 1,
    "pin_offset": np.array([0.8, 0, 0]),
    "slide_axis": np.array([1.0, 0, 0]),
    "lower_limit": 0.0,
    "upper_limit": 0.6,
}


def inertia(outer, inner=0.0):
    return np.pi / 64 * (outer**4 - inner**4)


def by_elements(parts, each=30):
    """The least load of a pinned column, by cubic elements; parts of E I and length."""
    stiffs = [(stiff, length / each) for stiff, length in parts for _ in range(each)]
    size = 2 * len(stiffs) + 2
    bending, turning = np.zeros((size, size)), np.zeros((size, size))
    for i, (stiff, h) in enumerate(stiffs):
        at = slice(2 * i, 2 * i + 4)
        bending[at, at] += stiff / h**3 * np.array([
            [12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h],
            [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h * h, -6 * h, 4 * h * h],
        ])  # fmt: skip
        turning[at, at] += 1 / (30 * h) * np.array([
            [36, 3 * h, -36, 3 * h], [3 * h, 4 * h * h, -3 * h, -h * h],
            [-36, -3 * h, 36, -3 * h], [3 * h, -h * h, -3 * h, 4 * h * h],
        ])  # fmt: skip
    free = np.delete(np.arange(size), [0, size - 2])
    loads = eigh(turning[np.ix_(free, free)], bending[np.ix_(free, free)], eigvals_only=True)
    return 1 / loads[-1]


@pytest.mark.parametrize(
    ("bore", "rod", "tube"),
    [(0.1, 0.056, 0.12), (0.14, 0.1, 0.168), (0.1, 0.02, 0.3), (0.05, 0.049, 0.051)],
)
def test_the_stepped_column_is_that_of_finite_elements(bore, rod, tube):
    column = CylinderColumn(bore=bore, rod=rod, tube=tube, **SHAPE)
    strokes = np.array([0.0, 0.2, 0.45, 0.6])
    out = column.pin_distance(strokes) - column.tube_length
    assert out[0] == pytest.approx(min(bore, 0.05))
    wanted = [
        by_elements(
            [
                (YOUNGS_MODULUS_STEEL * inertia(tube, bore), column.tube_length),
                (YOUNGS_MODULUS_STEEL * inertia(rod), x),
            ]
        )
        for x in out
    ]
    assert np.allclose(column.buckling_load(strokes), wanted, rtol=1e-6)
    if inertia(tube, bore) > inertia(rod):
        assert (column.euler_load(strokes) < column.buckling_load(strokes)).all()


def test_a_tube_as_stiff_as_the_rod_is_eulers_column():
    bore, rod = 0.1, 0.06
    tube = (bore**4 + rod**4) ** 0.25
    column = CylinderColumn(bore=bore, rod=rod, tube=tube, **SHAPE)
    assert np.allclose(column.buckling_load([0.1, 0.5]), column.euler_load([0.1, 0.5]), rtol=1e-12)
    assert column.euler_load(0.2) == pytest.approx(
        np.pi**2 * YOUNGS_MODULUS_STEEL * inertia(rod), rel=1e-12
    )  # 1 m
    unknown = replace(column, tube=0.0)
    assert np.array_equal(unknown.buckling_load([0.1, 0.5]), unknown.euler_load([0.1, 0.5]))
    assert np.allclose(replace(column, count=3).buckling_load(0.3), 3 * column.buckling_load(0.3))


EYES = {
    "excavator": {"X_boom": ("boom_barrel", "boom_eye"), "X_arm": ("arm_barrel", "arm_eye"),
                  "X_bucket": ("bucket_barrel", "bucket_eye")},
    "patu655": {"X_lift": ("lift_barrel", "lift_eye"), "X_tilt": ("tilt_barrel", "tilt_eye")},
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(EYES))
def test_pins_of_a_machine_lie_where_its_frames_are(name):
    machine = crane.load(name)
    buckling = Buckling(machine)
    assert list(buckling.columns) == list(EYES[name])
    assert buckling.unsupported["slew"] == "it turns its joint"
    rng = np.random.default_rng(0)
    span = 0.1 * (machine.upper - machine.lower) * rng.uniform(-1, 1, (5, len(machine.active)))
    q_a = machine.home[machine.closure.active] + span
    q = machine.closure.solve(q_a)
    successors = {loop.name: loop.successor for loop in machine.closure.equations.loops}
    for slide, (barrel, eye) in EYES[name].items():
        column = buckling.columns[slide]
        links = machine.tree.joints[barrel].child, successors[eye]
        one, two = np.moveaxis(FrameJacobians(machine).frame_origins(q, links), 1, 0)
        wanted = np.linalg.norm(two - one, axis=1)
        assert np.allclose(
            column.pin_distance(q_a[:, machine.active.index(slide)]), wanted, rtol=1e-9
        )
        cylinder = machine.hydraulics.cylinders[slide]
        assert (column.bore, column.rod) == (cylinder.bore, cylinder.rod)
    diameters = {x: (round(c.bore, 6), round(c.rod, 6)) for x, c in buckling.columns.items()}
    assert diameters["X_boom" if name == "excavator" else "X_lift"] == (
        (0.12, 0.085) if name == "excavator" else (0.1, 0.056)
    )


def circuit(**more):
    cylinder = Cylinder("stroke", 2 * 5e-3, 2 * 3e-3, 1e-4, 1e-4, count=2, **more)
    return Hydraulics(
        Supply(pressure=2e7), Oil(), {"stroke": cylinder},
        {"stroke": Valve("stroke", **dict.fromkeys(("c1", "c2", "c3", "c4"), 1e-7))},
    )  # fmt: skip


@pytest.mark.parametrize("reversed_", [False, True])
def test_margin_of_a_beams_cylinder(tmp_path, reversed_):
    """Two rods share what the beam's weight presses them with, whichever way the joint counts."""
    text = BEAM
    if reversed_:
        text = text.replace(
            'axis xyz="0 0 1"/><limit lower="0.5" upper="2"',
            'axis xyz="0 0 -1"/><limit lower="-2" upper="-0.5"',
        ).replace('name="stroke" value="1.077"', 'name="stroke" value="-1.077"')
        assert text != BEAM
    beam = load(tmp_path, text, active=["stroke"]).replace(hydraulics=circuit())
    buckling, sign = Buckling(beam), -1.0 if reversed_ else 1.0
    length = np.array([0.9, 1.3])
    q_a = sign * length[:, None]
    force = Dynamics(beam).gravity(q_a)
    assert (sign * force > 0).all()
    rod = np.sqrt(4 / np.pi * 2e-3)
    wanted = 2 * np.pi**2 * YOUNGS_MODULUS_STEEL * inertia(rod) / length**2 / np.abs(force[:, 0])
    assert np.allclose(buckling.buckling_margins(q_a, force)[:, 0], wanted, rtol=1e-9)
    assert np.isinf(buckling.buckling_margins(q_a, -force)).all()
    assert buckling.buckling_margins(q_a[0], force[0]) == pytest.approx(wanted[0])


def test_what_is_no_column_is_told(tmp_path):
    beam = load(tmp_path, BEAM, active=["stroke"])
    with pytest.raises(InputError, match="'beam' has no cylinders"):
        Buckling(beam)
    driven = beam.replace(hydraulics=circuit())
    with pytest.raises(InputError, match=r"shapes \(2, 1\) and \(1,\), give the same"):
        Buckling(driven).buckling_margins([[1.0], [1.1]], [5.0])
    same = replace(circuit().cylinders["stroke"], area_b=1e-2)
    found = Buckling(beam.replace(hydraulics=replace(circuit(), cylinders={"stroke": same})))
    assert "its rod is not known" in found.unsupported["stroke"]
    for place, reason in (("0 0 0.2", "more than one pin"), ("0 0 0", "")):
        second = BEAM.replace(
            '<link name="end"/>',
            '<link name="end"/>\n'
            + link("more", 1, "0.1 0 0", (1, 0, 0, 1, 0, 1))
            + joint("arm", "rod", "more", place, "0 1 0"),
        )
        other = load(tmp_path, second, active=["stroke"], free=["arm"])
        found = Buckling(other.replace(hydraulics=circuit()))
        assert reason in found.unsupported.get("stroke", "")
        assert ("stroke" in found.columns) == (not reason)


@pytest.mark.parametrize(
    ("more", "line"),
    [
        ({"tube": 0.01}, "tube of the cylinder of 'stroke' is 0.01 m, it must be more than the"),
        ({"tube": -1.0}, "tube of the cylinder of 'stroke' is -1"),
    ],
)
def test_a_tube_that_cannot_be_is_told(more, line):
    with pytest.raises(CraneError, match=line):
        circuit(**more)
    with pytest.raises(CraneError, match="count of the cylinder of 's' is 0"):
        Cylinder("s", 1e-3, 1e-3, 1e-4, 1e-4, count=0)


def test_tubes_and_counts_are_written_and_read(tmp_path):
    machine = crane.load("excavator")
    crane.write_machine(machine, tmp_path)
    file = next(tmp_path.glob("*.yaml"))
    again = crane.load(file)
    one, two = machine.hydraulics.cylinders, again.hydraulics.cylinders
    assert {x: (c.tube, c.count) for x, c in one.items()} == {
        "slew": (0.0, 1), "X_boom": (0.145, 2), "X_arm": (0.168, 1), "X_bucket": (0.145, 1),
    }  # fmt: skip
    assert one == two
    text = file.read_text()
    start = text.index("slew: {", text.index("cylinders:")) + len("slew: {")
    turning = f"{text[:start]}tube: 0.3, {text[start:]}"
    assert turning != text
    file.write_text(turning)
    with pytest.raises(CraneError, match="cylinder of 'slew' turns its joint"):
        crane.load(file)
