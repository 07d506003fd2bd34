"""Exact accelerations of a closed machine from MuJoCo's mass matrix, forces and constraints.

MuJoCo's own constraints are soft, so its accelerations are not those of closed loops. What it
computes with is exact: M, bias, passive forces and the Jacobian J of its equality constraints at a
posture. With them, and dJ/dt by differences along the motion, the accelerations solve

    M a + bias - passive = force + J^T lambda,    J a + (dJ/dt) v = 0.
"""

import mujoco
import numpy as np

_STEP = 2e-3  # [s] of the differences, whose error goes with its sixth power


class Oracle:
    """A file as MuJoCo has it.

    Args:
        path: The file.
        machine: The same, loaded.
    """

    def __init__(self, path, machine):
        self.model = model = mujoco.MjModel.from_xml_path(str(path))
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self.data, self.machine = mujoco.MjData(model), machine
        for i in range(model.neq):  # what a program moves is no part of a machine
            of_bodies = model.eq_type[i] < 2 and model.eq_objtype[i] == mujoco.mjtObj.mjOBJ_BODY
            if of_bodies and model.body_mocapid[model.eq_obj1id[i]] >= 0:
                self.data.eq_active[i] = 0
        self.names = [model.joint(i).name or f"joint{i + 1}" for i in range(model.njnt)]

    def _turns(self, name):
        return [self.machine.column(f"{name}_r{axis}") for axis in "xyz"]

    def _floats(self, name):
        """Columns of a free joint that is one free-flyer here, None of others."""
        names, floating = self.machine.joints, self.machine.coordinates.floating_base_columns
        first = names.index(f"{name}_x") if f"{name}_x" in names else -1
        return np.arange(first, first + 6) if first in floating else None

    def _turned(self, q, columns):
        """Rotation (3, 3) and quaternion of a rotation vector."""
        turn = np.zeros(9)
        quaternion = np.zeros(4)
        length = np.linalg.norm(q[columns])
        mujoco.mju_axisAngle2Quat(quaternion, q[columns] / max(length, 1e-300), length)
        mujoco.mju_quat2Mat(turn, quaternion)
        return turn.reshape(3, 3), quaternion

    def place(self, q, v):
        """Put MuJoCo into a closed posture (nq,) in motion (nv,)."""
        model, data = self.model, self.data
        for joint, name in enumerate(self.names):
            at, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
            if model.jnt_type[joint] >= 2:
                data.qpos[at], data.qvel[dof] = (x[self.machine.column(name)] for x in (q, v))
                continue
            if (fly := self._floats(name)) is not None:
                turn, data.qpos[at + 3 : at + 7] = self._turned(q, fly[3:])
                data.qpos[at : at + 3] = q[fly[:3]]
                data.qvel[dof : dof + 6] = *(turn @ v[fly[:3]]), *v[fly[3:]]
                continue
            if model.jnt_type[joint] == 0:
                slides = [self.machine.column(f"{name}_{axis}") for axis in "xyz"]
                data.qpos[at : at + 3], data.qvel[dof : dof + 3] = q[slides], v[slides]
                at, dof = at + 3, dof + 3
            turns = self._turns(name)
            data.qpos[at : at + 4] = self._turned(q, turns)[1]
            data.qvel[dof : dof + 3] = v[turns]
        mujoco.mj_forward(model, data)

    def motion(self, q, v, a):
        """Accelerations (nv,) of the tree as MuJoCo has them."""
        model, out = self.model, np.zeros(self.model.nv)
        for joint, name in enumerate(self.names):
            dof = model.jnt_dofadr[joint]
            if model.jnt_type[joint] >= 2:
                out[dof] = a[self.machine.column(name)]
                continue
            if (fly := self._floats(name)) is not None:
                turn, spin = self._turned(q, fly[3:])[0], v[fly[3:]]
                out[dof : dof + 3] = turn @ (a[fly[:3]] + np.cross(spin, v[fly[:3]]))
                out[dof + 3 : dof + 6] = a[fly[3:]]
                continue
            if model.jnt_type[joint] == 0:
                out[dof : dof + 3] = [a[self.machine.column(f"{name}_{x}")] for x in "xyz"]
                dof += 3
            out[dof : dof + 3] = a[self._turns(name)]
        return out

    def forces(self, q, along):
        """Forces (nv,) along the tree's coordinates as MuJoCo has them."""
        model, out = self.model, np.zeros(self.model.nv)
        for joint, name in enumerate(self.names):
            dof = model.jnt_dofadr[joint]
            if model.jnt_type[joint] >= 2:
                out[dof] = along[self.machine.column(name)]
                continue
            if (fly := self._floats(name)) is not None:
                turn = self._turned(q, fly[3:])[0]
                out[dof : dof + 6] = *(turn @ along[fly[:3]]), *along[fly[3:]]
                continue
            if model.jnt_type[joint] == 0:
                out[dof : dof + 3] = [along[self.machine.column(f"{name}_{x}")] for x in "xyz"]
                dof += 3
            out[dof : dof + 3] = along[self._turns(name)]
        return out

    def _jacobian(self):
        data = self.data
        equal = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        return data.efc_J.reshape(data.nefc, self.model.nv)[equal].copy(), data.efc_pos[equal]

    @property
    def gap(self):
        """The largest violation of a constraint."""
        return float(np.abs(self._jacobian()[1]).max(initial=0.0))

    def _drift(self):
        """(dJ/dt) v by central differences of sixth order."""
        model, data, v = self.model, self.data, self.data.qvel.copy()
        qpos, total = data.qpos.copy(), 0.0
        for count, weight in ((1, 45.0), (2, -9.0), (3, 1.0)):
            for sign in (1, -1):
                data.qpos[:] = qpos
                mujoco.mj_integratePos(model, data.qpos, v, sign * count * _STEP)
                mujoco.mj_forward(model, data)
                total = total + sign * weight / (60 * _STEP) * (self._jacobian()[0] @ v)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        return total

    def _rest(self):
        data, model = self.data, self.model
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        return mass, data.qfrc_passive - data.qfrc_bias

    def accelerations(self, force):
        """(nv,) under forces (nv,), at the posture and motion of `place`."""
        drift, (jacobian, _) = self._drift(), self._jacobian()
        mass, rest = self._rest()
        rows = len(jacobian)
        whole = np.block([[mass, jacobian.T], [jacobian, np.zeros((rows, rows))]])
        right = np.concatenate([rest + force, -np.broadcast_to(drift, rows)])
        return np.linalg.lstsq(whole, right, rcond=1e-13)[0][: self.model.nv]

    def unbalanced(self, force):
        """What of the forces at rest no constraint carries (nv,)."""
        jacobian, _ = self._jacobian()
        left = force + self._rest()[1]
        return left - jacobian.T @ np.linalg.lstsq(jacobian.T, left, rcond=1e-12)[0]
