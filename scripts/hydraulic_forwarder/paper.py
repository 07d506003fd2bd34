"""Published values of the electro-hydraulic forwarder paper: ranges read from its figures."""

ANGLES = ("q2", "q3", "X_ext")  # the paper's q2, q3, q4
SIGNALS = ("tau_2", "tau_3", "F_4")
UNITS = ("N m", "N m", "N")

# quantity: least and largest in sets 1 (Figures 4, 6) and 2 (Figures 5, 7)
RANGES = {
    "q2 [rad]": ((0.30, 0.65), (0.35, 0.70)),
    "q3 [rad]": ((-0.90, -0.30), (-1.00, -0.40)),
    "q4 [m]": ((0.50, 1.10), (0.50, 1.05)),
    "q2' [rad/s]": ((-0.03, 0.03), (-0.06, 0.06)),
    "q3' [rad/s]": ((-0.10, 0.10), (-0.20, 0.20)),
    "q4' [m/s]": ((-0.15, 0.15), (-0.12, 0.15)),
    "tau_2 [kN m]": ((8.0, 11.0), (7.0, 14.0)),
    "tau_3 [kN m]": ((3.0, 7.0), (2.0, 8.0)),
    "F_4 [kN]": ((-4.0, 3.0), (-4.0, 3.0)),
}
# Figures 8 and 9, by reference
LIFTING = {
    "duration [s]": ("60", "150", "100"),
    "q2_ref [rad]": ("-0.2 to 0.5", "-0.2 to 0.6", "-0.1 to 0.5"),
    "u, largest": ("0.15", "0.2", "0.1"),
    "F_2', largest [kN/s]": ("1.5", "2", "0.5"),
    "Y, largest [1e-3 m2/s]": ("4", "4", "2"),
}
STIFF = 1.0e9  # [Pa] of a usual beta, where the paper prints none
