"""Files with odd graphs of links and joints, judged. `test_fuzz.py` runs this as a process.

    python tests/fuzz_graphs.py FORMAT FIRST COUNT

prints what fuzz.py prints. A draw is a tree of links with some of: a ring, a joint from a link to
itself, a second parent, a root that is a child, rings and links beside it, joints that mimic each
other in rings, and in a machine file chains that hang from each other. Whether a draw is a tree,
and which links are on rings, is told by powers of its adjacency matrix.
"""

import json
import random
import re
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

import numpy as np
from executed_lines import TooMuchWorkError, at_most

import crane
from crane.common.errors import CraneError, CraneWarning
from crane.formats import check

MOST = 500_000  # lines of the package for one file; the longest of 2500 draws ran a fifth
APART = 8  # times as much for SDF, in which every part that nothing ties to another floats

_MASS = (
    '<inertial><mass value="{}"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" '
    'iyz="0"/></inertial>'
)
_RING = re.compile(r"cut the ring of joints (.+) at '")


def draw(rng):
    """Number of links and joints [parent, child, type, mimicked joint], more or less a tree."""
    count = rng.randint(2, 7)
    ends = [[rng.randrange(i), i] for i in range(1, count)]
    for _ in range(rng.choice((0, 1, 1, 2, 3))):
        how = rng.randrange(7)
        if how == 0:  # the root is a child, or a ring elsewhere
            child = rng.choice((0, rng.randrange(count)))
            ends.append([rng.randrange(count), child])
        elif how == 1:
            one = rng.randrange(count)
            ends.append([one, one])
        elif how == 2:  # diamond
            ends.append(rng.sample(range(count), 2))
        elif how == 3:  # a ring beside the tree
            more = rng.randint(1, 4)
            ends += [[count + i, count + (i + 1) % more] for i in range(more)]
            count += more
        elif how == 4:
            count += 1
        elif how == 5:
            rng.choice(ends).reverse()
        else:
            ends.append(list(rng.choice(ends)))
    rng.shuffle(ends)
    kinds = [rng.choice(("fixed", "continuous", "continuous", "floating")) for _ in ends]
    mimics = [rng.randrange(len(ends)) if rng.random() < 0.2 else None for _ in ends]
    return count, [[*pair, *rest] for pair, *rest in zip(ends, kinds, mimics, strict=True)]


def is_tree(count, joints):
    """Whether every link but one has one parent, and all come from that one."""
    if len(joints) != count - 1:
        return False
    below = np.zeros((count, count), dtype=int)
    for parent, child, *_ in joints:
        below[parent, child] += 1
    return below.sum(axis=0).max() <= 1 and not on_rings(count, joints)


def on_rings(count, joints):
    """Links that are below themselves, by the joints that first give each link a parent."""
    below = np.zeros((count, count))
    for parent, child, *_ in joints:
        if parent != child and not below[:, child].any():
            below[parent, child] = 1
    way, found = below.copy(), set()
    for _ in range(count):
        found |= set(np.flatnonzero(np.diag(way)).tolist())
        way = np.minimum(way @ below, 1)
    return found


def robot(links, joints, names, more="", heavy="1"):
    """A URDF of some links and joints, by their numbers."""
    lines = ['<robot name="odd">']
    lines += [f'<link name="l{i}">{_MASS.format(heavy if i == 1 else "1")}</link>' for i in links]
    for i in names:
        parent, child, kind, mimic = joints[i]
        follows = f'<mimic joint="j{mimic}"/>' if mimic is not None and kind != "floating" else ""
        lines.append(
            f'<joint name="j{i}" type="{kind}"><origin xyz="0.{i + 1} 0.1 0"/>'
            f'<parent link="l{parent}"/><child link="l{child}"/>{follows}</joint>'
        )
    return "\n".join([*lines, more, "</robot>"])


def loops(rng, count):
    """Loops and couplings between any two links, the same ones, too."""
    lines = []
    for i in range(rng.randrange(3)):
        one, two = rng.randrange(count), rng.randrange(count)
        tag = rng.choice(("loop", "loop", "coupling"))
        kind = "rolling" if tag == "coupling" else rng.choice(("revolute", "spherical", "planar"))
        lines.append(
            f'<{tag} name="x{i}" type="{kind}"><predecessor link="l{one}"/>'
            f'<successor link="l{two}"/></{tag}>'
        )
    return "\n".join(lines)


def chains(rng, folder):
    """A machine file of up to four chains; whether all are trees that hang from earlier ones."""
    drawn, count, joints, sound = [], 0, [], True
    for _ in range(rng.randint(1, 4)):
        size, own = draw(rng) if rng.random() < 0.4 else (2, [[0, 1, "continuous", None]])
        sound &= is_tree(size, own)
        first = len(joints)
        for parent, child, kind, mimic in own:
            mimic = None if mimic is None else mimic + first
            joints.append([parent + count, child + count, kind, mimic])
        drawn.append((range(count, count + size), range(first, len(joints))))
        count += size
    lines = ["name: odd", "chains:"]
    for chain, (links, names) in enumerate(drawn):
        (folder / f"{chain}.urdf").write_text(robot(links, joints, names))
        file, parent = chain, rng.randrange(count)  # of itself, or of a later one that hangs here
        if rng.random() < 0.05:
            file = rng.randrange(len(drawn))
        if links[0] and rng.random() < 0.8:
            parent = rng.randrange(links[0])
        hung = f", parent: l{parent}" if chain or rng.random() < 0.1 else ""
        sound &= file == chain and (parent < links[0] if chain else not hung)
        lines.append(f"  - {{name: c{chain}, urdf: {file}.urdf{hung}}}")
    ends = [rng.randrange(count) for _ in range(2 * rng.randrange(3))]
    if ends:
        lines.append("loops:")
    for i, (one, two) in enumerate(zip(ends[::2], ends[1::2], strict=True)):
        kind = rng.choice(("revolute", "spherical"))
        lines.append(f"  - {{name: x{i}, type: {kind}, predecessor: l{one}, successor: l{two}}}")
    if rng.random() < 0.3 and len(joints) > 1:
        one, two = rng.sample(range(len(joints)), 2)
        lines += ["couplings:", f"  - {{name: y, joints: {{j{one}: 1, j{two}: -1}}}}"]
        lines += [f"  - {{name: z, joints: {{j{two}: 1, j{one}: -1}}}}"]
    if rng.random() < 0.5:
        lines.append(f"active: [j{rng.randrange(len(joints))}]")
    (folder / "odd.yaml").write_text("\n".join(lines) + "\n")
    return folder / "odd.yaml", sound


def parallel(rng, count, joints, folder):
    """A robot.yaml whose closed loops and joint types name any joints."""
    (folder / "robot.urdf").write_text(robot(range(count), joints, range(len(joints))))
    pairs = [
        [f"{rng.choice('lj')}{rng.randrange(count)}" for _ in range(2)]
        for _ in range(rng.randrange(3))
    ]
    some = rng.sample(range(len(joints)), rng.randrange(min(3, len(joints)) + 1))
    kinds = [rng.choice(("SPHERICAL", "FIXED", "UJOINT_XY")) for _ in some]
    (folder / "robot.yaml").write_text(
        f"closed_loop: {json.dumps(pairs)}\ntype: {json.dumps(['6d'] * len(pairs))}\n"
        f"name_mot: [j{rng.randrange(len(joints))}]\n"
        f"joint_name: {json.dumps([f'j{i}' for i in some])}\njoint_type: {json.dumps(kinds)}\n"
    )
    return folder / "robot.yaml"


def mujoco(rng, folder):
    """Bodies, which MJCF nests, with constraints in rings, and files that name themselves."""
    count = rng.randint(2, 6)
    parents = [rng.randrange(i) if i else None for i in range(count)]

    def body(i):
        inside = "".join(body(k) for k in range(count) if parents[k] == i)
        return (
            f'<body name="b{i}" pos="0.{i + 1} 0.1 0"><joint name="j{i}" axis="0 0 1"/>'
            f'<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>{inside}</body>'
        )

    lines = []
    for i in range(rng.randrange(4)):
        one, two = rng.sample(range(count), 2)
        if rng.random() < 0.1:
            two = one
        lines.append(rng.choice((
            f'<connect name="e{i}" body1="b{one}" body2="b{two}" anchor="0.1 0 0"/>',
            f'<weld name="e{i}" body1="b{one}" body2="b{two}"/>',
            f'<joint name="e{i}" joint1="j{one}" joint2="j{two}" polycoef="0 1 0 0 0"/>'
            f'<joint name="f{i}" joint1="j{two}" joint2="j{one}" polycoef="0 -1 0 0 0"/>',
        )))  # fmt: skip
    odd = rng.random()
    more = ""
    if odd < 0.1:
        more = '<include file="odd.xml"/>'
    elif odd < 0.2:
        more = '<include file="other.xml"/>'
        (folder / "other.xml").write_text('<mujoco><include file="odd.xml"/></mujoco>')
    (folder / "odd.xml").write_text(
        f'<mujoco model="odd">{more}<worldbody>{body(0)}</worldbody>'
        f"<equality>{''.join(lines)}</equality></mujoco>"
    )
    return folder / "odd.xml", odd >= 0.2


def sdf(rng, count, joints, folder):
    """The same graph as SDF, where rings are loops; its number of loops if all joints turn."""
    kinds = {"floating": ("ball", "universal", "screw", "prismatic", "gearbox")}
    places = [f"0.{i + 1} {rng.choice((0.1, 0))} 0 0 0 0" for i in range(count)]
    lines = [
        f'<link name="l{i}"><pose>{place}</pose><inertial><mass>{i % 3 + 1}</mass></inertial>'
        "</link>"
        for i, place in enumerate(places)
    ]
    for i, (parent, child, kind, mimic) in enumerate(joints):
        style = rng.choice(kinds.get(kind, (kind,)))
        follows = f'<mimic joint="j{mimic}"/>' if mimic is not None else ""
        ends = f"l{parent}" if rng.random() < 0.9 else "world", f"l{child}"
        joints[i] = [parent if ends[0] != "world" else -1, child, style, mimic]
        lines.append(
            f'<joint name="j{i}" type="{style}"><parent>{ends[0]}</parent><child>{ends[1]}</child>'
            f"<axis><xyz>0 0 1</xyz>{follows}</axis></joint>"
        )
    rng.shuffle(lines)
    path = folder / "odd.sdf"
    text = "\n".join(lines)
    path.write_text(f'<sdf version="1.11"><model name="odd">\n{text}\n</model></sdf>')
    return path


def loops_of(count, joints):
    """How many joints of a graph are more than a tree, if all turn, the world being -1."""
    if any(kind != "continuous" or mimic is not None for *_, kind, mimic in joints):
        return None
    groups = [{i} for i in range(-1, count)]
    for parent, child, *_ in joints:
        one, two = (next(g for g in groups if x in g) for x in (parent, child))
        if one is not two:
            groups.remove(two)
            one |= two
    return len(joints) - (count + 1 - len(groups))


def judge(kind, seed, folder):
    """None if all is well, or what is wrong."""
    rng = random.Random(seed)
    count, joints = draw(rng)
    sound, rings = is_tree(count, joints), on_rings(count, joints)
    heavy = rng.choice(("1", "1", "-1"))
    if kind in ("urdf", "urdf+"):
        path = folder / "odd.urdf"
        more = loops(rng, count) if kind == "urdf+" else ""
        path.write_text(robot(range(count), joints, range(len(joints)), more, heavy))
    elif kind == "machine":
        path, sound = chains(rng, folder)
    elif kind == "parallel":
        path = parallel(rng, count, joints, folder)
    elif kind == "sdf":
        path = sdf(rng, count, joints, folder)
        sound = all(parent != child for parent, child, *_ in joints)
    else:
        path, sound = mujoco(rng, folder)
    machine = None
    told, most = None, MOST * (APART if kind == "sdf" else 1)
    try:
        with at_most(most):
            report = check(path)
        with at_most(most):
            machine = crane.load(path)
    except CraneError as error:
        told = str(error)
    except TooMuchWorkError as error:
        return str(error)
    except Exception:
        return traceback.format_exc()
    found = [str(finding) for finding in report.findings if finding.is_error]
    if bool(told) != bool(found):
        return f"load says {told}, check {found}"
    if not sound and not found:
        return f"nothing is said of {count} links and {joints}"
    if kind == "sdf" and machine is not None:
        if machine.closure.residual(machine.home) > 1e-8:
            return "loaded without being closed"
        expected = loops_of(count, joints)
        found_loops = len(machine.closure.equations.loops)
        if expected not in (None, found_loops):
            return f"{found_loops} loops, {expected} joints more than a tree"
    if kind in ("urdf", "urdf+"):
        if heavy == "-1" and not any("link 'l1' has the mass -1" in line for line in found):
            return f"nothing is said of the mass: {found}"
        return wrong_rings(found, joints, rings)
    return None


def wrong_rings(found, joints, rings):
    """Whether findings name the rings, joint by joint as they follow each other."""
    named = set()
    for line in found:
        for ring in _RING.findall(line):
            ends = [joints[int(name[1:])][:2] for name in ring.split(", ")]
            follow = zip(ends, [*ends[1:], ends[0]], strict=True)
            if any(one[1] != two[0] for one, two in follow):
                return f"no ring: {line}"
            named |= {child for _, child in ends}
    return None if named == rings else f"links {rings} are on rings, {named} were named: {found}"


def main():
    kind, begin, count = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    warnings.simplefilter("ignore", CraneWarning)
    for seed in range(begin, begin + count):
        print(json.dumps({"at": seed}), flush=True)
        with tempfile.TemporaryDirectory() as folder:
            wrong = judge(kind, seed, Path(folder))
        if wrong:
            print(json.dumps({"seed": seed, "wrong": wrong}), flush=True)
    print(json.dumps({"done": count}), flush=True)


if __name__ == "__main__":
    main()
