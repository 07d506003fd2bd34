"""Drawing a machine in a browser: the file that is written, its motions, pictures, access."""

import http.client
import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading

import numpy as np
import pytest
import yaml
from command_line import MAIN, typed
from hypothesis import assume, given
from hypothesis import strategies as st
from test_drawing import LOADER
from warned import quiet

import crane
from crane.common.errors import InputError, OutputError
from crane.formats.machine_file.yaml_edits import edit_yaml
from crane.view.draw.drawing_file import DrawingFile, _differences
from crane.view.draw.drawing_server import DrawingServer, drawing_html
from crane.view.draw.drawing_session import DrawingSession
from crane.view.draw.side_view_picture import place_picture, read_picture
from crane.view.live.live_server import AccessGuard, free_port

WITH_WORDS = """# a loader
name: loader  # its name
gravity: [0, 0, -9.81]
drawing:
  base: frame
  points:
    A: [0, 2]      # printed
    B: [400 mm, 1.1]
    # between
    C: [1.2, 1.5]  # read
  bodies:
    frame: {points: [A, B], mass: 8 t,
            centre: [-1, 1]}  # two lines
    boom: {points: [A, C], mass: 900}
  cylinders:
    X: {points: [B, C], bore: 120 mm, rod: 0.07, shortest: 0.8, longest: 1}  # of the brochure
# the tip
tip: C
"""


@pytest.fixture
def session(tmp_path):
    path = tmp_path / "loader.yaml"
    path.write_text(LOADER)
    return DrawingSession(DrawingFile(path, path))


# --- the machine file ---------------------------------------------------------------------------


def written(folder, change, new_names=None, text=WITH_WORDS):
    """Text of a machine file after a change of its drawing by a page."""
    path = folder / "loader.yaml"
    path.write_text(text)
    file = DrawingFile(path, path)
    data = json.loads(json.dumps(file.data))
    change(data)
    file.write(data, new_names or {})
    assert DrawingFile(path, path).data == data
    return path.read_text()


def test_what_is_not_changed_stays_to_the_letter(tmp_path):
    assert written(tmp_path, lambda data: None) == WITH_WORDS

    def change(data):
        drawing = data["drawing"]
        drawing["points"]["A"] = [0.1, 2]
        drawing["points"]["D"] = [1.5, 1.5]
        drawing["bodies"]["boom"] |= {"points": ["A", "C", "D"], "mass": "1 t"}
        drawing["cylinders"]["X"]["rod"] = 0.08
        del drawing["bodies"]["frame"]["centre"]
        data["tip"] = "D"

    text = written(tmp_path, change)
    assert text == (
        WITH_WORDS.replace("A: [0, 2] ", "A: [0.1, 2] ")
        .replace("# read\n", "# read\n    D: [1.5, 1.5]\n")
        .replace("mass: 8 t,\n            centre: [-1, 1]}", "mass: 8 t}")
        .replace("[A, C], mass: 900", "[A, C, D], mass: 1 t")
        .replace("rod: 0.07", "rod: 0.08")
        .replace("tip: C", "tip: D")
    )


def test_new_names_stand_where_the_old_ones_did(tmp_path):
    def change(data):
        drawing = data["drawing"]
        drawing["points"] = {"eye" if x == "C" else x: y for x, y in drawing["points"].items()}
        for body in (*drawing["bodies"].values(), *drawing["cylinders"].values()):
            body["points"] = ["eye" if x == "C" else x for x in body["points"]]
        data["tip"] = "eye"

    text = written(tmp_path, change, {"points": {"eye": "C"}})
    assert text == re.sub(r"\bC\b", "eye", WITH_WORDS)


def test_sections_come_and_go(tmp_path):
    def change(data):
        del data["drawing"]["cylinders"], data["tip"]
        data["drawing"]["pins"] = {"A": {"driven": True}}

    text = written(tmp_path, change)
    assert "cylinders" not in text and text.count("#") == WITH_WORDS.count("#") - 1
    assert "  pins:\n    A: {driven: true}\n# the tip\n" in text
    flow = "name: x\ndrawing: {base: f, points: {A: [0, 1]}, bodies: {f: {points: [A]}}}\n"

    def remove(data):
        data["drawing"]["points"] = {"B": [1.0, 2.0]}
        data["drawing"]["bodies"]["f"]["points"] = ["B"]

    text = written(tmp_path, remove, text=flow)
    assert text == flow.replace("A: [0, 1]", "B: [1.0, 2.0]").replace("[A]", "[B]")


NAMES = st.sampled_from(["A", "yes", "1", "boom: x", "ä", "q-1"])
VALUES = st.one_of(st.floats(-9, 9), st.text("ab #:,[]{}'\"&*", max_size=5), st.booleans())
ITEMS = st.one_of(VALUES, st.lists(VALUES, max_size=3), st.dictionaries(NAMES, VALUES))
FILES = st.dictionaries(NAMES, st.one_of(VALUES, st.dictionaries(NAMES, ITEMS)), min_size=1)


@given(FILES, FILES, st.booleans(), st.sampled_from(["\n", "\r\n"]))
def test_a_text_has_what_it_was_changed_to(old, new, is_flow, end):
    text = yaml.safe_dump(old, default_flow_style=is_flow or None, allow_unicode=True)
    text = text.replace("\n", end)
    assume({} not in new.values())  # which is left empty
    assert yaml.safe_load(edit_yaml(text, _differences(old, new))) == new


def test_a_file_that_another_program_changes_is_not_replaced(session):
    path, data = session.file.path, session.file.data
    path.write_text(LOADER + "# more\n")
    with pytest.raises(OutputError, match=r"loader\.yaml: another program has changed it"):
        session.file.write(data | {"tip": "E"}, {})
    assert path.read_text() == LOADER + "# more\n"


def test_shared_values_are_refused(tmp_path):
    text = WITH_WORDS.replace("[0, 2]", "&a [0, 2]")
    with pytest.raises(OutputError, match="'drawing' shares values with other keys"):
        written(tmp_path, lambda data: data["drawing"]["points"].update(B=[1.0, 1.0]), text=text)
    assert (tmp_path / "loader.yaml").read_text() == text


def test_a_new_file_has_a_line_for_each_thing(tmp_path):
    file = DrawingFile(tmp_path / "new.yaml")
    drawing = yaml.safe_load(LOADER.replace("e+3", "000.0"))
    file.write({**drawing, "name": "new"}, {})
    text = (tmp_path / "new.yaml").read_text()
    things = sum(len(drawing["drawing"][x]) for x in ("points", "bodies", "cylinders"))
    assert len(text.splitlines()) == things + 4 + 3  # name, drawing, base, tip; sections
    assert yaml.safe_load(text) == {**drawing, "name": "new"}


# --- checks and motions -------------------------------------------------------------------------


def test_errors_are_told_with_the_thing_that_they_are_of(session):
    model = session.file.data
    answer = session.check(model)
    assert not [x for x in answer["findings"] if x["isError"]]
    assert answer["masses"]["boom"] == 900
    model["drawing"]["cylinders"]["X_lift"]["longest"] = 0.85
    model["drawing"]["bodies"]["link"]["points"][1] = "Q"
    errors = {
        tuple(x["where"]): x["text"] for x in session.check(model)["findings"] if x["isError"]
    }
    assert errors["cylinders", "X_lift"].startswith("cylinder 'X_lift' is 0.8944 m from B to C")
    assert errors["bodies", "link"].startswith("body 'link' has the unknown point 'Q'")
    with pytest.raises(InputError, match="is no machine yet"):
        session.move("X_lift", 0.1)


def test_the_linkage_moves_as_a_triangle_does(session):
    """The boom by the law of cosines; the loops of the Z-bar keep the lengths of their parts."""
    points = session.check(session.file.data)["points"]
    drawn = {name: np.array(place) for name, place in points.items()}
    joints = {x["name"]: x for x in session.move("X_lift", 0.15)["joints"]}
    assert joints["X_lift"]["value"] == 0.15 and joints["X_lift"]["force"] > 0
    moved = {name: np.array(x) for name, x in session.move("X_lift", 0.12)["points"].items()}
    assert np.linalg.norm(moved["C"] - moved["B"]) == pytest.approx(0.8 + 0.12, abs=1e-9)
    for one, other in ("AC", "AD", "CE", "EF", "EG", "GH", "DH"):
        length = np.linalg.norm(drawn[one] - drawn[other])
        assert np.linalg.norm(moved[one] - moved[other]) == pytest.approx(length, abs=1e-9)
    assert np.linalg.norm(moved["T"] - moved["F"]) == pytest.approx(
        np.linalg.norm(drawn["T"] - drawn["F"]), abs=1e-9
    )


def test_a_point_follows_the_pointer_and_stays_at_the_edge_of_its_reach(session):
    drawn = session.check(session.file.data)["points"]
    target = np.array(drawn["D"]) + [0.02, 0.05]
    reach = np.linalg.norm(np.array(drawn["D"]) - drawn["A"])
    on_circle = np.array(drawn["A"]) + reach * (target - drawn["A"]) / np.linalg.norm(
        target - drawn["A"]
    )
    np.testing.assert_allclose(session.drag("D", *target)["points"]["D"], on_circle, atol=1e-6)
    far = session.drag("D", 0.0, 9.0)  # the lift cylinder ends the motion
    joints = {x["name"]: x["value"] for x in far["joints"]}
    assert joints["X_lift"] == pytest.approx(0.2, abs=1e-9)
    session.check(session.file.data)
    session.move("X_lift", 0.12)
    there = session.move("X_tilt", 0.07)
    session.check(session.file.data)
    back = session.drag("edge", *there["points"]["edge"])
    values = [[x["value"] for x in answer["joints"]] for answer in (there, back)]
    np.testing.assert_allclose(values[1], values[0], atol=1e-6)


def test_saving_tells_what_is_wrong_with_the_whole_file(session):
    model = session.file.data
    model = {**model, "tip": "nothing"}
    (finding,) = session.save(model, {})["findings"]
    assert "loader.yaml:" in finding and "error" in finding and "'nothing'" in finding
    assert "tip: nothing" in session.file.path.read_text()


# --- pictures -----------------------------------------------------------------------------------


def side_view(path, parts=(), pages=1):
    """A side view of 1200 x 800 pixels with marks at some pixels, as a brochure has it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 8), dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, 1200), ylim=(800, 0))
    axes.set_axis_off()
    for part in parts:
        axes.plot(*np.transpose(part), "-", color="0.45", lw=9, solid_capstyle="round", alpha=0.5)
        axes.plot(*np.transpose(part), "o", color="0.2", ms=7, mfc="w")
    if path.suffix == ".pdf":
        with PdfPages(path) as pdf:
            for _ in range(pages):
                pdf.savefig(figure)
    else:
        figure.savefig(path)
    return path


def test_pictures_that_are_none_are_told_in_a_line(tmp_path):
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    (tmp_path / "words.txt").write_text("words")
    for name in ("bad.png", "words.txt"):
        with pytest.raises(
            InputError, match="is no picture that can be read, give a PNG, JPEG or PDF"
        ):
            read_picture(tmp_path / name)
    png = side_view(tmp_path / "side.png")
    assert read_picture(png) == png.read_bytes()
    with pytest.raises(InputError, match="has no page 2, give 1 to 1"):
        read_picture(png, 2)


def test_pages_of_a_pdf(tmp_path):
    pytest.importorskip("pypdfium2")
    from matplotlib.image import imread

    pdf = side_view(tmp_path / "side.pdf", [[(100, 100), (900, 500)]], pages=2)
    (tmp_path / "page.png").write_bytes(read_picture(pdf, 2))
    image = imread(tmp_path / "page.png")
    assert image.shape[:2] == (2000, 3000)  # pixels of the picture by 2.5
    assert image[1750, 250, :3].min() > 0.9 > 0.8 > image[750, 1250, :3].max()
    for page in (0, 3):
        with pytest.raises(InputError, match=f"has no page {page}, give 1 to 2"):
            read_picture(pdf, page)
    pdf.write_bytes(pdf.read_bytes()[:200])
    with pytest.raises(InputError, match="is no picture that can be read"):
        read_picture(pdf)


def test_a_pdf_without_the_library(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pypdfium2", None)
    with pytest.raises(InputError, match=r"a picture from a PDF needs pypdfium2, .*'\.\[draw\]'"):
        read_picture(side_view(tmp_path / "side.pdf"))


def test_the_picture_is_kept_in_the_file_and_found_again(tmp_path):
    png = side_view(tmp_path / "side.png")
    (tmp_path / "sub").mkdir()
    path = tmp_path / "sub" / "loader.yaml"
    path.write_text(LOADER)
    page, content = place_picture(DrawingFile(path, path), path, png, 1)
    assert page["hasPicture"] and content == png.read_bytes()
    picture = page["model"]["drawing"]["picture"] | {"width": 9.0, "corner": [1.0, 0.0]}
    assert picture["file"] == "../side.png"
    page["model"]["drawing"]["picture"] = picture
    DrawingFile(path, path).write(page["model"], {})
    assert not crane.check(path).errors
    again, content = place_picture(DrawingFile(path, path), path, None, 1)
    assert again["model"] == page["model"] and content == png.read_bytes()
    assert place_picture(DrawingFile(path, path), path, png, 1)[0] == again
    png.unlink()
    with pytest.warns(crane.common.errors.CraneWarning, match="picture is left out: .*No such"):
        gone, content = place_picture(DrawingFile(path, path), path, None, 1)
    assert not gone["hasPicture"] and content == b"" and gone["model"] == again["model"]


# --- the command and its server -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["nowhere.yaml"], "nowhere.yaml: cannot be read (No such file or directory)"),
        (["plain.yaml"], "plain.yaml:1: has no section 'drawing', give a machine that is drawn"),
        (["loader.yaml", "--picture", "plain.yaml"], "plain.yaml: is no picture"),
        (["loader.yaml", "--picture", "none.png"], "none.png: No such file"),
        (["loader.yaml", "--out", "plain.yaml"], "plain.yaml: exists already"),
        (["--out", "plain.yaml"], "plain.yaml: exists already"),
        (["loader.yaml", "--page", "2"], "--page is for --picture, add it"),
        (["bad.yaml"], "bad.yaml:7: point 'A' has 1 coordinates"),
        (["own.yaml"], "body 'boom' has coordinates of its own, which 'crane draw' cannot edit"),
        (["loader.yaml", "--host", "no.such.host.invalid"], "is not known"),
    ],
)
def test_errors_are_one_line(arguments, text, tmp_path):
    (tmp_path / "loader.yaml").write_text(LOADER)
    (tmp_path / "bad.yaml").write_text(LOADER.replace("A: [0.0, 2.0]", "\n    A: [0]"))
    own = "name: own\ndrawing: {points: {}, bodies: {boom: {points: {A: [0, 0], B: [1, 0]}}}}\n"
    (tmp_path / "own.yaml").write_text(own)
    (tmp_path / "plain.yaml").write_text("name: plain\n")
    done = typed("draw", *arguments, "--no-open", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert text in done.stderr


@pytest.fixture
def served(session):
    """A server in this process, and its guard."""
    guard = AccessGuard("127.0.0.1")
    page = drawing_html({"model": session.file.data, "file": "loader.yaml", "hasPicture": False})
    server = DrawingServer(guard, free_port("127.0.0.1", 0), session, page, b"")
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server, guard
    server.shutdown()
    server.server_close()


def request(server, path, body=None, **headers):
    """Status and content of a request."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
    connection.request("GET" if body is None else "POST", path, body, headers)
    response = connection.getresponse()
    found = response.status, response.read()
    connection.close()
    return found


def test_strangers_get_nothing_and_write_nothing(served, session):
    server, guard = served
    text = session.file.path.read_text()
    data = json.dumps({"model": session.file.data | {"tip": "E"}, "renames": {}})
    save, port = f"/{guard.token}/save", server.server_address[1]
    for path, headers in (
        ("/save", {}), ("/AAAAAAAAAAAAAAAAAAAAAA/save", {}), (f"/{guard.token}x/save", {}),
        (save, {"Origin": "http://elsewhere.example"}), (save, {"Origin": "null"}),
        (save, {"Origin": "http://127.0.0.1:1"}), (save, {"Host": f"rebound.example:{port}"}),
    ):  # fmt: skip
        status, content = request(server, path, data, **headers)
        assert status == 403 and content.startswith(b"Refused")
        assert request(server, path.replace("save", ""), **headers)[0] == 403
    assert session.file.path.read_text() == text
    assert request(server, save, data, Origin=f"http://127.0.0.1:{port}")[0] == 200
    assert "tip: E" in session.file.path.read_text()


def test_requests_that_mean_nothing_are_told_and_end_nothing(served, capfd):
    server, guard = served
    for path in ("picture2", "../../etc/passwd", "_frames", "file"):
        assert request(server, f"/{guard.token}/{path}", "{}")[0] == 404
    for action, body in (
        ("check", ""), ("check", "[]"), ("check", "{}"), ("check", '{"model": 3}'), ("move", "{"),
        ("check", '{"model": {"drawing": {"points": [1]}}}'), ("save", '{"model": 1}'),
        ("move", '{"joint": "X_lift", "value": 0.1}'), ("drag", '{"point": 1, "x": 0, "z": 0}'),
    ):  # fmt: skip
        status, content = request(server, f"/{guard.token}/{action}", body)
        assert status == 200 and "error" in str(content)
    with socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=10) as there:
        there.sendall(b"POST /%s/save HTTP/1.0\r\nHost: 127.0.0.1\r\n" % guard.token.encode())
        there.sendall(b"Content-Length: 3000000\r\n\r\n")  # more than is read
        assert b"not done" in there.makefile("rb").read()
    assert request(server, f"/{guard.token}/")[0] == 200
    assert capfd.readouterr() == ("", "")


def begin(*arguments, cwd):
    """The command in a process of its own, and its address."""
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN, "draw", *map(str, arguments), "--no-open", "--port", "0"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=cwd,
    )  # fmt: skip
    line = process.stdout.readline()
    address = re.fullmatch(
        r"drawing at (http://127\.0\.0\.1:\d+/\S+/) \(Ctrl\+C ends it\)\n", line
    )
    assert address, line + process.stderr.read()
    return process, address[1]


def end(process):
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "", "")


# --- the page in a browser ----------------------------------------------------------------------

FRONT = {  # an excavator's front end in its side view [m]
    "foot": (0.16, 1.80), "lift": (0.585, 1.135), "eye": (2.245, 3.265), "pin": (5.51, 3.76),
    "crowd": (2.365, 3.695), "lever": (5.09, 4.51), "knuckle": (7.50, 1.65), "curl": (6.31, 3.95),
    "pivot": (7.23, 1.96), "crank": (7.74, 2.365), "ear": (7.94, 1.885), "teeth": (8.005, 0.27),
}  # fmt: skip
FRONT_BODIES = {
    "boom": ("foot crowd pin eye", "1640"), "stick": ("lever curl pivot knuckle pin", "840"),
    "rocker": ("pivot crank", "72"), "rod": ("crank ear", "68"),
    "bucket": ("knuckle ear teeth", "950"),
}  # fmt: skip
FRONT_CYLINDERS = {
    "X_boom": ("lift eye", "120 mm", "85 mm", 1.88, 3.14),
    "X_stick": ("crowd lever", "0.14", "0.1", 2.37, 3.874),
    "X_bucket": ("curl crank", "0.12", "0.085", 1.664, 2.768),
}


def pixel(place, tilt=0.026):
    """Where a place [m] is on a picture that is tilted, and on which the machine looks left."""
    x, z = place
    along = np.cos(tilt) * x - np.sin(tilt) * z
    up = np.sin(tilt) * x + np.cos(tilt) * z
    return 1050 - 100 * along, 700 - 100 * up


PIXELS = {name: pixel(place) for name, place in FRONT.items()}


@pytest.fixture(scope="module")
def browser():
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium in the path")
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield running
        running.close()


class DrawingPage:
    """The page as a hand uses it: clicks, drags, keys and words."""

    def __init__(self, browser, address, **options):
        self.page = browser.new_page(**options)
        self.faults, self.clicks = [], 0
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("console", lambda x: x.type == "error" and self.faults.append(x.text))
        self.page.goto(address)
        self.rest()

    def rest(self):
        """Wait until the server has answered all."""
        for _ in range(2000):
            self.page.wait_for_timeout(30)
            if self.page.evaluate("window.crane !== undefined && crane.idle"):
                self.page.wait_for_timeout(30)
                return
        raise TimeoutError

    def spot(self, place):
        """Pixels of the screen of a mark of the picture, a point by its name, or a place [m]."""
        if isinstance(place, str):
            place = self.page.evaluate("crane.place", place)
        if place[0] > 50:  # pixels of the picture
            matrix = self.page.evaluate(
                "(({ a, b, c, d, e, f }) => [[a, c, e], [b, d, f]])"
                "(document.querySelector('image').getScreenCTM())"
            )
            return np.array(matrix) @ [*place, 1]
        box = self.page.locator("#canvas").bounding_box()
        u, v = self.page.evaluate("crane.pixels", list(place))
        return box["x"] + u, box["y"] + v

    def click(self, *places):
        for place in places:
            self.page.mouse.click(*self.spot(place))
            self.clicks += 1

    def drag(self, start, to):
        self.page.mouse.move(*self.spot(start))
        self.page.mouse.down()
        x, y = self.spot(to)
        self.page.mouse.move(x - 20, y, steps=4)
        self.page.mouse.move(x, y, steps=4)
        self.rest()
        self.page.mouse.up()
        self.rest()

    def write(self, **fields):
        for field, value in fields.items():
            box = self.page.locator(f"[data-field='{field.replace('__', '.')}']")
            box.fill(value)
            box.press("Enter")
            self.page.wait_for_timeout(30)

    def key(self, key):
        self.page.keyboard.press(key)

    @property
    def model(self):
        return self.page.evaluate("crane.model")

    def close(self):
        self.rest()
        assert not self.faults
        self.page.close()


def draw_front(page):
    """Scale, mirror and level the picture, and draw bodies, base, cylinders and tip."""
    page.click(PIXELS["foot"], PIXELS["pin"])
    page.page.fill("#answer", "5.70")
    page.key("Enter")
    page.page.get_by_role("button", name="mirror").click()
    page.page.get_by_role("button", name="ground").click()
    page.click(pixel((8.5, 0)), pixel((-0.5, 0)))
    page.page.get_by_role("button", name="x = 0").click()
    page.click(pixel((0, 4)))
    page.rest()
    for name, (points, mass) in FRONT_BODIES.items():
        page.key("b")
        page.click(*(PIXELS[x] for x in points.split()))
        page.key("Enter")
        page.rest()
        page.write(bodies__name=name, bodies__mass=mass)
    page.key("g")
    page.click(PIXELS["foot"], PIXELS["lift"])
    for name, (points, bore, rod, shortest, longest) in FRONT_CYLINDERS.items():
        page.key("c")
        page.click(*(PIXELS[x] for x in points.split()))
        page.rest()
        page.write(
            cylinders__bore=bore, cylinders__rod=rod, cylinders__shortest=str(shortest),
            cylinders__longest=str(longest), cylinders__name=name,
        )  # fmt: skip
    page.key("t")
    page.click(PIXELS["teeth"])
    page.rest()


@pytest.mark.slow
def test_six_bodies_are_drawn_over_a_picture_and_move(browser, tmp_path):
    parts = [[PIXELS[x] for x in points.split()] for points, *_ in FRONT_BODIES.values()]
    side_view(tmp_path / "side.png", [*parts, [PIXELS["foot"], PIXELS["lift"]]])
    process, address = begin("--picture", "side.png", "--out", "front.yaml", cwd=tmp_path)
    page = DrawingPage(browser, address, viewport={"width": 1280, "height": 800})
    draw_front(page)
    model = page.model
    drawn = {name: np.array(place) for name, place in model["drawing"]["points"].items()}
    assert len(drawn) == len(FRONT)
    letters = {}  # of the points, by what they are
    for name, place in FRONT.items():
        letters[name] = min(drawn, key=lambda x: np.linalg.norm(drawn[x] - place))
        np.testing.assert_allclose(drawn[letters[name]], place, atol=0.015)  # a pixel
    assert not [x for x in page.page.evaluate("crane.findings") if x["isError"]]
    page.key("m")
    page.drag(letters["knuckle"], (7.0, 3.0))
    moved = page.page.evaluate("crane.moved")
    spot = np.array(moved["points"][letters["knuckle"]])
    np.testing.assert_allclose(spot, (7.0, 3.0), atol=0.015)
    strokes = {x["name"]: x["value"] for x in moved["joints"]}
    page.key("v")
    page.rest()
    page.key("Control+s")
    page.rest()
    assert page.page.text_content("#file") == "front.yaml"
    page.close()
    end(process)
    assert len((tmp_path / "front.yaml").read_text().splitlines()) < 60
    assert yaml.safe_load((tmp_path / "front.yaml").read_text()) == model
    machine = quiet(crane.load, tmp_path / "front.yaml")
    assert set(machine.active) == {*FRONT_CYLINDERS} and machine.tip == letters["teeth"]
    q_a = np.array([strokes[x] for x in machine.active])
    frame = next(x for x in machine.tree.links if x.endswith(f"_{letters['knuckle']}"))
    found = crane.Kinematics(machine, frame).position(q_a)[[0, 2]]
    np.testing.assert_allclose(found, spot, atol=1e-9)
    run = quiet(crane.simulate, machine, duration=0.05)
    assert np.isfinite(run.q).all()


@pytest.mark.slow
def test_points_are_dragged_renamed_and_deleted_and_all_is_undone(browser, tmp_path):
    (tmp_path / "loader.yaml").write_text(WITH_WORDS)
    process, address = begin("loader.yaml", cwd=tmp_path)
    page = DrawingPage(browser, address, viewport={"width": 1280, "height": 800})
    first = page.model
    page.drag("C", (1.3, 1.4))
    assert page.model["drawing"]["points"]["C"] == pytest.approx([1.3, 1.4], abs=0.005)
    page.drag("C", (2.3, 1.4))
    assert re.search(r"'X' is 1\.92\d m from B to C", page.page.text_content("#side"))
    page.key("Control+z")
    page.rest()
    assert not [x for x in page.page.evaluate("crane.findings") if x["isError"]]
    page.click("C")
    page.rest()
    page.write(points__name="eye")
    page.click("A")
    page.rest()
    page.key("ArrowUp")
    page.key("Shift+ArrowLeft")
    assert page.model["drawing"]["points"]["A"] == [-0.01, 2.001]
    page.key("Control+s")
    page.rest()
    text = (tmp_path / "loader.yaml").read_text()
    assert text.count("#") == WITH_WORDS.count("#") and "eye: [1.3, 1.4]  # read" in text
    assert "tip: eye" in text and "points: [B, eye], bore: 120 mm" in text
    page.click("B")
    page.key("Delete")
    page.rest()
    assert "cylinders" not in page.model["drawing"]
    page.click("A")
    page.rest()
    page.page.locator("[data-field='points.x']").click(click_count=3)
    page.page.keyboard.type("0.0")
    page.page.evaluate("check()")  # whose answer comes while somebody writes
    page.rest()
    page.page.keyboard.type("25")
    page.key("Tab")
    page.page.keyboard.type("2.1")
    page.key("Enter")
    page.rest()
    assert page.model["drawing"]["points"]["A"] == [0.025, 2.1]
    page.key("b")
    page.click((0.2, 1.3), (0.5, 1.3))
    page.page.mouse.dblclick(*page.spot((0.8, 1.2)))
    page.rest()
    assert page.model["drawing"]["bodies"]["body1"]["points"] == ["B", "C", "D"]
    for _ in range(20):
        page.key("Control+z")
    page.rest()
    assert page.model == first and page.page.is_disabled("#undo")
    for _ in range(20):
        page.key("Control+y")
    page.rest()
    assert page.model["drawing"]["points"]["B"] == pytest.approx([0.2, 1.3], abs=0.01)
    page.page.once("dialog", lambda dialog: dialog.accept())
    page.close()
    end(process)


@pytest.mark.slow
def test_fingers_draw_on_a_phone(browser, tmp_path):
    (tmp_path / "loader.yaml").write_text(WITH_WORDS)
    process, address = begin("loader.yaml", cwd=tmp_path)
    options = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    page = DrawingPage(browser, address, **options)
    touch = page.page.touchscreen
    page.page.tap("#tool-body")
    for place in ((1.0, 1.2), (0.6, 1.75), "C"):
        touch.tap(*page.spot(place))
    page.page.tap("#done")
    page.rest()
    assert page.model["drawing"]["bodies"]["body1"]["points"] == ["D", "E", "C"]
    finger = page.page.context.new_cdp_session(page.page)

    def moved(*paths):
        for step in range(5):
            spots = [{"x": x[step], "y": y[step], "id": i} for i, (x, y) in enumerate(paths)]
            kind = "touchMove" if step else "touchStart"
            finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": spots})
        finger.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        page.rest()

    x, y = page.spot("C")
    up = page.spot((1.1, 1.6))
    moved((np.linspace(x, up[0], 5), np.linspace(y, up[1], 5)))
    assert page.model["drawing"]["points"]["C"] == pytest.approx([1.1, 1.6], abs=0.01)
    scale = page.spot((1, 0))[0] - page.spot((0, 0))[0]
    moved(*((200 + side * np.linspace(50, 100, 5), np.full(5, 160.0)) for side in (-1, 1)))
    assert page.spot((1, 0))[0] - page.spot((0, 0))[0] == pytest.approx(2 * scale, rel=0.1)
    boxes = [page.page.locator(x).bounding_box() for x in ("#space", "#side")]
    assert boxes[1]["y"] >= boxes[0]["y"] + boxes[0]["height"]
    assert page.page.evaluate("document.documentElement.scrollWidth") == 390
    assert boxes[0]["height"] > 250 < boxes[1]["height"]
    page.close()
    end(process)
