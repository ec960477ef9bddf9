"""A gate in front of viser's server: it checks every request and every message.

viser 1.1 accepts a connection from any web page and writes any attribute that a message names. The
gate lets a message of viser's page pass only if it moves the camera or drags something. All other
controls use the page's own channel.
"""

from __future__ import annotations

import hmac
import http
import ipaddress
import logging
import math
import secrets
import time
from collections import Counter
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import viser
from viser import _messages as vm
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Response

from robot_ik.testbed.frontends.driver import Driver

LOG = logging.getLogger(__name__)

RATE = 400.0
"""Messages a second that one connection may send. A drag sends 20, a slider 60."""

BURST = 800.0
"""Messages that one connection may send at once."""

BAD_LIMIT = 20
"""Malformed messages after which a connection is dropped."""

_LARGEST_NUMBER = 1e9
"""Of any number in a message of viser's page."""

_LONGEST_NAME = 1000
"""Characters of the name of a node."""

_PAGE_KEY_BYTES = 16
"""Random bytes of a page's key. Other pages cannot guess it."""

LOOPBACK_PAGES = ("http://localhost:*", "http://127.0.0.1:*")
"""Origins of the pages that servers on this machine serve, a notebook server among them."""


def response_headers(framed_by: tuple[str, ...] = ()) -> dict[str, str]:
    """Return the headers of every response.

    viser's page evaluates its own code in workers and from blobs. It needs nothing from outside.

    Args:
        framed_by: Origins whose pages may show this page in a frame. A foreign page with such a
            frame could lead clicks to it, so by default there is none.
    """
    ancestors = " ".join(framed_by) or "'none'"
    headers = {
        "Content-Security-Policy": "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; "
        f"connect-src 'self' data: blob:; frame-ancestors {ancestors}; form-action 'none'; "
        "base-uri 'none'",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-store",
    }
    if not framed_by:
        headers["X-Frame-Options"] = "DENY"
    return headers


_NO_TOKEN = "open the address with its token, as printed at the start"
_WRONG_NAME = (
    "this server is not known under that name: use its address, or start it with --host NAME"
)


class Malformed(ValueError):
    """A message that the page does not send."""


def is_loopback(host: str) -> bool:
    """Return whether a name or address means this machine only."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Gate:
    """Decides about every request before viser gets it, and about every message after.

    Args:
        token: Token that every browser must send. None: no token is needed.
        names: Further names under which this server may be called.
        framed_by: Origins whose pages may show the page in a frame.

    Attributes:
        headers: Of every response.
        driver: Which page may change the session.
        dropped: How many messages of each kind did not pass.
        pages: Keys of the pages that are connected to viser.
        on_watcher: Called with the key of a page that does not drive and tried to drag.
        on_close: Called with the key of a page whose connection to viser has ended.
    """

    def __init__(
        self, token: str | None, names: tuple[str, ...] = (), framed_by: tuple[str, ...] = ()
    ) -> None:
        self.headers = response_headers(framed_by)
        self.token = token
        self.names = names
        self.driver = Driver()
        self.dropped: Counter[str] = Counter()
        self.pages: set[str] = set()
        self.on_watcher: Callable[[str], None] = _ignore
        self.on_close: Callable[[str], None] = self.driver.leave
        self._keys: dict[int, str] = {}
        self._server: viser.ViserServer | None = None

    def watch(self, server: viser.ViserServer) -> None:
        """Compare messages with the nodes of this server from now on."""
        self._server = server

    def page_of(self, connection: object) -> str:
        """Return the key of the page that a connection to viser belongs to."""
        return self._keys.get(id(connection), "")

    def _hosts(self, connection: Any) -> set[str]:
        """Return the values of the Host header that mean this server.

        These are loopback, the given names, and the address at which the connection came in. A
        foreign site can make its name point here (DNS rebinding), but not an address.
        """
        address, port = connection.transport.get_extra_info("sockname")[:2]
        came_in = f"[{address}]" if ":" in address else address
        names = {"localhost", "127.0.0.1", "[::1]", came_in, *self.names}
        return {f"{name}:{port}" for name in names} | (set(names) if port == 80 else set())

    def refusal(self, connection: Any, request: Any) -> str:
        """Return why a request is refused, empty if it may pass."""
        host = request.headers.get_all("Host")
        if len(host) != 1 or host[0].lower() not in self._hosts(connection):
            return _WRONG_NAME
        upgrade = _is_upgrade(request)
        origins = request.headers.get_all("Origin")
        is_foreign = any(origin.lower() != f"http://{host[0].lower()}" for origin in origins)
        if is_foreign or (upgrade and not origins):
            return "only pages of this server may connect"
        if upgrade and self.token and not self._matches(self._cookie(connection, request)):
            return _NO_TOKEN
        return ""

    def _matches(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), (self.token or "").encode())

    def _cookie_name(self, connection: Any) -> str:
        # Browsers do not distinguish cookies of different ports.
        return f"robot_ik_{connection.transport.get_extra_info('sockname')[1]}"

    def _cookie(self, connection: Any, request: Any) -> str:
        wanted = self._cookie_name(connection)
        for line in request.headers.get_all("Cookie"):
            for part in line.split(";"):
                name, _, value = part.strip().partition("=")
                if name == wanted:
                    return str(value)
        return ""

    def answer(self, connection: Any, request: Any) -> Response | None:
        """Return a response that ends the request here, or None if it may pass."""
        if reason := self.refusal(connection, request):
            return _plain(http.HTTPStatus.FORBIDDEN, reason)
        query = parse_qs(urlsplit(request.path).query)
        if "websocket" in query:  # viser's page would connect to a server of the link's choice
            reason = "this page connects to its own server only"
            return _plain(http.HTTPStatus.BAD_REQUEST, reason)
        if not self.token or _is_upgrade(request):
            return None
        if self._matches(query.get("token", [""])[0]):  # into a cookie, out of the address bar
            name = self._cookie_name(connection)
            cookie = f"{name}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            headers = {"Location": "/", "Set-Cookie": cookie}
            return _plain(http.HTTPStatus.SEE_OTHER, "", headers)
        if not self._matches(self._cookie(connection, request)):
            return _plain(http.HTTPStatus.FORBIDDEN, _NO_TOKEN)
        return None

    def passes(self, page: str, raw: object, budget: MessageBudget) -> bool:
        """Return whether viser may get a message.

        Args:
            page: Key of the page that sent it.
            raw: The message.
            budget: Of its connection.

        Raises:
            Malformed: The page does not send such a message.
        """
        message = _decoded(raw)
        kind = message["type"]
        row = _CHECKS.get(kind)
        if not budget.take() or row is None:
            self.dropped[kind[:40]] += 1
            return False
        if not isinstance(raw, bytes):
            raise Malformed(kind)
        vm.Message.deserialize(raw)  # checks names and types of fields; raises any exception
        if self._server is None or not _finite(message):
            raise Malformed(kind)
        registry, check = row
        if registry and attrgetter(registry)(self._server).get(message.get("name")) is None:
            self.dropped[f"{kind} to a removed node"] += 1  # another robot removes nodes
            return False
        if not check(message):
            raise Malformed(kind)
        if kind == "ViewerCameraMessage" or self.driver.admits(page):
            return True
        self.dropped[f"{kind} of a watcher"] += 1
        self.on_watcher(page)
        return False

    async def guard(self, handler: Callable[[Any], Any], connection: Any) -> None:
        """Run viser's handler with a filtered ``recv``. It raises nothing."""
        page = secrets.token_hex(_PAGE_KEY_BYTES)
        self._keys[id(connection)] = page
        self.pages.add(page)
        receive = connection.recv
        budget = MessageBudget()
        bad_count = 0

        async def recv() -> object:
            nonlocal bad_count
            while True:
                raw = await receive()
                try:
                    if self.passes(page, raw, budget):
                        return raw
                except Exception as error:  # decoders raise any exception
                    bad_count += 1
                    self.count_malformed(connection, bad_count, error)

        connection.recv = recv
        try:
            await handler(connection)
        except (ConnectionClosed, ConnectionError):
            pass
        except Exception as error:
            LOG.warning("a browser's connection ended: %s: %s", type(error).__name__, error)
        finally:
            connection.recv = receive
            del self._keys[id(connection)]
            self.pages.discard(page)
            self.on_close(page)

    def count_malformed(self, connection: Any, count: int, error: Exception) -> None:
        """Drop a connection after too many malformed messages.

        Raises:
            ConnectionError: The connection was dropped.
        """
        self.dropped["malformed"] += 1
        if count >= BAD_LIMIT:
            LOG.warning("a browser was dropped after %d malformed messages (%s)", count, error)
            # A polite close waits 10 s for a browser that does not answer.
            connection.transport.abort()
            raise ConnectionError from None


class MessageBudget:
    """Limits the messages of a connection to ``BURST`` at once and ``RATE`` a second."""

    def __init__(self) -> None:
        self._left = BURST
        self._time = time.monotonic()

    def take(self) -> bool:
        """Use one message up. Return False if there were too many."""
        now = time.monotonic()
        self._left = min(BURST, self._left + RATE * (now - self._time))
        self._time = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


def _ignore(_page: str) -> None:
    """Do nothing: there is no session yet."""


def _is_upgrade(request: Any) -> bool:
    return any("websocket" in value.lower() for value in request.headers.get_all("Upgrade"))


def _decoded(raw: object) -> dict[str, Any]:
    if not isinstance(raw, bytes):
        raise Malformed("text")
    message = msgspec.msgpack.decode(raw)
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise Malformed("no type")
    name = message.get("name", "")
    if not isinstance(name, str) or len(name) > _LONGEST_NAME:
        raise Malformed("name")
    return message


def _finite(value: object) -> bool:
    """Return whether no number in a value is NaN, infinite or absurd."""
    if isinstance(value, float | int):
        return -_LARGEST_NUMBER < value < _LARGEST_NUMBER
    if isinstance(value, dict):
        return all(_finite(item) for item in value.values())
    return all(_finite(item) for item in value) if isinstance(value, list | tuple) else True


def _numbers(message: Mapping[str, Any], **sizes: int) -> bool:
    """Return whether each field is a list of that many numbers; 0 stands for one number."""
    for field, size in sizes.items():
        value = message.get(field)
        row = [value] if size == 0 else value
        if not isinstance(row, list) or len(row) != (size or 1):
            return False
        if not all(isinstance(item, float | int) and not isinstance(item, bool) for item in row):
            return False
    return True


def _camera(message: Mapping[str, Any]) -> bool:
    vectors = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}
    if not _numbers(message, fov=0, near=0, far=0, **vectors):
        return False
    for side in ("image_width", "image_height"):
        pixels = message.get(side)
        if not isinstance(pixels, int) or not 0 <= pixels <= 100_000:
            return False
    return 0.01 < math.sqrt(sum(part * part for part in message["wxyz"])) < 100.0


def _transform(message: Mapping[str, Any]) -> bool:
    return _numbers(message, wxyz=4, position=3)


def _name_alone(message: Mapping[str, Any]) -> bool:  # noqa: ARG001 (a check of _CHECKS)
    return True


def _is_instance(index: object) -> bool:
    """Return whether a node of the scene may have such an instance."""
    return index is None or (isinstance(index, int) and 0 <= index < 4)


def _drag(message: Mapping[str, Any]) -> bool:
    if not _is_instance(message.get("instance_index")):
        return False
    return message.get("phase") in ("start", "update", "end") and _numbers(
        message, start_position=3, end_position=3, start_screen_pos=2, end_screen_pos=2
    )


def _click(message: Mapping[str, Any]) -> bool:
    return _is_instance(message.get("instance_index")) and _numbers(
        message, ray_origin=3, ray_direction=3, screen_pos=2
    )


_CONTROLS = "scene._handle_from_transform_controls_name"
_NODES = "scene._handle_from_node_name"
_CHECKS: Mapping[str, tuple[str, Callable[[Mapping[str, Any]], bool]]] = {
    "ViewerCameraMessage": ("", _camera),
    "TransformControlsUpdateMessage": (_CONTROLS, _transform),
    "TransformControlsDragStartMessage": (_CONTROLS, _name_alone),
    "TransformControlsDragEndMessage": (_CONTROLS, _name_alone),
    "SceneNodeDragMessage": (_NODES, _drag),
    "SceneNodeClickMessage": (_NODES, _click),
}
"""What viser's page may send: where the server has the node that the message names, and a check of
the message. All other messages are dropped unread."""


def _plain(
    status: http.HTTPStatus, text: str, headers: Mapping[str, str] | None = None
) -> Response:
    """Return a short text that closes the connection."""
    body = (text + "\n").encode()
    fields = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
    fields |= {"Connection": "close", **response_headers(), **(headers or {})}
    return Response(status.value, status.phrase, Headers(fields), body)
