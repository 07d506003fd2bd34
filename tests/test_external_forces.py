"""External forces against Pinocchio's, closed forms and energy."""

import dataclasses
import warnings

import numpy as np
import pinocchio as pin
import pytest
from command_line import typed
from urdf_text import body, joint, write

import crane
from crane.codegen.symbolic import scale_vector
from crane.common.errors import CraneError
from crane.recordings import table_reader

BUNDLED = ("mini_forwarder", "patu655")


def wandering(machine, count=5, seed=0):
    """States (N, n) within the middle half of the limits."""
    random = np.random.default_rng(seed)
    middle = 0.5 * (machine.lower + machine.upper)
    reach = 0.25 * np.minimum(machine.upper - machine.lower, 2.0)
    middle = np.where(np.isfinite(middle), middle, 0.0)
    q_a = middle + reach * random.uniform(-1, 1, (count, len(middle)))
    return q_a, 0.1 * random.normal(size=q_a.shape), random


@pytest.mark.parametrize("name", BUNDLED)
def test_wrenches_do_what_those_of_pinocchio_do(name):
    """gamma^T (rnea(q, v, a) - rnea(q, v, a, f_ext)) with wrenches on the bodies."""
    machine = crane.load(name)
    dynamics = crane.Dynamics(machine)
    q_a, v_a, random = wandering(machine)
    model, link = machine.model, machine.tip
    wrenches = random.normal(size=(len(q_a), 6))
    found = dynamics.project_wrenches(q_a, {link: wrenches})
    data, frame = model.createData(), model.frames[machine.frame(link)]
    for i, q in enumerate(machine.closure.solve(q_a)):
        gamma = machine.closure.gamma(q)
        at, v = machine.coordinates.configuration(q), gamma @ v_a[i]
        a = gamma @ random.normal(size=len(v_a[i]))
        without = pin.rnea(model, data, at, v, a).copy()
        pin.framesForwardKinematics(model, data, at)
        upright = pin.SE3(np.eye(3), data.oMf[machine.frame(link)].translation)
        outer = [pin.Force.Zero() for _ in range(model.njoints)]
        in_world = upright.act(pin.Force(wrenches[i]))
        outer[frame.parentJoint] = data.oMi[frame.parentJoint].actInv(in_world)
        true = gamma.T @ (without - pin.rnea(model, data, at, v, a, outer))
        assert found[i] == pytest.approx(true, abs=1e-11 * np.abs(true).max() + 1e-12)


class Drag(crane.description.ExternalForce):
    """A force against the velocity, and a moment against the spin."""

    def wrench(self, here):
        return scale_vector(-30.0, here.velocity), scale_vector(-2.0, here.angular_velocity)


def dragged(time, place, turn, velocity, spin):
    return np.concatenate([-30.0 * velocity, -2.0 * spin])


def loads_of(machine, drag):
    times = [0.0, 0.2, 0.2, 0.6]
    forces = [[0, 0, 0], [3, 2, -5], [-2, 1, 4], [0, 0, 1]]
    turned = crane.Wrench(machine.tip, (1.0, -2.0, 0.5), (0.2, 0.1, -0.3), axes="frame", name="t")
    return crane.Wrench(machine.tip, forces, times=times), turned, drag


@pytest.mark.parametrize("method", ["rk4", "DOP853"])
def test_a_function_in_python_does_what_formulas_do(method):
    sticky = crane.load("mini_forwarder")
    machine = sticky.replace(
        friction={
            x: crane.description.Friction(viscous=law.viscous)
            for x, law in sticky.friction.items()
        }
    )
    start = machine.home[machine.closure.active], [0.3, 0.02, 0.01]
    runs = [
        crane.simulate(machine, None, start, 0.3, 2e-3, method=method, loads=loads)
        for loads in (
            loads_of(machine, Drag(machine.tip, "drag")),
            loads_of(machine, crane.description.WrenchFunction(machine.tip, dragged, "drag")),
        )
    ]
    assert runs[0].q == pytest.approx(runs[1].q, abs=1e-11)
    for name in ("work_drag", "work_t", "load_drag_force_x", "load_t_moment_z"):
        one, other = (run.channels[name] for run in runs)
        assert one == pytest.approx(other, abs=1e-9 * np.abs(other).max()), name
        assert np.abs(other).max() > 1e-3


@pytest.mark.parametrize("method", ["DOP853", "Radau", "rosenbrock"])
def test_all_methods_agree_and_work_is_in_the_balance(method):
    machine = crane.load("mini_forwarder")
    controller = crane.ComputedTorque(machine, crane.task_trajectory(machine, "lift"))
    loads = loads_of(machine, Drag(machine.tip, "drag"))
    run = crane.simulate(machine, controller, None, 0.6, method=method, loads=loads)
    other = crane.simulate(machine, controller, None, 0.6, tolerance=1e-13, loads=loads)
    assert run.q == pytest.approx(other.q, abs=1e-7)
    seen = run.channels
    names = [f"work_{name}" for name in (machine.tip, "t", "drag")]
    assert all(np.ptp(seen[name]) > 1e-4 for name in names)
    work = seen["work"] + sum(seen[name] for name in names)
    stored = seen["kinetic"] + seen["potential"]
    gap = work - (stored - stored[0]) - seen["dissipated"]
    assert np.abs(gap).max() < 1e-6 * np.ptp(work)
    assert (np.diff(seen["work_drag"]) <= 1e-9).all()
    # the impulse of the drag is the way of the tip, which is seen apart
    way = np.stack([np.ptp(seen[f"tip_{x}"][[0, -1]]) for x in "xyz"])
    drag = np.stack([seen[f"load_drag_force_{x}"] for x in "xyz"], axis=1)
    impulse = 0.5 * (drag[1:] + drag[:-1]).sum(axis=0) * 1e-3
    assert np.abs(impulse) == pytest.approx(30.0 * way, rel=1e-3)


def test_what_carries_a_load_hangs_as_still_as_with_a_payload():
    """Initial pressures carry the loads at time 0."""
    machine = crane.load("patu655", lock={"X_ext": 0.1, "slew": 0.0})
    pull = crane.Wrench(machine.tip, (0.0, 0.0, -1500.0))
    run = crane.simulate(machine, None, None, 1.0, loads=(pull,))
    assert np.abs(run.q - run.q[0]).max() < 1e-9
    dynamics, q_a = crane.Dynamics(machine), run.q[0]
    wrench = {machine.tip: [0, 0, -1500.0, 0, 0, 0]}
    borne = dynamics.gravity(q_a) - dynamics.project_wrenches(q_a, wrench)
    np.testing.assert_allclose(run.tau[0], borne, rtol=1e-12)
    later = crane.Wrench(machine.tip, [(0, 0, 0), (0, 0, -1500.0)], times=[0.0, 0.5])
    unloaded = crane.simulate(machine, None, None, 1e-3, loads=(later,))
    np.testing.assert_allclose(unloaded.tau[0], dynamics.gravity(q_a), rtol=1e-12)
    mini = crane.load("mini_forwarder")
    law = crane.PI(
        mini.with_external_forces(crane.Wrench(mini.tip, (0, 0, -5.0))),
        crane.task_trajectory(mini, "lift"),
    )
    more = law.start(law.reference.position(0.0)) - crane.PI(mini, law.reference).start(
        law.reference.position(0.0)
    )
    lifted = crane.Dynamics(mini).project_wrenches(
        law.reference.position(0.0), {mini.tip: [0, 0, -5.0, 0, 0, 0]}
    )
    np.testing.assert_allclose(more * law.settings[3:], -lifted, rtol=1e-9, atol=1e-12)


def test_a_controller_of_the_bare_machine_begins_with_what_the_run_carries():
    mini = crane.load("mini_forwarder")
    stand = crane.point_to_point(*2 * [mini.home[mini.closure.active]], 1.0)
    law, pull = crane.PI(mini, stand), crane.Wrench(mini.tip, (0.0, 0.0, -5.0))
    run = crane.simulate(mini, law, loads=(pull,))
    assert np.abs(run.q - run.q[0]).max() < 1e-9
    crane_ = crane.load("patu655", lock={"X_ext": 0.1, "slew": 0.0})
    pull = crane.Wrench(crane_.tip, (0.0, 0.0, -1500.0))
    drive = crane.control.ValveDrive(crane_, crane.control.ValveSignals(crane_, [0.0], {}))
    given, own = (
        crane.simulate(crane_, control, duration=0.1, loads=(pull,)) for control in (drive, None)
    )
    np.testing.assert_array_equal(given["pressure_X_lift_a"], own["pressure_X_lift_a"])


def test_with_hydraulics_a_pull_is_in_the_chambers():
    """The force of a resting cylinder grows by the load's generalised force."""
    machine = crane.load("patu655", lock={"X_ext": 0.1, "slew": 0.0})
    pull = crane.Wrench(machine.tip, (0.0, 0.0, -1500.0))
    runs = [crane.simulate(machine, None, None, 4.0, loads=loads) for loads in ((), (pull,))]
    forces = [run.tau[-1] for run in runs]
    q_a = [run.q[-1] for run in runs]
    dynamics = crane.Dynamics(machine)
    more = dynamics.project_wrenches(q_a[1], {machine.tip: [0, 0, -1500.0, 0, 0, 0]})
    expected = [dynamics.gravity(q) - dynamics.passive(q, 0 * q) for q in q_a]
    difference = forces[1] - forces[0]
    friction = runs[1].channels["rest_X_lift"][-1] - runs[0].channels["rest_X_lift"][-1]
    # what friction holds at rest is told by the recording
    assert difference[0] - friction == pytest.approx(
        (expected[1] - expected[0] - more)[0], rel=1e-3
    )
    assert abs(more[0]) > 1e3


def test_recorded_loads_are_known_to_identification(tmp_path):
    machine = crane.load("mini_forwarder")
    motion = crane.ComputedTorque(machine, crane.task_trajectory(machine, "lift"))
    pull = crane.Wrench(machine.tip, [[0, 0, 0], [3, 1, -6]], [[0, 0, 0], [0.5, 0, 0]], [0, 4])
    without, pulled = (
        crane.simulate(machine, motion, None, 4.0, 4e-3, loads=loads) for loads in ((), (pull,))
    )
    told = {name: x for name, x in pulled.channels.items() if not name.startswith("load_")}
    units = {name: pulled.channel_units[name] for name in told}
    untold = dataclasses.replace(pulled, channels=told, channel_units=units)
    errors = []
    for one in (pulled, untold):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the same motion twice
            found = crane.identify(machine, one, without, prior=0.1, trust=one is untold)
        # q1 rests
        errors.append(found.validation.rmse[1:] / np.abs(without.tau).max(axis=0)[1:])
    assert errors[0].max() < 1e-4 and errors[1].max() > 0.2, errors
    with pytest.raises(CraneError, match="has the load 'push', and no column contains it"):
        crane.identify(
            machine.with_external_forces(crane.Wrench(machine.tip, name="push")),
            without,
            prior=0.1,
        )
    lost = pulled.channels | {"load_nix_force_x": 0 * pulled.time}
    units = pulled.channel_units | {"load_nix_force_x": "N"}
    nix = dataclasses.replace(pulled, channels=lost, channel_units=units)
    with pytest.raises(CraneError, match="'load_nix_force_x' acts on no link of 'mini_forw"):
        crane.identify(machine, nix, prior=0.1)


def test_what_a_function_in_python_raises_comes_out():
    machine = crane.load("patu655")

    def torn(time, place, turn, velocity, spin):
        if time > 0.05:
            raise ZeroDivisionError("torn")
        return np.zeros(6)

    motion = crane.task_trajectory(machine, "reach")
    for controller in (None, crane.ComputedTorque(machine, motion)):
        with pytest.raises(ZeroDivisionError, match="torn"):
            crane.simulate(
                machine,
                controller,
                None,
                0.2,
                loads=[crane.description.WrenchFunction(machine.tip, torn)],
            )


def test_what_is_no_load_is_refused():
    machine = crane.load("mini_forwarder")
    tip = machine.tip

    def run(load):
        crane.simulate(machine, None, None, 0.01, loads=[load])

    for load, text in (
        (lambda: crane.Wrench("nix", (1, 0, 0)), "'nix'"),
        (lambda: crane.Wrench(tip, (1, 0)), r"force has the shape \(2,\)"),
        (lambda: crane.Wrench(tip, (1, 0, np.nan)), "no finite number"),
        (lambda: crane.Wrench(tip, [[1, 0, 0]] * 2, times=[1, 0]), "times do not rise"),
        (lambda: crane.Wrench(tip, axes="tip"), "give 'world' or 'frame'"),
        (lambda: crane.description.WrenchFunction(tip, lambda *_: [np.nan] * 6), "six numbers"),
        (lambda: crane.description.WrenchFunction(tip, lambda *_: [1.0, 2.0]), "six numbers"),
        (lambda: 3.0, "no external force"),
        (lambda: crane.Wrench(machine.model.frames[1].name, (1, 0, 0)), "does not move"),
    ):
        with pytest.raises(CraneError, match=text):
            run(load())
    twice = [crane.Wrench(tip, (1, 0, 0))] * 2
    with pytest.raises(CraneError, match="two loads are called"):
        crane.simulate(machine, None, None, 0.01, loads=twice)


FILE = """
name: pushed
chains: [{name: block, urdf: block.urdf}]
active: [x, z]
home: {x: 0, z: 0}
loads:
  - {frame: block, force: [3, 0, 0], name: push}
  - frame: block
    force: [[0, 0, 0], [0, 0, 4]]
    times: [0, 2]
"""
MASS = 2.0


@pytest.fixture
def pushed(tmp_path):
    """A block that slides along x and, without weight on it, z."""
    slide = {"kind": "prismatic", "limits": (-100, 100)}
    write(
        tmp_path, "block", "base", '<link name="slide"/>', body("block", MASS),
        joint("x", "base", "slide", axis=(1, 0, 0), **slide),
        joint("z", "slide", "block", **slide),
    )  # fmt: skip
    path = tmp_path / "pushed.yaml"
    path.write_text(FILE)
    return path


def test_loads_of_a_machine_file_as_closed_forms(pushed, tmp_path):
    """Under F and c t, x = F t^2 / 2 m and z = c t^3 / 6 m - g t^2 / 2."""
    machine = crane.load(pushed)
    run = crane.simulate(machine, None, None, 2.0, 0.01)
    t = run.time
    true = np.stack([3 * t**2 / (2 * MASS), 2 * t**3 / (6 * MASS) - 9.81 * t**2 / 2], axis=1)
    assert run.q == pytest.approx(true, abs=1e-10)
    assert run.channels["work_push"] == pytest.approx(3 * true[:, 0], abs=1e-9)
    by = ("block.mass", "start.x_velocity")
    slopes = crane.sensitivities(
        machine, None, None, 2.0, 0.01, parameters=by, outputs=("x", "z")
    ).derivatives
    assert slopes[-1, 0] == pytest.approx([-3 * 4 / (2 * MASS**2), 2.0], abs=1e-8)
    assert slopes[-1, 1] == pytest.approx([-2 * 8 / (6 * MASS**2), 0.0], abs=1e-8)
    assert len(crane.load(pushed, lock={"x": 0.5}).external_forces) == 2
    written = crane.load(crane.write_machine(machine, tmp_path / "written"))
    again = crane.simulate(written, None, None, 2.0, 0.01)
    assert again.q == pytest.approx(run.q, abs=1e-12)


def test_wrong_loads_of_a_machine_file_are_told_with_their_line(pushed):
    for old, new, text in (
        ("force: [3, 0, 0]", "force: [3, 0]", r"yaml:7: .*shape \(2,\)"),
        ("force: [3, 0, 0]", "force: 3", "yaml:7: .*give a list"),
        ("force: [3, 0, 0], name", "name", "yaml:7: .*does nothing"),
        ("frame: block, force", "frame: base, force", "yaml:7: .*does not move"),
        ("frame: block, force", "frame: nix, force", "yaml:7: .*'nix'"),
        ("name: push}", "axes: up}", "yaml:7: 'axes' of a load: 'up' is unknown"),
        ("name: push}", "name: block}", "two loads are called 'block'"),
        ("times: [0, 2]", "times: [2, 0]", "yaml:8: .*do not rise"),
    ):
        pushed.write_text(FILE.replace(old, new))
        with pytest.raises(CraneError, match=text):
            crane.load(pushed)


def test_loads_are_typed(pushed, tmp_path):
    out, table = tmp_path / "out", tmp_path / "table.csv"
    table.write_text("time [s],force_x [kN]\n0,0.001\n1,0.002\n")
    command = ("simulate", pushed, "--duration", "1", "--step", "0.1", "--out", out)
    done = typed(*command, "--load", f"slide={table}")
    assert done.returncode == 0, done.stderr
    rows = table_reader.read_table(out / "recording.csv")
    x = rows.values[-1, list(rows.units).index("x")]
    # 3 N and 1 + t N
    assert x == pytest.approx((4 * 0.5 + 1 / 6) / MASS, abs=1e-9)
    for word, said in (
        ("slide", "no FRAME=WRENCH"), ("nix=1,0,0", "'nix'"), ("slide=1,0", "3 or 6 numbers"),
        ("slide=no.csv", "no.csv"), ("slide@up=1,0,0", "'world' or 'frame'"),
        ("block=1,0,0", "two loads are called"), ("slide=1,0,nan", "no finite number"),
    ):  # fmt: skip
        done = typed(*command[:-1], tmp_path / "other", "--load", word)
        assert done.returncode == 2 and said in done.stderr, done.stderr
        assert not (tmp_path / "other").exists()
