"""Problems: a machine, its start, a duration, and a reference solution, read from data files."""

import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import families
import numpy as np
import yaml
from multibody import Array, Multibody

import crane

FOLDER = Path(__file__).parent / "problems"
OUTPUT_COUNT = 10  # instants with outputs, after the start


@dataclass(frozen=True)
class Problem:
    """A trajectory problem.

    Attributes:
        name: Name of its file.
        title: What it is called.
        source: Where it was published.
        machine_name: File of the machine beside it, or a bundled machine, or `FAMILY JOINTS`.
        velocity: Velocities of active joints at the start, 0 where not given.
        duration: [s].
        steps: Lengths of steps to try, for engines with fixed steps [s].
        notes: How the reference is known besides the two computations.
        published: Joint coordinates at the end from elsewhere [m], [rad].
    """

    name: str
    title: str
    source: str
    machine_name: str
    duration: float
    steps: tuple[float, ...]
    velocity: dict[str, float]
    notes: str = ""
    published: dict[str, float] | None = None

    @classmethod
    def read(cls, path: Path) -> "Problem":
        """Read a problem file."""
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
        values["machine_name"] = values.pop("machine")
        steps = tuple(values.pop("steps"))
        return cls(name=path.stem, steps=steps, velocity=values.pop("velocity", {}), **values)

    @cached_property
    def system(self) -> Multibody:
        """The machine at its start."""
        return Multibody.from_machine(load_machine(self.machine_name), self.velocity)

    @property
    def is_conservative(self) -> bool:
        """Whether no damper or constant force does work, and no spring along a joint."""
        bodies, springs = self.system.bodies, self.system.springs
        passive = any(body.stiffness or body.damping or body.force for body in bodies)
        return not passive and not any(spring.damping for spring in springs)

    @property
    def times(self) -> Array:
        """Instants of outputs (k + 1,), the start included [s]."""
        return np.linspace(0.0, self.duration, OUTPUT_COUNT + 1)

    @property
    def reference_path(self) -> Path:
        """File of the reference solution."""
        return FOLDER / "references" / f"{self.name}.csv"

    @cached_property
    def reference(self) -> Array:
        """Positions (k, n, 3) of the centres of mass of all bodies after the start [m]."""
        table = np.loadtxt(self.reference_path, delimiter=",", comments="#")
        return table.reshape(OUTPUT_COUNT, -1, 3)

    def error(self, positions: Array) -> float:
        """Largest distance of a centre of mass from the reference at any output [m]."""
        distance = np.linalg.norm(positions - self.reference, axis=-1)
        return float(distance.max()) if np.isfinite(distance).all() else np.inf


def load_machine(name: str) -> crane.Machine:
    """A machine of the problems' folder, bundled, or of a family as `chain 61`."""
    family, _, joints = name.rpartition(" ")
    if family:
        with tempfile.TemporaryDirectory() as folder:
            return crane.load(families.write(family, int(joints), Path(folder)))
    path = FOLDER / "machines" / name
    return crane.load(path if path.suffix else name)


def problems(names: list[str] | None = None) -> list[Problem]:
    """All problems, or those of some names."""
    found = [Problem.read(path) for path in sorted(FOLDER.glob("*.yaml"))]
    return [problem for problem in found if not names or problem.name in names]
