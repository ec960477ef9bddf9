"""Rate and age of the pictures of live augmented reality, and their load on the session.

    python -m benchmarks.ar.live [--seconds 10] [--robot humanoid] [--browser]

The first row is the processor time of one picture, which depends least on other programs.
A session runs with its page in this process: the figure follows a ball that moves. A client in
another process takes the pictures of the synthetic camera, 640x480, as a page does. The session's
clock is measured without pictures and with them. With ``--browser`` Chromium shows the page, too.
The machine must be idle otherwise. Its load is printed.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np
from websockets.sync.client import connect

from docs.make.measure_page import CHROMIUM, find_chromium
from robot_ik.camera.target_files import parse_target
from robot_ik.robot import load_robot
from robot_ik.testbed.ar.camera import ArCamera
from robot_ik.testbed.ar.caption import Caption
from robot_ik.testbed.ar.late_registrar import LateRegistrar, RecentBoards
from robot_ik.testbed.ar.live import RATE_WINDOW
from robot_ik.testbed.ar.scene import ArScene
from robot_ik.testbed.ar.setup import ArDelay, ArSetup
from robot_ik.testbed.captions import caption_lines
from robot_ik.testbed.commands import RATE, MoveGoal, SetFigure, Start
from robot_ik.testbed.frontends.browser import Page
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.frontends.picture_message import HEADER, packed
from robot_ik.testbed.loop import run
from robot_ik.testbed.session import Session

PORT = 8790

MIN_RATE_HZ = 20.0
"""Smallest rate of pictures, per second."""

MAX_AGE_MS = 120.0
"""Largest median time from the camera's picture to the page."""

MIN_TICK_SHARE = 0.99
"""Smallest tick rate of the session with pictures, as a share of the rate without."""

_BALL_PERIOD = 6.0
"""Duration of one turn of the ball, s."""

_PICTURES = 120
"""Number of pictures whose processor time is measured."""

_SETTLE = 3.0
"""Time before a measurement, until the averaged rate contains only new pictures, s."""


@dataclass(frozen=True)
class Clock:
    """The session's clock over some seconds.

    Attributes:
        rate_hz: Ticks per second.
        p99_ms: 99th percentile of the time between two ticks.
    """

    rate_hz: float
    p99_ms: float


def watch(url: str, pipe: Connection) -> None:
    """Take pictures as a page does, and answer each message of the pipe with their ages.

    It runs in its own process.
    """
    place = urlsplit(url)
    origin: Any = f"http://{place.netloc}"
    ages: list[tuple[float, float]] = []
    address = f"ws://{place.netloc}/testbed/channel"
    with connect(address, origin=origin, compression=None, max_size=None) as socket:
        socket.send(msgspec.json.encode({"action": "show_ar", "on": True}).decode())
        pipe.send("open")
        while True:
            message = socket.recv()
            if isinstance(message, bytes):
                number, taken = HEADER.unpack_from(message)[:2]
                now = time.time()
                ages.append((now, now - taken))
                socket.send(msgspec.json.encode({"shown": number}).decode())
            if pipe.poll():
                if pipe.recv() == "end":
                    return
                pipe.send(ages)
                ages = []


@contextmanager
def served(robot: str) -> Iterator[tuple[Session, Page, list[float]]]:
    """Serve a page with a ball that moves. Yield the times of all ticks, too."""
    ticks: list[float] = []
    stop = threading.Event()
    with Session(Start(robot)) as session, Page(session, PageServer(port=PORT)) as page:
        real = session.tick

        def tick() -> None:
            now = time.perf_counter()
            ticks.append(now)
            angle = 2.0 * math.pi * now / _BALL_PERIOD
            if session.ready and len(ticks) % 6 == 0:
                ball = middle + 0.1 * extent * np.array((0.0, math.cos(angle), math.sin(angle)))
                x, y, z = ball.tolist()
                session.send(MoveGoal((x, y, z)))
            real()

        middle = np.array(session.ball.position)
        extent = float(load_robot(robot).model.stat.extent)
        session.tick = tick  # type: ignore[method-assign]
        loop = threading.Thread(target=run, args=(session, page.draw, stop))
        loop.start()
        try:
            while session.busy or not session.ready:
                time.sleep(0.1)
            if session.robot.file.figure is not None:
                session.send(SetFigure("active"))
                while session.view().figure is None:
                    time.sleep(0.1)
            yield session, page, ticks
        finally:
            stop.set()
            loop.join()


def clock_of(ticks: list[float], seconds: float) -> Clock:
    """Measure the session's clock for some seconds."""
    first = len(ticks)
    time.sleep(seconds)
    times = np.array(ticks[first:])
    gaps = np.diff(times)
    return Clock(1.0 / float(gaps.mean()), 1e3 * float(np.percentile(gaps, 99)))


def browser_row(url: str, seconds: float) -> tuple[float, float]:
    """Return pictures per second and their mean age in ms in Chromium without a GPU."""
    from playwright.sync_api import sync_playwright  # only this row needs it

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=list(CHROMIUM))
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.add_init_script("localStorage.setItem('robot_ik.intro.seen', '1')")
        page.goto(url)
        page.wait_for_function("document.querySelector('.rk-ar img')?.naturalWidth > 0")
        page.wait_for_timeout(1e3 * (seconds + _SETTLE))
        pane = page.locator(".rk-ar")
        rate = float(pane.get_attribute("data-rate") or "nan")
        age = float(pane.get_attribute("data-age") or "nan")
        browser.close()
    return rate, age


def processor_times(robot: str) -> dict[str, float]:
    """Return the median processor time of each step of a picture, ms."""
    session = Session(Start(robot), beside=False)
    session.tick()
    view = session.view()
    scene = ArScene(session.robot)
    caption = Caption()
    times: dict[str, list[float]] = {}

    def timed(name: str, step: Callable[[], Any]) -> Any:
        begin = time.process_time()
        result = step()
        times.setdefault(name, []).append(1e3 * (time.process_time() - begin))
        return result

    with ArCamera(ArSetup()) as camera:
        board = parse_target(ArSetup().board)
        tracker = RecentBoards(board, camera.intrinsics)
        registrar = LateRegistrar(tracker, scene.drawn, camera.intrinsics, ArDelay())
        qpos = scene.qpos(view.instances[0].q, np.array(view.ball.position))
        for number in range(_PICTURES):
            frame = timed("synthetic camera", camera.read)
            timed("tracking", lambda frame=frame: registrar.take(frame))
            done = timed("drawing", lambda frame=frame: registrar.composed(frame, qpos))
            image = done.image.copy()
            timed("text", lambda image=image: caption.write(image, caption_lines(view)))
            timed("JPEG", lambda image=image, number=number: packed(image, number, 0.0))
    session.close()
    return {name: float(np.median(values)) for name, values in times.items()}


def verdict(is_met: bool) -> str:
    """Return the text for a passed or failed limit."""
    return "within limit" if is_met else "NOT within limit"


def main() -> None:
    """Print all rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--robot", default="humanoid")
    parser.add_argument("--browser", action="store_true")
    options = parser.parse_args()
    seconds = options.seconds
    steps = processor_times(options.robot)
    texts = ", ".join(f"{name} {value:.1f}" for name, value in steps.items())
    total = sum(steps.values())
    print(f"processor time of one picture: {total:.1f} ms ({texts})")
    print(f"load of the machine: {os.getloadavg()[0]:.1f}, {os.cpu_count()} processors")
    with served(options.robot) as (_, page, ticks):
        time.sleep(_SETTLE)
        without = clock_of(ticks, seconds)
        pipe, client_pipe = multiprocessing.Pipe()
        context = multiprocessing.get_context("spawn")
        client = context.Process(target=watch, args=(page.url, client_pipe), daemon=True)
        client.start()
        pipe.recv()
        received = 0
        while received < RATE_WINDOW:  # all code is compiled, and the means are new
            time.sleep(0.5)
            pipe.send("ages")
            received += len(pipe.recv())
        used = time.process_time()
        beside = clock_of(ticks, seconds)
        share = (time.process_time() - used) / seconds
        pipe.send("ages")
        rows = np.array(pipe.recv())
        status = page.ar.live_status
        rate = (len(rows) - 1) / (rows[-1, 0] - rows[0, 0])
        ages = 1e3 * rows[:, 1]
        median = float(np.median(ages))
        slowest = float(np.percentile(ages, 90))
        is_steady = beside.rate_hz >= MIN_TICK_SHARE * without.rate_hz
        print(f"pictures per second: {rate:.1f}, {verdict(rate >= MIN_RATE_HZ)}")
        print(
            f"age at the page: median {median:.0f} ms, p90 {slowest:.0f} ms, "
            f"{verdict(median <= MAX_AGE_MS)}"
        )
        print(f"tracking {status.track_ms:.1f} ms, drawing {status.draw_ms:.1f} ms per picture")
        print(
            f"session's clock: {without.rate_hz:.1f} ticks/s (wanted {RATE}), p99 "
            f"{without.p99_ms:.1f} ms; with pictures {beside.rate_hz:.1f} ticks/s, p99 "
            f"{beside.p99_ms:.1f} ms, {verdict(is_steady)}"
        )
        print(f"processor of session, page and pictures: {100.0 * share:.0f} % of one core")
        if options.browser:
            shown_rate, shown_age = browser_row(page.url, seconds)
            print(f"in Chromium without a GPU: {shown_rate:.1f} pictures/s, {shown_age:.0f} ms old")
        pipe.send("end")
        client.join()


if __name__ == "__main__":
    main()
