"""xacro files expand as with xacro itself, with packages found by this program's rules."""

import importlib
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import typed
from warned import quiet

import crane
from crane.common.errors import CraneError, InputError
from crane.formats import robot_files
from crane.formats.xacro_process import UnsafeExpressionError, restrict_expressions

xacro = pytest.importorskip("xacro")

SHARED = Path(__file__).parents[2] / "shared" / "data" / "third_party" / "zx200" / "zx200.xacro"

MACROS = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:property name="sizes" value="${xacro.load_yaml(package + '/config/sizes.yaml')}"/>
  <xacro:macro name="segment" params="name length mass:=1.5 *place">
    <link name="${name}">
      <inertial><origin xyz="0 0 ${length / 2}"/><mass value="${mass}"/>
        <inertia ixx="${mass * length**2 / 12}" ixy="0" ixz="0" iyy="${mass * length**2 / 12}"
          iyz="0" izz="${0.01 * mass}"/></inertial>
    </link>
    <joint name="${name}_joint" type="continuous">
      <xacro:insert_block name="place"/><child link="${name}"/><axis xyz="0 1 0"/>
    </joint>
  </xacro:macro>
</robot>
"""
ROBOT = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="long" default="false"/>
  <xacro:property name="package" value="$(find arm_parts)"/>
  <xacro:include filename="$(find arm_parts)/urdf/macros.xacro"/>
  <link name="base"/>
  <xacro:segment name="upper" length="${sizes['upper']}"><parent link="base"/></xacro:segment>
  <xacro:if value="$(arg long)">
    <xacro:segment name="lower" length="0.4" mass="${2 * sizes['weight']}">
      <parent link="upper"/>
    </xacro:segment>
  </xacro:if>
</robot>
"""


def load(path, **options):
    return quiet(crane.load, path, **options)


@pytest.fixture
def arm(tmp_path):
    """A robot whose macros are in another package beside its own, which has another name."""
    parts, robot = tmp_path / "src" / "parts", tmp_path / "src" / "arm_robot"
    for folder in (parts / "urdf", parts / "config", robot / "urdf"):
        folder.mkdir(parents=True)
    (parts / "package.xml").write_text("<package><name>arm_parts</name></package>")
    (robot / "package.xml").write_text("<package><name>arm_robot</name></package>")
    (parts / "urdf" / "macros.xacro").write_text(MACROS)
    (parts / "config" / "sizes.yaml").write_text("upper: 0.6\nweight: 1.25\n")
    path = robot / "urdf" / "arm.urdf.xacro"
    path.write_text(ROBOT)
    return path


def test_includes_properties_and_yaml(arm):
    machine = load(arm)
    assert machine.joints == ("upper_joint",)
    inertial = machine.tree.links["upper"].inertial
    assert (inertial.mass, inertial.com) == (1.5, (0, 0, 0.3))
    assert inertial.tensor[0] == pytest.approx(1.5 * 0.36 / 12, rel=1e-15)


@pytest.mark.parametrize("value", [True, "true", 1])
def test_arguments(arm, value):
    machine = load(arm, arguments={"long": value})
    assert machine.joints == ("upper_joint", "lower_joint")
    assert machine.tree.links["lower"].inertial.mass == 2.5
    again = crane.formats.load_from_expression(machine.load_expression)
    assert again.joints == machine.joints and again.load_expression == machine.load_expression


def test_argument_that_the_file_does_not_have(arm):
    with pytest.raises(InputError) as caught:
        load(arm, arguments={"lang": 1})
    assert str(caught.value) == "arm.urdf.xacro has no argument 'lang', did you mean 'long'?"


@pytest.mark.parametrize("how", ["given", "above", "ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"])
def test_where_packages_are_found(arm, how, tmp_path, monkeypatch):
    """Outside of its packages the file needs a package path."""
    away = tmp_path / "elsewhere" / "deep"
    away.mkdir(parents=True)
    path = Path(shutil.move(arm, away / "arm.xacro"))
    with pytest.raises(CraneError) as caught:
        load(path)
    assert str(caught.value) == (
        "arm.xacro: package 'arm_parts' is not found, say where it is: --packages FOLDER, "
        "packages=[...] in Python"
    )
    options = {"packages": [tmp_path / "src"]} if how == "given" else {}
    if how == "above":
        (tmp_path / "src" / "parts").rename(tmp_path / "elsewhere" / "arm_parts")
    elif how == "ROS_PACKAGE_PATH":
        monkeypatch.setenv(how, str(tmp_path / "src"))
    elif how == "AMENT_PREFIX_PATH":
        (tmp_path / "install" / "share").mkdir(parents=True)
        (tmp_path / "src" / "parts").rename(tmp_path / "install" / "share" / "arm_parts")
        monkeypatch.setenv(how, str(tmp_path / "install"))
    assert load(path, **options).joints == ("upper_joint",)


def test_include_by_package_scheme(arm):
    text = ROBOT.replace("$(find arm_parts)/urdf", "package://arm_parts/urdf")
    arm.write_text(text)
    assert load(arm).joints == ("upper_joint",)


def test_same_as_xacro_itself(tmp_path):
    """Expanded by xacro's own command and read as URDF."""
    text = ROBOT.replace("$(find arm_parts)", ".").replace("./urdf/", "")
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "sizes.yaml").write_text("upper: 0.6\nweight: 1.25\n")
    (tmp_path / "macros.xacro").write_text(MACROS)
    (tmp_path / "arm.xacro").write_text(text)
    plain = xacro.process_file(str(tmp_path / "arm.xacro"), mappings={"long": "true"}).toxml()
    (tmp_path / "arm.urdf").write_text(plain)
    one = load(tmp_path / "arm.xacro", arguments={"long": "true"})
    assert one.model == load(tmp_path / "arm.urdf").model


def test_a_urdf_with_xacro_in_it_is_expanded(arm):
    path = arm.rename(arm.with_name("arm.urdf"))
    assert load(path).joints == ("upper_joint",)


REFUSED = {
    "a mass in a macro": (
        ("mass=\"${2 * sizes['weight']}\"", 'mass="-1"'),
        "macros.xacro:5: link 'lower' has the mass -1 kg, give a positive one",
    ),
    "a joint": (
        ('<parent link="base"/>', '<parent link="bose"/>'),
        "arm.urdf.xacro:6: joint 'upper_joint' has the unknown parent 'bose', did you mean "
        "'base'?",
    ),
    "a name": (
        ("sizes['upper']", "size"),
        "arm.urdf.xacro: xacro refuses it (name 'size' is not defined when evaluating expression "
        "'size'), correct it",
    ),
    "a file": (
        ("urdf/macros.xacro", "urdf/macro.xacro"),
        None,
    ),
    "broken": (
        ('<link name="base"/>', '<link name="base">'),
        "arm.urdf.xacro:12: not XML, Opening and ending tag mismatch: link line 5 and robot, "
        "correct it",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_is_refused(kind, arm):
    (old, new), message = REFUSED[kind]
    assert ROBOT.count(old) == 1
    arm.write_text(ROBOT.replace(old, new))
    with pytest.raises(CraneError) as caught:
        load(arm, arguments={"long": True})
    if message is None:
        assert "No such file or directory" in str(caught.value)
    else:
        assert str(caught.value) == message
    assert typed("check", arm, "--arg", "long:=true").returncode == 2


def test_macros_without_end(tmp_path):
    path = tmp_path / "ring.xacro"
    path.write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="m" params="">'
        "<xacro:m/></xacro:macro><xacro:m/></robot>"
    )
    with pytest.raises(
        CraneError, match=r"ring.xacro: xacro refuses it \(its macros or files use"
    ):
        load(path)


def test_without_xacro(arm, monkeypatch):
    monkeypatch.setattr(robot_files, "_run_xacro_process", lambda _: {"missing": True})
    with pytest.raises(CraneError) as caught:
        load(arm)
    assert str(caught.value) == (
        "arm.urdf.xacro: is written with xacro, install it in the repository's folder: "
        "pip install '.[xacro]'"
    )


def test_home_is_written_into_it(arm):
    """Two bars about one pin, the second of which a loop holds level."""
    loop = (
        '<loop name="pin" type="revolute"><predecessor link="lower"><origin xyz="0 0 0.4"/>'
        '</predecessor><successor link="base"><origin xyz="0.4 0 0"/></successor>'
        '<axis xyz="0 1 0"/></loop><group_state name="home"><joint name="upper_joint" '
        'value="0.5"/></group_state></robot>'
    )
    arm.write_text(ROBOT.replace("</robot>", loop))
    sought = load(arm, arguments={"long": True})
    done = typed("check", arm, "--arg", "long:=true", "--write-home")
    assert "home written" in done.stdout, done.stderr
    assert "$(find arm_parts)" in arm.read_text()
    assert np.abs(load(arm, arguments={"long": True}).home - sought.home).max() < 1e-12


@pytest.mark.skipif(not SHARED.is_file(), reason="the excavator, ../shared/data, is not there")
def test_excavator_as_it_comes():
    machine = load(SHARED)
    assert machine.joints[:4] == ("swing_joint", "boom_joint", "arm_joint", "bucket_joint")
    assert typed("check", SHARED).returncode == 1


# --- files of strangers ----------------------------------------------------------------------

ESCAPES = {
    "subclasses through a lambda": "(lambda: [c for c in ().__class__.__base__.__subclasses__() "
    "if c.__name__ == '_wrap_close'][0].__init__.__globals__['system']('touch {mark}'))()",
    "attributes of a comprehension": "[x.__class__ for x in [1]]",
    "a name": "__import__('os').system('touch {mark}')",
    "vars": "python.vars(python.vars(1).__class__)",
    "attributes by vars": "python.vars(python)['x']",
    "classes by type": "python.type('X', (str,), dict())",
    "the frame of a generator": "(x for x in [1]).gi_frame.f_back.f_globals",
    "format of attributes": "'{{0.__class__}}'.format(1)",
    "format of items": "'{{0[a]}}'.format(dict(a=1))",
    "format_map": "'{{0.__class__}}'.format_map(dict())",
    "a function's attributes": "xacro.load_yaml.func_globals",
    "methods of classes": "dict.fromkeys([1])",
    "an assignment": "[y := 1, y][0]",
    "f-string": "f'{{(1).__class__}}'",
    "names in full width": "().＿＿class＿＿",
}


def stranger(folder, expression, element):
    """A file that evaluates an expression."""
    text = {
        "property": f'<xacro:property name="x" value="${{{expression}}}"/><link name="${{x}}"/>',
        "eval": f'<xacro:property name="x" value="$(eval {expression})"/><link name="${{x}}"/>',
        "if": f'<xacro:if value="${{{expression}}}"><link name="a"/></xacro:if>',
    }[element]
    path = folder / "evil.urdf"
    path.write_text(
        '<robot name="e" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="base"/>'
        f'{text}<joint name="j" type="continuous"><parent link="base"/><child link="a"/></joint>'
        "</robot>"
    )
    return path


@pytest.mark.parametrize("element", ["property", "eval", "if"])
def test_expressions_of_a_file_do_not_run_programs(tmp_path, element):
    mark = tmp_path / "mark"
    path = stranger(tmp_path, ESCAPES["subclasses through a lambda"].format(mark=mark), element)
    with pytest.raises(CraneError) as caught:
        load(path)
    assert "evil.urdf: xacro refuses it" in str(caught.value) and "\n" not in str(caught.value)
    assert not mark.exists()


@pytest.fixture
def restricted_xacro():
    """A copy of xacro with restricted expressions; the module itself stays as it is."""
    names = [name for name in sys.modules if name.partition(".")[0] == "xacro"]
    originals = {name: sys.modules.pop(name) for name in names}
    copy = importlib.import_module("xacro")
    substitution = importlib.import_module("xacro.substitution_args")
    restrict_expressions(copy, substitution)
    yield copy
    sys.modules |= originals


@pytest.mark.parametrize("name", ESCAPES)
def test_expressions_compute_with_data_alone(restricted_xacro, tmp_path, name):
    expression = ESCAPES[name].format(mark=tmp_path / "mark")
    symbols = restricted_xacro.Table(restricted_xacro._global_symbols)
    with pytest.raises((UnsafeExpressionError, NameError, SyntaxError)):
        restricted_xacro.safe_eval(expression, symbols)
    with pytest.raises(restricted_xacro.XacroException):
        restricted_xacro.eval_text(f"$(eval {expression})", symbols)
    assert not (tmp_path / "mark").exists()


EXPRESSIONS = {
    "2 * pi + math.sin(0.5) ** 2": 2 * np.pi + np.sin(0.5) ** 2,
    "'{:.3f} {a}'.format(1 / 3, a='b')": "0.333 b",
    "f'{1 / 3:.2f}'": "0.33",
    "' a b '.split()[-1].upper()": "B",
    "dict(a=[1, 2]).get('a', [])[1]": 2,
    "xacro.dotify(dict(a=dict(b=3))).a.b": 3,
    "sum": None,
    "python.sum([x * y for x in range(4) for y in [1, 2] if x != y])": 13,
    "max(*[1, 5], 3) if not (1 < 2 <= 2 and 'a' in 'abc') else -1": -1,
    "{'a': 1, **{'b': 2}}['b'] << 2": 8,
    "python.sorted({3, 1, 2})[::-1]": [3, 2, 1],
    "[scale * x for x in list(map(float, '1 2'.split()))]": [2.0, 4.0],
}


@pytest.mark.parametrize("text", EXPRESSIONS)
def test_expressions_have_the_values_of_xacro(restricted_xacro, text):
    results = []
    for module in (xacro, restricted_xacro):
        symbols = module.Table(module._global_symbols)
        symbols["scale"] = 2
        try:
            results.append(module.safe_eval(text, symbols))
        except NameError as error:
            results.append(str(error))
    assert results[0] == results[1]
    assert results[0] == EXPRESSIONS[text] or EXPRESSIONS[text] is None


def test_trusted_files_run_as_by_xacro(tmp_path):
    """Only where the user says so, and never for a recording that names the file."""
    mark = tmp_path / "mark"
    run = ESCAPES["subclasses through a lambda"].format(mark=mark)
    path = stranger(tmp_path, f"'ab'[{run}]", "property")
    machine = load(path, trust_xacro=True)
    assert mark.exists() and machine.joints == ("j",)
    mark.unlink()
    with pytest.raises(CraneError, match="xacro refuses it"):
        crane.formats.load_from_expression(machine.load_expression)
    assert "--trust-xacro" in machine.command_line_arguments
    recording = tmp_path / "run.csv"
    recording.write_text(f"# machine: {path}\n# crane samples: 2\ntime [s],q_j [rad]\n0,0\n1,0\n")
    for words in ((), ("--trust-xacro",)):
        result = typed("view", recording, "--out", tmp_path / "page", *words)
        assert result.returncode == 2 and "xacro refuses it" in result.stderr
    assert not mark.exists()


@pytest.mark.parametrize("how", ["load_yaml", "include", "find"])
def test_files_outside_of_the_package_are_not_read(tmp_path, how):
    secret = tmp_path / "secret" / "keys.yaml"
    secret.parent.mkdir()
    secret.write_text("key: hidden\n")
    (tmp_path / "robot").mkdir()
    file = {"load_yaml": str(secret), "include": str(secret), "find": "../secret/keys.yaml"}[how]
    element = (
        f'<xacro:include filename="{file}"/>'
        if how == "include"
        else f"<link name=\"${{xacro.load_yaml('{file}')['key']}}\"/>"
    )
    path = tmp_path / "robot" / "r.xacro"
    path.write_text(
        f'<robot name="e" xmlns:xacro="http://www.ros.org/wiki/xacro">{element}</robot>'
    )
    with pytest.raises(CraneError) as caught:
        load(path)
    assert "--packages FOLDER" in str(caught.value) and "hidden" not in str(caught.value)
    if how != "include":
        with pytest.raises(CraneError, match="no joint moves"):
            load(path, packages=[secret.parent])


def test_neighbours_without_a_manifest_are_packages_but_no_other_folders(tmp_path, monkeypatch):
    """Any folder has a package's name: one beside the home folder is none."""
    robot = tmp_path / "home" / "src" / "robot" / "urdf" / "r.xacro"
    for folder in (robot.parent, tmp_path / "home" / "src" / "parts", tmp_path / "home" / "keys"):
        folder.mkdir(parents=True)
        (folder / "names.yaml").write_text("key: inside\n")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))

    def key(package):
        robot.write_text(
            '<robot name="e" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="base"/>'
            f"<link name=\"${{xacro.load_yaml('$(find {package})/names.yaml')['key']}}\"/>"
            '<joint name="j" type="continuous"><parent link="base"/><child link="inside"/></joint>'
            "</robot>"
        )
        return load(robot)

    assert key("parts").joints == key("urdf").joints == ("j",)
    with pytest.raises(CraneError, match="not in its package"):
        key("keys")


def test_environment_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "hidden")
    assert load(stranger(tmp_path, "'$(optenv SECRET none)' == 'none'", "if")).joints == ("j",)
    with pytest.raises(CraneError, match="variable 'SECRET' is not read, give --trust-xacro"):
        load(stranger(tmp_path, "'$(env SECRET)'", "property"))
