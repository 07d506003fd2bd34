"""Circuit parameters that are impossible or in units other than SI."""

import warnings

import numpy as np
import pytest
from hydraulic_rig import COMPENSATED, ORIFICE, rig
from warned import without_a_word

import crane
from crane.common.errors import CraneWarning, DescriptionError, InputError
from crane.common.plausible_ranges import (
    PLAUSIBLE_RANGES,
    RANGES_BY_COMPONENT,
    ROTARY_RANGES,
    implausible_value_text,
)
from crane.control import ValveSignals
from crane.formats import check
from crane.hydraulics import Supply


def told(folder, **numbers):
    """The only line that a rig with these numbers is answered with, and whether it is refused."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CraneWarning)
        try:
            rig(folder, **numbers)
            refused = ""
        except DescriptionError as error:
            refused = str(error)
    lines = [str(one.message) for one in caught]
    report = check(folder / "rig.yaml")
    assert len(report.findings) == 1, report.findings
    (finding,) = report.findings
    assert finding.is_error == bool(refused)
    line = refused or lines[0]
    assert line == f"{finding.file}:{finding.line}: {finding.message}" and "\n" not in line
    written = (folder / "rig.yaml").read_text().splitlines()[finding.line - 1]
    assert written.split(":")[0].strip() in line  # points at the key
    return line, bool(refused)


@pytest.mark.parametrize(
    ("numbers", "line"),
    [
        ({"supply": {"pressure": 350}}, "is 350 Pa, not above the tank's 100000 Pa, so that "
         "nothing would flow: looks like bar, write 350e5"),
        ({"supply": {"pressure": 0.2}}, "looks like MPa, write 0.2e6"),
        ({"supply": {"pressure": 2e5, "tank": 3e5}}, "not above the tank's 300000 Pa"),
        ({"supply": {"pressure": 0}}, "give a little more for a pump that rests"),
        ({"supply": {"tank": 0}}, "count from a vacuum, write 1e5 for an open tank"),
        ({"supply": {"tank": 2}}, "the oil boils at 1000 Pa: looks like bar, write 2e5"),
        ({"cylinder": {"relief": 390}}, "it would never close: looks like bar, write 390e5"),
        ({"cylinder": {"area_b": 0}}, "area_b of the cylinder of 'x' is 0, it must be positive"),
        ({"cylinder": {"hose_a": 0}}, "hose_a of the cylinder of 'x' is 0, it must be positive"),
        ({"cylinder": {"area_a": -1e-3}}, "give at least 0"),
        ({"oil": {"bulk_modulus": 0}}, "bulk_modulus of the oil is 0, it must be positive"),
        ({"valve": COMPENSATED | {"flow": 0}}, "'flow' is 0, give the flow at full stroke"),
        ({"valve": COMPENSATED | {"margin": 0}}, "'margin' is 0, give the pressure drop"),
        ({"valve": COMPENSATED | {"c1": 4e-7}}, "'flow' stands beside 'c1', keep one of them"),
        ({"valve": ORIFICE | {"margin": 7e5}}, "'margin' is for valves of type 'compensated'"),
        ({"valve": COMPENSATED | {"dead_band": 11.43}}, "looks like percent, write 0.1143"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(tmp_path, numbers, line):
    found, refused = told(tmp_path, **numbers)
    assert refused and line in found


@pytest.mark.parametrize(
    ("numbers", "line"),
    [
        ({"supply": {"flow": 426}}, "'flow' of 'supply' is 426 m3/s, usual are 1e-08 to 0.05: "
         "looks like l/min, write 0.0071"),
        ({"supply": {"pressure": 3.5e8}}, "usual are 100000 to 7e+07, look at its unit"),
        ({"supply": {"droop": 3}}, "looks like bar, write 3e5 or MPa, write 3e6"),
        ({"supply": {"volume": 2}}, "looks like l, write 2e-3"),
        ({"oil": {"bulk_modulus": 14000}}, "looks like bar, write 14000e5"),
        ({"oil": {"bulk_modulus": 1.4}}, "looks like GPa, write 1.4e9"),
        ({"oil": {"steel_modulus": 210}}, "looks like GPa, write 210e9"),
        ({"cylinder": {"area_a": 7853.98}}, "is 7853.98 m2, usual are 1e-06 to 0.2: looks like "
         "mm2, write 7853.98e-6"),
        ({"cylinder": {"area_a": 100.5}}, "looks like cm2, write 100.5e-4"),
        ({"cylinder": {"hose_a": 0.19}}, "looks like l, write 0.19e-3"),
        ({"cylinder": {"hose_a": 190}}, "looks like cm3, write 190e-6"),
        ({"cylinder": {"leakage_a": 20}}, "looks like ml/min per bar, write 3.333e-12"),
        ({"cylinder": {"cushion": 30}}, "looks like mm, write 30e-3"),
        ({"cylinder": {"refill": 45.5}}, "looks like l/min per root of bar, write 2.398e-06"),
        ({"cylinder": {"relief": 8e6}}, "not above the supply's 9.25e+06 Pa: what the pump gives"),
        ({"valve": ORIFICE | {"c3": 15.119}}, "'c3' of valve of 'x' is 15.119"),
        ({"valve": COMPENSATED | {"flow": 40}}, "looks like l/min, write 0.0006667"),
        ({"valve": COMPENSATED | {"margin": 7, "meter_out": 8e-7}}, "looks like bar, write 7e5"),
    ],
)  # fmt: skip
def test_another_unit_is_told(tmp_path, numbers, line):
    found, refused = told(tmp_path, **numbers)
    assert not refused and line in found


@pytest.mark.parametrize(
    "numbers",
    [
        {},
        {"valve": COMPENSATED},
        # a syringe's piston of 4 mm, and its hand pump
        {"supply": {"pressure": 4e5, "flow": 2e-7, "volume": 1e-6, "droop": 2e4},
         "cylinder": {"area_a": 1.3e-5, "area_b": 9.4e-6, "hose_a": 2e-8, "hose_b": 2e-8},
         "valve": dict.fromkeys(("c1", "c2", "c3", "c4"), 2e-10) | {"type": "orifice"}, "mass": 2},
        # chamber B without the rod: the rod pulls in the joint's positive direction
        {"cylinder": {"area_a": 5.4e-3, "area_b": 7.9e-3}},
        # a press
        {"supply": {"pressure": 6e7, "flow": 0.03},
         "cylinder": {"area_a": 0.15, "area_b": 0.1, "hose_a": 0.02, "hose_b": 0.02,
                      "relief": 6.6e7}},
    ],
)  # fmt: skip
def test_what_is_usual_is_not_doubted(tmp_path, numbers):
    without_a_word(rig, tmp_path, **numbers)
    assert check(tmp_path / "rig.yaml").status == 0


@pytest.mark.filterwarnings("ignore:parameter 'supply.tank':crane.CraneWarning")
def test_changes_are_looked_at_together():
    """A higher tank needs a higher supply: it is not refused for the one that comes first."""
    changes = {"supply.tank": 1e7, "supply.pressure": 2e7}
    assert crane.load("patu655", changes).hydraulics.supply.tank == 1e7
    with pytest.raises(InputError, match="nothing would flow: looks like bar, write 92e5"):
        crane.load("patu655", {"supply.pressure": 92})
    with pytest.raises(InputError, match="is 210 Pa, not above the tank's"):
        crane.load("patu655", {"cylinder.X_tilt.relief": 210})
    with pytest.warns(CraneWarning, match=r"parameter 'cylinder.slew.area_a' is 1414 m3/rad"):
        crane.load("patu655", {"cylinder.slew.area_a": 1414.0})


def test_parts_and_signals_by_hand():
    with pytest.raises(InputError, match="looks like bar, write 350e5"):
        Supply(pressure=350)
    machine = crane.load("patu655")
    with pytest.raises(InputError, match="at most, far below the tank's: looks like bar"):
        ValveSignals(machine, [0.0, 1.0], {}, supply=[92, 95])
    with pytest.raises(InputError, match=r"signals are a list, give those of each valve by its j"):
        ValveSignals(machine, [0.0, 1.0], [0.0, 1.0])
    ValveSignals(machine, [0.0, 1.0], {}, supply=[0.5e5, 9e6])  # the pump is switched on


@pytest.mark.parametrize(
    ("kind", "name"),
    [*(("", x) for x in sorted({*PLAUSIBLE_RANGES, *ROTARY_RANGES})), *RANGES_BY_COMPONENT],
)
def test_proposals_are_usual(kind, name):
    """Whatever unit is proposed, the number as it is to be written gives no doubt again."""
    for turning in (False, True):
        for value in np.logspace(-12, 14, 80):
            text = implausible_value_text(name, float(f"{value:.3g}"), turning, kind)
            for words in text.split("write ")[1:]:
                proposed = float(words.split()[0])
                assert not implausible_value_text(name, proposed, turning, kind), text
