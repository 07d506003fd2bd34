"""Section of the page about (1) to (20)."""

import numpy as np

from crane.identification.mechanics.identification_result import Identification
from hydraulic_forwarder import mechanics
from hydraulic_forwarder.paper import SIGNALS, UNITS
from hydraulic_forwarder.results import Results
from hydraulic_forwarder.tables import percent, span, table


def torques(found: Results) -> str:
    """Held-out torques, like Figures 6 and 7."""
    words = {
        "true": "true parameters and friction",
        "closed": "closed chain, friction at cylinders",
        "seven": "the paper's seven, friction at cylinders",
        "seven, friction at joints": "the paper's seven and (15), as (17)",
        "seven, rest known": "the seven, gravity of the other bodies known",
    }
    rows = []
    for model, text in words.items():
        one, two = (found.judged[model][name] for name in ("set 1", "set 2"))
        cells = [
            f"{e:.1f} ({percent(r)})"
            for x in (one, two)
            for e, r in zip(x.rmse, x.relative_error, strict=True)
        ]
        rows.append([text, *cells])
    head = [""] + [
        f"set {k}: {s} [{u}]" for k in (1, 2) for s, u in zip(SIGNALS, UNITS, strict=True)
    ]
    whole = found.judged["closed"]["set 1"].whole
    return "\n\n".join(
        [
            "## Torques from pressures: (17) to (20)",
            "The training data are a third motion (60 s, velocities like those of set 2); sets 1 "
            "and 2 are held out. RMS errors and relative errors, while the joint moves:",
            table(head, rows),
            "![Set 1: measured and modelled torques](../images/hydraulic_forwarder_6.png)",
            "![Set 2](../images/hydraulic_forwarder_7.png)",
            "These correspond to Figures 6 and 7. Both sides passed one low-pass of "
            f"{mechanics.BANDWIDTH:g} Hz: after each reversal the boom oscillates on its oil at "
            f"{found.oscillation:.1f} Hz, which the angles hardly show, so this part cannot be "
            "modelled (grey). The first row is the lower limit, from noise and the remaining "
            "oscillation; the excess over it is mainly due to the missing stiction in (14). "
            "Including standstill, where friction can have any value, the errors of set 1 are "
            f"{', '.join(percent(x) for x in whole)}.",
        ]
    )  # fmt: skip


def parameters(found: Results) -> str:
    """Seven parameters, and what the closed chain makes of them."""
    plain, known = found.found["seven"], found.found["seven, rest known"]
    rows = []
    for i, words in enumerate(mechanics.THETA):
        row = [f"theta_{i + 1} = {words}", f"{plain.nominal[i]:.4g}"]
        for one in (plain, known):
            low, high = one.confidence_interval()[i]
            value = f"{one.values[i]:.4g}"
            good = low < one.nominal[i] < high
            row += [value if good else f"**{value}**", span(low, high, 4)]
        rows.append(row)
    L = mechanics.elbow(found.plant.joints)
    inertia = {"theta_1": 1.0, "theta_3": L * L}
    sticky, least, most = mechanics.combined(found.found["seven, stiction"], inertia)
    for factors, words in (
        ({"theta_7": 1.0, "theta_3": L}, "theta_7 + L theta_3 [kg m]"),
        (inertia, "theta_1 + L^2 theta_3 [kg m2]"),
    ):
        row = [words]
        true = sum(f * plain.nominal[plain.names.index(n)] for n, f in factors.items())
        row.append(f"{true:.4g}")
        for one in (plain, known):
            value, low, high = mechanics.combined(one, factors)
            good = low < true < high
            row += [f"{value:.4g}" if good else f"**{value:.4g}**", span(low, high, 4)]
        rows.append(row)
    shares = [
        [group, *(f"{percent(a)}, {b:.0f}" for a, b in zip(share, most, strict=True))]
        for group, (share, most) in found.shares.items()
    ]
    return "\n\n".join(
        [
            "## The seven base parameters (4) to (10)",
            "The paper's crane is a chain of three bodies. This crane also has cylinders and the "
            "brackets of the tilt boom's four-bar linkage: six further bodies, whose weight and "
            "inertia act through the closed loops. Their contribution to the torques in set 1, "
            "RMS as a share of the measured torque, and maximum:",
            table(("", *(f"{s} [{u}]" for s, u in zip(SIGNALS, UNITS, strict=True))), shares),
            "So seven parameters are not complete here: they miss "
            f"{percent(found.shares['all of these'][0][0])} of tau_2. Yet they predict as well as "
            "the closed chain (table above), because the missing part is mainly gravity that "
            "varies much like that of the booms: the parameters absorb it and no longer have the "
            "meaning of (4) to (10). If the torques of the other bodies are subtracted first "
            "(their masses are known), theta_2, theta_4, theta_5 and theta_6 have their correct "
            "values. Bold: the true value is outside of the 95 % interval.",
            table(
                (
                    "",
                    "of the bodies",
                    "from all torque",
                    "95 % interval",
                    "other bodies known",
                    "95 % interval",
                ),
                rows,
            ),  # fmt: skip
            "theta_1, theta_3 and theta_7 are not identifiable separately: the lift boom's "
            "centre of mass is 2.2 degrees off the line to the elbow (on it, the rank is six), "
            "and a constant offset of the lift cylinder's friction has the same effect. Their "
            f"sums with L = {L:.3f} m are determined better. The estimated sum of the inertias is "
            "too low: the lift boom's accelerations, up to 0.06 rad/s2, require 55 N m of 12 kN "
            "m; the stiction that (14) lacks is 28 N m, and both occur when the boom starts. "
            f"With a column for stiction (5 mm/s) it is {sticky:.4g} ({span(least, most, 4)}); "
            "the remaining error also occurs without noise.",
            closed_base(found.found["closed"]),
        ]
    )


def closed_base(one: Identification) -> str:
    """How well the package's base parameters of the closed chain are told."""
    low, high = one.confidence_interval().T
    covered = int(((low < one.nominal) & (high > one.nominal)).sum())
    sharp = np.abs(one.std / one.values) < 0.1
    rows = []
    for i in np.flatnonzero(sharp):
        rows.append(
            [
                one.names[i],
                f"{one.nominal[i]:.4g}",
                f"{one.values[i]:.4g}",
                span(low[i], high[i], 4),
            ]
        )
    bodies = sum(not name.startswith("X_") for name in one.names)
    return (
        f"For the closed chain the package finds {bodies} inertial base parameters (with "
        f"friction {len(one.names)}); {covered} of their 95 % intervals contain the true "
        "value. Such slow and planar motions determine few of them separately, which is why "
        "`crane identify` gives intervals and accepts priors; the parameters known to better "
        "than 10 %:\n\n"
        + table(("base parameter", "of the bodies", "identified", "95 % interval"), rows)
        + "\n\nFor X_lift, Coulomb and viscous friction, 210 N and 330 N s/m, are not identified "
        "correctly: at these speeds, up to 15 mm/s, stiction of 90 exp(-(v / 5 mm/s)^2) N "
        "contributes, which (14) lacks. See [friction](#friction-of-the-lift-cylinder)."
    )
