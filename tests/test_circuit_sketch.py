"""Circuit diagrams: every component once with its label, connected lines that touch no other."""

import itertools
from collections import Counter
from dataclasses import replace

import diagram_circuits as circuits
import pytest
from command_line import typed
from full_circuit import everything
from matplotlib.backends.backend_agg import FigureCanvasAgg
from test_sketch import overlaps

import crane
from crane.common.errors import InputError
from crane.hydraulics.circuit_elements import TANK_NODE
from crane.view.sketches.circuit import circuit_figure
from crane.view.sketches.circuit.valve_symbols import (
    format_displacement,
    format_flow,
    format_pressure,
)

pytestmark = pytest.mark.slow


def counted(folder, kind, count):
    """A circuit with so many functions."""
    return getattr(circuits, kind)(folder, count)


BUNDLED = ("patu655", "excavator", "excavator_two_pumps")
CASES = {
    "everything": everything,
    "long names": circuits.long_names,
    "tapped": circuits.everything_tapped,
    **{f"{kind} {n}": lambda folder, kind=kind, n=n: counted(folder, kind, n)
       for kind in ("sensing", "sharing", "two_pumps") for n in (1, 4, 5, 8)},
}  # fmt: skip


@pytest.fixture(scope="module")
def drawings(tmp_path_factory):
    """By name machine, figure and ink."""
    machines = {name: make(tmp_path_factory.mktemp("rig")) for name, make in CASES.items()}
    machines |= {name: crane.load(name) for name in BUNDLED}
    return {name: (machine, *circuit_figure(machine)) for name, machine in machines.items()}


def gids(drawn):
    """How often each name of a symbol is drawn."""
    axes = drawn.axes[0]
    every = [x.get_gid() for x in (*axes.patches, *axes.lines)]
    return Counter(gid for gid in every if gid and not gid.startswith(("wire ", "dot ")))


def expected(hydraulics):
    """Names of the symbols that a circuit must have."""
    names = ["tank", *(["engine"] if hydraulics.engine else [])]
    names += [f"pump {name}" for name in hydraulics.pumps]
    names += [f"regulator {name}" for name, x in hydraulics.pumps.items() if x.control != "fixed"]
    names += [f"relief {name}" for name, x in hydraulics.pumps.items() if x.relief]
    names += [f"accumulator {name}" for name in hydraulics.accumulators]
    names += [f"element {name}" for name in hydraulics.elements]
    for joint, cylinder in hydraulics.cylinders.items():
        valve = hydraulics.valves[joint]
        names.append(f"valve {joint}")
        names += [f"compensator {joint}"] * bool(valve.margin or valve.sharing)
        names += [f"metering {joint}"] * valve.sharing
        names += [f"regeneration {joint}"] * bool(valve.regeneration)
        for side in "ab":
            chamber = f"{joint}.{side}"
            names += [f"relief {chamber}"] * bool(cylinder.relief)
            names += [f"suction {chamber}"] * bool(cylinder.refill)
            names += [f"cross {chamber}"] * bool(cylinder.cross_relief)
            names += [f"rupture {chamber}"] * bool(getattr(cylinder, f"rupture_{side}"))
            held = getattr(cylinder, f"counterbalance_{side}")
            names += [f"counterbalance {chamber}", f"counterbalance {chamber} check"] * bool(held)
    return names


def test_every_part_is_drawn_once(drawings):
    for name, (machine, drawn, _) in drawings.items():
        found, wanted = gids(drawn), expected(machine.hydraulics)
        assert {x: found[x] for x in wanted} == dict.fromkeys(wanted, 1), name
        drives = [x for x in found if x.split()[0] in ("cylinder", "motor", "rotary")]
        assert sorted(x.split()[-1] for x in drives) == sorted(machine.hydraulics.joints), name
        kinds = {"valve", "compensator", "relief", "suction", "cross", "rupture", "pump",
                 "accumulator", "element", "counterbalance", "regeneration"}  # fmt: skip
        assert {x for x in found if x.split()[0] in kinds} == {
            x for x in wanted if x.split()[0] in kinds
        }, name


def test_every_part_is_named_with_its_numbers(drawings):
    for name, (machine, drawn, _) in drawings.items():
        said = {}
        for text in drawn.axes[0].texts:
            said.setdefault(text.get_gid(), []).append(text.get_text())
        hydraulics = machine.hydraulics
        for joint, cylinder in hydraulics.cylinders.items():
            assert f"label valve {joint}" in said, name
            if cylinder.relief:
                for side in "ab":
                    assert said[f"label relief {joint}.{side}"] == [
                        format_pressure(cylinder.relief)
                    ]
        for pump, supply in hydraulics.pumps.items():
            assert pump.startswith(said[f"name pump {pump}"][0].rstrip("…"))
            told = said[f"label pump {pump}"]
            assert f"{format_flow(supply.flow)} l/min" in told or not supply.flow
        for part in (*hydraulics.accumulators, *hydraulics.elements):
            assert any(said.get(f"name {kind} {part}") for kind in ("accumulator", "element"))


def test_no_words_overlap(drawings):
    for name, (_, drawn, _) in drawings.items():
        assert overlaps(drawn) == [], name


def test_all_words_are_on_the_sheet(drawings):
    for name, (_, drawn, _) in drawings.items():
        renderer = FigureCanvasAgg(drawn).get_renderer()
        width, height = renderer.get_canvas_width_height()
        for text in drawn.axes[0].texts:
            box = text.get_window_extent(renderer)
            assert box.x0 > 0 and box.y0 > 0, (name, text.get_text())
            assert box.x1 < width and box.y1 < height, (name, text.get_text())


def test_no_words_lie_on_wires_or_symbols(drawings):
    for name, (_, drawn, _) in drawings.items():
        axes = drawn.axes[0]
        renderer = FigureCanvasAgg(drawn).get_renderer()
        lines = [x.get_transform().transform_path(x.get_path()) for x in axes.lines]
        found = []
        for text in axes.texts:
            gid = text.get_gid()
            if gid.startswith(("symbol ", "label regulator ")):
                continue  # stands within its symbol
            box = text.get_window_extent(renderer)
            # a halo's breadth from the ends of lines
            box = box.expanded((box.width - 2) / box.width, (box.height - 2) / box.height)
            if any(path.intersects_bbox(box, filled=False) for path in lines):
                found.append((gid, text.get_text()))
        assert found == [], name


def crosses(one, other):
    """Whether two pieces of wires have more than one point in common."""
    same = [p for p in (one.start, one.end) if other.contains(p)]
    same += [p for p in (other.start, other.end) if one.contains(p)]
    return len({(round(x, 6), round(y, 6)) for x, y in same}) > 1


def test_wires_of_two_nets_touch_nowhere_but_where_they_cross(drawings):
    """No end of a net on a wire of another one, and no two along each other."""
    for name, (_, _, ink) in drawings.items():
        for one, other in itertools.combinations(ink.wires, 2):
            if one.net == other.net:
                continue
            touching = [p for p in (one.start, one.end) if other.contains(p)]
            touching += [p for p in (other.start, other.end) if one.contains(p)]
            assert not [p for p in touching if not tapped(ink, p)], (name, one, other)
            assert not crosses(one, other), (name, one, other)


def tapped(ink, point):
    """Whether the end of an open centre is there, and the signal before its throttle."""
    return any(
        p.position == point and p.component.split()[0] in ("bypass", "throttle") for p in ink.ports
    )


def pieces(ink, net):
    """Wires and ports of a net, in groups that hang together."""
    groups = [([w], []) for w in ink.wires if w.net == net]
    groups += [([], [p]) for p in ink.ports if p.net == net]

    def joined(one, other):
        for wires, ports in ((one, other), (other, one)):
            for wire in wires[0]:
                ends = [p.position for p in ports[1]]
                ends += [at for w in ports[0] for at in (w.start, w.end)]
                if any(wire.contains(at) for at in ends):
                    return True
        return any(p.position == q.position for p in one[1] for q in other[1])

    done = []
    for group in groups:
        near = [other for other in done if joined(group, other)]
        done = [other for other in done if other not in near]
        done.append(([w for g in (*near, group) for w in g[0]],
                     [p for g in (*near, group) for p in g[1]]))  # fmt: skip
    return done


def test_every_net_hangs_together_and_joins_its_ports(drawings):
    """The tank's lines hang together through the tank: each of them ends in its symbol."""
    for name, (machine, _, ink) in drawings.items():
        for net in {x.net for x in (*ink.wires, *ink.ports)}:
            groups = pieces(ink, net)
            if net == TANK_NODE:
                for wires, ports in groups:
                    assert wires and any(p.component.startswith("tank") for p in ports), (
                        name,
                        ports,
                    )
            else:
                assert len(groups) == 1, (name, net)
        for joint, valve in machine.hydraulics.valves.items():
            ways = {(p.component, p.net) for p in ink.ports}
            part = "compensator" if valve.margin else "metering" if valve.sharing else "valve"
            assert (f"{part} {joint}", valve.supply) in ways
            assert (f"valve {joint}", valve.return_a) in ways
            assert (f"valve {joint}", valve.return_b) in ways
            drives = {p for p, n in ways if n in (f"{joint}.a", f"{joint}.b")}
            assert {p.split()[0] for p in drives} & {"cylinder", "motor", "rotary"}


def test_wires_end_at_ports(drawings):
    """An end of a wire is at a port, on another piece, or it is the way to the right of a rail."""
    for name, (_, _, ink) in drawings.items():
        ports = {(p.net, p.position) for p in ink.ports}
        for wire in ink.wires:
            for at in (wire.start, wire.end):
                on = any(w is not wire and w.net == wire.net and w.contains(at) for w in ink.wires)
                left = (
                    at[1] == wire.start[1] == wire.end[1] and at[0] < 160
                )  # begins with its name
                assert on or (wire.net, at) in ports or left, (name, wire)


def test_dots_are_where_wires_meet_and_not_where_they_cross(drawings):
    for name, (_, drawn, ink) in drawings.items():
        for dot in (x for x in drawn.axes[0].patches if (x.get_gid() or "").startswith("dot ")):
            here = {w.net for w in ink.wires if w.contains(dot.center)}
            assert here == {dot.get_gid().removeprefix("dot ")}, name


def test_open_centres_are_in_series(tmp_path):
    """From each pump through all of its valves to its throttle."""
    machine = circuits.two_pumps(tmp_path, 8)
    ink = circuit_figure(machine)[1]
    for pump in ("supply", "second"):
        mine = [j for j, v in machine.hydraulics.valves.items() if v.supply == pump]
        chain = [f"C {pump} {i + 1}" for i in range(len(mine))]
        for i, joint in enumerate(mine):
            nets = [p.net for p in ink.ports if p.component == f"valve {joint}"]
            assert (chain[i - 1] if i else pump) in nets and chain[i] in nets
        assert chain[-1] in [p.net for p in ink.ports if p.component == f"throttle {pump}"]


def test_words_on_pumps(drawings):
    texts, others = (
        {x.get_gid(): x.get_text() for x in drawings[name][1].axes[0].texts}
        for name in ("everything", "long names")
    )
    assert texts["label regulator supply"] == "LS" and texts["label regulator second"] == "NFC"
    assert others["label regulator C"] == "PFC"
    assert "label regulator pump_of_the_slewing_gear_motor" not in others
    said = {x.get_text() for x in drawings["everything"][1].axes[0].texts}
    assert {"72 l/min", "max. 240 bar", "LS + 20 bar", "1814 rpm"} <= said
    assert "15 kW of supply, second" in said


def test_rods_are_where_chamber_a_is_not(tmp_path):
    """A rod in B to the right, in A to the left, and through where both areas are the same."""
    areas = [(7e-3, 5e-3), (5e-3, 7e-3), (5e-3, 5e-3)]
    machine = circuits.circuit(tmp_path, circuits.PLAIN, [{}] * 3, [{}] * 3)
    cylinders = {
        joint: replace(cylinder, area_a=a, area_b=b)
        for (joint, cylinder), (a, b) in zip(
            machine.hydraulics.cylinders.items(), areas, strict=True
        )
    }
    machine = replace(machine, hydraulics=replace(machine.hydraulics, cylinders=cylinders))
    axes = circuit_figure(machine)[0].axes[0]
    shapes = [x.get_path().vertices for x in axes.patches]
    reaches = []
    for joint in machine.hydraulics.joints:
        (barrel,) = [x.get_path().vertices for x in axes.patches
                     if x.get_gid() == f"cylinder {joint}"]  # fmt: skip
        (x0, y0), (x1, y1) = barrel.min(axis=0), barrel.max(axis=0)
        rods = [s for s in shapes if s[:, 1].min() > y0 and s[:, 1].max() < y1
                and s[:, 0].max() > x0 - 30 and s[:, 0].min() < x1 + 30]  # fmt: skip
        (rod,) = [s for s in rods if s[:, 0].min() < x0 or s[:, 0].max() > x1]
        reaches.append((rod[:, 0].min() < x0, rod[:, 0].max() > x1))
    assert reaches == [(False, True), (True, False), (True, True)]


def test_numbers_as_data_sheets_have_them():
    assert format_flow(40 / 6e4) == "40"
    assert format_displacement(1e-5) == "62.8 cm³/rev"


@pytest.mark.parametrize("suffix", ["svg", "pdf", "png"])
def test_the_command(tmp_path, monkeypatch, suffix):
    monkeypatch.chdir(tmp_path)
    done = typed("sketch", "patu655", "--circuit", "--out", f"circuit.{suffix}")
    assert done.returncode == 0 and f"written to circuit.{suffix}" in done.stdout
    start = (tmp_path / f"circuit.{suffix}").read_bytes()[:200]
    assert {"svg": b"<svg", "pdf": b"%PDF", "png": b"PNG"}[suffix] in start + (
        tmp_path / f"circuit.{suffix}"
    ).read_bytes()[:1000]


def test_refusals(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = typed("sketch", "kr300", "--circuit")
    assert done.returncode == 2 and "'kr300' has no hydraulic circuit" in done.stderr
    done = typed("sketch", "patu655", "--circuit", "--com")
    assert done.returncode == 2 and "--com is for the mechanism, leave it out" in done.stderr
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="has no hydraulic circuit"):
        crane.view.sketch_circuit(crane.load("tx40"), tmp_path / "x.png")
