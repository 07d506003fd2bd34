"""Valid descriptions, warnings, machine lookup, and randomly changed files."""

import re
import warnings

import numpy as np
import pytest
from broken_machines import (
    DATA,
    GROUND,
    LOOPED,
    MACHINE,
    MINI,
    MODELS,
    ROCKER,
    Edit,
    copy_machine,
    swap,
)

import crane
from crane.common.errors import (
    CraneError,
    CraneWarning,
    DescriptionError,
    suggest_names,
)
from crane.description import Friction, bundled_machines, example_robots
from crane.description.kinematic_tree import inertia_problem
from crane.description.machine_lookup import find_machine_file
from crane.description.specification import LOOP_TYPES

NO_MACHINE = (
    "not a machine, give a machine file (.yaml), a URDF (.urdf, .xacro), an SDF (.sdf) or a MJCF "
    "(.xml)"
)


@pytest.fixture
def four_bar(tmp_path):
    """Load the four-bar linkage after some edits."""

    def load(*edits, machine=MACHINE):
        path = copy_machine(machine, tmp_path)
        for edit in edits:
            edit.apply(tmp_path)
        return crane.load(path)

    return load


class TestValid:
    def test_four_bar(self, four_bar):
        machine = four_bar()
        assert machine.name == "four_bar"
        assert machine.source == "written for the tests"
        assert machine.joints == ("crank", "coupler", "rocker")
        assert machine.active == ("crank",)
        assert (machine.lower, machine.upper) == ([-1.5], [2.5])
        assert machine.home[0] == 1.2
        assert [(c.name, c.urdf.name, c.parent) for c in machine.chains] == [
            ("crank", "ground.urdf", None),
            ("rocker", "rocker.urdf", "pin_B"),
        ]
        assert machine.tip == "coupler_pin"
        assert machine.forces[0].rest == 1.5
        assert machine.end_stops[0].stiffness == 1e4  # 1e4 is text to YAML
        assert machine.control["crank"].ki == 20.0
        assert machine.tasks["swing"].coefficients == {"crank": (1.2, 0.4, -0.2)}
        assert machine.tasks["reach"].space == "tip"
        assert machine.tasks["reach"].coefficients["y"] == (0.3, 0.01)

    def test_loop_in_a_urdf_is_the_same_machine(self, four_bar):
        split, single = four_bar(), four_bar(machine=LOOPED)
        assert single.active == ("crank",)
        assert [loop.type for loop in single.closure.equations.loops] == ["revolute"]
        crank = np.linspace(0.6, 1.8, 7)[:, None]  # that of the single file counts from 1.2
        offsets = np.array([1.2, -0.9, 1.4])
        q = single.closure.solve(crank - 1.2) + offsets
        np.testing.assert_allclose(q, split.closure.solve(crank), atol=1e-12)
        a = crane.Dynamics(split).mass_matrix(crank)
        b = crane.Dynamics(single).mass_matrix(crank - 1.2)
        np.testing.assert_allclose(a, b, rtol=1e-10)

    def test_doubled_loop_changes_nothing(self, four_bar):
        loop = "type: revolute, predecessor: coupler_pin, successor: rocker_pin}\n"
        doubled = four_bar(swap(loop, loop + "  - {name: other_side, " + loop))
        np.testing.assert_allclose(doubled.home, four_bar().home, atol=1e-12)

    def test_axis_need_not_be_a_unit(self, four_bar):
        machine = four_bar(
            swap("successor: rocker_pin}", "successor: rocker_pin, axis: [0, 0, 5]}")
        )
        assert machine.closure.equations.loops[0].axis == (0.0, 0.0, 1.0)

    def test_urdf_dynamics_become_friction(self, four_bar):
        unsaid = four_bar(swap("  crank: {coulomb: 0.3, viscous: 0.1, smoothing: 1e-3}\n", ""))
        assert unsaid.friction["crank"] == Friction(viscous=0.2, coulomb=0.5)
        assert "rocker" not in unsaid.friction

    def test_machine_file_overrides_urdf_dynamics(self, four_bar):
        friction = four_bar().friction
        assert friction["crank"] == Friction(coulomb=0.3, viscous=0.1, smoothing=1e-3)
        assert friction["coupler"] == Friction(viscous=0.01)

    def test_continuous_joints_have_no_limits_and_keep_their_efforts(self, four_bar):
        axis = '<axis xyz="0 0 1"/>'
        machine = four_bar(swap(axis, axis + '<limit effort="3" velocity="2"/>', ROCKER))
        model = machine.model
        column = machine.column("rocker")
        assert model.lowerPositionLimit[column] == -np.inf
        assert model.upperPositionLimit[column] == np.inf
        assert (model.effortLimit[column], model.velocityLimit[column]) == (3.0, 2.0)
        assert model.effortLimit[machine.column("coupler")] == np.inf

    def test_home_without_values_is_zero_or_the_nearest_limit(self, four_bar):
        limits = swap('lower="-1.5"', 'lower="0.25"', GROUND)
        home = "home:\n  crank: 1.2\n  coupler: -1.0\n  rocker: 1.5\n"
        machine = four_bar(limits, swap(home, ""))
        assert machine.home[machine.column("crank")] == 0.25

    # Pinocchio's own reader refuses these without saying where; they are harmless.
    @pytest.mark.parametrize(
        "edit",
        [
            swap('value="1.5"', 'value=" 1.5 "', GROUND),
            swap('rpy="0 0 0"', 'rpy="0\t0\n 0"', GROUND),
            swap(' effort="10" velocity="5"', "", GROUND),
            swap("<dynamics damping", "<safety_controller/><dynamics damping", GROUND),
            swap("<dynamics damping", '<calibration rising="a"/><dynamics damping', GROUND),
            swap('damping="0.2" friction="0.5"', "", GROUND),
        ],
        ids=["spaces", "white-space", "no-effort", "safety", "calibration", "no-dynamics"],
    )
    def test_harmless(self, four_bar, edit):
        assert four_bar(edit).active == ("crank",)

    def test_limits_and_friction_of_fixed_joints_do_not_count(self, four_bar):
        fixed = '<joint name="rocker_pin_fixed" type="fixed">'
        more = '<limit lower="a"/><axis xyz="0 0 0"/><dynamics damping="3"/>'
        machine = four_bar(swap(fixed, fixed + more, ROCKER))
        assert "rocker_pin_fixed" not in machine.friction

    def test_foreign_elements_are_ignored(self, four_bar):
        foreign = '<gazebo><joint name="x"><orign/></joint></gazebo><sensor type="imu"/><?pi x?>'
        assert four_bar(swap("</robot>", foreign + "</robot>", GROUND)).joints[0] == "crank"

    def test_link_and_joint_may_share_a_name(self, four_bar):
        shared = swap('<joint name="rocker" ', '<joint name="rocker_arm" ', ROCKER)
        machine = four_bar(
            shared,
            swap("  rocker: 1.5", "  rocker_arm: 1.5"),
            swap("joint: rocker,", "joint: rocker_arm,"),
        )
        assert machine.joints == ("crank", "coupler", "rocker_arm")
        frame = machine.model.frames[machine.frame("rocker_arm")]
        assert machine.model.names[frame.parentJoint] == "rocker_arm"

    def test_quotes_in_names(self, four_bar):
        other = """x'y"z"""
        escaped = "x'y&quot;z"
        machine = four_bar(
            swap('<joint name="rocker" ', f'<joint name="{escaped}" ', ROCKER),
            swap("  rocker: 1.5\n", ""),
            swap("  - {joint: rocker, stiffness: 2, rest: 1.5, damping: 0.1}\n", ""),
        )
        assert machine.joints[2] == other

    def test_long_chain_of_fixed_links(self, four_bar):
        links = "".join(
            f'<link name="l{i}"/><joint name="j{i}" type="fixed">'
            f'<parent link="{f"l{i - 1}" if i else "ground"}"/><child link="l{i}"/></joint>'
            for i in range(1500)
        )
        assert four_bar(swap("</robot>", links + "</robot>", GROUND)).frame("l1499")

    def test_tip_of_an_unbranched_urdf_is_its_last_link(self, tmp_path):
        path = tmp_path / "arm.urdf"
        path.write_text((DATA / ROCKER).read_text())
        machine = crane.load(path)
        assert (machine.name, machine.tip) == ("four_bar_rocker", "rocker_pin")
        assert machine.active == ("rocker",)
        assert machine.source == "arm.urdf"
        assert machine.path == path


class TestWarnings:
    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            (
                "coulomb: 0.3,",
                "coulomb: 0.3, coulomb_offset: -0.4,",
                "four_bar.yaml:20: friction of 'crank' drives the joint in one direction "
                "(|coulomb_offset| 0.4 > coulomb 0.3), a constant force may hide in it; write "
                "drives: true if it is meant",
            ),
            (
                "viscous: 0.1,",
                "viscous: 0.1, viscous_offset: 0.2,",
                "four_bar.yaml:20: friction of 'crank' drives the joint in one direction "
                "(|viscous_offset| 0.2 > viscous 0.1), a constant force may hide in it; write "
                "drives: true if it is meant",
            ),
        ],
        ids=["coulomb", "viscous"],
    )
    def test_friction_that_drives(self, four_bar, old, new, message):
        with pytest.warns(CraneWarning) as caught:
            four_bar(swap(old, new))
        assert [str(warning.message) for warning in caught] == [message]

    def test_inertia_of_no_body_on_a_fixed_link(self, four_bar):
        """A fixed link only adds to another body, whose sum counts."""
        inertia = '<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="1e-4"/>'
        body = f'<link name="pin_B"><inertial><mass value="1"/>{inertia}</inertial></link>'
        with pytest.warns(CraneWarning) as caught:
            four_bar(swap('<link name="pin_B"/>', body, GROUND))
        assert [str(warning.message) for warning in caught] == [
            "ground.urdf:3: link 'pin_B' has an inertia of no possible body: principal moments "
            "0 + 0 < 0.0001 kg m2; computed with as it stands, the nearest possible is "
            'ixx="5e-05" ixy="0" ixz="0" iyy="5e-05" iyz="0" izz="0.0001"'
        ]

    def test_what_is_odd_is_told_unless_the_file_says_that_it_is_meant(self, tmp_path):
        path = copy_machine(MINI, tmp_path)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            written = crane.write_machine(crane.load(path), tmp_path / "written")
            assert crane.load(written).friction == crane.load("mini_forwarder").friction
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace(", drives: true", ""), encoding="utf-8")
        with pytest.warns(CraneWarning, match="friction of 'X2' drives the joint") as caught:
            crane.load(path)
        assert len(caught) == 1
        path.write_text(text.replace("drives: true", "drives: 1"), encoding="utf-8")
        with pytest.raises(DescriptionError, match="'X2' is 1, give true or false"):
            crane.load(path)


class TestSources:
    @pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")
    def test_every_example_loads_or_is_refused_with_a_line(self):
        loaded = 0
        for name in example_robots():
            try:
                machine = crane.load(name)
            except CraneError as error:
                assert str(error).startswith(example_robots()[name].name)
            else:
                loaded += 1
                free = machine.model.nv - len(machine.closure.equations.couplings)
                assert machine.model.nq == machine.model.nv
                assert len(machine.active) == free
        assert loaded > 35

    def test_paths(self, tmp_path, monkeypatch):
        path = copy_machine(MACHINE, tmp_path)
        monkeypatch.chdir(tmp_path)
        assert (
            find_machine_file(path)
            == find_machine_file(str(path))
            == find_machine_file(MACHINE)
            == path.resolve()
        )
        path.rename(tmp_path / "OTHER.YML")
        assert crane.load("OTHER.YML").name == "four_bar"

    def test_reference_loads_the_same_machine_again(self, four_bar, mini):
        assert mini.load_name == "mini_forwarder"
        machine = four_bar()
        assert machine.load_name == str(machine.path)
        assert crane.load("ur5_robot").load_name == "ur5_robot"

    @pytest.mark.parametrize(
        ("name", "message"),
        [
            ("mini_forwader", "no machine and no file is named 'mini_forwader', "
             "did you mean 'mini_forwarder'?"),
            ("ur5_robt", "no machine and no file is named 'ur5_robt', did you mean 'ur5_robot'?"),
            ("elephant", "no machine and no file is named 'elephant', known: {bundled}; "
             "crane list --robots names more"),
            ("crane.yaml", "crane.yaml: no such file, check the path"),
            ("folder/crane.urdf", "folder/crane.urdf: no such file, check the path"),
            ("a\0b", "no machine and no file is named 'a b', known: {bundled}; "
             "crane list --robots names more"),
            ("folder", f"folder: {NO_MACHINE}"),
            ("", f".: {NO_MACHINE}"),
            ("a.txt", f"a.txt: {NO_MACHINE}"),
            ("folder.yaml", "folder.yaml: is a folder, give a file"),
            ("folder.urdf", "folder.urdf: is a folder, give a file"),
        ],
        ids=["misspelt", "misspelt-example", "far", "no-machine-file", "no-urdf", "nul", "folder",
             "empty", "text-file", "folder-yaml", "folder-urdf"],
    )  # fmt: skip
    def test_not_found(self, name, message, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        for folder in ("folder", "folder.yaml", "folder.urdf"):
            (tmp_path / folder).mkdir()
        (tmp_path / "a.txt").write_text("a crane")
        with pytest.raises(CraneError) as caught:
            crane.load(name)
        assert str(caught.value) == message.format(bundled=", ".join(sorted(bundled_machines())))

    @pytest.mark.parametrize("suffix", ["", ".yaml"])
    def test_name_longer_than_any_file(self, suffix):
        with pytest.raises(CraneError, match="cannot be read .*, check the path"):
            crane.load("x" * 5000 + suffix)


class TestWords:
    def test_errors_are_one_line(self):
        assert str(CraneError("a\nb\r\u2028c\x1b[31m\tä")) == "a b  c [31m ä"

    def test_nearest_name_or_all(self):
        assert suggest_names(["q1", "X1"]) == "known: X1, q1"
        assert suggest_names(["link2_D", "link2_E"], "link_2D") == "did you mean 'link2_D'?"
        assert suggest_names(["link2_D"], "boom") == "known: link2_D"
        assert suggest_names([]) == "there are none"

    def test_of_many_names_the_nearest_are_listed_first(self):
        names = [f"link_{i}" for i in range(40)] + ["bucket_lip", "bucket_load", "tip_fork"]
        assert suggest_names(names, "bucketlip") == "did you mean 'bucket_lip'?"
        told = suggest_names(names, "tip")
        assert told.startswith("the nearest of 43 known ones are tip_fork, ")
        assert told.count(",") == 7
        assert "bucket_lip, bucket_load" in suggest_names(names, "Bucket")
        assert suggest_names(names) == (
            "known: bucket_lip, bucket_load, link_0, link_1, link_10, link_11, link_12, link_13 "
            "and 35 more"
        )
        many = (f"n{i}" for i in range(10**5))
        assert len(suggest_names(many, "x")) < 200

    @pytest.mark.parametrize(
        ("mass", "moments", "problem"),
        [
            (1.0, (1, 1, 1), None),
            (1.0, (0, 1, 1), None),  # a slender rod
            (1.0, (1, 1, 2), None),  # a plate
            (1.0, (1, 1, 2.0001), None),  # a plate, rounded
            (1.0, (1, 1, 2.01), "no possible body"),
            (1.0, (-1e-6, 1, 1), None),  # a rod, rounded
            (1.0, (-0.01, 1, 1), "negative principal moment"),
            (1.0, (0, 0, 0), "no inertia"),
            (0.0, (0, 0, 0), None),
            (0.0, (1, 1, 1), None),  # a rotor whose mass stands elsewhere
            (0.0, (1, 1, 3), "no possible body"),
            (np.inf, (1, 1, 1), "beyond all numbers"),
            (1.0, (1, np.nan, 1), "beyond all numbers"),
        ],
    )
    def test_inertia_problem(self, mass, moments, problem):
        turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
        found = inertia_problem(mass, turn @ np.diag(moments) @ turn.T)
        assert found is None if problem is None else problem in str(found)


class TestDocumentation:
    PAGE = (MODELS.parent / "docs" / "machine_file.md").read_text()

    def test_example_loads(self, four_bar):
        (example,) = re.findall(r"```yaml\n(.*?)```", self.PAGE, re.S)
        machine = four_bar(Edit(MACHINE, None, example))
        assert machine.control and machine.end_stops and machine.forces and machine.tasks

    def test_example_has_every_section(self):
        (example,) = re.findall(r"```yaml\n(.*?)```", self.PAGE, re.S)
        sections = set(re.findall(r"^(\w+):", example, re.M))
        known = set(re.findall(r"^\| `(\w+)` \|", self.PAGE.split("### ")[0], re.M))
        # a four-bar has none of them
        elsewhere = {"couplings", "drives", "hydraulics", "identification"}
        elsewhere |= {"extends", "floating", "ground", "contacts", "soil", "cutters"}
        elsewhere |= {"supports", "pins", "gravity", "drawing"}
        assert sections == known - elsewhere
        for name in elsewhere:
            (section,) = re.findall(rf"^### [^\n]*`{name}`.*?(?=^### |\Z)", self.PAGE, re.M | re.S)
            assert re.search(rf"^    {name}:", section, re.M)

    @pytest.mark.parametrize("kind", LOOP_TYPES)
    def test_loop_types(self, kind):
        (row,) = re.findall(rf"^\| `{kind}` \| (.*?) \| (.*?) \| (\d) \|$", self.PAGE, re.M)
        locked = [int(axis in words.split(", ")) for words in row[:2] for axis in "xyz"]
        assert tuple(locked) == LOOP_TYPES[kind]
        assert int(row[2]) == sum(locked)


def test_machines_with_numbers_of_numpy_are_written(tmp_path):
    machine = crane.load("mini_forwarder")
    spring = crane.description.ForceElement(machine.active[0], np.float64(2.5), rest=np.float64(0))
    path = crane.write_machine(machine.replace(forces=(spring,)), tmp_path / "machine")
    (found,) = crane.load(path).forces
    assert found == crane.description.ForceElement(machine.active[0], 2.5)
