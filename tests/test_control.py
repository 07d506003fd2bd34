"""Control laws: gains, references and their errors."""

import numpy as np
import pytest
from warned import quiet

import crane
from crane.common.errors import InputError
from crane.control import CONTROLLERS, make_controller


@pytest.fixture(scope="module")
def path(mini):
    return crane.point_to_point([0.0, 0.012, 0.010], [0.5, 0.020, 0.014], 1.0)


def test_pi_is_equation_7(mini, path):
    pi = crane.PI(mini, path, integral=[0.1, 0.002, -0.003])
    state = pi.start(np.zeros(3))
    q_a = np.array([0.1, 0.011, 0.0125])
    tau, rate = pi(0.4, q_a, np.ones(3), state)
    error = path(0.4)[0] - q_a
    np.testing.assert_array_equal(rate, error)
    expected = [15, 5500, 18000] * error + [5, 19500, 20000] * np.array([0.1, 0.002, -0.003])
    np.testing.assert_allclose(tau, expected, rtol=1e-15)


def test_pi_starts_by_holding_the_weight(mini, path):
    pi = crane.PI(mini, path)
    q_a = path(0.0)[0] + [0.0, 1e-4, -1e-4]
    tau, _ = pi(0.0, q_a, np.zeros(3), pi.start(q_a))
    a_a = crane.Dynamics(mini).forward(q_a, np.zeros(3), tau, friction=True)
    np.testing.assert_allclose(a_a, 0, atol=1e-9)


def test_computed_torque_follows_to_rounding(mini, path):
    recording = crane.simulate(mini, crane.ComputedTorque(mini, path), duration=0.5, step=2e-3)
    # the start is on the path at rest, so only the integration's error remains
    assert np.abs(recording.q - path(recording.time)[0]).max() < 1e-8


def test_computed_torque_corrects_like_a_critically_damped_oscillator(mini, path):
    still = crane.point_to_point([0.0, 0.012, 0.010], [0.0, 0.012, 0.010], 1.0)
    offset, w = np.array([0.02, 5e-4, -5e-4]), 30.0
    recording = crane.simulate(
        mini,
        crane.ComputedTorque(mini, still, bandwidth=w),
        initial=still(0.0)[0] + offset,
        duration=0.3,
    )
    t = recording.time[:, None]
    expected = offset * (1 + w * t) * np.exp(-w * t)
    np.testing.assert_allclose(recording.q - still(0.0)[0], expected, atol=1e-8)


def test_named_controllers(mini, path):
    assert isinstance(make_controller("pi", mini, path), crane.PI)
    assert isinstance(make_controller("computed-torque", mini, path), crane.ComputedTorque)
    with pytest.raises(InputError, match=r"controller 'pid' is unknown, did you mean 'pi'\?"):
        make_controller("pid", mini, path)
    names = {"pi", "computed-torque", "valve-pd", "valve-feedforward", "tip-velocity"}
    assert set(CONTROLLERS) == names


def test_errors(mini, path):
    with pytest.raises(InputError, match="no PI gains for driven joint 'X1'"):
        crane.PI(mini, path, gains={"q1": crane.description.PIGains(1, 1)})
    form = r"gains=\{'X1': crane.description.PIGains\(kp, ki\)\}"
    with pytest.raises(InputError, match=f"machine file, or in Python {form}$"):
        crane.PI(mini, path, gains={"q1": crane.description.PIGains(1, 1)})
    good = {joint: crane.description.PIGains(1, 1) for joint in mini.active}
    for wrong in ((1.0, 2.0), {"kp": 1.0, "ki": 2.0}, 3.0, None):
        told = f"^gains of 'X1' are a {type(wrong).__name__}, give {form}$"
        with pytest.raises(InputError, match=told):
            crane.PI(mini, path, gains=good | {"X1": wrong})
    gains = r"crane.description.PIGains\(kp, ki\)"
    told = rf"^gains are a list, give them by joint: gains=\{{'JOINT': {gains}\}}$"
    with pytest.raises(InputError, match=told):
        crane.PI(mini, path, gains=[(1.0, 2.0)] * 3)
    with pytest.raises(InputError, match="the bandwidth is 0 rad/s"):
        crane.ComputedTorque(mini, path, bandwidth=0)
    with pytest.raises(InputError, match="integral has the shape"):
        crane.PI(mini, path, integral=[0, 0])


def test_a_sampled_program_gives_forces_to_a_machine_without_a_circuit():
    machine, period = crane.load("mini_forwarder"), 0.01
    weight = crane.Dynamics(machine).gravity(machine.home[machine.closure.active])
    seen = []

    def control_unit(time, q_a, v_a, pressures):
        seen.append((time, pressures.shape))
        return weight * (1.02 if time < 0.045 else 1.0)

    program = crane.control.SampledCommand(control_unit, machine, period)
    run = quiet(crane.simulate, machine, program, duration=0.1, step=period)
    assert [time for time, _ in seen] == pytest.approx(period * np.arange(10))
    assert {shape for _, shape in seen} == {(0, 2)}
    before = run.time < 0.045
    assert run.tau[before] == pytest.approx(np.tile(1.02 * weight, (before.sum(), 1)))
    with pytest.raises(InputError, match="'rk4' does not call the sampled program"):
        crane.simulate(machine, program, duration=0.1, step=period, method="rk4")
