"""C99 sources of a machine: header, functions, self-test with recorded vectors, examples."""

import re
from collections.abc import Iterable, Mapping
from functools import cached_property
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from types import MappingProxyType

import numpy as np

import crane
from crane.codegen.c_emitter import C_PRELUDE, c_parameters, emit_c_function
from crane.codegen.linked_functions import LinkedFunction
from crane.common.atomic_output import check_folder_is_writable, replace_folder
from crane.common.samples import Array
from crane.control.control_law import Controller
from crane.control.valve_commands import ValveCommand
from crane.export.instance_program import InstanceProgram
from crane.export.instance_routines import STATUS_TEXTS
from crane.export.kinematics_program import KinematicsProgram
from crane.export.recorded_values import TEST_STEP, random_vectors, recorded_motion
from crane.formats.machine_loading import load
from crane.machine.machine import Machine

_ARRAYS = (
    "q", "v_a", "contacts", "tau", "friction", "friction_at_rest", "a", "cursor", "lengths",
    "bounds", "tolerances", "history",
)  # fmt: skip
_PARAMETERS = ("geometry", "dynamics", "settings")
_TEMPLATES = (
    "CMakeLists.txt", "machine_example.c", "machine_example.py", "machine_sfunction.c",
)  # fmt: skip
_TEXTS = {
    "initialize": "Close the loops from the active coordinates in q, the others as first guess,\n"
    "and start at rest at `time`; pressures hold the machine, joints with stiction stick or slip.",
    "update_modes": "After an event, or a change of parameters during a motion: find which joints "
    "stick.",
    "advance": "Integrate over `step` with controlled errors. The inputs go linearly from those\n"
    "of the last call to those that are set now.",
    "advance_fixed": "One step of the classical Runge-Kutta method of length `step`. Joints begin "
    "to\nslip and stop at the start of a step only.",
    "update_outputs": "Compute the outputs, from `tau` on, at the state and inputs.",
    "derivatives": "Derivatives of the state, from `q` on, at the state and inputs.",
    "event_indicators": "Quantities whose change of sign is an event: the margin of stick-slip "
    "transitions,\nthen distances of end stops, contacts, voids.",
    "directional_derivatives": "Derivatives of `derivatives` and the outputs along a direction "
    "(state, inputs).",
    "close_loops": "Newton's method in place: q (nq) closed at its active coordinates, the others "
    "as first guess.",
    "follow_loops": "q (nq) at active coordinates q_a (n), by one step from the last ones.",
    "gamma": "dq/dq_a (nq, n) at a closed configuration.",
    "tip": "Position of the tip (3), its Jacobian (3, n) and its acceleration at a_a = 0 (3).",
    "inverse_dynamics": "Active forces (n) at accelerations x (n), without friction.",
    "inverse_dynamics_with_friction": "Active forces (n) at accelerations x (n).",
    "forward_dynamics": "Accelerations (n) under active forces x (n), without friction.",
    "forward_dynamics_with_friction": "Accelerations (n) under active forces x (n).",
    "set_payload": "Hang a payload (10) on the tip: mass, centre of mass (3) and inertia about it "
    "(xx,\nxy, xz, yy, yz, zz), in the frame of the tip; it replaces the last one. The body of the"
    "\ntip without it is `unladen_`.",
    "mass_matrix": "(n, n); v_a and x are not used, as for gravity and energy.",
    "bias": "Forces (n) of inertia, gravity and springs at a_a = 0.",
    "gravity": "Active forces (n) that hold the machine.",
    "energy": "Kinetic and potential energy [J].",
    "regressor": "(n, parameters): forces = regressor times inertial parameters, see the docs.",
    "inverse_dynamics_derivatives": "By q_a, v_a and x, (3, n, n).",
    "forward_dynamics_derivatives": "By q_a, v_a and x, (3, n, n).",
}


def c_identifier(name: str) -> str:
    """A name as an identifier in C."""
    found = re.sub(r"\W", "_", name, flags=re.ASCII)
    return f"m_{found}" if not found or found[0].isdigit() else found


def write_c(
    machine: Machine | str | Path,
    folder: str | Path,
    *,
    controller: Controller | ValveCommand | None = None,
    name: str = "",
    overwrite: bool = True,
) -> Path:
    """Write a machine as C99 sources, with a self-test, examples and a CMakeLists.txt.

    They close the loops and compute the tip, inverse and forward dynamics, mass matrix, gravity,
    regressor and derivatives, and integrate the machine with friction that sticks, end stops and
    its hydraulic circuit, as `simulate` does. NAME.h explains the functions.

    Args:
        machine: The machine, or what `crane.load` takes.
        folder: Folder of the files.
        controller: See `InstanceProgram`; the inputs are forces or valve signals without it.
        name: Prefix of all public names; that of the machine by default.
        overwrite: Whether files of the same names are replaced.

    Returns:
        The folder.

    Raises:
        InputError: See `InstanceProgram`.
        OutputError: The folder cannot be written.
    """
    check_folder_is_writable(Path(folder), overwrite)
    loaded = machine if isinstance(machine, Machine) else load(machine)
    texts = CSources(InstanceProgram(loaded, controller=controller), name).files()
    return write_texts(folder, texts, overwrite)


def write_texts(folder: str | Path, texts: Mapping[str, str], overwrite: bool) -> Path:
    """Write files of a folder by name."""
    with replace_folder(folder, overwrite) as output_folder:
        for file, text in texts.items():
            (output_folder / file).write_text(text, encoding="utf-8")
    return Path(folder)


class CSources:
    """The C sources of a machine.

    Args:
        program: The machine as a program.
        name: Prefix of all public names; that of the machine by default.
    """

    def __init__(self, program: KinematicsProgram, name: str = ""):
        self._program, self.name = program, c_identifier(name or program.machine.name)
        self._values = [
            c_number(x)
            if x == y
            else f"sizeof({self.name}_real) < 8 ? {c_number(y)} : {c_number(x)}"
            for x, y in zip(program.defaults, program.single_precision_defaults, strict=True)
        ]

    def fill(self, template: str, further: Mapping[str, str] = MappingProxyType({})) -> str:
        """The text of a template with the values of the machine in place of @VALUE@."""
        text = (files("crane.export") / "templates" / f"{template}.template").read_text("utf-8")
        machine, inputs = self._program.machine, self._program.layout.indices("inputs")
        values = {
            "NAME": self.name, "UPPER": self.name.upper(), "MACHINE": machine.name,
            "VERSION": crane.__version__, "NQ": str(machine.model.nv),
            "N": str(len(machine.active)), "INPUT_COUNT": str(len(inputs)),
            "FIRST_INPUT": self.first_input(),
            "OUTPUTS": str(self._program.output_count), **further,
        }  # fmt: skip
        return re.sub(r"@([A-Z_]+)@", lambda match: values[match[1]], text)

    @cached_property
    def _members(self) -> dict[str, list[int]]:
        """Elements of each member of the struct; arrays have brackets in their names."""
        program, found = self._program, dict[str, list[int]]()
        parts = [part for part, size in program.layout.parts.items() for _ in range(size)]

        def array_name(i: int) -> str:
            is_unused = parts[i] in _PARAMETERS and i not in program.loads
            return parts[i] if parts[i] in _ARRAYS else "unused" if is_unused else f"{i}"

        for array, group in groupby(range(program.layout.size), array_name):
            indices = [*group]
            name = f"{array}[{len(indices)}]"
            if array == "unused":
                name = f"unused_{indices[0]}[{len(indices)}]"
            elif array not in _ARRAYS:
                name = c_identifier(program.names[indices[0]])
            while name in found or name in _ARRAYS:
                name += "_"
            found[name] = indices
        return found

    def first_input(self) -> str:
        """Member of the first input; the time where there is none."""
        inputs = self._program.layout.indices("inputs")
        return next((name for name, (i, *_) in self._members.items() if i in inputs), "time")

    def header(self) -> str:
        """The header."""
        program, upper = self._program, self.name.upper()
        machine, prototypes = program.machine, []
        for entry, linked in program.entries.items():
            operations, memory = sum(linked.formula_lengths.values()), 8 * linked.stack_numbers
            cost = f"{operations} operations where nothing is repeated, arrays of {memory} bytes."
            text = "\n * ".join([*_TEXTS[entry].split("\n"), cost])
            prototypes.append(f"/* {text} */\n{self._prototype(entry, linked)};")
        joints = ",\n    ".join(f"{upper}_{c_identifier(x).upper()}" for x in machine.joints)
        values = {
            "STATUSES": "\n".join(f" *  {code}: {text}" for code, text in STATUS_TEXTS.items()),
            "ACTIVE": ", ".join(map(str, machine.closure.active.tolist())),
            "JOINTS": joints,
            "MEMBERS": _join(map(self._declaration, self._members)),
            "PROTOTYPES": "\n".join(prototypes),
        }
        return self.fill("machine.h", values)

    def _declaration(self, member: str) -> str:
        unit = "" if member.endswith("]") else self._program.units[self._members[member][0]]
        return f"{self.name}_real {member};{f' /* {unit} */' if unit else ''}"

    def _initial_value(self, member: str) -> str:
        values = ", ".join(self._values[i] for i in self._members[member])
        return f"{{{values}}}," if member.endswith("]") else f"{values},"

    def _prototype(self, entry: str, linked: LinkedFunction) -> str:
        real, parameters = f"{self.name}_real", c_parameters(linked).replace("real *", "@*")
        instance = f"{'' if 'instance' in linked.written else 'const '}{self.name} *m"
        rest = [x.replace("@*", f"{real} *") for x in parameters.split(", ")[1:]]
        return f"int {self.name}_{entry}({', '.join([instance, *rest])})"

    def source(self) -> str:
        """The functions."""
        wrappers = []
        for entry, linked in self._program.entries.items():
            kind = "real *" if "instance" in linked.written else "const real *"
            arguments = ", ".join([f"({kind})m", *linked.arguments[1:]])
            call = f"return {linked.name}({arguments});"
            wrappers.append(f"{self._prototype(entry, linked)}\n{{\n    {call}\n}}\n")
        values = {
            "FUNCTIONS": "\n".join([C_PRELUDE, *map(emit_c_function, self._program.functions)]),
            "DEFAULTS": _join(map(self._initial_value, self._members)),
            "WRAPPERS": "\n".join(wrappers),
        }
        return self.fill("machine.c", values)

    def files(self) -> dict[str, str]:
        """Texts of all files of an `InstanceProgram` by name."""
        name = self.name
        found = {
            f"{name}.h": self.header(),
            f"{name}.c": self.source(),
            f"{name}_test.c": self.test(),
        }
        for template in _TEMPLATES:
            found[template.replace("machine", name)] = self.fill(template)
        return found

    def test(self) -> str:
        """A program that compares the functions with recorded values of crane."""
        program, name = self._program, self.name
        assert isinstance(program, InstanceProgram)
        vectors, (inputs, motion) = random_vectors(program), recorded_motion(program)
        sizes = {key: rows[0].size for key, rows in vectors.values.items()}
        checks, bounds = [], {}
        for key, rows in vectors.values.items():
            # rounding errors of n operations grow as sqrt(n) where they are independent
            growth = np.sqrt(sum(program.entries[key].formula_lengths.values()))
            bounds[f"bound_of_{key}"] = growth * vectors.changes[key]
            scale = c_number(float(np.abs(rows).max()) or 1.0)
            arguments = f'"{key}", found, {key}[i], {sizes[key]}, {scale}, bound_of_{key}[i][0]'
            checks += [f"{name}_{key}(&m, q, v, x, found);", f"compare({arguments});"]
        set_inputs = f"for (j = 0; j < {inputs.shape[1]}; ++j)\n            " + (
            f"(&m.{self.first_input()})[j] = ({name}_real)inputs[i][j];" if inputs.size else ";"
        )
        tables = vectors.states | vectors.values | bounds | {"inputs": inputs, "motion": motion}
        values = {
            "TABLES": "\n".join(_table(key, np.array(rows)) for key, rows in tables.items()),
            "STATES": str(len(vectors.states["second"])), "STEPS": str(len(motion)),
            "STEP": repr(TEST_STEP), "LARGEST": str(max(sizes.values())),
            "CHECKS": "\n        ".join(checks), "SET_INPUTS": set_inputs,
        }  # fmt: skip
        return self.fill("self_test.c", values)


def _join(lines: Iterable[str]) -> str:
    return "\n    ".join(lines)


def c_number(value: float) -> str:
    """A number in C."""
    return repr(value if isinstance(value, int) else float(value)).replace("inf", "INFINITY")


def c_numbers(values: Iterable[float]) -> str:
    """Numbers of C in a list."""
    return ", ".join(map(c_number, values))


def _table(name: str, rows: Array) -> str:
    """A constant table; of one number where it would be empty."""
    flat = rows.reshape(len(rows), -1) if rows.size else np.zeros((1, 1))
    body = ",\n    ".join(f"{{{c_numbers(row)}}}" for row in flat.tolist())
    return f"static const double {name}[{flat.shape[0]}][{flat.shape[1]}] = {{\n    {body}}};"
