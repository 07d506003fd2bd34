"""Changes bytes of valid files and judges how each is read. `test_fuzz.py` runs this as a process.

    python tests/fuzz.py FORMAT FIRST COUNT

prints a line of JSON per file that is not refused in one line nor read as it says, and one at the
end. A file may end the process (MuJoCo and Pinocchio are not Python): the last line tells which.
"""

import json
import os
import random
import re
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from xml.etree import ElementTree

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np  # noqa: E402
import yaml  # noqa: E402
from executed_lines import TooMuchWorkError, at_most  # noqa: E402

import crane  # noqa: E402
from crane.common.errors import CraneError, CraneWarning  # noqa: E402
from crane.formats import read_machine_spec  # noqa: E402

DATA = Path(__file__).parent / "data"
MOST = 250_000  # lines of the package for one file; a search for home in vain takes 211,000

FOUR_BAR_MJCF = """<mujoco model="bar">
  <compiler angle="radian"/>
  <default><joint axis="0 1 0" damping="0.01"/></default>
  <worldbody>
    <body name="crank"><joint name="a" range="-2 2" limited="true" armature="0.03"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.2" contype="0" conaffinity="0"/>
      <body name="rod" pos="0 0 0.2"><joint name="b" stiffness="1.5"/>
        <inertial pos="0.2 0 0.05" mass="0.7" diaginertia="0.01 0.02 0.025"/>
        <site name="end" pos="0.5 0 0.1"/></body></body>
    <body name="rocker" pos="0.5 0 0"><joint name="c" frictionloss="0.2"/>
      <inertial pos="0 0 0.15" mass="0.5" diaginertia="0.01 0.012 0.004"/>
      <site name="top" pos="0 0 0.3"/></body>
    <body name="wheel" pos="0.9 0 0"><joint name="d" ref="0.5"/>
      <inertial pos="0.01 0 0" mass="0.3" diaginertia="0.001 0.0012 0.0014"/></body>
  </worldbody>
  <tendon><fixed name="rope" stiffness="3" damping="0.2">
    <joint joint="d" coef="-1.5"/></fixed></tendon>
  <equality>
    <connect name="pin" site1="end" site2="top"/>
    <joint name="gear" joint1="d" joint2="c" polycoef="0.1 -2 0 0 0"/>
  </equality>
  <actuator><motor name="drive" joint="a" armature="0.2"/></actuator>
  <keyframe><key name="home" qpos="0.05 0 0 0.3"/></keyframe>
</mujoco>
"""

FOUR_BAR_SDF = """<sdf version="1.9">
  <model name="bar">
    <frame name="plane"><pose>0 0.1 0 0 0 0.4</pose></frame>
    <link name="crank"><pose relative_to="plane">0 0 0 0.1 0.2 0.3</pose>
      <inertial><pose>0 0 0.1 0.3 0 0</pose><mass>0.7</mass>
        <inertia><ixx>0.01</ixx><iyy>0.012</iyy><izz>0.004</izz><ixy>0.001</ixy></inertia>
      </inertial></link>
    <link name="rod"><pose relative_to="plane">0 0 0.2 0 0 0</pose>
      <inertial><pose>0.2 0 0.05 0 0 0</pose><mass>0.5</mass>
        <inertia><ixx>0.01</ixx><iyy>0.02</iyy><izz>0.025</izz></inertia></inertial></link>
    <model name="right"><pose relative_to="plane">0.5 0 0 0 0 0</pose>
      <link name="rocker">
        <inertial><pose>0 0 0.15 0 0 0</pose><mass>0.3</mass>
          <inertia><ixx>0.006</ixx><iyy>0.005</iyy><izz>0.004</izz></inertia></inertial></link>
      <link name="top"><pose>0 0 0.3 0 0 0</pose>
        <inertial><mass>0.2</mass>
          <inertia><ixx>0.006</ixx><iyy>0.005</iyy><izz>0.004</izz></inertia></inertial></link>
    </model>
    <joint name="a" type="revolute"><parent>world</parent><child>crank</child>
      <axis><xyz expressed_in="plane">0 1 0</xyz>
        <limit><lower>-2</lower><upper>1.5</upper><effort>30</effort></limit>
        <dynamics><damping>0.3</damping><friction>0.1</friction></dynamics>
        <initial_position>0.05</initial_position></axis></joint>
    <joint name="b" type="revolute"><parent>crank</parent><child>rod</child>
      <axis><xyz expressed_in="plane">0 1 0</xyz>
        <dynamics><spring_stiffness>1.5</spring_stiffness>
          <spring_reference>0.2</spring_reference></dynamics></axis></joint>
    <joint name="c" type="revolute"><parent>world</parent><child>right::rocker</child>
      <axis><xyz>0 1 0</xyz></axis></joint>
    <joint name="d" type="revolute"><pose relative_to="rod">0.5 0 0 0 0 0</pose>
      <parent>rod</parent><child>right::rocker</child>
      <axis><xyz>0 1 0</xyz></axis></joint>
    <joint name="f" type="revolute"><parent>world</parent><child>right::top</child>
      <axis><xyz>0 1 0</xyz>
        <mimic joint="c"><multiplier>0.5</multiplier></mimic></axis></joint>
  </model>
</sdf>
"""

ARM_XACRO = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="long" default="true"/>
  <xacro:property name="r" value="${0.5 * pi}"/>
  <xacro:macro name="segment" params="name length:=0.5 mass:=^|1.5 *place">
    <link name="${name}">
      <inertial><origin xyz="0 0 ${length / 2}"/><mass value="${mass}"/>
        <inertia ixx="${mass * length**2 / 12}" ixy="0" ixz="0" iyy="${mass * length**2 / 12}"
          iyz="0" izz="${0.01 * mass}"/></inertial>
    </link>
    <joint name="${name}_joint" type="revolute">
      <xacro:insert_block name="place"/><child link="${name}"/><axis xyz="0 1 0"/>
      <limit lower="${-r}" upper="${r}" effort="1" velocity="2"/>
    </joint>
  </xacro:macro>
  <link name="base"/>
  <xacro:segment name="upper" length="0.6"><parent link="base"/></xacro:segment>
  <xacro:if value="$(arg long)">
    <xacro:segment name="lower"><parent link="upper"/></xacro:segment>
  </xacro:if>
</robot>
"""

PARALLEL_YAML = (
    "closed_loop: [[tip, eye]]\ntype: ['6d']\nname_mot: [crank]\n"
    "joint_name: [pin, coupler]\njoint_type: ['SPHERICAL', 'UJOINT_YZ']\n"
)


def make(kind, folder):
    """Write a valid machine: its main file, and the files that are changed."""
    if kind == "machine":
        (folder / "four_bar").mkdir()
        for name in ("four_bar.yaml", "four_bar/ground.urdf", "four_bar/rocker.urdf",
                     "four_bar/load.urdf"):  # fmt: skip
            (folder / name).write_bytes((DATA / name).read_bytes())
        main = folder / "four_bar.yaml"
        return main, [main]
    if kind in ("urdf", "urdf+"):
        name = {"urdf": "four_bar_loop.urdf", "urdf+": "planar_leg.urdf"}[kind]
        (folder / name).write_bytes((DATA / name).read_bytes())
        return folder / name, [folder / name]
    if kind == "parallel":
        text = (DATA / "four_bar_loop.urdf").read_text()
        text = re.sub(r"<loop.*</loop>", "", text, flags=re.DOTALL)
        # a joint whose type robot.yaml replaces has no axis of its own
        text = re.sub(r'(link="coupler_arm"/>\s*)<axis[^>]*/>', r"\1", text)
        for name, link, x in (("tip", "coupler_arm", 0.4), ("rim", "rocker_arm", 0.3)):
            text = text.replace(
                "</robot>",
                f'<link name="{name}"/><joint name="{name}_fixed" type="fixed"><origin '
                f'xyz="{x} 0 0"/><parent link="{link}"/><child link="{name}"/></joint></robot>',
            )
        text = text.replace(
            "</robot>",
            '<link name="eye"><inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" '
            'izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="pin" '
            'type="continuous"><parent link="rim"/><child link="eye"/></joint>'
            "\n</robot>",
        )
        (folder / "robot.urdf").write_text(text)
        (folder / "robot.yaml").write_text(PARALLEL_YAML)
        return folder / "robot.yaml", [folder / "robot.yaml", folder / "robot.urdf"]
    if kind in ("sdf", "xacro"):
        path = folder / f"bar.{kind}"
        path.write_text(FOUR_BAR_SDF if kind == "sdf" else ARM_XACRO)
        return path, [path]
    (folder / "bar.xml").write_text(FOUR_BAR_MJCF)
    return folder / "bar.xml", [folder / "bar.xml"]


def mutated(data, seed):
    """One to three changes of single bytes, digits or short pieces."""
    rng = random.Random(seed)
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        at, how = rng.randrange(len(out)), rng.randrange(7)
        if how == 0:
            out[at] = rng.randrange(256)
        elif how == 1:
            out[at] = rng.choice(b"0123456789.-+eE \"'<>/=:,[]{}#&\n\tax_")
        elif how == 2:
            del out[at]
        elif how == 3:
            out.insert(at, rng.choice(b"0123456789.-+eE \"'<>/=:,[]{}#&\n\tax_"))
        elif how == 4:  # a digit, where it hurts without being noticed
            digits = [i for i, byte in enumerate(out) if byte in b"0123456789"]
            if digits:
                out[rng.choice(digits)] = rng.choice(b"0123456789.-e,")
        elif how == 5:
            out[at:at] = out[at : at + rng.randrange(1, 30)]
        else:
            del out[at : at + rng.randrange(1, 12)]
    return bytes(out)


# --- what a file says, by other parsers than the package's -------------------------------------

IGNORED = {  # what a machine does not have
    ("geom", "contype"), ("geom", "conaffinity"), ("motor", "name"), ("mujoco", "model"),
    ("key", "name"), ("fixed", "name"),  # the only key is home, and nothing refers to the tendon
    ("robot", "name"), ("model", "name"),
}  # fmt: skip


def words(text):
    """Text with its numbers as numbers."""
    found = []
    for word in (text or "").split():
        try:
            found.append((float.fromhex if word.startswith("0x") else float)(word) + 0.0)
        except ValueError:
            found.append(word)
    return tuple(found)


def said_xml(data, known=None):
    """Elements and attributes, as far as they are known."""
    said = []

    def walk(element, path):
        if known is not None and element.tag not in known:
            return
        here = (*path, element.tag)
        given = {"independent": "true"} if element.tag == "joint" else {}  # as in URDF+
        for key, value in sorted({**given, **element.attrib}.items()):
            if (element.tag, key) in IGNORED or (known and key not in known[element.tag]):
                continue
            value = words(value)
            if "axis" in (element.tag, key) and (length := np.hypot.reduce(value)):
                value = tuple(np.round(np.array(value) / length, 15).tolist())
            if (element.tag, key) == ("sdf", "version"):
                if not any(isinstance(x, float) and x < 1.5 for x in value):
                    continue  # axes count elsewhere before, else it says nothing
                value = ("old",)
            if key == "polycoef":
                value += (0.0,) * (5 - len(value))
            said.append((here, key, value))
        if not len(element):  # others have none that means anything
            text = words(element.text)
            if element.tag == "xyz" and (length := np.hypot.reduce(text)):
                text = tuple(np.round(np.array(text) / length, 15).tolist())
            said.append((here, "text", text))
        for child in element:
            walk(child, here)
        said.append((here, "end", ()))

    walk(ElementTree.fromstring(data), ())
    return said


def vocabulary(data):
    """Attributes by element that a file has."""
    found = {}
    for element in ElementTree.fromstring(data).iter():
        found.setdefault(element.tag, set()).update(element.keys())
    return found


def said_yaml(data):
    def plain(value):
        if isinstance(value, dict):
            return {str(key): plain(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [plain(inner) for inner in value]
        if isinstance(value, str):
            return words(value)
        return (float(value),) if isinstance(value, int | float) else value

    return plain(yaml.safe_load(data.decode("utf-8")))


def said(files, known):
    return [
        said_yaml(file.read_bytes()) if file.suffix == ".yaml"
        else said_xml(file.read_bytes(), known[file.name])
        for file in files
    ]  # fmt: skip


def got(spec):
    """All that was read, without where it stood."""
    named = spec.path.name == "four_bar.yaml"  # others are named by their files if by nothing
    parts = []
    for name, value in sorted(vars(spec).items()):
        if name in ("source_locations", "path"):
            continue
        if name == "name" and not named:
            continue
        if name == "chains":
            value = [(named and chain.name, chain.urdf.name, chain.parent) for chain in value]
        if name == "payload":
            value = value and value.urdf.name
        parts.append((name, value))
    return re.sub(
        r"(?<![\w.])-0\.0(?![\w.])", "0.0", re.sub(r", source_location='[^']*'", "", repr(parts))
    )


def judge(kind, seed, folder):
    """None if all is well, or what is wrong."""
    main, files = make(kind, folder)
    known = {f.name: vocabulary(f.read_bytes()) for f in files if f.suffix != ".yaml"}
    original = None if kind == "xacro" else said(files, known), got(read_machine_spec(main))
    file = files[seed % len(files)]
    file.write_bytes(mutated(file.read_bytes(), seed))
    problem = None
    try:
        with at_most(MOST):
            machine = crane.load(main)
            spec = read_machine_spec(main)
    except CraneError as error:
        line = str(error)
        problem = None if line.isprintable() and line else f"message {line!r}"
        machine = None
    except TooMuchWorkError as error:
        return str(error)
    except RecursionError:
        problem, machine = "recursion", None
    except Exception:
        problem, machine = traceback.format_exc(), None
    if machine is None or problem:
        return problem
    if not np.isfinite(machine.home).all() or machine.closure.residual(machine.home) > 1e-8:
        return "loaded without being closed"
    if kind == "xacro":  # whose words are a program
        return None
    try:
        says = said(files, known)
    except Exception as error:
        return f"loaded, and another parser says: {error}"
    same = says == original[0]
    if kind == "mjcf":  # to say a thing twice is to say it
        same = {*says[0]} == {*original[0][0]}
    same_machine = got(spec) == original[1]
    if same and not same_machine:
        return "another machine from a file that says the same"
    if same_machine and not same:
        return f"the same machine from a file that says something else: {first(says, original[0])}"
    return None


def first(one, two):
    """The first difference of what two files say."""
    for a, b in zip(one, two, strict=True):
        if isinstance(a, list):
            for x, y in zip(a, b, strict=False):
                if x != y:
                    return f"{x} for {y}"
        if a != b:
            return f"{a} for {b}"[:300]
    return "length"


def main():
    kind, begin, count = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    warnings.simplefilter("ignore", CraneWarning)
    loaded = 0
    for seed in range(begin, begin + count):
        print(json.dumps({"at": seed}), flush=True)
        with tempfile.TemporaryDirectory() as folder:
            wrong = judge(kind, seed, Path(folder))
        if wrong:
            print(json.dumps({"seed": seed, "wrong": wrong}), flush=True)
        loaded += 1
    print(json.dumps({"done": loaded}), flush=True)


if __name__ == "__main__":
    main()
