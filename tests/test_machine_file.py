"""Errors of broken machine files, line by line."""

import pytest
from broken_machines import ROCKER, assert_refused, case, swap, whole

LOAD = """<robot name="load"><link name="load"><inertial><mass value="2"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>
"""

LOOPED_LOAD = LOAD.replace(
    "</robot>",
    """<joint name="j" type="fixed"><parent link="load"/><child link="hook"/></joint>
  <link name="hook"/>
  <loop name="l" type="revolute"><predecessor link="load"/><successor link="hook"/>
  </loop></robot>""",
)

# What is not YAML, or not the YAML of a machine.
TEXT = [
    case("four_bar.yaml: the file is empty, write a machine in it", whole("")),
    case("four_bar.yaml: not a machine file, write keys such as 'name:'", whole("hello\n")),
    case(
        "four_bar.yaml:15: not YAML, found character '\\t' that cannot start any token, "
        "correct it",
        swap("  crank: 1.2", "\tcrank: 1.2"),
    ),
    case(
        "four_bar.yaml:5: not YAML, but found another document, correct it",
        swap("\nchains:", "\n---\nchains:"),
    ),
    case("four_bar.yaml: not UTF-8, save it as UTF-8 text", whole(b"name: kr\xe4n\n")),
    case(
        "four_bar.yaml: not YAML, it holds the control character number 0, remove it",
        whole("name: a\x00b\n"),
    ),
    case(
        "four_bar.yaml:2: not YAML, could not determine a constructor for the tag "
        "'tag:yaml.org,2002:python/object:os.system', correct it",
        swap("name: four_bar", "name: !!python/object:os.system x"),
    ),
    case(
        "four_bar.yaml:15: not YAML, '2024-13-45' is no value of its kind, quote it"
        " if it is text, correct it",
        swap("  crank: 1.2", "  crank: 2024-13-45"),
    ),
    case(
        "four_bar.yaml:15: '<<' is not supported, write the keys out",
        swap("  crank: 1.2", "  <<: {crank: 1.2}"),
    ),
    case("four_bar.yaml: nested too deep, simplify it", whole("name: " + "[" * 3000)),
    case(
        "four_bar.yaml:2: 'name' of the machine file is a list, give text (or quote it)",
        swap(
            "name: four_bar",
            "name: [&a [x,x,x,x,x,x,x,x,x], &b [*a,*a,*a,*a,*a,*a,*a,*a,*a], &c "
            "[*b,*b,*b,*b,*b,*b,*b,*b,*b], &d [*c,*c,*c,*c,*c,*c,*c,*c,*c], &e "
            "[*d,*d,*d,*d,*d,*d,*d,*d,*d], &f [*e,*e,*e,*e,*e,*e,*e,*e,*e], &g "
            "[*f,*f,*f,*f,*f,*f,*f,*f,*f], &h [*g,*g,*g,*g,*g,*g,*g,*g,*g], &i "
            "[*h,*h,*h,*h,*h,*h,*h,*h,*h], &j [*i,*i,*i,*i,*i,*i,*i,*i,*i], *j]",
        ),
    ),
    case(
        "four_bar.yaml:15: key True (in YAML, yes, no, on and off mean true and "
        "false) is not a name, write names in quotes",
        swap("  crank: 1.2", "  yes: 1.2"),
    ),
    case(
        "four_bar.yaml:29: unknown key 'tip  [31m' in the machine file, the nearest of 34 "
        "known ones are tip, active, floating, friction, end_stops, rotor_inertia, "
        "identification, home",
        swap("tip: coupler_pin", '"tip\\n\\e[31m": coupler_pin'),
        alone=False,
    ),
    case(
        "four_bar.yaml:7: 'name' of chain 'rock er' holds control characters, remove them",
        swap("{name: rocker,", '{name: "rock\\0er",'),
    ),
]

# Keys that are unknown, missing or empty.
KEYS = [
    case(
        "four_bar.yaml:29: unknown key 'weather' in the machine file, the nearest of 34 "
        "known ones are active, cutters, extends, home, name, start, rotor_inertia, control",
        swap("tip: coupler_pin", "weather: 9.81"),
        alone=False,
    ),
    case(
        "four_bar.yaml:39: unknown key 'X' in 'tip' of task 'reach', known: x, y, z",
        swap("tip: {x: [0.4]", "tip: {X: [0.4]"),
    ),
    case("four_bar.yaml:2: the machine file has no 'name', add it", swap("name: four_bar\n", "")),
    case(
        "four_bar.yaml: 1 degree of freedom and no active joints, name one: try "
        "[crank] (condition 1.6), or [coupler] (condition 1.47)",
        swap("active: [crank]", ""),
    ),
    case(
        "four_bar.yaml:5: there are no chains, add one under 'chains:', or a 'drawing:'",
        swap(
            "chains:\n"
            "  - {name: crank, urdf: four_bar/ground.urdf}\n"
            "  - {name: rocker, urdf: four_bar/rocker.urdf, parent: pin_B}\n",
            "chains: []\n",
        ),
    ),
    case(
        "four_bar.yaml:15: 'crank' of 'home' is empty, give its value",
        swap("  crank: 1.2", "  crank:"),
    ),
    case(
        "four_bar.yaml:21: friction of 'coupler' is empty, its keys are coulomb, "
        "coulomb_offset, viscous, viscous_offset, smoothing, stiction, stribeck, "
        "stiction_2, stribeck_2, root, presliding, presliding_length, memory, memory_time, "
        "memory_speed, drives",
        swap("{viscous: 0.01}", ""),
    ),
    case(
        "four_bar.yaml:37: task 'reach' has more than one of 'tip', 'active', "
        "'via', 'joystick', 'phases', give one",
        swap(
            "    tip: {x: [0.4], y: [0.3, 0.01], z: [0]}\n",
            "    tip: {x: [0.4], y: [0.3, 0.01], z: [0]}\n    active: {crank: [1]}\n",
        ),
    ),
    case(
        "four_bar.yaml:38: task 'reach' moves the tip, name its frame under 'tip:'",
        swap("tip: coupler_pin\n", ""),
    ),
]

# Values of a wrong kind.
TYPES = [
    case(
        "four_bar.yaml:5: 'chains' is a mapping, give a list, its items with '- '",
        swap(
            "chains:\n"
            "  - {name: crank, urdf: four_bar/ground.urdf}\n"
            "  - {name: rocker, urdf: four_bar/rocker.urdf, parent: pin_B}\n",
            "chains: {crank: ground.urdf}\n",
        ),
    ),
    case(
        "four_bar.yaml:5: 'chains' lists 'ground.urdf', write each item as {key: value}",
        swap("  - {name: crank, urdf: four_bar/ground.urdf}", "  - ground.urdf"),
    ),
    case(
        "four_bar.yaml:12: 'active' lists True (in YAML, yes, no, on and off mean "
        "true and false), which is not a name, quote it",
        swap("active: [crank]", "active: [on]"),
    ),
    case(
        "four_bar.yaml:15: 'crank' of 'home' is True (in YAML, yes, no, on and off "
        "mean true and false), give a number",
        swap("  crank: 1.2", "  crank: true"),
    ),
    case(
        "four_bar.yaml:36: 'crank' of 'active' of task 'swing' is empty, give a "
        "list such as [0, 1]",
        swap("[1.2, 0.4, -0.2]", "[]"),
    ),
    case(
        "four_bar.yaml:21: friction of 'coupler' is 0.01, give a mapping 'name: value'",
        swap("  coupler: {viscous: 0.01}", "  coupler: 0.01"),
    ),
    case(
        "four_bar.yaml:21: 'stribeck' of friction of 'coupler' is 0, give a velocity",
        swap("viscous: 0.01", "viscous: 0.01, stribeck: 0"),
    ),
    case(
        "four_bar.yaml:24: the force element of 'rocker' does nothing, give stiffness,"
        " damping or force",
        swap("stiffness: 2, rest: 1.5, damping: 0.1", "rest: 1.5"),
    ),
    case(
        "four_bar.yaml:27: the end stop of 'crank' has no stiffness, give one",
        swap("stiffness: 1e4", "stiffness: 0"),
    ),
    case(
        "four_bar.yaml:27: joint 'rocker' is continuous, a stop needs limits: make it revolute",
        swap("  crank: {stiffness", "  rocker: {stiffness"),
    ),
    case(
        "four_bar.yaml:10: 'axis' of loop 'pin' is 'z', give a list such as [0, 1]",
        swap("successor: rocker_pin}", "successor: rocker_pin, axis: z}"),
    ),
]

# Names of files, frames and joints that do not exist, or exist twice.
NAMES = [
    case(
        "four_bar.yaml:7: 'four_bar' of chain 'rocker' is a folder, give a file",
        swap("urdf: four_bar/rocker.urdf", "urdf: four_bar"),
    ),
    case(
        "four_bar.yaml:2: this is no URDF and has no section 'drawing'",
        swap("urdf: four_bar/rocker.urdf", "urdf: four_bar.yaml"),
    ),
    case(
        "four_bar.yaml:7: chain 'rocker' hangs from 'rocker_base', no frame of an "
        "earlier chain, known: coupler_arm, coupler_pin, crank_arm, ground, pin_B",
        swap("parent: pin_B", "parent: rocker_base"),
    ),
    case(
        "four_bar.yaml:7: chain 'rocker' has no 'parent', name the frame it hangs from",
        swap(", parent: pin_B", ""),
    ),
    case(
        "four_bar.yaml:6: chain 'crank' is first and stands on the world, remove its 'parent'",
        swap("urdf: four_bar/ground.urdf}", "urdf: four_bar/ground.urdf, parent: world}"),
    ),
    case(
        "four_bar.yaml:7: two chains are named 'crank', rename one",
        swap("{name: rocker,", "{name: crank,"),
    ),
    case(
        "rocker.urdf:15: link 'coupler_pin' is also in ground.urdf:39, rename one",
        swap('<link name="rocker_pin"/>', '<link name="coupler_pin"/>', ROCKER),
        swap('<child link="rocker_pin"/>', '<child link="coupler_pin"/>', ROCKER),
    ),
    case(
        "rocker.urdf:16: joint 'rocker_attachment' is also in four_bar.yaml:7, rename one",
        swap('<joint name="rocker_pin_fixed"', '<joint name="rocker_attachment"', ROCKER),
    ),
    case(
        "rocker.urdf:21: a sub-chain has no <loop>, write it under 'loops' of four_bar.yaml",
        swap(
            "</robot>",
            '<loop name="l" type="revolute"><predecessor link="rocker_base"/><successor'
            ' link="rocker_pin"/></loop></robot>',
            ROCKER,
        ),
    ),
    case(
        "four_bar.yaml:10: loop 'pin' has the unknown successor 'tool', known: "
        "coupler_arm, coupler_pin, crank_arm, ground, pin_B, rocker_arm, "
        "rocker_base, rocker_pin",
        swap("successor: rocker_pin", "successor: tool"),
    ),
    case(
        "four_bar.yaml:11: two loops are named 'pin', rename one",
        swap(
            "successor: rocker_pin}\n",
            "successor: rocker_pin}\n"
            "  - {name: pin, type: revolute, predecessor: coupler_pin, successor: rocker_pin}\n",
        ),
    ),
    case(
        "four_bar.yaml:10: loop 'pin' joins 'coupler_pin' and 'coupler_arm', both "
        "on the body 'coupler_arm': choose frames of two bodies",
        swap("successor: rocker_pin", "successor: coupler_arm"),
    ),
    case(
        "four_bar.yaml:12: 'active' lists 'crank' twice, list it once",
        swap("active: [crank]", "active: [crank, crank]"),
    ),
    case(
        "four_bar.yaml:29: 'couplr' under 'pins' is no joint or loop, did you mean 'coupler'?",
        swap("tip: coupler_pin", "pins: {couplr: 5}\ntip: coupler_pin"),
    ),
    case(
        "four_bar.yaml:29: the pin 'coupler' bears 0 N, give a force above 0",
        swap("tip: coupler_pin", "pins: {coupler: 0}\ntip: coupler_pin"),
    ),
    case(
        "four_bar.yaml:29: the tip frame 'rocker_base' does not move, choose another",
        swap("tip: coupler_pin", "tip: rocker_base"),
    ),
    case(
        "four_bar.yaml:29: a payload hangs on the tip, name its frame under 'tip:'",
        swap("tip: coupler_pin", "payload: {urdf: load.urdf}"),
        whole(LOAD, "load.urdf"),
        alone=False,
    ),
    case(
        "rocker.urdf:3: joint 'rocker' moves, a payload is rigid: make it fixed",
        swap("tip: coupler_pin", "tip: coupler_pin\npayload: {urdf: four_bar/rocker.urdf}"),
        alone=False,
    ),
    case(
        "four_bar.yaml:30: no link of load.urdf has a mass, give one an <inertial>",
        swap("tip: coupler_pin", "tip: coupler_pin\npayload: {urdf: load.urdf}"),
        whole('<robot name="load"><link name="load"/></robot>', "load.urdf"),
    ),
    case(
        "load.urdf:1: link 'ground' is also in ground.urdf:2, rename one",
        swap("tip: coupler_pin", "tip: coupler_pin\npayload: {urdf: load.urdf}"),
        whole(LOAD.replace('link name="load"', 'link name="ground"'), "load.urdf"),
    ),
    case(
        "four_bar.yaml:30: unknown key 'mass' in 'payload', known: urdf",
        swap("tip: coupler_pin", "tip: coupler_pin\npayload: {urdf: lod.urdf, mass: 2}"),
    ),
    case(
        "load.urdf:4: a payload has no <loop>, remove it",
        swap("tip: coupler_pin", "tip: coupler_pin\npayload: {urdf: load.urdf}"),
        whole(LOOPED_LOAD, "load.urdf"),
    ),
    case(
        "four_bar.yaml:42: 'rocker' is not an active joint, known: crank",
        swap("  crank: {kp", "  rocker: {kp"),
    ),
    case(
        "four_bar.yaml:42: no gains for coupler, give kp and ki of each",
        swap("active: [crank]", "active: [crank, coupler]"),
        swap("      crank: [1.2, 0.4, -0.2]", "      crank: [1.2]\n      coupler: [0]"),
    ),
]


@pytest.mark.parametrize("broken", [*TEXT, *KEYS, *TYPES, *NAMES])
def test_is_refused(broken, tmp_path):
    assert_refused(broken, tmp_path)
