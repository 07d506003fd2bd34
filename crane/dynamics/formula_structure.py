"""Constants and structure of the dynamics formulas of a machine, and the two formulations."""

from dataclasses import dataclass

import numpy as np

from crane.closure.kinematics_formulas import TreeGeometry
from crane.codegen import Layout
from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array
from crane.dynamics.cluster_recursion import RecursionPlan, plan_recursion
from crane.dynamics.frame_jacobians import frame_placement
from crane.dynamics.joint_forces import PARAMETER_COUNT, SLIP_INDEX, JointForces
from crane.machine.machine import Machine

BODY_SIZE = 10  # inertia constants of a body
DISTANCE_SIZE = PARAMETER_COUNT + 6  # constants of a distance: law, attachment points
_UPPER_TRIANGLE = np.triu_indices(3)
FORMULATIONS = ("exact", "decoupled")


def motion_parents(machine: Machine, formulation: str) -> tuple[int, ...]:
    """The body whose motion each body shares.

    "exact": the parent in the tree. "decoupled": the same within a sub-chain, but every sub-chain
    stands on a base held still at its current pose, equations (16) to (21) of the reduced-scale
    forwarder paper; the forces of a chain on the chain that carries it are left out.

    Args:
        machine: The machine.
        formulation: One of `FORMULATIONS`.

    Returns:
        (nv + 1,) indices in the numbering of `Coordinates.parents`; 0 for the world, which is at
        rest.

    Raises:
        InputError: Unknown formulation.
    """
    if formulation not in FORMULATIONS:
        raise InputError(
            f"formulation '{formulation}' is unknown, {suggest_names(FORMULATIONS, formulation)}"
        )
    parents = machine.coordinates.parents
    if formulation == "exact":
        return parents
    chain = {joint: chain.name for chain in machine.chains for joint in chain.joints}
    names = [None, *(chain[joint] for joint in machine.joints)]
    return tuple(p if names[p] == names[i] else 0 for i, p in enumerate(parents))


def dynamics_constants(
    machine: Machine, geometry: TreeGeometry, forces: JointForces, least_inertias: Array
) -> Array:
    """Inertias, force laws and gravity, see `FormulaStructure.constants_layout`.

    Per body mass, COM (3), inertia about it (xx, xy, xz, yy, yz, zz) in the axes of the geometry;
    per joint the 22 values of `JointForces.table`; gravity (3); per joint its rotor inertia; per
    distance its 22 values and the attachment points on its two bodies; the moving factor; circuit
    friction of joints (`JointForces.circuit_friction`); mass and first moment of the fixed bodies
    (4); the tip point on its body, if there is a tip; per joint the inertia that counts as none
    (`Machine.least_inertias`).
    """
    bodies = []
    for i, joint in enumerate(machine.coordinates.joints, start=1):
        if i in geometry.massless_bodies:
            bodies.append([0.0] * BODY_SIZE)
            continue
        turn, inertia = geometry.body_rotations[i], machine.model.inertias[int(joint)]
        bodies.append(
            [
                inertia.mass,
                *(turn.T @ inertia.lever),
                *(turn.T @ inertia.inertia @ turn)[_UPPER_TRIANGLE],
            ]
        )
    joint_laws, distance_laws = np.split(forces.table, [len(bodies)])
    numbers = [
        np.ravel(bodies),
        np.ravel(joint_laws),
        machine.model.gravity.linear,
        machine.model.armature,
    ]
    for law, ends in zip(distance_laws, forces.lengths.end_points, strict=True):
        turns = (
            geometry.body_rotations[machine.coordinates.body_of_joint[joint]] for joint, _ in ends
        )
        numbers += [law, *(turn.T @ place for turn, (_, place) in zip(turns, ends, strict=True))]
    numbers += [
        [forces.moving_factor],
        forces.circuit_friction[list(forces.circuit_friction_columns)],
    ]
    fixed_inertia = machine.model.inertias[0]
    numbers += [[fixed_inertia.mass], fixed_inertia.mass * fixed_inertia.lever]
    if machine.tip is not None:
        joint, placement = frame_placement(machine, machine.tip)
        turn = geometry.body_rotations[machine.coordinates.body_of_joint[joint]]
        numbers.append(turn.T @ placement.translation)
    return np.concatenate([*numbers, least_inertias])


@dataclass(frozen=True)
class FormulaStructure:
    """What the formulas of a machine depend on besides its loops and constants.

    Attributes:
        motion_parents: See `motion_parents`.
        recursion_plan: How forward dynamics reduces the machine's clusters; see
            `crane.dynamics.cluster_recursion`.
        distance_bodies: Bodies of the two ends of each distance of `JointForces.lengths`; 0 is the
            world.
        stick_slip_columns: Columns of the joints with stick-slip friction.
        circuit_friction_columns: Columns of the joints with circuit friction.
        tip_body: Body of the tip, if there is one.
        held: See `Machine.held`.
    """

    motion_parents: tuple[int, ...]
    recursion_plan: RecursionPlan
    distance_bodies: tuple[tuple[int, int], ...]
    stick_slip_columns: tuple[int, ...]
    circuit_friction_columns: tuple[int, ...]
    tip_body: int | None
    held: tuple[int, ...]

    @classmethod
    def from_machine(
        cls, machine: Machine, formulation: str, forces: JointForces
    ) -> "FormulaStructure":
        """The formula structure of a machine.

        Raises:
            InputError: Unknown formulation.
        """
        bodies = machine.coordinates.body_of_joint
        spans = ((bodies[one], bodies[two]) for (one, _), (two, _) in forces.lengths.end_points)
        plan = plan_recursion(machine) if formulation == "exact" else ()
        tip = None if machine.tip is None else bodies[frame_placement(machine, machine.tip)[0]]
        return cls(
            motion_parents(machine, formulation),
            plan,
            tuple(spans),
            forces.stick_slip_columns,
            forces.circuit_friction_columns,
            tip,
            machine.held,
        )

    @property
    def constants_layout(self) -> Layout:
        """Layout of `dynamics_constants`."""
        bodies, distances = len(self.motion_parents) - 1, len(self.distance_bodies)
        return Layout(
            inertias=BODY_SIZE * bodies, joint_laws=PARAMETER_COUNT * bodies, gravity=3,
            rotor_inertias=bodies, distances=DISTANCE_SIZE * distances, moving_factor=1,
            circuit_friction=len(self.circuit_friction_columns), fixed_inertia=4,
            tip_point=0 if self.tip_body is None else 3, least_inertias=bodies,
        )  # fmt: skip

    @property
    def stick_slip_mode_indices(self) -> list[int]:
        """Indices in `dynamics_constants` of the values of `JointForces.set_stick_slip_modes`."""
        layout = self.constants_layout
        first = layout.start_index("joint_laws") + SLIP_INDEX
        modes = [
            first + PARAMETER_COUNT * i + k for i in self.stick_slip_columns for k in range(3)
        ]
        return [*modes, layout.start_index("moving_factor")]

    @property
    def tip_inertia(self) -> range:
        """Indices in `dynamics_constants` of the inertia of the tip's body; none on the world."""
        if not self.tip_body:
            return range(0)
        start = self.constants_layout.start_index("inertias") + BODY_SIZE * (self.tip_body - 1)
        return range(start, start + BODY_SIZE)
