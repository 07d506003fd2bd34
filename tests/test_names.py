"""Names are terms of the field, see `docs/glossary.md`."""

import ast
import inspect
import re
from collections import defaultdict

import pytest
from package_source import PACKAGE, nodes

import crane

# What one word alone may name. A name of several words says more, and needs no list.
CLASSES = """
Accumulator Batch Breakout Buckling Calibration Capacity Chain Chart Checkpoint Closure Cluster
Comparison Contact Controller Coordinates Coupling Cylinder Derivatives Design Dimension Drawing
Drive Dynamics Engine Estimate Excitation Finding Findings Flow Formula Friction Gearbox
Gradient Ground Hydraulics Identification Inertial Jackknife Joint Key Kinematics Layout Limits
Link Machine Mode Motion Oil Payload Phase Playback Program Reactions Readout Recording
Regressor Remedy Result Rope Routine Rule Scene Sensitivities Sensor Session Soil Spool Strokes
Study Supply Sway Table Tape Task Torques Trajectory Transmission Tree Unknown Valve Visual
Workspace Wrench _Line _Stream _Subtree
"""
FILES = """
attitude batch buckling calibrate charts checkpoint closure clusters command components coordinates
describe design differentiation drawing dynamics entry errors estimators exchange findings
identifiability identify integrators kinematics levers linearization logs machine measures
misfit notebook npz options parsing payload plausibility priors program progress radau rate
reactions recording regressor result rosenbrock samples scene sensors serialization show simulate
specification statics strokes sway symbolic terminal threads timeseries trajectory transmission
trim units unknowns
"""
# Words that name nothing by themselves, whatever else stands beside them in a class.
EMPTY = """
About Above Against Alone Along Anything Asked At Beside Beyond Found Give Given Held Here Kept
Lacking Left Matter Own Said Seen Sought There Together Told Way What When Where
"""


def classes():
    """Files that define a class, by its name."""
    found = defaultdict(set)
    for path in PACKAGE.rglob("*.py"):
        for node in nodes(path):
            if isinstance(node, ast.ClassDef):
                found[node.name].add(path.relative_to(PACKAGE))
    return found


def words(name):
    return re.findall(r"[A-Z]+(?![a-z])|[A-Z][a-z0-9]*", name)


def test_a_class_name_stands_once_in_the_package():
    assert not {name: files for name, files in classes().items() if len(files) > 1}


def test_one_word_alone_names_a_class_only_if_it_is_a_term():
    alone = {name for name in classes() if len(words(name)) <= 1 and name[:1] + name[1:] != "PI"}
    assert not alone - {*CLASSES.split(), "error_recovery"}


def test_no_class_is_named_by_a_word_that_names_nothing():
    assert not {name for name in classes() if {*EMPTY.split()} & {*words(name)}}


def test_one_word_alone_names_a_file_only_if_it_is_a_term():
    alone = {x.stem for x in PACKAGE.rglob("*.py") if "_" not in x.stem}
    assert not alone - {*FILES.split()}


def test_the_root_keeps_what_short_programs_need():
    names = {name for name in crane.__all__ if not inspect.ismodule(getattr(crane, name))}
    assert len(names) <= 36
    assert {"load", "simulate", "replay", "identify", "report", "Dynamics", "Recording"} <= names


def test_a_name_of_a_submodule_is_found_by_the_message():
    with pytest.raises(AttributeError, match="use crane.recordings.limit_cycles"):
        _ = crane.limit_cycles
    with pytest.raises(AttributeError, match="names_0_3"):
        _ = crane.retimed


def test_submodules_list_what_they_define():
    """The stubs name what is there, and each name once in the package."""
    submodules = [
        x for x in (getattr(crane, name) for name in crane.__all__) if inspect.ismodule(x)
    ]
    listed = [name for module in submodules for name in module.__all__]
    for module in submodules:
        for name in module.__all__:
            assert getattr(module, name) is not None
    assert len({*listed}) == len(listed)
