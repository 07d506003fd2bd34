"""Sensitivities of simulations against closed forms and differences of simulations."""

import warnings

import numpy as np
import pytest
import singular_linkages
from command_line import typed
from test_ball_joints import ROD, RSSR, RSSR_FILE
from test_floating import box, hinge
from urdf_text import sliding_block

import crane
from crane.common.errors import CraneError
from crane.formats.machine_loading import MachineVariants
from crane.recordings import table_reader

MASS, STIFFNESS, DAMPING = 2.0, 50.0, 0.6


def block(folder, friction="{}", spring=""):
    """A block that slides along x."""
    sliding_block(folder, MASS)
    (folder / "block.yaml").write_text(
        f"name: block\nchains: [{{name: block, urdf: block.urdf}}]\nloops: []\nactive: [x]\n"
        f"home: {{x: 0}}\nfriction: {friction}\n{spring}"
    )
    return crane.load(folder / "block.yaml")


def swung(time, x0, v0, mass, stiffness, damping):
    """Position and velocity (N, 2) of a damped spring, as its closed form."""
    roots = np.roots(np.array([mass, damping, stiffness], dtype=complex))
    weights = np.linalg.solve(np.array([[1, 1], roots]), np.array([x0, v0], dtype=complex))
    waves = weights * np.exp(np.outer(time, roots))
    return np.stack([waves.sum(1).real, (waves * roots).sum(1).real], axis=1)


def test_a_damped_spring_as_its_closed_form(tmp_path):
    spring = f"forces: [{{joint: x, stiffness: {STIFFNESS}, damping: {DAMPING}}}]"
    machine = block(tmp_path, spring=spring)
    by = ("start.x", "start.x_velocity", "block.mass", "spring.x.stiffness", "spring.x.damping")
    found = crane.sensitivities(machine, None, ([0.3], [0.1]), 5.0, 2e-3, parameters=by,
                                outputs=("x", "x_velocity"))  # fmt: skip
    time = found.recording.time
    at = np.array([0.3, 0.1, MASS, STIFFNESS, DAMPING])
    for i, name in enumerate(by):
        h = 1e-3 * at[i] * np.eye(5)[i]
        weights = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
        true = sum(
            w * (swung(time, *(at + j * h)) - swung(time, *(at - j * h))) for j, w in weights
        )
        true /= 1e-3 * at[i]
        assert found.derivatives[:, :, i] == pytest.approx(true, abs=1e-9 * np.abs(true).max()), (
            name
        )
    assert found.values == pytest.approx(at)


def test_behind_a_stop_everything_depends_on_when_it_stopped(tmp_path):
    """A block swings on a spring until friction F holds it, at (-1)^n (x0 - 2 n F / k)."""
    coulomb, x0 = 1.7, 0.3
    spring = f"forces: [{{joint: x, stiffness: {STIFFNESS}}}]"
    machine = block(tmp_path, f"{{x: {{coulomb: {coulomb}}}}}", spring)
    by = ("start.x", "friction.x.coulomb", "spring.x.stiffness", "block.mass")
    outputs = ("x", "x_velocity")
    found = crane.sensitivities(machine, None, [x0], 4.0, 2e-3, parameters=by, outputs=outputs)
    n = round((x0 * STIFFNESS / coulomb - 1.0) / 2.0 + 0.4999)
    assert found.recording.q[-1, 0] == pytest.approx(
        (-1) ** n * (x0 - 2 * n * coulomb / STIFFNESS)
    )
    true = (-1) ** n * np.array([1.0, -2 * n / STIFFNESS, 2 * n * coulomb / STIFFNESS**2, 0.0])
    assert found.derivatives[-1, 0] == pytest.approx(true, abs=1e-8)
    assert found.derivatives[-1, 1] == pytest.approx(0.0, abs=1e-8)
    # and during the first half swing
    w, time = np.sqrt(STIFFNESS / MASS), found.recording.time
    first = time < np.pi / w
    assert found.derivative("x", "start.x")[first] == pytest.approx(
        np.cos(w * time[first]), abs=1e-8
    )


class Ramp(crane.control.ControlLaw):
    """A force that grows."""

    def references(self, times):
        return 3.0 * times[:, None]

    def law(self, inputs):
        return inputs.reference, ()


def test_behind_a_start_everything_depends_on_when_it_started(tmp_path):
    """A growing force c t moves a block from t = F / c on: x = c (t - F / c)^3 / (6 m)."""
    coulomb = 2.0
    machine = block(tmp_path, f"{{x: {{coulomb: {coulomb}}}}}")
    by = ("friction.x.coulomb", "block.mass")
    found = crane.sensitivities(
        machine, Ramp(machine), [0.0], 2.0, 2e-3, parameters=by, outputs=("x",)
    )
    since = np.maximum(found.recording.time - coulomb / 3.0, 0.0)
    assert found.derivatives[:, 0, 0] == pytest.approx(-(since**2) / (2 * MASS), abs=1e-9)
    assert found.derivatives[:, 0, 1] == pytest.approx(-3.0 * since**3 / (6 * MASS**2), abs=1e-9)


def differences(machine, made, by, duration, step, outputs, share):
    """Derivatives (N, k, p) of order 4, and how far those over half as much differ."""
    variants, out, doubt = MachineVariants(machine), [], []

    def run(name, value):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            other = variants.machine({name: value})
            controller, initial = made(other)
            columns = crane.simulate(
                other, controller, initial, duration, step, tolerance=1e-12
            ).columns()
        return np.column_stack([columns[output] for output in outputs])

    for name in by:
        value = variants.values[name]
        found = []
        size = abs(value) if value else 0.1
        for h in (share * size, 0.5 * share * size):
            near, far = (run(name, value + i * h) - run(name, value - i * h) for i in (1, 2))
            found.append((8 * near - far) / (12 * h))
        out.append(found[1])
        doubt.append(np.abs(found[1] - found[0]))
    return np.stack(out, axis=2), np.stack(doubt, axis=2)


def compare(machine, made, by, duration, step, outputs, share):
    """To 1e-6, or as well as differences of simulations know. Returns the relative gaps."""
    controller, initial = made(machine)
    found = crane.sensitivities(
        machine,
        controller,
        initial,
        duration,
        step,
        parameters=by,
        outputs=outputs,
        tolerance=1e-10,
    )
    true, doubt = differences(machine, made, by, duration, step, outputs, share)
    gap, doubt = np.abs(found.derivatives - true).max(axis=0), doubt.max(axis=0)
    columns = found.recording.columns()
    sizes = np.array([np.ptp(columns[output]) for output in outputs])[:, None]
    numbers = np.where(found.values, np.abs(found.values), 0.1)
    size = np.maximum(np.abs(true).max(axis=0), 1e-6 * sizes / numbers)
    assert (gap <= 1e-6 * size + 10.0 * doubt).all(), (gap / size, doubt / size)
    assert np.median(doubt / size) < 1e-3
    return gap / size


def test_a_closed_chain_under_computed_torque():
    machine = crane.load("mini_forwarder")
    reference = crane.task_trajectory(machine, "lift")

    def made(other):
        return crane.ComputedTorque(machine, reference), None

    by = ("link3.mass", "friction.X1.viscous", "link3_G.x")
    compare(machine, made, by, 2.0, 1e-3, ("X1", "q2", "X1_force", "tip_z"), 1e-2)


def test_a_linkage_short_of_its_dead_centre(tmp_path):
    """Velocities of joints per that of the slider become 15 times those at home."""
    machine = singular_linkages.slider_crank(tmp_path, "s", 0.3, 0.6)
    begin = singular_linkages.start(machine, "a", 2.0)
    outputs = ("s", "s_velocity", "a")
    by = ("rod.mass", "slider.mass")
    compare(machine, lambda _: (None, begin), by, 0.173, 1e-3, outputs, 1e-2)
    with pytest.raises(CraneError, match="come near a dead centre"):
        crane.sensitivities(machine, None, begin, 0.2, 1e-3, parameters=by)


SHIP = (
    '<robot name="ship">' + box("hull", 8.0, "0.02 -0.01 0.05") + box("crank", 1.0, "0.1 0 0")
    + box("coupler", 2.0, "0.2 0.02 0") + box("rocker", 1.5, "0.15 0 0.01")
    + hinge("c", "hull", "crank", "0.1 0 0.2") + hinge("d", "crank", "coupler", "0.2 0 0")
    + hinge("r", "hull", "rocker", "0.5 0 0.2") + '<link name="eye"/><link name="pin"/>'
    + hinge("e", "coupler", "eye", "0.45 0 0", kind="fixed")
    + hinge("f", "rocker", "pin", "0.3 0 0", kind="fixed") + "</robot>"
)  # fmt: skip
SHIP_FILE = """
name: ship
chains: [{name: all, urdf: ship.urdf}]
loops: [{name: l, type: revolute, predecessor: eye, successor: pin}]
active: [c]
home: {c: 0.8, d: -0.58, r: 0.93}
"""
# starts and parameters: an open tree, a rod whose spin alone is active, a floating loop
TURNING = {
    "rod": (
        ([0.1, 0.3, 2.0, 1.0], [0.0, 1.0, 2.0, 5.0]),
        ("start.b_ry", "start.b_rz_velocity", "rod.mass"),
    ),
    "rssr": (None, ("start.b_rx", "start.c", "rod.mass", "rod_end.x")),
    "ship": (None, ("start.base_ry", "start.base_x", "start.c", "coupler.mass", "pin.x")),
}


@pytest.mark.parametrize("name", TURNING)
def test_machines_that_turn_past_half_a_turn(name, tmp_path):
    """To 1e-6 of differences of runs, but for where these have rotation vectors on both sides."""
    (initial, by), texts = TURNING[name], {"rod": ROD, "rssr": RSSR, "ship": SHIP}
    (tmp_path / f"{name}.urdf").write_text(texts[name])
    path = tmp_path / f"{name}.urdf"
    if name != "rod":
        path = tmp_path / f"{name}.yaml"
        path.write_text({"rssr": RSSR_FILE, "ship": SHIP_FILE}[name])
    machine = crane.load(path, floating=name == "ship")
    if initial is None:
        speeds = {"c": 3.0, "b_rx": 8.0, "base_rx": 4.0, "base_rz": 3.0}
        v_a = [speeds.get(joint, 0.0) for joint in machine.active]
        initial = machine.home[machine.closure.active], v_a
    made = (None, initial, 1.2, 2e-3)
    found = crane.sensitivities(machine, *made, parameters=by, outputs=machine.active)
    total = crane.simulation.gradient(
        machine, *made, functional=lambda time, y: (0.5 * (y**2).sum(), y), parameters=by,
        outputs=machine.active,
    )  # fmt: skip
    expected = np.einsum("nk,nkp->p", found.recording.q, found.derivatives)
    np.testing.assert_allclose(total.derivatives, expected, rtol=1e-7)
    wraps = np.abs(np.diff(found.recording.q, axis=0)).max(axis=1) > 1.0
    assert wraps.any()
    variants = MachineVariants(machine)
    for k, parameter in enumerate(by):
        h = 3e-4 * max(abs(found.values[k]), 0.1)

        def moved(change, parameter=parameter):
            start, (q, v) = parameter.removeprefix("start."), map(np.copy, initial)
            if start == parameter:
                varied = variants.machine({parameter: variants.values[parameter] + change})
                return crane.simulate(varied, None, (q, v), *made[2:]).q
            joint = start.removesuffix("_velocity")
            (q if joint == start else v)[machine.active.index(joint)] += change
            return crane.simulate(machine, None, (q, v), *made[2:]).q

        weights = ((1, 2 / 3), (2, -1 / 12))
        true = sum(w * (moved(j * h) - moved(-j * h)) for j, w in weights) / h
        gap = np.abs(true - found.derivatives[:, :, k]).max(axis=1)
        size = np.abs(found.derivatives[:, :, k]).max()
        jumps = np.abs(true).max(axis=1) > 100.0 * size
        assert jumps.sum() <= 4 * wraps.sum() and gap[~jumps].max() < 1e-6 * size, parameter


HYDRAULIC = ("payload.mass", "oil.bulk_modulus", "valve.X_lift.c1", "cylinder.X_lift.hose_a",
             "lift_eye.x", "friction.X_lift.viscous")  # fmt: skip


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    ("sticks", "share"),
    [
        (True, 1e-4),
        (False, 3e-4),
    ],
)
def test_ten_seconds_on_valves(sticks, share):
    changes = {"payload.mass": 150.0} | ({} if sticks else {
        f"friction.{joint}.{key}": 0.0 for joint in ("X_lift", "X_tilt")
        for key in ("coulomb", "stiction")
    })  # fmt: skip
    machine = crane.load("patu655", changes=changes, lock={"X_ext": 0.1, "slew": 0.0})

    def made(other):
        valve = other.hydraulics.valves["X_lift"]
        levers = valve.neutral + 0.4 * np.array([0, 0, 1, 1, 0, 0]) * (valve.full - valve.neutral)
        signals = crane.control.ValveSignals(other, [0, 0.5, 1, 4, 4.5, 10.0], {"X_lift": levers})
        return signals, [0.2, 0.3]

    outputs = ("X_lift", "X_tilt", "pressure_X_lift_a", "tip_z")
    gap = compare(machine, made, HYDRAULIC, 10.0, 1e-3, outputs, share)
    assert gap[0, HYDRAULIC.index("valve.X_lift.c1")] < 1e-6  # which differences know best


def test_what_has_no_sensitivity_is_refused(tmp_path):
    machine = block(tmp_path)
    start = ([0.0], [1.0])
    for options, text in (
        ({"parameters": ["start.y"]}, "'start.y' is no start of an active joint"),
        ({"parameters": ["mass"]}, "'mass'"),
        ({"parameters": ["block.mass"], "outputs": ["y"]}, "'y' is no output of 'block'"),
        ({"parameters": []}, "no number is named"),
    ):
        with pytest.raises(CraneError, match=text):
            crane.sensitivities(machine, None, start, 0.1, **options)
    with pytest.raises(CraneError, match="write it as a crane.control.ControlLaw"):
        crane.sensitivities(machine, lambda t, q, v: q, start, 0.1, parameters=["block.mass"])
    with pytest.raises(CraneError, match="dead centre"):
        crank = crane.load("tests/data/slider_crank.yaml")
        crane.sensitivities(crank, None, ([1.0], [0.0]), 2.0, parameters=["start.theta"])


def test_the_command_tells_what_a_motion_depends_on(tmp_path):
    out = tmp_path / "out"
    command = ("sensitivities", "mini_forwarder", "--task", "lift", "--duration", "0.1")
    numbers = ("--by", "link3.mass", "--by", "start.X1", "--outputs", "X1,X1_force,q1")
    done = typed(*command, *numbers, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "| link3.mass | 0.218 | 0.00218 |" in done.stdout and "X1_force [N]" in done.stdout
    names = {"sensitivities.md", "sensitivities.csv", "sensitivities.png"}
    assert {path.name for path in out.iterdir()} == names
    table = table_reader.read_table(out / "sensitivities.csv")
    first = dict(zip(table.units, table.values[0], strict=True))
    assert first["X1 by start.X1"] == pytest.approx(1.0) and first["X1 by link3.mass"] == 0.0
    for options, said in (
        (numbers, "is not empty"), (("--by", "nix"), "'nix' is unknown"),
        (("--by", "start.X1", "--outputs", "foo"), "'foo' is no output"),
    ):  # fmt: skip
        done = typed(*command, *options, *(("--out", out) if options is numbers else ()))
        assert done.returncode == 2 and said in done.stderr
