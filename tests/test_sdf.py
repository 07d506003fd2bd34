"""SDF: what it says, in whatever way and version, is the machine that a plain URDF describes."""

from functools import partial

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from command_line import typed
from scipy.integrate import quad
from sdf_models import SdfWriter, draw, planar, stewart, urdf
from warned import quiet, told

import crane
from crane.common.errors import CraneError
from crane.formats.robot_files import open_robots


def load(path, **options):
    return quiet(crane.load, path, **options)


def assert_same(one, two, rng):
    """Mass matrix, gravity and Coriolis forces of two trees, joint by joint."""
    assert set(one.joints) == set(two.joints)
    order = [two.joints.index(name) for name in one.joints]
    for _ in range(4):
        q, v = rng.uniform(-2, 2, (2, one.model.nv))
        other_q, other_v = np.empty_like(q), np.empty_like(v)
        other_q[order], other_v[order] = q, v
        here, there = one.model.createData(), two.model.createData()
        mass, other = (np.triu(pin.crba(*x)) for x in (
            (one.model, here, one.coordinates.configuration(q)),
            (two.model, there, two.coordinates.configuration(other_q))))  # fmt: skip
        mass, other = (x + np.triu(x, 1).T for x in (mass, other))
        scale = np.abs(mass).max()
        assert np.abs(mass - other[np.ix_(order, order)]).max() < 1e-12 * scale
        bias = pin.nonLinearEffects(one.model, here, one.coordinates.configuration(q), v)
        place = two.coordinates.configuration(other_q)
        apart = bias - pin.nonLinearEffects(two.model, there, place, other_v)[order]
        assert np.abs(apart).max() < 1e-11 * max(1, np.abs(bias).max())


@pytest.mark.parametrize("version", [4, 5, 6, 7, 9, 11])
@pytest.mark.parametrize("seed", range(5))
def test_poses_and_axes_mean_what_they_say(version, seed, tmp_path):
    rng = np.random.default_rng([version, seed])
    drawn = draw(rng)
    (tmp_path / "drawn.sdf").write_text(SdfWriter(rng, drawn, version).text())
    (tmp_path / "drawn.urdf").write_text(urdf(drawn))
    assert_same(load(tmp_path / "drawn.sdf"), load(tmp_path / "drawn.urdf"), rng)


def assert_same_driven(one, two, rng, reach, count=4):
    """Mass matrix and gravity in the same active coordinates, the loops closed."""
    assert one.active == two.active
    here, there = crane.Dynamics(one), crane.Dynamics(two)
    for _ in range(count):
        q = one.home[one.closure.active] + rng.uniform(-reach, reach, len(one.active))
        full = one.closure.solve(q)
        assert one.closure.residual(full) < 1e-12
        mass, gravity = here.mass_matrix(q), here.gravity(q)
        assert np.abs(mass - there.mass_matrix(q)).max() < 1e-10 * np.abs(mass).max()
        weight = 9.81 * one.tree.total_mass
        assert np.abs(gravity - there.gravity(q)).max() < 1e-12 * weight


PINS = {
    "four bars": [(0, 0), (0, 0.3), (0.5, 0.45), (0.5, 0)],
    "five bars": [(0, 0), (-0.1, 0.3), (0.25, 0.6), (0.6, 0.3), (0.5, 0)],
    "parallelogram": [(0, 0), (0.1, 0.3), (0.6, 0.3), (0.5, 0)],
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", PINS)
def test_rings_of_joints_are_loops(kind, seed, tmp_path):
    """However the joints of a ring are turned and listed, it closes as URDF+ says it does."""
    rng = np.random.default_rng([seed, len(kind)])
    drawn = planar(rng, PINS[kind])
    (tmp_path / "ring.sdf").write_text(SdfWriter(rng, drawn, 9).text())
    (tmp_path / "ring.urdf").write_text(urdf(drawn))
    active = ["j0", f"j{len(PINS[kind]) - 1}"] if kind == "five bars" else ["j0"]
    one, two = (load(tmp_path / f"ring.{end}", active=active) for end in ("sdf", "urdf"))
    assert len(one.closure.equations.loops) == 1
    assert_same_driven(one, two, rng, 0.2)


@pytest.mark.parametrize("seed", range(2))
def test_platform_on_legs(seed, tmp_path):
    """Universal joints, slides and balls: five balls close loops, one is in the tree."""
    rng = np.random.default_rng([seed, 6])
    drawn = stewart(rng)
    (tmp_path / "legs.sdf").write_text(SdfWriter(rng, drawn, 11).text())
    (tmp_path / "legs.urdf").write_text(urdf(drawn))
    active = [f"slide{i}" for i in range(6)]
    one, two = (load(tmp_path / f"legs.{end}", active=active) for end in ("sdf", "urdf"))
    assert [loop.type for loop in one.closure.equations.loops] == ["spherical"] * 5
    assert_same_driven(one, two, rng, 0.05, 2)


MASS = (
    "<inertial><pose>0.1 0 0.2 0 0 0</pose><mass>1.5</mass><inertia><ixx>0.02</ixx><iyy>0.03</iyy>"
    "<izz>0.025</izz></inertia></inertial>"
)


def arm(joints, version="1.9", more="", links=("a", "b"), name="arm"):
    """An SDF of a few links, one above the other."""
    bodies = "".join(
        f'<link name="{x}"><pose>0 0 {i} 0 0 0</pose>{MASS}</link>' for i, x in enumerate(links)
    )
    return (
        f'<sdf version="{version}"><model name="{name}">\n{bodies}\n{joints}{more}</model></sdf>'
    )


def hinge(name, parent, child, axis="0 1 0", inside="", kind="revolute", beside=""):
    return (
        f'<joint name="{name}" type="{kind}"><parent>{parent}</parent><child>{child}</child>'
        f"{beside}<axis><xyz>{axis}</xyz>{inside}</axis></joint>\n"
    )


TWO = hinge("p", "world", "a") + hinge("q", "a", "b")


def written(folder, text, name="arm.sdf"):
    (folder / name).write_text(text)
    return folder / name


warnings_of = partial(told, crane.load)


def test_limits_friction_springs_and_home(tmp_path):
    inside = (
        "<limit><lower>-1</lower><upper>2</upper><effort>30</effort></limit><dynamics><damping>0.5"
        "</damping><friction>0.25</friction><spring_stiffness>7</spring_stiffness>"
        "<spring_reference>0.4</spring_reference></dynamics>"
        "<initial_position>0.3</initial_position>"
    )
    joints = hinge("p", "world", "a", inside=inside) + hinge("q", "a", "b")
    machine = load(written(tmp_path, arm(joints)))
    assert (machine.lower.tolist(), machine.upper.tolist()) == ([-1, -np.inf], [2, np.inf])
    assert machine.home.tolist() == [0.3, 0]
    assert (machine.friction["p"].viscous, machine.friction["p"].coulomb) == (0.5, 0.25)
    (spring,) = machine.forces
    assert (spring.joint, spring.stiffness, spring.rest) == ("p", 7, 0.4)
    assert machine.model.effortLimit.tolist() == [30, np.inf]


def test_a_screw_turns_and_slides(tmp_path):
    """One turn of a right-handed thread moves it by its pitch; older files say minus rad/m."""
    for text, version in (
        ("<screw_thread_pitch>0.3</screw_thread_pitch>", "1.10"),
        (f"<thread_pitch>{-2 * np.pi / 0.3!r}</thread_pitch>", "1.6"),
    ):
        joints = hinge("p", "world", "a") + hinge(
            "s", "a", "b", "0 0 1", kind="screw", beside=text
        )
        machine = load(written(tmp_path, arm(joints, version)), active=["p", "s"])
        q = machine.closure.solve([0.0, 2 * np.pi])
        assert q[machine.column("s_slide")] == pytest.approx(0.3, abs=1e-14)


def test_a_gearbox_turns_the_second_link_backwards(tmp_path):
    """theta_2 = -ratio theta_1, angles from the reference about the axes of the gearbox."""
    gear = (
        '<joint name="g" type="gearbox"><parent>a</parent><child>b</child><gearbox_ratio>3'
        "</gearbox_ratio><gearbox_reference_body>base</gearbox_reference_body>"
        "<axis><xyz>0 1 0</xyz></axis><axis2><xyz>0 1 0</xyz></axis2></joint>"
    )
    joints = (
        '<joint name="f" type="fixed"><parent>world</parent><child>base</child></joint>'
        + hinge("p", "base", "a") + hinge("q", "base", "b", "0 -1 0") + gear
    )  # fmt: skip
    machine = load(written(tmp_path, arm(joints, links=("base", "a", "b"))), active=["p"])
    assert machine.closure.solve([0.2])[machine.column("q")] == pytest.approx(0.6, abs=1e-14)


def test_a_joint_follows_another(tmp_path):
    """q = multiplier (leader - reference) + offset."""
    mimic = (
        '<mimic joint="p"><multiplier>2</multiplier><offset>0.1</offset><reference>0.3</reference>'
        "</mimic>"
    )
    joints = hinge("p", "world", "a") + hinge("q", "a", "b", inside=mimic)
    machine = load(written(tmp_path, arm(joints, "1.11")))
    assert machine.closure.solve([0.5])[machine.column("q")] == pytest.approx(0.5, abs=1e-14)


def test_nothing_drives_a_joint_without_effort(tmp_path):
    zero = "<limit><effort>0</effort></limit>"
    joints = hinge("p", "world", "a", inside=zero) + hinge("q", "a", "b")
    machine = load(written(tmp_path, arm(joints)))
    assert machine.free == ("p",)


def test_stands_on_the_ground_or_floats(tmp_path):
    path = written(tmp_path, arm(hinge("q", "a", "b")))
    machine, told = warnings_of(path)
    assert machine.joints == ("q",)
    assert told == [
        "arm.sdf:2: nothing joins 'arm' to the world, it is taken as standing on the ground by "
        "link 'a': --floating (floating=True) lets it float"
    ]
    machine, told = warnings_of(path, floating=True)
    assert len(machine.joints) == 7 and not any("ground" in line for line in told)
    total = pin.crba(machine.model, machine.model.createData(), pin.neutral(machine.model))[0, 0]
    assert total == pytest.approx(3.0)


def test_parts_apart(tmp_path):
    """Those that nothing ties to a grounded one fall freely; if all float, each does."""
    path = written(tmp_path, arm(hinge("p", "world", "a"), links=("a", "b")))
    machine, told = warnings_of(path)
    assert machine.free == tuple(f"b_free_{x}" for x in ("x", "y", "z", "rx", "ry", "rz"))
    assert told == [
        "arm.sdf: otherwise than in SDF: links that no joint ties to the others float (b)"
    ]
    path = written(tmp_path, arm(hinge("p", "a", "b"), links=("a", "b", "c")))
    assert load(path).joints == ("p",)
    assert len(load(path, floating=True).joints) == 13


def test_a_link_without_mass_weighs_what_sdf_says(tmp_path):
    text = arm(TWO).replace(MASS, "", 1).replace('name="b"><pose>', 'name="b" ><pose>')
    machine, told = warnings_of(written(tmp_path, text))
    assert machine.tree.total_mass == 2.5
    assert told == [
        "arm.sdf:2: link 'a' has no <inertial>, which SDF takes as 1 kg and 1 kg m2: write what "
        "it has"
    ]


def test_mass_of_collisions(tmp_path):
    """A box of water and a ball of steel beside it."""
    shapes = (
        '<inertial auto="true"/><collision name="x"><pose>0 0 0.5 0 0 0.3</pose><geometry><box>'
        "<size>0.1 0.2 1</size></box></geometry></collision><collision name='y'><pose>1 0 0 0 0 0"
        "</pose><density>7800</density><geometry><sphere><radius>0.1</radius></sphere></geometry>"
        "</collision>"
    )
    machine = load(written(tmp_path, arm(TWO).replace(MASS, shapes, 1)))
    inertial = machine.tree.links["a"].inertial
    masses = np.array([20.0, 7800 * 4 / 3 * np.pi * 1e-3])
    assert inertial.mass == pytest.approx(masses.sum(), rel=1e-14)
    com = (masses @ [[0, 0, 0.5], [1, 0, 0]]) / masses.sum()
    assert np.allclose(inertial.com, com, atol=1e-14)
    about = inertial.tensor[2 + 1]  # yy: both turned about the common centre of mass
    own = [20 / 12 * (1 + (0.1 * np.cos(0.3)) ** 2 + (0.2 * np.sin(0.3)) ** 2),
           0.4 * masses[1] * 0.01]  # fmt: skip
    steiner = masses @ (np.square([[0, 0.5], [1, 0]] - com[[0, 2]])).sum(axis=1)
    assert about == pytest.approx(sum(own) + steiner, rel=1e-12)


SOLIDS = {  # radius at a height, lowest and highest, by closed forms of the shapes alone
    "<sphere><radius>0.3</radius></sphere>": (lambda z: np.sqrt(0.09 - z * z), -0.3, 0.3),
    "<cylinder><radius>0.2</radius><length>0.7</length></cylinder>": (lambda z: 0.2, -0.35, 0.35),
    "<capsule><radius>0.2</radius><length>0.7</length></capsule>": (
        lambda z: np.sqrt(np.maximum(0.04 - np.maximum(np.abs(z) - 0.35, 0.0) ** 2, 0.0)),
        -0.55,
        0.55,
    ),
    "<cone><radius>0.2</radius><length>0.8</length></cone>": (
        lambda z: 0.2 * (0.4 - z) / 0.8, -0.4, 0.4,
    ),
    "<ellipsoid><radii>0.2 0.2 0.5</radii></ellipsoid>": (
        lambda z: 0.2 * np.sqrt(1 - 4 * z * z), -0.5, 0.5,
    ),
}  # fmt: skip


def body_of(folder, inertial, *collisions):
    """The inertial of the first link with these `<collision>` elements."""
    shapes = "".join(f'<collision name="c{i}">{x}</collision>' for i, x in enumerate(collisions))
    text = arm(TWO, version="1.12").replace(MASS, inertial + shapes, 1)
    return load(written(folder, text)).tree.links["a"].inertial


@pytest.mark.parametrize("shape", SOLIDS, ids=lambda shape: shape[1:].partition(">")[0])
def test_solids_of_revolution_by_slices(shape, tmp_path):
    """Discs of radius r at height z: dm = rho pi r^2 dz, r^2 / 2 dm, (r^2 / 4 + z^2) dm."""
    radius, low, high = SOLIDS[shape]
    found = body_of(
        tmp_path, '<inertial auto="true"/>',
        f"<density>2700</density><geometry>{shape}</geometry>",
    )  # fmt: skip

    def total(weight):
        area = lambda z: np.pi * radius(z) ** 2 * 2700 * weight(z)  # noqa: E731
        ends = [low, *(x for x in (-0.35, 0.35) if low < x < high), high]
        pairs = zip(ends, ends[1:], strict=False)
        return sum(quad(area, a, b, epsabs=1e-12, epsrel=1e-12)[0] for a, b in pairs)

    mass = total(lambda z: 1.0)
    centre = total(lambda z: z) / mass
    across = total(lambda z: radius(z) ** 2 / 4 + (z - centre) ** 2)
    along = total(lambda z: radius(z) ** 2 / 2)
    assert found.mass == pytest.approx(mass, rel=1e-9)
    assert np.allclose(found.com, [0, 0, centre], atol=1e-9)
    assert np.allclose(found.tensor, [across, 0, 0, across, 0, along], rtol=1e-9, atol=1e-9)


def mesh_of(folder, mesh, name="part.stl", scale="1 1 1"):
    mesh.export(folder / name)
    uri = f"<uri>{name}</uri><scale>{scale}</scale>"
    return f"<density>800</density><geometry><mesh>{uri}</mesh></geometry>"


def test_a_closed_mesh_is_the_solid_that_it_bounds(tmp_path):
    """A box as triangles, out of the middle, scaled, and inside out by a mirror."""
    box = trimesh.creation.box((0.2, 0.4, 0.6))
    box.apply_translation((5, -3, 1))
    for name, scale in (("a.stl", "1 0.5 2"), ("b.obj", "1 0.5 2"), ("c.ply", "-1 0.5 2")):
        found = body_of(tmp_path, '<inertial auto="true"/>', mesh_of(tmp_path, box, name, scale))
        x, y, z = 0.2, 0.2, 1.2
        mass = 800 * x * y * z
        moments = mass / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
        assert found.mass == pytest.approx(mass, rel=1e-6)  # STL has seven digits
        assert np.allclose(found.com, [np.copysign(5, float(scale.split()[0])), -1.5, 2])
        assert np.allclose(
            found.tensor, np.diag(moments)[np.triu_indices(3)], rtol=1e-5, atol=1e-5
        )


def test_density_and_mass_of_the_whole(tmp_path):
    """Density by collision, then by link, then water; a mass keeps the shape of the tensor."""
    boxes = [
        f"<pose>{x} 0 0 0 0 0</pose>{density}"
        "<geometry><box><size>0.1 0.1 0.1</size></box></geometry>"
        for x, density in ((0, ""), (1, "<density>3000</density>"))
    ]
    water = body_of(tmp_path, '<inertial auto="true"/>', *boxes)
    assert (water.mass, water.com[0]) == pytest.approx((4.0, 0.75))
    oil = body_of(tmp_path, '<inertial auto="1"><density>500</density></inertial>', *boxes)
    assert (oil.mass, oil.com[0]) == pytest.approx((3.5, 3 / 3.5))
    for given in (
        '<inertial auto="true"><mass>8</mass></inertial>',
        '<inertial><mass>8</mass><inertia auto="true"/></inertial>',
    ):
        weighed = body_of(tmp_path, given, *boxes)
        assert weighed.mass == 8 and weighed.com == pytest.approx(water.com)
        assert weighed.tensor == pytest.approx([2 * x for x in water.tensor])


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ("<mesh><uri>open.stl</uri></mesh>", "the mesh 'open.stl', which 3 edges leave open, so"),
        ("<mesh><uri>none.stl</uri></mesh>", "the mesh 'none.stl', which is not there, so that"),
        ("<mesh><uri>bad.stl</uri></mesh>", "the mesh 'bad.stl', which cannot be read ("),
        ("<mesh><uri>open.stl</uri><submesh><name>a</name></submesh></mesh>", "takes a part of"),
        (
            "<plane><normal>0 0 1</normal></plane>",
            "is no box, capsule, cone, cylinder, ellipsoid, ",
        ),
        ("<sphere><radius>-1</radius></sphere>", "<radius> of a collision of link 'a' is not pos"),
    ],
    ids=["open", "missing", "damaged", "part", "plane", "negative"],
)
def test_shapes_without_a_volume(shape, message, tmp_path):
    box = trimesh.creation.box((1, 1, 1))
    box.update_faces(np.arange(12) > 0)
    box.export(tmp_path / "open.stl")
    (tmp_path / "bad.stl").write_text("no mesh")
    with pytest.raises(CraneError) as caught:
        body_of(tmp_path, '<inertial auto="true"/>', f"<geometry>{shape}</geometry>")
    assert message in str(caught.value) and str(caught.value).startswith("arm.sdf:")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.sdf", "", "a.sdf: the file is empty, write an <sdf> in it"),
        ("a.world", " ", "a.world: the file is empty, write an <sdf> in it"),
        ("a.mjcf", "", "a.mjcf: the file is empty, write a <mujoco> in it"),
        ("a.xml", "", "a.xml: the file is empty, write a <robot>, an <sdf> or a <mujoco> in it"),
        ("a.sdf", "<model/>", "a.sdf:1: an SDF starts with <sdf>, this file with <model>"),
    ],
)
def test_files_without_an_sdf(name, text, message, tmp_path):
    with pytest.raises(CraneError) as caught:
        load(written(tmp_path, text, name))
    assert str(caught.value) == message


@pytest.mark.parametrize("kind", ["fixed", "ball"])
def test_an_axis_that_a_joint_does_not_use_is_not_read(kind, tmp_path):
    joint = hinge("q", "a", "b", axis="0 0 0", kind=kind)
    assert load(written(tmp_path, arm(hinge("p", "world", "a") + joint))).joints


def test_models_within_models(tmp_path):
    """An included hand by its grip, in a folder that is given, against the same written flat."""
    hand = tmp_path / "models" / "my_hand"
    hand.mkdir(parents=True)
    (hand / "model.config").write_text(
        '<model><name>Hand</name><sdf version="1.9">hand.sdf</sdf></model>'
    )
    (hand / "hand.sdf").write_text(
        f'<sdf version="1.9"><model name="hand"><link name="palm">{MASS}</link><frame name="grip">'
        "<pose>0.15 0.2 -0.1 0 0 0</pose></frame></model></sdf>"
    )
    include = (
        "<include><uri>model://my_hand</uri><name>left</name><pose relative_to='b'>0 0 1 0 0 0"
        "</pose><placement_frame>grip</placement_frame></include>"
    )
    path = written(tmp_path, arm(TWO + hinge("w", "b", "left"), more=include))
    (tmp_path / "flat").mkdir()
    palm = f"<link name='palm'><pose>-0.15 -0.2 2.1 0 0 0</pose>{MASS}</link>"
    flat = written(tmp_path / "flat", arm(TWO + hinge("w", "b", "palm"), more=palm))
    rng = np.random.default_rng(0)
    assert_same(load(path, packages=[tmp_path / "models"]), load(flat), rng)
    machine = load(path, packages=[tmp_path / "models"])
    assert crane.formats.load_from_expression(machine.load_expression).model == machine.model


def test_a_world_with_one_machine(tmp_path):
    """Models that stand still, and those that are not there, are no part of it."""
    model = arm(TWO).removeprefix('<sdf version="1.9">').removesuffix("</sdf>")
    world = (
        '<sdf version="1.9"><world name="w"><include><uri>model://sun</uri></include>'
        f'<model name="floor"><static>true</static><link name="l"/></model>{model}</world></sdf>'
    )
    machine, told = warnings_of(written(tmp_path, world, "arm.world"))
    assert machine.joints == ("p", "q")
    assert told == ["arm.world: left out of what SDF has: models that are not found (model://sun)"]
    two = world.replace("</world>", model.replace('"arm"', '"other"') + "</world>")
    path = written(tmp_path, two, "two.world")
    with pytest.raises(CraneError, match=r"2 models move \(arm, other\), choose one: --arg model"):
        crane.load(path)
    assert load(path, arguments={"model": "other"}).name == "other"


def test_what_is_drawn(tmp_path):
    visual = (
        "<visual name='v'><pose relative_to='b'>0 0 1 0 0 0</pose><geometry><box>"
        "<size>1 2 3</size></box></geometry><material><diffuse>1 0 0 1</diffuse></material>"
        "</visual>"
    )
    text = arm(TWO).replace(MASS, MASS + visual, 1)
    machine = load(written(tmp_path, text))
    with open_robots(machine) as (xml,):
        (drawn,) = xml.root.iter("visual")
    assert drawn.find("origin").get("xyz").split() == ["0.0", "0.0", "2.0"]
    crane.formats.write_urdf_plus(machine, tmp_path / "out.urdf")
    assert 'size="1 2 3"' in (tmp_path / "out.urdf").read_text()
    assert_same(machine, load(tmp_path / "out.urdf"), np.random.default_rng(1))


def test_commands(tmp_path):
    path = written(tmp_path, arm(TWO))
    assert typed("check", path).returncode == 0
    assert "drive" not in typed("info", path).stderr
    assert typed("convert", path, tmp_path / "arm.urdf").returncode == 0
    assert typed("convert", path, tmp_path / "folder").returncode == 0
    for made in (tmp_path / "arm.urdf", tmp_path / "folder" / "arm.yaml"):
        assert_same(load(path), load(made), np.random.default_rng(2))
    done = typed("check", path, "--write-home")
    assert done.returncode == 2
    assert "is an SDF, write it into a copy" in done.stderr


REFUSED = [
    ("type", TWO.replace('"revolute"', '"revolut"', 1),
     "arm.sdf:3: joint 'p' has the type 'revolut', did you mean 'revolute'?"),
    ("parent", hinge("p", "wolrd", "a"),
     "arm.sdf:3: joint 'p' names 'wolrd', which is unknown, known: a, b, p"),
    ("itself", hinge("p", "a", "a"), "arm.sdf:3: joint 'p' joins 'a' to itself"),
    ("no child", "<joint name='p' type='fixed'><parent>a</parent></joint>",
     "arm.sdf:3: joint 'p' has no <child>, add it"),
    ("number", hinge("p", "a", "b", "0 x 0"),
     "arm.sdf:3: <xyz> of joint 'p' is not a number, write digits"),
    ("axis", hinge("p", "a", "b", "0 0 0"),
     "arm.sdf:3: the axis of joint 'p' is zero, give a direction"),
    ("ring", TWO + "<frame name='f'><pose relative_to='g'/></frame>"
     "<frame name='g'><pose relative_to='f'/></frame><joint name='r' type='fixed'>"
     "<parent>b</parent><child>f</child></joint>",
     "arm.sdf:5: frame 'g' is relative to 'f' in a ring, break it"),
    ("twice", TWO + hinge("p", "a", "b"),
     "arm.sdf:5: joint 'p' is there twice (first in arm.sdf:3), rename one"),
    ("include", "<include><uri>model://lost</uri></include>",
     "arm.sdf:3: there is no model 'model://lost', say where it is: --packages FOLDER, "
     "packages=[...] in Python"),
    ("static", "<static>1</static>", "arm.sdf:1: model 'arm' is static: nothing in it moves"),
    ("limits", hinge("p", "a", "b", inside="<limit><lower>1</lower><upper>-1</upper></limit>"),
     "arm.sdf:3: the limits of joint 'p' are reversed (1 > -1), swap them"),
    ("gear", TWO + hinge("g", "a", "b", kind="gearbox",
     beside="<gearbox_reference_body>world</gearbox_reference_body>"),
     "arm.sdf:5: joint 'g': no joint turns 'b' against 'world' about the gear's axis, name "
     "another gearbox_reference_body"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("joints", "message"), [x[1:] for x in REFUSED], ids=[x[0] for x in REFUSED]
)
def test_is_refused(joints, message, tmp_path):
    path = written(tmp_path, arm(joints))
    with pytest.raises(CraneError) as caught:
        load(path)
    assert str(caught.value) == message
    assert typed("check", path).returncode == 2


def test_negative_mass_is_refused(tmp_path):
    path = written(tmp_path, arm(TWO).replace("1.5", "-1.5", 1))
    with pytest.raises(CraneError, match="arm.sdf:2: link 'a' has the mass -1.5 kg"):
        load(path)


def test_slips_are_told(tmp_path):
    inside = "<limit><lowr>1</lowr></limit><damping>3</damping>"
    path = written(tmp_path, arm(hinge("p", "world", "a", inside=inside) + hinge("q", "a", "b")))
    _, told = warnings_of(path)
    assert told == [
        "arm.sdf:3: unknown <damping> in <axis> of joint 'p', it is left out, it belongs into "
        "<dynamics>",
        "arm.sdf:3: unknown <lowr> in <limit> of joint 'p', it is left out, did you mean <lower>?",
    ]


def test_links_without_gravity_are_told(tmp_path):
    text = arm(TWO).replace(MASS, MASS + "<gravity>0</gravity>", 1)
    _, told = warnings_of(written(tmp_path, text))
    assert told == ["arm.sdf: otherwise than in SDF: links without gravity have their weight (a)"]


def test_plugins_and_sensors_are_told_once(tmp_path):
    more = '<plugin name="drive" filename="x.so"/><plugin name="imu" filename="y.so"/>'
    _, told = warnings_of(written(tmp_path, arm(TWO, more=more)))
    assert told == ["arm.sdf: left out of what SDF has: plugins (drive, imu)"]
