"""The referee of `benchmarks/`: reference solutions, engines, and what it makes of them."""

from dataclasses import replace

import forward_dynamics
import inverse_dynamics
import numpy as np
import pinocchio as pin
import pytest
from dense_equations import exact_forward
from engines import ENGINES
from engines.crane_engine import Crane, CraneSimulator
from engines.drake_engine import Drake
from engines.exudyn_engine import Exudyn
from engines.exudyn_tree_engine import ExudynTree
from engines.mujoco_engine import MuJoCo
from engines.mujoco_warp_engine import MuJoCoWarp
from engines.newton_engine import Newton
from engines.pinocchio_admm_engine import AdmmForward
from engines.pinocchio_engine import Pinocchio, largest_difference, sample_states
from multibody import Multibody
from problem import FOLDER, Problem, load_machine, machine_file, missing_problems, problems
from reference import crane_positions, independent_positions
from trajectories import Point, failures, measure_setting, time_at_error
from warned import quiet

import crane

PROBLEMS = {problem.name: problem for problem in problems()}


@pytest.mark.parametrize("name", PROBLEMS)
def test_problems_start_closed_and_have_a_reference(name):
    problem = PROBLEMS[name]
    system = quiet(lambda: problem.system)
    assert system.loops and system.loop_error(system.start) < 1e-12
    assert problem.reference.shape == (10, len(system.bodies), 3)
    assert all(abs(problem.times[1] / step % 1 - 0.5) > 0.499999 for step in problem.steps)


def test_the_squeezer_ends_where_the_test_set_for_ivp_solvers_says():
    problem = PROBLEMS["andrews_squeezer"]
    system = problem.system
    q = np.array([problem.published[body.name] for body in system.bodies])
    ends = system.state(q, np.zeros(len(q))).position
    np.testing.assert_allclose(problem.reference[-1], ends, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("bricard", 1e-11),
        ("delta_robot", 1e-12),
        ("grbda_leg", 1e-12),
        *(pytest.param(name, error, marks=pytest.mark.slow)
          for name, error in (("mini_forwarder", 1e-11), ("andrews_squeezer", 1e-13),
                              ("flyball_governor", 1e-11), ("stewart_platform", 1e-12),
                              ("cassie_leg", 1e-12), ("grbda_chains", 1e-11),
                              ("grbda_tree", 1e-11),
                              # rounding, which processors do differently, grows at change points
                              ("slider_crank", 1e-9), ("n_four_bar_2", 5e-8),
                              ("n_four_bar_40", 2e-6))),
    ],
)  # fmt: skip
def test_references_by_two_ways(name, error):
    """Dense equations with multipliers, or a closed form, against crane."""
    if name not in PROBLEMS:
        pytest.skip("its machine is not part of the project: ../shared/data/third_party")
    problem = PROBLEMS[name]
    # of rounding that grows, one run may have ten times another: the middle one of three
    tolerances = (1e-13, 3e-13, 1e-12) if name.startswith("n_four_bar") else (1e-13,)
    errors = [problem.error(quiet(crane_positions, problem, x)) for x in tolerances]
    assert np.median(errors) < error
    if name in ("mini_forwarder", "slider_crank", "grbda_leg"):
        assert problem.error(independent_positions(problem)[0]) < 1e-11


@pytest.mark.parametrize(
    ("engine", "setting", "error"),
    [
        (Crane("DOP853"), 1e-10, 1e-10),
        (Crane("rk4"), 1e-3, 1e-8),
        (Pinocchio("lcaba"), (5e-3, 0.0), 1e-5),
        (Pinocchio("constraintDynamics"), (1e-3, 0.0), 1e-4),
        (MuJoCo("RK4"), (1e-3, 0.45, 0.9999), 1e-5),
        (Exudyn("GeneralizedAlpha"), (5e-3, 1e-8, "EigenSparse"), 2e-4),
        (Exudyn("TrapezoidalIndex2"), (5e-3, 1e-8, "EigenSparse"), 2e-4),
        (ExudynTree("GeneralizedAlpha"), (5e-3, 1e-8, "EigenSparse"), 2e-4),
        (Drake(), 5e-3, 2e-3),
        *(
            pytest.param(*case, marks=pytest.mark.long)  # a minute of compilation each
            for case in (
                (MuJoCoWarp(), (1e-2, 0.45, 0.9999), 2e-3),
                (Newton("Kamino"), (1e-2, 0.01), 2e-2),
            )
        ),
        pytest.param(Crane("DOP853", "pinocchio"), 1e-6, 2e-6, marks=pytest.mark.slow),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_engines_move_the_mini_forwarder_alike(engine, setting, error):
    if not engine.version():
        pytest.skip(f"{engine.package} is not installed")
    point = measure_setting(PROBLEMS["mini_forwarder"], engine, setting)
    assert not point.failure and point.error < error and point.loop_error < 10 * error
    assert 0 < point.time < np.inf


def test_admm_finds_the_accelerations_of_an_overconstrained_loop():
    system = PROBLEMS["bricard"].system
    samples, exact = sample_states(system, 3), exact_forward(system)
    expected = [exact(*sample) for sample in samples]
    assert largest_difference(AdmmForward(system, 2), samples, expected) < 1e-6


def test_failures_are_told_in_a_line():
    points = [Point("p", "e", setting=str(k), failure="unstable" * (k > 1)) for k in range(4)]
    points.append(Point("p", "e", failure="other"))
    assert failures(points) == ["e: 3 of 5 settings fail, most: unstable"]


def test_energy_has_the_springs_along_joints():
    problem = PROBLEMS["delta_robot"]
    system = problem.system
    simulator = CraneSimulator(problem, "DOP853", 1e-12)
    states = simulator.states(quiet(simulator.run))
    joint = [body.name for body in system.bodies].index("motor1")
    angles = [system.joint_coordinate(state, joint) for state in states]
    assert problem.is_conservative and np.ptp(angles) > 0.2
    energies = [system.energy(state) for state in states]
    np.testing.assert_allclose(energies, system.energy(system.start), rtol=0, atol=1e-9)


def test_planar_bodies_that_cannot_be_move_as_ones_that_can():
    machine = quiet(load_machine, "n_four_bar_2.urdf")
    system = Multibody.from_machine(machine, {})
    flat = machine.model.copy()
    for i, body in enumerate(system.bodies):
        moment = np.diag(body.axis * (body.axis @ body.inertia @ body.axis))
        flat.inertias[i + 1] = pin.Inertia(body.mass, body.com, np.abs(moment))
    assert np.linalg.eigvalsh(flat.inertias[1].inertia)[1] == 0
    bodies = replace(system, model=flat).bodies
    for body, original in zip(bodies, system.bodies, strict=True):
        moments = np.linalg.eigvalsh(body.inertia)
        assert moments[0] > 0 and moments[2] <= moments[0] + moments[1]
        assert body.axis @ (body.inertia - original.inertia) @ body.axis == pytest.approx(
            0, abs=1e-9
        )


@pytest.mark.parametrize(
    "name",
    ["mini_forwarder/mini_forwarder.yaml", "spatial ring 6",
     "third_party/grbda/robot-models_mini_cheetah.urdf",
     pytest.param("third_party/grbda/variable_four_bar_urdf_four_bar_branch_2_5.urdf",
                  marks=pytest.mark.slow)],
)  # fmt: skip
@pytest.mark.parametrize("part", [forward_dynamics, inverse_dynamics])
def test_engines_agree_on_accelerations_and_forces(name, part):
    if name.startswith("third_party/") and not machine_file(name).exists():
        pytest.skip("no ../shared/data/third_party")
    machine = quiet(load_machine, name)
    start = forward_dynamics.THIRD_PARTY_START if name.startswith("third_party/") else 0.0
    system = Multibody.from_machine(machine, {}, start)
    calls, _, told = quiet(part.candidates, system, crane.Dynamics(machine))
    differences = {key: value for key, value in told.items() if key.endswith("difference")}
    assert len(differences) >= 2 and max(differences.values()) < 1e-8
    assert any(call.startswith("pin.") for call in calls)


def test_forces_are_not_projected_with_too_few_rows():
    system = Multibody.from_machine(quiet(load_machine, "ring 7"), {})
    with pytest.raises(ValueError, match="too few independent rows"):
        inverse_dynamics.Projection(system, np.ones((3, 7)))


def test_an_unstable_run_is_a_failure_in_one_line():
    point = measure_setting(PROBLEMS["bricard"], MuJoCo("Euler"), (0.05, 0.1, 0.9999))
    assert point.failure and "\n" not in point.failure and point.error == np.inf


def test_time_at_an_error_is_that_of_the_frontier():
    points = [Point("p", "e", error=e, time=t) for e, t in ((1e-2, 1), (1e-1, 3), (1e-4, 10))]
    points.append(Point("p", "e", failure="unstable"))
    assert time_at_error(points, 1.0) == 1 and time_at_error(points, 1e-5) is None
    assert time_at_error(points, 1e-3) == pytest.approx(10**0.5)


def test_names_of_engines_and_problems_are_unique():
    assert len({engine.name for engine in ENGINES}) == len(ENGINES)
    assert len(PROBLEMS) + len(missing_problems()) == len(list(FOLDER.glob("*.yaml")))
    assert all(isinstance(problem, Problem) and problem.source for problem in PROBLEMS.values())
