"""Measure the processor time and the start of the testbed's page, beside the target values.

    python docs/make/measure_page.py [--seconds N]

It needs a quiet machine and the extra web. The rows of the start need Chromium and the extra dev
(playwright). The page runs in this process and the browsers in others, so the processor time is
that of the page. The rows of the start are those of `robot-ik view` with Chromium already open, and
with an empty cache of kernels. Ctrl-C keeps the finished rows.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any, Self
from urllib.parse import urlsplit

import msgspec
import numpy as np
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from benchmarks.quantity import Quantity
from benchmarks.quantity_table import show_quantities
from robot_ik.commands.terminal import say
from robot_ik.testbed.commands import Count, Start
from robot_ik.testbed.frontends.browser import Page
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.loop import run
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View

COUNT: Count = 4
"""Arms side by side in every row but those of the start."""
CHROMIUM = (
    "--no-sandbox",
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
)
"""Arguments of a Chromium that draws without a GPU and connects to nothing outside."""
DRAWN = """() => {
    const seen = window.__viserMutable, points = window.__viserTestpoints;
    return seen && points && seen.nodeRefFromName["/goal"]
        && points.rendererInfo.render.triangles > 2300;
}"""
"""JavaScript: whether viser's page shows the robot."""
_PORT = 8660
_TICKS = 600
_GOALS = 40  # ball moves of which the delay is taken
_QUIET = 0.15  # seconds without a moved robot: it has arrived
_PATIENCE = 180.0  # seconds for a kernel cache that is empty, on a slow machine
_PLACES = (-0.45, -0.3, 0.9), (-0.45, -0.27, 0.88)  # of the ball, in the PUMA's reach, metres


def measure_page(
    seconds: float = 10.0, say: Callable[[str], None] = lambda _: None
) -> Iterator[Quantity]:
    """Measure all rows, one after the other.

    Args:
        seconds: Time in which processor time and bytes are counted, s.
        say: Called with the name of each step.
    """
    say("running four arms")
    with Session(Start(count=COUNT)) as session:
        while session.busy or not session.ready:
            session.tick()
            time.sleep(0.01)
        yield _tick_and_view(session)
        yield from _running(session, seconds, say)
    yield from _starts(say)


def _tick_and_view(session: Session) -> Quantity:
    times = []
    for _ in range(_TICKS):
        begin = time.perf_counter()
        session.tick()
        session.view()
        times.append(time.perf_counter() - begin)
    return Quantity(
        "tick and view, four arms, tight loop", 1e3 * float(np.median(times)), "ms", 1.0
    )


def _running(session: Session, seconds: float, say: Callable[[str], None]) -> Iterator[Quantity]:
    """Measure the costs with one client and with two, and the delay of a dragged ball."""
    draws: list[float] = []
    stop = threading.Event()
    with Page(session, PageServer(port=_PORT)) as page, Watcher(page.url) as first:

        def draw(view: View) -> None:
            begin = time.perf_counter()
            page.draw(view)
            draws.append(time.perf_counter() - begin)

        loop = threading.Thread(target=run, args=(session, draw, stop), name="testbed-loop")
        loop.start()
        try:
            time.sleep(1.0)  # until the first messages to a new browser are sent
            draws.clear()
            say("one connected browser")
            alone_before, sent = _costs(first, seconds)
            times = 1e3 * np.array(draws)
            with Watcher(page.url) as second:
                time.sleep(1.0)
                say("two connected browsers")
                two, _ = _costs(second, seconds)
            alone_after, _ = _costs(first, seconds)
            say("dragging the ball")
            delays = 1e3 * np.array(first.drag())
        finally:
            stop.set()
            loop.join()
    alone = 0.5 * (alone_before + alone_after)
    rows = (
        ("draw, four arms, one client: median", np.median(times), "ms", 2.0),
        ("draw, four arms, one client: p99", np.percentile(times, 99), "ms", 4.0),
        ("the whole page, solved at 60 Hz, drawn at 30", 100.0 * alone, "% of a core", 10.0),
        ("a second browser", 100.0 * (two - alone), "% of a core", 5.0),
        ("on the wire to one browser", sent / 1000.0, "kB/s", 300.0),
        (
            "from a goal message to the packet with the moved arm: median",
            np.median(delays),
            "ms",
            40.0,
        ),
        (
            "from a goal message to the packet with the moved arm: p90",
            np.percentile(delays, 90),
            "ms",
            60.0,
        ),
    )
    for what, value, unit, limit in rows:
        yield Quantity(what, float(value), unit, limit)


def _costs(watcher: Watcher, seconds: float) -> tuple[float, float]:
    """Return the share of a core that this process uses, and the watcher's bytes per second."""
    watcher.received()
    clock = time.perf_counter()
    used = time.process_time()
    time.sleep(seconds)
    used = time.process_time() - used
    clock = time.perf_counter() - clock
    return used / clock, watcher.received() / clock


class Watcher:
    """A process that receives all messages of a page."""

    def __init__(self, url: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_watch, args=(url, other), daemon=True)
        self._process.start()
        other.close()
        self._pipe.recv()  # it shows the page

    def received(self) -> int:
        """Bytes since this was last asked."""
        self._pipe.send("received")
        return int(self._pipe.recv())

    def drag(self) -> list[float]:
        """Seconds from each of some ball moves to the packet in which a robot has moved."""
        self._pipe.send("drag")
        delays: list[float] = self._pipe.recv()
        return delays

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._pipe.close()
        self._process.join(10.0)


def _watch(url: str, pipe: Connection) -> None:
    """Run the process of a watcher, until its pipe closes."""
    received = 0
    with PageClient(url) as client:
        pipe.send("looking")
        while True:
            received += client.receive(0.05)[0]
            try:
                if not pipe.poll():
                    continue
                asked = pipe.recv()
            except (EOFError, OSError):
                return
            pipe.send(received if asked == "received" else _drag(client))
            received = 0


def _drag(client: PageClient) -> list[float]:
    rng = np.random.default_rng(0)
    delays = []
    for k in range(_GOALS + 2):
        client.drag_ball(_PLACES[k % 2])
        begin = time.perf_counter()
        while not client.receive(1.0)[1]:
            if time.perf_counter() - begin > 2.0:
                break
        delays.append(time.perf_counter() - begin)
        quiet = time.perf_counter()
        while time.perf_counter() - quiet < _QUIET:
            if client.receive(0.02)[1]:
                quiet = time.perf_counter()
            if time.perf_counter() - begin > 2.0:
                break  # a method that does not come to rest
        time.sleep(float(rng.uniform(0.0, 0.05)))  # at any moment between two drawings
    return delays[2:]  # the first two move the arms to the ball


class PageClient:
    """A client that behaves like a browser: it sends its camera and receives all messages."""

    def __init__(self, url: str) -> None:
        where = urlsplit(url)
        assert where.hostname is not None and where.port is not None
        opened = socket.create_connection((where.hostname, where.port), 20.0)
        opened.settimeout(None)
        self._socket = connect(
            f"ws://{where.netloc}/",
            sock=opened,
            origin=f"http://{where.netloc}",
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[arg-type, list-item]
            compression=None,
            max_size=None,
            max_queue=None,
            ping_interval=None,
        )
        self._channel = self._open_channel(where.netloc, where.hostname, where.port)
        self._channel_bytes = 0
        threading.Thread(target=self._read_channel, daemon=True).start()
        self._unpack = zstandard.ZstdDecompressor()
        self._coordinates: dict[str, bytes] = {}
        self._send(
            {
                "type": "ViewerCameraMessage",
                "wxyz": [1.0, 0.0, 0.0, 0.0],
                "position": [1.0, 1.0, 1.0],
                "fov": 0.7,
                "near": 0.01,
                "far": 100.0,
                "look_at": [0.0, 0.0, 0.0],
                "up_direction": [0.0, 0.0, 1.0],
                "image_height": 900,
                "image_width": 1440,
            }
        )

    @staticmethod
    def _open_channel(netloc: str, host: str, port: int) -> Any:
        """Connect to the page's own WebSocket."""
        opened = socket.create_connection((host, port), 20.0)
        opened.settimeout(None)
        return connect(
            f"ws://{netloc}/testbed/channel",
            sock=opened,
            origin=f"http://{netloc}",  # type: ignore[arg-type]
            compression=None,
            max_size=None,
            max_queue=None,
            ping_interval=None,
        )

    def _read_channel(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            for message in self._channel:
                self._channel_bytes += len(message)

    def _send(self, message: dict[str, Any]) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def drag_ball(self, position: tuple[float, float, float]) -> None:
        """Drags the ball of the first arm to a position in the scene, metres."""
        self._send(
            {
                "type": "SceneNodeDragMessage",
                "phase": "update",
                "name": "/robot/ball",
                "instance_index": 0,
                "start_position": list(position),
                "start_screen_pos": [0.5, 0.5],
                "end_position": list(position),
                "end_screen_pos": [0.5, 0.5],
                "button": "left",
                "modifier": None,
            }
        )

    def receive(self, timeout: float) -> tuple[int, bool]:
        """Bytes since the last call, and whether a robot moves in a packet within ``timeout`` s."""
        channel_bytes = self._channel_bytes
        self._channel_bytes = 0
        try:
            data = self._socket.recv(timeout=timeout)
        except TimeoutError:
            return channel_bytes, False
        assert isinstance(data, bytes)
        begin = 16 + int.from_bytes(data[8:16], "little")
        packet = msgspec.msgpack.decode(self._unpack.decompress(data[16:begin]))
        ends = (
            np.cumsum([-(-size // 8) * 8 for size in packet["binaryBufferLengths"]])
            + -(-begin // 8) * 8
        )
        moved = False
        for message in packet["messages"]:
            if (
                message["type"] != "SceneNodeUpdateMessage"
                or "batched_positions" not in message["updates"]
            ):
                continue
            if name := re.fullmatch(r"/robot/\d+_\d+", message["name"]):
                index = message["updates"]["batched_positions"]["__binary_index"]
                size = packet["binaryBufferLengths"][index]
                coordinates = data[ends[index] - -(-size // 8) * 8 :][:size]
                moved |= (
                    self._coordinates.get(name[0], coordinates) != coordinates
                )  # the first is where it stands
                self._coordinates[name[0]] = coordinates
        return channel_bytes + len(data), moved

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._socket.close()
        self._channel.close()


def _starts(say: Callable[[str], None]) -> Iterator[Quantity]:
    """Measure the seconds from the command to the robot in a browser and to the first answer."""
    with _browser() as (browser, why):
        say("starting the command")
        with tempfile.TemporaryDirectory() as empty:
            warm = _started(browser, {})
            say("starting it with no kernel compiled")
            cold = _started(browser, {"XDG_CACHE_HOME": empty})
    rows = (
        ("command to address printed, warm", warm[0], 5.0, ""),
        ("command to robot drawn in a running browser, warm", warm[1], 5.0, why),
        ("command to robot drawn, at home, with no kernel compiled", cold[1], 10.0, why),
        ("command to first answer, with no kernel compiled", cold[2], 45.0, ""),
    )
    for what, value, limit, note in rows:
        yield Quantity(what, value, "s", limit, missing=note)


@contextlib.contextmanager
def _browser() -> Iterator[tuple[Any, str]]:
    """Yield a running Chromium, or None and the reason."""
    path = find_chromium()
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        path = None
    if path is None:
        yield None, "it needs Chromium and playwright (extra dev)"
        return
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(CHROMIUM))
        yield browser, ""
        browser.close()


def find_chromium() -> str | None:
    """Return the path of Chromium, or None if it is not installed."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next((path for name in names if (path := shutil.which(name))), None)


def _started(browser: Any, environment: dict[str, str]) -> tuple[float, float, float]:
    """Return seconds to the address, to the robot in the browser (or NaN), to the first answer."""
    window = None if browser is None else browser.new_page(viewport={"width": 1440, "height": 900})
    arguments = [
        sys.executable,
        "-m",
        "robot_ik",
        "view",
        "--host",
        f"127.0.0.1:{_PORT}",
    ]
    begin = time.perf_counter()
    drawn = float("nan")
    child = subprocess.Popen(
        arguments,
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert child.stdout is not None
        matches = (re.search(r"http://\S+", line) for line in child.stdout)
        match = next(filter(None, matches), None)
        if match is None:
            raise ChildProcessError("robot-ik view ended without an address")
        address = time.perf_counter() - begin
        replies: list[float] = []
        waiting = threading.Thread(target=lambda: replies.append(_first_reply(match[0]) - begin))
        waiting.start()
        if window is not None:
            window.goto(match[0])
            window.wait_for_function(DRAWN, timeout=1e3 * _PATIENCE)
            drawn = time.perf_counter() - begin
            window.close()
        waiting.join()
    finally:
        child.send_signal(signal.SIGINT)
        child.communicate(timeout=60.0)
    return address, drawn, replies[0] if replies else float("inf")


def _first_reply(url: str) -> float:
    """Return the time at which a robot first moves; infinite if none moves."""
    with PageClient(url) as client, contextlib.suppress(ConnectionClosed):
        end = time.perf_counter() + _PATIENCE
        while time.perf_counter() < end:
            if client.receive(1.0)[1]:
                return time.perf_counter()
    return float("inf")


def main() -> int:
    """Print the table. Return 0 if every figure was measured and is within its limit, else 1."""
    parser = argparse.ArgumentParser(description="processor time and start of the testbed's page")
    parser.add_argument(
        "--seconds",
        type=float,
        default=10.0,
        help="time in which processor time and bytes are counted, s; three times",
    )
    asked = parser.parse_args()
    rows = list[Quantity]()
    try:
        for row in measure_page(asked.seconds, lambda text: say(text, "dim")):
            rows.append(row)  # one at a time: an interrupt keeps the finished rows
    finally:
        show_quantities("page", (("", row) for row in rows))
    return 0 if all(row.passed for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
