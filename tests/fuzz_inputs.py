"""Damages visuals, meshes and recordings. `test_fuzz.py` runs this as a process.

    python tests/fuzz_inputs.py KIND FIRST COUNT

prints a line of JSON per case that is neither taken nor refused in one line, that computes for
more than 20 s or takes more than 2 GB, and one at the end. What is drawn never refuses a machine.
"""

import contextlib
import io
import json
import os
import random
import re
import resource
import signal
import sys
import tempfile
import traceback
import warnings
import zipfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np  # noqa: E402

import crane  # noqa: E402
from crane.common.errors import CraneError, CraneWarning  # noqa: E402
from crane.control import joystick, make_controller  # noqa: E402
from crane.formats import check  # noqa: E402
from crane.identification.mechanics.identify import identify  # noqa: E402
from crane.motion.task_trajectories import task_trajectory  # noqa: E402
from crane.recordings.measured_recordings import read_run  # noqa: E402
from crane.simulation.recording_replay import replay  # noqa: E402
from crane.view.page import report  # noqa: E402
from crane.view.result_files import plot_result  # noqa: E402

DATA = Path(__file__).parent / "data"
SECONDS, MEMORY = 20, 2 << 30  # of computing per case, bytes
ODD = [
    "", " ", "nan", "inf", "-inf", "1e308", "-1e308", "1e30", "1e-320", "0", "-1", "1,5", "0x10",
    "red", "1 2", "1 2 3", "1 2 3 4", "0 0 0", "1e400", "1_0", "\u0661", "${r}", "$\\bad$", "--",
    "1" * 400,
]  # fmt: skip


# --- visuals -----------------------------------------------------------------------------------

ROBOT = """<robot name="arm">{materials}
  <link name="foot">{drawn}</link>
  <joint name="swing" type="revolute"><parent link="foot"/><child link="arm"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="arm"><inertial><mass value="1"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>{more}</link>
</robot>
"""
SHAPES = {
    "box": {"size": "0.1 0.2 0.3"},
    "cylinder": {"radius": "0.1", "length": "0.4"},
    "sphere": {"radius": "0.2"},
    "capsule": {"radius": "0.1", "length": "0.3"},
    "mesh": {"filename": "good.stl", "scale": "1 2 3"},
    "cone": {"radius": "1"},
    "heightmap": {},
}
FILES = [
    "good.stl", "none.stl", "package://good.stl", "package://", "package:///", "file://", "..",
    "/", "/dev/zero", "\u00e4.dae", "a" * 300 + ".stl", "http://[::1", "good.stl/x",
    "model://a/b.dae",
]  # fmt: skip


def escaped(text):
    return text.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")


def element(rng, tag, given, inner=""):
    """An element, some of whose attributes are odd or missing."""
    out = f"<{tag}"
    for key, value in given.items():
        if rng.random() < 0.2:
            value = rng.choice(FILES if key == "filename" else ODD)
        if rng.random() > 0.06:
            out += f' {key}="{escaped(value)}"'
    return f"{out}>{inner}</{tag}>"


def visual(rng, meshes=()):
    parts = []
    if rng.random() < 0.6:
        parts.append(element(rng, "origin", {"xyz": "0 0 1", "rpy": "0 0 0.5"}))
    shapes = []
    for _ in range(rng.choice((0, 1, 1, 1, 1, 1, 2))):
        tag = rng.choice(list(SHAPES))
        given = dict(SHAPES[tag])
        if tag == "mesh" and meshes:
            given["filename"] = rng.choice(meshes)
        shapes.append(element(rng, tag, given))
    parts += [f"<geometry>{''.join(shapes)}</geometry>"] * rng.choice((0, 1, 1, 1, 1, 1))
    if rng.random() < 0.6:
        colour = element(rng, "color", {"rgba": "0.1 0.2 0.3 1"}) * rng.choice((0, 1, 1))
        colour += element(rng, "texture", {"filename": "none.png"}) * rng.choice((0, 0, 1))
        parts.append(element(rng, "material", {"name": rng.choice("abc")}, colour))
    rng.shuffle(parts)
    tag = rng.choice(("visual", "visual", "visual", "collision"))
    return f"<{tag}>{''.join(parts)}</{tag}>"


def triangle(corners=((0, 0, 0), (1, 0, 0), (0, 1, 0))):
    rows = np.array([[0, 0, 1], *corners], "<f4").tobytes() + b"\0\0"
    return b"\0" * 80 + (1).to_bytes(4, "little") + rows


def judge_visuals(seed, folder):
    rng = random.Random(seed)
    (folder / "good.stl").write_bytes(triangle())
    robot = ROBOT.format(
        materials="".join(
            element(rng, "material", {"name": name}, element(rng, "color", {"rgba": "1 0 0 1"}))
            for name in "ab"
            if rng.random() < 0.5
        ),
        drawn="".join(visual(rng) for _ in range(rng.randrange(6))),
        more="".join(visual(rng) for _ in range(rng.randrange(3))),
    )
    return judge_drawn(robot, folder)


def judge_drawn(robot, folder):
    """A machine whose drawing is odd is loaded without a word, checked and shown."""
    path = folder / "arm.urdf"
    path.write_text(robot)
    with warnings.catch_warnings():
        warnings.simplefilter("error", CraneWarning)
        machine = crane.load(path)
    found = check(path)
    if found.errors:
        return f"an error for what is drawn: {found.findings}"
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        report(machine, None, folder / "arm.html")
    lines = [str(one) for one in (*found.findings, *(one.message for one in told))]
    if not (folder / "arm.html").is_file() or any(".part" in x.name for x in folder.iterdir()):
        return "no page, or half of one"
    return foreign(told) or bad_line(lines)


def foreign(told):
    """What a user would see of libraries."""
    for one in told:
        ours = issubclass(one.category, CraneWarning | DeprecationWarning)
        if not ours and "Glyph" not in str(one.message):  # that no font has
            return f"a warning of others: {one.message} ({one.filename}:{one.lineno})"
    return None


def bad_line(lines):
    for line in lines:
        if not line or not line.isprintable() or len(line) > 1500:
            return f"message {line[:500]!r}"
    return None


# --- meshes ------------------------------------------------------------------------------------

PER_CASE = 20  # meshes in one machine


def good_meshes():
    """Small valid files of every format."""
    import trimesh

    solid = trimesh.creation.icosphere(subdivisions=1)
    painted = solid.copy()
    painted.visual.vertex_colors = np.linspace(0, 255, 4 * len(solid.vertices)).reshape(-1, 4)
    scene = trimesh.Scene([painted, trimesh.creation.box()])
    kinds = [
        ("stl", solid, {}), ("stl", solid, {"file_type": "stl_ascii"}), ("obj", painted, {}),
        ("off", solid, {}), ("ply", painted, {}), ("ply", painted, {"encoding": "ascii"}),
        ("glb", scene, {}), ("dae", solid, {}),
    ]  # fmt: skip
    found = []
    for kind, mesh, options in kinds:
        data = mesh.export(file_type=options.pop("file_type", kind), **options)
        found.append((kind, data if isinstance(data, bytes) else data.encode()))
    document = json.loads(found[6][1][20 : 20 + int.from_bytes(found[6][1][12:16], "little")])
    document["buffers"][0]["uri"] = "scene.bin"
    found.append(("gltf", json.dumps(document).encode()))
    return found


def damaged(rng, data):
    """Bytes changed, cut, repeated; numbers made large."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        at, how = rng.randrange(len(out) + 1), rng.randrange(9)
        if how == 0:
            del out[at:]
        elif how == 1:
            del out[at : at + rng.randrange(1, 200)]
        elif how == 2:
            out[at:at] = out[at : at + rng.randrange(1, 400)] * rng.randrange(1, 4)
        elif how == 3:
            out[at : at + 4] = rng.choice((b"\xff\xff\xff\xff", b"\0\0\0\0", b"\0\0\xc0\x7f"))
        elif how == 4:
            out[at:at] = rng.choice((b"\0" * 40, b"\n" * 40, b"(" * 400, b"[" * 3000, b"\xff\xfe"))
        elif how in (5, 6):  # a number, wherever it stands
            numbers = list(re.finditer(rb"\d+", bytes(out)))
            if numbers:
                one = rng.choice(numbers)
                large = (b"99999999999", b"-1", b"0", b"1e400", b"4294967295", b"nan", b"1e9")
                out[one.start() : one.end()] = rng.choice(large)
        else:
            for _ in range(rng.randrange(1, 6)):
                if out:
                    out[rng.randrange(len(out))] = rng.randrange(256)
        if not out:
            break
    return bytes(out)


def judge_meshes(seed, folder):
    rng = random.Random(seed)
    drawn = []
    for i in range(PER_CASE):
        kind, data = rng.choice(MESHES)
        kind = rng.choice([kind] * 12 + ["stl", "zip", "svg", "STL", "3mf", "xyz"])
        name = f"{i}.{kind}"
        (folder / name).write_bytes(data if rng.random() < 0.1 else damaged(rng, data))
        drawn.append(f'<visual><geometry><mesh filename="{name}"/></geometry></visual>')
    (folder / "scene.bin").write_bytes(rng.randbytes(rng.choice((0, 100, 4000))))
    return judge_drawn(ROBOT.format(materials="", drawn="\n".join(drawn), more=""), folder)


# --- recordings --------------------------------------------------------------------------------


def prepare_recordings(both):
    """Machines, and a valid recording of each: of angles, and of valves with pressures."""
    global MACHINES, RECORDINGS
    bar = crane.load(DATA / "four_bar.yaml")
    swing = make_controller("pi", bar, task_trajectory(bar, "swing"))
    runs = [crane.simulate(bar, swing, duration=1.0, step=0.01, label="swing")]
    MACHINES, RECORDINGS = [bar], []
    if both:  # whose formulas take ten seconds
        boom = crane.load("patu655")
        MACHINES.append(boom)
        stir = joystick(boom, "stir")
        runs.append(crane.simulate(boom, stir, duration=0.05, step=0.01, label="stir"))
    with tempfile.TemporaryDirectory() as folder:
        for run in runs:
            run.to_csv(Path(folder) / "run.csv")
            RECORDINGS.append((Path(folder) / "run.csv").read_bytes())


def mangled(rng, text):
    """A CSV with some lines, cells, units, or all of its encoding changed."""
    lines = text.decode().splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("time"))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        how = rng.randrange(16)
        row = rng.randrange(head + 1, len(lines)) if len(lines) > head + 1 else head
        cells, names = lines[row].split(","), lines[head].split(",")
        column = rng.randrange(len(names))
        if how in (0, 1):
            cells[rng.randrange(len(cells))] = rng.choice(ODD)
            lines[row] = ",".join(cells)
        elif how == 2:
            names[column] = rng.choice(
                ["", "time [s]", "a [", "a]", "[m]", "$\\bad$ [m]", '"a"', '"', "_a", "q\0",
                 "=1+1", "\u4e2d [m]", "x" * 300, names[0], names[-1], " ", "#", "a [rad] [m]"]
            )  # fmt: skip
            lines[head] = ",".join(names)
        elif how == 3:
            unit = rng.choice(
                ["deg", "mm", "m", "rad", "bar", "kN", "V", "l/min", "ms", "$x$", ""]
            )
            names[column] = re.sub(r"\[.*\]", f"[{unit}]", names[column])
            lines[head] = ",".join(names)
        elif how == 4:
            del lines[rng.randrange(len(lines))]
        elif how == 5:
            lines[rng.randrange(len(lines))] = rng.choice(("", ",,,", "\0" * 50, "#", "a", "1"))
        elif how == 6:
            lines.insert(row, lines[row])
        elif how == 7:
            lines = [",".join(x.split(",")[: column or 1]) if i >= head else x
                     for i, x in enumerate(lines)]  # fmt: skip
        elif how == 8:
            lines = lines[: rng.randrange(1, len(lines) + 1)]
        elif how == 9:
            lines[rng.choice((0, head, row))] += rng.choice("a,# ") * (1 << 21)
        elif how == 10:
            lines.insert(0, "# " + rng.choice(
                ["machine: /dev/zero", "machine: ..", "machine: $\\bad$", "task: $\\bad$",
                 "a" * 9999, "machine: mini_forwarder with {", "machine: \0", "task:",
                 'machine: mini_forwarder with {"lock": [1]}']
            ))  # fmt: skip
            head += 1
        elif how == 11:
            factor = rng.choice((1e-300, 1e300, 0.0, -1.0, 1e9))
            for i in range(head + 1, len(lines)):
                some = lines[i].split(",")
                with contextlib.suppress(ValueError, IndexError):
                    some[column] = repr(float(some[column]) * factor)
                lines[i] = ",".join(some)
        elif how == 12:
            lines[head + 1 :] = lines[:head:-1]
        elif how == 13:
            lines[head] += "," + ",".join(f"c{i}" for i in range(rng.choice((3, 3000, 9000))))
        elif how == 14:
            lines = [line.replace(",", rng.choice((";", "\t", ", "))) for line in lines]
        else:
            lines[rng.randrange(len(lines))] *= rng.choice((2, 50))
        head = min(head, len(lines) - 1)
        if len(lines) < 2:
            break
    out = rng.choice(("\n", "\n", "\n", "\r\n", "\r")).join(lines)
    data = out.encode(rng.choice(["utf-8"] * 9 + ["utf-16", "utf-32", "utf-8-sig"]), "replace")
    return damaged(rng, data) if rng.random() < 0.1 else data


def judge_csv(seed, folder):
    rng = random.Random(seed)
    which = min(rng.choice((0, 0, 0, 1)), len(MACHINES) - 1)
    file = folder / "run.csv"
    file.write_bytes(mangled(rng, RECORDINGS[which]))
    return judge_recording(rng, which, file, folder)


def arrays_of(text):
    lines = [x for x in text.decode().splitlines() if not x.startswith("#")]
    values = np.array([[float(x) for x in line.split(",")] for line in lines[1:]])
    return dict(zip(lines[0].split(","), values.T, strict=True))


def array_file(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def judge_npz(seed, folder):
    rng = random.Random(seed)
    which = min(rng.choice((0, 0, 0, 1)), len(MACHINES) - 1)
    arrays = arrays_of(RECORDINGS[which])
    entries = {f"{name}.npy": array_file(array) for name, array in arrays.items()}
    for _ in range(rng.choice((0, 1, 1, 2))):
        name = rng.choice(list(entries))
        array, how = arrays.get(name[:-4], np.zeros(3)), rng.randrange(9)
        if how == 0:
            other = rng.choice(
                [array[:-1], array[None], array.astype("S3"), array.astype(object), array + 1j,
                 array.astype("f2"), array.astype(">i8"), array[0], array[:0], array[::-1],
                 array * np.nan, array * 1e300, array.astype("M8[s]"),
                 np.array([{}] * len(array)), array.astype(np.longdouble), array > 0]
            )  # fmt: skip
            entries[name] = array_file(other)
        elif how == 1:
            shapes = ["(99999999999,)", "(-1,)", "()", "(2, 50)", "(1e3,)", "None", "(True,)"]
            shape = rng.choice([*shapes, "(((" * 99, f"({10**30},)"])
            entries[name] = re.sub(rb"\(\d+,\)", shape.encode(), entries[name], count=1)
        elif how == 2:
            kind = rng.choice(["|O", "<f4", "<U9", "|V99999", "<f16", "<c16", "zz", "<i8", "|b1",
                               "<f8' * 9", "[('a', '<f8')]"])  # fmt: skip
            entries[name] = entries[name].replace(b"<f8", kind.encode(), 1)
        elif how in (3, 4):
            entries[name] = damaged(rng, entries[name])
        elif how == 5:
            entries[
                rng.choice([".npy", "a", "../x.npy", "a b", "time.npy", "$\\bad$ [m].npy"])
            ] = entries[name]
        elif how == 6:
            del entries[name]
        elif how == 7:
            entries[name] = entries[name][: rng.randrange(len(entries[name]))]
        else:
            entries[name] += b"\0" * rng.choice((1, 8, 1 << 24))
        if not entries:
            break
    file = folder / "run.npz"
    method = rng.choice(
        [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    )
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    data = bytearray(file.read_bytes())
    how = rng.randrange(4)
    if how == 0:
        data = bytearray(damaged(rng, bytes(data)))
    elif how == 1:  # fields of the headers and the directory
        starts = [m.start() for m in re.finditer(rb"PK(\x01\x02|\x03\x04|\x05\x06)", bytes(data))]
        for _ in range(rng.choice((1, 2, 5))):
            at = rng.choice(starts) + rng.randrange(4, 46)
            if at < len(data):
                data[at] = rng.choice((0, 1, 8, 9, 99, 255, rng.randrange(256)))
    file.write_bytes(bytes(data))
    return judge_recording(rng, which, file, folder)


def judge_recording(rng, which, file, folder):
    """Plotted, shown, identified from and now and then replayed, or refused in one line."""
    machine = MACHINES[which]
    written = folder / "run.png", folder / "run.html"
    uses = [
        lambda: plot_result(read_run(file, None), written[0]),
        lambda: plot_result(read_run(file, machine), written[0]),
        lambda: report(machine, read_run(file, machine), written[1]),
    ]
    if which == 0:
        uses.append(lambda: identify(machine, read_run(file, machine)))
    else:
        uses.append(lambda: replay(machine, file, 1e-2))
    lines = []
    for use in uses:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            try:
                use()
            except CraneError as error:
                lines.append(str(error))
        if wrong := foreign(told):
            return wrong
        lines += [str(one.message) for one in told if one.category is CraneWarning]
    if any(".part" in x.name for x in folder.iterdir()):
        return "something half-written"
    return bad_line(lines)


# --- all ---------------------------------------------------------------------------------------

JUDGES = {
    "visuals": judge_visuals, "meshes": judge_meshes, "npz": judge_npz, "csv": judge_csv,
}  # fmt: skip


def too_long(*_):
    raise TimeoutError(f"computed for more than {SECONDS} s")


def main():
    kind, begin, count = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    global MESHES
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if kind == "meshes":
            MESHES = good_meshes()
        if kind in ("npz", "csv"):
            prepare_recordings(both=count > 100)
    resource.setrlimit(resource.RLIMIT_AS, (3 * MEMORY, resource.RLIM_INFINITY))
    signal.signal(signal.SIGPROF, too_long)
    for seed in range(begin, begin + count):
        print(json.dumps({"at": seed}), flush=True)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        wrong = None
        with tempfile.TemporaryDirectory() as folder:
            try:
                wrong = JUDGES[kind](seed, Path(folder))
            except Exception:
                wrong = traceback.format_exc()
        signal.setitimer(signal.ITIMER_PROF, 0)
        taken = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if wrong is None and taken > MEMORY:
            wrong = f"took {taken / 1e9:.1f} GB"
        if wrong:
            print(json.dumps({"seed": seed, "wrong": wrong}), flush=True)
    print(json.dumps({"done": count}), flush=True)


if __name__ == "__main__":
    main()
