"""A gate in front of viser's server: Host, Origin, token, headers, and a filter of every message.

viser 1.1 accepts a connection from any web page, and writes any attribute that a message names, so that one
message can switch a stop button off for good.  It calls ``websockets.asyncio.server.serve`` once, by its
full name, while ``ViserServer`` is made; ``open_server`` puts its own ``serve`` there for just that moment.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import gzip
import hmac
import http
import io
import ipaddress
import logging
import math
import secrets
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import viser
import websockets.asyncio.server as ws_server
from viser import _messages as vm
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Response

from robot_ik.errors import ViewerError, install_command

LOG = logging.getLogger(__name__)

MAX_MESSAGE = 1 << 20
"""Bytes; viser's own limit is 50 MiB."""
RATE, BURST = 400.0, 800.0
"""Messages a second of one browser; a drag sends 20, a slider 60."""
BAD_LIMIT = 20
"""Malformed messages after which a connection is dropped."""
_LARGEST = 1e9  # of any number in a message
_LONGEST = 1000  # characters of a text
_VISER = "1.1."

# An arm follows a page whose connection broke until that is noticed: within the sum of these, seconds.  By
# default it takes 50.  Browsers answer pings beside the page's own work, so a slow page is not a lost one.
KEEPALIVE: Mapping[str, float] = {"ping_interval": 2.0, "ping_timeout": 4.0, "close_timeout": 1.0}

# viser's page evaluates its own code in workers and from blobs; nothing outside is ever needed.
HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; "
    "connect-src 'self' data: blob:; frame-ancestors 'none'; form-action 'none'; base-uri 'none'",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


_NO_TOKEN = "open the address with its token, as printed at the start"


class Malformed(ValueError):
    """No page of ours sends such a message."""


def is_loopback(host: str) -> bool:
    """Whether a name or address means this machine only."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Gate:
    """Decides about every request before viser sees it, and about every message after.

    Args:
        token: Asked of every browser; None: of none.
        names: Further names under which this server may be called.

    Attributes:
        always: Widgets that a browser may use without driving: the stop button.
        driver: Number of the connection that drives; None: the next to act does.
        dropped: How many messages of each kind did not pass.
        on_refused: Called with (connection, message) of a browser that only watches.
        on_driver_left: Called when the driving page is gone, or hands over.
    """

    def __init__(self, token: str | None, names: tuple[str, ...] = ()) -> None:
        self.token, self.names = token, names
        self.always: set[str] = set()
        self.driver: int | None = None
        self.dropped: Counter[str] = Counter()
        self.on_refused: Callable[[Any, Mapping[str, Any]], None] = lambda connection, message: None
        self.on_driver_left: Callable[[], None] = lambda: None
        self._server: viser.ViserServer | None = None

    # ------------------------------------------------------------------------------------- requests

    def watch(self, server: viser.ViserServer) -> None:
        """From now on messages are compared with the widgets and nodes of this server."""
        self._server = server

    def _hosts(self, connection: Any) -> set[str]:
        """Values of the Host header that mean us.

        Loopback, names that were given, and the address that the connection came in at: an address cannot
        be made to point elsewhere, a foreign name can (DNS rebinding).
        """
        address, port = connection.transport.get_extra_info("sockname")[:2]
        came_in = f"[{address}]" if ":" in address else address
        names = {"localhost", "127.0.0.1", "[::1]", came_in, *self.names}
        return {f"{name}:{port}" for name in names} | (set(names) if port == 80 else set())

    def refusal(self, connection: Any, request: Any) -> str:
        """Why a request is refused, as text; empty when it may pass."""
        host = request.headers.get_all("Host")
        if len(host) != 1 or host[0].lower() not in self._hosts(connection):
            return (
                "this server is not known under that name: use its address, or start it with --host-name NAME"
            )
        upgrade = _is_upgrade(request)
        origin = request.headers.get_all("Origin")
        if (upgrade and not origin) or any(one.lower() != f"http://{host[0].lower()}" for one in origin):
            return "only pages of this server may connect"
        if upgrade and self.token and not self._right(self._cookie(connection, request)):
            return _NO_TOKEN
        return ""

    def _right(self, token: str) -> bool:
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
        """A response that ends the request here; None: viser goes on."""
        if why := self.refusal(connection, request):
            return _plain(http.HTTPStatus.FORBIDDEN, why)
        query = parse_qs(urlsplit(request.path).query)
        if "websocket" in query:  # viser's page would connect to a server of the link's choice
            return _plain(http.HTTPStatus.BAD_REQUEST, "this page connects to its own server only")
        if not self.token or _is_upgrade(request):
            return None
        if self._right(query.get("token", [""])[0]):  # into a cookie and out of the address bar
            cookie = f"{self._cookie_name(connection)}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            return _plain(http.HTTPStatus.SEE_OTHER, "", {"Location": "/", "Set-Cookie": cookie})
        if not self._right(self._cookie(connection, request)):
            return _plain(http.HTTPStatus.FORBIDDEN, _NO_TOKEN)
        return None

    # ------------------------------------------------------------------------------------- messages

    def passes(self, connection: Any, raw: object, budget: MessageBudget) -> bool:
        """Whether viser may see a message.

        Raises:
            Malformed: No page of ours sends it.
        """
        message = _decoded(raw)
        kind = message["type"]
        row = _CHECKS.get(kind)
        if not budget.take() or row is None:
            self.dropped[kind[:40]] += 1
            return False
        if not isinstance(raw, bytes):
            raise Malformed(kind)
        vm.Message.deserialize(raw)  # fields and their types as viser has them; it raises whatever it likes
        if self._server is None or not _finite(message):
            raise Malformed(kind)
        named, registry, check = row
        handle = attrgetter(registry)(self._server).get(message[named]) if registry else None
        if registry and handle is None:  # a change of method or robot takes some away
            self.dropped[f"{kind} to what is gone"] += 1
            return False
        if not check(handle, message):
            raise Malformed(kind)
        if kind == "ViewerCameraMessage" or message.get("uuid") in self.always:
            return True
        if self.driver is None:
            self.driver = id(connection)
        if self.driver != id(connection):
            self.dropped[f"{kind} of a watcher"] += 1
            self.on_refused(connection, message)
            return False
        return True

    def hand_over(self) -> None:
        """The next browser that acts drives."""
        self.driver = None
        self.on_driver_left()

    async def guard(self, handler: Callable[[Any], Any], connection: Any) -> None:
        """viser's handler with a filtered ``recv``; nothing that it raises gets out."""
        receive, budget, bad = connection.recv, MessageBudget(), 0

        async def recv() -> object:
            nonlocal bad
            while True:
                raw = await receive()
                try:
                    if self.passes(connection, raw, budget):
                        return raw
                except Exception as error:  # whatever decoders raise at rubbish
                    bad += 1
                    self.dropped["malformed"] += 1
                    if bad >= BAD_LIMIT:
                        LOG.warning("a browser was dropped after %d malformed messages (%s)", bad, error)
                        connection.transport.abort()  # a polite close waits 10 s for one who is silent
                        raise ConnectionError from None

        connection.recv = recv
        try:
            await handler(connection)
        except (ConnectionClosed, ConnectionError):
            pass
        except Exception as error:
            LOG.warning("a browser's connection ended: %s: %s", type(error).__name__, error)
        finally:
            connection.recv = receive
            if self.driver == id(connection):
                self.hand_over()


class MessageBudget:
    """How many messages a browser may still send: ``BURST`` at once, ``RATE`` a second."""

    def __init__(self) -> None:
        self._left, self._then = BURST, time.monotonic()

    def take(self) -> bool:
        """Uses one up; False: too many."""
        now = time.monotonic()
        self._left = min(BURST, self._left + RATE * (now - self._then))
        self._then = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


def _is_upgrade(request: Any) -> bool:
    return any("websocket" in one.lower() for one in request.headers.get_all("Upgrade"))


def _decoded(raw: object) -> dict[str, Any]:
    if not isinstance(raw, bytes):
        raise Malformed("text")
    message = msgspec.msgpack.decode(raw)
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise Malformed("no type")
    for field in ("uuid", "name"):
        if not isinstance(message.get(field, ""), str) or len(message.get(field, "")) > _LONGEST:
            raise Malformed(field)
    return message


def _finite(value: object) -> bool:
    """No NaN, no infinity, no absurd number anywhere."""
    if isinstance(value, float | int):
        return -_LARGEST < value < _LARGEST
    if isinstance(value, dict):
        return all(_finite(one) for one in value.values())
    return all(_finite(one) for one in value) if isinstance(value, list | tuple) else True


def _numbers(message: Mapping[str, Any], **sizes: int) -> bool:
    """Whether each field is a list of so many numbers; 0: one number."""
    for field, size in sizes.items():
        value = message.get(field)
        row = [value] if size == 0 else value
        if not isinstance(row, list) or len(row) != (size or 1):
            return False
        if not all(isinstance(one, float | int) and not isinstance(one, bool) for one in row):
            return False
    return True


def _camera(handle: Any, message: Mapping[str, Any]) -> bool:
    good = _numbers(message, wxyz=4, position=3, fov=0, near=0, far=0, look_at=3, up_direction=3)
    size = message.get("image_width"), message.get("image_height")
    if not good or not all(isinstance(one, int) and 0 <= one <= 100_000 for one in size):
        return False
    return 0.01 < math.sqrt(sum(one * one for one in message["wxyz"])) < 100.0


def _transform(handle: Any, message: Mapping[str, Any]) -> bool:
    return _numbers(message, wxyz=4, position=3)


def _name_alone(handle: Any, message: Mapping[str, Any]) -> bool:
    return True


def _drag(handle: Any, message: Mapping[str, Any]) -> bool:
    index = message.get("instance_index")
    if index is not None and not (isinstance(index, int) and 0 <= index < 4):
        return False
    return message.get("phase") in ("start", "update", "end") and _numbers(
        message, start_position=3, end_position=3, start_screen_pos=2, end_screen_pos=2
    )


def _value(handle: Any, message: Mapping[str, Any]) -> bool:
    """Whether a widget could have sent this value: viser itself takes any attribute, type and range."""
    updates = message.get("updates")
    if not isinstance(updates, dict) or set(updates) != {"value"}:
        return False
    value, now = updates["value"], handle.value
    if (options := getattr(handle, "options", None)) is not None:
        return isinstance(value, str) and value in options
    if isinstance(now, bool):
        return isinstance(value, bool)
    if isinstance(now, int | float):
        low, high = getattr(handle, "min", None), getattr(handle, "max", None)
        if not isinstance(value, int | float) or isinstance(value, bool):
            return False
        return (low is None or value >= low - 1e-9) and (high is None or value <= high + 1e-9)
    return isinstance(value, str) and isinstance(now, str) and len(value) < _LONGEST


_CONTROLS = "scene._handle_from_transform_controls_name"
_CHECKS: Mapping[str, tuple[str, str, Callable[[Any, Mapping[str, Any]], bool]]] = {
    "ViewerCameraMessage": ("", "", _camera),
    "CommandTriggerMessage": ("uuid", "gui._command_handle_from_uuid", _name_alone),
    "GuiUpdateMessage": ("uuid", "gui._gui_input_handle_from_uuid", _value),
    "TransformControlsUpdateMessage": ("name", _CONTROLS, _transform),
    "TransformControlsDragStartMessage": ("name", _CONTROLS, _name_alone),
    "TransformControlsDragEndMessage": ("name", _CONTROLS, _name_alone),
    "SceneNodeDragMessage": ("name", "scene._handle_from_node_name", _drag),
}
"""What a browser may send: the field that names a widget or node, where the server has these, and what must
hold of the message, given its widget or node.  Everything else is dropped unread."""


def _plain(status: http.HTTPStatus, text: str, headers: Mapping[str, str] | None = None) -> Response:
    """A short text that closes the connection."""
    body = (text + "\n").encode()
    fields = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
    fields |= {"Connection": "close", **HEADERS, **(headers or {})}
    return Response(status.value, status.phrase, Headers(fields), body)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """viser prints a banner at the start and a line at the end whatever one says; who calls this talks."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


class SharedEvent(asyncio.Event):
    """An event that any thread may set.

    viser sets the event of its outgoing messages from the thread that draws, and asyncio's own then goes
    through waiters that the server's thread may be changing: with two browsers that raises, now and then.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._own = loop

    def set(self) -> None:
        """On the loop's thread: wakes all that wait.  On others: viser asks the loop to do so next."""
        self._value = True
        try:
            here = asyncio.get_running_loop()
        except RuntimeError:
            return
        if here is self._own:
            for waiter in list(self._waiters):
                if not waiter.done():
                    waiter.set_result(True)


_SCRIPT = Path(__file__).with_name("connection.js")


def _add_connection_script(response: Response) -> None:
    """Put ``connection.js`` into viser's page; a response that is no page stays as it is."""
    headers = response.headers
    if response.body and headers.get("Content-Type", "").startswith("text/html"):
        response.body = _with_script(bytes(response.body), headers.get("Content-Encoding") == "gzip")
        del headers["Content-Length"]
        headers["Content-Length"] = str(len(response.body))


@functools.lru_cache(maxsize=2)  # the page of 0.8 MB as it is, and compressed
def _with_script(page: bytes, compressed: bool) -> bytes:
    """The page with the script at its end, compressed as before."""
    text = gzip.decompress(page) if compressed else page
    before, end, after = text.rpartition(b"</body>")
    text = before + b"<script>" + _SCRIPT.read_bytes() + b"</script>" + end + after
    return gzip.compress(text) if compressed else text


_PATCHING = threading.Lock()


@contextlib.contextmanager
def in_front_of_serve(gate: Gate) -> Iterator[None]:
    """``websockets.asyncio.server.serve`` with the gate in front, as long as the block runs."""
    real = ws_server.serve

    def serve(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def first_the_gate(connection: Any, request: Any) -> Response | None:
            response = gate.answer(connection, request)
            if response is None:
                response = process_request(connection, request)
                if response is not None:
                    _add_connection_script(response)
            for name, value in HEADERS.items() if response is not None else ():
                if name not in response.headers:
                    response.headers[name] = value
            return response

        options |= {"max_size": MAX_MESSAGE, "open_timeout": 10, "max_queue": 64, **KEEPALIVE}
        return real(
            lambda connection: gate.guard(handler, connection),
            host, port, process_request=first_the_gate, **options,
        )  # fmt: skip

    with _PATCHING:
        setattr(ws_server, "serve", serve)  # noqa: B010 (mypy: a module's function)
        try:
            yield
        finally:
            setattr(ws_server, "serve", real)  # noqa: B010


def _require_address(host: str, port: int) -> None:
    """viser binds on a thread of its own, and its constructor waits for ever where that fails.

    Raises:
        ViewerError: The address cannot be used.
    """
    try:
        if not 0 < port < 1 << 16:
            raise OSError(f"ports are 1 to {(1 << 16) - 1}")
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:  # the next port is taken then
            raise ViewerError(
                f"cannot listen at {host}:{port}: {error.strerror or error}",
                hint="give another --host or --port",
            ) from error


def open_server(host: str, port: int, token: bool, names: tuple[str, ...]) -> tuple[viser.ViserServer, Gate]:
    """A viser server behind a gate; arguments and errors as those of ``PageServer``."""
    if not viser.__version__.startswith(_VISER):
        raise ViewerError(
            f"the page is made for viser {_VISER}x, and {viser.__version__} is installed",
            hint=install_command("web"),
        )
    _require_address(host, port)
    gate = Gate(secrets.token_urlsafe(24) if token or not is_loopback(host) else None, names)
    with in_front_of_serve(gate), quiet():
        server = viser.ViserServer(host=host, port=port, verbose=False)
    for kind in (vm.ShareUrlRequest, vm.ShareUrlDisconnect):  # no tunnel to outside, whoever asks
        server._websock_server.unregister_handler(kind)
    buffer = server._websock_server._broadcast_buffer
    event = SharedEvent(buffer.event_loop)
    event.set()  # what was queued up to now
    buffer.message_event = event
    gate.watch(server)
    return server, gate
