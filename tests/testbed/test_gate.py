"""The gate in front of the page, asked by raw sockets: who gets in, and which messages."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import json
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
from websockets.exceptions import ConnectionClosed

from robot_ik.errors import CameraError
from robot_ik.testbed.camera_picture import CameraPicture
from robot_ik.testbed.commands import COMMANDS, SetCount, SetRunning, Start
from robot_ik.testbed.filming import arm_link
from robot_ik.testbed.view import View
from tests.memory import resident_memory
from tests.testbed.channel_client import ChannelClient
from tests.testbed.conftest import Bed, running_bed
from tests.waiting import LONG, wait_for

pytest.importorskip("viser", reason="needs the extra web")
from robot_ik.testbed.frontends.actions import ACTIONS
from robot_ik.testbed.frontends.gate import BAD_LIMIT
from robot_ik.testbed.frontends.picture_message import HEADER


class Browser:
    """The part of a browser that the gate sees: raw requests and messages."""

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

    def request(self, path: str = "/") -> tuple[int, dict[str, str], bytes]:
        """Return status, headers and the beginning of the body of a response."""
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
        """Send one binary message, masked as browsers do."""
        data = message if isinstance(message, bytes) else msgspec.msgpack.encode(message)
        mask = os.urandom(4)
        size = len(data)
        head = (
            struct.pack("!BB", 0x82, 0x80 | size)
            if size < 126
            else struct.pack("!BBH", 0x82, 0xFE, size)
        )
        if size >= 1 << 16:
            head = struct.pack("!BBQ", 0x82, 0xFF, size)
        self.socket.sendall(head + mask + bytes(b ^ mask[k % 4] for k, b in enumerate(data)))

    def open_page(self) -> Browser:
        """Connect as a page does: viser registers a browser at its first camera message."""
        assert self.request()[0] == 101
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
        """Return whether the server keeps the connection. Received data is discarded."""
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
    """Return the WebSocket protocol that viser's page requests."""
    import viser

    return f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def port(bed: Bed) -> int:
    return int(bed.page.server.get_port())


@pytest.fixture
def browser(bed: Bed, port: int) -> Iterator[Browser]:
    wait_for_no_driver(bed)
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
def test_only_pages_of_this_server_connect(
    port: int, headers: dict[str, str | None], wanted: int
) -> None:
    given = {name: value and value.replace("PORT", str(port)) for name, value in headers.items()}
    assert asked(port, **given)[0] == wanted


def asked(port: int, **headers: str | None) -> tuple[int, dict[str, str], bytes]:
    """Return the response to a connection."""
    browser = Browser(port, **headers)
    answer = browser.request()
    browser.close()
    return answer


def page_of(port: int, path: str = "/", **headers: str | None) -> tuple[int, dict[str, str], bytes]:
    plain: dict[str, str | None] = {"Connection": "close", "Upgrade": None, "Origin": None}
    browser = Browser(port, **{**plain, **headers})
    answer = browser.request(path)
    browser.close()
    return answer


def test_the_page_comes_with_headers_against_frames_and_outside_connections(port: int) -> None:
    status, headers, _ = page_of(port)
    assert status == 200 and headers["X-Frame-Options"] == "DENY"
    assert "connect-src 'self'" in headers["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]


def test_the_page_is_not_given_to_other_names_or_for_other_servers(port: int) -> None:
    status, _, body = page_of(port, Host="evil.example")
    assert status == 403 and b"--host NAME" in body
    assert page_of(port, Origin="http://evil.example")[0] == 403
    assert page_of(port, "/?websocket=ws://evil.example")[0] == 400
    assert page_of(port, "/?a=1&websocket=ws%3A%2F%2Fevil.example")[0] == 400


def test_the_channel_is_behind_the_gate(port: int) -> None:
    for headers, wanted in (
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": None}, 403),
        ({"Host": "evil.example", "Origin": "http://evil.example"}, 403),
        ({"Sec_WebSocket_Protocol": None}, 101),
    ):
        browser = Browser(port, **headers)
        assert browser.request("/testbed/channel")[0] == wanted
        browser.close()


def test_files_of_the_page_are_given_and_no_others(port: int) -> None:
    for path in ("page.js", "page.css", "channel_worker.js", "thumbnails/puma560.png"):
        assert page_of(port, f"/testbed/{path}")[0] == 200
    for path in (
        "../gate.py",
        "..%2fgate.py",
        "%2e%2e/gate.py",
        "/etc/passwd",
        "page.js/",
        "",
        "page.py",
        "thumbnails/../page.js/../../gate.py",
        "channel",
    ):
        assert page_of(port, f"/testbed/{path}")[0] == 404


def test_with_a_token_nothing_is_given_without_it(guarded: Any) -> None:
    port = int(guarded.server.get_port())
    token = guarded.gate.token
    assert token in guarded.url
    assert page_of(port)[0] == 403
    assert page_of(port, "/?token=wrong")[0] == 403
    assert page_of(port, "/testbed/page.js")[0] == 403
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


def wait_for_no_driver(bed: Bed) -> None:
    """Wait until no page drives."""
    wait_for(lambda: bed.page.gate.driver.page is None)


@pytest.fixture
def page(bed: Bed) -> Iterator[ChannelClient]:
    """A page that drives as soon as it sends an action."""
    wait_for_no_driver(bed)
    with ChannelClient(bed.page.url) as made:
        made.until(lambda one: {"settings", "role"} <= set(one.latest))
        yield made
    wait_for_no_driver(bed)


@contextlib.contextmanager
def paired(bed: Bed) -> Iterator[tuple[Browser, ChannelClient]]:
    """A page with both of its sockets, as a browser has them."""
    gate = bed.page.gate
    before = set(gate.pages)
    with ChannelClient(bed.page.url) as channel:
        browser = Browser(int(bed.page.server.get_port())).open_page()
        key = wait_for(lambda: set(gate.pages) - before, "the gate does not know the page").pop()
        channel.send({"page": key})
        wait_for(lambda: bed.page.channel.has(key), "the page is not paired")
        yield browser, channel
        browser.close()


WRONG = (
    {"command": "set_speed", "speed": 1e9},
    {"command": "set_speed", "speed": -0.1},
    {"command": "set_speed", "speed": "fast"},
    {"command": "set_speed", "speed": True},
    {"command": "set_speed"},
    {"command": "set_speed", "speed": 2.0, "max": 5.0},
    '{"command": "set_speed", "speed": NaN}',
    {"command": "stop"},
    {"command": "set_motion", "motion": "joints"},
    {"action": "show_overlay", "on": "yes"},
    {"action": "show_overlay"},
    {"action": "exec", "code": "1"},
    {"action": "save_motion", "format": "exe"},
    {"action": "press_key", "code": "KeyX"},
    {"command": {"command": "reset"}},
    {"page": "somebody else"},
    {"page": 7},
    {"nothing": True},
    [1, 2],
    "{",
)
"""Messages that no page sends, fewer malformed ones than a connection may send."""


def test_right_messages_make_commands_and_wrong_ones_do_not(
    bed: Bed, page: ChannelClient, caplog: pytest.LogCaptureFixture
) -> None:
    before = len(bed.sent)
    for message in WRONG:
        page.send(message)
    page.command("set_speed", speed=1.5)
    bed.until(lambda view: view.speed == 1.5, "the right value was lost")
    assert [type(command).__name__ for command in bed.sent[before:]] == ["SetSpeed"]
    page.command("set_speed", speed=1.0)
    bed.until(lambda view: view.speed == 1.0)
    assert any("fast" in notice and "allowed" in notice for notice in page.notices)
    assert not caplog.records


def test_a_value_of_a_wrong_message_is_said_to_the_page_that_sent_it(
    bed: Bed, page: ChannelClient
) -> None:
    with ChannelClient(bed.page.url) as other:
        page.command("set_count", count=3)
        page.until(lambda one: one.notices, "no notice")
        assert "count" in page.notices[0]
        other.command("set_running", running=False)
        bed.until(lambda view: not view.running)
        assert other.notices == []
    page.command("set_running", running=True)
    bed.until(lambda view: view.running)


def test_one_page_drives_the_others_watch_and_stop_works_from_all(
    bed: Bed, page: ChannelClient
) -> None:
    with ChannelClient(bed.page.url) as watcher:
        page.command("set_speed", speed=2.0)
        bed.until(lambda view: view.speed == 2.0)
        page.until(lambda one: one.latest.get("role", {}).get("drives"), "the driver is not told")
        role = watcher.until(
            lambda one: one.latest.get("role", {}).get("driven") and one.latest["role"]
        )
        assert not role["drives"]
        before = len(bed.sent)
        watcher.command("set_speed", speed=0.5)
        watcher.action("press_key", code="KeyR")
        watcher.action("show_overlay", on=False)
        watcher.action("hand_over")
        watcher.command("set_running", running=True)
        watcher.until(lambda one: len(one.notices) >= 5, "a watcher is not told")
        assert all("STOP works" in notice for notice in watcher.notices)
        assert bed.sent[before:] == [] and page.latest["settings"]["overlay"]
        watcher.command("set_running", running=False)
        bed.until(lambda view: not view.running, "a watcher's STOP does nothing")
        page.close()  # the driver leaves, and the next to act drives
        wait_for_no_driver(bed)
        watcher.action("press_key", code="Space")
        watcher.command("set_speed", speed=1.0)
        bed.until(lambda view: view.speed == 1.0 and view.running)
        watcher.until(lambda one: one.latest.get("role", {}).get("drives"))


def test_a_watcher_may_save_files_and_place_its_camera(bed: Bed, page: ChannelClient) -> None:
    page.command("set_speed", speed=1.0)
    page.until(lambda one: one.latest.get("role", {}).get("drives"))
    with ChannelClient(bed.page.url) as watcher:
        watcher.action("fit_camera")
        watcher.action("report_graphics", software=True)
        watcher.action("save_log")
        watcher.until(lambda one: "testbed.jsonl" in one.files, "no log came")
        assert watcher.notices == [] and "testbed.jsonl" not in page.files


def test_the_driver_rule_holds_over_both_sockets(bed: Bed) -> None:
    bed.until(lambda view: view.tick > 0 and not view.busy)  # what dragging needs is compiled
    wait_for_no_driver(bed)
    with paired(bed) as (browser, channel), paired(bed) as (other, other_channel):
        channel.command("set_speed", speed=1.0)
        channel.until(lambda one: one.latest.get("role", {}).get("drives"))
        other.send(drag(bed, "start"))
        other_channel.until(lambda one: one.notices, "a watcher that drags is not told")
        assert bed.view.dragged == ""
        browser.send(drag(bed, "start"))
        bed.until(lambda view: view.dragged, "the driver cannot drag")
        browser.close()  # viser's page loses its connection, and its channel does not
        bed.until(lambda view: not view.dragged, "a lost browser still drags")
        assert channel.latest["role"]["drives"]
        channel.close()
        wait_for_no_driver(bed)


def test_a_page_cannot_take_the_place_of_another(bed: Bed) -> None:
    wait_for_no_driver(bed)
    with paired(bed) as (_, channel), ChannelClient(bed.page.url) as thief:
        channel.command("set_speed", speed=1.0)
        channel.until(lambda one: one.latest.get("role", {}).get("drives"))
        for guess in ("", "0" * 32, bed.page.gate.driver.page[:-1]):
            thief.send({"page": guess})
        thief.command("set_speed", speed=2.0)
        thief.until(lambda one: one.notices)
        assert bed.view.speed == 1.0


def drag(bed: Bed, phase: str, **changed: Any) -> dict[str, Any]:
    """A message of a mouse that drags the robot's last part."""
    name = bed.page._scene.bodies[-1][1].name
    return {
        "type": "SceneNodeDragMessage",
        "phase": phase,
        "name": name,
        "instance_index": 0,
        "start_position": [0.0, 0.0, 1.0],
        "start_screen_pos": [0.5, 0.5],
        "end_position": [0.1, 0.1, 1.0],
        "end_screen_pos": [0.5, 0.5],
        "button": "left",
        "modifier": None,
        **changed,
    }


def test_a_scene_that_changes_under_the_mouse_ends_the_drag(
    bed: Bed, browser: Browser, capfd: pytest.CaptureFixture[str]
) -> None:
    bed.until(lambda view: view.tick > 0 and not view.busy)  # what dragging needs is compiled
    browser.send(drag(bed, "start"))
    bed.until(lambda view: view.dragged, "the part was not dragged")
    bed.session.send(SetCount(2))
    bed.until(
        lambda view: view.count == 2 and not view.dragged, "the drag goes on in another scene"
    )
    before = len(bed.sent)
    for phase in (*["update"] * 5, "end"):
        browser.send(drag(bed, phase))
    scene_is_drawn(bed)
    browser.send(drag_of("/robot/ball"))
    wait_for(lambda: len(bed.sent) > before, "the ball stays")
    assert {type(command).__name__ for command in bed.sent[before:]} == {"MoveGoal"}
    assert "Traceback" not in "".join(capfd.readouterr())
    bed.session.send(SetCount(1))
    bed.until(lambda view: view.count == 1)


def test_messages_to_removed_nodes_are_dropped_and_their_browser_is_not(
    bed: Bed, browser: Browser
) -> None:
    """Another robot removes a part that is being dragged."""
    scene_is_drawn(bed)
    before = bed.page.gate.dropped["malformed"]
    for _ in range(2 * BAD_LIMIT):
        browser.send(drag(bed, "update", name="/robot/taken_away"))
        browser.send({"type": "GuiUpdateMessage", "uuid": "taken-away", "updates": {"value": 1}})
        browser.send({"type": "CommandTriggerMessage", "uuid": "taken-away"})
    sent = len(bed.sent)
    browser.send(drag_of("/robot/ball"))
    wait_for(lambda: len(bed.sent) > sent, "the browser was dropped")
    assert bed.page.gate.dropped["malformed"] == before


BALL = (-0.4, -0.3, 0.9)


def scene_is_drawn(bed: Bed) -> None:
    """Wait until the scene shows all robots of the session. Until then its nodes change."""
    wait_for(lambda: bed.page._scene.count == bed.view.count)


def drag_of(name: str) -> dict[str, Any]:
    """A message of a mouse that drags a node to ``BALL``."""
    position = list(BALL)
    return {
        "type": "SceneNodeDragMessage",
        "phase": "update",
        "name": name,
        "instance_index": 0,
        "start_position": position,
        "start_screen_pos": [0.5, 0.5],
        "end_position": position,
        "end_screen_pos": [0.5, 0.5],
        "button": "left",
        "modifier": None,
    }


def test_a_drag_ends_when_its_browser_is_lost(bed: Bed, browser: Browser) -> None:
    bed.until(lambda view: view.tick > 0 and not view.busy)  # what dragging needs is compiled
    browser.send(drag(bed, "start"))
    bed.until(lambda view: view.dragged, "the part was not dragged")
    browser.close()
    bed.until(lambda view: not view.dragged, "a lost browser still drags")


def test_a_camera_without_pictures_is_said_on_the_page_and_comes_back(bed: Bed) -> None:
    from robot_ik.testbed.frontends.browser import Page
    from robot_ik.testbed.frontends.page_server import PageServer

    picture = CameraPicture(np.zeros((8, 12, 3), np.uint8), ((7, 0.5, 0.1),), "a picture")
    results: list[Any] = [RuntimeError(), CameraError("the cable <is> out"), None, picture]
    notes = ["no picture: RuntimeError", "the cable <is> out", "no scene", "a picture"]

    def read() -> CameraPicture | None:
        if isinstance(results[0], Exception):
            raise results[0]
        return results[0]

    server = PageServer(port=8612, shadows=False)
    with (
        Page(bed.session, server, camera=lambda: read) as page,
        ChannelClient(page.url) as client,
    ):
        client.action("show_camera", on=True)
        for note in notes:
            client.until(
                lambda one, note=note: note in one.latest.get("camera", {}).get("note", ""), note
            )
            if len(results) > 1:
                results.pop(0)
        client.until(lambda one: one.pictures, "no picture came")
        number, _, width, height, *_ball = HEADER.unpack_from(client.pictures[0])
        assert (number, width, height) == (1, 12, 8)
        assert client.pictures[0][HEADER.size :].startswith(b"\xff\xd8"), "no JPEG"
        assert client.latest["camera"]["markers"] == [[7, 0.5, 0.1]]
        client.action("show_camera", on=False)
        client.until(lambda one: not one.latest["settings"]["camera"])


def test_a_page_gets_the_next_picture_when_it_has_shown_the_last(bed: Bed) -> None:
    channel = bed.page.channel
    with ChannelClient(bed.page.url) as slow, ChannelClient(bed.page.url) as quick:
        wait_for(lambda: channel.is_watched)
        quick.until(lambda one: "role" in one.latest)
        slow.until(lambda one: "role" in one.latest)
        for k in range(3):
            channel.send_picture(b"%d" % k)
            quick.until(lambda one, k=k: one.pictures and one.pictures[-1] == b"%d" % k)
            quick.send({"shown": k})
            quick.command("set_running", running=False)  # STOP: its effect shows that it was read
            bed.until(lambda view: not view.running)
            bed.session.send(SetRunning(True))
            bed.until(lambda view: view.running)
        assert slow.pictures == [b"0"]


def test_a_lost_page_and_a_page_that_hands_over_make_the_arm_hold(real_time: None) -> None:
    """The servos are behind a real serial line (pty)."""
    link = arm_link("tabletop_puma", None, "pty")
    with running_bed(Start("tabletop_puma"), 8613, link) as bed:
        bed.until(lambda view: not view.busy)
        for lose in (ChannelClient.close, lambda client: client.action("hand_over")):
            with ChannelClient(bed.page.url) as client:
                client.command("set_arm", state="follow")
                bed.until(lambda view: arm_is("enabled", view), "the arm does not follow")
                lose(client)
                bed.until(
                    lambda view: arm_is("hold", view) and view.arm.mode == "hold",
                    "the arm still follows after its page has left",
                )


def arm_is(state: str, view: View) -> bool:
    """Return whether the arm is in a state. A fault ends the waiting."""
    if view.arm is None:
        return False
    assert view.arm.state != "fault", view.arm
    return view.arm.state == state


def test_the_share_tunnel_is_gone(bed: Bed, browser: Browser) -> None:
    from viser import _messages as vm

    assert vm.ShareUrlRequest not in bed.page.server._websock_server._incoming_handlers
    scene_is_drawn(bed)
    sent = len(bed.sent)
    browser.send({"type": "ShareUrlRequest"})
    browser.send(drag_of("/robot/ball"))
    wait_for(lambda: len(bed.sent) > sent, "the browser was dropped")


JUNK = [None, True, -1, 1e300, math.inf, "x", "é" * 2000, [], {}, [[[]]], {"value": 1}]


def random_message(rng: random.Random) -> object:
    """A message that viser's page does not send."""
    from viser import _messages as vm

    kinds = [kind.__name__ for kind in vm.Message.get_subclasses()]
    match rng.randrange(3):
        case 0:
            return rng.randbytes(rng.randrange(200))
        case 1:
            return rng.choice([*JUNK, b"\0\xff"])
    names = ("uuid", "name", "updates", "position", "wxyz", "phase", "part_count", "size_bytes")
    fields = {name: rng.choice([*JUNK, b"\0\xff"]) for name in rng.sample(names, 3)}
    return {"type": rng.choice(kinds), **fields}


def random_channel_message(rng: random.Random) -> str | bytes:
    """A message that no page sends over the channel."""
    names = [*COMMANDS, *ACTIONS, "page", "shown", "é", ""]
    keys = ("speed", "on", "name", "value", "position", "instance", "index", "text", "kind")
    match rng.randrange(4):
        case 0:
            return rng.randbytes(rng.randrange(200))
        case 1:
            return json.dumps(rng.choice(JUNK))
        case 2:
            return "".join(chr(rng.randrange(1, 0x2FF)) for _ in range(rng.randrange(80)))
    fields = {key: rng.choice(JUNK) for key in rng.sample(keys, 3)}
    return json.dumps({rng.choice(("command", "action")): rng.choice(names), **fields})


def fuzz(bed: Bed, count: int, seed: int) -> None:
    """Send random messages over both sockets, and reconnect when a connection is dropped."""
    rng = random.Random(seed)
    port = int(bed.page.server.get_port())
    browser = Browser(port).open_page()
    client = ChannelClient(bed.page.url)
    for k in range(count):
        try:
            browser.send(random_message(rng))
            if k % 50 == 0:
                browser.socket.settimeout(0.001)
                while browser.socket.recv(1 << 20):
                    pass
        except TimeoutError:
            browser.socket.settimeout(LONG)
        except OSError:  # dropped after too many
            browser = Browser(port).open_page()
        try:
            client.send(random_channel_message(rng))
        except ConnectionClosed:
            client = ChannelClient(bed.page.url)
    browser.close()
    client.close()


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
    _, headers, _ = browser.request()
    wanted = hashlib.sha1((key + "258EAFA5-E914-47DA-95CA-C5AB0DC85B11").encode()).digest()
    assert headers["Sec-WebSocket-Accept"] == base64.b64encode(wanted).decode()
    browser.close()


def test_an_event_set_from_another_thread_wakes_all_waiters() -> None:
    from robot_ik.testbed.frontends.viser_server import SharedEvent

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
