"""What a gradient of a sum over a motion takes, forwards along it and back."""

import time
from collections.abc import Callable

import numpy as np
from measuring import table

import crane

_OUTPUTS = ("X_lift", "X_tilt", "pressure_X_lift_a", "tip_z")
_MANY = 200  # numbers forwards, a minute


def gradients() -> str:
    """Ten seconds of a crane on two valves, by some of its numbers and by all."""
    machine = crane.load(
        "patu655", changes={"payload.mass": 150.0}, lock={"X_ext": 0.1, "slew": 0.0}
    )
    levers = crane.joystick(machine, "stir")

    def spent(call: Callable[[], object]) -> float:
        call()  # compiles
        start = time.process_time()
        call()
        return time.process_time() - start

    def back(by: list[str] | None) -> crane.Gradient:
        return crane.gradient(
            machine,
            levers,
            None,
            10.0,
            functional=lambda _, y: (0.5 * np.sum(y**2), y),
            parameters=by,
            outputs=_OUTPUTS,
        )

    def forwards(by: list[str]) -> object:
        return crane.sensitivities(machine, levers, None, 10.0, parameters=by, outputs=_OUTPUTS)

    every = list(back(None).parameters)
    rows = []
    for count in (6, 50, 200, len(every)):
        some = every[:: len(every) // count][:count]
        took = spent(lambda some=some: back(some))
        ahead = spent(lambda some=some: forwards(some)) if count <= _MANY else 0.0
        row = f"{count}", f"{took:.2f}", f"{ahead:.2f}" if ahead else ""
        rows.append((*row, f"{ahead / took:.1f}" if ahead else ""))
    return table(("numbers", "back [s]", "forwards [s]", "ratio"), rows)
