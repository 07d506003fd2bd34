"""Reactions of joints against free-body diagrams and Pinocchio's constraint solver."""

import hanging_loads
import numpy as np
import pinocchio as pin
import pytest
from hanging_loads import joint, limits, link
from linkages import postures
from scipy.linalg import null_space
from test_file_precision import four_bar, loaded, written

import crane
from crane import Dynamics
from crane.common.errors import InputError, SingularConfigurationError
from crane.description import ForceElement, Rope
from crane.dynamics import Reactions

G = 9.81


def moving(machine, count, seed=0, share=0.15):
    """Closed postures in motion: active coordinates, and q, v, a of all joints."""
    rng = np.random.default_rng(seed)
    lower = np.where(np.isfinite(machine.lower), machine.lower, -1.0)
    upper = np.where(np.isfinite(machine.upper), machine.upper, 1.0)
    size = (count, len(machine.active))
    spread = share * (upper - lower) * rng.uniform(-1, 1, size)
    q_a = machine.home[machine.closure.active] + spread
    v_a, a_a = 0.5 * rng.normal(size=size), rng.normal(size=size)
    q = machine.closure.solve(q_a)
    gamma = machine.closure.gamma(q)
    v = np.einsum("nij,nj->ni", gamma, v_a)
    a = np.einsum("nij,nj->ni", gamma, a_a) + machine.closure.drift(q, v)
    return (q_a, v_a, a_a), (q, v, a)


def load(folder, text, **more):
    (folder / "machine.urdf").write_text(text)
    return crane.load(folder / "machine.urdf", **more)


BEAM = (
    '<robot name="beam">\n<link name="ground"/>\n'
    + link("beam", 100, "1 0 0", (1, 0, 0, 30, 0, 30))
    + '<link name="barrel"/>\n<link name="rod"/>\n<link name="end"/>\n'
    + joint("pivot", "ground", "beam", "0 0 0", "0 1 0")
    + joint("foot", "ground", "barrel", "0.6 0 -1", "0 1 0")
    + joint("stroke", "barrel", "rod", "0 0 0", "0 0 1", limits(0.5, 2, 1e5), "prismatic")
    + '<joint name="at_end" type="fixed"><parent link="beam"/><child link="end"/>'
    '<origin xyz="2 0 0"/></joint>'
    '<loop name="eye" type="revolute">'
    '<predecessor link="beam"><origin xyz="1 0 0"/></predecessor>'
    '<successor link="rod"/><axis xyz="0 1 0"/></loop>'
    '<group_state name="home"><joint name="foot" value="0.3"/>'
    '<joint name="stroke" value="1.077"/></group_state></robot>'
)


def test_beam_on_a_cylinder_by_moments(tmp_path):
    """F d = sum of moments about the pivot, d the distance of pivot and cylinder's line."""
    beam = load(tmp_path, BEAM, active=["stroke"])
    reactions = Reactions(beam)
    push = np.array([200.0, 0, -1000, 0, 0, 0])
    for length in (0.9, 1.08, 1.3):
        q = beam.closure.solve([length])
        tilt = q[beam.column("pivot")]
        along = np.array([np.cos(tilt), 0, -np.sin(tilt)])
        foot = np.array([0.6, 0, -1])
        way = (along - foot) / length
        weight = np.array([0, 0, -100 * G])
        turning = np.cross(along, weight) + np.cross(2 * along, push[:3])
        force = -turning[1] / np.cross(along, way)[1]
        found = dict(
            zip(reactions.names, reactions.joint_wrenches(q, wrenches={"end": push}), strict=True)
        )
        assert np.allclose(reactions.drive_forces(q, wrenches={"end": push}), force, rtol=1e-12)
        # the beam, predecessor of the eye, is pushed by the rod
        assert np.allclose(found["eye"][:3], -force * way, atol=1e-9)
        assert np.allclose(found["foot"][:3], force * way, atol=1e-9)
        assert np.allclose(found["pivot"][:3], -weight - push[:3] - force * way, atol=1e-9)
        # massless barrel and rod are pulled and pushed along their line alone
        assert np.allclose([found[x][3:] for x in ("eye", "foot", "stroke")], 0, atol=1e-9)
    known = dict(zip(reactions.names, reactions.statically_determined(q), strict=True))
    for pinned in ("pivot", "foot", "eye"):
        assert known[pinned].tolist() == [True, True, False, False, False, True]


# R. L. Norton, Design of Machinery, 11.4: a four-bar whose crank turns under a force on its
# coupler and a torque on its rocker; in inches and pounds, in a plane that no weight acts in.
CRANK, COUPLER, ROCKER, GROUND = 5.0, 15.0, 10.0, 19.0
MASSES, INERTIAS = (1.5 / 386, 7.7 / 386, 5.8 / 386), (0.4, 1.5, 0.8)
CENTRES = [r * np.exp(1j * np.radians(x)) for r, x in ((3, 30), (9, 45), (5, 0))]


def _bar(name, i):
    inertia = (INERTIAS[i], 0, 0, INERTIAS[i], 0, INERTIAS[i])
    return link(name, MASSES[i], f"{CENTRES[i].real} {CENTRES[i].imag} 0", inertia)


FOUR_BAR = (
    '<robot name="four_bar">\n<link name="ground"/>\n'
    + _bar("crank", 0) + _bar("coupler", 1) + _bar("rocker", 2)
    + joint("O2", "ground", "crank", "0 0 0", "0 0 1")
    + joint("A", "crank", "coupler", f"{CRANK} 0 0", "0 0 1")
    + joint("O4", "ground", "rocker", f"{GROUND} 0 0", "0 0 1")
    + '<link name="P"/><joint name="at_P" type="fixed"><parent link="coupler"/><child link="P"/>'
    f'<origin xyz="{(CENTRES[1] + 3 * np.exp(1.74533j)).real} '
    f'{(CENTRES[1] + 3 * np.exp(1.74533j)).imag} 0"/></joint>'
    '<loop name="B" type="revolute">'
    f'<predecessor link="coupler"><origin xyz="{COUPLER} 0 0"/></predecessor>'
    f'<successor link="rocker"><origin xyz="{ROCKER} 0 0"/></successor><axis xyz="0 0 1"/></loop>'
    '<group_state name="home"><joint name="O2" value="1.047"/><joint name="A" value="-0.682"/>'
    '<joint name="O4" value="1.822"/></group_state></robot>'
)  # fmt: skip


def _asked(model, data, body):
    """Momentum's rate less weight of a body, at the world's origin."""
    inertia, spin = model.inertias[body], data.v[body]
    rate = (inertia * data.a[body] + spin.cross(inertia * spin)).vector
    place = data.oMi[body]
    weight = inertia.mass * place.rotation.T @ model.gravity.linear
    rate -= np.append(weight, np.cross(inertia.lever, weight))
    return place.act(pin.Force(rate)).vector


def _about(point, wrench):
    return np.append(wrench[:3], wrench[3:] + np.cross(point, wrench[:3]))


def _machine(name, folder):
    """A machine with a spring, a gas of force and a rope between frames, and loads on links."""
    if name == "afloat":
        return hanging_loads.floating_series(folder), ["load", "hull"]
    machine = crane.load(name)
    links = [machine.tip, machine.closure.equations.loops[0].successor]
    root = machine.tree.root_link
    far = 5 * machine.closure.characteristic_length
    return machine.replace(
        forces=(ForceElement(between=(root, links[0]), stiffness=3e3, damping=200, force=500),
                ForceElement(joint=machine.closure.equations.coordinates.names[-1], force=77)),
        ropes=(Rope(between=(links[0], links[1]), stiffness=2e4, damping=0.1, length=far / 1e3),),
    ), links  # fmt: skip


@pytest.mark.parametrize("name", ["excavator", "patu655", "mini_forwarder", "afloat"])
def test_every_body_is_in_balance(name, tmp_path):
    """Joints, weight, springs and loads give each body its momentum's rate; pins turn freely."""
    machine, links = _machine(name, tmp_path)
    (q_a, v_a, a_a), (q, v, a) = moving(machine, 12)
    reactions, dynamics = Reactions(machine), Dynamics(machine)
    rng = np.random.default_rng(1)
    scale = G * machine.tree.total_mass
    loads = {held: 0.2 * scale * rng.normal(size=(12, 6)) for held in links}
    found = reactions.joint_wrenches(q, v, a, loads, friction=True)
    drives = reactions.drive_forces(q, v, a, loads, friction=True)
    wanted = dynamics.inverse(q_a, v_a, a_a, friction=True) - dynamics.project_wrenches(q_a, loads)
    assert np.allclose(drives, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
    model, data = machine.model, machine.model.createData()
    joints, nj = dict(zip(reactions.names, range(100), strict=False)), model.njoints - 1
    largest = np.abs(found).max()
    forces = dynamics.forces
    for i in range(len(q)):
        at = machine.coordinates.configuration(q[i])
        pin.forwardKinematics(model, data, at, v[i], a[i])
        pin.updateFramePlacements(model, data)
        rest = np.zeros((model.njoints, 6))
        for body in range(1, model.njoints):
            rest[body] = -_asked(model, data, body)
            wrench = _about(data.oMi[body].translation, found[i, body - 1])
            rest[body] += wrench
            rest[model.parents[body]] -= wrench
        for loop in machine.closure.equations.loops:
            one, two = (machine.frame(x) for x in (loop.predecessor, loop.successor))
            wrench = _about(data.oMf[two].translation, found[i, joints[loop.name]])
            rest[model.frames[two].parentJoint] += wrench
            rest[model.frames[one].parentJoint] -= wrench
        for held, wrench in loads.items():
            frame = machine.frame(held)
            about = _about(data.oMf[frame].translation, wrench[i])
            rest[model.frames[frame].parentJoint] += about
        for item in machine.force_elements:
            if item.between is None:
                continue
            one, two = (machine.frame(x) for x in item.between)
            way = data.oMf[two].translation - data.oMf[one].translation
            length = np.linalg.norm(way)
            rates = [
                pin.getFrameVelocity(model, data, x, pin.LOCAL_WORLD_ALIGNED).linear
                for x in (one, two)
            ]
            rate = (rates[1] - rates[0]) @ way / length
            if isinstance(item, Rope):
                deep = max(0.0, length - item.length)
                force = -item.stiffness * deep * max(0.0, 1 + item.damping * rate)
            else:
                force = item.force - item.stiffness * length - item.damping * rate
            for frame, sign in ((one, -1), (two, 1)):
                push = np.append(sign * force * way / length, np.zeros(3))
                body = model.frames[frame].parentJoint
                rest[body] += _about(data.oMf[frame].translation, push)
        assert np.abs(rest[1:]).max() < 1e-9 * largest
        # across a joint goes what acts along it
        axes = reactions.joint_axes(q[i])
        driven = np.zeros(model.nv)
        driven[machine.closure.active] = drives[i]
        along, _ = forces.passive_forces_by_element(q[i], v[i])
        along = driven + along[: model.nv] - forces.friction_forces(v[i]) - model.armature * a[i]
        for column, body in enumerate(machine.coordinates.joints.tolist()):
            if model.joints[body].nv > 1:
                continue
            part = slice(0, 3) if machine.coordinates.is_translation[column] else slice(3, 6)
            across = found[i, body - 1, part] @ axes[body - 1, :, 2]
            assert abs(across - along[column]) < 1e-9 * largest
        for k, loop in enumerate(machine.closure.equations.loops):
            assert loop.type == "revolute"
            assert abs(found[i, nj + k, 3:] @ axes[nj + k, :, 2]) < 1e-9 * largest


def test_what_floats_is_held_by_nothing(tmp_path):
    machine = hanging_loads.floating_series(tmp_path)
    _, (q, v, _) = moving(machine, 1)
    tau = np.zeros(len(machine.active))
    q_a = q[0, machine.closure.active]
    gained = Dynamics(machine).forward(q_a, v[0, machine.closure.active], tau)
    a = machine.closure.gamma(q[0]) @ gained + machine.closure.drift(q[0], v[0])
    found = Reactions(machine).joint_wrenches(q[0], v[0], a)
    assert np.abs(found[0]).max() < 1e-9 * np.abs(found).max()


def test_determined_is_what_no_stress_changes(mini):
    """Random stresses of the loops in themselves, gathered body by body."""
    reactions = Reactions(mini)
    _, (q, v, a) = moving(mini, 3)
    equations, model = mini.closure.equations, mini.model
    known = reactions.statically_determined(q)
    rng = np.random.default_rng(2)
    for i in range(len(q)):
        jacobian = equations.evaluate(q[i])[1]
        stress = null_space(jacobian.T, rcond=1e-9)
        assert stress.shape[1] == len(jacobian) - len(mini.closure.passive)
        data = equations.data
        frames = [data.oMi[joint] * local for joint, local in equations.frames]
        rows = equations.constraint_wrenches(
            np.array([x.rotation for x in frames]), np.array([x.translation for x in frames])
        )
        lambdas = stress @ rng.normal(size=stress.shape[1])
        held = np.zeros((model.njoints, 6))
        loops = []
        for k, loop in enumerate(equations.loops):
            wrench = lambdas[equations.loop_of_row == k] @ rows[equations.loop_of_row == k]
            one, two = (model.frames[mini.frame(x)].parentJoint
                        for x in (loop.predecessor, loop.successor))  # fmt: skip
            for body, sign in ((one, 1), (two, -1)):
                for carrier in model.supports[body]:
                    held[carrier] += sign * wrench
            loops.append(_about(-frames[2 * k + 1].translation, wrench))
        joints = [_about(-data.oMi[j].translation, held[j]) for j in range(1, model.njoints)]
        changed = np.array([*joints, *loops]).reshape(-1, 2, 3) @ reactions.joint_axes(q[i])
        loud = np.abs(changed.reshape(-1, 6)) > 1e-9 * np.abs(changed).max()
        assert (loud == ~known[i]).all()


def test_a_unit_force_is_what_it_adds(mini):
    reactions = Reactions(mini)
    _, (q, v, a) = moving(mini, 4)
    for held in (mini.tip, mini.tree.root_link):
        unit = reactions.unit_load_wrenches(q, held)
        assert np.allclose(unit[2], reactions.unit_load_wrenches(q[2], held), atol=1e-12)
        force = np.array([3.0, -2.0, 5.0])
        loaded = reactions.joint_wrenches(q, v, a, {held: [*force, 0, 0, 0]}, friction=True)
        added = loaded - reactions.joint_wrenches(q, v, a, friction=True)
        assert np.allclose(unit @ force, added, atol=1e-10)


def test_rotors_take_their_torque_before_the_pin(tmp_path):
    """A drive gives the rotor its part, which does not go through the joint."""
    plain = load(tmp_path, FOUR_BAR, active=["O2"])
    geared = crane.load(plain.path, active=["O2"], changes={"O2.rotor_inertia": 3.0})
    _, (q, v, a) = moving(plain, 2)
    one, two = Reactions(plain), Reactions(geared)
    assert np.allclose(one.joint_wrenches(q, v, a), two.joint_wrenches(q, v, a), atol=1e-12)
    more = two.drive_forces(q, v, a) - one.drive_forces(q, v, a)
    assert np.allclose(more, 3.0 * a[:, plain.closure.active])


def test_without_loops_it_is_rnea():
    machine = crane.load("tx40")
    q = postures(machine, 0.5, 3) if machine.closure.equations.loops else machine.home[None]
    reactions, data = Reactions(machine), machine.model.createData()
    found = reactions.joint_wrenches(q)
    assert reactions.statically_determined(q).all()
    pin.rnea(machine.model, data, q[0], 0 * q[0], 0 * q[0])
    pin.forwardKinematics(machine.model, data, q[0])
    for body in range(1, machine.model.njoints):
        turn, force = data.oMi[body].rotation, data.f[body]
        assert np.allclose(found[0, body - 1, :3], turn @ force.linear)
        assert np.allclose(found[0, body - 1, 3:], turn @ force.angular)


def test_digits_determine_no_more_than_what_was_meant(tmp_path):
    """Axes that are 3.7e-6 rad off hold nothing out of the plane."""
    (tmp_path / "meant").mkdir()
    meant, _ = loaded(written(tmp_path / "meant", four_bar(repr(-np.pi / 2), repr(np.pi / 2))))
    machine, _ = loaded(written(tmp_path, four_bar("-1.5708", "1.57079")))
    one, two = Reactions(meant), Reactions(machine)
    known = one.statically_determined(meant.home)
    assert not known.all() and (known == two.statically_determined(machine.home)).all()
    wanted, found = one.joint_wrenches(meant.home), two.joint_wrenches(machine.home)
    assert np.allclose(found, wanted, atol=1e-4 * np.abs(wanted).max())
    q_a = machine.home[machine.closure.active]
    assert np.allclose(two.drive_forces(machine.home), Dynamics(machine).gravity(q_a), rtol=1e-4)


def test_a_dead_centre_determines_nothing(tmp_path):
    """The cylinder's line goes through the beam's pivot."""
    beam = load(tmp_path, BEAM, active=["stroke"])
    way = np.array([-0.6, 1]) / np.hypot(0.6, 1)
    dead = {"pivot": np.arctan2(-way[1], way[0]), "foot": np.arctan2(*way)}
    dead["stroke"] = np.hypot(0.6, 1) + 1
    q = np.array([dead[name] for name in beam.joints])
    assert beam.closure.residual(q) < 1e-12
    with pytest.raises(SingularConfigurationError, match="stroke"):
        Reactions(beam).joint_wrenches(q)


def test_what_cannot_be_is_told_in_one_line(mini):
    reactions = Reactions(mini)
    q = mini.home
    for call, words in (
        (lambda: reactions.joint_wrenches(q[:3]), "q has the shape"),
        (lambda: reactions.joint_wrenches(q, np.zeros((2, len(q)))), "v has 2 samples and q 1"),
        (
            lambda: reactions.joint_wrenches(q, wrenches={"hook": np.zeros(6)}),
            "frame 'hook' is unknown",
        ),
        (
            lambda: reactions.joint_wrenches(q, wrenches={mini.tip: np.zeros((3, 6))}),
            "has 3 samples and q",
        ),
        (lambda: reactions.unit_load_wrenches(q, "hook"), "frame 'hook' is unknown"),
        (lambda: reactions.joint_wrenches(np.zeros((0, len(q)))), "empty stack"),
        (lambda: Reactions("mini_forwarder"), "load it with crane.load"),
    ):
        with pytest.raises(InputError, match=words):
            call()
