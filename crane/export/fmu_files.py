"""A machine as a Functional Mock-up Unit (FMU) of FMI 3 or 2."""

import hashlib
import warnings
import zipfile
from html import escape
from math import inf
from pathlib import Path
from xml.etree import ElementTree as ET

import crane
from crane.common.atomic_output import check_file_is_writable, replace_file
from crane.common.errors import CraneWarning, check_name
from crane.control.control_law import Controller
from crane.control.valve_commands import ValveCommand
from crane.export.c_sources import CSources, c_numbers
from crane.export.fmu_libraries import PLATFORMS, compile_libraries, library_compilers
from crane.export.fmu_variables import FmuVariable, FmuVariables, base_unit
from crane.export.instance_program import InstanceProgram
from crane.export.instance_routines import STATUS_TEXTS
from crane.formats.machine_loading import load
from crane.machine.machine import Machine
from crane.motion.limit_violations import limit_tolerances
from crane.simulation.integration.stick_slip_modes import EVENT_TOLERANCE

VERSIONS = ("3", "2")
_DATE = (1980, 1, 1, 0, 0, 0)  # of all members, so that equal machines give equal files
# words of C that differ between the versions
_WORDS = {
    3: {"FLAG": "bool", "STATE": "State", "DESERIALIZE": "DeserializeFMUState",
        "GET_DERIVATIVES": "GetContinuousStateDerivatives", "LOGGER_NAME": "",
        "REAL": "Float64", "BEGIN": "EnterInitializationMode",
        "LOGGER": "int, const char *, const char *"},
    2: {"FLAG": "int", "STATE": "state", "DESERIALIZE": "DeSerializeFMUstate",
        "GET_DERIVATIVES": "GetDerivatives", "LOGGER_NAME": "c->name, ", "REAL": "Real",
        "BEGIN": "SetupExperiment",
        "LOGGER": "const char *, int, const char *, const char *, ..."},
}  # fmt: skip


def write_fmu(
    machine: Machine | str | Path,
    path: str | Path,
    fmi: int = 3,
    *,
    controller: Controller | ValveCommand | None = None,
    overwrite: bool = True,
    icon: bytes = b"",
    about: str = "",
) -> Path:
    """Write a machine as an FMU for model exchange and co-simulation, with its C sources.

    Inputs are those of `InstanceProgram`. Valves with dead times have co-simulation alone. With
    ziglang it has libraries for Windows and Linux,
    else one for this computer, by its C compiler.

    Args:
        machine: The machine, or what `crane.load` takes.
        path: The .fmu file.
        fmi: Version of FMI, 3 or 2.
        controller: See `InstanceProgram`; the inputs are forces or valve signals without it.
        overwrite: Whether the file is replaced.
        icon: A PNG file of the machine.
        about: HTML about the machine, for its documentation.

    Returns:
        The path.

    Raises:
        InputError: See `InstanceProgram`; or there is no C compiler.
        OutputError: The file cannot be written.
    """
    check_name(str(fmi), VERSIONS, f"FMI {fmi} is not written")
    check_file_is_writable(Path(path), overwrite)
    compilers = library_compilers()
    loaded = machine if isinstance(machine, Machine) else load(machine)
    program = InstanceProgram(loaded, (), controller=controller, has_derivatives=True)
    if program.has_dead_times:
        warnings.warn(
            f"valves of '{loaded.name}' have a dead time: the FMU has co-simulation, and no model "
            "exchange, whose states cannot remember signals",
            CraneWarning,
            stacklevel=2,
        )
    files = FmuFiles(program, fmi)
    members = files.members(icon, about)
    for key, library in compile_libraries(compilers, files.sources, files.name).items():
        platform = PLATFORMS[key]
        folder = key if fmi == 3 else platform.name_in_fmi2
        members[f"binaries/{folder}/{files.name}{platform.suffix}"] = library
    with replace_file(path) as output, zipfile.ZipFile(output, "w") as archive:
        for name, content in members.items():
            member = zipfile.ZipInfo(name, _DATE)
            member.external_attr = 0o644 << 16
            archive.writestr(member, content, zipfile.ZIP_DEFLATED)
    return Path(path)


class FmuFiles:
    """The files of an FMU.

    Args:
        program: The machine.
        fmi: Version of FMI, 3 or 2.

    Attributes:
        name: The model identifier.
        sources: C sources by file.
    """

    def __init__(self, program: InstanceProgram, fmi: int):
        self._program, self._fmi, self._c = program, fmi, CSources(program)
        self._values, self.name = FmuVariables(program), self._c.name
        self._variables = self._values.variables
        self._places = {x.reference: i for i, x in enumerate(self._variables, start=1)}
        self.sources = {f"{self.name}.h": self._c.header(), f"{self.name}.c": self._c.source()}
        self._names = [f'[{x.reference}] = "{x.kind}{x.name}",' for x in self._variables]
        text = "".join((crane.__version__, str(fmi), *self.sources.values(), *self._names))
        self._token = hashlib.sha256(text.encode()).hexdigest()
        self.sources["fmu.c"] = self._runtime()
        self._source_files = ("fmu.c", f"{self.name}.c")

    def members(self, icon: bytes, about: str) -> dict[str, str | bytes]:
        """Contents of all files by path, without libraries; see `write_fmu`."""
        found: dict[str, str | bytes] = {
            "modelDescription.xml": self.description(),
            "documentation/index.html": self._documentation(about),
            **{f"sources/{name}": text for name, text in self.sources.items()},
        }
        if self._fmi == 2:
            return found | ({"model.png": icon} if icon else {})
        root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
        build = ET.SubElement(root, "BuildConfiguration", modelIdentifier=self.name)
        files = ET.SubElement(build, "SourceFileSet", language="C99")
        files.extend(ET.Element("SourceFile", name=name) for name in self._source_files)
        found["sources/buildDescription.xml"] = _xml(root)
        if icon:
            root = ET.Element("fmiTerminalsAndIcons", fmiVersion="3.0")
            picture = ET.SubElement(root, "GraphicalRepresentation")
            corners = {"x1": "-100", "y1": "-100", "x2": "100", "y2": "100"}
            ET.SubElement(picture, "CoordinateSystem", corners, suggestedScalingFactorTo_mm="0.1")
            ET.SubElement(picture, "Icon", corners)
            found["terminalsAndIcons/terminalsAndIcons.xml"] = _xml(root)
            found["terminalsAndIcons/icon.png"] = icon
        return found

    def _runtime(self) -> str:
        """The C source between the functions of FMI and those of the machine."""
        values, program, machine = self._values, self._program, self._program.machine
        layout, events = values.layout, program.routines.event_parts
        indices = {
            "SIZE": layout.size, "STATE_SIZE": program.chart.state_layout.size,
            "OUTPUT_SIZE": program.output_count, "HAS_MARGIN": int("margin" in events),
            **{x.upper(): layout.start_index(x) for x in layout.parts},
            **{f"{x.upper()}_SIZE": size for x, size in layout.parts.items()},
        }  # fmt: skip
        stubs = {
            "event_indicators": "(m, x) 1", "tip": "(m, q, v, tip) ((void)(m), 1)",
            "set_payload": "(m, payload) ((void)(payload), 1)",
            "directional_derivatives": "(m, direction, x) (-3)",
        }  # fmt: skip
        further = {
            **_WORDS[self._fmi], "FMI": str(self._fmi), "ID": f"0x{self._token[:16]}",
            "TOKEN": self._token, "MARGIN_SHIFT": str(1.5 * EVENT_TOLERANCE),
            "INDICES": ",\n    ".join(f"{key} = {x}" for key, x in indices.items()),
            "STUBS": "\n".join(
                f"#define {self.name}_{x}{text}"
                for x, text in stubs.items() if x not in program.entries
            ),
            "NAMES": "\n    ".join(self._names),
            "ACTIVE": c_numbers(machine.closure.active.tolist()),
            "STATES": c_numbers(values.states), "NOMINALS": c_numbers(values.nominals.tolist()),
            "LIMITS": ",\n    ".join(f"{{{c_numbers(row)}}}" for row in _limits(machine)),
            "REASONS": ", ".join(f'"{text}"' for text in STATUS_TEXTS.values()),
            "ROTATIONS": "".join(f"{x}, " for x in machine.coordinates.rotation_columns),
        }  # fmt: skip
        return self._c.fill("fmu.c", further) + self._c.fill(f"fmi{self._fmi}.c", further)

    def description(self) -> str:
        """modelDescription.xml."""
        fmi, machine = self._fmi, self._program.machine
        events = str(self._values.layout.parts["event"])
        own: dict[str, str] = {"instantiationToken": self._token}
        if fmi == 2:
            own = {"guid": self._token, "numberOfEventIndicators": events}
        root = ET.Element(
            "fmiModelDescription", own, fmiVersion=f"{fmi}.0", modelName=machine.name,
            description=f"{machine.name}, written by crane", variableNamingConvention="structured",
            generationTool=f"crane {crane.__version__}",
        )  # fmt: skip
        state, end = ("FMUState", "s") if fmi == 3 else ("FMUstate", "")
        abilities = {
            "modelIdentifier": self.name, f"canGetAndSet{state}": "true",
            f"canSerialize{state}": "true",
            f"providesDirectionalDerivative{end}":
                str("directional_derivatives" in self._program.entries).lower(),
        }  # fmt: skip
        steps = {"canHandleVariableCommunicationStepSize": "true"}
        steps |= {"canInterpolateInputs": "true"} if fmi == 2 else {}
        kinds = {"ModelExchange": {}, "CoSimulation": steps}
        for kind, further in [*kinds.items()][self._program.has_dead_times :]:
            element = ET.SubElement(root, kind, {**abilities, **further})
            if fmi == 2:
                files = ET.SubElement(element, "SourceFiles")
                files.extend(ET.Element("File", name=name) for name in self._source_files)
        units = ET.SubElement(root, "UnitDefinitions")
        for unit in sorted({x.unit for x in self._variables} - {""}):
            base = {name: str(power) for name, power in base_unit(unit).items()}
            ET.SubElement(ET.SubElement(units, "Unit", name=unit), "BaseUnit", base)
        categories = ET.SubElement(root, "LogCategories")
        ET.SubElement(categories, "Category", name="logStatus", description="warnings and errors")
        ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime="10", stepSize="0.01")
        variables = ET.SubElement(root, "ModelVariables")
        for variable in self._variables:
            self._add_variable(variables, variable)
        self._add_structure(ET.SubElement(root, "ModelStructure"))
        return _xml(root)

    def _add_variable(self, parent: ET.Element, variable: FmuVariable) -> None:
        attributes = {"name": variable.name, "valueReference": str(variable.reference)}
        attributes |= variable.attributes
        number = {"unit": variable.unit} if variable.unit else {}
        if variable.has_start:
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

    def _add_structure(self, structure: ET.Element) -> None:
        outputs = [x for x in self._variables if x.attributes["causality"] == "output"]
        derivatives = [x for x in self._variables if x.state >= 0]
        computed = {x.reference for x in [*outputs, *derivatives]} | {x.state for x in derivatives}
        unknowns = {
            "Output": outputs,
            "ContinuousStateDerivative": derivatives,
            "InitialUnknown": [
                x for x in self._variables
                if x.reference in computed and x.attributes["initial"] != "exact"
            ],
            "EventIndicator": [x for x in self._variables if x.name.startswith("event_indicator")],
        }  # fmt: skip
        names = {"Output": "Outputs", "ContinuousStateDerivative": "Derivatives",
                 "InitialUnknown": "InitialUnknowns"}  # fmt: skip
        for kind in unknowns if self._fmi == 3 else names:
            parent = structure if self._fmi == 3 else ET.SubElement(structure, names[kind])
            for variable in unknowns[kind]:
                self._add_unknown(parent, kind, variable)

    def _add_unknown(self, parent: ET.Element, kind: str, variable: FmuVariable) -> None:
        attribute = "valueReference" if self._fmi == 3 else "index"
        given = {attribute: self._index(variable.reference)}
        known = self._values.dependencies.get(variable.reference)
        if known is not None and kind != "InitialUnknown":
            given["dependencies"] = " ".join(map(self._index, known))
        ET.SubElement(parent, kind if self._fmi == 3 else "Unknown", given)

    def _documentation(self, about: str) -> str:
        title = escape(self._program.machine.name)
        return (
            f'<!DOCTYPE html><html><head><meta charset="utf-8"><title>{title}</title></head><body>'
            f"<h1>{title}</h1>{about}<p>Written by crane {crane.__version__}.</p></body></html>\n"
        )


def _limits(machine: Machine) -> list[list[float]]:
    """(n, 6) limits of the start, of joints without end stops, and of pistons in cylinders."""
    slack = limit_tolerances(machine)[machine.closure.active]
    stops = {stop.joint for stop in machine.end_stops}
    cylinders = machine.hydraulics.cylinders if machine.hydraulics is not None else {}
    rows = []
    for i, joint in enumerate(machine.active):
        lower, upper, cylinder = machine.lower[i], machine.upper[i], cylinders.get(joint)
        start, piston = [lower - slack[i], upper + slack[i]], [-inf, inf]
        if cylinder is not None and not cylinder.motor:
            piston = [lower - cylinder.hose_a / cylinder.area_a,
                      upper + cylinder.hose_b / cylinder.area_b]  # fmt: skip
        rows.append([*start, *([-inf, inf] if joint in stops else start), *piston])
    return rows


def _xml(root: ET.Element) -> str:
    ET.indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode")
