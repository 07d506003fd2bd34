"""How much can my crane lift at each position, and what is the limit?"""

import matplotlib
import numpy as np

import crane

matplotlib.use("agg")
import matplotlib.pyplot as plt  # noqa: E402

machine = crane.load("patu655")
chart = crane.capacity(machine, step=0.25)
chart.to_csv("chart.csv")

loads = chart.loads[0]  # (heights, radii) [kg]
picture = plt.figure()
colours = plt.pcolormesh(chart.radii, chart.heights, loads)
plt.colorbar(colours, label="load [kg]")
plt.xlabel("radius [m]")
plt.ylabel("height [m]")
plt.axis("equal")
picture.savefig("chart.png", dpi=150)

row = int(np.argmin(np.abs(chart.heights - 1.0)))
for radius in (3.0, 4.0, 5.0):
    column = int(np.argmin(np.abs(chart.radii - radius)))
    load, why = (
        loads[row, column],
        chart.limiting_factors[chart.limiting_factor_index[0, row, column]],
    )
    print(f"{load:.0f} kg at {radius} m, 1 m above the ground: {why}")

    # at this position and load the lift cylinder needs the full pressure of the pump
    loaded = machine.with_payload(crane.Payload(chart.frame, mass=load))
    force = crane.Dynamics(loaded).gravity(chart.q_a[0, row, column])
    i, circuit = machine.active.index("X_lift"), machine.hydraulics
    cylinder, supply = circuit.cylinders["X_lift"], circuit.supply
    most = cylinder.area_a * supply.pressure - cylinder.area_b * supply.tank
    assert np.isclose(force[i], most, rtol=1e-6)
