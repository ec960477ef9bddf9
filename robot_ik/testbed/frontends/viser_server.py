"""Opens viser's server with the gate, the page's files and the page's channel in front of it.

viser calls ``websockets.asyncio.server.serve`` once, by its full name, while ``ViserServer`` is
made. ``open_server`` puts its own ``serve`` there during that call.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import io
import secrets
import socket
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import viser
import websockets.asyncio.server as ws_server
from viser import _messages as vm
from websockets.http11 import Response

from robot_ik.errors import ViewerError, install_command
from robot_ik.testbed.frontends.channel import Channel
from robot_ik.testbed.frontends.gate import Gate, is_loopback
from robot_ik.testbed.frontends.site import CHANNEL, path_of, site_answer

MAX_MESSAGE = 1 << 20
"""Bytes of a message of a browser. viser's own limit is 50 MiB."""

OPEN_TIMEOUT = 10.0
"""Seconds in which a browser must finish the handshake."""

MAX_QUEUE = 64
"""Messages of a browser that wait to be read."""

KEEPALIVE: Mapping[str, float] = {"ping_interval": 2.0, "ping_timeout": 4.0, "close_timeout": 1.0}
"""Seconds of the keepalive of a connection.

A broken connection is detected within their sum. Until then an arm follows its page. With viser's
default it takes 50 s. Browsers answer pings while a page is busy, so a slow page stays connected.
"""

_VISER = "1.1."
"""The version of viser on whose private functions this module relies."""

_LARGEST_PORT = (1 << 16) - 1


@dataclass(frozen=True)
class OpenedServer:
    """A running server.

    Attributes:
        viser: Draws the 3D view.
        gate: Checks requests and viser's messages.
        channel: The page's own connection.
    """

    viser: viser.ViserServer
    gate: Gate
    channel: Channel


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Suppress the lines that viser prints at the start and at the end."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


class SharedEvent(asyncio.Event):
    """An event that any thread may set.

    viser sets the event of its outgoing messages from the thread that draws. asyncio's own event
    then goes through waiters that the server's thread may be changing, which can raise.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._own_loop = loop

    def set(self) -> None:
        """Wake all waiters if this is the loop's thread. Else viser asks the loop to do so next."""
        self._value = True
        try:
            running = asyncio.get_running_loop()
        except RuntimeError:
            return
        if running is self._own_loop:
            for waiter in list(self._waiters):
                if not waiter.done():
                    waiter.set_result(True)


_PATCHING = threading.Lock()


@contextlib.contextmanager
def in_front_of_serve(gate: Gate, channel: Channel) -> Iterator[None]:
    """Put the gate in front of ``websockets.asyncio.server.serve`` during the block."""
    real_serve = ws_server.serve

    def serve(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Response | None:
            response = gate.answer(connection, request) or site_answer(request)
            if response is None and path_of(request) != CHANNEL:
                response = process_request(connection, request)
            if response is not None:
                for name, value in gate.headers.items():
                    if name not in response.headers:
                        response.headers[name] = value
            return response

        def handle(connection: Any) -> Any:
            if path_of(connection.request) == CHANNEL:
                return channel.serve(connection)
            return gate.guard(handler, connection)

        options |= {"max_size": MAX_MESSAGE, "open_timeout": OPEN_TIMEOUT, "max_queue": MAX_QUEUE}
        options |= KEEPALIVE
        return real_serve(handle, host, port, process_request=answer, **options)

    with _PATCHING:
        setattr(ws_server, "serve", serve)  # noqa: B010 (mypy: a module's function)
        try:
            yield
        finally:
            setattr(ws_server, "serve", real_serve)  # noqa: B010


def _require_address(host: str, port: int) -> None:
    """Check that an address can be used.

    viser binds on a thread of its own, and its constructor waits forever if that fails.

    Raises:
        ViewerError: The address cannot be used.
    """
    try:
        if not 0 < port <= _LARGEST_PORT:
            raise OSError(f"ports are 1 to {_LARGEST_PORT}")
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        family, kind, protocol, _, address = found[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:  # the next port is taken then
            raise ViewerError(
                f"cannot listen at {host}:{port}: {error.strerror or error}",
                hint="give another address or port: --host ADDR:PORT",
            ) from error


def open_server(
    host: str, port: int, token: bool, names: tuple[str, ...], framed_by: tuple[str, ...]
) -> OpenedServer:
    """Open a viser server behind a gate. Arguments and errors as for ``PageServer``."""
    if not viser.__version__.startswith(_VISER):
        raise ViewerError(
            f"the page is made for viser {_VISER}x, and {viser.__version__} is installed",
            hint=install_command("web"),
        )
    _require_address(host, port)
    is_asked = token or not is_loopback(host)
    gate = Gate(secrets.token_urlsafe(24) if is_asked else None, names, framed_by)
    channel = Channel(gate)
    with in_front_of_serve(gate, channel), quiet():
        server = viser.ViserServer(host=host, port=port, verbose=False)
    for kind in (vm.ShareUrlRequest, vm.ShareUrlDisconnect):  # no tunnel to the outside
        server._websock_server.unregister_handler(kind)
    buffer = server._websock_server._broadcast_buffer
    event = SharedEvent(buffer.event_loop)
    event.set()  # for the messages that were queued before
    buffer.message_event = event
    gate.watch(server)
    return OpenedServer(server, gate, channel)
