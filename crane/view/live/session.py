"""What a live view knows: one posture, closed at every move, and its numbers."""

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.common.errors import BranchEdgeError, ClosureError, InputError, known
from crane.common.samples import Array, as_number
from crane.dynamics import Dynamics
from crane.machine import Machine, Payload
from crane.motion.kinematics import Kinematics
from crane.recordings.summary import READING_UNITS

_STEP = 1 / 128  # of a move, at most
_SHORTEST = 1e-11  # of a move, at which it gives up
_AT_ONCE = 32  # steps that are tried before their length is thought over
_SINGULAR = 1e4  # condition number above which a posture counts as on the branch's edge
_TURN, _WAY = np.pi, 1.0  # how far a slider goes to both sides of home without limits [rad], [m]


@dataclass(frozen=True, eq=False)
class Readout:
    """A closed posture and its numbers.

    Attributes:
        q: (nq,) coordinates [m], [rad].
        q_a: (n,) the active ones.
        tip: (3,) position of the tip [m], None without one.
        gravity: (n,) active forces that hold the weight, the payload's too [N], [N m].
        gain: Entry of gamma with the largest magnitude among the passive joints
            [m/m], [rad/m], [m/rad], [rad/rad]; 0 without any.
        gain_of: The passive and the active joint it belongs to, empty without any.
        condition: Condition number of J_P, the passive columns of the loops' Jacobian in SI
            units; 1 without loops. It grows without bound at the branch's edge.
        weakest: The loop that holds the passive joints least, empty without loops.
        residual: Largest loop equation [m], [rad].
        refused: Why the last move went only this far; empty where it went all the way.
    """

    q: Array
    q_a: Array
    tip: Array | None
    gravity: Array
    gain: float
    gain_of: tuple[str, ...]
    condition: float
    weakest: str
    residual: float
    refused: str = ""


class Session:
    """A machine that is moved joint by joint.

    Args:
        machine: The machine.

    Attributes:
        machine: The machine without payload.
        lower: (n,) where sliders begin [m], [rad].
        upper: (n,) where they end.
        posture: Where it is.
        payload: Mass at the tip [kg].
        heaviest: Largest payload that a slider offers [kg]: half of the moving mass, or a little
            more, as a round number.
    """

    def __init__(self, machine: Machine):
        self.machine = machine
        self.payload = 0.0
        self._dynamics = Dynamics(machine, backend="pinocchio")
        self._kinematics = None if machine.tip is None else Kinematics(machine)
        home = machine.home[machine.closure.active]
        ways = np.array([_TURN if machine.unit(x) == "rad" else _WAY for x in machine.active])
        self.lower = np.where(np.isfinite(machine.lower), machine.lower, home - ways)
        self.upper = np.where(np.isfinite(machine.upper), machine.upper, home + ways)
        mass = sum(inertia.mass for inertia in list(machine.model.inertias)[1:])
        self.heaviest = round_up(mass / 2)
        self.posture = self._measured(machine.home)

    def move(self, joint: str, value: float) -> Readout:
        """Move one active joint, the others held.

        Where the loops cannot be closed, the machine goes as far towards the value as they can,
        and the posture says why it stopped.

        Args:
            joint: An active joint.
            value: Its coordinate within its slider's range [m], [rad].

        Raises:
            InputError: Unknown joint, or a value that is not finite or out of range.
        """
        active = self.machine.active
        if joint not in active:
            raise InputError(f"'{joint}' is no active joint, {known(active, joint)}")
        index = active.index(joint)
        unit = self.machine.unit(joint)
        value = as_number(value, f"the value of {joint}", unit)
        low, high = self.lower[index], self.upper[index]
        slack = 1e-9 * (high - low)
        if not low - slack <= value <= high + slack:
            raise InputError(
                f"{joint} = {value:.6g} {unit} is outside of {low:.6g} to {high:.6g}, "
                "choose a value within"
            )
        target = self.posture.q_a.copy()
        target[index] = value
        way = self._way(target)
        if way is None:
            return self.place(target)
        for q in reversed(way):
            try:
                posture = self._measured(q)
            except BranchEdgeError:
                continue
            if posture.condition < _SINGULAR:
                break
        else:
            posture = self._measured(self.posture.q)
        if posture.q_a[index] != value:
            shown, scale = READING_UNITS[unit]
            posture = replace(
                posture,
                refused=f"{joint} stops at {scale * posture.q_a[index]:.4g} {shown}: beyond it "
                f"loop '{posture.weakest}' leaves its assembly branch or cannot be closed",
            )
        self.posture = posture
        return posture

    def place(self, q_a: ArrayLike) -> Readout:
        """Put all active joints (n,) where they are told, wherever they were before.

        The machine stays where it is if the loops cannot be closed there.
        """
        try:
            q = self.machine.closure.solve(q_a, guess=self.posture.q)
            self.posture = self._measured(q)
        except ClosureError as error:
            self.posture = replace(self.posture, refused=str(error))
        return self.posture

    def home(self) -> Readout:
        """Go to the home posture."""
        self.posture = self._measured(self.machine.home)
        return self.posture

    def load(self, mass: float) -> Readout:
        """Hang a mass [kg] at the tip, in place of what hung there before.

        Raises:
            InputError: The machine has no tip, or the mass is negative or not finite.
        """
        if self.machine.tip is None:
            raise InputError(f"machine '{self.machine.name}' has no tip to hang a load on")
        loaded = self.machine.with_payload(Payload(self.machine.tip, mass))
        self._dynamics = Dynamics(loaded, backend="pinocchio")
        self.payload = float(mass)
        self.posture = replace(self._measured(self.posture.q), refused=self.posture.refused)
        return self.posture

    def poses(self, links: list[str]) -> Array:
        """(len(links), 4, 4) poses of links in the world."""
        model = self.machine.model
        data = model.createData()
        at = self.machine.coordinates.configuration(self.posture.q)
        pin.framesForwardKinematics(model, data, at)
        frames = [self.machine.frame(link) for link in links]
        return np.array([data.oMf[i].homogeneous for i in frames]).reshape(-1, 4, 4)

    def tips(self, q: Array) -> Array:
        """(N, 3) positions of the tip [m] at closed postures (N, nq); (0, 3) without one."""
        if self._kinematics is None:
            return np.empty((0, 3))
        return self._kinematics.positions(q)

    def _way(self, target: Array) -> list[Array] | None:
        """Postures on the straight way to a target (n,), up to where it leaves the branch.

        Small steps, so that it never jumps to where a longer step would find the branch again,
        and smaller ones towards its edge and away from it.
        None where there is no machine code to take them.
        """
        closure = self.machine.closure
        if not closure.compiled:
            return None
        cursor, here = closure.fast.cursor(), self.posture.q_a
        way: list[Array] = []
        done, step = 0.0, _STEP
        if not closure.fast.start_near(cursor, self.posture.q):
            return way
        while done < 1.0 and step > _SHORTEST:
            shares = np.unique(np.minimum(done + step * np.arange(1, _AT_ONCE + 1), 1.0))
            goals = here + shares[:, None] * (target - here)
            goals[shares == 1.0] = target
            out = np.empty((len(goals), len(self.machine.joints)))
            count = closure.fast.follow(cursor, goals, out)
            way += list(out[:count])
            done = float(shares[count - 1]) if count else done
            step = min(4 * step, _STEP) if count == len(goals) else step / 8
        return way

    def _measured(self, q: Array) -> Readout:
        """A closed posture (nq,) with its numbers.

        Raises:
            BranchEdgeError: The passive joints are not determined there.
        """
        machine, closure = self.machine, self.machine.closure
        gamma = closure.gamma(q)
        gains = np.abs(gamma[closure.passive])
        gain, gain_of = 0.0, tuple[str, ...]()
        if gains.any():
            row, column = np.unravel_index(int(gains.argmax()), gains.shape)
            gain = float(gamma[closure.passive[row], column])
            gain_of = (machine.joints[closure.passive[row]], machine.active[column])
        condition, weakest = self._condition(q)
        q_a = np.array(q[closure.active])
        rest = np.zeros(len(q_a))
        return Readout(
            q=np.array(q),
            q_a=q_a,
            tip=None if self._kinematics is None else self._kinematics.position_at(q),
            gravity=self._dynamics.at("gravity", q, rest, rest),
            gain=gain,
            gain_of=gain_of,
            condition=condition,
            weakest=weakest,
            residual=float(closure.residual(q)),
        )

    def _condition(self, q: Array) -> tuple[float, str]:
        """Condition number of J_P, and the loop that a force of least effect belongs to.

        In shares of the machine's size, so that metres and radians compare.
        """
        closure = self.machine.closure
        equations, rows = closure.equations, closure.structure.rows
        if not len(rows):
            return 1.0, ""
        left, values, _ = np.linalg.svd(equations.scaled(q)[1][rows][:, closure.passive])
        shares = np.bincount(equations.loop_of_row[rows], left[:, -1] ** 2)
        condition = values[0] / values[-1] if values[-1] > 0 else np.inf
        return float(condition), equations.names[int(shares.argmax())]


def round_up(value: float) -> float:
    """The next of 1, 2 or 5 times a power of ten that is not below a positive value."""
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next(x for x in (1, 2, 5, 10) if x * decade >= value * (1 - 1e-9)) * decade)
