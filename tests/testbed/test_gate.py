"""The gate in front of the page, asked by raw sockets: who gets in, and which messages."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import math
import os
import random
import re
import socket
import struct
import threading
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from robot_ik.errors import CameraError
from robot_ik.jobs.testbed import arm_link
from robot_ik.testbed.commands import SetCount, Start
from robot_ik.testbed.session import Session, View, run
from tests.memory import resident_memory
from tests.testbed.conftest import Bed
from tests.waiting import LONG, wait_for

pytest.importorskip("viser", reason="needs the extra web")
from robot_ik.testbed.frontends.gate import BAD_LIMIT


class Browser:
    """As much of a browser as the gate can see."""

    def __init__(self, port: int, **headers: str | None) -> None:
        self.port = port
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=LONG)
        self.headers: dict[str, str | None] = {
            "Host": f"127.0.0.1:{port}",
            "Origin": f"http://127.0.0.1:{port}",
            "Connection": "Upgrade",
            "Upgrade": "websocket",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": base64.b64encode(os.urandom(16)).decode(),
            "Sec-WebSocket-Protocol": protocol(),
            **{name.replace("_", "-"): value for name, value in headers.items()},
        }

    def ask(self, path: str = "/") -> tuple[int, dict[str, str], bytes]:
        """Status, headers and the begin of the body."""
        lines = [f"{name}: {value}" for name, value in self.headers.items() if value is not None]
        self.socket.sendall(("\r\n".join([f"GET {path} HTTP/1.1", *lines]) + "\r\n\r\n").encode())
        data = b""
        while b"\r\n\r\n" not in data:
            piece = self.socket.recv(4096)
            if not piece:
                break
            data += piece
        head, _, body = data.partition(b"\r\n\r\n")
        first, *rest = head.decode("latin-1").split("\r\n")
        found = dict(line.split(": ", 1) for line in rest)
        return int(first.split()[1]), found, body

    def send(self, message: object) -> None:
        """One binary message, masked as browsers do."""
        data = message if isinstance(message, bytes) else msgspec.msgpack.encode(message)
        mask = os.urandom(4)
        size = len(data)
        head = struct.pack("!BB", 0x82, 0x80 | size) if size < 126 else struct.pack("!BBH", 0x82, 0xFE, size)
        if size >= 1 << 16:
            head = struct.pack("!BBQ", 0x82, 0xFF, size)
        self.socket.sendall(head + mask + bytes(b ^ mask[k % 4] for k, b in enumerate(data)))

    def open_page(self) -> Browser:
        """Connects as a page does: viser knows a browser from its first camera on."""
        assert self.ask()[0] == 101
        at = {
            "wxyz": [1.0, 0.0, 0.0, 0.0],
            "position": [1.0, 1.0, 1.0],
            "fov": 0.7,
            "near": 0.01,
            "far": 100.0,
        }
        up = {
            "look_at": [0.0, 0.0, 0.0],
            "up_direction": [0.0, 0.0, 1.0],
            "image_height": 90,
            "image_width": 160,
        }
        self.send({"type": "ViewerCameraMessage", **at, **up})
        return self

    def is_open(self) -> bool:
        """Whether the server has not closed it; what was sent is thrown away."""
        self.socket.settimeout(0.3)
        try:
            for _ in range(40):
                if not self.socket.recv(1 << 20):
                    return False
        except TimeoutError:
            return True
        except OSError:
            return False
        return True

    def close(self) -> None:
        self.socket.close()


def protocol() -> str:
    """What viser's page says it speaks."""
    import viser

    return f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def port(bed: Bed) -> int:
    return int(bed.page.server.get_port())


@pytest.fixture
def browser(bed: Bed, port: int) -> Iterator[Browser]:
    nobody_drives(bed)
    made = Browser(port).open_page()
    yield made
    made.close()


@pytest.mark.parametrize(
    ("headers", "wanted"),
    [
        ({}, 101),
        ({"Host": "localhost:PORT", "Origin": "http://localhost:PORT"}, 101),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": None}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Origin": "https://127.0.0.1:PORT"}, 403),
        ({"Origin": "http://localhost:PORT"}, 403),
        ({"Host": "evil.example:PORT", "Origin": "http://evil.example:PORT"}, 403),
        ({"Host": "127.0.0.1"}, 403),
        ({"Host": ""}, 403),
    ],
)
def test_only_pages_of_this_server_connect(port: int, headers: dict[str, str | None], wanted: int) -> None:
    given = {name: value and value.replace("PORT", str(port)) for name, value in headers.items()}
    assert asked(port, **given)[0] == wanted


def asked(port: int, **headers: str | None) -> tuple[int, dict[str, str], bytes]:
    """The answer to a connection."""
    browser = Browser(port, **headers)
    answer = browser.ask()
    browser.close()
    return answer


def page_of(port: int, path: str = "/", **headers: str | None) -> tuple[int, dict[str, str], bytes]:
    plain: dict[str, str | None] = {"Connection": "close", "Upgrade": None, "Origin": None}
    browser = Browser(port, **{**plain, **headers})
    answer = browser.ask(path)
    browser.close()
    return answer


def test_the_page_comes_with_headers_against_frames_and_outside_connections(port: int) -> None:
    status, headers, _ = page_of(port)
    assert status == 200 and headers["X-Frame-Options"] == "DENY"
    assert "connect-src 'self'" in headers["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]


def test_the_page_is_not_given_to_other_names_or_for_other_servers(port: int) -> None:
    status, _, body = page_of(port, Host="evil.example")
    assert status == 403 and b"--host-name" in body
    assert page_of(port, Origin="http://evil.example")[0] == 403
    assert page_of(port, "/?websocket=ws://evil.example")[0] == 400
    assert page_of(port, "/?a=1&websocket=ws%3A%2F%2Fevil.example")[0] == 400


def test_with_a_token_nothing_is_given_without_it(guarded: Any) -> None:
    port, token = int(guarded.server.get_port()), guarded.gate.token
    assert token in guarded.url
    assert page_of(port)[0] == 403
    assert page_of(port, "/?token=wrong")[0] == 403
    assert asked(port)[0] == 403
    status, headers, _ = page_of(port, f"/?token={token}")
    assert status == 303 and headers["Location"] == "/"
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie and f"robot_ik_{port}=" in cookie
    cookie = cookie.split(";")[0]
    assert page_of(port, Cookie=f"other=1; {cookie}")[0] == 200
    assert page_of(port, Cookie=cookie + "x")[0] == 403
    assert asked(port, Cookie=cookie)[0] == 101
    assert asked(port, Cookie=cookie, Origin="http://evil.example")[0] == 403


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "::", "robot.local"])
def test_a_host_that_others_reach_gets_a_token(host: str) -> None:
    from robot_ik.testbed.frontends.gate import is_loopback

    assert not is_loopback(host)
    assert all(is_loopback(name) for name in ("127.0.0.1", "localhost", "::1", "127.8.8.8"))


def uuid_of(bed: Bed, label: str) -> str:
    handles = bed.page.server.gui._gui_input_handle_from_uuid
    return next(uuid for uuid, handle in handles.items() if getattr(handle, "label", None) == label)


def nobody_drives(bed: Bed) -> None:
    """Waits until the server has noticed that the last driver is gone."""
    wait_for(lambda: bed.page.gate.driver is None)


def update(uuid: str, **updates: Any) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": uuid, "updates": updates}


def test_values_pass_and_attributes_do_not(bed: Bed, browser: Browser) -> None:
    speed, stop = uuid_of(bed, "Speed"), uuid_of(bed, "STOP")
    slider = bed.page.server.gui._gui_input_handle_from_uuid[speed]
    wrong = [
        update(speed, value=1e9), update(speed, value=-0.1), update(speed, value="fast"),
        update(speed, value=True), update(speed, max=100.0), update(speed, value=2.0, min=-5.0),
        update(stop, update_cb=[]), update(stop, disabled=True), update(stop, visible=False),
        update("nobody", value=1.0), update(uuid_of(bed, "Robot"), value="../etc"),
        update(speed, value=math.nan), {"type": "GuiUpdateMessage", "uuid": speed},
    ]  # fmt: skip
    before = bed.view.speed
    for message in wrong:
        browser.send(message)
    browser.send(update(speed, value=1.5))
    bed.until(lambda view: view.speed == 1.5, "the right value was lost")
    assert before == 1.0 and slider.max == 3.0 and slider.min == 0.0
    button = bed.page.server.gui._gui_input_handle_from_uuid[stop]
    assert button._impl.update_cb and not button.disabled
    browser.send(update(stop, value=True))
    bed.until(lambda view: not view.running, "the stop button was switched off")
    browser.send(update(uuid_of(bed, "Run"), value="Reset"))
    browser.send(update(speed, value=1.0))
    bed.until(lambda view: view.running and view.speed == 1.0)


def test_one_browser_drives_the_others_watch_and_stop_works_from_all(bed: Bed, browser: Browser) -> None:
    watcher = Browser(browser.port).open_page()
    speed = uuid_of(bed, "Speed")
    browser.send(update(speed, value=2.0))
    bed.until(lambda view: view.speed == 2.0)
    watcher.send(update(speed, value=0.5))
    watcher.send(update(uuid_of(bed, "STOP"), value=True))
    bed.until(lambda view: not view.running)
    assert bed.view.speed == 2.0
    browser.close()  # the driver leaves, and the next to act drives
    nobody_drives(bed)
    watcher.send(update(uuid_of(bed, "Run"), value="Reset"))
    watcher.send(update(speed, value=1.0))
    bed.until(lambda view: view.speed == 1.0 and view.running)
    watcher.close()


def drag(bed: Bed, phase: str, **changed: Any) -> dict[str, Any]:
    """A message of a mouse that drags the robot's last part."""
    name = bed.page._scene.bodies[-1][1].name
    return {
        "type": "SceneNodeDragMessage", "phase": phase, "name": name, "instance_index": 0,
        "start_position": [0.0, 0.0, 1.0], "start_screen_pos": [0.5, 0.5], "end_position": [0.1, 0.1, 1.0],
        "end_screen_pos": [0.5, 0.5], "button": "left", "modifier": None, **changed,
    }  # fmt: skip


def test_a_scene_that_changes_under_the_mouse_ends_the_drag(
    bed: Bed, browser: Browser, capfd: pytest.CaptureFixture[str]
) -> None:
    bed.until(lambda view: view.tick > 0 and not view.busy)  # what dragging needs is compiled
    browser.send(drag(bed, "start"))
    bed.until(lambda view: view.dragged, "the part was not dragged")
    bed.session.send(SetCount(2))
    bed.until(lambda view: view.count == 2 and not view.dragged, "the drag goes on in another scene")
    before = len(bed.sent)
    for phase in (*["update"] * 5, "end"):
        browser.send(drag(bed, phase))
    browser.send(update(uuid_of(bed, "Speed"), value=1.5))
    bed.until(lambda view: view.speed == 1.5)
    assert [type(command).__name__ for command in bed.sent[before:]] == ["SetSpeed"]
    assert "Traceback" not in "".join(capfd.readouterr())
    browser.send(update(uuid_of(bed, "Speed"), value=1.0))
    bed.session.send(SetCount(1))
    bed.until(lambda view: view.speed == 1.0 and view.count == 1)


def test_messages_to_what_is_gone_are_dropped_and_their_browser_is_not(bed: Bed, browser: Browser) -> None:
    """A method that changes takes away a slider that is being moved."""
    before = bed.page.gate.dropped["malformed"]
    for _ in range(2 * BAD_LIMIT):
        browser.send(update("taken-away", value=0.5))
        browser.send(drag(bed, "update", name="/robot/taken_away"))
        browser.send({"type": "CommandTriggerMessage", "uuid": "taken-away"})
    browser.send(update(uuid_of(bed, "Speed"), value=1.5))
    bed.until(lambda view: view.speed == 1.5, "the browser was dropped")
    assert bed.page.gate.dropped["malformed"] == before
    browser.send(update(uuid_of(bed, "Speed"), value=1.0))
    bed.until(lambda view: view.speed == 1.0)


def test_a_driver_who_is_lost_in_a_drag_lets_go(bed: Bed, browser: Browser) -> None:
    bed.until(lambda view: view.tick > 0 and not view.busy)  # what dragging needs is compiled
    browser.send(drag(bed, "start"))
    bed.until(lambda view: view.dragged, "the part was not dragged")
    browser.close()
    bed.until(lambda view: not view.dragged, "a lost browser still drags")


def test_a_camera_without_pictures_is_said_on_the_page_and_comes_back(bed: Bed) -> None:
    from robot_ik.testbed.frontends.browser import Page
    from robot_ik.testbed.frontends.page_server import PageServer

    seen = [CameraError("the cable <is> out"), None, (np.zeros((8, 8, 3), np.uint8), "a picture")]
    texts = ["the cable &lt;is&gt; out", "no scene", "a picture"]

    def read() -> Any:
        if isinstance(seen[0], Exception):
            raise seen[0]
        return seen[0]

    with Page(bed.session, PageServer(port=8612, shadows=False), camera=lambda: read) as page:
        page._camera.switch(True)
        for text in texts:
            wait_for(lambda text=text: text in page._camera._text.content, f"{text!r} is not said")
            seen.pop(0)
            seen += [None] * (not seen)
        page._camera.switch(False)
        assert "switch them on" in page._camera._text.content


def test_a_lost_page_and_a_page_that_hands_over_make_the_arm_hold(real_time: None) -> None:
    """By a real serial line; the page that drove is a browser whose connection breaks."""
    from robot_ik.testbed.frontends.browser import Page
    from robot_ik.testbed.frontends.page_server import PageServer

    link, stop = arm_link("tabletop_puma", None, "pty"), threading.Event()
    with (
        Session(Start("tabletop_puma"), arm=link) as session,
        Page(session, PageServer(port=8613, shadows=False)) as page,
    ):
        bed = Bed(session, page)
        loop = threading.Thread(target=run, args=(session, page.draw, stop), kwargs={"every": 4})
        loop.start()
        try:
            bed.until(lambda view: not view.busy and view.tick > 0)
            browser = Browser(int(page.server.get_port())).open_page()
            buttons = uuid_of(bed, "Arm")
            for lose in (browser.close, page.gate.hand_over):
                if lose is not browser.close:
                    browser = Browser(int(page.server.get_port())).open_page()
                browser.send(update(buttons, value="Follow"))
                bed.until(lambda view: arm_is("enabled", view), "it does not follow")
                lose()
                bed.until(
                    lambda view: arm_is("hold", view) and view.arm.mode == "hold",
                    "it goes on following a page that is gone",
                )
        finally:
            stop.set()
            loop.join()


def arm_is(state: str, view: View) -> bool:
    """Whether it is so; a fault ends the waiting."""
    if view.arm is None:
        return False
    assert view.arm.state != "fault", view.arm
    return view.arm.state == state


def test_the_share_tunnel_is_gone(bed: Bed, browser: Browser) -> None:
    from viser import _messages as vm

    assert vm.ShareUrlRequest not in bed.page.server._websock_server._incoming_handlers
    browser.send({"type": "ShareUrlRequest"})
    speed = uuid_of(bed, "Speed")
    browser.send(update(speed, value=1.25))
    bed.until(lambda view: view.speed == 1.25)
    browser.send(update(speed, value=1.0))
    bed.until(lambda view: view.speed == 1.0)


def rubbish(rng: random.Random, bed: Bed) -> object:
    """A message that no page sends."""
    from viser import _messages as vm

    kinds = [kind.__name__ for kind in vm.Message.get_subclasses()]
    handles = list(bed.page.server.gui._gui_input_handle_from_uuid)
    junk = [None, True, -1, 1e300, math.inf, "x", "é" * 2000, [], {}, [[[]]], {"value": 1}, b"\0\xff"]
    match rng.randrange(5):
        case 0:
            return rng.randbytes(rng.randrange(200))
        case 1:
            return rng.choice(junk)
        case 2:
            names = ("uuid", "name", "updates", "position", "wxyz", "phase", "part_count", "size_bytes")
            return {"type": rng.choice(kinds), **{name: rng.choice(junk) for name in rng.sample(names, 3)}}
        case 3:
            return update(
                rng.choice(handles), **{rng.choice(("update_cb", "_impl", "max")): rng.choice(junk)}
            )
    return update(rng.choice(handles), value=rng.choice([math.nan, [1], {"a": 1}, 1e300, b"x", "é" * 2000]))


def fuzz(bed: Bed, count: int, seed: int) -> None:
    rng, port = random.Random(seed), int(bed.page.server.get_port())
    browser = Browser(port).open_page()
    for k in range(count):
        try:
            browser.send(rubbish(rng, bed))
            if k % 50 == 0:
                browser.socket.settimeout(0.001)
                while browser.socket.recv(1 << 20):
                    pass
        except TimeoutError:
            browser.socket.settimeout(LONG)
        except OSError:  # dropped after too many
            browser = Browser(port).open_page()
    browser.close()


def test_fuzzed_messages_make_no_command_and_no_traceback(
    bed: Bed, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    watcher = Browser(int(bed.page.server.get_port())).open_page()
    before = len(bed.sent)
    fuzz(bed, 600, seed=1)
    assert bed.sent[before:] == []
    assert watcher.is_open(), "another connection was dropped"
    watcher.close()
    assert "Traceback" not in "".join(capfd.readouterr()) and "Traceback" not in caplog.text
    assert not re.search(r"ERROR", caplog.text)


@pytest.mark.soak
@pytest.mark.filterwarnings("ignore")
def test_memory_is_flat_under_ten_thousand_fuzzed_messages(
    bed: Bed, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("ERROR", "robot_ik")  # pytest keeps every record: 1 kB a message
    fuzz(bed, 10_000, seed=2)
    first = resident_memory()
    before = len(bed.sent)
    fuzz(bed, 10_000, seed=3)
    grown = resident_memory() - first
    assert bed.sent[before:] == []
    assert grown < 10.0, f"{grown:.1f} MB"


def test_a_websocket_key_is_answered_as_the_standard_says(port: int) -> None:
    browser = Browser(port)
    key = browser.headers["Sec-WebSocket-Key"] or ""
    _, headers, _ = browser.ask()
    wanted = hashlib.sha1((key + "258EAFA5-E914-47DA-95CA-C5AB0DC85B11").encode()).digest()
    assert headers["Sec-WebSocket-Accept"] == base64.b64encode(wanted).decode()
    browser.close()


def test_an_event_set_from_another_thread_wakes_all_who_wait() -> None:
    from robot_ik.testbed.frontends.gate import SharedEvent

    async def story() -> int:
        loop = asyncio.get_running_loop()
        event = SharedEvent(loop)
        waiters = [asyncio.ensure_future(event.wait()) for _ in range(20)]
        await asyncio.sleep(0.0)

        def other() -> None:
            event.set()
            loop.call_soon_threadsafe(event.set)  # as viser does

        thread = threading.Thread(target=other)
        thread.start()
        done, _ = await asyncio.wait(waiters, timeout=LONG)
        thread.join()
        return len(done)

    assert asyncio.run(story()) == 20
