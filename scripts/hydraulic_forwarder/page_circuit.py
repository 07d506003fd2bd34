"""Section of the page about (21) to (32), valve and friction."""

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
            "Only the lift boom moves, with three references of different amplitude and "
            "frequency:",
            table(head, rows),
            "![References, control input, rate of the force](../images/hydraulic_forwarder_8.png)",
            "This corresponds to Figure 8, one averaged period each. u is larger than the "
            "paper's, because its first 0.1143 open nothing. F' is larger because the boom's "
            f"oscillation is not filtered out; below 0.5 Hz it is {slow} kN/s. This oscillation "
            f"determines 1/beta: the RMS of F'/beta is {share} of that of Y. In the paper's "
            f"ranges F'/beta is at most {printed:.4f} of Y (with beta = {STIFF:g} Pa), less than "
            "any sensor's error: such data determine c1 to c4, but hardly beta. The paper gives "
            "no value of its X.",
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
            PARAMETER_NAMES, TRUE, X.values, X.confidence_interval(), strict=True
        )
    ]
    both = ", ".join(f"{name} {percent(x)}" for name, x in found.all_joints.items())
    return "\n\n".join(
        [
            "**Without noise**, for the paper's crane (rigid hoses and walls, no leakage, a "
            "spool without dynamics), written to and read from the logger's file, not averaged, "
            "relative errors of X:",
            table(("method", *PARAMETER_NAMES), clean),
            "`ls` is the paper's (36) with the smoother's F' and x'; `weak` is (29) integrated "
            "over windows, without differentiation; `chambers` is both equations (23).",
            "**With noise**, X from the three recordings; relative errors of (29) on each "
            "recording with X of the other two. Bold: the true value (for 1/beta that of the oil "
            "alone) is outside of the 95 % interval.",
            table(("", *PARAMETER_NAMES, "(29) held out"), rows),
            "- All methods estimate c1 to c4 to less than 1 %. The standard deviations of "
            f"`chambers` are {ratio.min():.0f} to {ratio.max():.0f} times smaller than those of "
            "`weak`, because in (29) c1 and c2 differ only by the change of V_A / V_B along the "
            "stroke.\n- 1/beta of `ls` is wrong, even negative, and its interval does not show "
            "it. The smoother treats the boom's oscillation in the stroke, some hundredths of a "
            "millimetre, as noise, but not that in the force; so F' has no counterpart in Y. "
            "With a tenth of the noise, as with a hundred times the periods, the error is "
            f"{quiet}.\n- For the machine, the errors of c1 to c4 are some tenths of a per cent "
            "and exceed their intervals, which include noise but not the leakage (20 ml/min at "
            "100 bar), which the equations neglect. Without leakage (and noise) the errors of "
            f"`chambers` are {tight:.0e}.\n- (29) on sets 1 and 2, in which all joints move, with "
            f"X of `chambers`: {both}.",
            "![Both sides of (29)](../images/hydraulic_forwarder_9.png)",
            "This corresponds to Figure 9, for the machine, method `chambers`: each recording "
            "with X of the other two. X of all three:",
            table(("", "true", "identified", "95 % interval"), values),
        ]
    )


def modulus(found: Results) -> str:
    """Which beta it is."""
    (low_a, high_a), (low_b, high_b) = found.softness
    X = found.noisy["orifices"]["chambers"]
    low, high = X.confidence_interval()[0]
    rows = [
        ["oil alone", f"{1 / OIL:.3g}", f"{OIL / 1e9:.2f}"],
        ["chamber A", span(low_a, high_a), span(1e-9 / high_a, 1e-9 / low_a)],
        ["chamber B", span(low_b, high_b), span(1e-9 / high_b, 1e-9 / low_b)],
        ["identified", f"{X.values[0]:.3g} ({span(low, high)})",
         f"{1e-9 / X.values[0]:.2f} ({span(1e-9 / high, 1e-9 / low)})"],
    ]  # fmt: skip
    rigid = found.noisy["rigid"]["chambers"]
    a, b = rigid.confidence_interval()[0]
    return "\n\n".join(
        [
            "### Which beta",
            "The equations have one constant beta. For the chambers of the machine 1/K = 1/B_oil "
            "+ ((V - V_h) / V) / B_steel + (V_h / V) / B_hose, which depends on the stroke: the "
            "less oil in the cylinder, the larger the share of the hose. Over the strokes of the "
            "three recordings:",
            table(("", "1/K [1/Pa]", "K [1e9 Pa]"), rows),
            "The estimate is a mean of 1/K of both chambers, mainly where the boom oscillates "
            f"and pressures change. It is {percent(X.values[0] * OIL - 1)} above that of the oil "
            "alone; those of the chambers are up to "
            f"{percent(max(high_a, high_b) / X.values[0] - 1)} above it. For c1 to c4 this has no "
            "effect: F'/beta is below a per cent of Y. With rigid hoses and walls, where beta is "
            f"the oil's, the estimate is {rigid.values[0]:.3g} ({span(a, b)}) for {1 / OIL:.3g} "
            "1/Pa.",
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
            "### Required knowledge",
            "The signal that is used as the opening (machine, `chambers`):",
            table(("", *PARAMETER_NAMES), signals),
            "A real crane provides the voltage. The second-order dynamics of its spool are in "
            "data sheets; without them each c has an error of a per cent in motions as slow as "
            "these. A spool sensor would give the same information.",
            "The effect of errors of sensors and known values:",
            table(("", *PARAMETER_NAMES, "misfit"), off),
            "Offsets of single sensors change one or two c; the misfit does not show them. The "
            "neutral signal and the dead band of the valve must be accurate: at |u| of 0.2 to "
            "0.3 an error of 0.01 is a tenth of the opening. `identify_valve` estimates them "
            f"from a staircase of the same valve, here without compensation: neutral {neutral} V, "
            f"dead band {band}. Without compensation the speed is slightly nonlinear in the "
            "voltage, which causes an error of a millivolt.",
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
            "The valve is compensated, 40 l/min. Its voltage has steps of 2.5 s, up and down; "
            "speeds are those of the smoother:",
            table(("", "true", *found.valves), rows),
            "The extension is horizontal, and its compensator supplies it in both directions: "
            "neutral signal, dead band and flow are as published. The lift boom is lowered by "
            "its weight: the oil leaves through the open edge faster than the compensator "
            "supplies the other side, and the speed is not linear in the voltage; the edge "
            "downwards is some millivolts late, and `flow down` is the outflow, not the nominal "
            "flow of the valve.",
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
            low, high = found.friction.confidence_interval()[i]
            row.append(f"{found.friction.values[i]:.4g} ({span(low, high)})")
        else:
            row.append("not determined")
        row.append(f"{found.heavy.values[i]:.4g}")
        rows.append(row)
    return "\n\n".join(
        [
            "## Friction of the lift cylinder",
            "The recording has strokes at nine constant speeds in both directions, 3.3 to 45 "
            "mm/s; friction is F minus the load from the machine's masses. The noise is that of "
            f"{PASSES} averaged passes: pressures of 0.2 bar are 190 N, almost as much as the "
            "friction. One pass does not determine stiction.",
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
            "An error of the load does not change its sign with the motion: it becomes part of "
            "the offset, and influences the other parameters only as far as it changes along the "
            "stroke.",
            "![Valve curve and friction](../images/hydraulic_forwarder_valve.png)",
        ]
    )
