"""Objects shared by several threads give each thread the same bits as without sharing.

Every thread asks its own samples, so that numbers of one in the answer of another show. Where it
follows a branch is its own: alone, too, each runs in a fresh thread.
"""

import sys
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import crane
from crane.control import ValveDrive
from crane.dynamics.tipping_stability import TippingStability

THREADS, SAMPLES = 3, 6


PACKAGE = str(Path(crane.__file__).parent)


def restless(frame, event, argument):
    """Let another thread go on before every line of the package."""
    if not frame.f_code.co_filename.startswith(PACKAGE):
        return None
    time.sleep(0)
    return restless


def run(functions):
    """What functions return, each in a thread of its own, all at once."""
    answers = [None] * len(functions)
    start = threading.Barrier(len(functions))

    def work(i):
        start.wait()
        if len(functions) > 1:
            sys.settrace(restless)
        try:
            answers[i] = functions[i]()
        except Exception as error:  # seen where it is compared
            answers[i] = error

    threads = [threading.Thread(target=work, args=(i,)) for i in range(len(functions))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return answers


def same(one, other):
    """Whether two answers are equal to the last bit."""
    flat = [[np.asarray(x) for x in answer] for answer in (one, other)]
    return all(np.array_equal(x, y) for x, y in zip(*flat, strict=True))


def wrong(make, ask, machine, rounds=1):
    """Rounds in which some thread did not get what it gets alone.

    Args:
        make: Makes what the threads share.
        ask: (shared, q_a, v_a, x) -> arrays.
        machine: Whose samples they are, (N, n) within the limits of each thread's own part.
        rounds: How many.
    """
    rng = np.random.default_rng(7)
    width = machine.upper - machine.lower
    width = np.where(np.isfinite(width), width, 1.0)
    low = np.where(np.isfinite(machine.lower), machine.lower, -0.5)
    asked = []
    for i in range(THREADS):
        path = low + width * (0.3 + 0.1 * i + 0.05 * rng.random((SAMPLES, len(low))))
        v_a, x = rng.normal(size=(2, SAMPLES, len(low)))
        asked.append((path, v_a * 0.1 * width, 100 * x))
    alone = [run([partial(ask, make(), *part)])[0] for part in asked]
    for answer in alone:
        if isinstance(answer, Exception):
            raise answer
    failed = 0
    for _ in range(rounds):
        shared = make()
        found = run([partial(ask, shared, *part) for part in asked])
        failed += not all(
            not isinstance(one, Exception) and same(one, other)
            for one, other in zip(found, alone, strict=True)
        )
    return failed


QUANTITIES = {
    "inverse": 3, "forward": 3, "mass_matrix": 1, "bias": 2, "gravity": 1, "friction": 2,
    "passive": 2, "energy": 2, "regressor": 3,
}  # fmt: skip


def singly(dynamics, q_a, v_a, x):
    """Every quantity sample by sample."""
    out = []
    for row in zip(q_a, v_a, x, strict=True):
        out += [getattr(dynamics, name)(*row[:count]) for name, count in QUANTITIES.items()]
    return [np.ravel(one) for one in out]


def stacked(dynamics, q_a, v_a, x):
    """Stacks that keep machine code busy, and what lies around."""
    many = 1 if dynamics.backend == "pinocchio" else 500
    out = [
        getattr(dynamics, name)(*(np.tile(one, (many, 1)) for one in (q_a, v_a, x)[:count]))
        for name, count in QUANTITIES.items()
    ]
    slopes = dynamics.derivatives if dynamics.backend == "compiled" else lambda *_: {}
    tip = {dynamics.machine.tip: np.arange(6.0)}
    parts = [np.ravel(part) for part in out]
    return [*parts, *slopes("inverse", q_a, v_a, x).values(), dynamics.project_wrenches(q_a, tip)]


def held(machine):
    """The machine with a spring between frames, and friction that is smooth."""
    tip, root = machine.tip, machine.tree.root_link
    spring = crane.description.ForceElement(
        between=(root, tip), stiffness=50.0, damping=1.0, rest=0.2
    )
    return machine.replace(forces=(*machine.forces, spring))


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["compiled", "pinocchio"])
@pytest.mark.parametrize("ask", [singly, stacked])
def test_dynamics(mini, backend, ask):
    machine = held(mini)
    assert wrong(lambda: crane.Dynamics(machine, backend=backend), ask, mini) == 0


def posed(kinematics, q_a, v_a, x):
    """The tip sample by sample, of the stack, and back."""
    out = []
    for a, v in zip(q_a, v_a, strict=True):
        out += [kinematics.position(a), kinematics.rotation(a), kinematics.jacobian(a)]
        out += [kinematics.bias(a, v)]
    out += [kinematics.position(q_a), kinematics.jacobian(q_a), kinematics.bias(q_a, v_a)]
    return [*out, kinematics.inverse(kinematics.position(q_a[:3]), initial_guess=q_a[0])]


def test_kinematics(mini):
    assert wrong(lambda: crane.Kinematics(mini), posed, mini) == 0


def closed(closure, q_a, v_a, x):
    """Loops sample by sample, and of the stack."""
    out = []
    for a, v in zip(q_a, v_a, strict=True):
        q = closure.solve(a)
        gamma = closure.gamma(q)
        out += [q, gamma, closure.drift(q, gamma @ v), closure.residual(q)]
        out += closure.gamma_velocity_drift(q, v)
    q = closure.solve(q_a)
    return [
        *out,
        q,
        closure.gamma(q),
        closure.condition_number(q),
        closure.follow_motion(np.linspace(*q_a[:2], 9)),
    ]


def test_closure(mini):
    assert wrong(lambda: mini.closure, closed, mini) == 0


def balanced(stability, q_a, v_a, x):
    """Moments about the supports, and what hangs."""
    out = []
    for a in q_a[:5]:
        q = stability.machine.closure.solve(a[None])
        out += [
            *stability.static_margins(a),
            stability.ground_wrench(q, q, q),
            stability.tipping_load(a)[0],
        ]
    return out


def test_stability():
    digger = crane.load("excavator")
    assert wrong(lambda: TippingStability(digger), balanced, digger) == 0


def swayed(sway, q_a, v_a, x):
    """Where what is free hangs, and how it sways."""
    q_a = sway.hanging_equilibrium(q_a[:6])
    return [q_a, sway.stiffness(q_a), *(x for a in q_a for x in sway.modes(a))]


def test_sway():
    grapple = crane.load("patu655_grapple")
    assert wrong(lambda: crane.motion.Sway(grapple), swayed, grapple) == 0


def controlled(controllers, q_a, v_a, x):
    """Forces of controllers in Python, one of which asks for inverse dynamics."""
    out = []
    for t, a, v in zip(np.linspace(0, 1, len(q_a)), q_a, v_a, strict=True):
        for control in controllers:
            out += control(t, a, v, control.start(a))
    return out


def test_controllers(mini):
    path = crane.point_to_point([0, 0.015, 0.012], [0.5, 0.02, 0.014], 1.0)

    def make():
        made = [crane.PI(mini, path), crane.ComputedTorque(mini, path)]
        for control in made:
            control(0.0, *path(0.0)[:2], control.start(path(0.0)[0]))
        return made

    assert wrong(make, controlled, mini) == 0


def circled(drive, q_a, v_a, x):
    """A circuit in numbers."""
    out = []
    for a, v in zip(q_a[:2], v_a[:2], strict=True):
        out += drive(0.0, a, v, drive.start(a))
    return out


def test_circuit(patu):
    assert (
        wrong(lambda: ValveDrive(patu, crane.control.ValveSignals(patu, [0.0], {})), circled, patu)
        == 0
    )


def program(time, q_a, v_a, pressures):
    """Signals that tell who is asking."""
    return 5.0 + np.clip(q_a, -0.4, 0.4)


def simulated(shared, q_a, v_a, x):
    """A run from a thread's own posture, its valves set by one program for all."""
    recording = crane.simulate(*shared, q_a[0], duration=0.03)
    return [recording.q, recording.v, recording.tau, *recording.channels.values()]


@pytest.mark.slow
def test_simulations(patu):
    assert wrong(lambda: (patu, crane.control.SampledCommand(program, patu)), simulated, patu) == 0
