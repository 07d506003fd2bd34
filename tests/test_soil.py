"""Soil cutting: force balance of wedges, tables of earth pressure, dissipation, energy."""

from pathlib import Path

import numpy as np
import pytest
from urdf_text import body, frame, joint, write
from warned import quiet

import crane
from crane.common.errors import CraneError
from crane.description.external_forces import FrameMotion

SANDY, CLAY = crane.description.SOILS["sandy loam"], crane.description.SOILS["lean clay"]
STICKY = crane.description.Soil(18e3, 9e3, np.radians(25), np.radians(14), 4e3, 2e3)
UNDRAINED = crane.description.Soil(18e3, 30e3, 0.0, 0.0, 10e3)


def wedge(soil, rake, beta, depth):
    """(2,) [N/m] along and across the surface on a blade, by the balance of the wedge before it.

    The corners of the wedge, the forces on its faces and its weight, and one solution of two
    equations for the unknown sizes on the blade and in the plane of failure.
    """
    edge, exit_, top = np.zeros(2), [depth / np.tan(beta), depth], [-depth / np.tan(rake), depth]
    exit_, top = np.array(exit_), np.array(top)
    area = 0.5 * (exit_[0] * top[1] - exit_[1] * top[0])
    weight = np.array([0.0, -soil.unit_weight * area - soil.surcharge * (exit_ - top)[0]])
    slide, rise = exit_ - edge, top - edge
    cohesive = -soil.cohesion * slide  # on the wedge, which moves up the plane
    adhesive = -soil.adhesion * rise  # and up the blade
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])  # by -90 degrees
    out, along = turn @ rise / np.hypot(*rise), rise / np.hypot(*rise)
    up, plane = -turn @ slide / np.hypot(*slide), slide / np.hypot(*slide)
    blade = out - np.tan(soil.tool_friction) * along
    below = up - np.tan(soil.friction) * plane
    sizes = np.linalg.solve(np.stack([blade, below], axis=1), -weight - cohesive - adhesive)
    return -(sizes[0] * blade + adhesive), sizes[0] / np.cos(soil.tool_friction)


def flattest(soil, rake):
    """The failure angle at which a wedge resists least by its weight, by a fine scan.

    Without friction its weight tells none, and cohesion does.
    """
    bare = crane.description.Soil(
        1.0, 0.0 if soil.friction else 1.0, soil.friction, soil.tool_friction
    )
    low, high = 1e-3, np.pi - rake - soil.friction - soil.tool_friction - 1e-3
    for _ in range(9):
        angles = np.linspace(low, high, 41)
        sizes = [wedge(bare, rake, beta, 1.0)[1] for beta in angles]
        k = int(np.argmin(np.where(np.array(sizes) > 0, sizes, np.inf)))
        low, high = angles[max(k - 1, 0)], angles[min(k + 1, 40)]
    return 0.5 * (low + high)


@pytest.mark.parametrize(
    "soil", [SANDY, CLAY, STICKY, UNDRAINED, *crane.description.SOILS.values()]
)
def test_factors_are_those_of_a_wedge_in_balance_that_resists_least(soil):
    for rake in np.linspace(0.2, min(1.5, soil.max_rake), 5):
        factors, cot_beta = soil.cutting_factors(np.cos(rake), np.sin(rake))
        beta = np.arctan2(1.0, cot_beta)
        assert beta == pytest.approx(flattest(soil, rake), abs=1e-6)
        depth = 0.3
        loads = (soil.unit_weight * depth, soil.cohesion, soil.adhesion, soil.surcharge)
        size = depth * np.dot(loads, factors)
        assert size == pytest.approx(wedge(soil, rake, beta, depth)[1], rel=1e-10)


@pytest.mark.parametrize(
    ("friction", "tool", "coefficient"),
    [(20, 0, 2.040), (20, 10, 2.635), (30, 0, 3.000), (30, 10, 4.143), (30, 20, 6.105),
     (40, 20, 11.77)],
)  # fmt: skip
def test_an_upright_blade_is_a_wall_under_passive_pressure(friction, tool, coefficient):
    """2 N_gamma is Coulomb's coefficient (tables of B. M. Das, Principles of Foundation Eng.)."""
    soil = crane.description.Soil(1.0, 0.0, np.radians(friction), np.radians(tool))
    (of_weight, *_), _ = soil.cutting_factors(0.0, 1.0)
    assert 2 * of_weight == pytest.approx(coefficient, rel=5e-4)


def test_a_strip_bears_what_tables_say():
    """N_c and N_q of Prandtl and Reissner at 0, 10, 20, 30 and 40 degrees (Vesic 1973)."""
    for degrees, of_cohesion, of_pressure in (
        (0, 5.14, 1.0), (10, 8.35, 2.47), (20, 14.83, 6.40), (30, 30.14, 18.40), (40, 75.31, 64.20)
    ):  # fmt: skip
        found = crane.description.Soil(0.0, 0.0, np.radians(degrees)).bearing_factors
        assert found == pytest.approx((of_cohesion, of_pressure), abs=6e-3)
    near = crane.description.Soil(0.0, 0.0, 1e-9).bearing_factors
    assert near == pytest.approx(crane.description.Soil(0.0, 0.0, 0.0).bearing_factors, rel=1e-8)


def seen(depth, rake, velocity, lean=0.0):
    """An edge under level ground whose blade, z of its frame, has a rake against x."""
    up, lateral = np.array([-np.cos(rake), 0.0, np.sin(rake)]), np.array([0.0, 1.0, 0.0])
    up, lateral = np.cos(lean) * up + np.sin(lean) * lateral, np.cross(
        np.cos(lean) * up + np.sin(lean) * lateral, [np.sin(rake), 0.0, np.cos(rake)]
    )  # fmt: skip
    turn = np.stack([np.cross(lateral, up), lateral, up], axis=1)
    return FrameMotion([0.0, 0.0, -depth], turn.tolist(), list(velocity), [0.0] * 3, [])


def cutter(soil=STICKY, frame="blade", **options):
    options = {"width": 1.2, "length": 0.8, "smoothing": 1e-4} | options
    return crane.description.SoilCutting(
        frame, soil, blade=(0, 0, 1), cutting=(1, 0, 0), **options
    )


@pytest.mark.parametrize("soil", [STICKY, UNDRAINED, SANDY])
def test_ahead_it_resists_with_the_wedge_and_withdrawn_it_only_rubs(soil):
    rake, depth = 1.0, 0.3
    _, cot_beta = soil.cutting_factors(np.cos(rake), np.sin(rake))
    ahead, _ = wedge(soil, rake, np.arctan2(1.0, cot_beta), depth)
    force = cutter(soil).wrench(seen(depth, rake, (1.0, 0.0, 0.0)))[0]
    assert np.array(force)[[0, 2]] == pytest.approx(1.2 * ahead, rel=1e-6)
    # into the soil along the blade, and back: both sides rub, and a thick edge bears as it goes in
    inwards = np.array([np.cos(rake), 0.0, -np.sin(rake)])
    pressure = (1 - np.sin(soil.friction)) * (soil.surcharge + soil.unit_weight * depth / 2)
    shear = soil.adhesion + np.tan(soil.tool_friction) * pressure
    rubs = 2 * 1.2 * depth / np.sin(rake) * shear
    of_cohesion, of_pressure = soil.bearing_factors
    strip = soil.cohesion * of_cohesion
    strip += (soil.surcharge + soil.unit_weight * depth) * of_pressure
    bears = 1.2 * 0.02 * strip / np.hypot(1.0, 0.02 / depth)
    thick = cutter(soil, thickness=0.02)
    for way, expected in ((inwards, rubs + bears), (-inwards, rubs)):
        force = np.array(thick.wrench(seen(depth, rake, way))[0])
        assert force == pytest.approx(-expected * way, rel=1e-6, abs=1e-6 * rubs)
    # deeper than its blade, what is above it weighs on the wedge
    deep = crane.description.Soil(*(getattr(soil, key) for key in (
        "unit_weight", "cohesion", "friction", "tool_friction", "adhesion"
    )), soil.surcharge + soil.unit_weight * 0.5)  # fmt: skip
    filled = 0.8 * np.sin(rake)
    ahead, _ = wedge(deep, rake, np.arctan2(1.0, cot_beta), filled)
    force = cutter(soil).wrench(seen(filled + 0.5, rake, (1.0, 0.0, 0.0)))[0]
    assert np.array(force)[[0, 2]] == pytest.approx(1.2 * ahead, rel=1e-6)


def test_beyond_the_bounds_of_the_rake_it_cuts_with_their_wedges():
    """A heap before what is steeper than upright; a blade laid flat fills nothing and cuts not."""
    depth, ahead = 0.3, (1.0, 0.0, 0.0)
    upright, over = (
        np.array(cutter().wrench(seen(depth, rake, ahead))[0]) for rake in (np.pi / 2, 1.9)
    )
    assert over == pytest.approx(upright, rel=1e-6)
    steep = crane.description.Soil(15e3, 0.0, 1.0, 1.0)
    heap, within = (
        np.array(cutter(steep).wrench(seen(depth, rake, ahead))[0])
        for rake in (1.5, steep.max_rake)
    )
    assert steep.max_rake == pytest.approx(np.pi - 2.35)
    assert heap == pytest.approx(within, rel=1e-6)
    flat, almost = (cutter().wrench(seen(depth, rake, ahead))[0] for rake in (0.0, 1e-6))
    sides = cutter().wrench(seen(depth, 0.0, (-1.0, 0.0, 0.0)))[0]
    assert flat[0] == pytest.approx(-sides[0], rel=1e-6)
    assert almost == pytest.approx(flat, rel=1e-2, abs=1.0)


@pytest.mark.slow
def test_it_never_drives_the_edge_and_is_always_a_number():
    random = np.random.default_rng(0)
    some = 0
    for _ in range(4000):
        phi = random.uniform(0, 1.05) * random.integers(0, 2)
        cohesion = 10 ** random.uniform(0, 5)
        soil = crane.description.Soil(
            random.uniform(1e4, 2e4), cohesion, phi, phi * random.uniform(), cohesion
            * random.uniform(), random.uniform(0, 1e4),
        )  # fmt: skip
        acting = cutter(soil, thickness=random.uniform(0, 0.05), smoothing=1e-2)
        where = seen(
            random.uniform(-0.2, 1.5), random.uniform(-np.pi, np.pi),
            random.normal(size=3) * 10 ** random.uniform(-4, 1), random.uniform(-2, 2),
        )  # fmt: skip
        force = np.array(acting.wrench(where)[0])
        assert np.isfinite(force).all()
        power, most = (
            force @ where.velocity,
            np.linalg.norm(force) * np.linalg.norm(where.velocity),
        )
        assert power <= 1e-9 * most
        assert acting.outputs(where)[1] == pytest.approx(np.linalg.norm(force))
        some += power < -1e-3 * most
        if where.position[2] >= 0:
            assert not force.any()
    assert some > 1000


def test_it_begins_at_the_surface_without_a_jump():
    acting = cutter(thickness=0.02)
    sizes = [
        np.linalg.norm(acting.wrench(seen(depth, 0.8, (1.0, 0.0, -0.5)))[0])
        for depth in (0.0, 1e-9, 1e-6, 1e-3)
    ]
    assert (
        sizes[0] == 0 and sizes[1] < 1e-3 and sizes[2] == pytest.approx(1e3 * sizes[1], rel=1e-3)
    )
    assert sizes[3] < 3e3


@pytest.fixture
def sled(tmp_path):
    """A blade of 300 kg on a sled along x and z that pitches: x, z, pitch."""
    slides = {"kind": "prismatic", "limits": (-9, 9, 1e6, 9)}
    path = write(
        tmp_path, "sled", "world", '<link name="along"/><link name="above"/>',
        body("body", 300, (-0.2, 0, 0.5), (20, 30, 20)),
        joint("x", "world", "along", axis=(1, 0, 0), **slides),
        joint("z", "along", "above", **slides),
        joint("pitch", "above", "body", (0, 0, 0), "revolute", (0, 1, 0), (-2, 2, 1e6, 9)),
        frame("blade", "body", (0.1, 0, -0.4)),
    )  # fmt: skip
    return crane.load(path)


def run(machine, loads, initial, duration, **options):
    return quiet(crane.simulate, machine, None, initial, duration, loads=loads, **options)


def test_pulled_as_the_equation_says_it_goes_on_at_its_speed(sled, tmp_path):
    rake, depth, speed = 1.1, 0.25, 0.8
    _, cot_beta = STICKY.cutting_factors(np.cos(rake), np.sin(rake))
    ahead, _ = wedge(STICKY, rake, np.arctan2(1.0, cot_beta), depth)
    pull = crane.Wrench("blade", (-1.2 * ahead[0], 0, 0), name="pull")
    pitch = rake - np.pi / 2  # about y, that turns z to x
    low = -0.1 * np.sin(pitch) - 0.4 * np.cos(pitch)  # where the edge is beside the pitch joint
    locked = crane.load(tmp_path / "sled.urdf", lock={"z": -depth - low, "pitch": pitch})
    found = run(locked, [cutter(), pull], ([0.0], [speed]), 0.5)
    assert found.q[:, 0] == pytest.approx(speed * found.time, abs=1e-6)
    assert found.channels["depth_blade"] == pytest.approx(depth, abs=1e-9)
    assert found.channels["resistance_blade"] == pytest.approx(1.2 * np.hypot(*ahead), rel=1e-6)
    work = 1.2 * ahead[0] * speed * 0.5
    assert found.channels["work_blade"][-1] == pytest.approx(work, rel=1e-6)


@pytest.mark.parametrize("soil", [STICKY, UNDRAINED])
def test_a_dig_keeps_the_balance_and_is_in_machine_code_what_it_is_in_python(sled, soil):
    ground = crane.description.Ground(profile=((-2.0, -0.6), (0.4, -0.6), (3.0, -0.2)))
    digging = cutter(soil, ground=ground, thickness=0.01, smoothing=0.05)

    def in_python(time, *where):
        parts = [part.tolist() for part in where]
        return np.concatenate(digging.wrench(FrameMotion(*parts, [])))

    push = crane.Wrench("blade", (500.0, 0, 0), (0, 900.0, 0), name="push")
    start = [0.0, -0.25, -0.4], [2.0, -1.0, 0.3]
    runs = [
        run(sled, [load, push], start, 0.3, step=1e-3, method="rk4")
        for load in (digging, crane.description.WrenchFunction("blade", in_python))
    ]
    assert runs[0].q == pytest.approx(runs[1].q, abs=1e-11)
    assert runs[0].channels["depth_blade"].max() > 0.05
    channels = run(sled, [digging, push], start, 0.8, step=5e-3).channels
    work = channels["work_blade"] + channels["work_push"]
    stored = channels["kinetic"] + channels["potential"]
    gap = work - (stored - stored[0]) - channels["dissipated"]
    assert np.abs(gap).max() < 1e-6 * np.ptp(channels["work_blade"])
    assert channels["depth_blade"].max() > 0.05 and np.ptp(channels["work_blade"]) > 500
    assert (np.diff(channels["work_blade"]) <= 1e-9).all()


DIGGING = """
name: digging
chains: [{name: sled, urdf: sled.urdf}]
home: {z: 0.3}
ground: {height: -0.5}
soil: {kind: lean clay, surcharge: 500}
cutters:
  - {frame: blade, width: 1.2, length: 0.8, blade: [0, 0, 2], cutting: [1, 0, 1], thickness: 0.02}
"""


def test_machine_files_dig(sled, tmp_path):
    path = tmp_path / "digging.yaml"
    path.write_text(DIGGING)
    machine = crane.load(path)
    (found,) = machine.external_forces
    assert (found.cutting, found.blade) == ([1, 0, 0], [0, 0, 1])
    assert (found.soil.cohesion, found.soil.surcharge) == (68950.0, 500.0)
    dug = run(machine, [], None, 0.5)
    assert dug.channels["resistance_blade"].max() > 100
    again = crane.load(crane.write_machine(machine, tmp_path / "written"))
    assert run(again, [], None, 0.5).q == pytest.approx(dug.q, abs=1e-12)
    (written,) = again.external_forces
    assert written.soil == found.soil and written.thickness == found.thickness
    for old, new, text in (
        ("ground:", "#", "yaml:8: cutters without ground, add 'ground: {height: 0}'"),
        ("soil:", "#", "yaml:8: cutters without soil, add 'soil: {kind: sandy loam}'"),
        ("lean clay", "lean cla", "'kind' of 'soil': 'lean cla' is unknown, did you"),
        ("kind: lean clay", "friction: 0.3", "yaml:6: 'soil' has no 'unit_weight', add it"),
        ("surcharge: 500", "friction: 0.1", "yaml:6: .*tool_friction .* above its friction 0.1"),
        ("surcharge: 500", "fricton: 0.1", "yaml:6: unknown key 'fricton' in 'soil'"),
        ("frame: blade", "frame: nix", "yaml:8: .*'nix'"),
        ("frame: blade", "frame: world", "yaml:8: .*does not move"),
        ("width: 1.2, ", "", "yaml:8: .* has no 'width'"),
        ("cutting: [1, 0, 1]", "cutting: [0, 0, 1]", "yaml:8: .*along its blade"),
        ("blade: [0, 0, 2]", "blade: [0, 2]", "yaml:8: .*give a direction"),
    ):
        path.write_text(DIGGING.replace(old, new))
        with pytest.raises(CraneError, match=text):
            crane.load(path)
    for other, text in (
        (cutter(SANDY, name="b", ground=found.ground), "several soils"),
        (cutter(found.soil, name="b"), "several grounds"),
    ):
        with pytest.raises(CraneError, match=text):
            crane.write_machine(machine.with_external_forces(other), tmp_path / "other")


def test_the_documented_soils_are_those_of_the_table():
    page = (Path(__file__).parents[1] / "docs" / "machine_file.md").read_text(encoding="utf-8")
    for name, soil in crane.description.SOILS.items():
        (row,) = [line for line in page.splitlines() if line.startswith(f"| `{name}` |")]
        told = [float(word.split()[0]) for word in row.split("|")[2:7]]
        told[2:4] = np.radians(told[2:4])
        assert told == pytest.approx(list(vars(soil).values())[:5], rel=4e-3), name


def test_what_cuts_nothing_is_refused():
    for make, text in (
        (
            lambda: crane.description.Soil(-1.0, 0.0, 0.5),
            "unit_weight of the soil is -1 N/m3, it must not",
        ),
        (lambda: crane.description.Soil(1.0, 0.0, 30.0), "30 rad, give at most 1.05 rad"),
        (
            lambda: crane.description.Soil(1.0, 0.0, 0.3, 0.4),
            "tool_friction .* above its friction 0.3",
        ),
        (
            lambda: crane.description.Soil(1.0, 5.0, 0.3, 0.1, 6.0),
            "adhesion .* above its cohesion 5",
        ),
        (lambda: crane.description.Soil(1.0, np.nan, 0.3), "cohesion of the soil is nan Pa"),
        (
            lambda: cutter("sand"),
            "soil of the cutter at 'blade' is 'sand', give a crane.description.Soil",
        ),
        (lambda: cutter(width=0.0), "the width of the cutter at 'blade'"),
        (lambda: cutter(thickness=-1.0), "must not be negative"),
    ):
        with pytest.raises(CraneError, match=text) as found:
            make()
        assert "\n" not in str(found.value)
