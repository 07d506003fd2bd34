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
THIRD_PARTY = Path(__file__).parents[2] / "shared" / "data" / "third_party"
OUTPUT_COUNT = 10  # instants with outputs, after the start


@dataclass(frozen=True)
class Problem:
    """A trajectory problem.

    Attributes:
        name: Name of its file.
        title: What it is called.
        source: Where it was published.
        machine_name: File of the machine beside it, or a bundled machine, or `FAMILY JOINTS`, or
            `third_party/FILE` of a folder that is not part of the project.
        velocity: Velocities of active joints at the start, 0 where not given.
        duration: [s].
        steps: Lengths of steps to try, for engines with fixed steps [s].
        notes: How the reference is known besides the two computations.
        lock: Coordinates of joints that are held, by name.
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
    lock: dict[str, float] | None = None
    start: float = 0.0
    published: dict[str, float] | None = None

    @classmethod
    def read(cls, path: Path) -> "Problem":
        """Read a problem file."""
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
        values["machine_name"] = values.pop("machine")
        steps = tuple(values.pop("steps"))
        return cls(name=path.stem, steps=steps, velocity=values.pop("velocity", {}), **values)

    @property
    def machine_is_there(self) -> bool:
        """Whether the machine's file exists, if it is that of a third party."""
        is_own = not self.machine_name.startswith("third_party/")
        return is_own or machine_file(self.machine_name).exists()

    @cached_property
    def system(self) -> Multibody:
        """The machine at its start."""
        machine = load_machine(self.machine_name, self.lock)
        return Multibody.from_machine(machine, self.velocity, self.start)

    @property
    def is_conservative(self) -> bool:
        """Whether no damper or constant force does work."""
        _, _, damping, force = self.system.joint_force_parameters
        springs = self.system.springs
        return not damping.any() and not force.any() and not any(x.damping for x in springs)

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


def machine_file(name: str) -> Path:
    """File of a machine of the problems' folder or of a third party."""
    third_party = name.removeprefix("third_party/")
    return FOLDER / "machines" / name if third_party == name else THIRD_PARTY / third_party


def load_machine(name: str, lock: dict[str, float] | None = None) -> crane.Machine:
    """A machine of the problems' folder, of a third party, bundled, or of a family: `chain 61`.

    Args:
        name: See `Problem.machine_name`.
        lock: Coordinates of joints that are held, by name.
    """
    family, _, joints = name.rpartition(" ")
    if family in families.FAMILIES:
        with tempfile.TemporaryDirectory() as folder:
            return crane.load(families.write(family, int(joints), Path(folder)))
    path = machine_file(name)
    return crane.load(path if path.suffix else name, lock=lock)


def problems(names: list[str] | None = None) -> list[Problem]:
    """All problems whose machine is there, or those of some names."""
    return [
        problem
        for problem in _all_problems()
        if problem.machine_is_there and (not names or problem.name in names)
    ]


def missing_problems() -> list[str]:
    """A line for each problem that is left out."""
    return [
        f"{problem.name} is left out: there is no ../shared/data/{problem.machine_name}"
        for problem in _all_problems()
        if not problem.machine_is_there
    ]


def _all_problems() -> list[Problem]:
    return [Problem.read(path) for path in sorted(FOLDER.glob("*.yaml"))]
