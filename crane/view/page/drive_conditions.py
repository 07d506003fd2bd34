"""Payload, slope and supports of the page on which a machine is driven."""

import warnings
from contextlib import suppress
from typing import Any

import numpy as np

from crane.common.errors import CraneError, CraneWarning, InputError
from crane.common.samples import Array
from crane.control.control_law import Controller
from crane.control.valve_commands import ValveCommand
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.dynamics.tipping_stability import TippingStability, find_supports, has_supports
from crane.export.instance_program import InstanceProgram
from crane.formats.machine_loading import MachineVariants
from crane.machine.machine import Machine
from crane.ratings.drive_force_limits import drive_force_limits
from crane.view.page.page_motion import frame_data, pack_base64

PAYLOAD = "payload.mass"
_PAYLOAD_LEVELS = 20  # of the slider, beside 0
_UNKNOWN_SHARE = 0.2  # of the moving mass, the largest payload where drives have no limit
_TILT = 0.1  # [rad], of a variant: no component of gravity is zero


class DriveConditions:
    """What the page changes of a machine: its payload and the direction of gravity.

    Args:
        machine: The machine.
        quantities: See `InstanceProgram`.
        controller: See `InstanceProgram`.

    Attributes:
        program: The machine with these parameters as elements of an instance.
        masses: Payloads to choose from [kg], with that of the machine; one without a choice.
    """

    def __init__(
        self,
        machine: Machine,
        quantities: tuple[str, ...] = (),
        controller: Controller | ValveCommand | None = None,
    ):
        self._machine = machine
        self.masses = [float(machine.parameter_changes.get(PAYLOAD, 0.0))]
        variants, tilted = MachineVariants(machine), []
        x, y, z = machine.gravity
        self.slopes = bool(z < 0 and not x and not y)
        self._payloads: list[Machine] = []
        with suppress(CraneError), warnings.catch_warnings():  # another structure with a payload
            warnings.simplefilter("ignore", CraneWarning)  # as when the machine was loaded
            if self.slopes:
                tilted = [variants.machine(self._changes(_gravity(z, _TILT, 2 * _TILT)))]
            masses = sorted({*self.masses, *_payload_masses(machine)})
            payloads = [variants.machine(self._changes({PAYLOAD: x})) for x in masses]
            self.program = InstanceProgram(machine, quantities, [*payloads, *tilted], controller)
            self.masses, self._payloads = masses, payloads
            return
        self.program = InstanceProgram(machine, quantities, tilted, controller)

    def _changes(self, changes: dict[str, float]) -> dict[str, float]:
        return dict(self._machine.parameter_changes) | changes

    def data(self) -> dict[str, Any]:
        """What the script needs: values of the elements by payload, and the place of gravity."""
        program, payload = self.program, None
        if self._payloads:
            instances = np.nan_to_num(program.variant_defaults[: len(self.masses)], posinf=1e300)
            indices = np.flatnonzero(np.ptp(instances, axis=0))
            own = self._machine.parameter_changes.get(PAYLOAD, 0.0)
            payload = {
                "masses": self.masses, "start": self.masses.index(own),
                "indices": indices.tolist(), "values": pack_base64(instances[:, indices], "f8"),
                "bodies": [_bodies(x) for x in self._payloads if has_supports(x)],
            }  # fmt: skip
        names, gravity = program.names, None
        if self.slopes:
            gravity = {
                "index": names.index("gravity_x"),
                "value": -float(self._machine.gravity[2]),
            }
        return {"payload": payload, "gravity": gravity, "stability": self._stability()}

    def _stability(self) -> dict[str, Any] | None:
        """Supports and bodies, for the margins of `TippingStability`."""
        machine = self.program.machine
        if not has_supports(machine):
            return None
        stability, start = TippingStability(machine), self.program.layout.start_index
        first, forces = start("external"), []
        for force in machine.external_forces:
            size = 6 + len(force.channels)
            moves = (force.name, force.frame) in find_supports(machine)
            forces.append(
                {"first": first, "supports": moves, "frame": frame_data(machine, force.frame)}
            )
            first += size
        return {
            "lines": stability.line_indices, "isStationary": stability.is_stationary,
            "supports": [frame_data(machine, link) for _, link in find_supports(machine)],
            "forces": forces, "bodies": _bodies(machine), "accelerations": start("a"),
            "gravity": self.program.names.index("gravity_x"),
        }  # fmt: skip


def _bodies(machine: Machine) -> list[list[float]]:
    """Mass, lever, inertia about the COM (xx, xy, yy, xz, yz, zz) of all bodies, fixed first."""
    return [[x.mass, *x.lever, *x.inertia[np.tril_indices(3)]] for x in machine.model.inertias]


def _gravity(z: float, pitch: float, roll: float) -> dict[str, float]:
    """Gravity on ground that falls by angles along x and y, see `assets/drive_machine.js`."""
    direction = np.array([np.tan(pitch), np.tan(roll), -1.0])
    vector: Array = -z * direction / np.linalg.norm(direction)
    return dict(zip(("gravity.x", "gravity.y", "gravity.z"), vector.tolist(), strict=True))


def _payload_masses(machine: Machine) -> list[float]:
    """Payloads up to what the drives raise at home, a round one.

    Raises:
        InputError: No moving body carries a payload.
    """
    tip = machine.tip
    if tip is None or not machine.model.frames[machine.frame(tip)].parentJoint:
        raise InputError(f"'{machine.name}' has no tip that moves")
    moving = sum(x.mass for x in list(machine.model.inertias)[1:])
    home = machine.home[machine.closure.active]
    weights = Dynamics(machine, backend="pinocchio").gravity(home)
    frames = FrameJacobians(machine)
    frames.set_configuration(machine.home)
    levers = frames.jacobian(tip)[:3] @ machine.closure.gamma(machine.home)
    per_mass = -machine.model.gravity.linear @ levers
    largest = np.inf
    with suppress(InputError):
        for limit in drive_force_limits(machine, machine.driven_joints):
            weight, force = per_mass[limit.active_index], weights[limit.active_index]
            room = (limit.max_force if weight > 0 else limit.min_force) - force
            if abs(weight) > 1e-9:
                largest = min(largest, room / weight)
    if not 0.0 < largest < moving:
        largest = _UNKNOWN_SHARE * moving
    power = 10.0 ** np.floor(np.log10(largest))
    step = max(x for x in (1.0, 2.0, 5.0) if x * power <= largest) * power
    steps = np.floor(largest / step * 4.0) / 4.0 * step
    return np.linspace(0.0, steps, _PAYLOAD_LEVELS + 1).tolist()
