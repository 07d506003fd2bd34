"""Problems of hydraulics, friction and stops in `benchmarks/`: crane against equations by hand."""

import drives
import exudyn_drives
import numpy as np
import pytest
import valve_crane
from hand_equations import Functions, RecordingFunctions
from warned import quiet

PROBLEMS = {problem.name: problem for problem in drives.problems()}
METHODS = [
    (name, method)
    for name, problem in PROBLEMS.items()
    for method in (
        ("rosenbrock",) if "signals" in problem.data else ("DOP853", "Radau", "rosenbrock")
    )
]


@pytest.mark.parametrize(("name", "method"), METHODS)
def test_crane_converges_to_equations_by_hand(name, method):
    problem = PROBLEMS[name]
    tolerance = 1e-10 if "signals" in problem.data else 1e-12
    error, pressure_error = problem.errors(quiet(problem.simulate, method, tolerance))
    # jumps, as of a void, are located to 1e-9 of the interval of outputs
    assert error < (2e-10 if name == "valve_and_cylinder" else 3e-11)
    assert ("signals" in problem.data) == (pressure_error < 1e-6)
    assert np.ptp(problem.reference[:, : problem.stroke_count], axis=0).min() > 0.01


@pytest.mark.parametrize(("tolerance", "error"), [(1e-8, 6e-9), (1e-12, 2e-10)])
def test_voids_are_located_at_any_tolerance(tolerance, error):
    """The compliance of a chamber jumps where a void forms and closes."""
    problem = PROBLEMS["valve_and_cylinder"]
    assert problem.errors(problem.simulate("rosenbrock", tolerance))[0] < error


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow)
        if name in ("load_sensing_pair", "two_arm_crane")
        else name
        for name in PROBLEMS
    ],
)
def test_references_are_what_the_equations_say(name):
    problem = PROBLEMS[name]
    if name == "stick_slip":
        found = problem.equations.closed_form(problem.times)[:, None]
        other = drives.solve_slips(problem.equations, problem.times, "DOP853", 1e-13)
        assert np.abs(other - found).max() < 1e-11
    else:
        found = drives.solve_exactly(problem, "DOP853", drives.REFERENCE_TOLERANCE)
    error, pressure_error = problem.errors(found)
    assert error < 1e-12
    assert not pressure_error > 1e-9


def test_kinks_are_where_functions_have_them():
    functions = RecordingFunctions()
    assert functions.root(4e4) == Functions().root(4e4) == 200.0
    assert functions.values == [3e4, 5e4]
    assert functions.root(-1e4) == -100.0 and functions.root(1.0) == pytest.approx(0.0125)
    kinks = PROBLEMS["end_stop"].equations.kinks
    assert (kinks(0.0, [0.1, 5.0]) == [0.1, -0.25]).all()


def channels(name):
    problem = PROBLEMS[name]
    machine = problem.machine
    start = [problem.data["start"][joint] for joint in machine.active]
    run = quiet(drives.crane.simulate, machine, problem.command(), start, problem.duration, 2e-3)
    return run, run.channels


def test_problems_visit_what_they_are_about():
    run, found = channels("valve_and_cylinder")
    circuit = PROBLEMS["valve_and_cylinder"].machine.hydraulics
    assert found["pressure_lift_a"].max() > circuit.cylinders["lift"].relief
    assert np.abs(found["spool_lift"] - found["voltage_lift"]).max() > 0.3  # the spool lags
    assert (found["pressure_lift_b"] <= 1e3).sum() > 10  # a void
    _, found = channels("load_sensing_pair")
    assert found["share_supply"].max() > 0.999 and found["share_supply"].min() == 0
    assert found["pressure_supply"].max() > 2.1e7  # cut off
    _, found = channels("counterbalance_lowering")
    valve = PROBLEMS["counterbalance_lowering"].machine.hydraulics.cylinders["lift"]
    valve = valve.counterbalance_a
    a, b = (found[f"pressure_lift_{side}"] for side in "ab")
    opening = (a + valve.pilot_ratio * b - valve.pressure) / valve.range
    assert opening.min() < 0 < np.median(opening) < opening.max() < 0.5  # it throttles
    run, _ = channels("stick_slip")
    starts = np.flatnonzero((run.v[1:, 0] != 0) & (run.v[:-1, 0] == 0))
    assert len(starts) >= 5
    run, _ = channels("end_stop")
    is_below = run.q[:, 0] < PROBLEMS["end_stop"].equations.lower
    assert (np.diff(is_below.astype(int)) == 1).sum() >= 4


@pytest.mark.parametrize(
    ("name", "engine", "setting", "error"),
    [
        ("counterbalance_lowering", "scipy LSODA", 1e-8, 1e-7),
        ("valve_and_cylinder", "scipy Radau", 1e-6, 1e-6),
        ("stick_slip", "scipy DOP853", 1e-8, 1e-6),
        ("end_stop", "scipy DOP853", 1e-10, 1e-8),
        ("end_stop", "crane rk4", 1e-3, 1e-3),
        ("stick_slip", "Exudyn GeneralizedAlpha", (1e-3, 1e7), 1e-5),
        ("end_stop", "Exudyn GeneralizedAlpha", (1e-4,), 1e-5),
        ("two_arm_crane", "Exudyn GeneralizedAlpha", (5e-3,), 5e-6),
    ],
)
def test_candidates_move_alike(name, engine, setting, error):
    problem = PROBLEMS[name]
    if engine.startswith("Exudyn"):
        pytest.importorskip("exudyn")
        assert setting in exudyn_drives.settings(problem.equations)
    candidate = next(one for one in drives.candidates(problem, False) if one[0] == engine)
    run = quiet(drives.measure_setting, problem, candidate, setting)
    assert not run.failure and run.error < error and 0 < run.time < np.inf


def test_a_candidate_that_gives_up_is_a_line_of_the_table():
    problem = PROBLEMS["end_stop"]

    def fails(_):
        raise RuntimeError("it stops\nhere")

    runs = [
        drives.measure_setting(problem, ("other", (1.0,), fails), 1.0),
        drives.Run("end_stop", "crane", "1e-06", 2e-3, 1e-7),
    ]
    assert runs[0].failure == "RuntimeError: it stops"
    heading, about, table = drives.tables(runs)
    assert heading == "#### A load that falls onto an end stop" and about.startswith("4 s. ")
    first, second = (row.split(" | ") for row in table.splitlines()[2:])
    assert first[-1] == "RuntimeError: it stops |" and len(first) == len(second)
    assert second[6] == "2e+03" and second[4] == "2"


@pytest.mark.slow
def test_the_crane_on_its_valves_follows_its_tolerance():
    coarse, fine = quiet(valve_crane.measure, True)
    assert fine.error < 1e-6 < coarse.error < 1e-5
    assert sum(fine.shares.values()) == pytest.approx(1.0)
    (*_, table) = valve_crane.tables([coarse, fine])
    assert len(table.splitlines()) == 4
