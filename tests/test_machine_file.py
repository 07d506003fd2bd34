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
    case("empty file", "four_bar.yaml: the file is empty, write a machine in it", whole("")),
    case(
        "only comments",
        "four_bar.yaml: the file is empty, write a machine in it",
        whole("# nothing\n"),
    ),
    case(
        "a list",
        "four_bar.yaml: not a machine file, write keys such as 'name:'",
        whole("- a\n- b\n"),
    ),
    case(
        "plain text",
        "four_bar.yaml: not a machine file, write keys such as 'name:'",
        whole("hello\n"),
    ),
    case(
        "bracket not closed",
        "four_bar.yaml:14: not YAML, expected ',' or ']', but got ':', correct it",
        swap("active: [crank]", "active: [crank"),
    ),
    case(
        "tab",
        "four_bar.yaml:15: not YAML, found character '\\t' that cannot start any token, "
        "correct it",
        swap("  crank: 1.2", "\tcrank: 1.2"),
    ),
    case(
        "two documents",
        "four_bar.yaml:5: not YAML, but found another document, correct it",
        swap("\nchains:", "\n---\nchains:"),
    ),
    case(
        "not UTF-8", "four_bar.yaml: not UTF-8, save it as UTF-8 text", whole(b"name: kr\xe4n\n")
    ),
    case(
        "control character",
        "four_bar.yaml: not YAML, it holds the control character number 0, remove it",
        whole("name: a\x00b\n"),
    ),
    case(
        "python object",
        "four_bar.yaml:2: not YAML, could not determine a constructor for the tag "
        "'tag:yaml.org,2002:python/object:os.system', correct it",
        swap("name: four_bar", "name: !!python/object:os.system x"),
    ),
    case(
        "impossible date",
        "four_bar.yaml:15: not YAML, '2024-13-45' is no value of its kind, quote it"
        " if it is text, correct it",
        swap("  crank: 1.2", "  crank: 2024-13-45"),
    ),
    case(
        "number without digits",
        "four_bar.yaml:15: 'crank' of 'home' is '0x_', and 'x_' is no known unit, give a number "
        "in rad, as in 5 deg",
        swap("  crank: 1.2", "  crank: 0x_"),
    ),
    case(
        "merge key",
        "four_bar.yaml:15: '<<' is not supported, write the keys out",
        swap("  crank: 1.2", "  <<: {crank: 1.2}"),
    ),
    case(
        "nested too deep",
        "four_bar.yaml: nested too deep, simplify it",
        whole(
            "name: "
            "[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[["
        ),
    ),
    case(
        "aliases that grow",
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
        "key twice",
        "four_bar.yaml:30: key 'tip' is there twice (first in line 29), keep one",
        swap("tip: coupler_pin", "tip: coupler_pin\ntip: rocker_pin"),
    ),
    case(
        "joint twice in home",
        "four_bar.yaml:18: key 'rocker' is there twice (first in line 17), keep one",
        swap("  rocker: 1.5\n", "  rocker: 1.5\n  rocker: 1.4\n"),
    ),
    case(
        "key twice in a chain",
        "four_bar.yaml:6: key 'urdf' is there twice (first in line 6), keep one",
        swap(
            "{name: crank, urdf: four_bar/ground.urdf}",
            "{name: crank, urdf: four_bar/ground.urdf, urdf: four_bar/rocker.urdf}",
        ),
    ),
    case(
        "number as key",
        "four_bar.yaml:15: key 3 is not a name, write names in quotes, and decimals with a point",
        swap("  crank: 1.2", "  3: 1.2"),
    ),
    case(
        "yes as key",
        "four_bar.yaml:15: key True (in YAML, yes, no, on and off mean true and "
        "false) is not a name, write names in quotes",
        swap("  crank: 1.2", "  yes: 1.2"),
    ),
    case(
        "decimal comma in braces",
        "four_bar.yaml:21: key 1 is not a name, write names in quotes, and decimals with a point",
        swap("{viscous: 0.01}", "{viscous: 0,01}"),
    ),
    case(
        "decimal comma",
        "four_bar.yaml:15: 'crank' of 'home' is '1,2', give a number with a decimal point",
        swap("  crank: 1.2", "  crank: 1,2"),
    ),
    case(
        "control characters in a key",
        "four_bar.yaml:29: unknown key 'tip  [31m' in the machine file, the nearest of 31 "
        "known ones are tip, active, floating, friction, end_stops, rotor_inertia, "
        "identification, home",
        swap("tip: coupler_pin", '"tip\\n\\e[31m": coupler_pin'),
    ),
    case(
        "control characters in a name",
        "four_bar.yaml:7: 'name' of chain 'rock er' holds control characters, remove them",
        swap("{name: rocker,", '{name: "rock\\0er",'),
    ),
]

# Keys that are unknown, missing or empty.
KEYS = [
    case(
        "unknown key",
        "four_bar.yaml:29: unknown key 'tipp' in the machine file, did you mean 'tip'?",
        swap("tip: coupler_pin", "tipp: coupler_pin"),
    ),
    case(
        "unknown key far from all",
        "four_bar.yaml:29: unknown key 'gravity' in the machine file, the nearest of 31 "
        "known ones are friction, hydraulics, gas_springs, active, chains, drives, ground, "
        "payload",
        swap("tip: coupler_pin", "gravity: 9.81"),
    ),
    case(
        "misspelt section",
        "four_bar.yaml:5: unknown key 'chain' in the machine file, did you mean 'chains'?",
        swap("chains:", "chain:"),
    ),
    case(
        "unknown key of a chain",
        "four_bar.yaml:7: unknown key 'parrent' in chain 'rocker', did you mean 'parent'?",
        swap("parent: pin_B", "parrent: pin_B"),
    ),
    case(
        "unknown key of a loop",
        "four_bar.yaml:10: unknown key 'predecesor' in loop 'pin', did you mean 'predecessor'?",
        swap("predecessor: coupler_pin", "predecesor: coupler_pin"),
    ),
    case(
        "unknown key of friction",
        "four_bar.yaml:20: unknown key 'colomb' in friction of 'crank', did you mean 'coulomb'?",
        swap("coulomb: 0.3", "colomb: 0.3"),
    ),
    case(
        "unknown key of a force",
        "four_bar.yaml:24: unknown key 'rset' in force element of 'rocker', did you mean 'rest'?",
        swap("rest: 1.5", "rset: 1.5"),
    ),
    case(
        "unknown key of an end stop",
        "four_bar.yaml:27: unknown key 'stifness' in end stop of 'crank', did you "
        "mean 'stiffness'?",
        swap("stiffness: 1e4", "stifness: 1e4"),
    ),
    case(
        "unknown key of a task",
        "four_bar.yaml:38: unknown key 'duraton' in task 'reach', did you mean 'duration'?",
        swap("duration: 1\n", "duraton: 1\n"),
    ),
    case(
        "unknown coordinate of a task",
        "four_bar.yaml:39: unknown key 'X' in 'tip' of task 'reach', known: x, y, z",
        swap("tip: {x: [0.4]", "tip: {X: [0.4]"),
    ),
    case(
        "unknown joint of a task",
        "four_bar.yaml:36: unknown key 'cranc' in 'active' of task 'swing', did you mean 'crank'?",
        swap("      crank: [1.2", "      cranc: [1.2"),
    ),
    case(
        "unknown key of control",
        "four_bar.yaml:42: unknown key 'kP' in control of 'crank', known: ki, kp",
        swap("kp: 50", "kP: 50"),
    ),
    case(
        "no name",
        "four_bar.yaml:2: the machine file has no 'name', add it",
        swap("name: four_bar\n", ""),
    ),
    case(
        "no active",
        "four_bar.yaml: 1 degree of freedom and no active joints, name one: try "
        "[crank] (condition 1.6), or [coupler] (condition 1.47)",
        swap("active: [crank]", ""),
    ),
    case(
        "no chains",
        "four_bar.yaml:2: there are no chains, add one under 'chains:'",
        swap(
            "chains:\n"
            "  - {name: crank, urdf: four_bar/ground.urdf}\n"
            "  - {name: rocker, urdf: four_bar/rocker.urdf, parent: pin_B}\n",
            "",
        ),
    ),
    case(
        "empty chains",
        "four_bar.yaml:5: there are no chains, add one under 'chains:'",
        swap(
            "chains:\n"
            "  - {name: crank, urdf: four_bar/ground.urdf}\n"
            "  - {name: rocker, urdf: four_bar/rocker.urdf, parent: pin_B}\n",
            "chains: []\n",
        ),
    ),
    case(
        "chain without file",
        "four_bar.yaml:6: chain 'crank' has no 'urdf', add it",
        swap(", urdf: four_bar/ground.urdf", ""),
    ),
    case(
        "home without value",
        "four_bar.yaml:15: 'crank' of 'home' is empty, give its value",
        swap("  crank: 1.2", "  crank:"),
    ),
    case(
        "friction without value",
        "four_bar.yaml:21: friction of 'coupler' is empty, its keys are coulomb, "
        "coulomb_offset, viscous, viscous_offset, smoothing, stiction, stribeck, drives",
        swap("{viscous: 0.01}", ""),
    ),
    case(
        "end stop without value",
        "four_bar.yaml:27: end stop of 'crank' is empty, its keys are stiffness, damping",
        swap("{stiffness: 1e4, damping: 2}", "{}"),
    ),
    case(
        "control without ki",
        "four_bar.yaml:42: control of 'crank' has no 'ki', add it",
        swap(", ki: 20", ""),
    ),
    case(
        "task without motion",
        "four_bar.yaml:37: task 'reach' has none of 'tip', 'active', 'via', 'joystick', 'phases', "
        "give one",
        swap("    tip: {x: [0.4], y: [0.3, 0.01], z: [0]}\n", ""),
    ),
    case(
        "task with two motions",
        "four_bar.yaml:37: task 'reach' has more than one of 'tip', 'active', "
        "'via', 'joystick', 'phases', give one",
        swap(
            "    tip: {x: [0.4], y: [0.3, 0.01], z: [0]}\n",
            "    tip: {x: [0.4], y: [0.3, 0.01], z: [0]}\n    active: {crank: [1]}\n",
        ),
    ),
    case(
        "task without y",
        "four_bar.yaml:39: 'tip' of task 'reach' has no 'y', add it",
        swap("y: [0.3, 0.01], ", ""),
    ),
    case(
        "task without duration",
        "four_bar.yaml:37: task 'reach' has no 'duration', add it",
        swap("    duration: 1\n", ""),
    ),
    case(
        "task of the tip without tip",
        "four_bar.yaml:38: task 'reach' moves the tip, name its frame under 'tip:'",
        swap("tip: coupler_pin\n", ""),
    ),
]

# Values of a wrong kind.
TYPES = [
    case(
        "name is a number",
        "four_bar.yaml:2: 'name' of the machine file is 4, give text (or quote it)",
        swap("name: four_bar", "name: 4"),
    ),
    case(
        "name is a list",
        "four_bar.yaml:2: 'name' of the machine file is a list, give text (or quote it)",
        swap("name: four_bar", "name: [a, b]"),
    ),
    case(
        "chains is a mapping",
        "four_bar.yaml:5: 'chains' is a mapping, give a list, its items with '- '",
        swap(
            "chains:\n"
            "  - {name: crank, urdf: four_bar/ground.urdf}\n"
            "  - {name: rocker, urdf: four_bar/rocker.urdf, parent: pin_B}\n",
            "chains: {crank: ground.urdf}\n",
        ),
    ),
    case(
        "chain is text",
        "four_bar.yaml:5: 'chains' lists 'ground.urdf', write each item as {key: value}",
        swap("  - {name: crank, urdf: four_bar/ground.urdf}", "  - ground.urdf"),
    ),
    case(
        "active is text",
        "four_bar.yaml:12: 'active' of the machine file is 'crank', give a list such as [q1, q2]",
        swap("active: [crank]", "active: crank"),
    ),
    case(
        "active lists a number",
        "four_bar.yaml:12: 'active' lists 1, which is not a name, quote it",
        swap("active: [crank]", "active: [1]"),
    ),
    case(
        "active lists on",
        "four_bar.yaml:12: 'active' lists True (in YAML, yes, no, on and off mean "
        "true and false), which is not a name, quote it",
        swap("active: [crank]", "active: [on]"),
    ),
    case(
        "active is empty",
        "four_bar.yaml:12: 1 degree of freedom and no active joints, name one: try "
        "[crank] (condition 1.6), or [coupler] (condition 1.47)",
        swap("active: [crank]", "active: []"),
    ),
    case(
        "home is a list",
        "four_bar.yaml:14: 'home' is a list, give a mapping 'name: value'",
        swap("home:\n  crank: 1.2\n  coupler: -1.0\n  rocker: 1.5", "home: [1.2]"),
    ),
    case(
        "home is text",
        "four_bar.yaml:15: 'crank' of 'home' is 'up', give a number in rad, as in 5 deg",
        swap("  crank: 1.2", "  crank: up"),
    ),
    case(
        "home is true",
        "four_bar.yaml:15: 'crank' of 'home' is True (in YAML, yes, no, on and off "
        "mean true and false), give a number",
        swap("  crank: 1.2", "  crank: true"),
    ),
    case(
        "home is nan",
        "four_bar.yaml:15: 'crank' of 'home' is nan, give a finite number",
        swap("  crank: 1.2", "  crank: .nan"),
    ),
    case(
        "home is infinite",
        "four_bar.yaml:15: 'crank' of 'home' is -inf, give a finite number",
        swap("  crank: 1.2", "  crank: -.inf"),
    ),
    case(
        "home holds a list",
        "four_bar.yaml:15: 'crank' of 'home' is a list, give a number",
        swap("  crank: 1.2", "  crank: [1.2]"),
    ),
    case(
        "task holds nan",
        "four_bar.yaml:36: 'crank' of 'active' of task 'swing' is nan, give a finite number",
        swap("[1.2, 0.4, -0.2]", "[1.2, .nan]"),
    ),
    case(
        "task holds a number",
        "four_bar.yaml:36: 'crank' of 'active' of task 'swing' is 1.2, give a list such as [0, 1]",
        swap("[1.2, 0.4, -0.2]", "1.2"),
    ),
    case(
        "task holds an empty list",
        "four_bar.yaml:36: 'crank' of 'active' of task 'swing' is empty, give a "
        "list such as [0, 1]",
        swap("[1.2, 0.4, -0.2]", "[]"),
    ),
    case(
        "task takes no time",
        "four_bar.yaml:34: task 'swing' takes no time, give a duration",
        swap("duration: 2", "duration: 0"),
    ),
    case(
        "task goes back in time",
        "four_bar.yaml:34: 'duration' of task 'swing' is -2, give at least 0",
        swap("duration: 2", "duration: -2"),
    ),
    case(
        "friction is a number",
        "four_bar.yaml:21: friction of 'coupler' is 0.01, give a mapping 'name: value'",
        swap("  coupler: {viscous: 0.01}", "  coupler: 0.01"),
    ),
    case(
        "viscous is negative",
        "four_bar.yaml:21: 'viscous' of friction of 'coupler' is -0.01, give at least 0",
        swap("viscous: 0.01", "viscous: -0.01"),
    ),
    case(
        "no Stribeck velocity",
        "four_bar.yaml:21: 'stribeck' of friction of 'coupler' is 0, give a velocity",
        swap("viscous: 0.01", "viscous: 0.01, stribeck: 0"),
    ),
    case(
        "force does nothing",
        "four_bar.yaml:24: the force element of 'rocker' does nothing, give stiffness,"
        " damping or force",
        swap("stiffness: 2, rest: 1.5, damping: 0.1", "rest: 1.5"),
    ),
    case(
        "end stop has no stiffness",
        "four_bar.yaml:27: the end stop of 'crank' has no stiffness, give one",
        swap("stiffness: 1e4", "stiffness: 0"),
    ),
    case(
        "end stop without limits",
        "four_bar.yaml:27: joint 'rocker' is continuous, a stop needs limits: make it revolute",
        swap("  crank: {stiffness", "  rocker: {stiffness"),
    ),
    case(
        "kp is negative",
        "four_bar.yaml:42: 'kp' of control of 'crank' is -50, give at least 0",
        swap("kp: 50", "kp: -50"),
    ),
    case(
        "loop axis is zero",
        "four_bar.yaml:10: the axis of loop 'pin' is no direction, give three "
        "numbers, not all zero",
        swap("successor: rocker_pin}", "successor: rocker_pin, axis: [0, 0, 0]}"),
    ),
    case(
        "loop axis has two numbers",
        "four_bar.yaml:10: the axis of loop 'pin' is no direction, give three "
        "numbers, not all zero",
        swap("successor: rocker_pin}", "successor: rocker_pin, axis: [0, 1]}"),
    ),
    case(
        "loop axis is text",
        "four_bar.yaml:10: 'axis' of loop 'pin' is 'z', give a list such as [0, 1]",
        swap("successor: rocker_pin}", "successor: rocker_pin, axis: z}"),
    ),
]

# Names of files, frames and joints that do not exist, or exist twice.
NAMES = [
    case(
        "missing URDF",
        "four_bar.yaml:7: chain 'rocker': there is no file 'four_bar/roker.urdf', "
        "give its path from this folder",
        swap("urdf: four_bar/rocker.urdf", "urdf: four_bar/roker.urdf"),
    ),
    case(
        "URDF is a folder",
        "four_bar.yaml:7: 'four_bar' of chain 'rocker' is a folder, give a file",
        swap("urdf: four_bar/rocker.urdf", "urdf: four_bar"),
    ),
    case(
        "URDF is a machine file",
        "four_bar.yaml:1: not XML, Start tag expected, '<' not found, correct it",
        swap("urdf: four_bar/rocker.urdf", "urdf: four_bar.yaml"),
    ),
    case(
        "unknown parent",
        "four_bar.yaml:7: chain 'rocker' hangs from 'pin_C', no frame of an earlier"
        " chain, did you mean 'pin_B'?",
        swap("parent: pin_B", "parent: pin_C"),
    ),
    case(
        "parent in the chain itself",
        "four_bar.yaml:7: chain 'rocker' hangs from 'rocker_base', no frame of an "
        "earlier chain, known: coupler_arm, coupler_pin, crank_arm, ground, pin_B",
        swap("parent: pin_B", "parent: rocker_base"),
    ),
    case(
        "chain without parent",
        "four_bar.yaml:7: chain 'rocker' has no 'parent', name the frame it hangs from",
        swap(", parent: pin_B", ""),
    ),
    case(
        "first chain with parent",
        "four_bar.yaml:6: chain 'crank' is first and stands on the world, remove its 'parent'",
        swap("urdf: four_bar/ground.urdf}", "urdf: four_bar/ground.urdf, parent: world}"),
    ),
    case(
        "two chains of one name",
        "four_bar.yaml:7: two chains are named 'crank', rename one",
        swap("{name: rocker,", "{name: crank,"),
    ),
    case(
        "one URDF twice",
        "ground.urdf:2: link 'ground' is also in ground.urdf:2, rename one",
        swap("urdf: four_bar/rocker.urdf", "urdf: four_bar/ground.urdf"),
    ),
    case(
        "same link in two chains",
        "rocker.urdf:15: link 'coupler_pin' is also in ground.urdf:39, rename one",
        swap('<link name="rocker_pin"/>', '<link name="coupler_pin"/>', ROCKER),
        swap('<child link="rocker_pin"/>', '<child link="coupler_pin"/>', ROCKER),
    ),
    case(
        "same joint in two chains",
        "rocker.urdf:3: joint 'crank' is also in ground.urdf:10, rename one",
        swap('<joint name="rocker"', '<joint name="crank"', ROCKER),
    ),
    case(
        "same fixed joint in two chains",
        "rocker.urdf:16: joint 'pin_B_fixed' is also in ground.urdf:4, rename one",
        swap('<joint name="rocker_pin_fixed"', '<joint name="pin_B_fixed"', ROCKER),
    ),
    case(
        "joint named as an attachment",
        "rocker.urdf:16: joint 'rocker_attachment' is also in four_bar.yaml:7, rename one",
        swap('<joint name="rocker_pin_fixed"', '<joint name="rocker_attachment"', ROCKER),
    ),
    case(
        "loop in a sub-chain",
        "rocker.urdf:21: a sub-chain has no <loop>, write it under 'loops' of four_bar.yaml",
        swap(
            "</robot>",
            '<loop name="l" type="revolute"><predecessor link="rocker_base"/><successor'
            ' link="rocker_pin"/></loop></robot>',
            ROCKER,
        ),
    ),
    case(
        "unknown predecessor",
        "four_bar.yaml:10: loop 'pin' has the unknown predecessor 'coupler_pn', did"
        " you mean 'coupler_pin'?",
        swap("predecessor: coupler_pin", "predecessor: coupler_pn"),
    ),
    case(
        "unknown successor",
        "four_bar.yaml:10: loop 'pin' has the unknown successor 'tool', known: "
        "coupler_arm, coupler_pin, crank_arm, ground, pin_B, rocker_arm, "
        "rocker_base, rocker_pin",
        swap("successor: rocker_pin", "successor: tool"),
    ),
    case(
        "misspelt loop type",
        "four_bar.yaml:10: 'type' of loop 'pin': 'revolve' is unknown, did you mean 'revolute'?",
        swap("type: revolute", "type: revolve"),
    ),
    case(
        "unknown loop type",
        "four_bar.yaml:10: 'type' of loop 'pin': 'hinge' is unknown, known: "
        "cylindrical, fixed, planar, prismatic, revolute, spherical",
        swap("type: revolute", "type: hinge"),
    ),
    case(
        "two loops of one name",
        "four_bar.yaml:11: two loops are named 'pin', rename one",
        swap(
            "successor: rocker_pin}\n",
            "successor: rocker_pin}\n"
            "  - {name: pin, type: revolute, predecessor: coupler_pin, successor: rocker_pin}\n",
        ),
    ),
    case(
        "loop from a frame to itself",
        "four_bar.yaml:10: loop 'pin' joins 'coupler_pin' and 'coupler_pin', both "
        "on the body 'coupler_arm': choose frames of two bodies",
        swap("successor: rocker_pin", "successor: coupler_pin"),
    ),
    case(
        "loop within a body",
        "four_bar.yaml:10: loop 'pin' joins 'coupler_pin' and 'coupler_arm', both "
        "on the body 'coupler_arm': choose frames of two bodies",
        swap("successor: rocker_pin", "successor: coupler_arm"),
    ),
    case(
        "loop within a body over two chains",
        "four_bar.yaml:10: loop 'pin' joins 'ground' and 'rocker_base', both on the"
        " body 'ground': choose frames of two bodies",
        swap(
            "predecessor: coupler_pin, successor: rocker_pin",
            "predecessor: ground, successor: rocker_base",
        ),
    ),
    case(
        "unknown active joint",
        "four_bar.yaml:12: joint 'crnk' is unknown, did you mean 'crank'?",
        swap("active: [crank]", "active: [crnk]"),
    ),
    case(
        "fixed active joint",
        "four_bar.yaml:12: joint 'pin_B_fixed' is fixed, name a moving one",
        swap("active: [crank]", "active: [pin_B_fixed]"),
    ),
    case(
        "active joint twice",
        "four_bar.yaml:12: 'active' lists 'crank' twice, list it once",
        swap("active: [crank]", "active: [crank, crank]"),
    ),
    case(
        "unknown joint in home",
        "four_bar.yaml:16: joint 'couple' is unknown, did you mean 'coupler'?",
        swap("  coupler: -1.0", "  couple: -1.0"),
    ),
    case(
        "unknown joint in friction",
        "four_bar.yaml:21: joint 'couplr' is unknown, did you mean 'coupler'?",
        swap("  coupler: {viscous", "  couplr: {viscous"),
    ),
    case(
        "unknown pin",
        "four_bar.yaml:29: 'couplr' under 'pins' is no joint or loop, did you mean 'coupler'?",
        swap("tip: coupler_pin", "pins: {couplr: 5}\ntip: coupler_pin"),
    ),
    case(
        "pin that bears nothing",
        "four_bar.yaml:29: the pin 'coupler' bears 0 N, give a force above 0",
        swap("tip: coupler_pin", "pins: {coupler: 0}\ntip: coupler_pin"),
    ),
    case(
        "pin without number",
        "four_bar.yaml:29: 'coupler' of 'pins' is 'a', give a number in N, as in 5 kN",
        swap("tip: coupler_pin", "pins: {coupler: a}\ntip: coupler_pin"),
    ),
    case(
        "unknown joint in forces",
        "four_bar.yaml:24: joint 'roker' is unknown, did you mean 'rocker'?",
        swap("{joint: rocker,", "{joint: roker,"),
    ),
    case(
        "unknown joint in end stops",
        "four_bar.yaml:27: joint 'crnk' is unknown, did you mean 'crank'?",
        swap("  crank: {stiffness", "  crnk: {stiffness"),
    ),
    case(
        "unknown tip",
        "four_bar.yaml:29: the tip frame 'couplr_pin' is unknown, did you mean 'coupler_pin'?",
        swap("tip: coupler_pin", "tip: couplr_pin"),
    ),
    case(
        "tip fixed to the world",
        "four_bar.yaml:29: the tip frame 'rocker_base' does not move, choose another",
        swap("tip: coupler_pin", "tip: rocker_base"),
    ),
    case(
        "payload without a tip",
        "four_bar.yaml:29: a payload hangs on the tip, name its frame under 'tip:'",
        swap("tip: coupler_pin", "payload: {urdf: load.urdf}"),
        whole(LOAD, "load.urdf"),
    ),
    case(
        "payload with a moving joint",
        "rocker.urdf:3: joint 'rocker' moves, a payload is rigid: make it fixed",
        swap("tip: coupler_pin", "tip: coupler_pin\npayload: {urdf: four_bar/rocker.urdf}"),
    ),
    case(
        "payload without mass",
        "four_bar.yaml:30: no link of load.urdf has a mass, give one an <inertial>",
        swap("tip: coupler_pin", "tip: coupler_pin\npayload: {urdf: load.urdf}"),
        whole('<robot name="load"><link name="load"/></robot>', "load.urdf"),
    ),
    case(
        "payload with a name of the machine",
        "load.urdf:1: link 'ground' is also in ground.urdf:2, rename one",
        swap("tip: coupler_pin", "tip: coupler_pin\npayload: {urdf: load.urdf}"),
        whole(LOAD.replace('link name="load"', 'link name="ground"'), "load.urdf"),
    ),
    case(
        "payload without a file",
        "four_bar.yaml:30: 'payload': there is no file 'lod.urdf', give its path from this folder",
        swap("tip: coupler_pin", "tip: coupler_pin\npayload: {urdf: lod.urdf}"),
    ),
    case(
        "payload with another key",
        "four_bar.yaml:30: unknown key 'mass' in 'payload', known: urdf",
        swap("tip: coupler_pin", "tip: coupler_pin\npayload: {urdf: lod.urdf, mass: 2}"),
    ),
    case(
        "payload with a loop",
        "load.urdf:4: a payload has no <loop>, remove it",
        swap("tip: coupler_pin", "tip: coupler_pin\npayload: {urdf: load.urdf}"),
        whole(LOOPED_LOAD, "load.urdf"),
    ),
    case(
        "control of a passive joint",
        "four_bar.yaml:42: 'rocker' is not an active joint, known: crank",
        swap("  crank: {kp", "  rocker: {kp"),
    ),
    case(
        "control not of all",
        "four_bar.yaml:42: no gains for coupler, give kp and ki of each",
        swap("active: [crank]", "active: [crank, coupler]"),
        swap("      crank: [1.2, 0.4, -0.2]", "      crank: [1.2]\n      coupler: [0]"),
    ),
]


@pytest.mark.parametrize("broken", [*TEXT, *KEYS, *TYPES, *NAMES])
def test_is_refused(broken, tmp_path):
    assert_refused(broken, tmp_path)
