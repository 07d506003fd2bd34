"""Machine files with all quantities scaled by powers of one length and one mass factor.

Lengths times `s`, masses times `m` (s^3 where the material stays the same), at the same gravity.
Then times scale by sqrt(s), forces by m, torques by m s, and a motion that starts likewise goes on
likewise (Froude's similarity).
"""

from pathlib import Path

import numpy as np
import yaml
from lxml import etree

# what a number is about: powers of length, of mass, of time; of a slide and of a turning joint
SLIDE = {
    "coordinate": (1, 0, 0), "rate": (1, 0, -1), "acceleration": (1, 0, -2),
    "force": (1, 1, -2), "viscous": (0, 1, -1), "stiffness": (0, 1, -2), "integral": (0, 1, -3),
    "hunt": (-1, 0, 1),
}  # fmt: skip
TURN = {
    "coordinate": (0, 0, 0), "rate": (0, 0, -1), "acceleration": (0, 0, -2),
    "force": (2, 1, -2), "viscous": (2, 1, -1), "stiffness": (2, 1, -2), "integral": (2, 1, -3),
    "hunt": (0, 0, 1),
}  # fmt: skip
FRICTION = {
    "coulomb": "force", "coulomb_offset": "force", "stiction": "force", "viscous": "viscous",
    "viscous_offset": "viscous", "smoothing": "rate", "stribeck": "rate",
}  # fmt: skip
ELEMENT = {"stiffness": "stiffness", "rest": "coordinate", "damping": "viscous", "force": "force"}
DEFAULTS = {"smoothing": 1e-3, "stribeck": 1e-2}  # what a file leaves out has to be scaled, too


class Scale:
    """A change of size.

    Args:
        s: Factor of lengths.
        m: Factor of masses; s^3 if not given.
    """

    def __init__(self, s, m=None):
        self.s, self.m = float(s), float(s) ** 3 if m is None else float(m)
        self.time = float(np.sqrt(s))

    def by(self, powers):
        length, mass, time = powers
        return self.s**length * self.m**mass * self.time**time

    def of(self, machine, what, joints=None):
        """(k,) factors of a quantity of joints, the active ones if not given."""
        kinds = {"m": SLIDE, "rad": TURN}
        names = machine.active if joints is None else joints
        return np.array([self.by(kinds[machine.unit(name)][what]) for name in names])

    def urdf(self, text):
        """A URDF of the new size, URDF+ too, and which of its joints slide."""
        root = etree.fromstring(text)
        slides = {}
        times = self._times
        for origin in root.iter("origin"):
            times(origin, {"xyz": self.s})
        for mass in root.iter("mass"):
            times(mass, {"value": self.m})
        for inertia in root.iter("inertia"):
            times(inertia, dict.fromkeys(inertia.keys(), self.m * self.s**2))
        for tag, keys in (("box", ("size",)), ("cylinder", ("radius", "length"))):
            for shape in root.iter(tag):
                times(shape, dict.fromkeys(keys, self.s))
        for joint in root.iterfind("joint"):
            kind = SLIDE if joint.get("type") == "prismatic" else TURN
            slides[joint.get("name")] = kind is SLIDE
            where = {
                "limit": {"lower": "coordinate", "upper": "coordinate", "effort": "force",
                          "velocity": "rate"},
                "dynamics": {"damping": "viscous", "friction": "force"},
            }  # fmt: skip
            for tag, keys in where.items():
                for element in joint.iterfind(tag):
                    times(element, {key: self.by(kind[what]) for key, what in keys.items()})
        return etree.tostring(root), slides

    def write(self, path, folder):
        """A machine file or a URDF, without hydraulics and pictures, written into a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        target = folder / Path(path).name
        if path.suffix == ".urdf":
            target.write_bytes(self.urdf(path.read_bytes())[0])
            return target
        told = yaml.safe_load(path.read_text())
        slides = {}
        for chain in [*told["chains"], *filter(None, [told.get("payload")])]:
            file = folder / chain["urdf"]
            file.parent.mkdir(parents=True, exist_ok=True)
            text, found = self.urdf((path.parent / chain["urdf"]).read_bytes())
            file.write_bytes(text)
            slides |= found
        told.pop("hydraulics", None)
        kinds = {name: SLIDE if slid else TURN for name, slid in slides.items()}

        def by(joint, what):
            return self.by(kinds[joint][what])

        told["home"] = {x: v * by(x, "coordinate") for x, v in told.get("home", {}).items()}
        for joint, law in told.get("friction", {}).items():
            law |= {key: law.get(key, value) for key, value in DEFAULTS.items()}
            told["friction"][joint] = {
                k: v if k == "drives" else float(v) * by(joint, FRICTION[k])
                for k, v in law.items()
            }
        for law in told.get("forces", []):
            for key in law.keys() & ELEMENT.keys():
                law[key] = float(law[key]) * by(law["joint"], ELEMENT[key])
        for joint, law in told.get("gas_springs", {}).items():
            length = 3 if kinds[joint] is TURN else 2
            law["area"] = float(law["area"]) * self.s**length
            law["pressure"] = float(law["pressure"]) * self.m / self.s**2
            law["volume"] = float(law["volume"]) * self.s**3
            if "rest" in law:
                law["rest"] = float(law["rest"]) * by(joint, "coordinate")
        for joint, law in told.get("end_stops", {}).items():
            law["stiffness"] = float(law["stiffness"]) * by(joint, "stiffness")
            law["damping"] = float(law.get("damping", 0.0)) * by(joint, "hunt")
        for joint, gains in told.get("control", {}).items():
            gains["kp"] = float(gains["kp"]) * by(joint, "stiffness")
            gains["ki"] = float(gains["ki"]) * by(joint, "integral")
        for name in [name for name, task in told.get("tasks", {}).items() if "joystick" in task]:
            del told["tasks"][name]
        for task in told.get("tasks", {}).values():
            task["duration"] *= self.time
            for space in task.keys() & {"tip", "active"}:
                for axis, values in task[space].items():
                    factor = self.s if space == "tip" else by(axis, "coordinate")
                    task[space][axis] = [
                        float(x) * factor / self.time**k for k, x in enumerate(values)
                    ]
        target.write_text(yaml.safe_dump(told, sort_keys=False))
        return target

    @staticmethod
    def _times(element, factors):
        for key, factor in factors.items():
            if element.get(key) is not None:
                values = (repr(float(x) * factor) for x in element.get(key).split())
                element.set(key, " ".join(values))
