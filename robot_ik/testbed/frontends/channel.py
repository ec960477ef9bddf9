"""The page's own WebSocket: views go out, commands and actions come in.

Messages are JSON, pictures are binary. This module does not interpret messages, so a page may
connect before there is a session.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import secrets
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
from websockets.asyncio.server import ServerConnection, broadcast
from websockets.exceptions import ConnectionClosed

from robot_ik.testbed.frontends.gate import Gate, Malformed, MessageBudget

LOG = logging.getLogger(__name__)

LONGEST_MESSAGE = 1_000_000
"""Characters of one message of a page. A mesh file is the longest."""

_KEY_BYTES = 16
"""Random bytes of the key of a page that has no connection to viser yet."""


@dataclass(eq=False)
class ChannelPage:
    """One page that is connected to the channel.

    Attributes:
        connection: Its WebSocket.
        key: Key of the page, the same as that of its connection to viser.
        is_free: Whether it has shown the last picture that was sent to it.
    """

    connection: ServerConnection
    key: str
    is_free: bool = True


class Channel:
    """The connections to all pages of one session.

    Args:
        gate: Holds the keys of the pages, and the driver.

    Attributes:
        receive: Called with a page and its message, on the server's thread.
        on_close: Called with the key of a page that has left the channel.
    """

    def __init__(self, gate: Gate) -> None:
        self.receive: Callable[[ChannelPage, dict[str, Any]], None] = _ignore
        self.on_close: Callable[[str], None] = gate.driver.leave
        self._gate = gate
        self._pages: list[ChannelPage] = []
        self._published: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        gate.driver.on_change = lambda: self._call(self._send_roles)

    @property
    def is_watched(self) -> bool:
        """Whether any page is connected."""
        return bool(self._pages)

    def has(self, key: str) -> bool:
        """Return whether the page of that key is connected to the channel."""
        return any(page.key == key for page in self._pages)

    async def serve(self, connection: ServerConnection) -> None:
        """Serve one page until it disconnects."""
        self._loop = asyncio.get_running_loop()
        page = ChannelPage(connection, secrets.token_hex(_KEY_BYTES))
        budget = MessageBudget()
        bad_count = 0
        try:
            with self._lock:
                published = dict(self._published)
            for name, content in published.items():
                await connection.send(_text({name: content}))
            self._pages.append(page)
            self._send_roles()
            async for raw in connection:
                try:
                    if budget.take():
                        self._take(page, raw)
                    else:
                        self._gate.dropped["too many for the channel"] += 1
                except Malformed as error:
                    bad_count += 1
                    self._gate.count_malformed(connection, bad_count, error)
        except (ConnectionClosed, ConnectionError):
            pass
        except Exception:
            LOG.exception("a page's channel ended")
        finally:
            if page in self._pages:
                self._pages.remove(page)
            self.on_close(page.key)
            self._send_roles()

    def _take(self, page: ChannelPage, raw: str | bytes) -> None:
        """Take one message of a page.

        Raises:
            Malformed: The page does not send such a message.
        """
        if not isinstance(raw, str) or len(raw) > LONGEST_MESSAGE:
            raise Malformed("no text, or too long")
        try:
            message = msgspec.json.decode(raw)
        except msgspec.DecodeError as error:
            raise Malformed(str(error)) from None
        if not isinstance(message, dict):
            raise Malformed("no object")
        if "page" in message:
            self._pair(page, message["page"])
        elif "shown" in message:
            page.is_free = True
        elif isinstance(message.get("command", message.get("action")), str):
            self.receive(page, message)
        else:
            raise Malformed("neither a command nor an action")

    def _pair(self, page: ChannelPage, key: object) -> None:
        """Give a page the key of its connection to viser."""
        if not isinstance(key, str) or key not in self._gate.pages:
            return  # that connection has just ended: the page sends the next key
        if key != page.key:
            self._gate.driver.rename(page.key, key)
            page.key = key
            self._send_roles()

    def _send_roles(self) -> None:
        """Send each page its role and the number of connected pages."""
        driver = self._gate.driver.page
        for page in self._pages:
            role = {
                "drives": driver == page.key,
                "driven": driver is not None,
                "pages": len(self._pages),
            }
            broadcast([page.connection], _text({"role": role}))

    def publish(self, name: str, content: Any) -> None:
        """Send a message to all pages, and to each that connects later."""
        with self._lock:
            self._published[name] = content
        self.broadcast({name: content})

    def publish_view(self, view: Mapping[str, Any]) -> None:
        """Send what has changed of a view, and all of it to each page that connects later."""
        with self._lock:
            before = self._published.get("view", {})
            self._published["view"] = view
        changed = {name: value for name, value in view.items() if before.get(name) != value}
        self.broadcast({"view": changed})

    def broadcast(self, message: Mapping[str, Any]) -> None:
        """Send a message to all pages, from any thread."""
        text = _text(message)
        self._call(lambda: broadcast([page.connection for page in self._pages], text))

    def send(self, key: str, message: Mapping[str, Any]) -> None:
        """Send a message to one page, from any thread."""
        text = _text(message)
        self._call(
            lambda: broadcast([page.connection for page in self._pages if page.key == key], text)
        )

    def send_file(self, key: str, name: str, content: bytes) -> None:
        """Let one page save a file, from any thread."""
        data = base64.b64encode(content).decode()
        self.send(key, {"file": {"name": name, "base64": data}})

    def send_picture(self, data: bytes) -> None:
        """Send a picture to every page that has shown the one before, from any thread."""
        self._call(lambda: self._broadcast_picture(data))

    def _broadcast_picture(self, data: bytes) -> None:
        waiting = [page for page in self._pages if page.is_free]
        for page in waiting:
            page.is_free = False
        broadcast([page.connection for page in waiting], data)

    def _call(self, act: Callable[[], None]) -> None:
        """Call a function on the server's thread."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the server is closed
                self._loop.call_soon_threadsafe(act)


def _ignore(_page: ChannelPage, _message: dict[str, Any]) -> None:
    """Ignore a message, as long as there is no session."""


def _text(message: Mapping[str, Any]) -> str:
    """Return a message as JSON. Numbers that are not finite become null."""
    return msgspec.json.encode(message).decode()
