"""Film the page of the testbed in a browser: docs/images/testbed/testbed.webp.

    python docs/make/testbed_film.py

Four robots follow the ball on its curve for one round, so the film has no jump when it repeats.
Needs Chromium and the extras web and dev (playwright). The session advances only between two
pictures, so the speed of the machine does not matter.
"""

from __future__ import annotations

import sys
import time
from io import BytesIO
from pathlib import Path
from typing import Any

from measure_page import CHROMIUM, DRAWN, find_chromium
from PIL import Image
from playwright.sync_api import sync_playwright

from robot_ik.testbed.commands import RATE, Start
from robot_ik.testbed.frontends.browser import VIEW_PERIOD, Page
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.session import Session
from robot_ik.testbed.setup import CURVE_PERIOD

FILE = Path(__file__).resolve().parents[1] / "images" / "testbed" / "testbed.webp"
START = Start("puma560", count=4)
PORT = 8655
#: Width and height of the browser window, and width of the film, px.
WINDOW = (1200, 720)
FILM_WIDTH = 960
#: Pictures of one round of the ball, and how long each is shown, ms.
PICTURES = 60
PICTURE_MS = 80
#: Ticks before the first picture: the plots of the page are filled by then.
WARM_UP_TICKS = round(CURVE_PERIOD * RATE)
#: Quality of the compression, 0 to 100.
QUALITY = 60
#: Largest size of the file, bytes.
MAX_BYTES = 3_000_000
#: A browser without a GPU on a busy machine may take so long, ms.
PATIENCE = 300_000

BALL_IS_AT = """async position => {
    const node = window.__viserMutable.nodeRefFromName["/goal"];
    const place = node.getWorldPosition(node.position.clone());
    const world = window.__viserMutable.nodeRefFromName["/robot"];
    const expected = world.localToWorld(node.position.clone().set(...position));
    if (place.distanceTo(expected) > 1e-3) return false;
    for (let k = 0; k < 3; k++) await new Promise(requestAnimationFrame);
    return true;
}"""
"""JavaScript: whether the browser has drawn the ball at a position in the world."""


def advance(session: Session, page: Page, ticks: int) -> None:
    """Run ticks of the session and send the last view to the browser."""
    for _ in range(ticks):
        session.tick()
    time.sleep(VIEW_PERIOD)  # the page sends numbers no more often than that
    page.draw(session.view())


def take(window: Any, session: Session) -> Image.Image:
    """Return the picture of the page once it shows the last view of the session."""
    position = [float(value) for value in session.view().ball.position]
    window.wait_for_function(BALL_IS_AT, arg=position, timeout=PATIENCE)
    raw = window.screenshot(timeout=PATIENCE)
    picture: Image.Image = Image.open(BytesIO(raw)).convert("RGB")
    height = round(picture.height * FILM_WIDTH / picture.width)
    return picture.resize((FILM_WIDTH, height), Image.Resampling.LANCZOS)


def film(browser: Any) -> list[Image.Image]:
    """Return the pictures of one round of the ball."""
    with (
        Session(START) as session,
        Page(session, PageServer(port=PORT, shadows=False)) as page,
    ):
        while session.busy or not session.ready:
            advance(session, page, 1)
        width, height = WINDOW
        window = browser.new_page(viewport={"width": width, "height": height})
        window.set_default_timeout(PATIENCE)
        window.add_init_script("localStorage.setItem('robot_ik.intro.seen', '1')")
        window.goto(page.url)
        window.wait_for_function(DRAWN, timeout=PATIENCE)
        for _ in range(PICTURES):
            advance(session, page, WARM_UP_TICKS // PICTURES)

        pictures = []
        for k in range(PICTURES):
            advance(session, page, round(CURVE_PERIOD * RATE / PICTURES))
            pictures.append(take(window, session))
            print(f"\r{k + 1} of {PICTURES}", end="", flush=True)
        print()
        window.close()
    return pictures


def main() -> None:
    """Film the page and write the file."""
    path = find_chromium()
    if path is None:
        sys.exit("Chromium is needed: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(CHROMIUM))
        pictures = film(browser)
        browser.close()
    pictures[0].save(
        FILE,
        save_all=True,
        append_images=pictures[1:],
        duration=PICTURE_MS,
        loop=0,
        quality=QUALITY,
        method=4,
    )
    size = FILE.stat().st_size
    print(f"{FILE.name}: {size / 1000:.0f} kB")
    if size > MAX_BYTES:
        sys.exit(f"it is larger than {MAX_BYTES / 1000:.0f} kB: lower QUALITY or FILM_WIDTH")


if __name__ == "__main__":
    main()
