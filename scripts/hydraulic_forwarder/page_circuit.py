"""The part of the page on (21) to (32), valve and friction."""

import numpy as np

from crane.identification.hydraulics.orifice_coefficients import PARAMETER_NAMES
from crane.identification.hydraulics.valve_curve import ValveCurve
from hydraulic_forwarder.circuit import PASSES, TRUE
from hydraulic_forwarder.experiment import LIFTS, OIL
from hydraulic_forwarder.paper import LIFTING, STIFF
from hydraulic_forwarder.results import Results
from hydraulic_forwarder.tables import KIND, errors, percent, span, table


def lifting(found: Results) -> str:
    """The recordings of Figure 8."""
    ours = {
        "duration [s]": [f"{m.period * m.periods:g}" for m in LIFTS.values()],
        "q2_ref [rad]": [span(float(x[1].min()), float(x[1].max()), 2) for x in found.lifting],
        "u, largest": [f"{s.u:.2f}" for s in found.sizes.values()],
        "F_2', largest [kN/s]": [f"{s.rate / 1e3:.0f}" for s in found.sizes.values()],
        "Y, largest [1e-3 m2/s]": [f"{1e3 * s.left:.1f}" for s in found.sizes.values()],
    }
    rows = [
        [name, *(x for pair in zip(LIFTING[name], ours[name], strict=True) for x in pair)]
        for name in LIFTING
    ]
    slow = ", ".join(f"{s.slow / 1e3:.1f}" for s in found.sizes.values())
    share = ", ".join(percent(s.share) for s in found.sizes.values())
    head = [""] + [f"{k}, {who}" for k in (1, 2, 3) for who in ("paper", "ours")]
    printed = max(
        1e3 * float(rate) / STIFF / (1e-3 * float(Y))
        for rate, Y in zip(
            LIFTING["F_2', largest [kN/s]"], LIFTING["Y, largest [1e-3 m2/s]"], strict=True
        )
    )
    return "\n\n".join(
        [
            "## Orifices and oil: (29) to (32)",
            "The lift boom alone, three references of other amplitude and frequency:",
            table(head, rows),
            "![References, control input, rate of the force](../images/hydraulic_forwarder_8.png)",
            "As Figure 8, one averaged period each. u is larger than the paper's, as its first "
            "0.1143 open nothing. F' is larger because nothing has filtered the boom's swing "
            "away; "
            f"below 0.5 Hz it is {slow} kN/s. That swing is what tells 1/beta: the RMS of F'/beta "
            f"is {share} of that of Y. By the paper's ranges F'/beta is at most {printed:.4f} of "
            "Y "
            f"(with beta = {STIFF:g} Pa), less than any sensor's error: such data tell c1 to c4, "
            "hardly beta. The paper prints no value of its X.",
        ]
    )


def orifices(found: Results) -> str:
    """X by kind and method."""
    clean = [
        [method, *(f"{x:+.1e}" for x in X.values / TRUE - 1)] for method, X in found.clean.items()
    ]
    rows = []
    for kind, methods in found.noisy.items():
        for method, X in methods.items():
            held = found.predicted[kind][method].values()
            rows.append(
                [f"{KIND[kind]}: {method}", *errors(X),
                 ", ".join(percent(x) for x in held)]
            )  # fmt: skip
    X = found.noisy["orifices"]["chambers"]
    ideal = found.noisy["paper"]
    ratio = ideal["weak"].std[1:] / ideal["chambers"].std[1:]
    tight = float(np.abs(found.tight.values[1:] / TRUE[1:] - 1).max())
    quiet = percent(float(found.quiet.values[0] / TRUE[0] - 1))
    values = [
        [name, f"{true:.4g}", f"{x:.4g}", span(a, b, 4)]
        for name, true, x, (a, b) in zip(
            PARAMETER_NAMES, TRUE, X.values, X.interval(), strict=True
        )
    ]
    both = ", ".join(f"{name} {percent(x)}" for name, x in found.all_joints.items())
    return "\n\n".join(
        [
            "**Without noise**, on the paper's crane (rigid hoses and walls, no leakage, a spool "
            "that follows at once), through the logger's file and back, not averaged, relative "
            "errors of X:",
            table(("method", *PARAMETER_NAMES), clean),
            "`ls` is the paper's (36) on the smoother's F' and x'; `weak` is (29) integrated "
            "over windows, nothing differentiated; `chambers` both equations (23).",
            "**With noise**, X from the three recordings; relative errors of (29) on each "
            "recording by X of the other two. Bold: the truth (for 1/beta that of the oil alone) "
            "is outside of the 95 % interval.",
            table(("", *PARAMETER_NAMES, "(29) held out"), rows),
            "- All methods find c1 to c4 to less than 1 %. `chambers` knows them "
            f"{ratio.min():.0f} to {ratio.max():.0f} times better than `weak`, because in (29) c1 "
            "and c2 differ only by how V_A / V_B changes "
            "along the stroke.\n"
            "- 1/beta of `ls` is wrong, even negative, and its interval does not tell. The "
            "smoother takes the boom's swing in the stroke, some hundredths of a millimetre, for "
            "noise, in the force it does not; so F' has no counterpart in Y. With a tenth of the "
            f"noise, as of a hundred times the periods, the error is {quiet}.\n"
            "- On the machine, c1 to c4 are off by some tenths of a percent, more than their "
            "intervals say: those count noise, not the leakage (20 ml/min at 100 bar), which the "
            "equations do not have. Without leakage (and noise) `chambers` has them right to "
            f"{tight:.0e}.\n"
            f"- (29) on sets 1 and 2, in which all joints move, by X of `chambers`: {both}.",
            "![Both sides of (29)](../images/hydraulic_forwarder_9.png)",
            "As Figure 9, on the machine, method `chambers`: each recording by X of the other "
            "two. X of all three:",
            table(("", "true", "identified", "95 % interval"), values),
        ]
    )


def modulus(found: Results) -> str:
    """Which beta it is."""
    (low_a, high_a), (low_b, high_b) = found.softness
    X = found.noisy["orifices"]["chambers"]
    low, high = X.interval()[0]
    rows = [
        ["oil alone", f"{1 / OIL:.3g}", f"{OIL / 1e9:.2f}"],
        ["chamber A", span(low_a, high_a), span(1e-9 / high_a, 1e-9 / low_a)],
        ["chamber B", span(low_b, high_b), span(1e-9 / high_b, 1e-9 / low_b)],
        ["identified", f"{X.values[0]:.3g} ({span(low, high)})",
         f"{1e-9 / X.values[0]:.2f} ({span(1e-9 / high, 1e-9 / low)})"],
    ]  # fmt: skip
    rigid = found.noisy["rigid"]["chambers"]
    a, b = rigid.interval()[0]
    return "\n\n".join(
        [
            "### Which beta",
            "The equations have one constant beta. The machine's chambers have "
            "1/K = 1/B_oil + ((V - V_h) / V) / B_steel + (V_h / V) / B_hose, which depends on the "
            "stroke: the less oil in the cylinder, the larger the hose's share. Over the strokes "
            "of the three recordings:",
            table(("", "1/K [1/Pa]", "K [1e9 Pa]"), rows),
            "What is identified is a mean of both chambers' 1/K, mostly of where the boom swings "
            f"and pressures change. It is {percent(X.values[0] * OIL - 1)} above that of the oil "
            "alone; the chambers' own are up to "
            f"{percent(max(high_a, high_b) / X.values[0] - 1)} above it. For c1 to c4 it does not "
            "matter: "
            "F'/beta is below a percent of Y. With rigid hoses and walls, where beta is the "
            f"oil's, it is {rigid.values[0]:.3g} ({span(a, b)}) for {1 / OIL:.3g} 1/Pa.",
        ]
    )


def assumptions(found: Results) -> str:
    """What stands for the opening, and what is off."""
    signals = [[name, *errors(X)] for name, X in found.signals.items()]
    off = [[name, *errors(X), f"{X.misfit:.3g}"] for name, X in found.disturbed.items()]
    edges = found.edges.parameter_intervals()
    neutral, band = (
        f"{value:.5g} ({span(a, b, 5)})" for value, a, b in (edges["neutral"], edges["dead_band"])
    )
    return "\n\n".join(
        [
            "### What has to be known",
            "The signal that stands for the opening (machine, `chambers`):",
            table(("", *PARAMETER_NAMES), signals),
            "A real crane has the voltage. Its spool's second order is in data sheets; without it "
            "each c is wrong by a percent in motions as slow as these. A spool sensor would "
            "tell as much.",
            "What sensors and numbers that are off do:",
            table(("", *PARAMETER_NAMES, "misfit"), off),
            "Offsets of single sensors go into one or two c; the misfit does not see them. What "
            "has to be right is the valve's middle and dead band: at |u| of 0.2 to 0.3 an error "
            "of 0.01 is a tenth of the opening. They come from a staircase of the same valve, "
            f"here without compensation, by `identify_valve`: neutral {neutral} V, dead band "
            f"{band}. Without compensation the speed bends a little over the voltage, which "
            "costs a millivolt.",
        ]
    )


def valve(found: Results) -> str:
    """Neutral voltage and dead band of the machine as published."""

    def row(curve: ValveCurve, name: str, digits: int = 5) -> str:
        value, low, high = curve.parameter_intervals()[name]
        return f"{value:.{digits}g} ({span(low, high, digits)})"

    true = {
        "neutral": "5.8 V",
        "dead_band": "0.1143",
        "edge up": "5.4571 V",
        "edge down": "6.1429 V",
        "flow up": "6.667e-04 m3/s",
        "flow down": "6.667e-04 m3/s",
    }
    rows = [
        [name.replace("_", " "), text, *(row(curve, name) for curve in found.valves.values())]
        for name, text in true.items()
    ]
    return "\n\n".join(
        [
            "## Valve of the machine as published",
            "Compensated, 40 l/min. Steps of its voltage of 2.5 s, up and down, speeds by the "
            "smoother:",
            table(("", "true", *found.valves), rows),
            "The extension, level, is fed by its compensator both ways: middle, dead band and "
            "flow are as published. The lift boom comes down by its weight: the oil leaves "
            "through the open edge, faster than the compensator feeds the other side, and the "
            "speed is no straight line of the voltage; the edge downwards comes out "
            "some millivolts late, and `flow down` is what leaves, not what the valve is built "
            "for.",
        ]
    )


def friction(found: Results) -> str:
    """Friction of the lift cylinder."""
    truth = {"coulomb": "210 N", "coulomb_offset": "0 N", "viscous": "330 N s/m",
             "stiction": "90 N (300 N at rest)", "stribeck": "0.005 m/s"}  # fmt: skip
    rows = []
    for i, (name, text) in enumerate(truth.items()):
        row = [name.replace("_", " "), text, f"{found.still.values[i]:.4g}"]
        if name in found.friction.names:
            low, high = found.friction.interval()[i]
            row.append(f"{found.friction.values[i]:.4g} ({span(low, high)})")
        else:
            row.append("not told")
        row.append(f"{found.heavy.values[i]:.4g}")
        rows.append(row)
    return "\n\n".join(
        [
            "## Friction of the lift cylinder",
            "Strokes at nine constant speeds both ways, 3.3 to 45 mm/s; friction is F less "
            "the load by the machine's masses. Noise is that of "
            f"{PASSES} passes, averaged: pressures of 0.2 bar are 190 N, almost as much as what "
            "is "
            "looked for. One pass does not tell stiction.",
            table(
                (
                    "",
                    "true",
                    "without noise",
                    f"{PASSES} passes",
                    "without noise, lift boom taken 5 % too heavy",
                ),
                rows,
            ),  # fmt: skip
            "A load that is wrong does not change its sign with the motion: it goes into the "
            "offset, and only as far as it changes along the stroke into the rest.",
            "![Valve curve and friction](../images/hydraulic_forwarder_valve.png)",
        ]
    )
