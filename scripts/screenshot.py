"""Take a picture of a page written by `crane view`, for the documentation.

Needs the extra `dev` (playwright) and Chromium.
"""

import argparse
import shutil
from pathlib import Path

from playwright.sync_api import sync_playwright

WEBGL = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


def main() -> None:
    """Read the command line, open the page, take the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("png", type=Path)
    parser.add_argument("--time", type=float, default=0.0, help="[s] after the first frame")
    parser.add_argument("--camera", default="iso", help="iso, side, front or top")
    parser.add_argument("--size", default="1280x720", help="pixels")
    parser.add_argument("--zoom", type=float, default=1.0)
    parser.add_argument("--bare", action="store_true", help="the machine alone, without panels")
    options = parser.parse_args()
    width, height = (int(number) for number in options.size.split("x"))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=WEBGL)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.goto(options.page.resolve().as_uri())
        if options.bare:
            page.add_style_tag(
                content="body { grid-template: 'space' 1fr / 1fr !important; }"
                "body > :not(main), main > :not(#pane) { display: none !important; }"
            )
            for layer in page.query_selector_all("#layers button"):
                layer.evaluate("(button) => button.click()")
        page.wait_for_timeout(300)  # the picture takes its size
        page.evaluate(
            """([time, camera, zoom]) => {
                crane.seek(crane.timeline.start + time);
                crane.look(camera);
                crane.viewer.camera.zoom = zoom;
                crane.viewer.render();
            }""",
            [options.time, options.camera, options.zoom],
        )
        page.wait_for_timeout(500)
        page.screenshot(path=options.png)
        browser.close()


if __name__ == "__main__":
    main()
