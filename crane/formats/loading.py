"""From a description to a machine."""

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from weakref import WeakKeyDictionary

import pinocchio as pin

from crane.closure import Closure
from crane.closure.structure import OpenLoopError
from crane.common.counted import few_warnings
from crane.common.errors import CraneWarning, DescriptionError, InputError
from crane.common.packages import giving, package_folders, values_by_name
from crane.description import Coupling, LoopSpec, MachineSpec, changed, driven, locked, parameters
from crane.description.floating import floated, freedoms_of
from crane.description.sources import WITH, find
from crane.formats.ambiguity import warn_of_assemblies
from crane.formats.home import check_home, with_remedy
from crane.formats.machine_file.read import read
from crane.machine.assemble import assemble, closed, home_guess
from crane.machine.between import check_elements
from crane.machine.drives import free_joints, motors
from crane.machine.machine import Machine, fixed
from crane.machine.masses import check_masses, with_computable_inertias


def load(
    name: str | Path,
    changes: Mapping[str, float] | None = None,
    lock: Mapping[str, float] | None = None,
    active: Sequence[str] | None = None,
    free: Sequence[str] | None = None,
    floating: bool | Sequence[str] = False,
    packages: Sequence[str | Path] = (),
    arguments: Mapping[str, object] | None = None,
    strict: bool = False,
) -> Machine:
    """Load a machine, perhaps with some of its numbers changed, or joints locked.

    Args:
        name: A bundled machine's name, a robot of example-robot-data by its file's name, or the
            path of a machine file (.yaml), URDF (.urdf, .xacro, with `<loop>` elements if it has
            loops), SDF (.sdf, .world) or MJCF (.xml).
        changes: New values by the names of `crane.description.parameters`, such as
            {"link3_G.x": 0.1, "link7.mass": 0.25, "payload.mass": 0.1}; SI units.
        lock: Coordinates [m], [rad] of joints to be fixed, by name.
        active: Driven joints in the order of q_A, if not those of the file. Where there are more
            than degrees of freedom, all of them are drives, see `Dynamics.drive_forces`.
        free: Coordinates that nothing drives, if not those of the file. What the active joints
            leave open is free anyway, with a warning.
        floating: Whether the root floats instead of standing on the ground: a vehicle, a humanoid.
            Its six freedoms, base_x to base_rz, are free, see `crane.description.floating`;
            of some freedoms their names, such as ("z", "ry") for one that heaves and pitches.
        packages: Folders of the packages that files name by `package://`, `model://` and
            `$(find ...)`, or folders in which these are, see `crane.common.packages`.
        arguments: Values of the arguments of a xacro file; `model` of an SDF with several models;
            `urdf_constraint`, true where a URDF's `<constraint>` elements, as proposed upstream,
            are to be read as loops, see `crane.formats.urdf.constraints`; `nearest_assembly`, true
            to take an assembly that is far from the home that a file says.
        strict: Whether to refuse, as `check` does, what can be computed with in spite of its
            form: inertias that no body has, see `crane.machine.masses`.

    Returns:
        The machine, its home posture closed.

    Raises:
        DescriptionError: A file is wrong; the message has file and line.
        MechanismError: The parts do not make a machine that can be driven.
        InputError: A change of a parameter that is not there, or to what cannot be.
    """
    folders, values = package_folders(packages), values_by_name(arguments)
    floating = floating if isinstance(floating, bool) else freedoms_of(floating)
    with few_warnings(), giving(folders, values, bool(floating), strict) as said:
        machine = _load(name, changes, lock, active, free, floating)
        return replace(machine, packages=said.packages, arguments=MappingProxyType(said.arguments))


Known = Callable[[pin.Model, Sequence[LoopSpec], Sequence[Coupling]], Closure | None]
_REMEMBERED = (
    3  # closures of variants: what is looked at beside one shares its loops or has its own
)
# What machines were made of before changes and locks, so that `Variants` need not read it again.
_UNCHANGED: WeakKeyDictionary[Closure, MachineSpec] = WeakKeyDictionary()


class Variants:
    """The machines that differ from one in their numbers alone.

    Its files are not read again, unless its loops were closed anew since it was loaded.

    Args:
        machine: As it was loaded; what was put onto it or replaced since is not in its files.

    Attributes:
        spec: Its description, with its own changes.
        values: Its numbers by name, see `crane.description.parameters`.
    """

    def __init__(self, machine: Machine):
        self._machine = machine
        with few_warnings(), self._giving():
            unchanged = _UNCHANGED.get(machine.closure) or _described(
                machine.reference,
                machine.chosen.get("active"),
                machine.chosen.get("free"),
                machine.floats,
            )
            self.spec = changed(unchanged, machine.changes)
        # of a payload the description does not say that it is one
        self.values = parameters(self.spec) | dict(machine.changes)
        self._unchanged = unchanged
        self._known = [machine.closure] if machine.closure in _UNCHANGED else []

    def machine(self, changes: Mapping[str, float]) -> Machine:
        """The machine with some of its numbers changed, see `load`."""
        known = self._known
        made = self._with(changes, lambda *tree: _of_alike(known, *tree))
        if all(made.closure.structure is not closure.structure for closure in known):
            self._known = [made.closure, *known][:_REMEMBERED]
        return made

    def near(self, changes: Mapping[str, float]) -> Machine:
        """The machine with numbers changed so little that its loops are the same.

        A look at its numbers, of which nothing is told: see `Closure.near`.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CraneWarning)
            return self._with(changes, self._machine.closure.near)

    def _with(self, changes: Mapping[str, float], known: Known) -> Machine:
        was, every = self._machine, {**self._machine.changes, **changes}
        chosen = was.chosen.get("active"), was.chosen.get("free")
        with few_warnings(), self._giving():
            made = _assembled(self._unchanged, every, was.locks, *chosen, was.floats, known)
        return replace(made, packages=was.packages, arguments=was.arguments)

    def _giving(self) -> AbstractContextManager[object]:
        was = self._machine
        folders, values = package_folders(was.packages), values_by_name(was.arguments)
        return giving(folders, values, bool(was.floats))


def _load(
    name: str | Path,
    changes: Mapping[str, float] | None,
    lock: Mapping[str, float] | None,
    active: Sequence[str] | None,
    free: Sequence[str] | None,
    floating: bool | tuple[str, ...],
) -> Machine:
    spec = _described(name, active, free, floating)
    return _assembled(spec, changes, lock, active, free, floating)


def _described(
    name: str | Path,
    active: Sequence[str] | None,
    free: Sequence[str] | None,
    floating: bool | tuple[str, ...],
) -> MachineSpec:
    spec = floated(read(name), floating)
    if active is not None or free is not None:
        spec = driven(spec, _names(active, "active"), _names(free, "free"))
    return spec


def _assembled(
    spec: MachineSpec,
    changes: Mapping[str, float] | None,
    lock: Mapping[str, float] | None,
    active: Sequence[str] | None,
    free: Sequence[str] | None,
    floating: bool | tuple[str, ...],
    known: Known = lambda *_: None,
) -> Machine:
    said, unchanged = {"active": active, "free": free}, spec
    if changes:
        spec = changed(spec, changes)
    if lock:
        spec = locked(spec, lock)
    model = assemble(spec)
    closure = known(model, spec.loops, spec.couplings) or _closed(
        spec, model, bool(changes or lock)
    )
    _UNCHANGED[closure] = unchanged
    spec, model = with_computable_inertias(spec, model, closure)
    check_masses(spec, model, closure)
    check_elements(spec, closure)
    coordinates = closure.equations.coordinates
    lower, upper = coordinates.lower, coordinates.upper
    machine = Machine(
        name=spec.name,
        source=spec.source,
        path=spec.path,
        chains=spec.chains,
        tree=spec.tree,
        model=model,
        closure=closure,
        active=closure.active_names,
        lower=fixed(lower[closure.active]),
        upper=fixed(upper[closure.active]),
        friction=MappingProxyType(dict(spec.friction)),
        forces=spec.forces,
        gas_springs=spec.gas_springs,
        ropes=spec.ropes,
        end_stops=spec.end_stops,
        estimation=spec.estimation,
        tip=spec.tip,
        tasks=MappingProxyType(dict(spec.tasks)),
        control=MappingProxyType(dict(spec.control)),
        hydraulics=spec.hydraulics,
        sensors=MappingProxyType(dict(spec.sensors)),
        chosen=MappingProxyType(
            {key: tuple(names) for key, names in said.items() if names is not None}
        ),
        floats=floating,
        packages=(),
        arguments=MappingProxyType({}),
        changes=MappingProxyType({name: float(value) for name, value in (changes or {}).items()}),
        free=free_joints(spec, closure.active_names),
        external=(),
        supports=spec.supports,
        pins=MappingProxyType(dict(spec.pins)),
        motors=motors(spec, closure.active_names),
        locks=MappingProxyType({name: float(value) for name, value in (lock or {}).items()}),
    )
    return machine.under(*spec.external) if spec.external else machine


def _of_alike(
    closures: Sequence[Closure],
    model: pin.Model,
    loops: Sequence[LoopSpec],
    couplings: Sequence[Coupling],
) -> Closure | None:
    """One of some closures if the tree is at the same places as its own."""
    found = (closure.of_alike(model, loops, couplings) for closure in closures)
    return next((closure for closure in found if closure is not None), None)


def _closed(spec: MachineSpec, model: pin.Model, varied: bool) -> Closure:
    guess = home_guess(spec, model)
    try:
        closure = closed(spec, model, guess)
    except OpenLoopError as error:
        raise error if varied else with_remedy(spec, model, guess, error) from None
    check_home(spec, closure, guess, varied)
    warn_of_assemblies(spec, closure, guess)
    return closure


def _names(given: object, what: str) -> Sequence[str] | None:
    if given is None:
        return None
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise InputError(f"{what} is {given!r}, give a list of joints such as ['lift', 'tilt']")
    return tuple(map(str, given))


def recalled(call: str) -> Machine:
    """Load a machine by what `Machine.call` says of it.

    Raises:
        InputError: It says nothing that can be understood; otherwise as `load`.
    """
    try:
        find(call)
    except DescriptionError:
        if WITH not in call:
            raise
    else:
        return load(call)  # a path may hold anything
    name, _, text = call.partition(WITH)
    try:
        given = json.loads(text)
        changes, lock = (
            {key: float(value) for key, value in given.pop(kind, {}).items()}
            for kind in ("changes", "lock")
        )
        active, free = (
            [str(joint) for joint in given.pop(kind)] if kind in given else None
            for kind in ("active", "free")
        )
        floating = given.pop("floating", False)
        packages = [str(folder) for folder in given.pop("packages", [])]
        arguments = {key: str(value) for key, value in given.pop("arguments", {}).items()}
    except (ValueError, TypeError, AttributeError, RecursionError):
        given = {"": None}
    if given:
        example = '{"changes": {"payload.mass": 200}, "lock": {"slew": 0}}'
        raise InputError(f"'{call}' names no machine, write NAME{WITH}{example}")
    return load(name, changes, lock, active, free, floating, packages, arguments)
