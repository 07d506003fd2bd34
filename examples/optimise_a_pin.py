"""Which position of the lift cylinder's pin gives the largest load at a required height?"""

import crane

PIN = {"lift_boom_rod.x": (0.25, 0.36), "lift_boom_rod.y": (-0.16, -0.06)}  # [m] on the boom

machine = crane.load("patu655", changes={"supply.pressure": 1.9e7})
found = crane.design(
    machine,
    PIN,
    maximise=["load(5, 1)"],  # [kg] at 5 m, 1 m above the ground
    require=["highest >= 7.55"],  # [m]
    starts=2,
)
for solution in found.solutions:
    x, y = solution.values
    print(f"pin at ({1e3 * x:.0f}, {1e3 * y:.0f}) mm: {solution.objectives[0]:.0f} kg")
print(f"before: {found.initial.objectives[0]:.0f} kg")

# check with the machine that has the best pin
better = found.variant()
chart = crane.capacity(better, radii=[5.0], heights=[1.0])
assert abs(chart.loads.item() - found.solutions[0].objectives[0]) < 1e-3
assert chart.loads.item() > found.initial.objectives[0]
crane.write_machine(better, "better")
