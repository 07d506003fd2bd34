"""The strokes that move a frame of a machine in its section."""

import numpy as np

from crane.common.errors import InputError
from crane.dynamics.statics import StaticsEvaluator
from crane.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces.workspace_mapping import moving_strokes, stroke_limits
from crane.motion.workspaces.workspace_patch import last_closed_configuration
from crane.motion.workspaces.workspace_section import find_slewing_joint, workspace_section

_DRAWN = 200  # postures from which it is seen how the frame moves
_STILL = 1e-6  # of what the other strokes move the frame


class Strokes:
    """The strokes that move a frame in its section.

    A joint that slews the whole machine stays at home, as do strokes that do not move the frame.

    Args:
        statics: The machine and the frame.

    Attributes:
        machine: The machine.
        statics: As given.
        section: Of the frame's places: radius and height.
        low: (n,) lower limits of the active joints.
        high: (n,) upper limits.
        span: (n,) between them; 1 where they are equal.
        moving: Indices of the strokes among the active joints: the two that move the frame most,
            then the others, both in the order of the machine.

    Raises:
        InputError: A joint is free.
    """

    def __init__(self, statics: StaticsEvaluator):
        machine = self.machine = statics.machine
        self.statics = statics
        frame, active = statics.frame, machine.closure.active
        self.low, self.high = stroke_limits(machine)
        self.span = np.where(self.high > self.low, self.high - self.low, 1.0)
        slew, random = find_slewing_joint(machine, frame), np.random.default_rng(0)
        if machine.free:
            raise InputError(
                f"'{machine.free[0]}' of '{machine.name}' is free, hold it: "
                f"--lock {machine.free[0]}=0"
            )
        kinematics = Kinematics(machine, frame)
        strokes = moving_strokes(
            machine, kinematics, self.low, self.high, None if slew is None else slew[0], random
        )
        drawn = np.repeat(machine.home[None], _DRAWN, axis=0)
        for k in strokes:
            drawn[:, active[k]] = random.uniform(self.low[k], self.high[k], _DRAWN)
        closed, good = statics.close_loops(drawn)
        for i in np.flatnonzero(np.logical_not(good)).tolist():  # far from home, step by step
            closed[i] = last_closed_configuration(machine, machine.home, drawn[i, active])[0]
        at = statics.evaluate(closed)
        self.section = workspace_section(
            machine, frame, at.tip_positions, kinematics.position_at_configuration(machine.home)
        )
        moves = np.linalg.norm(
            self.section.section_jacobian(at.tip_positions, at.tip_jacobian), axis=1
        ).mean(axis=0)
        far = moves * self.span
        strokes = [i for i in strokes if far[i] > _STILL * far[strokes].max()]
        order = sorted(strokes, key=lambda i: -far[i])
        self.moving = [*sorted(order[:2]), *sorted(order[2:])]


def check_drives(machine: Machine) -> Machine:
    """The machine, whose drives are its active joints.

    Raises:
        InputError: They are others.
    """
    if machine.explicit_drives and any(
        drive.name not in machine.active or len(drive.factors) > 1
        for drive in machine.explicit_drives
    ):
        raise InputError(
            f"the drives of '{machine.name}' are not its active joints, choose them: --active"
        )
    return machine
