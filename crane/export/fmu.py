"""A machine as a Functional Mock-up Unit (FMU) of FMI 3 or 2."""

import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Iterable, Mapping
from functools import cached_property
from html import escape
from math import inf
from pathlib import Path
from xml.etree import ElementTree as ET

import crane
from crane.common.atomic_output import check_file_is_writable, replace_file
from crane.common.errors import CraneWarning, InputError, check_name
from crane.export.c_sources import CSources, read_template
from crane.export.fmu_variables import (
    FIXED, GUESS, INPUT, LOCAL, OUTPUT, STATE_START, TIME, TUNABLE, FmuVariable, FmuVariables,
    base_unit,
)  # fmt: skip
from crane.export.instance_program import InstanceProgram
from crane.export.instance_routines import STATUS_TEXTS
from crane.formats.machine_loading import load
from crane.machine.machine import Machine
from crane.motion.limit_violations import limit_tolerances
from crane.simulation.integration.stick_slip_modes import EVENT_TOLERANCE

VERSIONS = (3, 2)
MARGIN_SHIFT = 1.5 * EVENT_TOLERANCE  # by which a stick-slip transition is passed
# platforms of FMI 3: its name in FMI 2, suffix of the library, target of zig
_PLATFORMS = {
    "x86_64-linux": ("linux64", ".so", "x86_64-linux-gnu.2.17"),
    "x86_64-windows": ("win64", ".dll", "x86_64-windows-gnu"),
    "aarch64-linux": ("aarch64-linux", ".so", "aarch64-linux-gnu.2.17"),
    "x86_64-darwin": ("darwin64", ".dylib", ""),
    "aarch64-darwin": ("aarch64-darwin", ".dylib", ""),
}
_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-shared")
_DATE = (1980, 1, 1, 0, 0, 0)  # of all members, so that equal machines give equal files
_ATTRIBUTES = {
    TIME: {"causality": "independent", "variability": "continuous"},
    INPUT: {"causality": "input", "variability": "continuous"},
    TUNABLE: {"causality": "parameter", "variability": "tunable"},
    FIXED: {"causality": "parameter", "variability": "fixed"},
    STATE_START: {"causality": "output", "variability": "continuous", "initial": "exact"},
    GUESS: {"causality": "output", "variability": "continuous", "initial": "approx"},
    OUTPUT: {"causality": "output", "variability": "continuous", "initial": "calculated"},
    LOCAL: {"causality": "local", "variability": "continuous", "initial": "calculated"},
}


def write_fmu(
    machine: Machine | str | Path,
    path: str | Path,
    fmi: int = 3,
    *,
    overwrite: bool = True,
    icon: bytes = b"",
    about: str = "",
) -> Path:
    """Write a machine as an FMU for model exchange and co-simulation.

    Inputs are those of `InstanceProgram`. With ziglang it has libraries for Windows and Linux,
    else one for this computer, by its C compiler.

    Args:
        machine: The machine, or what `crane.load` takes.
        path: The .fmu file.
        fmi: Version of FMI, 3 or 2.
        overwrite: Whether the file is replaced.
        icon: A PNG file of the machine.
        about: HTML about the machine, for its documentation.

    Returns:
        The path.

    Raises:
        InputError: See `InstanceProgram`; or there is no C compiler.
        OutputError: The file cannot be written.
    """
    check_name(fmi, VERSIONS, f"FMI {fmi} is not written")
    check_file_is_writable(Path(path), overwrite)
    loaded = machine if isinstance(machine, Machine) else load(machine)
    files = FmuFiles(InstanceProgram(loaded, (), for_exchange=True), fmi)
    members = files.members(icon, about)
    with replace_file(path) as output, zipfile.ZipFile(output, "w") as archive:
        for name, content in members.items():
            member = zipfile.ZipInfo(name, _DATE)
            member.external_attr = 0o644 << 16
            data = content.encode() if isinstance(content, str) else content
            archive.writestr(member, data, zipfile.ZIP_DEFLATED)
    return Path(path)


class FmuFiles:
    """The files of an FMU.

    Args:
        program: The machine.
        fmi: Version of FMI, 3 or 2.
    """

    def __init__(self, program: InstanceProgram, fmi: int):
        self._program, self._fmi, self._sources = program, fmi, CSources(program)
        self._values, self.name = FmuVariables(program), self._sources.name
        self._by_reference = {x.reference: x for x in self._values.variables}
        self.sources = {f"{self.name}.h": self._sources.header(),
                        f"{self.name}.c": self._sources.source()}  # fmt: skip
        text = "".join((crane.__version__, str(fmi), *self.sources.values(), *self._names()))
        self._token = hashlib.sha256(text.encode()).hexdigest()
        self.sources["fmu.c"] = self._runtime()

    def members(self, icon: bytes, about: str) -> dict[str, str | bytes]:
        """Contents of all files by path; see `write_fmu`."""
        found: dict[str, str | bytes] = {"modelDescription.xml": self.description()}
        found |= {f"sources/{name}": text for name, text in self.sources.items()}
        if self._fmi == 3:
            root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
            build = ET.SubElement(root, "BuildConfiguration", modelIdentifier=self.name)
            files = ET.SubElement(build, "SourceFileSet", language="C99")
            for name in ("fmu.c", f"{self.name}.c"):
                ET.SubElement(files, "SourceFile", name=name)
            found["sources/buildDescription.xml"] = _xml(root)
        found["documentation/index.html"] = self._documentation(about)
        if icon and self._fmi == 2:
            found["model.png"] = icon
        elif icon:
            root = ET.Element("fmiTerminalsAndIcons", fmiVersion="3.0")
            picture = ET.SubElement(root, "GraphicalRepresentation")
            corners = {"x1": "-100", "y1": "-100", "x2": "100", "y2": "100"}
            ET.SubElement(picture, "CoordinateSystem", corners, suggestedScalingFactorTo_mm="0.1")
            ET.SubElement(picture, "Icon", corners)
            found["terminalsAndIcons/terminalsAndIcons.xml"] = _xml(root)
            found["terminalsAndIcons/icon.png"] = icon
        for folder, library in compile_libraries(self.sources, self.name).items():
            place = folder if self._fmi == 3 else _PLATFORMS[folder][0]
            found[f"binaries/{place}/{self.name}{_PLATFORMS[folder][1]}"] = library
        return found

    def _names(self) -> list[str]:
        pairs = ((x.reference, f"{x.kind}{x.name}") for x in self._values.variables)
        return [f'[{i}] = "{name}",' for i, name in pairs]

    def _runtime(self) -> str:
        """The C source between the functions of FMI and those of the machine."""
        values, program, machine = self._values, self._program, self._program.machine
        layout, parts, frame = values.layout, values.layout.parts, program.tip_frame
        first = layout.start_index
        dynamics = program.chart.dynamics.formula_structure.constants_layout
        body = first("dynamics") + dynamics.start_index("inertias")
        indices = {
            "SIZE": layout.size, "TIME": first("time"), "STEP": first("step"),
            "INPUTS_START": first("inputs_start"), "INPUTS": first("inputs"),
            "INPUT_COUNT": parts["inputs"], "Q": first("q"),
            "STATE_SIZE": program.chart.state_layout.size,
            "OUTPUT_SIZE": program.chart.output_layout.size, "LENGTHS": first("lengths"),
            "DERIVATIVES": first("derivatives"), "EVENT": first("events"),
            "EVENT_SIZE": parts["events"], "TIP_POSITION": first("tip"), "TIP_SIZE": parts["tip"],
            "PAYLOAD": first("payload"), "CURSOR": first("cursor"), "CURSOR_SIZE": parts["cursor"],
            "TIP_BODY": body + (10 * (frame.body - 1) if frame is not None else 0),
        }  # fmt: skip
        point = [0.0] * 3 if frame is None else frame.frame_offset.tolist()
        name, events = self.name, program.routines.event_parts
        call = f"if (status == 1 && missing & EVENTS) status = {name}_event_indicators(m, x + EVENT);"
        if "margin" in events:
            call += f"\n    if (missing & EVENTS) x[EVENT] += {MARGIN_SHIFT};"
        tip = f"if (status == 1 && missing & TIP) status = {name}_tip(m, x + Q, x + Q + NQ, tip);"
        derivative = f"if (status == 1) status = {name}_tip(m, x + Q, x + Q + NQ, tip);"
        further = {
            "FMI": str(self._fmi), "ID": f"0x{self._token[:16]}", "TOKEN": self._token,
            "INDICES": ",\n    ".join(f"{key} = {x}" for key, x in indices.items()),
            "NAMES": "\n    ".join(self._names()),
            "ACTIVE": _numbers(machine.closure.active.tolist()),
            "STATES": _numbers(values.states), "NOMINALS": _numbers(values.nominals.tolist()),
            "LIMITS": ",\n    ".join(f"{{{_numbers(row)}}}" for row in _limits(machine)),
            "REASONS": ", ".join(f'"{text}"' for text in STATUS_TEXTS.values()),
            "TIP_POINT": _numbers(point), "TIP_CALL": tip if frame is not None else "(void)tip;",
            "TIP_DERIVATIVE_CALL": derivative if frame is not None else "",
            "EVENT_CALL": call if events else "",
            "ROTATIONS": "".join(f"{x}, " for x in machine.coordinates.rotation_columns),
            "DESERIALIZE": "DeserializeFMUState" if self._fmi == 3 else "DeSerializeFMUstate",
            "GET_DERIVATIVES": "GetContinuousStateDerivatives" if self._fmi == 3 else "GetDerivatives",
            "HAS_DERIVATIVES": str(int("directional_derivatives" in program.entries)),
        }
        text = read_template("fmu.c") + read_template(f"fmi{self._fmi}.c")
        return self._sources.fill(text, further)

    def description(self) -> str:
        """modelDescription.xml."""
        fmi, values, machine = self._fmi, self._values, self._program.machine
        token = {"instantiationToken": self._token} if fmi == 3 else {
            "guid": self._token, "numberOfEventIndicators": str(values.layout.parts["events"])
        }  # fmt: skip
        root = ET.Element(
            "fmiModelDescription", fmiVersion=f"{fmi}.0", modelName=machine.name, **token,
            description=f"{machine.name}, written by crane", variableNamingConvention="structured",
            generationTool=f"crane {crane.__version__}",
        )  # fmt: skip
        state, ends = ("FMUState", "s") if fmi == 3 else ("FMUstate", "")
        has_derivatives = "directional_derivatives" in self._program.entries
        abilities = {
            "modelIdentifier": self.name, f"canGetAndSet{state}": "true",
            f"canSerialize{state}": "true",
            f"providesDirectionalDerivative{ends}": str(has_derivatives).lower(),
        }  # fmt: skip
        steps = {"canHandleVariableCommunicationStepSize": "true"}
        steps |= {"canInterpolateInputs": "true"} if fmi == 2 else {}
        for kind, further in (("ModelExchange", {}), ("CoSimulation", steps)):
            element = ET.SubElement(root, kind, {**abilities, **further})
            if fmi == 2:
                files = ET.SubElement(element, "SourceFiles")
                for name in ("fmu.c", f"{self.name}.c"):
                    ET.SubElement(files, "File", name=name)
        units = ET.SubElement(root, "UnitDefinitions")
        for unit in sorted({x.unit for x in values.variables} - {""}):
            base = {name: str(power) for name, power in base_unit(unit).items()}
            ET.SubElement(ET.SubElement(units, "Unit", name=unit), "BaseUnit", base)
        categories = ET.SubElement(root, "LogCategories")
        ET.SubElement(categories, "Category", name="logStatus", description="warnings and errors")
        ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime="10", stepSize="0.01")
        variables = ET.SubElement(root, "ModelVariables")
        for variable in values.variables:
            self._add_variable(variables, variable)
        self._add_structure(ET.SubElement(root, "ModelStructure"))
        return _xml(root)

    def _add_variable(self, parent: ET.Element, variable: FmuVariable) -> None:
        attributes = {"name": variable.name, "valueReference": str(variable.reference)}
        attributes |= _ATTRIBUTES[variable.kind]
        number = {"unit": variable.unit} if variable.unit else {}
        if variable.kind in (INPUT, TUNABLE, FIXED, STATE_START, GUESS):
            number["start"] = repr(variable.start)
        if variable.state >= 0:
            number["derivative"] = self._index(variable.state)
        if self._fmi == 3:
            ET.SubElement(parent, "Float64", {**attributes, **number})
        else:
            ET.SubElement(ET.SubElement(parent, "ScalarVariable", attributes), "Real", number)

    def _index(self, reference: int) -> str:
        """What names a variable: its value reference, in FMI 2 its place from 1 on."""
        return str(reference if self._fmi == 3 else self._places[reference])

    @cached_property
    def _places(self) -> dict[int, int]:
        return {x.reference: i for i, x in enumerate(self._values.variables, start=1)}

    def _add_structure(self, structure: ET.Element) -> None:
        values, fmi = self._values, self._fmi
        derivatives = [x for x in values.variables if x.state >= 0]
        outputs = [x for x in values.variables if x.kind in (STATE_START, GUESS, OUTPUT)]
        initial = [x for x in values.variables if x.kind in (GUESS, OUTPUT)]
        local = [x for x in values.variables if x.reference in values.states and x.kind == LOCAL]
        events = [x for x in values.variables if x.name.startswith("event_indicator[")]
        lists = {
            "Outputs": ("Output", outputs),
            "Derivatives": ("ContinuousStateDerivative", derivatives),
            "InitialUnknowns": ("InitialUnknown", [*initial, *local, *derivatives]),
        }
        if fmi == 3:
            lists["EventIndicators"] = ("EventIndicator", events)
        for name, (element, unknowns) in lists.items():
            parent = structure if fmi == 3 else ET.SubElement(structure, name)
            for unknown in sorted(unknowns):
                attribute = "valueReference" if fmi == 3 else "index"
                given = {attribute: self._index(unknown.reference)}
                known = values.dependencies.get(unknown.reference)
                if known is not None and name != "InitialUnknowns":
                    given["dependencies"] = " ".join(map(self._index, known))
                ET.SubElement(parent, element if fmi == 3 else "Unknown", given)

    def _documentation(self, about: str) -> str:
        rows = "".join(
            f"<tr><td>{escape(x.name)}</td><td>{x.unit}</td>"
            f"<td>{_ATTRIBUTES[x.kind]['causality']}</td><td>{x.start:.6g}</td></tr>\n"
            for x in self._values.variables
        )
        title = escape(self._program.machine.name)
        return (
            f'<!DOCTYPE html><html><head><meta charset="utf-8"><title>{title}</title></head><body>'
            f"<h1>{title}</h1>{about}<p>Written by crane {crane.__version__}.</p><table>"
            f"<tr><th>variable</th><th>unit</th><th>kind</th><th>start</th></tr>\n{rows}</table>"
            "</body></html>\n"
        )


def compile_libraries(sources: Mapping[str, str], name: str) -> dict[str, bytes]:
    """Shared libraries of sources by platform.

    Raises:
        InputError: There is no compiler, or it fails.
    """
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(
        platform.machine().lower(), platform.machine().lower()
    )
    own = f"{machine}-{platform.system().lower()}"
    zig = [sys.executable, "-m", "ziglang", "cc"] if importlib.util.find_spec("ziglang") else []
    compiler = os.environ.get("CC") or next(filter(shutil.which, ("cc", "gcc", "clang")), "")
    commands = {
        key: [*zig, "-target", x[2], "-s"] for key, x in _PLATFORMS.items() if zig and x[2]
    }
    if own in _PLATFORMS and own not in commands and compiler:
        commands[own] = [*compiler.split(), "-fPIC"]
    if not commands:
        raise InputError(
            f"no C compiler is here for the library of an FMU on {own}: pip install "
            "'crane-dynamics[fmu]', or install gcc or clang"
        )
    if not zig:
        warnings.warn(
            f"the FMU has a library for {own} alone, not for Windows and other processors: pip "
            "install 'crane-dynamics[fmu]' for these; its C sources are inside",
            CraneWarning,
            stacklevel=2,
        )
    with tempfile.TemporaryDirectory() as folder:
        for file, text in sources.items():
            (Path(folder) / file).write_text(text, encoding="utf-8")
        processes = {}
        for key, command in commands.items():
            (Path(folder) / key).mkdir()
            output = f"{key}/{name}{_PLATFORMS[key][1]}"
            line = [*command, *_FLAGS, "fmu.c", f"{name}.c", "-o", output, "-lm"]
            processes[key] = subprocess.Popen(
                line, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            )
        found = {}
        for key, process in processes.items():
            _, errors = process.communicate()
            if process.returncode:
                first = next(iter(errors.strip().splitlines()), f"status {process.returncode}")
                raise InputError(f"the C compiler for {key} fails: {first}")
            found[key] = (Path(folder) / key / f"{name}{_PLATFORMS[key][1]}").read_bytes()
        return found


def _limits(machine: Machine) -> list[list[float]]:
    """(n, 6) limits of the start, of joints without end stops, and of pistons in cylinders."""
    columns = machine.closure.active.tolist()
    slack = limit_tolerances(machine)[columns]
    stops = {stop.joint for stop in machine.end_stops}
    cylinders = machine.hydraulics.cylinders if machine.hydraulics is not None else {}
    rows = []
    for joint, lower, upper, gap in zip(
        machine.active, machine.lower, machine.upper, slack, strict=True
    ):
        start = [float(lower - gap), float(upper + gap)]
        stop = [-inf, inf] if joint in stops else start
        cylinder, piston = cylinders.get(joint), [-inf, inf]
        if cylinder is not None and not cylinder.motor:
            piston = [float(lower - cylinder.hose_a / cylinder.area_a),
                      float(upper + cylinder.hose_b / cylinder.area_b)]  # fmt: skip
        rows.append([*start, *stop, *piston])
    return rows


def _numbers(values: Iterable[float]) -> str:
    """Numbers of C in a list."""
    return ", ".join(repr(x).replace("inf", "INFINITY") for x in values)


def _xml(root: ET.Element) -> str:
    ET.indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode")
