"""Machine code of a machine against the Pinocchio backend and the closure in numpy."""

import copy
import warnings
from pathlib import Path

import numpy as np
import oracles
import pytest
from warned import quiet

import crane
import crane.codegen.program
import crane.dynamics.pinocchio_dynamics
from crane.common.errors import (
    CraneError,
    CraneWarning,
    InputError,
    OutOfReachError,
    WrongBranchError,
)

DATA = Path(__file__).parent / "data"
# name: arguments besides q_a, and keywords
QUANTITIES = {
    "inverse": ("va", {}),
    "inverse with friction": ("va", {"friction": True}),
    "forward": ("vt", {}),
    "forward with friction": ("vt", {"friction": True}),
    "mass_matrix": ("", {}),
    "bias": ("v", {}),
    "gravity": ("", {}),
    "friction": ("v", {}),
    "passive": ("v", {}),
    "energy": ("v", {}),
    "regressor": ("va", {}),
}


def ask(dynamics, quantity, samples):
    needs, keywords = QUANTITIES[quantity]
    method = getattr(dynamics, quantity.split()[0])
    out = method(samples["q"], *(samples[name] for name in needs), **keywords)
    return np.stack(out, axis=-1) if quantity == "energy" else out


def off(found, wanted):
    """Largest difference, every entry relative to the largest that it takes in the stack."""
    assert found.shape == wanted.shape and np.isfinite(wanted).all()
    size = np.abs(wanted).max(axis=0)
    size = np.maximum(size, 1e-3 * size.max(initial=0.0))
    return float((np.abs(found - wanted) / np.where(size > 0, size, 1.0)).max())


def dressed(machine, seed=0):
    """The machine with friction, springs, dampers, constant forces and end stops drawn."""
    random = np.random.default_rng(seed)
    friction, forces, stops = {}, [], []
    for joint in machine.joints:
        column = machine.column(joint)
        model = machine.model
        limits = model.lowerPositionLimit[column], model.upperPositionLimit[column]
        always = joint == machine.joints[0]
        if random.random() < 0.6 or always:
            coulomb, viscous = random.uniform(0.1, 2.0, 2)
            friction[joint] = crane.description.Friction(
                coulomb, coulomb * random.uniform(-0.5, 0.5), viscous,
                viscous * random.uniform(-0.5, 0.5), random.uniform(0.01, 0.2),
            )  # fmt: skip
        if random.random() < 0.4 or always:
            stiffness, damping, rest, force = random.uniform(0.1, 3.0, 4)
            forces.append(
                crane.description.ForceElement(
                    joint, stiffness=stiffness, damping=damping, rest=rest, force=force
                )
            )
        if random.random() < 0.5 and np.isfinite(limits).all():
            stops.append(
                crane.description.EndStop(joint, stiffness=1e3, damping=random.uniform(0, 2))
            )
    return machine.replace(friction=friction, forces=tuple(forces), end_stops=tuple(stops))


def draw(machine, count, seed=0, share=1.0):
    """Samples about the middle of the limits, over a share of them."""
    random = np.random.default_rng(seed)
    n = len(machine.active)
    low, high = np.maximum(machine.lower, -3.0), np.minimum(machine.upper, 3.0)
    middle, half = (low + high) / 2, share * (high - low) / 2
    size = np.array([1.0 if machine.unit(joint) == "rad" else 0.1 for joint in machine.active])
    return {
        "q": middle + random.uniform(-1, 1, (count, n)) * half,
        "v": random.uniform(-2, 2, (count, n)) * size,
        "a": random.uniform(-9, 9, (count, n)) * size,
        "t": random.uniform(-50, 50, (count, n)),
    }


@pytest.fixture(scope="module")
def machines(mini, slider_crank, stewart):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        arms = {name: crane.load(name) for name in ("ur5_robot", "xarm7")}
    load = crane.Payload("link7_tip", 0.2, (0.02, -0.01, 0.03), np.diag([2e-4, 3e-4, 4e-4]))
    elements = (
        crane.description.ForceElement("q3", stiffness=2.0, rest=1.2),
        crane.description.ForceElement("q3", stiffness=0.5, rest=0.3, force=0.2),
        crane.description.ForceElement("X1", stiffness=800.0, rest=0.01, damping=30.0),
        crane.description.ForceElement("q9", damping=0.7),
    )
    return {
        "mini": (mini, 1.2),
        "loaded mini": (mini.replace(forces=elements).with_payload(load), 1.2),
        "bare mini": (mini.replace(friction={}, forces=(), end_stops=()), 1.0),
        "slider_crank": (dressed(slider_crank), 1.0),
        "stewart": (dressed(stewart, 1), 0.5),
        "ur5_robot": (dressed(arms["ur5_robot"]), 1.1),
        "xarm7": (arms["xarm7"], 1.0),
    }


@pytest.fixture(scope="module")
def fast(mini):
    return crane.Dynamics(mini)


NAMES = ["mini", "loaded mini", "bare mini", "slider_crank", "ur5_robot", "xarm7"]


@pytest.mark.parametrize(
    ("name", "quantities"),
    [
        *((name, tuple(QUANTITIES)) for name in NAMES),
        ("stewart", ("forward with friction",)),
        pytest.param("stewart", tuple(QUANTITIES), marks=pytest.mark.slow),
    ],
)
def test_every_quantity_agrees_with_pinocchio(machines, name, quantities):
    machine, share = machines[name]
    samples = draw(machine, 15, share=share)
    if name == "slider_crank":
        samples["q"] = np.random.default_rng(0).uniform(0.2, 2.8, (15, 1))
    both = crane.Dynamics(machine), crane.Dynamics(machine, backend="pinocchio")
    for quantity in quantities:
        found, wanted = (ask(dynamics, quantity, samples) for dynamics in both)
        assert off(found, wanted) < 1e-11, quantity
        first = {key: rows[0] for key, rows in samples.items()}
        for _ in range(2):  # slow the first time, then at once
            alone = ask(both[0], quantity, first)
            size = np.abs(found).max() or 1.0
            assert np.abs(alone - found[0]).max() < 1e-12 * size, quantity


@pytest.mark.parametrize("kind", oracles.LOCKED)
@pytest.mark.parametrize("count", [2, pytest.param(7, marks=(pytest.mark.slow, pytest.mark.long))])
def test_random_mechanisms_agree_with_pinocchio(count, kind, tmp_path):
    """Six kinds of loops, seven mechanisms of each: 42."""
    tested, seed = 0, 1000 * list(oracles.LOCKED).index(kind)
    while tested < count:
        seed += 1
        assert seed % 1000 < 200, "too few draws can be driven"
        try:
            machine = crane.load(oracles.random_mechanism(tmp_path, seed, kind))
            closure = machine.closure
            wide = draw(machine, 12, seed, 1.2)
            postures = closure.solve(wide["q"])
        except CraneError:
            continue
        jacobian = closure.equations.evaluate(machine.home)[1]
        block = jacobian[np.ix_(closure.structure.independent_rows, closure.passive)]
        if np.linalg.cond(block) > 50 or np.abs(closure.gamma(postures)).max() > 20:
            continue
        assert closure.residual(machine.home) < 1e-12 and np.abs(machine.home).max() < 1e-12
        assert closure.residual(postures).max() < 1e-13
        if tested % 2:
            machine = dressed(machine, seed)
        if tested % 3 == 2:
            link = f"body{machine.model.njoints - 1}"
            machine = machine.with_payload(crane.Payload(link, 1.0, (0.1, 0.2, -0.1)))
        both = crane.Dynamics(machine), crane.Dynamics(machine, backend="pinocchio")
        for quantity in ("inverse with friction", "forward with friction", "regressor"):
            found, wanted = (ask(dynamics, quantity, wide) for dynamics in both)
            assert off(found, wanted) < 1e-11, f"{quantity} of seed {seed}"
        tested += 1


def test_elements_act_in_what_is_compared(machines):
    """Otherwise the agreement of friction and passive forces says nothing."""
    for name in ("loaded mini", "slider_crank", "stewart", "ur5_robot"):
        machine, share = machines[name]
        samples = draw(machine, 40, share=share)
        if name == "slider_crank":
            samples["q"] = np.random.default_rng(0).uniform(0.2, 2.8, (40, 1))
        slow = crane.Dynamics(machine, backend="pinocchio")
        for quantity in ("friction", "passive"):
            assert np.abs(ask(slow, quantity, samples)).max() > 1e-3
    machine, share = machines["mini"]
    q_a = draw(machine, 40, share=share)["q"]
    assert machine.end_stops and (q_a > machine.upper).any() and (q_a < machine.lower).any()


# --- the body that carries all others --------------------------------------------------------


def on_a_stand(folder, kind, closed):
    """The five-bar, closed or cut open, on a stand that moves along or about an oblique axis."""
    text = (DATA / "five_bar.urdf").read_text()
    if not closed:
        text = text[: text.index("<loop")] + "</robot>"
        text = text.replace('independent="false"', 'independent="true"')
    path = folder / f"{kind}_{closed}.urdf"
    path.write_text(
        text.replace(
            '<link name="ground"/>',
            f"""<link name="floor"/>
            <joint name="stand" type="{kind}" independent="true">
              <origin xyz="0.4 -0.7 1.1" rpy="0.5 -0.9 0.3"/>
              <parent link="floor"/><child link="ground"/><axis xyz="0.48 -0.6 0.64"/>
              <limit lower="-2" upper="2" effort="99" velocity="9"/>
            </joint>
            <link name="ground"><inertial>
              <origin xyz="0.1 0.3 -0.2" rpy="0.4 0.2 0.1"/><mass value="2"/>
              <inertia ixx="0.05" ixy="0.01" ixz="0" iyy="0.06" iyz="-0.01" izz="0.07"/>
            </inertial></link>""",
        )
    )
    return crane.load(path)


def test_the_trunk_is_the_body_that_carries_all_others(machines, five_bar, tmp_path):
    def trunk(machine):
        return machine.closure.compiled_closure.geometry.reference_body

    for name in ("mini", "loaded mini", "ur5_robot", "xarm7"):
        assert trunk(machines[name][0]) == 1, name
    # several children of the world: slider and crank, two cranks, the platform and its legs
    for machine in (machines["slider_crank"][0], five_bar, machines["stewart"][0]):
        assert trunk(machine) == 0
    # one child, but a loop ends in the world
    held = crane.load(oracles.looped_arm(tmp_path, "revolute", "[0, 0, 1]"))
    assert list(held.model.parents).count(0) == 2 and trunk(held) == 0


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("closed", [True, False])
def test_an_oblique_trunk_agrees_with_pinocchio(tmp_path, kind, closed):
    machine = dressed(on_a_stand(tmp_path, kind, closed))
    assert machine.closure.compiled_closure.geometry.reference_body == 1
    samples = draw(machine, 40)
    home, stand = machine.home[machine.closure.active], machine.active.index("stand")
    moved = samples["q"][:, stand].copy()
    samples["q"] = home + np.random.default_rng(1).uniform(-0.3, 0.3, samples["q"].shape)
    samples["q"][:, stand] = moved
    both = crane.Dynamics(machine), crane.Dynamics(machine, backend="pinocchio")
    for quantity in QUANTITIES:
        found, wanted = (ask(dynamics, quantity, samples) for dynamics in both)
        assert off(found, wanted) < 1e-12, quantity


# --- closure ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "share"), [("mini", 1.0), ("slider_crank", 1.0), ("stewart", 0.6)]
)
def test_postures_equal_those_tracked_in_numpy(machines, name, share):
    machine, _ = machines[name]
    closure = machine.closure
    q_a = draw(machine, 60, 3, share)["q"]
    if name == "slider_crank":
        q_a = np.random.default_rng(1).uniform(0.15, 2.9, (60, 1))
    branch = closure.continuation
    wanted = np.array([branch.continue_to(target, branch.home).q for target in q_a])
    assert np.abs(closure.solve(q_a) - wanted).max() < 1e-12
    assert np.abs(closure.solve(q_a[::-1])[::-1] - wanted).max() < 1e-12
    order = np.argsort(q_a[:, 0])
    assert np.abs(closure.solve(q_a[order]) - wanted[order]).max() < 1e-12
    alone = np.array([closure.solve(target) for target in q_a])
    assert np.abs(alone - wanted).max() < 1e-12
    path = q_a[0] + np.linspace(0, 1, 500)[:, None] * (q_a[1] - q_a[0])
    assert np.abs(closure.solve(path)[-1] - wanted[1]).max() < 1e-12
    assert (closure.solve(q_a)[:, closure.active] == q_a).all()


@pytest.mark.slow
def test_a_folded_region_is_told_apart_from_the_branch(five_bar):
    """Five-bar far apart: same verdict as the closure in numpy, and the same posture."""
    closure = five_bar.closure
    branch = closure.continuation
    home = np.array(five_bar.home[closure.active])
    closed = 0
    for target in home + np.random.default_rng(2).uniform(-2.5, 2.5, (80, 2)):
        try:
            wanted = branch.continue_to(target, branch.home).q
        except CraneError as error:
            with pytest.raises(type(error)) as caught:
                closure.solve(target)
            # they may come from two sides
            found, wanted = (str(x).split("; the last")[0] for x in (caught.value, error))
            assert found == wanted
        else:
            assert np.abs(closure.solve(target) - wanted).max() < 1e-9
            closed += 1
    assert 15 < closed < 75


def test_errors_name_the_sample(mini, fast):
    q_a = np.tile(mini.home[mini.closure.active], (5, 1))
    q_a[3, 1] = 0.2
    zero = np.zeros((5, 3))
    for call in (
        lambda: mini.closure.solve(q_a),
        lambda: fast.inverse(q_a, zero, zero),
        lambda: fast.inverse(q_a, zero[0], zero[0]),
        lambda: fast.mass_matrix(q_a),
        lambda: crane.Dynamics(mini, backend="pinocchio").gravity(q_a),
    ):
        with pytest.raises(OutOfReachError, match=r"cannot be closed at .*X1 = 0\.2.*sample 3\)"):
            call()
    with pytest.raises(OutOfReachError) as caught:
        fast.gravity(q_a[3])
    assert "sample" not in str(caught.value)
    with pytest.raises(OutOfReachError, match=r"\(sample 3\)"):  # once more, from a warm start
        fast.inverse(q_a, zero, zero)
    assert np.isfinite(fast.gravity(q_a[:3])).all()


def test_guesses_of_other_branches_are_refused(slider_crank):
    theta, closure = 1.0, slider_crank.closure
    psi = np.pi - np.arcsin((0.3 - 0.2 * np.sin(theta)) / 0.3)
    guess = np.zeros(3)
    columns = [slider_crank.column(name) for name in ("s", "theta", "phi")]
    guess[columns] = 0.2 * np.cos(theta) + 0.3 * np.cos(psi), theta, psi - theta
    for nudge in (0.0, 1e-9, 1e-7):
        with pytest.raises(WrongBranchError):
            closure.solve([theta], initial_guess=guess + nudge)
    near = closure.solve([1.1])
    assert (
        np.abs(closure.solve([theta], initial_guess=near) - closure.solve([theta])).max() < 1e-12
    )


def test_guesses_with_opposed_axes_are_refused(tmp_path):
    """They close the equations too, with determinants of the same sign."""
    machine = crane.load(oracles.random_mechanism(tmp_path, 3, "fixed"))
    closure, random = machine.closure, np.random.default_rng(3)
    found = 0
    while found < 5:
        guess = random.uniform(-3, 3, machine.model.nq)
        for _ in range(100):
            phi, jacobian = closure.equations.evaluate(guess)
            step = np.linalg.lstsq(jacobian, -phi, rcond=1e-8)[0]
            guess = guess + step * min(1.0, 0.3 / np.abs(step).max(initial=1e-300))
        if closure.residual(guess) < 1e-12 and closure.equations.find_opposed_loop(guess):
            found += 1
            with pytest.raises(WrongBranchError, match="loop 'clasp' is assembled the other way"):
                closure.solve(guess[closure.active], initial_guess=guess)
    assert np.abs(closure.solve(machine.home[closure.active]) - machine.home).max() < 1e-12


# --- arguments -------------------------------------------------------------------------------


def test_nothing_but_finite_numbers_passes(machines, fast, mini):
    rest = np.array(mini.home[mini.closure.active])
    zero = np.zeros(3)
    fast.inverse(rest, zero, zero), fast.forward(rest, zero, zero), fast.gravity(rest)
    for bad in (np.nan, np.inf, -np.inf):
        for at in range(3):
            for position in range(3):
                arguments = [rest.copy(), zero.copy(), zero.copy()]
                arguments[position][at] = bad
                for method in (fast.inverse, fast.forward):
                    with pytest.raises(InputError, match="give finite numbers"):
                        method(*arguments)
            broken = np.tile(rest, (4, 1))
            broken[2, at] = bad
            with pytest.raises(InputError, match="of sample 2"):
                fast.gravity(broken)
    assert np.isfinite(fast.inverse(rest, zero, zero)).all()


def test_nothing_but_finite_numbers_passes_an_open_chain(machines):
    arm, _ = machines["ur5_robot"]
    dynamics, zero = crane.Dynamics(arm), np.zeros(6)
    for _ in range(2):  # the second call is the quick one
        for at in range(6):
            q_a = zero.copy()
            q_a[at] = np.nan
            with pytest.raises(InputError, match="q_a is nan"):
                dynamics.gravity(q_a)
            with pytest.raises(InputError, match="q_a is nan"):
                arm.closure.solve(q_a)
        assert np.isfinite(dynamics.gravity(zero)).all()


def test_words_are_refused_every_time(fast, mini):
    fast.gravity(np.array(mini.home[mini.closure.active]))
    for bad in (np.array(["a", "b", "c"]), ["a", "b", "c"], "abc"):
        for _ in range(2):
            with pytest.raises(InputError, match="is not made of real numbers"):
                fast.gravity(bad)


def test_any_array_of_numbers_serves(fast):
    samples = draw(fast.machine, 30, 5)
    q_a, v_a, a_a = (samples[key] for key in "qva")
    wanted = fast.inverse(q_a, v_a, a_a)
    size = np.abs(wanted).max()

    def same(found, expected=wanted):
        assert found.shape == expected.shape and np.abs(found - expected).max() < 1e-12 * size

    wide = np.full((60, 7), np.nan)
    wide[::2, 1::2] = q_a
    same(fast.inverse(wide[::2, 1::2], np.asfortranarray(v_a), a_a[:, ::-1][:, ::-1]))
    same(fast.inverse(q_a.tolist(), v_a.tolist(), tuple(map(tuple, a_a))))
    same(fast.inverse(q_a[::-1], v_a[::-1], a_a[::-1])[::-1])
    for i in (0, 7):
        same(fast.inverse(wide[2 * i, 1::2], list(v_a[i]), tuple(a_a[i])), wanted[i])
        same(fast.inverse(q_a[i], v_a[i], np.asfortranarray(a_a)[i]), wanted[i])
        column = np.ascontiguousarray(q_a.T)[:, i]
        assert not column.flags.c_contiguous
        same(fast.inverse(column, v_a[i], a_a[i]), wanted[i])
    single = q_a.astype(np.float32)
    same(fast.gravity(single), fast.gravity(single.astype(np.float64)))
    same(fast.gravity(single[4]), fast.gravity(single.astype(np.float64)[4]))
    big_endian = q_a.astype(">f8")
    same(fast.gravity(big_endian[3]), fast.gravity(q_a[3]))
    same(fast.gravity(big_endian), fast.gravity(q_a))
    ones = np.array([0, 0, 0])
    for zeros in (ones, [0, 0, 0], ones.astype(np.int8), ones.astype(bool)):
        same(fast.gravity(zeros), fast.gravity(np.zeros(3)))
        same(fast.inverse(q_a, zeros, zeros), fast.inverse(q_a, np.zeros(3), np.zeros((30, 3))))


def test_single_samples_hold_for_every_row(fast):
    samples = draw(fast.machine, 6, 6)
    q_a, v_a, a_a = (samples[key] for key in "qva")
    for mask in range(1, 8):
        mixed = [x if mask >> i & 1 else x[2] for i, x in enumerate((q_a, v_a, a_a))]
        full = [np.broadcast_to(x, (6, 3)) for x in mixed]
        for method in (fast.inverse, fast.forward, fast.regressor):
            rows = np.array([method(*(x[i] for x in full)) for i in range(6)])
            found = method(*mixed)
            assert found.shape == rows.shape
            assert np.abs(found - rows).max() < 1e-12 * np.abs(rows).max()
    one = fast.inverse(q_a[:1], v_a[0], a_a[0])
    assert one.shape == (1, 3) and fast.mass_matrix(q_a[:1]).shape == (1, 3, 3)
    with pytest.raises(InputError, match="stacks of"):
        fast.inverse(q_a, v_a[:2], a_a)
    with pytest.raises(InputError, match="empty"):
        fast.gravity(np.zeros((0, 3)))


def test_results_and_arguments_belong_to_the_caller(fast):
    samples = draw(fast.machine, 4, 7)
    for quantity in QUANTITIES:
        for rows in (samples, {key: x[1] for key, x in samples.items()}):
            kept = copy.deepcopy(rows)
            first = ask(fast, quantity, rows)
            saved = first.copy()
            first[...] = np.nan
            second = ask(fast, quantity, rows)
            assert not np.shares_memory(first, second)
            np.testing.assert_allclose(second, saved, rtol=1e-12, atol=1e-13)
            third = ask(fast, quantity, {key: x * 0.9 for key, x in rows.items()})
            assert not np.shares_memory(second, third)
            np.testing.assert_allclose(second, saved, rtol=1e-12, atol=1e-13)
            for key, x in kept.items():
                np.testing.assert_array_equal(rows[key], x)
    closure = fast.machine.closure
    q = closure.solve(samples["q"][0])
    again = closure.solve(samples["q"][0])
    q[:] = np.nan
    assert np.isfinite(again).all() and np.isfinite(closure.solve(samples["q"][0])).all()


def test_answers_do_not_depend_on_history(mini, machines):
    samples = draw(mini, 25, 8)
    other = draw(mini, 25, 9)
    fresh = {q: ask(crane.Dynamics(mini), q, samples) for q in ("forward", "regressor", "energy")}
    used = crane.Dynamics(mini)
    random = np.random.default_rng(0)
    for quantity, wanted in fresh.items():
        size = np.abs(wanted).max()
        for _ in range(3):
            i, j = random.integers(25, size=2)
            ask(used, "gravity", {key: x[i] for key, x in other.items()})
            mini.closure.solve(other["q"][j])
            with pytest.raises(CraneError):
                used.gravity(np.array([0.0, 0.3, 0.0]))
            with pytest.raises(InputError):
                used.gravity(np.array([0.0, np.nan, 0.0]))
            found = ask(used, quantity, {key: x[i] for key, x in samples.items()})
            assert np.abs(found - wanted[i]).max() < 1e-12 * size
            order = random.permutation(25)
            found = ask(used, quantity, {key: x[order] for key, x in samples.items()})
            assert np.abs(found - wanted[order]).max() < 1e-12 * size


def test_long_formulas_are_left_to_pinocchio(mini, monkeypatch):
    samples = draw(mini, 5, 10)
    again = quiet(crane.load, "mini_forwarder")  # with nothing compiled yet
    quick = crane.Dynamics(mini)
    wanted = {quantity: ask(quick, quantity, samples) for quantity in QUANTITIES}
    monkeypatch.setattr(crane.codegen.program, "MAX_OPERATIONS", 10)
    monkeypatch.setattr(crane.closure.compiled_closure, "_SHARED_CODE", {})
    asked = []
    at = crane.dynamics.pinocchio_dynamics.PinocchioDynamics.evaluate

    def spy(self, quantity, *rest):
        asked.append(quantity)
        return at(self, quantity, *rest)

    monkeypatch.setattr(crane.dynamics.pinocchio_dynamics.PinocchioDynamics, "evaluate", spy)
    long = crane.Dynamics(again)
    for quantity in QUANTITIES:
        asked.clear()
        assert off(ask(long, quantity, samples), wanted[quantity]) < 1e-11
        assert len(asked) == 5
        alone = ask(long, quantity, {key: x[1] for key, x in samples.items()})
        size = np.abs(wanted[quantity]).max()
        assert np.abs(alone - wanted[quantity][1]).max() <= 1e-11 * size
        asked.clear()
        ask(quick, quantity, samples)  # what is compiled stays so
        assert not asked


def test_paths_are_what_they_say(mini, fast):
    assert (
        fast.backend == "compiled"
        and crane.Dynamics(mini, backend="pinocchio").backend == "pinocchio"
    )
    with pytest.raises(InputError, match="backend 'fast' is unknown"):
        crane.Dynamics(mini, backend="fast")
