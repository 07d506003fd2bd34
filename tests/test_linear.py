"""Linear models against closed forms, short simulations and formats of other programs."""

import numpy as np
import pytest
from command_line import typed
from hydraulic_rig import AREA_A, AREA_B, COMPENSATED, HOSE, STROKE, rig
from warned import quiet

import crane
from crane.common.errors import CraneError, CraneWarning
from crane.simulation.linear.linearization import external_force_derivatives


@pytest.fixture(scope="module")
def patu():
    machine = crane.load("patu655")
    return machine.replace(friction={})


def test_a_load_on_its_oil(tmp_path):
    """w^2 = k / m, k = K (A_a^2 / V_a + A_b^2 / V_b), of closed valves."""
    machine = rig(tmp_path, COMPENSATED, friction={"viscous": 300.0}, supply={"tank": 2e5})
    place = 0.2
    model = crane.linearize(machine)
    assert model.inputs == ("voltage_x",) and model.states[:2] == ("x", "x_velocity")
    stiffness = 1.2e9 * (
        AREA_A**2 / (HOSE + AREA_A * place) + AREA_B**2 / (HOSE + AREA_B * (STROKE - place))
    )
    rings = [mode for mode in model.modes if mode.pole.imag > 0]
    assert len(rings) == 1
    undamped = crane.linearize(machine.replace(friction={}))
    (ring,) = (mode for mode in undamped.modes if mode.is_oscillatory)
    assert ring.damping == 0 and str(ring.damping) == "0.0"  # not what rounding leaves
    assert f"| {ring.frequency:.4g} | 0 |  | x |" in undamped.to_text()
    assert "nothing answers voltage_x there; a velocity opens valves" in undamped.to_text()
    # p^2 + c/m p + k/m = 0
    poles = np.roots([1.0, 300.0 / 2000.0, stiffness / 2000.0])
    np.testing.assert_allclose(rings[0].pole, poles[poles.imag > 0][0], rtol=1e-11)
    assert rings[0].frequency == pytest.approx(np.sqrt(stiffness / 2000.0) / (2 * np.pi), rel=1e-9)
    assert rings[0].damping == pytest.approx(300.0 / 2 / np.sqrt(stiffness * 2000.0), rel=1e-9)
    # the cushion of oil is all that holds it: pressures balance the weight
    pressures = model.y[list(model.outputs).index("pressure_x_a") :][:2]
    assert AREA_A * pressures[0] - AREA_B * pressures[1] == pytest.approx(2000.0 * 9.81, rel=1e-3)
    np.testing.assert_allclose(model.rate, 0.0, atol=1e-6)


def pulled(machine):
    """With a constant force, and one that grows with the way and the speed."""

    class Held(crane.description.ExternalForce):
        def wrench(self, here):
            return [-2e3 * here.position[0] - 50 * here.velocity[0], 0.0, -300.0], [0.0, 40.0, 0.0]

    return machine.with_external_forces(
        crane.Wrench(machine.tip, (800.0, 0.0, -1500.0)), Held(machine.tip, "b")
    )


def test_forces_from_outside_are_part_of_it():
    """Beside differences of the accelerations, by all that goes with place and speed."""
    machine = crane.load("patu655", lock={"X_ext": 0.1, "slew": 0.0})
    loaded = pulled(machine)
    model = crane.linearize(loaded, drive="forces", outputs=["X_lift"])
    np.testing.assert_allclose(model.rate, 0.0, atol=1e-9)
    dynamics, n = crane.Dynamics(machine), len(machine.active)
    kinematics = crane.Kinematics(machine)
    first = model.x[:n]

    def acceleration(q_a, v_a):
        place, speed = kinematics.position(q_a), kinematics.jacobian(q_a) @ v_a
        push = [800.0 - 2e3 * place[0] - 50 * speed[0], 0.0, -1800.0, 0.0, 40.0, 0.0]
        return dynamics.forward(
            q_a, v_a, model.u + dynamics.project_wrenches(q_a, {machine.tip: push})
        )

    for i in range(n):
        way = 1e-4 * np.eye(n)[i]
        by_place, by_speed = (
            (acceleration(first + q, v) - acceleration(first - q, -v)) / 2e-4
            for q, v in ((way, 0 * way), (0 * way, way))
        )
        np.testing.assert_allclose(model.A[n:, i], by_place, rtol=1e-6, atol=1e-5)
        # joints' own friction is that of a motion that has begun
        own = crane.linearize(machine, drive="forces", outputs=["X_lift"]).A[n:, n + i]
        np.testing.assert_allclose(model.A[n:, n + i] - own, by_speed, rtol=1e-6, atol=1e-6)


def test_stiffness_under_a_constant_force_is_symmetric():
    """As of all that has a potential, -F p: to the digits that its differences leave."""
    for name, force in (("mini_forwarder", (2, 1, -5)), ("excavator", (1e4, 0, -2e4))):
        machine = quiet(crane.load, name)
        q_a = machine.home[machine.closure.active]
        loaded = machine.with_external_forces(crane.Wrench(machine.tip, force))
        stiffness = external_force_derivatives(loaded, q_a, 0 * q_a)[1][:, : len(q_a)]
        off = np.abs(stiffness - stiffness.T).max()
        assert off < 1e-10 * np.abs(stiffness).max() and np.abs(stiffness).max() > 0


def test_on_valves_chambers_bear_forces_from_outside():
    machine = crane.load("patu655", lock={"X_ext": 0.1, "slew": 0.0})
    model, n = crane.linearize(pulled(machine)), len(machine.active)
    np.testing.assert_allclose(model.rate[: 2 * n], 0.0, atol=1e-9)  # what leaks goes on leaking
    run = crane.simulate(pulled(machine), None, None, 0.5)
    assert np.abs(run.q - run.q[0]).max() < 1e-9
    a, b = (run[f"pressure_X_lift_{x}"][0] for x in "ab")
    at = {name: model.y[i] for i, name in enumerate(model.outputs)}
    np.testing.assert_allclose(
        [at["pressure_X_lift_a"], at["pressure_X_lift_b"]], [a, b], rtol=1e-9
    )


def test_what_remembers_its_way_is_left_out_and_told():
    machine = crane.load("excavator")
    foot = crane.description.Contact(machine.tip, lateral_stiffness=1e6)
    with pytest.warns(CraneWarning, match=f"remember their way .*left out: {machine.tip}"):
        crane.linearize(machine.with_external_forces(foot), drive="forces")


def test_a_mass_on_a_spring_under_a_force(tmp_path):
    machine = rig(tmp_path, friction={"viscous": 300.0})
    machine = machine.replace(
        forces=(crane.description.ForceElement("x", stiffness=5e4, rest=0.1),)
    )
    model = crane.linearize(machine, drive="forces", outputs=["x", "x_velocity", "x_force"])
    np.testing.assert_allclose(model.A, [[0, 1], [-5e4 / 2000, -300 / 2000]], rtol=1e-13)
    np.testing.assert_allclose(model.B, [[0], [1 / 2000]], rtol=1e-13)
    np.testing.assert_allclose(model.C, [[1, 0], [0, 1], [0, 0]], atol=0)
    np.testing.assert_allclose(model.D, [[0], [0], [1]], atol=0)
    assert model.u[0] == pytest.approx(2000 * 9.81 + 5e4 * 0.1, rel=1e-4)
    s = 2j * np.pi * 0.7
    wanted = 1.0 / (2000 * s * s + 300 * s + 5e4)
    np.testing.assert_allclose(model.response([0.7])[0, 0, 0], wanted, rtol=1e-12)
    rising = crane.linearize(machine, drive="forces", velocity={"x": 0.2})
    assert rising.u[0] - model.u[0] == pytest.approx(300.0 * 0.2, rel=1e-9)


def deviations(machine, model, controller, start, moved, times):
    """Recorded outputs that a simulation differs by, times (N,) in even steps from 0."""
    step = times[1] - times[0]
    runs = [
        quiet(crane.simulate, machine, made, initial, times[-1], step, tolerance=1e-12)
        for made, initial in ((controller[0], start), (controller[1], moved))
    ]

    def column(run, name):
        return run.q[:, run.joints.index(name)] if name in run.joints else run.channels[name]

    return np.column_stack(
        [column(runs[1], name) - column(runs[0], name) for name in model.outputs]
    )


@pytest.mark.parametrize("velocity", (None, {"slew": 0.2, "X_lift": 0.03}))
def test_small_motions_under_forces_are_the_simulation(patu, velocity):
    """Of a crane that stands or moves: the model is of first order in what is moved."""
    at = {"X_lift": 0.25, "X_tilt": 0.35}
    model = crane.linearize(
        patu, at, velocity=velocity, drive="forces",
        outputs=["X_lift", "X_tilt", "slew", "q2", "tip_x", "tip_z"],
    )  # fmt: skip
    n, times = 4, np.linspace(0.0, 0.05, 11)
    q_a, v_a = model.x[:n], model.x[n:]
    state, push = np.array([1e-3, 2e-4, -1e-4, 3e-4, 1e-3, 1e-3, -2e-3, 1e-3]), 50.0
    gaps = []
    for share in (1e-2, 1e-3):
        moved, inputs = share * state, share * np.array([0.0, push, 0.0, 0.0])

        class Given(crane.control.ControlLaw):
            def __init__(self, forces):
                super().__init__(patu)
                self.settings = forces

            def law(self, at):
                return at.settings, ()

        controllers = Given(model.u), Given(model.u + inputs)
        found = deviations(
            patu, model, controllers, (q_a, v_a), (q_a + moved[:n], v_a + moved[n:]), times
        )
        wanted = model.simulate(times, moved, inputs)
        gaps.append(np.abs(found - wanted).max() / np.abs(wanted).max())
    if velocity is None:  # else the operating point moves on
        assert gaps[1] < 1e-5 and gaps[1] < 0.2 * gaps[0]
    else:
        assert gaps[1] < 2e-2


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
@pytest.mark.parametrize(("name", "joint"), [("patu655", "X_lift"), ("excavator_ls", "X_boom")])
def test_in_motion_the_pump_keeps_its_pressure(name, joint):
    model = crane.linearize(crane.load(name), velocity={joint: 0.03})
    rate = model.rate[list(model.states).index("pressure_supply")]
    assert abs(rate) < 1.0  # of 1e8 Pa/s where the pump's flow is not taken


def test_small_motions_on_the_valves_are_the_simulation(patu):
    """The boom rings on its oil after a push; a valve that is open answers its signal."""
    # both chambers well above the tank, whose valves let oil in below
    high = {joint: (60e5, 60e5) for joint in patu.active}
    model = quiet(crane.linearize, patu, {"X_lift": 0.25, "X_tilt": 0.35}, pressures=high)
    n, times = 4, np.linspace(0.0, 0.3, 31)
    q_a = model.x[:n]
    inputs = np.zeros(4)
    start = np.zeros(len(model.x))
    start[n + 1 : n + 3] = 1e-4, -2e-4
    at = dict(zip(model.states, model.x, strict=True))
    held = {j: (at[f"pressure_{j}_a"], at[f"pressure_{j}_b"]) for j in patu.active}
    controllers = (
        crane.control.ValveDrive(patu, crane.control.ValveSignals(patu, [0.0], {}), held),
    ) * 2
    found = deviations(
        patu, model, controllers, (q_a, np.zeros(n)), (q_a, start[n : 2 * n]), times
    )
    wanted = model.simulate(times, start, inputs)
    for i, name in enumerate(model.outputs):
        scale = np.abs(wanted[:, i]).max()
        if scale > 1e-12:
            assert np.abs(found[:, i] - wanted[:, i]).max() < 2e-3 * scale, name
    ring = next(mode for mode in model.modes if mode.pole.imag > 0)
    assert 3.0 < ring.frequency < 5.0
    # the spring in series bears what its cylinder does, whatever pressures are asked for
    cylinder = patu.hydraulics.cylinders["X_lift"]
    force = cylinder.area_a * at["pressure_X_lift_a"] - cylinder.area_b * at["pressure_X_lift_b"]
    assert at["spring_X_lift"] == pytest.approx(force / cylinder.stiffness, rel=1e-9)


def test_over_strokes_and_loads(patu):
    """A larger load lowers the frequency; a machine loaded with it has the same model."""
    machine = crane.load("patu655")
    found = quiet(
        crane.simulation.linear_models,
        machine,
        {"payload.mass": [0.0, 400.0], "X_lift": [0.15, 0.3]},
    )
    assert [tuple(values.values()) for values, _ in found] == [
        (0.0, 0.15), (0.0, 0.3), (400.0, 0.15), (400.0, 0.3)
    ]  # fmt: skip
    rings = [min(m.frequency for m in model.modes if m.pole.imag > 1) for _, model in found]
    assert rings[2] < rings[0] and rings[3] < rings[1]
    loaded = crane.load("patu655", changes={"payload.mass": 400.0})
    again = quiet(crane.linearize, loaded, {"X_lift": 0.3})
    np.testing.assert_allclose(again.A, found[3][1].A, rtol=0, atol=1e-9 * np.abs(again.A).max())


def test_files_and_python_control(patu, tmp_path):
    control = pytest.importorskip("control")
    from scipy.io import loadmat

    model = quiet(crane.linearize, patu, drive="forces")
    read = loadmat(model.save(tmp_path / "model.mat"))
    for name in "ABCD":
        np.testing.assert_array_equal(read[name], getattr(model, name))
    assert [str(x[0]) for x in read["states"].ravel()] == list(model.states)
    with np.load(model.save(tmp_path / "model.npz")) as kept:
        np.testing.assert_array_equal(kept["A"], model.A)
        assert tuple(kept["inputs"]) == model.inputs
    system = model.to_control()
    assert isinstance(system, control.StateSpace)
    assert system.state_labels == list(model.states)
    frequency = 1.3
    wanted = model.response([frequency])[0]
    found = system(2j * np.pi * frequency)
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize(
    "options, said",
    [
        ({"drive": "valve"}, "drive 'valve' is unknown"),
        ({"operating_point": {"X_lft": 0.2}}, "at: 'X_lft' is no active joint"),
        ({"operating_point": {"X_lift": 2.0}}, "outside of its limits"),
        ({"outputs": ["tip_w"]}, "output 'tip_w' is unknown"),
        ({"velocity": {"X_ext": 5.0}}, "cannot be trimmed there"),
    ],
)
def test_what_cannot_be_is_said(patu, options, said):
    with pytest.raises(CraneError) as error:
        crane.linearize(patu, **options)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_no_valves_and_files(tmp_path):
    with pytest.raises(CraneError, match="has no valves, take the drive 'forces'"):
        crane.linearize("mini_forwarder", drive="valves")
    with pytest.raises(CraneError, match=r"written as .mat or .npz"):
        crane.linearize("tx40").save(tmp_path / "model.txt")
    with pytest.raises(CraneError, match="parameter 'payload.mas' is unknown"):
        crane.simulation.linear_models("patu655", {"payload.mas": [1.0]})


def test_a_free_joint_that_hangs_still_and_one_that_does_not():
    machine = crane.load("tx40", free=["q5"])
    with pytest.raises(CraneError, match="free joint 'q5' does not stay there"):
        crane.linearize(machine, {"q2": 0.4, "q3": 0.7, "q5": 0.8})


def test_the_command_writes_model_pictures_and_page(tmp_path):
    done = typed(
        "modes", "patu655", "--vary", "X_lift=0.1:0.4:3", "--vary", "payload.mass=0:300:2",
        "--velocity", "X_tilt=0.02", "--out", tmp_path / "modes",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "| frequency [Hz] | damping [%] |" in done.stdout
    written = {path.name for path in (tmp_path / "modes").iterdir()}
    assert written == {
        "model.mat", "model.npz", "modes.md", "modes.png", "over.png", "view.html"
    }  # fmt: skip
    with np.load(tmp_path / "modes" / "model.npz") as model:
        assert model["A"].shape[0] == len(model["states"]) == 26
    done = typed("modes", "patu655", "--out", tmp_path / "modes")
    assert done.returncode == 2 and "--force" in done.stderr
    done = typed("modes", "patu655", "--vary", "X_lft=0.1:0.4:3")
    assert done.returncode == 2 and "parameter 'X_lft' is unknown" in done.stderr


def test_what_rings_is_shown_within_the_strokes(patu):
    model = quiet(crane.linearize, patu)
    motion = model.mode_animation()
    assert motion.task == "modes in slow motion"
    rings = [mode.frequency for mode in model.modes if mode.is_oscillatory]
    assert list(dict.fromkeys(motion.channels["mode_frequency"])) == rings
    assert (motion.q >= patu.lower).all() and (motion.q <= patu.upper).all()
    assert np.abs(np.diff(motion.q, axis=0)).max() < 0.02
    assert crane.linearize(crane.load("tx40"), drive="forces").mode_animation() is not None
