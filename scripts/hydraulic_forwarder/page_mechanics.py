"""The part of the page on (1) to (20)."""

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
        "seven, rest known": "the seven, other bodies' weight known",
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
            "Learned from a third motion (60 s, rates like those of set 2), judged by sets 1 and "
            "2. RMS errors and relative errors, where the joint moves:",
            table(head, rows),
            "![Set 1: measured and modelled torques](../images/hydraulic_forwarder_6.png)",
            "![Set 2](../images/hydraulic_forwarder_7.png)",
            "As Figures 6 and 7. Both sides went through one low-pass of "
            f"{mechanics.BANDWIDTH:g} Hz: after each turn the boom swings on its oil at "
            f"{found.oscillation:.1f} Hz, which the angles hardly show, so nothing can be "
            "modelled there (grey). The first row is the floor, noise and what the filter "
            "lets through; what is above it is mostly that (14) has no stiction. "
            "With standstill counted, where friction is anything, set 1 has "
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
            low, high = one.interval()[i]
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
            "The paper's crane is three bodies in a row. Ours carries its cylinders and the "
            "brackets of the tilt boom's four-bar linkage: six bodies more, whose weight and "
            "inertia go through the closed loops. Their part of the torques in set 1, RMS as a "
            "share of the measured, and largest:",
            table(("", *(f"{s} [{u}]" for s, u in zip(SIGNALS, UNITS, strict=True))), shares),
            "So seven parameters are not complete here: they miss "
            f"{percent(found.shares['all of these'][0][0])} of tau_2. Yet they predict as well as "
            "the closed chain (table above), because most of what is missing is weight that moves "
            "much like that of the booms: they take it up, and stop being what (4) to (10) say. "
            "With the other bodies' torques subtracted first (their masses are known) "
            "theta_2, theta_4, theta_5 and theta_6 are what they should be. Bold: the truth is "
            "outside of the 95 % interval.",
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
            "theta_1, theta_3 and theta_7 cannot be told one by one: the lift boom's centre of "
            "mass lies 2.2 degrees off the line to the elbow (on it, the rank is six), and a "
            "constant offset of the lift cylinder's friction acts alike. Their sums with "
            f"L = {L:.3f} m are better told. That of the inertias comes out too low: the lift "
            "boom's accelerations, up to 0.06 rad/s2, ask it for 55 N m of 12 kN m; the stiction "
            "that (14) does not have is 28 N m, and both come when the boom starts. With a column "
            f"for stiction (5 mm/s) it is {sticky:.4g} ({span(least, most, 4)}); "
            "the rest is there without noise, too.",
            closed_base(found.found["closed"]),
        ]
    )


def closed_base(one: Identification) -> str:
    """How well the package's base parameters of the closed chain are told."""
    low, high = one.interval().T
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
        f"For the closed chain the package finds {bodies} inertial base parameters (with friction "
        f"{len(one.names)}); {covered} of their 95 % intervals hold the truth. Few are told one "
        "by "
        "one by motions as slow and as planar as these, which is why `crane identify` shows the "
        "intervals, and has priors; those known to better than 10 %:\n\n"
        + table(("base parameter", "of the bodies", "identified", "95 % interval"), rows)
        + "\n\nFriction of X_lift as Coulomb and viscous, 210 N and 330 N s/m, does not come out: "
        "at these speeds, up to 15 mm/s, stiction of 90 exp(-(v / 5 mm/s)^2) N takes part, which "
        "(14) does not have. "
        "For that see [friction](#friction-of-the-lift-cylinder)."
    )
