"""Output of lifting capacity: pressures, table, figures, page and command."""

import csv
import json
import math
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import typed
from free_bodies import balance
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.path import Path

import crane
from crane.ratings.capacity_report import load_table, slew_labels
from crane.view.page.capacity_page import capacity_page_data, write_capacity_page
from crane.view.plots.capacity_sheet import capacity_sheet_figure
from crane.view.plots.rating_figures import _draw_contours, capacity_figure, load_contours
from crane.view.sketches.mechanism_projection import machine_outline

G = np.array([0.0, 0.0, -9.81])
TANK = 3.0e5


@pytest.fixture(scope="module")
def chart(excavator):
    return crane.capacity(excavator, "bucket", rule="iso10567")


def some(chart, count, seed=0):
    reached = np.argwhere(np.isfinite(chart.loads))
    return reached[np.random.default_rng(seed).choice(len(reached), count, replace=False)]


def test_pressures_are_those_of_free_bodies(excavator, chart):
    """The force of each cylinder from balances of all links, the other chamber at the tank's."""
    pressures = chart.pressures()
    assert set(pressures) == {"slew", "X_boom", "X_arm", "X_bucket"}
    for s, b, a in some(chart, 25):
        q = excavator.closure.solve(chart.q_a[s, b, a])
        forces, _ = balance(excavator, q, G, chart.loads[s, b, a], "bucket")
        for joint, cylinder in excavator.hydraulics.cylinders.items():
            push = (forces[joint] + TANK * cylinder.area_b) / cylinder.area_a
            pull = (TANK * cylinder.area_a - forces[joint]) / cylinder.area_b
            by_hand = [max(push, TANK), max(pull, TANK)]
            assert pressures[joint][s, b, a] == pytest.approx(by_hand, rel=1e-8, abs=10.0)


@pytest.mark.parametrize("given", [{}, {"friction": True}, {"slope": 0.1}])
def test_what_ends_a_load_is_at_its_pressure(excavator, given):
    """Without reserve, one chamber of the cylinder that ends a load has its limit."""
    chart = crane.capacity(excavator, "bucket", raising=["X_boom"], slews=[0.4], step=1.0, **given)
    pressures, seen = chart.pressures(), set()
    for k in chart.active_factors:
        cause = chart.limiting_factors[k]
        if cause.reason == "tips":
            continue
        here = (chart.limiting_factor_index == k) & (chart.loads > 0)
        limit = 3.5e7 if cause.element == "X_boom" else 3.7e7
        highest = pressures[cause.element][here].max(axis=-1)
        assert highest == pytest.approx(np.full(here.sum(), limit), rel=1e-9)
        seen.add(cause.element)
    assert {"X_boom", "X_arm"} <= seen


def test_the_table_has_the_cells_of_the_chart(chart):
    table = load_table(chart)
    assert len(table.radii) >= 5 and len(table.heights) >= 8 and table.can_tip
    assert np.diff(table.radii) == pytest.approx(1.5) and np.diff(table.heights) == pytest.approx(
        -1.5
    )
    rows, starred = table.format_rows(), 0
    for height, row in zip(table.heights, rows, strict=True):
        b = int(np.flatnonzero(chart.heights == height)[0])
        cells = [
            (chart.loads[s, b, a], chart.limiting_factor_index[s, b, a])
            for a in np.flatnonzero(np.isin(chart.radii, table.radii))
            for s in range(2)
        ]
        for text, (load, k) in zip(row, cells, strict=False):
            star = "*" if k >= 0 and chart.limiting_factors[k].reason != "tips" else ""
            assert text == ("" if math.isnan(load) else f"{math.floor(load)}{star}")
            starred += bool(star)
    assert 10 < starred < 60
    for height, row, far in zip(table.heights, rows, table.max_radii, strict=True):
        there = chart.at_positions([far, far + 0.02], [height])
        assert np.isfinite(there.loads[:, 0, 0]).all() and np.isnan(there.loads[:, 0, 1]).all()
        assert [int(x.rstrip("*")) for x in row[-3:-1]] == np.floor(there.loads[:, 0, 0]).tolist()
        assert float(row[-1]) == pytest.approx(far, abs=0.005)
    text = chart.to_markdown()
    assert all(f" {cell} |" in text for row in rows for cell in row if cell)
    assert chart.rule.description in text and "X_boom 350 bar (working pressure)" in text


def test_the_largest_radius_lies_beyond_the_last_column(excavator):
    chart = crane.capacity(excavator, radii=[7.0, 9.0], heights=[0.0], slews=[0.0])
    (far,) = load_table(chart).max_radii
    there = chart.at_positions([far, far + 2.0 / 25], [0.0])
    assert far > 9.0 and np.isfinite(there.loads[0, 0]).tolist() == [True, False]


def test_where_nothing_tips_nothing_is_marked():
    table = load_table(crane.capacity(crane.load("mini_forwarder"), step=0.02))
    assert not table.can_tip and table.limited_by_drives.any()
    words = [cell for row in table.format_rows() for cell in row if cell]
    assert not any("*" in word for word in words)
    assert max(float(word) for word in words) < 3 and "0.75" in words


def test_slew_angles_are_named(excavator):
    at = {"frame": "bucket", "radii": [6.0], "heights": [1.0]}
    turned = crane.capacity(excavator, slews=np.deg2rad([0, 30, 90, 180, -90]), **at)
    assert slew_labels(turned) == ["front", "30°", "90°", "rear", "-90°"]
    assert slew_labels(crane.capacity(excavator, slews=[0.0], **at)) == [""]


def test_outlines_put_the_frame_where_the_load_hangs(excavator, chart):
    """At every slew angle; feet are as far apart as the tracks are long, or wide."""
    for s, b, a in some(chart, 20):
        q = excavator.closure.solve(chart.q_a[s, b, a])
        seen = machine_outline(excavator, "bucket", chart.section, q)
        corners = np.concatenate(seen.bodies)
        place = [chart.radii[a], chart.heights[b]]
        assert np.linalg.norm(corners - place, axis=1).min() < 1e-9
        assert np.ptp(seen.stationary_hull[:, 0]) == pytest.approx([3.65, 2.38][s], abs=1e-9)
        for start, mouth, end in seen.cylinders:
            along, out = mouth - start, end - start
            assert abs(along[0] * out[1] - along[1] * out[0]) < 1e-9


def test_pictures_name_all_causes(chart):
    figure = capacity_figure(chart)
    (legend,) = figure.legends
    named = {text.get_text() for text in legend.get_texts()}
    assert named == {str(chart.limiting_factors[k]) for k in chart.active_factors}
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["front", "side"]
    sheet = capacity_sheet_figure(chart)
    sheet.draw_without_rendering()
    tables = [table for axes in sheet.axes for table in axes.tables]
    texts = [*sheet.texts, *(x.get_text() for table in tables for x in table.get_celld().values())]
    words = {text.get_text() for text in texts}
    assert {cell for row in load_table(chart).format_rows() for cell in row if cell} <= words
    page = sheet.bbox
    for text in texts:  # nothing runs off the page
        box = text.get_window_extent()
        assert page.x0 <= box.x0 and box.x1 <= page.x1 and page.y0 <= box.y0 and box.y1 <= page.y1


def test_contours_run_to_the_edge(chart):
    """Their ends are in cells at the border of those that have loads; and none leaves these."""
    loads, half = np.isfinite(chart.loads[0]), np.diff(chart.radii)[0] / 2
    b, a = np.nonzero(loads)
    reached = np.column_stack([chart.radii[a], chart.heights[b]])
    b, a = np.nonzero(np.logical_not(loads))
    open_ = np.column_stack([chart.radii[a], chart.heights[b]])
    ends = 0
    for _, lines in load_contours(chart, 0):
        for line in lines:
            away = np.abs(line[:, None] - reached).max(axis=2).min(axis=1)
            assert away.max() <= half + 1e-9
            if np.linalg.norm(line[0] - line[-1]) > 1e-9:
                gaps = np.abs(line[[0, -1], None] - open_).max(axis=2).min(axis=1)
                assert gaps.max() < 1.8 * half  # 1 at the edge, 2 at the outermost places
                ends += 2
    assert ends > 8


def test_the_heading_is_above_those_of_the_panels(chart):
    figure = capacity_figure(chart)
    FigureCanvasAgg(figure).draw()
    heading = figure._suptitle.get_window_extent()
    for axes in figure.axes:
        assert axes._left_title.get_window_extent().y1 < heading.y0


def turned(text):
    """The corners of a text's box as it is drawn, a path [pixels]."""
    angle, middle = (
        np.deg2rad(text.get_rotation()),
        text.get_transform().transform(text.get_position()),
    )
    text.set_rotation(0)
    box = text.get_window_extent()
    text.set_rotation(np.rad2deg(angle))
    x, y = box.width / 2, box.height / 2
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return Path(middle + np.array([[-x, -y], [x, -y], [x, y], [-x, y], [-x, -y]]) @ turn.T)


@pytest.mark.parametrize("turns", [0.25, 0.5, 1.0])
def test_labels_of_contours_are_not_upon_one_another(turns):
    """Contours that meet in a point, as they do beside a column, and run apart further out."""
    x, y = np.linspace(-3, 3, 61), np.linspace(-3, 3, 61)
    far = np.hypot(*np.meshgrid(x, y))
    share = np.arctan2(*np.meshgrid(y, x, indexing="ij")) / (np.pi * turns)
    loads = np.where((share > 0) & (share < 1) & (far < 2.2), 100 * 25**share, np.nan)
    figure = Figure(figsize=(4, 4), layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(-3, 3), ylim=(-3, 3), aspect="equal")
    chart = SimpleNamespace(radii=x, heights=y, loads=loads[None])
    _draw_contours(axes, chart, 0)
    FigureCanvasAgg(figure).draw()
    boxes = [turned(text) for text in axes.texts]
    assert len(boxes) >= 2
    for i, one in enumerate(boxes):
        assert not any(one.intersects_path(other, filled=True) for other in boxes[:i])


@pytest.mark.slow
def test_the_page_holds_the_chart(chart, tmp_path):
    text = write_capacity_page(chart, tmp_path / "capacity.html").read_text(encoding="utf-8")
    (inside,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    data = json.loads(inside)
    assert "http" not in text.replace("http://www.w3.org/2000/svg", "").replace("http-equiv", "")
    assert data == json.loads(json.dumps(capacity_page_data(chart)))
    pressures = chart.pressures()
    for s in range(2):
        cells = {(cell[0], cell[1]): cell for cell in data["cells"][s]}
        assert len(cells) == np.isfinite(chart.loads[s]).sum()
        for b, a in np.argwhere(np.isfinite(chart.loads[s]))[::7]:
            cell = cells[chart.radii[a], chart.heights[b]]
            assert cell[2] == pytest.approx(chart.loads[s, b, a], rel=1e-6)
            assert cell[3] == chart.limiting_factor_index[s, b, a]
            each = [math.inf if x is None else x for x in cell[4]]
            assert each == pytest.approx(chart.values_by_factor[s, b, a].tolist(), rel=1e-6)
            assert cell[5][1] == pytest.approx(1e3 * chart.q_a[s, b, a, 1], abs=0.05 + 1e-9)
            assert all(x == round(x, 1) for x in cell[5])  # no rounding noise at limits
            assert cell[6][1][0] == pytest.approx(1e-5 * pressures["X_boom"][s, b, a, 0], rel=1e-4)
            bodies = data["shapes"][cell[7]][0]
            corners = data["unit"] * np.concatenate(bodies).reshape(-1, 2)
            assert np.linalg.norm(corners - cell[:2], axis=1).min() < data["unit"]


def test_the_command_writes_tables_pictures_and_page(tmp_path):
    words = "capacity excavator --frame bucket --rule iso10567 --tipping 0.5 --slew 0,30 --step 1"
    words = [*words.split(), "--set", "arm.mass=900", "--out", "chart"]
    done = typed(*words, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    out = done.stdout
    assert "50 % of the tipping load" in out and "written to chart" in out
    files = {path.name for path in (tmp_path / "chart").iterdir()}
    assert files == {"capacity.md", "capacity.csv", "capacity.png", "sheet.pdf", "capacity.html"}
    lines = (tmp_path / "chart" / "capacity.csv").read_text(encoding="utf-8").splitlines()
    rows = list(csv.DictReader(line for line in lines if line[0] != "#"))
    # a level load slews nothing
    level = [row for row in rows if row["load_holding_pressure_slew [kg]"] == ""]
    assert len(rows) > 50 and len(level) == len(rows)
    assert all(float(row["load [kg]"]) >= 0 for row in rows)
    assert (tmp_path / "chart" / "sheet.pdf").read_bytes()[:5] == b"%PDF-"
    assert (tmp_path / "chart" / "capacity.md").read_text(encoding="utf-8") in out
    assert typed(*words, cwd=tmp_path).returncode == 2  # not over what is there


@pytest.mark.slow
def test_a_rule_of_what_tips_is_told_where_nothing_does(tmp_path):
    words = "capacity", "patu655", "--step", "2", "--rule"
    done = typed(*words, "sfs4677", "--out", "rated", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == (
        "warning: 'patu655' has no supports, so that nothing tips and the rule's 90.9 % of the "
        "tipping load are left out: name what it stands on under 'supports' of the machine file\n"
    )
    assert typed(*words, "none", "--out", "plain", cwd=tmp_path).stderr == ""


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--rule", "iso"], "rule 'iso' is unknown, known: en12999, iso10567"),
        (["--tipping", "1.5"], "--tipping is 1.5, give a number from"),
        (["--hydraulic", "0"], "--hydraulic is 0.0, give a number above 0"),
        (["--slew", "front"], "--slew is 'front', write degrees, as 0,45,90"),
        (["--slew", "0,1,2,3,4,5,6,7,8"], "--slew has 9 angles, a page has room for 8"),
        (["--slew", "0,nan"], "slews is nan"),
        (["--slope", "60"], "--slope is 60.0 degrees, give a number from -45 to 45"),
        (["--step", "0"], "the step is 0.0 m"),
        (["--raising", "X_bom"], "did you mean 'X_boom'"),
        (["--frame", "buckett"], "frame 'buckett' is unknown"),
    ],
)
def test_wrong_options_are_told_in_one_line(tmp_path, given, said):
    done = typed("capacity", "excavator", *given, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ") and said in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1280, 800), (390, 844)])
def test_the_page_shows_the_cell_under_the_cursor(chart, tmp_path, size):
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("needs Chromium")
    sync_api = pytest.importorskip("playwright.sync_api")
    path, errors = write_capacity_page(chart, tmp_path / "capacity.html"), []
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(
            viewport={"width": size[0], "height": size[1]}, has_touch=size[0] < 400
        )
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text))
        page.goto(path.resolve().as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        for s, b, a in some(chart, 8, seed=2):
            page.click(f"text={('front', 'side')[s]}")
            x, y = page.evaluate(
                "([r, h]) => { const box = byId('chart').getBoundingClientRect();"
                " return [box.x + px(r), box.y + py(h)]; }",
                [float(chart.radii[a]), float(chart.heights[b])],
            )
            if size[0] < 400:
                page.touchscreen.tap(x, y)
            else:
                page.mouse.move(x, y)
            load = float(page.inner_text("#load").split()[0])
            assert load <= chart.loads[s, b, a] < load + max(1.0, 1e-3 * load)
            assert page.inner_text("#why") == str(
                chart.limiting_factors[chart.limiting_factor_index[s, b, a]]
            )
        browser.close()
    assert not errors
