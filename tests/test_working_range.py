"""Working ranges against triangles by hand, brute force over the strokes, and data sheets."""

import numpy as np
import pytest
from free_bodies import places

import crane
from crane.view.plots.workspace_figures import working_range_figure

COUNT = 31  # values of each stroke in the grid


@pytest.fixture(scope="module")
def found(excavator):
    return crane.working_range(excavator)


@pytest.fixture(scope="module")
def grid(excavator):
    """Lip, bucket's pin and floor at a grid of all strokes."""
    axes = [np.linspace(excavator.lower[k], excavator.upper[k], COUNT) for k in (1, 2, 3)]
    strokes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    q_a = np.column_stack([np.zeros(len(strokes)), strokes])
    lip, pin = (crane.Kinematics(excavator, x).position(q_a) for x in ("bucket_lip", "bucket"))
    along, up = (lip - pin)[:, [0, 2]] / 1.47, np.array([[0.0, 1.0], [-1.0, 0.0]])
    blade = np.array(excavator.external_forces[0].blade)
    floor = blade[0] * along + blade[1] * along @ up  # by the bucket's x and y
    return q_a, lip[:, [0, 2]], pin[:, [0, 2]], floor


def test_dimensions_are_where_their_postures_put_the_lip(excavator, found):
    for one in found.dimensions:
        if one.name == "smallest front slewing radius":
            continue
        lip = places(excavator, excavator.closure.solve(one.q_a))["bucket_lip"][:3, 3]
        assert one.section_position == pytest.approx([lip[0], lip[2]], abs=1e-9)
        inside = (one.q_a >= excavator.lower - 1e-9) & (one.q_a <= excavator.upper + 1e-9)
        assert inside.all()
        u, w = one.section_position
        value = u if one.name.startswith("reach") else abs(w)
        assert one.value == pytest.approx(value, abs=1e-9)
    assert found["reach at ground level"].section_position[1] == pytest.approx(0.0, abs=1e-9)


def test_nothing_of_a_grid_is_better(found, grid):
    """No grid point exceeds the result, which lies within one grid step."""
    _, lip, pin, floor = grid
    ground = np.abs(lip[:, 1]) < 0.1
    hangs = (np.abs(lip - pin)[:, 0] < 0.2) & (lip[:, 1] < pin[:, 1])
    wall = (floor[:, 0] <= 0) & (floor[:, 1] >= 0) & (pin[:, 0] <= lip[:, 0])
    for name, brute, slack, coarse in (
        ("reach", lip[:, 0].max(), 0.0, 0.05),
        ("reach at ground level", lip[ground, 0].max(), 0.03, 0.1),
        ("digging depth", -lip[:, 1].min(), 0.0, 0.05),
        ("cutting height", lip[:, 1].max(), 0.0, 1e-9),
        ("dump height", lip[hangs, 1].max(), 0.02, 0.1),  # 1.47 - (1.47^2 - 0.2^2)^0.5
        ("vertical wall digging depth", -lip[wall, 1].min(), 0.0, 0.3),
    ):
        assert brute <= found[name].value + slack + 1e-9, name
        assert brute == pytest.approx(found[name].value, abs=coarse), name


def test_the_level_bottom_ends_at_the_reach(excavator, found):
    """As deep at both ends as the deepest of a grid there, and no window of it is deeper."""
    axes = [np.linspace(excavator.lower[k], excavator.upper[k], 121) for k in (2, 3)]
    strokes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    q_a = np.column_stack([np.zeros((len(strokes), 1)) + [0.0, excavator.lower[1]], strokes])
    lip = crane.Kinematics(excavator, "bucket_lip").position(q_a)[:, [0, 2]]  # the boom all down
    one = found["depth of a 2.44 m level bottom"]
    deepest = [-lip[np.abs(lip[:, 0] - u) < 0.02, 1].min() for u in np.arange(1.0, 6.0, 0.02)]
    windows = [min(deepest[k : k + 122]) for k in range(len(deepest) - 122)]
    assert one.value - 0.02 < max(windows) < one.value + 0.02
    radii = one.section_position[0] + [0.0, 2.44]
    ends = [-lip[np.abs(lip[:, 0] - u) < 0.02, 1].min() for u in radii]
    assert ends == pytest.approx([one.value] * 2, abs=0.02)
    assert found.level_length == 2.44


def test_the_front_slews_within_its_radius(excavator, found, grid):
    """All pins of the posture inside, and no posture of the grid holds them in less."""
    one = found["smallest front slewing radius"]
    pins = ("bucket_lip", "bucket", "arm", "arm_barrel", "arm_eye", "bucket_barrel", "rocker",
            "bucket_eye", "link_eye", "boom_eye")  # fmt: skip
    at = places(excavator, excavator.closure.solve(one.q_a))
    radii = [abs(at[pin][0, 3]) for pin in pins]
    assert max(radii) == pytest.approx(one.value, abs=1e-8)
    q = excavator.closure.solve(grid[0])
    all_pins = [
        crane.Kinematics(excavator, pin).positions_at_configurations(q)[:, 0] for pin in pins
    ]
    brute = np.abs(all_pins).max(axis=0).min()
    assert one.value - 1e-9 <= brute < one.value + 0.05


def test_the_reach_is_what_triangles_give(excavator, found):
    """The arm all out, the bucket in line with boom's and bucket's pins, all of it level."""
    at = places(excavator, excavator.closure.solve(found["reach"].q_a))
    boom, arm, bucket, lip = (at[x][:3, 3] for x in ("boom", "arm", "bucket", "bucket_lip"))
    angle = np.arccos((boom - arm) @ (bucket - arm) / (5.7 * 2.9))
    side = np.sqrt(5.7**2 + 2.9**2 - 2 * 5.7 * 2.9 * np.cos(angle))
    assert found["reach"].value == pytest.approx(boom[0] + side + 1.47, abs=1e-9)
    assert lip[2] == pytest.approx(boom[2], abs=1e-6)
    i = excavator.active.index("X_arm")
    assert found["reach"].q_a[i] == pytest.approx(excavator.lower[i], abs=1e-9)


@pytest.mark.parametrize(
    ("name", "printed", "share"),  # of a Cat 320; the model is chosen after its class
    [
        ("reach at ground level", 9.85, 0.002),
        ("digging depth", 6.71, 0.02),
        ("depth of a 2.44 m level bottom", 6.55, 0.02),
        ("vertical wall digging depth", 5.18, 0.03),
        ("cutting height", 9.36, 0.05),
        ("dump height", 6.49, 0.08),
    ],
)
def test_it_works_as_far_as_data_sheets_say(found, name, printed, share):
    assert found[name].value == pytest.approx(printed, rel=share)


def test_a_crane_has_reach_depth_and_height():
    crane_ = crane.load("patu655")
    found = crane.working_range(crane_)
    names = [one.name for one in found.dimensions]
    assert names == ["reach", "reach at ground level", "depth", "height"]
    space = crane.workspace(crane_)
    for name, other in (("reach", "largest radius"), ("height", "largest height")):
        assert found[name].value == pytest.approx(space.extreme(other).value, abs=1e-6)
    with pytest.raises(crane.CraneError, match="'dump height' is no dimension of 'patu655'"):
        found["dump height"]


def test_tables_and_lines(found, tmp_path):
    """One row per dimension; lines of the picture do not lie on each other."""
    found.to_csv(tmp_path / "range.csv")
    rows = (tmp_path / "range.csv").read_text().splitlines()
    assert sum(row[0].isdigit() for row in rows) == len(found.dimensions) == 8
    assert found.to_markdown().count(" m, X_arm = ") == 8
    (axes,) = working_range_figure(found).axes
    arrows = [text for text in axes.texts if getattr(text, "arrow_patch", None) is not None]
    lines = [np.array([text.xy, text.xyann]) for text in arrows]
    assert len(lines) == 8
    for i, one in enumerate(lines):
        for other in lines[:i]:
            for k in (0, 1):  # along both axes
                if np.ptp(one[:, k]) == np.ptp(other[:, k]) == 0 and one[0, k] == other[0, k]:
                    a, b = sorted(one[:, 1 - k]), sorted(other[:, 1 - k])
                    assert a[1] <= b[0] or b[1] <= a[0]


@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        ("excavator", {"level": -1.0}, "the level bottom's length"),
        ("excavator", {"frame": "nothing"}, "frame 'nothing' is unknown"),
        ("excavator", {"bucket": "slew"}, "'slew' does not turn"),
        ("excavator", {"frame": "upper"}, "no driven joint moves 'upper'"),
        ("patu655", {"frame": "lift_boom"}, "covers no area of an upright plane"),
    ],
)
def test_what_has_no_range_is_said_in_one_line(name, given, said):
    with pytest.raises(crane.CraneError, match=said) as error:
        crane.working_range(crane.load(name), **given)
    assert "\n" not in str(error.value)
