"""A load on one or two hydraulic cylinders, written as machine files."""

from pathlib import Path

import yaml

import crane

AREA_A, AREA_B, STROKE = 7.853981633974483e-3, 5.390973158159084e-3, 0.535
HOSE = 1.9e-4

ORIFICE = {"type": "orifice", "c1": 4e-7, "c2": 5e-7, "c3": 6e-7, "c4": 7e-7}
COMPENSATED = {
    "type": "compensated", "flow": 40 / 6e4, "margin": 7e5, "neutral": 5.8, "full": 2.8,
    "dead_band": 0.1143,
}  # fmt: skip


def rig(
    folder: Path,
    valve=None,
    cylinder=None,
    supply=None,
    oil=None,
    mass=2000.0,
    joints=("x",),
    axis="0 0 1",
    friction=None,
    stops=2e7,
    control=None,
    lower=0.0,
    motors=None,
    valves=None,
    cylinders=None,
    inertia=9.0,
    locked=None,
    changes=None,
    **more,
):
    """Vertical (or along `axis`) masses, each on a cylinder; dictionaries replace numbers.

    Args:
        motors: Motors by joint, which turns on without limits then.
        valves: What of the valves is different, by joint; None in place of a number takes it off.
        cylinders: What of the cylinders is different, by joint.
        inertia: That a motor turns [kg m2].
        locked: Joints to lock.
        changes: Numbers to change.
        more: Further sections: supplies, engine, lines, accumulators, elements.
    """
    motors = motors or {}
    own = [x for x in joints if x not in motors or x in (cylinders or {})]
    links = ['<link name="base"/>']
    for joint in joints:
        if joint not in own:
            links.append(
                f'<link name="load_{joint}"><inertial><mass value="1"/>'
                f'<inertia ixx="{inertia}" ixy="0" ixz="0" iyy="{inertia}" iyz="0" '
                f'izz="{inertia}"/></inertial></link><joint name="{joint}" type="continuous">'
                f'<parent link="base"/><child link="load_{joint}"/><axis xyz="0 0 1"/></joint>'
            )
            continue
        links.append(
            f'<link name="load_{joint}"><inertial><mass value="{mass}"/>'
            '<inertia ixx="9" ixy="0" ixz="0" iyy="9" iyz="0" izz="9"/></inertial></link>'
            f'<joint name="{joint}" type="prismatic"><parent link="base"/>'
            f'<child link="load_{joint}"/><axis xyz="{axis}"/>'
            f'<limit lower="{lower}" upper="{lower + STROKE}" effort="1e6" velocity="1"/></joint>'
        )
    (folder / "rig.urdf").write_text(f'<robot name="rig">{"".join(links)}</robot>')
    parts = {"area_a": AREA_A, "area_b": AREA_B, "hose_a": HOSE, "hose_b": HOSE} | (cylinder or {})
    hydraulics = {
        "supply": {"pressure": 9.25e6} | (supply or {}),
        "oil": {"bulk_modulus": 1.2e9} | (oil or {}),
        "cylinders": {x: parts | (cylinders or {}).get(x, {}) for x in own},
        "valves": {x: _but(valve or ORIFICE, (valves or {}).get(x, {})) for x in joints},
    } | more
    if motors:
        hydraulics["motors"] = motors
        hydraulics["cylinders"] = hydraulics["cylinders"] or None
    hydraulics = {key: value for key, value in hydraulics.items() if value is not None}
    if control:
        hydraulics["control"] = dict.fromkeys(joints, control)
    machine = {
        "name": "rig",
        "chains": [{"name": "rig", "urdf": "rig.urdf"}],
        "active": list(joints),
        "home": {x: 0.0 if x in motors else lower + 0.2 for x in joints},
        "friction": dict.fromkeys(joints, friction or {"viscous": 300.0}),
        "end_stops": {x: {"stiffness": stops, "damping": 1.0} for x in joints if x not in motors},
        "hydraulics": hydraulics,
    }
    path = folder / "rig.yaml"
    path.write_text(yaml.dump(machine, Dumper=_Plain))
    return crane.load(path, changes, locked)


def _but(usual, other):
    return {key: value for key, value in (usual | other).items() if value is not None}


class _Plain(yaml.SafeDumper):
    """Without anchors, which machine files do not know."""

    def ignore_aliases(self, data):
        return True
