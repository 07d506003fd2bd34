"""`Machine`: the immutable result of assembling and closing a description."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from crane.closure.closure import Closure
from crane.closure.coordinates import Coordinates
from crane.closure.loop_equations import frame_id
from crane.common.errors import InputError, LimitError, suggest_names
from crane.common.one_line_repr import OneLineRepr, format_count
from crane.common.package_search import LoadOptions
from crane.common.samples import Array, as_samples, read_only_copy
from crane.description.external_forces import ExternalForce, PhasedWrench
from crane.description.force_elements import EndStop, ForceElement, Friction, GasSpring, Rope
from crane.description.machine_lookup import (
    CHANGES_SEPARATOR,
    bundled_machines,
    command_line_arguments,
    example_robots,
)
from crane.description.pinocchio_conversion import add_rigid_load
from crane.description.sensors import Sensor
from crane.description.specification import Drive, EstimationSettings, MachineParts
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.machine.machine_checks import check_force_elements, check_limited
from crane.machine.massless_motions import (
    find_idle_motions,
    least_inertias,
    select_held_coordinates,
)
from crane.machine.payload import Payload

_LIMIT_TOLERANCE = 1e-9  # scaled distance beyond a limit that counts as on it


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Machine(OneLineRepr, MachineParts):
    """A machine with closed kinematic chains, assembled and closed.

    Attributes:
        name: Its name.
        source: Source of its parameters.
        path: The machine file or URDF that it was read from.
        chains: Its open sub-chains.
        tree: Its links and joints, all sub-chains connected.
        model: Pinocchio's model of the tree, depth-first; for nq and nv see `coordinates`.
        closure: Its loops.
        active: Names of the active joints, in the order of q_A.
        lower: (n,) lower limits of the active joints [m], [rad].
        upper: (n,) upper limits of the active joints [m], [rad].
        friction: Friction by joint.
        forces: Passive force elements.
        gas_springs: Gas springs along joints, at most one per joint, and between frames.
        ropes: Ropes between frames.
        end_stops: End stops.
        tip: Name of the tip frame.
        tasks: Reference trajectories by name.
        control: PI gains by active joint.
        hydraulics: Hydraulic circuit, None for a machine without.
        estimation: Unknowns and priors of `identify`.
        sensors: Sensor data by quantity, see `crane.description.sensors`.
        free: Active joints without drive: only friction, springs and stops act on them.
        external_forces: External forces.
        supports: Links that stand on the ground; empty if its contacts do.
        start: How runs start: "equilibrium", "home", or "" for the default.
        pin_capacities: Largest force that pins bear, by joint or loop [N].
        explicit_drives: Drives of the file (actuators of a MJCF), or all drives where they are
            redundant; empty where `drives` are the active joints.
        parameter_changes: Parameters that differ from its files, by name.
        locked_joints: Coordinates of joints that were locked, by name [m], [rad].
        chosen_joints: Active and free joints that differ from its file, under "active" and "free".
        floating_base: Whether its root was made a floating base, or with which degrees of freedom.
        packages: Folders in which packages were searched for.
        arguments: Values of its file's arguments.
        trusts_xacro: Whether its xacro files may run Python and read all files.
        written_numbers: Numbers of its machine file with their units, by the keys to them.
    """

    model: pin.Model
    closure: Closure
    active: tuple[str, ...]
    lower: Array
    upper: Array
    explicit_drives: tuple[Drive, ...]
    parameter_changes: Mapping[str, float]
    locked_joints: Mapping[str, float]
    chosen_joints: Mapping[str, tuple[str, ...]]
    floating_base: bool | tuple[str, ...]
    packages: tuple[str, ...]
    arguments: Mapping[str, str]
    trusts_xacro: bool

    def _one_line(self) -> str:
        words = [
            repr(self.name),
            format_count(len(self.active), "degree of freedom", "degrees of freedom"),
            format_count(len(self.joints), "joint"),
            format_count(len(self.closure.equations.loops), "loop"),
            *["hydraulic"] * bool(self.hydraulics), *[f"{len(self.free)} free"] * bool(self.free),
        ]  # fmt: skip
        return f"Machine({', '.join(words)})"

    @property
    def home(self) -> Array:
        """(nv,) closed home configuration."""
        return self.closure.home

    @property
    def gravity(self) -> tuple[float, ...]:
        """(3,) acceleration of gravity in the axes of the world [m/s2]."""
        return tuple(self.model.gravity.linear.tolist())

    @property
    def up_direction(self) -> Array:
        """Unit vector (3,) against gravity; z without gravity."""
        length = float(np.linalg.norm(self.gravity))
        return -np.array(self.gravity) / length if length else np.array([0.0, 0.0, 1.0])

    @property
    def has_traceable_forces(self) -> bool:
        """Whether all external forces can be compiled."""
        return all(force.is_traceable for force in self.external_forces)

    @property
    def undriven_joints(self) -> tuple[str, ...]:
        """Active joints that are not free and for which no drive is specified.

        A joint has a drive if its URDF `<limit>` has an `effort` above 0, or if it has a cylinder,
        gains under `control`, or a motor in the file. Others are active only because of the
        mobility of the machine, for example a swinging grapple; they should be listed under
        `free`.
        """
        driven = {
            *self.free, *self.chosen_joints.get("active", ()), *self.control,
            *(self.hydraulics.joints if self.hydraulics else ()),
        }  # fmt: skip
        driven |= {joint for motor in self.explicit_drives for joint in motor.factors}
        efforts = zip(self.active, self.model.effortLimit[self.closure.active], strict=True)
        return tuple(x for x, effort in efforts if x not in driven and not 0 < effort < np.inf)

    @cached_property
    def drives(self) -> tuple[Drive, ...]:
        """The drives of the machine: those of the file, or one along each driven active joint."""
        return self.explicit_drives or tuple(Drive(x, {x: 1.0}) for x in self.driven_joints)

    @property
    def driven_joints(self) -> tuple[str, ...]:
        """Active joints that are not free."""
        return tuple(joint for joint in self.active if joint not in self.free)

    @cached_property
    def is_driven(self) -> NDArray[np.bool_]:
        """(n,) whether each active joint is driven, that is not free."""
        return np.array([joint not in self.free for joint in self.active])

    def expand_driven(self, x: ArrayLike, label: str) -> Array:
        """Expand values of the k driven joints, (k,) or (N, k), by zeros to (n,) or (N, n).

        Raises:
            InputError: Wrong shape or not finite.
        """
        given = as_samples(x, len(self.driven_joints), label, self.driven_joints)
        out = np.zeros((*given.shape[:-1], len(self.active)))
        out[..., self.is_driven] = given
        return out

    @cached_property
    def load_name(self) -> str:
        """Argument of `crane.load` for this machine: the bundled name, or the path."""
        known_as, bundle = self.path.stem, bundled_machines()
        named = bundle if known_as in bundle else example_robots()
        return known_as if named.get(known_as) == self.path else str(self.path)

    @property
    def load_options(self) -> dict[str, Any]:
        """Further arguments of `crane.load` for this machine, by name."""
        given = {
            "changes": dict(self.parameter_changes), "lock": dict(self.locked_joints),
            "floating": self.floating_base, "packages": self.packages,
            "arguments": dict(self.arguments),
        }  # fmt: skip
        return {name: x for name, x in (given | dict(self.chosen_joints)).items() if x}

    @property
    def load_expression(self) -> str:
        """Text from which this machine can be loaded again, without trust in its xacro files.

        For example 'patu655 with {"changes": {"payload.mass": 200.0}, "lock": {"slew": 0.0}}'.
        """
        options = self.load_options
        return self.load_name + (CHANGES_SEPARATOR + json.dumps(options) if options else "")

    @property
    def command_line_arguments(self) -> str:
        """Command line arguments that load this machine again, quoted for a shell."""
        is_floating, trust = bool(self.floating_base), self.trusts_xacro
        options = LoadOptions(self.packages, self.arguments, is_floating, trust_xacro=trust)
        active, free = map(self.chosen_joints.get, ("active", "free"))
        changed = self.parameter_changes, self.locked_joints
        return command_line_arguments(self.load_name, active, free, *changed, options)

    @property
    def coordinates(self) -> Coordinates:
        """Coordinates of the tree, and their conversion to Pinocchio's configurations."""
        return self.closure.equations.coordinates

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of all coordinates of the tree in the order of q, with those of floating bases."""
        return self.coordinates.names

    @cached_property
    def held(self) -> tuple[int, ...]:
        """Indices of active coordinates that are held for idle motions: they keep their speed."""
        return select_held_coordinates(find_idle_motions(self.model, self.closure))

    @cached_property
    def least_inertias(self) -> Array:
        """(nv,) inertia of each joint that counts as none [kg], [kg m2]."""
        return least_inertias(self.model, self.closure)

    def column(self, joint: str) -> int:
        """Index of a joint in q and v.

        Raises:
            InputError: Unknown joint.
        """
        return self.coordinates.column(joint)

    def unit(self, joint: str) -> str:
        """Unit of a joint's coordinate, "m" or "rad"."""
        self.column(joint)
        return "m" if self.tree.joints[joint].kind == "prismatic" else "rad"

    def frame(self, link: str) -> int:
        """Pinocchio's index of a link's frame.

        Raises:
            InputError: Unknown link.
        """
        if not self.model.existFrame(link, pin.FrameType.BODY):
            links = [f.name for f in self.model.frames if f.type == pin.FrameType.BODY]
            raise InputError(f"frame '{link}' is unknown, {suggest_names(links, link)}")
        return frame_id(self.model, link)

    def check_limits(self, q_a: ArrayLike, label: str = "q_a") -> Array:
        """Check that active coordinates (n,) or (N, n) are within the limits, and return them.

        Raises:
            InputError: Wrong shape or not finite.
            LimitError: A coordinate is outside of its limits.
        """
        q_a = as_samples(q_a, len(self.active), label, self.active)
        slack = _LIMIT_TOLERANCE * self.closure.units[self.closure.active]
        outside = (q_a < self.lower - slack) | (q_a > self.upper + slack)
        if outside.any():
            index = tuple(int(i) for i in np.argwhere(outside)[0])
            joint, name = index[-1], self.active[index[-1]]
            sample = f" in sample {index[0]}" if q_a.ndim == 2 else ""
            place = self.tree.joints[name].limits.source_location
            raise LimitError(
                f"{label}: {name} = {q_a[index]:.6g}{sample} is outside of its limits "
                f"{self.lower[joint]:.6g} to {self.upper[joint]:.6g} {self.unit(name)}"
                f"{f' ({place})' if place else ''}, choose one within them"
            )
        return q_a

    def replace(
        self,
        *,
        friction: Mapping[str, Friction] | None = None,
        forces: tuple[ForceElement, ...] | None = None,
        gas_springs: tuple[GasSpring, ...] | None = None,
        ropes: tuple[Rope, ...] | None = None,
        end_stops: tuple[EndStop, ...] | None = None,
        hydraulics: Hydraulics | None = None,
        sensors: Mapping[str, Sensor] | None = None,
        estimation: EstimationSettings | None = None,
    ) -> "Machine":
        """A copy with other friction, force elements, stops, hydraulics, sensors or settings.

        Raises:
            InputError: A joint or frame is unknown or does not fit the element.
        """
        check_force_elements(
            self.closure, [*(forces or ()), *(gas_springs or ()), *(ropes or ())], self.frame
        )
        for joint in friction or {}:
            self.column(joint)
        for stop in end_stops or ():
            check_limited(self.coordinates, stop.joint, " to stop at, give it some")
        for joint in hydraulics.joints if hydraulics else ():
            if joint not in self.active:
                hint = suggest_names(self.active, joint)
                raise InputError(f"'{joint}' has a cylinder and is not active, {hint}")
            check_limited(self.coordinates, joint, ", a cylinder needs those of its stroke")
        changes: dict[str, Any] = {
            "friction": friction, "sensors": sensors, "hydraulics": hydraulics,
            "estimation": estimation, "forces": forces, "gas_springs": gas_springs,
            "ropes": ropes, "end_stops": end_stops,
        }  # fmt: skip
        for name, value in changes.items():
            if isinstance(value, Mapping):
                changes[name] = MappingProxyType(dict(value))
            if isinstance(value, list):
                changes[name] = tuple(value)
        return dataclasses.replace(self, **{k: x for k, x in changes.items() if x is not None})

    def with_active_joints(self, names: Sequence[str]) -> "Machine":
        """A copy with other active joints, for example the angles of its booms.

        Home configuration and branch stay. With the new active coordinates q_B, those of this
        machine q_A, and the rows gamma_A of gamma = dq/dq_B that belong to q_A,

            v_A = gamma_A v_B,    tau_B = gamma_A^T tau_A,

        which are equations (18), (19) of the electro-hydraulic forwarder paper,
        tau_i = F_i dx_i/dq_i, for any choice of joints.

        The circuit keeps the cylinders whose joints are still active. Gains and tasks of active
        joints are dropped unless the joints are the same. `load_name` and `parameter_changes`
        stay: they load the machine with the active joints of its file.

        Args:
            names: As many joints as there are degrees of freedom, in the order of q_B.

        Raises:
            InputError: A joint is unknown or named twice.
            MechanismError: Too few or too many joints, or they do not determine the others.
        """
        names = tuple(names)
        for name in names:
            self.column(name)
            if names.count(name) > 1:
                raise InputError(
                    f"joint '{name}' is named twice among the active ones, once will do"
                )
        return self._with_closure(names, self.home)

    def with_home_configuration(self, q: Array, names: tuple[str, ...]) -> "Machine":
        """`with_active_joints` at another home configuration, which may be on another branch.

        Args:
            q: (nq,) closed configuration, whose full revolutions are kept.
            names: Active joints.

        Raises:
            MechanismError: See `with_active_joints`.
        """
        known = self.closure.with_home_configuration(q) if names == self.active else None
        return self._with_closure(names, q, known, keep_revolutions=True)

    def _with_closure(
        self,
        names: tuple[str, ...],
        home: Array,
        closure: Closure | None = None,
        keep_revolutions: bool = False,
    ) -> "Machine":
        if closure is None:
            equations = self.closure.equations
            arguments = self.model, equations.loops, names, home, equations.couplings
            closure = Closure(*arguments, keep_revolutions=keep_revolutions)
        same = set(names) == set(self.active)
        tasks = {key: x for key, x in self.tasks.items() if same or x.space == "tip"}
        return dataclasses.replace(
            self,
            closure=closure,
            active=names,
            lower=read_only_copy(self.coordinates.lower[closure.active]),
            upper=read_only_copy(self.coordinates.upper[closure.active]),
            tasks=MappingProxyType(tasks),
            control=self.control if same else MappingProxyType({}),
            hydraulics=self.hydraulics and self.hydraulics.select_joints(names),
            free=tuple(name for name in names if name in self.free),
            explicit_drives=(),
        )

    def with_external_forces(self, *forces: ExternalForce) -> "Machine":
        """A copy with additional external forces; the machine itself without any.

        Raises:
            InputError: Not an external force, an unknown or fixed frame, or a name that exists
                already.
        """
        every = (*self.external_forces, *forces)
        for force in forces:
            if not isinstance(force, ExternalForce):
                raise InputError(f"{force!r} is no external force, give a crane.Wrench")
            if not self.model.frames[self.frame(force.frame)].parentJoint:
                raise InputError(f"'{force.frame}' does not move, a load on it does nothing")
            if [other.name for other in every].count(force.name) > 1:
                raise InputError(f"two loads are called '{force.name}', give them names")
        return dataclasses.replace(self, external_forces=every) if forces else self

    def with_phase_function(self, clock: Callable[[Array], Array] | None) -> "Machine":
        """A copy whose phased external forces use the clock of a simulation.

        Args:
            clock: Returns the phase (N,) at times (N,) [s]; None if there are no phases.

        Raises:
            InputError: A phased force without a clock.
        """
        phased = [force for force in self.external_forces if isinstance(force, PhasedWrench)]
        if not phased:
            return self
        if clock is None:
            hint = "simulate it with the task of levers that has them"
            raise InputError(f"the load '{phased[0].name}' counts phases, {hint}")
        every = (x.with_phase_function(clock) if x in phased else x for x in self.external_forces)
        return dataclasses.replace(self, external_forces=tuple(every))

    def with_payload(self, payload: Payload) -> "Machine":
        """A copy that carries a payload.

        Raises:
            InputError: Unknown frame, or infeasible mass and inertia.
        """
        frame = self.model.frames[self.frame(payload.frame)]
        load = payload.rigid_body()
        model = pin.Model(self.model)
        model.appendBodyToJoint(frame.parentJoint, load, frame.placement)
        tree = add_rigid_load(self.tree, payload.frame, load)
        return dataclasses.replace(self, model=model, tree=tree)
