"""Part: forward dynamics of all engines over the number of joints."""

from collections.abc import Sequence
from typing import Any

import forward_dynamics
from report import table

OWN = ("crane, one call", "crane, a stack", "crane, closed stack")
SOFT = ("mj_forward",)  # gives the accelerations of soft loops: no peer


def measure(quick: bool) -> list[dict[str, Any]]:
    """Forward dynamics of all machines, each in a process of its own."""
    results = []
    for machine in forward_dynamics.machines(quick):
        results.append(forward_dynamics.measure(machine, 5 if quick else 15))
        print(f"{machine}: {results[-1].get('failure', 'done')}", flush=True)
    return results


def best_peer(times: dict[str, float]) -> tuple[str, float] | None:
    """Name and time [s] of the fastest other engine with rigid loops; None if there is none."""
    found = [(time, name) for name, time in times.items() if name not in (*OWN, *SOFT)]
    return min(found)[::-1] if found else None


def tables(results: Sequence[dict[str, Any]]) -> list[str]:
    """Times of a call, and of the first one."""
    names = list(dict.fromkeys(name for found in results for name in found.get("times", ())))
    head = [
        "machine", "joints", "loops", "degrees of freedom", *(f"{name} [us]" for name in names),
        "best peer / one call", "best peer / stack", "load [s]", "first call [s]", "cached [s]",
    ]  # fmt: skip
    rows = []
    for found in results:
        if "failure" in found:
            rows.append([found["machine"], *["-"] * (len(head) - 2), found["failure"]])
            continue
        times, peer = found["times"], best_peer(found["times"])
        rows.append([
            found["machine"], *(str(found[key]) for key in ("joints", "loops", "freedoms")),
            *(f"{1e6 * times[name]:.2f}" if name in times else "-" for name in names),
            *(f"{peer[1] / times[name]:.1f}" if peer else "-" for name in OWN[:2]),
            *(f"{found[key]:.2f}" for key in ("load", "first", "cached")),
        ])  # fmt: skip
    return [table(head, rows)]
