"""Test machines in several formats, random states of them, and copies written in other formats."""

import warnings
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from broken_machines import DATA

import crane
from crane.common.errors import CraneWarning
from crane.formats import write_machine, write_mjcf, write_urdf_plus

MACHINES = {  # file, degrees of freedom, how far the tests go from home [m], [rad]
    "four_bar": ("four_bar_loop.urdf", 1, 0.3),
    "five_bar": ("five_bar.urdf", 2, 0.3),
    "six_bar": ("six_bar.urdf", 1, 0.3),
    "planar_leg": ("planar_leg.urdf", 2, 0.12),
    "delta": ("delta", 3, 0.3),
    "stewart": ("stewart.xml", 6, 0.05),
    "sarrus": ("sarrus.urdf", 1, 0.2),
}
NEEDS_MUJOCO = {"stewart"}
LARGE = {"delta", "stewart"}


@cache
def load(name):
    return crane.load(DATA / MACHINES[name][0])


def loaded(name):
    if name in NEEDS_MUJOCO:
        pytest.importorskip("mujoco")
    return load(name)


@cache
def dynamics_of(name):
    """Formulas of the two machines with one large block take seconds to compile."""
    return crane.Dynamics(load(name), backend="pinocchio" if name in LARGE else "compiled")


def postures(machine, reach, count, seed=0):
    """Active coordinates about home, velocities and forces."""
    random = np.random.default_rng(seed)
    n = len(machine.active)
    for _ in range(count):
        q_a = machine.home[machine.closure.active] + random.uniform(-reach, reach, n)
        yield q_a, *random.normal(size=(2, n))


def multipliers(machine, q, v, tau):
    """Accelerations (nv,) of the tree with multipliers: points of both frames stay together.

    The equations are written anew from Pinocchio's frame Jacobians, and solved by least squares
    because some say the same.
    """
    model = machine.model.copy()
    equations = machine.closure.equations
    pairs = []
    for loop in equations.loops:
        axis = np.array(loop.axis)
        points = {
            "spherical": [np.zeros(3)],
            "revolute": [np.zeros(3), 0.2 * axis],
            "fixed": [np.zeros(3), np.array([0.2, 0, 0]), np.array([0, 0.2, 0])],
        }[loop.type]
        for i, point in enumerate(points):
            ends = []
            for link in (loop.predecessor, loop.successor):
                frame = machine.model.frames[machine.frame(link)]
                place = frame.placement * pin.SE3(np.eye(3), point)
                name = f"{loop.name} {i} {link}"
                parent = frame.parentJoint
                ends.append(
                    model.addFrame(pin.Frame(name, parent, 0, place, pin.FrameType.OP_FRAME))
                )
            pairs.append(ends)
    data = model.createData()
    at = machine.coordinates.configuration(q)
    pin.computeJointJacobians(model, data, at)
    pin.forwardKinematics(model, data, at, v, np.zeros(model.nv))
    pin.updateFramePlacements(model, data)
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    rows, biases = [], []
    for ends in pairs:
        jacobians = [pin.getFrameJacobian(model, data, end, world)[:3] for end in ends]
        drifts = [pin.getFrameClassicalAcceleration(model, data, end, world) for end in ends]
        rows.append(jacobians[1] - jacobians[0])
        biases.append(drifts[1].linear - drifts[0].linear)
    for coupling in equations.couplings:
        row = np.zeros((1, model.nv))
        for joint, factor in coupling.factors.items():
            row[0, machine.column(joint)] = factor
        rows.append(row)
        biases.append(np.zeros(1))
    jacobian, bias = np.vstack(rows), np.concatenate(biases)
    mass = pin.crba(model, data, at)
    mass = np.triu(mass) + np.triu(mass, 1).T
    rest = tau - pin.nonLinearEffects(model, data, at, v)
    whole = np.block([[mass, jacobian.T], [jacobian, np.zeros((len(bias),) * 2)]])
    solution = np.linalg.lstsq(whole, np.concatenate([rest, -bias]), rcond=1e-12)[0]
    return solution[: model.nv]


WRITERS = {
    "urdf+": lambda machine, folder: write_urdf_plus(machine, folder / "written.urdf"),
    "mjcf": lambda machine, folder: write_mjcf(machine, folder / "written.xml"),
    "machine": lambda machine, folder: write_machine(machine, folder),
}


def rewritten(machine, kind, folder):
    if kind == "mjcf":
        pytest.importorskip("mujoco")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        WRITERS[kind](machine, folder)
        return crane.load(next(x for x in folder.iterdir() if x.suffix in (".xml", ".yaml")
                               or x.name == "written.urdf"))  # fmt: skip


def assert_same(one, two, reach, forces=True):
    """The same dynamics to 1e-12, at random postures."""
    assert one.active == two.active
    assert set(one.joints) == set(two.joints)
    columns = [two.column(joint) for joint in one.joints]
    np.testing.assert_allclose(two.home[columns], one.home, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(one.lower, two.lower)
    np.testing.assert_array_equal(one.upper, two.upper)
    links = [f.name for f in one.model.frames if f.type == pin.FrameType.BODY]
    shared = [link for link in links if two.model.existFrame(link, pin.FrameType.BODY)]
    moved = {one.model.frames[one.frame(link)].parentJoint for link in shared}
    massive = {i for i in range(1, one.model.njoints) if one.model.inertias[i].mass > 0}
    assert massive <= moved
    places = []
    for machine in (one, two):
        data = machine.model.createData()
        pin.framesForwardKinematics(
            machine.model, data, machine.coordinates.configuration(machine.home)
        )
        places.append([data.oMf[machine.frame(link)].homogeneous for link in shared])
    np.testing.assert_allclose(places[1], places[0], rtol=0, atol=1e-11)
    if not forces:
        one, two = (x.replace(forces=(), gas_springs=(), end_stops=()) for x in (one, two))
    both = [crane.Dynamics(machine, backend="pinocchio") for machine in (one, two)]
    for q_a, v_a, a_a in postures(one, reach, 4):
        q_a = np.clip(q_a, one.lower, one.upper)
        for quantity in (
            lambda d, q_a=q_a: d.mass_matrix(q_a),
            lambda d, q_a=q_a, v_a=v_a: d.bias(q_a, v_a),
            lambda d, q_a=q_a, v_a=v_a, a_a=a_a: d.inverse(q_a, v_a, a_a),
        ):
            expected, found = (quantity(dynamics) for dynamics in both)
            np.testing.assert_allclose(
                found, expected, rtol=0, atol=1e-12 * np.abs(expected).max()
            )
