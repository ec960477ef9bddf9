"""A window of a real browser that shows the page, and what tests do in it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from tests.doc_pages import script

measure_page = script("measure_page")

PAGE_TIMEOUT = 60.0
"""Seconds of one wait for the page. What waits for a compiler has ``LONG``."""

HARMLESS = (
    "THREE.Clock: This module has been deprecated",
    "GL Driver Message",  # the driver warns that software rendering is slow
    "Unable to preventDefault inside passive event listener invocation.",  # of viser
    "GL_INVALID_OPERATION: glDrawElementsInstanced",  # of viser's outline, in software
)
"""Parts of console messages that are no error of the page."""

CURSOR = """shown => document.querySelector("canvas[data-engine]").style.cursor === shown"""
"""Whether the browser shows a cursor: "pointer" over what can be dragged, else "auto"."""

PIXEL = """([x, y, z]) => {
    const { camera, nodeRefFromName } = window.__viserMutable;
    const world = nodeRefFromName["/robot"];
    const point = world.localToWorld(camera.position.clone().set(x, y, z)).project(camera);
    const box = document.querySelector("canvas[data-engine]").getBoundingClientRect();
    return [box.left + (point.x + 1) / 2 * box.width, box.top + (1 - point.y) / 2 * box.height];
}"""
"""The pixel of a point of the world."""

COARSE = "fixedDpr=0.25"
"""Part of the address: viser draws a sixteenth of the pixels. The layout stays the same."""

SMOOTHING_OFF = "--webgl-antialiasing-mode=none"
"""Argument of Chromium. Tests do not look at edges, and software draws them slowly."""

SLOW_FRAMES = """(() => {
    // Draws at most every 80 ms: without a GPU, 60 frames a second take more than a core.
    const PERIOD_MS = 80;
    const request = window.requestAnimationFrame.bind(window);
    const waiting = new Map();
    let lastId = 0;
    let lastTime = -PERIOD_MS;
    const run = (time) => {
        lastTime = performance.now();
        const due = [...waiting.values()];
        waiting.clear();
        for (const act of due) {
            try { act(time); } catch (error) { reportError(error); }
        }
    };
    window.requestAnimationFrame = (act) => {
        if (waiting.size === 0) {
            const rest = lastTime + PERIOD_MS - performance.now();
            setTimeout(() => request(run), Math.max(0, rest));
        }
        waiting.set(++lastId, act);
        return lastId;
    };
    window.cancelAnimationFrame = (id) => waiting.delete(id);
})()"""

INTRO_SEEN = "localStorage.setItem('robot_ik.intro.seen', '1')"


@dataclass
class Window:
    """A browser window that shows the page.

    Attributes:
        page: Playwright's page.
        console: Lines of its console, with their types.
        requests: Addresses that it requested.
    """

    page: Any
    console: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def pixel(self, position: Any) -> tuple[float, float]:
        """Return the pixel of a point (3,) of the world, m."""
        x, y = self.page.evaluate(PIXEL, [float(value) for value in position])
        return x, y

    def blur(self) -> None:
        """Take the focus out of a text field: there, letters are no keys of the page."""
        self.page.evaluate("document.activeElement && document.activeElement.blur()")

    def leave_fields(self) -> None:
        """Take the focus out of a text field, and move the mouse over the 3D view."""
        self.blur()
        self.page.locator("canvas[data-engine]").hover()

    def open_tab(self, name: str) -> None:
        """Open a tab of the side panel."""
        self.page.get_by_role("tab", name=name, exact=True).click()

    def drag(
        self,
        position: Callable[[], Any],
        way: tuple[float, float],
        holds: Callable[[], bool],
        failure: str,
    ) -> None:
        """Drag what is drawn at a point of the world until ``holds()``.

        A press can miss where the browser draws late, so the drag is repeated.

        Args:
            position: Returns the point (3,), m.
            way: Pixels to the right and down.
            holds: The condition.
            failure: What is wrong if it never holds.
        """
        end = time.monotonic() + PAGE_TIMEOUT
        self.repeat_until(lambda: self._drag_once(position, way, end), holds, failure)

    def press(self, key: str, holds: Callable[[], bool], failure: str, on: Any = None) -> None:
        """Press a key until ``holds()``, with the focus ``on`` a widget or unchanged."""

        def press_once() -> None:
            if on is not None:
                on.focus()
            self.page.keyboard.press(key)

        self.repeat_until(press_once, holds, failure)

    def repeat_until(
        self, act: Callable[[], None], holds: Callable[[], bool], failure: str
    ) -> None:
        """Repeat an act until ``holds()``: a busy browser may have lost its connection."""
        end = time.monotonic() + PAGE_TIMEOUT
        while not holds():
            assert time.monotonic() < end, failure
            act()
            for _ in range(100):
                if holds():  # what holds may last some seconds only, as a notice
                    return
                self.page.wait_for_timeout(100)

    def wait_until(self, holds: Callable[[], bool], failure: str) -> None:
        """Wait until ``holds()``."""
        self.repeat_until(lambda: None, holds, failure)

    def errors(self) -> list[str]:
        """Return the errors and warnings of the console, without the harmless ones."""
        return [
            line
            for line in self.console
            if line.startswith(("error", "warning")) and not any(text in line for text in HARMLESS)
        ]

    def _drag_once(self, position: Callable[[], Any], way: tuple[float, float], end: float) -> None:
        """Drag once.

        viser needs a hover before a press, and the drawing may be older than the session. So the
        mouse hovers until the browser shows the cursor of a part that can be dragged.
        """
        mouse = self.page.mouse
        mouse.move(10, self.page.viewport_size["height"] - 10)
        self.page.wait_for_function(CURSOR, arg="auto")
        while True:
            begin = self.pixel(position())
            mouse.move(*begin)
            self.page.wait_for_timeout(300)
            if self.page.evaluate(CURSOR, "pointer"):
                break
            assert time.monotonic() < end, f"nothing to drag is drawn at {begin}"
            mouse.move(begin[0] + 1, begin[1])
        mouse.down()
        for k in range(1, 5):
            mouse.move(begin[0] + way[0] * k / 4, begin[1] + way[1] * k / 4)
            self.page.wait_for_timeout(60)
        mouse.up()


def open_window(
    chromium: Any,
    url: str,
    *,
    scene: bool,
    width: int = 1000,
    height: int = 560,
    first_visit: bool = False,
) -> Window:
    """Open the page, and wait for its panel, or for the 3D view too if ``scene``."""
    page = chromium.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(1e3 * PAGE_TIMEOUT)
    page.add_init_script(SLOW_FRAMES)
    if not first_visit:
        page.add_init_script(INTRO_SEEN)
    window = Window(page)
    page.on("console", lambda message: window.console.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: window.console.append(f"error: {error}"))
    page.on("request", lambda request: window.requests.append(request.url))
    page.goto(f"{url}{'&' if '?' in url else '?'}{COARSE}")
    page.get_by_role("button", name="STOP").wait_for()
    page.get_by_role("tab", name="Methods", exact=True).wait_for()
    if scene:
        page.wait_for_function(measure_page.DRAWN)
    return window
