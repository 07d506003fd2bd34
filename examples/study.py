"""Which position of a pin gives the least force of a cylinder?"""

import numpy as np

import crane

if __name__ == "__main__":  # several processes import this file
    pin = np.linspace(0.080, 0.110, 7)  # of cylinder A2 on link 3 [m]
    found = crane.study(
        "mini_forwarder", {"link3_G.x": pin}, ["loading"], ["peak_X2", "energy"], processes=2
    )
    print(found.to_text())
    found.to_csv("study.csv")
    best = found.best_row("peak_X2")
    print(f"best: pin at {1e3 * best['link3_G.x']:.0f} mm, {best['peak_X2']:.2f} N at most")

    # check of one variant: inverse dynamics along the task
    machine = crane.load("mini_forwarder", changes={"link3_G.x": best["link3_G.x"]})
    time = np.arange(0.0, 10.0025, 0.005)
    q, v, a = crane.task_trajectory(machine, "loading")(time)
    force = crane.Dynamics(machine).inverse(q, v, a, friction=True)[:, 2]
    assert np.isclose(np.abs(force).max(), best["peak_X2"], rtol=1e-9)
