"""Load machines: read a description, assemble it and close its loops."""

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import fields
from pathlib import Path
from types import MappingProxyType
from typing import Any
from weakref import WeakKeyDictionary

import pinocchio as pin

from crane.closure.closure import Closure
from crane.closure.constraint_structure import OpenLoopError
from crane.common.errors import (
    DescriptionError,
    InputError,
    ignore_warnings,
    summarize_warnings,
)
from crane.common.package_search import (
    check_argument_values,
    check_package_folders,
    load_options,
    use_load_options,
)
from crane.common.samples import as_sample, read_only_copy
from crane.description.machine_lookup import CHANGES_SEPARATOR, find_machine_file
from crane.description.machine_parameters import GRAVITY_PREFIX, parameters
from crane.description.parameter_changes import (
    apply_parameter_changes,
    changes_in_si,
    lock_joints,
    locks_in_si,
    set_active_joints,
)
from crane.description.rotation_vectors import add_floating_base, check_freedoms
from crane.description.specification import Coupling, LoopSpec, MachineSpec
from crane.formats.assembly_warnings import (
    add_remedy,
    check_home,
    warn_about_assembly_modes,
    warn_about_limits,
)
from crane.formats.machine_file.machine_reader import read_machine_spec
from crane.machine.drive_selection import select_free_joints, select_motors
from crane.machine.machine import Machine
from crane.machine.machine_assembly import assemble_tree, build_closure, home_initial_guess
from crane.machine.machine_checks import (
    check_frame_elements,
    check_masses,
    replace_infeasible_inertias,
)


def load(
    name: str | Path,
    changes: Mapping[str, float | str] | None = None,
    lock: Mapping[str, float | str] | None = None,
    active: Sequence[str] | None = None,
    free: Sequence[str] | None = None,
    floating: bool | Sequence[str] = False,
    packages: Sequence[str | Path] = (),
    arguments: Mapping[str, object] | None = None,
    strict: bool = False,
    trust_xacro: bool = False,
    gravity: Sequence[float] | None = None,
) -> Machine:
    """Load a machine, optionally with changed parameters or locked joints.

    Args:
        name: Name of a bundled machine or of a robot of example-robot-data, or path of a machine
            file (.yaml), URDF (.urdf, .xacro, with `<loop>` elements for loops), SDF (.sdf,
            .world) or MJCF (.xml).
        changes: New values by the names of `crane.description.parameters`, such as
            {"link3_G.x": 0.1, "link7.mass": 0.25, "payload.mass": "0.1 t"}; SI units, or texts
            with other ones.
        lock: Coordinates [m], [rad] of joints to be fixed, by name; or texts with other units.
        active: Active joints in the order of q_A, if not those of the file. If there are more than
            degrees of freedom, all of them are drives, see `Dynamics.drive_forces`.
        free: Free joints, which nothing drives, if not those of the file. Degrees of freedom
            without an active joint are free anyway, with a warning.
        floating: Whether the root floats instead of being fixed to the ground: a vehicle, a
            humanoid. Its six joints, base_x to base_rz, are free, see
            `crane.description.rotation_vectors`. For some of these freedoms give their names, such
            as ("z", "ry") for heave and pitch.
        packages: Folders of the packages that files name by `package://`, `model://` and
            `$(find ...)`, or folders that contain such packages, see
            `crane.common.package_search`.
        arguments: Values of the arguments of a xacro file; `model` of an SDF with several models;
            `urdf_constraint`, true to read the proposed `<constraint>` elements of a URDF as
            loops, see `crane.formats.urdf.loop_elements`; `nearest_assembly`, true to accept a
            home that is far from the home of the file.
        strict: Whether to refuse, as `check` does, formal errors such as infeasible inertias, see
            `crane.machine.machine_checks`.
        trust_xacro: Whether a xacro file may run Python in its expressions and read all files and
            environment variables, as by xacro itself; by default as `docs/security.md` says.
        gravity: (3,) acceleration of gravity in the axes of the world [m/s2], if not that of the
            file: (0, 0, -1.62) on the moon, (0, -9.81, 0) for a planar machine drawn in x and y.
            The same as changes of gravity.x, .y and .z.

    Returns:
        The machine, closed at home.

    Raises:
        DescriptionError: A file is wrong; the message has file and line.
        MechanismError: The parts do not form a machine that can be driven.
        InputError: A parameter is unknown or a value is not allowed.
    """
    package_paths, values = check_package_folders(packages), check_argument_values(arguments)
    floating = floating if isinstance(floating, bool) else check_freedoms(floating)
    with (
        summarize_warnings(),
        use_load_options(package_paths, values, bool(floating), strict, trust_xacro or None),
    ):
        chosen_joints = _check_chosen_joints(active=active, free=free)
        changes = _with_gravity(changes or {}, gravity)
        return _assemble_machine(
            _read_spec(name, chosen_joints, floating), changes, lock, chosen_joints, floating
        )


def _with_gravity(
    changes: Mapping[str, float | str], gravity: Sequence[float] | None
) -> Mapping[str, float | str]:
    """Return the changes with those by the gravity of the caller, or else of the load options.

    Raises:
        InputError: It is no vector, or the changes have another gravity.
    """
    if gravity is None and (gravity := load_options().gravity) is None:
        return changes
    values = as_sample(gravity, 3, "gravity").tolist()
    given = {f"{GRAVITY_PREFIX}{axis}": value for axis, value in zip("xyz", values, strict=True)}
    for name, value in given.items():
        if changes.get(name, value) != value:
            raise InputError(f"{name} is {changes[name]} and {value} at once, give one of them")
    return {**changes, **given}


ClosureProvider = Callable[[pin.Model, Sequence[LoopSpec], Sequence[Coupling]], Closure | None]
# fields that a machine has as its description has them
_DESCRIBED_FIELDS = {x.name for x in fields(Machine)} - {"active", "free", "external_forces"}
_MAX_KNOWN_CLOSURES = 3  # of variants, kept for reuse
# Descriptions of machines before changes and locks, so that `MachineVariants` can reuse them
_SPEC_BEFORE_CHANGES: WeakKeyDictionary[Closure, MachineSpec] = WeakKeyDictionary()


class MachineVariants:
    """Variants of a machine that differ in parameters alone.

    Files are not read again, unless the loops were closed anew since the machine was loaded.

    Args:
        machine: The machine as loaded; parts added or replaced since are not in its files.

    Attributes:
        spec: Its description with its parameter changes.
        values: Its parameters by name, see `crane.description.parameters`.
    """

    def __init__(self, machine: Machine):
        self._machine = machine
        with summarize_warnings(), self._load_options():
            spec_before_changes = _SPEC_BEFORE_CHANGES.get(machine.closure) or _read_spec(
                machine.load_name, machine.chosen_joints, machine.floating_base
            )
            self.spec = apply_parameter_changes(spec_before_changes, machine.parameter_changes)
        # the description has no payload mass after a change
        self.values = parameters(self.spec) | dict(machine.parameter_changes)
        self._spec_before_changes = spec_before_changes
        self._known_closures = [machine.closure] if machine.closure in _SPEC_BEFORE_CHANGES else []

    def machine(self, changes: Mapping[str, float]) -> Machine:
        """Return the machine with changed parameters, see `load`."""
        known_closures = self._known_closures

        def reuse_closure(
            model: pin.Model, loops: Sequence[LoopSpec], couplings: Sequence[Coupling]
        ) -> Closure | None:
            variants = (x.with_other_masses(model, loops, couplings) for x in known_closures)
            return next((closure for closure in variants if closure is not None), None)

        variant = self._build_variant(changes, reuse_closure)
        if all(variant.closure.structure is not closure.structure for closure in known_closures):
            self._known_closures = [variant.closure, *known_closures][:_MAX_KNOWN_CLOSURES]
        return variant

    def perturbed_machine(self, changes: Mapping[str, float]) -> Machine:
        """Return the machine with parameters changed so little that its loops stay the same.

        No warnings are issued; see `Closure.perturbed_machine`.
        """
        with ignore_warnings():
            return self._build_variant(changes, self._machine.closure.with_perturbed_model)

    def _build_variant(
        self, changes: Mapping[str, float], closure_provider: ClosureProvider
    ) -> Machine:
        original = self._machine
        with summarize_warnings(), self._load_options():
            return _assemble_machine(
                self._spec_before_changes,
                {**original.parameter_changes, **changes},
                original.locked_joints,
                original.chosen_joints,
                original.floating_base,
                closure_provider,
            )

    def _load_options(self) -> AbstractContextManager[object]:
        original = self._machine
        return use_load_options(
            check_package_folders(original.packages),
            check_argument_values(original.arguments),
            bool(original.floating_base),
            trust_xacro=original.trusts_xacro,
        )


def _read_spec(
    name: str | Path,
    chosen_joints: Mapping[str, tuple[str, ...]],
    floating: bool | tuple[str, ...],
) -> MachineSpec:
    spec = add_floating_base(read_machine_spec(name), floating)
    if chosen_joints:
        spec = set_active_joints(spec, chosen_joints.get("active"), chosen_joints.get("free"))
    return spec


def _assemble_machine(
    spec: MachineSpec,
    changes: Mapping[str, float | str] | None,
    lock: Mapping[str, float | str] | None,
    chosen_joints: Mapping[str, tuple[str, ...]],
    floating: bool | tuple[str, ...],
    closure_provider: ClosureProvider = lambda *_: None,
) -> Machine:
    spec_before_changes = spec
    changes, lock = changes_in_si(spec, changes), locks_in_si(spec, lock)
    if changes:
        spec = apply_parameter_changes(spec, changes)
    if lock:
        spec = lock_joints(spec, lock)
    model = assemble_tree(spec)
    is_modified = bool(lock) or not all(x.startswith(GRAVITY_PREFIX) for x in changes or ())
    closure = closure_provider(model, spec.loops, spec.couplings) or _build_closure(
        spec, model, is_modified
    )
    if lock:
        warn_about_limits(spec, closure)
    _SPEC_BEFORE_CHANGES[closure] = spec_before_changes
    spec, model = replace_infeasible_inertias(spec, model, closure)
    held = [closure.active_names[i] for i in check_masses(spec, model, closure)]
    check_frame_elements(spec, closure)
    coordinates = closure.equations.coordinates
    lower, upper = coordinates.lower, coordinates.upper
    described: dict[str, Any] = {
        name: MappingProxyType(dict(value)) if isinstance(value, Mapping) else value
        for name, value in vars(spec).items()
        if name in _DESCRIBED_FIELDS
    }
    machine = Machine(
        **described,
        model=model,
        closure=closure,
        active=closure.active_names,
        lower=read_only_copy(lower[closure.active]),
        upper=read_only_copy(upper[closure.active]),
        chosen_joints=MappingProxyType(dict(chosen_joints)),
        floating_base=floating,
        packages=load_options().packages,
        arguments=MappingProxyType(load_options().arguments),
        trusts_xacro=load_options().trust_xacro,
        parameter_changes=MappingProxyType(
            {name: float(value) for name, value in changes.items()}
        ),
        free=select_free_joints(spec, closure.active_names, held),
        external_forces=(),
        explicit_drives=select_motors(spec, closure.active_names),
        locked_joints=MappingProxyType({name: float(value) for name, value in lock.items()}),
    )
    return machine.with_external_forces(*spec.external_forces) if spec.external_forces else machine


def _build_closure(spec: MachineSpec, model: pin.Model, is_modified: bool) -> Closure:
    initial_guess = home_initial_guess(spec, model)
    try:
        closure = build_closure(spec, model, initial_guess)
    except OpenLoopError as error:
        raise error if is_modified else add_remedy(spec, model, initial_guess, error) from None
    check_home(spec, closure, initial_guess, is_modified)
    warn_about_assembly_modes(spec, closure, initial_guess)
    return closure


def _check_chosen_joints(**chosen_joints: Sequence[str] | None) -> dict[str, tuple[str, ...]]:
    for label, joints in chosen_joints.items():
        if joints is not None and (isinstance(joints, str) or not isinstance(joints, Sequence)):
            raise InputError(
                f"{label} is {joints!r}, give a list of joints such as ['lift', 'tilt']"
            )
    return {
        label: tuple(map(str, joints))
        for label, joints in chosen_joints.items()
        if joints is not None
    }


def load_from_expression(expression: str) -> Machine:
    """Load a machine from the text of `Machine.load_expression`, without trust in xacro files.

    Raises:
        InputError: The text is malformed; otherwise as `load`.
    """
    try:
        find_machine_file(expression)
    except DescriptionError:
        if CHANGES_SEPARATOR not in expression:
            raise
    else:
        with use_load_options(trust_xacro=False):
            return load(expression)  # a path may hold anything
    name, _, text = expression.partition(CHANGES_SEPARATOR)
    try:
        options = json.loads(text)
        changes, lock = (
            {key: float(value) for key, value in options.pop(kind, {}).items()}
            for kind in ("changes", "lock")
        )
        active, free = (
            [str(joint) for joint in options.pop(kind)] if kind in options else None
            for kind in ("active", "free")
        )
        floating = options.pop("floating", False)
        packages = [str(folder) for folder in options.pop("packages", [])]
        arguments = {key: str(value) for key, value in options.pop("arguments", {}).items()}
    except (ValueError, TypeError, AttributeError, RecursionError):
        options = {"": None}
    if options:
        example = '{"changes": {"payload.mass": 200}, "lock": {"slew": 0}}'
        raise InputError(
            f"'{expression}' names no machine, write NAME{CHANGES_SEPARATOR}{example}"
        )
    with use_load_options(trust_xacro=False):
        return load(name, changes, lock, active, free, floating, packages, arguments)
