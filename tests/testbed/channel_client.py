"""A page without a browser: a client of the channel, and optionally of viser."""

from __future__ import annotations

import json
import logging
import socket
import threading
import time
from collections.abc import Callable
from typing import Any, Self
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.waiting import LONG

SILENT = logging.Logger("channel client", logging.CRITICAL)
"""The client would log an error when the server drops its connection."""

CONNECT_TIMEOUT = 20.0
"""Seconds. The server is in this process."""


class ChannelClient:
    """Receives all messages of the channel and keeps the latest of each kind.

    Args:
        url: Address of the page.

    Attributes:
        latest: Latest content of each message by its name; views are merged.
        notices: All notices.
        files: Content of files by name.
        pictures: Binary messages.
    """

    def __init__(self, url: str) -> None:
        place = urlsplit(url)
        assert place.hostname is not None and place.port is not None
        opened = socket.create_connection((place.hostname, place.port), CONNECT_TIMEOUT)
        opened.settimeout(None)
        self._socket = connect(
            f"ws://{place.netloc}/testbed/channel",
            sock=opened,
            origin=f"http://{place.netloc}",  # type: ignore[arg-type]
            compression=None,
            max_size=None,
            logger=SILENT,
        )
        self.latest: dict[str, Any] = {}
        self.notices: list[str] = []
        self.files: dict[str, str] = {}
        self.pictures: list[bytes] = []
        self.is_closed = False
        self._changed = threading.Condition()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        try:
            for raw in self._socket:
                with self._changed:
                    self._take(raw)
                    self._changed.notify_all()
        except ConnectionClosed:
            pass
        finally:
            with self._changed:
                self.is_closed = True
                self._changed.notify_all()

    def _take(self, raw: str | bytes) -> None:
        if isinstance(raw, bytes):
            self.pictures.append(raw)
            return
        for name, content in json.loads(raw).items():
            if name == "view":
                self.latest["view"] = {**self.latest.get("view", {}), **content}
            elif name == "notice":
                self.notices.append(content)
            elif name == "file":
                self.files[content["name"]] = content["base64"]
            else:
                self.latest[name] = content

    def until(self, holds: Callable[[Self], Any], failure: str = "the message never came") -> Any:
        """Return what ``holds`` returns once it is true. It is called after each message."""
        end = time.monotonic() + LONG
        with self._changed:
            while not (result := holds(self)):
                assert not self.is_closed, f"the channel was closed: {failure}"
                assert self._changed.wait(end - time.monotonic()), failure
            return result

    def send(self, message: Any) -> None:
        """Send a message as JSON, or a text as it is."""
        self._socket.send(message if isinstance(message, str | bytes) else json.dumps(message))

    def command(self, name: str, **values: Any) -> None:
        """Send a command of the command log."""
        self.send({"command": name, **values})

    def action(self, name: str, **values: Any) -> None:
        """Send an action, which is not in the command log."""
        self.send({"action": name, **values})

    def close(self) -> None:
        """Close the connection, as a closed page does."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
