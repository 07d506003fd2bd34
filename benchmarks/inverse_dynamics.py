"""Inverse dynamics over the number of joints: forces of the active joints for closed motions.

    python benchmarks/inverse_dynamics.py MACHINE --rounds 15

No peer has inverse dynamics of loops. Theirs is that of the spanning tree, t = rnea(q, v, a), and
the constraint Jacobian J of its own, which its user projects with:

    J_P' lambda = t_P,   tau_A = t_A - J_A' lambda

with as many independent rows of J as there are passive joints, chosen once. The projection runs in
numpy and LAPACK; on small machines it is most of a peer's time.
"""

import tempfile
from collections.abc import Callable, Sequence
from typing import Any

import forward_dynamics
import numpy as np
import pinocchio as pin
from dense_equations import KinematicRows
from engines.mujoco_engine import MuJoCo, mjcf
from engines.pinocchio_engine import OFFSET, sample_states
from forward_dynamics import MAX_DIFFERENCE, Calls, largest_difference, peer_call, stacks
from multibody import Array, Loop, Multibody
from report import table
from scipy.linalg import qr
from scipy.linalg.lapack import dgesv

import crane

Solver = Callable[[Array, Array, Array, Array], Array]
OWN = ("crane, one call", "crane, a stack", "crane, closed stack")
PEERS = ("pin.rnea", "mj_inverse")
ROW_TOLERANCE = 1e-6  # share of the largest pivot below which a row is redundant


def measure(quick: bool) -> list[dict[str, Any]]:
    """Times of all machines, each in a process of its own."""
    results = []
    for machine in forward_dynamics.machines(quick):
        with tempfile.TemporaryDirectory() as cache:
            found = forward_dynamics.run_process(__file__, machine, 5 if quick else 15, cache)
        results.append({"machine": machine} | found)
        print(f"inverse, {machine}: {found.get('failure', 'done')}", flush=True)
    return results


def tables(results: Sequence[dict[str, Any]]) -> list[str]:
    """Time of a call, and of the first one."""
    head = [
        "machine", "joints", "loops", "degrees of freedom",
        *(f"{name} [us]" for name in (*OWN, *PEERS)), "best peer / one call",
        "best peer / stack", "first call [s]",
    ]  # fmt: skip
    rows = []
    for found in results:
        if "failure" in found:
            rows.append([found["machine"], *["-"] * (len(head) - 2), found["failure"]])
            continue
        times = found["times"]
        best = min((times[name] for name in PEERS if name in times), default=None)
        rows.append([
            found["machine"], *(str(found[key]) for key in ("joints", "loops", "freedoms")),
            *(f"{1e6 * times[name]:.2f}" if name in times else "-" for name in (*OWN, *PEERS)),
            *("-" if best is None else f"{best / times[name]:.1f}" for name in OWN[:2]),
            f"{found['first']:.2f}",
        ])  # fmt: skip
    return [table(head, rows)]


def candidates(system: Multibody, dynamics: crane.Dynamics) -> Calls:
    """Calls over all samples, the number of samples, and differences of all from dense equations.

    Raises:
        RuntimeError: Forces of an engine differ from those of dense equations.
    """
    active = system.machine.closure.active
    few = sample_motions(system, 5)
    own, count = forward_dynamics.timed_samples(
        dynamics.inverse, [tuple(x[active] for x in row) for row in few]
    )
    full = peer_samples(system, few)
    exact = exact_inverse(system)
    expected = [exact(*sample) for sample in full]
    found = {"crane": own}
    samples = forward_dynamics.there_and_back(sample_motions(system, count))
    q, v_a, a_a = stacks(samples, active)
    q_a = np.ascontiguousarray(q[:, active])
    rows = list(zip(q_a, v_a, a_a, strict=True))
    calls = {
        "crane, one call": lambda: [dynamics.inverse(*row) for row in rows],
        "crane, a stack": lambda: dynamics.inverse(q_a, v_a, a_a),
        "crane, closed stack": lambda: dynamics.evaluate_closed("inverse", q, v_a, a_a),
    }
    samples, told = peer_samples(system, samples), {}
    solvers = {"pin.rnea": pinocchio_inverse(system, full[0][0])}
    try:
        solvers["mj_inverse"] = mujoco_inverse(system)
    except (ImportError, ValueError) as error:
        told["mj_inverse failure"] = str(error)
    for name, solver in solvers.items():
        found[name] = [solver(*sample) for sample in full]
        calls[name] = peer_call(solver, samples)
    for name, forces in found.items():
        told[f"{name} difference"] = difference = largest_difference(forces, expected)
        if difference > MAX_DIFFERENCE:
            raise RuntimeError(f"forces of {name} differ by {difference:.0e}")
    return calls, count, told


def sample_motions(system: Multibody, count: int) -> list[tuple[Array, Array, Array]]:
    """Closed configurations, velocities and accelerations (q, v, a) of all joints."""
    closure, random = system.machine.closure, np.random.default_rng(2)
    units = closure.units[closure.active]
    return [
        (q, v, closure.gamma(q) @ (units * random.normal(size=len(units))) + closure.drift(q, v))
        for q, v, _ in sample_states(system, count)
    ]


def peer_samples(system: Multibody, samples: list) -> list:
    """Pinocchio's configurations, velocities, accelerations, and forces of springs and dampers."""
    return [(system.configuration(q), v, a, system.joint_forces(q, v)) for q, v, a in samples]


def exact_inverse(system: Multibody) -> Solver:
    """The forces (n_A,) that with multipliers balance all joints, by dense least squares."""
    model, data, rows = system.model, system.model.createData(), KinematicRows(system)
    selection = np.eye(model.nv)[:, system.machine.closure.active]

    def inverse(q: Array, v: Array, a: Array, passive: Array) -> Array:
        tree = pin.rnea(model, data, q, v, a) - passive
        matrix = np.hstack([selection, rows.jacobian_and_drift(q, v)[0].T])
        return np.linalg.lstsq(matrix, tree, rcond=1e-12)[0][: selection.shape[1]]

    return inverse


class Projection:
    """Forces of the active joints from those of the tree and a constraint Jacobian.

    Args:
        system: The system.
        jacobian: Constraint Jacobian (m, n) at a configuration, from which the rows are chosen.
    """

    def __init__(self, system: Multibody, jacobian: Array):
        self._active = system.machine.closure.active
        self._passive = np.setdiff1d(np.arange(system.model.nv), self._active)
        count = len(self._passive)
        _, triangle, order = qr(jacobian[:, self._passive].T, pivoting=True, mode="economic")
        pivots = np.abs(np.diag(triangle))
        if len(pivots) < count or pivots[count - 1] < ROW_TOLERANCE * pivots[0]:
            raise ValueError("the constraint Jacobian has too few independent rows")
        self._rows = np.sort(order[:count])

    def __call__(self, tree: Array, jacobian: Array) -> Array:
        """Forces (n_A,) from those of the tree (n,) and the Jacobian (m, n)."""
        chosen = jacobian[self._rows]
        multipliers = dgesv(chosen[:, self._passive].T, tree[self._passive])[2]
        return tree[self._active] - multipliers @ chosen[:, self._active]


def pinocchio_inverse(system: Multibody, start: Array) -> Solver:
    """Pinocchio's recursive Newton-Euler algorithm and Jacobian of its point anchors."""
    if len(system.couplings):
        return coupled_inverse(system)
    try:
        return anchored_inverse(system, start, 1)
    except ValueError:  # the loops turn in space
        return anchored_inverse(system, start, 2)


def anchored_inverse(system: Multibody, start: Array, points: int) -> Solver:
    """Inverse dynamics with coincident points on the axis of each loop.

    Raises:
        ValueError: So few points do not determine the passive joints.
    """
    model, data = system.model, system.model.createData()
    models, datas = pin.StdVec_ConstraintModel(), pin.StdVec_ConstraintData()
    for loop in system.loops:
        for offset in np.arange(1 if loop.axis is None else points) * OFFSET:
            models.append(pin.ConstraintModel(point_anchor(model, loop, offset)))
    for constraint in models:
        datas.append(constraint.createData())
    pairs = list(zip(models, datas, strict=True))

    def jacobian(q: Array) -> Array:
        pin.computeJointJacobians(model, data, q)
        for constraint, constraint_data in pairs:
            constraint.calc(model, data, constraint_data)
        return pin.getConstraintsJacobian(model, data, models, datas)

    project = Projection(system, jacobian(start))

    def inverse(q: Array, v: Array, a: Array, passive: Array) -> Array:
        return project(pin.rnea(model, data, q, v, a) - passive, jacobian(q))

    return inverse


def coupled_inverse(system: Multibody) -> Solver:
    """Couplings without loops: tau_A = G' t with constant G.

    Raises:
        ValueError: There are loops as well.
    """
    if system.loops:
        raise ValueError("couplings and loops")
    model, data = system.model, system.model.createData()
    gamma = system.machine.closure.gamma(system.q)

    def inverse(q: Array, v: Array, a: Array, passive: Array) -> Array:
        return (pin.rnea(model, data, q, v, a) - passive) @ gamma

    return inverse


def point_anchor(model: pin.Model, loop: Loop, offset: float) -> pin.PointAnchorConstraintModel:
    """Two coincident points on the axis of a loop."""
    shift = pin.SE3(np.eye(3), offset * (np.zeros(3) if loop.axis is None else loop.axis))
    ends: list[Any] = []
    for mount in (loop.predecessor, loop.successor):
        ends += [mount.body + 1, pin.SE3(mount.placement) * shift]
    return pin.PointAnchorConstraintModel(model, *ends)


def mujoco_inverse(system: Multibody) -> Solver:
    """MuJoCo's mj_inverse, projected with the Jacobian of its connections.

    Raises:
        ImportError: MuJoCo is not installed.
        ValueError: The system has balls or couplings.
    """
    if not MuJoCo.version():
        raise ImportError("mujoco is not installed")
    import mujoco

    model: Any = mujoco.MjModel.from_xml_string(mjcf(system, "Euler", 1e-3, 2e-3, 0.9))
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data: Any = mujoco.MjData(model)
    n = model.nv

    def solve(q: Array, v: Array, a: Array) -> tuple[Array, Array]:
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(model, data)
        return data.qfrc_inverse, data.efc_J.reshape(-1, n)

    project = Projection(system, solve(system.q, system.v, system.v)[1])

    def inverse(q: Array, v: Array, a: Array, _passive: Array) -> Array:
        return project(*solve(q, v, a))

    return inverse


if __name__ == "__main__":
    forward_dynamics.main("inverse", candidates)
