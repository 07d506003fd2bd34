"""The pages of the referee: ratios, losses, faults, and what is written by hand around them."""

import inspect

import pages
import pytest
from parts import PARTS
from pictures import family, frontier
from trajectories import Point

HAND_WRITTEN = "# Title\n\n{begin}\n\nold\n\n{end}\n\n## What crane loses\n\nA lot.\n"


def point(engine, error, time, problem="bricard"):
    return {"problem": problem, "engine": engine, "error": error, "time": time}


@pytest.fixture
def results():
    """crane 10 times faster to 1e-6 m than Pinocchio; Exudyn twice as fast to 1e-3 m."""
    rows = [
        point("crane DOP853", 1e-7, 2e-3), point("crane rk4", 1e-5, 1e-3),
        point("pin.lcaba", 1e-6, 2e-2), point("Exudyn GeneralizedAlpha", 1e-3, 5e-4),
        {"problem": "bricard", "engine": "Drake SAP", "failure": "unstable"},
        point("MuJoCo RK4", 1e-4, 3e-3, "slider_crank"),
    ]  # fmt: skip
    times = {"crane, one call": 1e-6, "pin.lcaba": 4e-6, "mj_forward": 1e-7}
    calls = [
        {"machine": f"chain {n}", "joints": n, "times": {k: n * t for k, t in times.items()},
         "settings": {"crane difference": 1e-13}}
        for n in (10, 19)
    ]  # fmt: skip
    return {
        "trajectories": {"conditions": "Here.", "rows": rows, "tables": ["#### Deep", "| a |"]},
        "forward_dynamics": {"conditions": "Here.", "rows": calls, "tables": []},
    }


def test_the_summary_has_the_best_of_each_and_losses_in_bold(results):
    lines = pages.trajectory_summary(pages.points(results, *pages.RACES)).splitlines()
    assert lines[2].split(" | ")[1:] == [
        "1", "Exudyn GeneralizedAlpha 0.5", "**0.5**", "2", "pin.lcaba 20", "10 |",
    ]  # fmt: skip
    assert lines[3].count("not reached") == 3  # crane never, nobody to 1e-6 m
    summary = pages.families_summary(results["forward_dynamics"]["rows"])
    assert "| Chain | 10 to 19 | 10 to 19 | 40 to 76 | 4 to 4 |" in summary


def test_pages_keep_what_is_written_by_hand(results, tmp_path):
    page = tmp_path / "performance.md"
    page.write_text(HAND_WRITTEN.format(begin=pages.BEGIN, end=pages.END))
    pages.write_pages(page, results)
    text = page.read_text()
    assert (
        text.startswith(f"# Title\n\n{pages.BEGIN}\n\n![") and "\n\nHere.\n\n| problem |" in text
    )
    assert text.endswith(f"{pages.END}\n\n## What crane loses\n\nA lot.\n") and "old" not in text
    tables = (tmp_path / "performance-tables.md").read_text()
    assert tables.count("Here.") == 1 and "\n### Deep\n" in tables
    names = {path.name for path in (tmp_path / "images").glob("*.png")}
    assert names == {
        "times_trajectories.png", "work_precision_trajectories.png", "forward_dynamics.png",
    }  # fmt: skip
    assert all(f"](images/{name})" in text for name in names)


def test_faults_are_crane_failing_or_disagreeing(results):
    assert pages.faults(results) == ["crane does not reach 1e-06 m on slider_crank"]
    results["forward_dynamics"]["rows"][0]["settings"]["crane difference"] = 1e-6
    results["forward_dynamics"]["rows"][1] = {"machine": "ring 7", "failure": "no"}
    assert pages.faults(results)[1:] == [
        "accelerations of chain 10 differ by 1e-06", "no forward dynamics of ring 7: no",
    ]  # fmt: skip


def test_a_frontier_has_what_nothing_beats():
    points = [Point("p", "e", error=e, time=t) for e, t in ((1, 1), (2, 2), (0.1, 3), (0.1, 4))]
    assert frontier(points) == [points[0], points[2]]
    assert [family(name) for name in ("pin.lcaba", "crane rk4")] == ["Pinocchio", "crane"]


@pytest.mark.parametrize("name", PARTS)
def test_parts_measure_and_tabulate(name):
    module = PARTS[name].module
    assert next(iter(inspect.signature(module.measure).parameters)) == "quick"
    assert len(inspect.signature(module.tables).parameters) == 1
