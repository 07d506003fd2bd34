"""A circuit with every kind of component, and its oil and energy balances."""

import numpy as np
from hydraulic_rig import rig

SENSING = {
    "control": "load-sensing", "pressure": 24e6, "flow": 1.2e-3, "margin": 2e6, "droop": 5e5,
    "standby": 2.5e6, "response": 0.08, "power": 1.5e4, "summed": ["supply", "second"],
    "slip": 2e-12, "friction": 0.05, "drag": 400.0, "least": 0.02, "relief": 28e6,
}  # fmt: skip
NEGATIVE = {
    "control": "negative", "pressure": 24e6, "flow": 1e-3, "signal": 2e6, "throttle": 6e-7,
    "droop": 1e6, "response": 0.1, "power": 1e4, "summed": ["supply", "second"], "relief": 26e6,
    "relief_gain": 2e-8, "slip": 1e-12,
}  # fmt: skip
VALVE = {"type": "sharing", "c1": 5e-7, "c2": 4e-7, "c3": 4e-7, "c4": 5e-7}
ALL = {
    "joints": ("x", "y", "z", "w"),
    "valve": VALVE,
    "valves": {
        "x": {"hysteresis": 0.02, "bandwidth": 40.0, "damping": 0.8, "dead_band": 0.05},
        "y": {
            "c1": [[0.05, 0.0], [0.5, 1e-7], [1.0, 5e-7]], "c3": [[0.1, 0.0], [1.0, 4e-7]],
            "regeneration": 8e-7, "float_from": 0.8, "float_coefficient": 1e-6,
            "return_a": "return", "return_b": "return",
        },
        "z": {
            "type": "orifice", "supply": "second", "centre": [[0.0, 3e-6], [0.9, 0.0]],
            "bandwidth": 60.0, "rate": 8.0,
        },
        "w": {"type": "compensated", "margin": 8e5, "supply": "pilot"},
    },
    "cylinders": {
        "x": {
            "stiffness": 2e7, "damping": 5e4, "relief": 26e6, "refill": 1e-6, "gas_a": 1e-6,
            "leakage": 1e-13, "rupture_a": 9e-4,
            "counterbalance_a": {
                "pressure": 1.2e7, "pilot_ratio": 4.0, "range": 2e6, "coefficient": 4e-7,
            },
        },
        "y": {"cushion": 0.03, "cushion_coefficient": 1e-7, "relief": 26e6, "refill": 1e-6},
        "w": {"area_a": 2e-3, "area_b": 1.5e-3, "cross_relief": 1e7},
    },
    "motors": {
        "z": {
            "displacement": 2e-5, "gear": 15.0, "volume": 1.5e-4, "cross_relief": 1.2e7,
            "relief": 27e6, "refill": 1e-6, "leakage_a": 1e-13,
        },
    },
    "supply": SENSING,
    "supplies": {"second": NEGATIVE, "pilot": {"pressure": 1.6e7}},
    "engine": {
        "speed": 190.0, "torque": 150.0, "inertia": 1.5, "speed_droop": 12.0, "fuel": 6e-8,
        "idle": 3e-4,
    },
    "oil": {"bulk_modulus": 1.3e9, "air": 0.005, "steel_modulus": 2e11, "hose_modulus": 8e8},
    "lines": {"return": {"volume": 1e-3}, "block": {"volume": 5e-4, "pressure": 2e6}},
    "accumulators": {
        "warm": {
            "volume": 1e-3, "precharge": 3e6, "exponent": 1.3, "time_constant": 3.0,
            "pressure": 5e6,
        },
        "quick": {"volume": 5e-4, "precharge": 1e6, "pressure": 1.2e6},
    },
    "elements": {
        "cooler": {"type": "check", "from": "return", "to": "tank", "coefficient": 2e-6,
                   "pressure": 2e5},
        "confluence": {"type": "check", "from": "second", "to": "supply", "coefficient": 5e-7,
                       "joints": ["x", "y"], "side": "out"},
        "fill": {"type": "orifice", "from": "supply", "to": "warm", "coefficient": 2e-8},
        "suspension": {"type": "orifice", "from": "x.a", "to": "quick", "coefficient": 5e-8},
        "drain": {"type": "leak", "from": "block", "to": "tank", "gain": 1e-11},
        "feed": {"type": "relief", "from": "warm", "to": "block", "gain": 1e-11,
                 "pressure": 1e6},
    },
    "friction": {"viscous": 2e4},
    "inertia": 400.0,
    "control": {"kp": 20.0, "kd": 0.5},
}  # fmt: skip
TIMES = [0.0, 0.2, 0.5, 1.0, 1.4, 2.0, 2.5, 3.0]
SIGNALS = {
    "x": [0.0, 0.0, 0.7, 0.7, 0.0, -0.6, -0.6, 0.0],
    "y": [0.0, 0.3, 0.9, 0.9, -1.0, -1.0, 0.2, 0.2],
    "z": [0.0, 0.0, 0.0, 0.8, 0.8, 0.3, -0.5, 0.0],
    "w": [0.0, 0.5, 0.5, 0.0, -0.5, 0.0, 0.0, 0.4],
}


def everything(folder, **changed):
    """The machine with it."""
    return rig(folder, **ALL | changed)


def gaps(run, machine):
    """What is missing in the two balances: oil over what was pumped, energy over what went in."""
    c = run.channels
    swept = np.zeros(len(run.time))
    for joint, cylinder in machine.hydraulics.cylinders.items():
        if not cylinder.motor:
            x = run.q[:, machine.active.index(joint)]
            swept += (cylinder.area_a - cylinder.area_b) * (x - x[0])
    oil = c["oil_pumped"] - c["oil_returned"] - c["oil_stored"] - swept
    drawn = abs(c["oil_pumped"]).max() + abs(c["oil_returned"]).max() + abs(swept).max()
    energy = c["pump_work"] - c["work"] - c["hydraulic_loss"] - c["oil_energy"]
    through = max(abs(c[x]).max() for x in ("pump_work", "work", "hydraulic_loss", "oil_energy"))
    return abs(oil).max() / max(drawn, 1e-9), abs(energy).max() / max(through, 1e-3)
