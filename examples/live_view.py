"""How do I move a machine by sliders in a browser, and stop that from a program?"""

import os
import signal
import threading

import numpy as np

import crane
from crane.view.live import Session
from crane.view.live.live_server import serve_live_view

machine = crane.load("patu655")
session = Session(machine)
readout = session.move("X_lift", 0.3)  # the same as a slider [m]
session.set_payload(200.0)  # [kg] at the tip
print(f"the tip is {session.readout.tip[2]:.2f} m high, loops closed to {readout.residual:.0e} m")
lift = machine.active.index("X_lift")
print(f"the lift cylinder holds {session.readout.gravity[lift] / 1e3:.1f} kN")

loaded = machine.with_payload(crane.Payload(machine.tip, mass=200.0))
expected = crane.Dynamics(loaded).gravity(session.readout.q_a)
assert np.allclose(session.readout.gravity, expected, rtol=1e-9)

# Ctrl+C ends a live view; here a timer does so after three seconds
threading.Timer(3.0, os.kill, (os.getpid(), signal.SIGINT)).start()
serve_live_view(session)  # prints the address to open
print("the live view has ended")
