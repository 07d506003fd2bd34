"""A minute of the full-size crane on its valves, beside scipy on the same formulas."""

import time

from measuring import table

import crane

_SHORT = 1.0  # of the minute, for what takes long [s]


def hydraulic_crane(rounds: int) -> str:
    """Time of a minute under levers, all functions, with pressures, spools and pump."""
    machine = crane.load("patu655", changes={"payload.mass": 211.4})
    levers = {
        joint: [(0, 0), *((t, 0.2 * (-1) ** (i + k)) for i, t in enumerate(range(4, 57, 7)))]
        for k, joint in enumerate(machine.hydraulics.joints)
    }
    minute = crane.joystick(machine, levers)

    def spent(duration: float, **options) -> float:
        start = time.process_time()
        crane.simulate(machine, minute, duration=duration, **options)
        return time.process_time() - start

    crane.simulate(machine, minute, duration=0.1)  # compiles
    rows = []
    for step in (1e-3, 1e-2):
        took = sorted(spent(60.0, step=step) for _ in range(rounds))[rounds // 2]
        rows.append((f"crane, recorded every {1e3 * step:g} ms", took, 60.0))
    slow = spent(_SHORT, step=1e-2, backend="pinocchio")
    rows.append(("scipy's BDF on the Pinocchio backend", slow, _SHORT))
    best = rows[0][1] / 60.0
    return table(
        ("", "CPU time per second of work [ms]", "times faster than real time", "ratio"),
        [
            (name, f"{1e3 * took / span:.3g}", f"{span / took:.3g}", f"{took / span / best:.3g}")
            for name, took, span in rows
        ],
    )
