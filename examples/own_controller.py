"""How do I write a controller of my own, and make it fast?"""

import time

import numpy as np

import crane

machine = crane.load("mini_forwarder")
trajectory = crane.task_trajectory(machine, "lift")
start = trajectory.position(0.0)
weight = crane.Dynamics(machine).gravity(start)  # [N m], [N], [N]
KP = np.array([15.0, 5500.0, 18000.0])  # [N m/rad], [N/m], [N/m]
KD = np.array([1.0, 100.0, 100.0])  # [N m s/rad], [N s/m], [N s/m]


def feedback(t, q_a, v_a):
    """Return the forces at a time, coordinates and velocities."""
    return weight + KP * (trajectory.position(t) - q_a) - KD * v_a


class Feedback(crane.control.ControlLaw):
    """The same as formulas, which are compiled to machine code."""

    def references(self, times):
        """Return the references, which depend on time only."""
        return trajectory.position(times)

    def law(self, inputs):
        """Return the forces, and the rates of states (none)."""
        error = np.array(inputs.reference) - np.array(inputs.q_a)
        return weight + KP * error - KD * np.array(inputs.v_a), ()


def timed(controller):
    """Simulate one second; return the recording and the computing time [s]."""
    before = time.perf_counter()
    run = crane.simulate(machine, controller, start, duration=1.0, method="rk4")
    return run, time.perf_counter() - before


timed(Feedback(machine))  # the first call compiles
slow, slow_time = timed(feedback)
fast, fast_time = timed(Feedback(machine))
print(f"function: {slow_time:.2f} s, law: {fast_time:.3f} s for one second of motion")
same = np.abs(slow.q - fast.q).max()
print("both move alike" if same < 1e-9 else f"they differ by {same:.1e}")
assert same < 1e-9
