"""The page before there is a robot: a server behind its gate, an address, an empty scene.

It imports neither models nor solvers, so a browser loads the page while the program does.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket

import numpy as np
from viser import ClientHandle

from robot_ik.ports import Closing
from robot_ik.testbed.frontends.viser_server import open_server, quiet

_BRAND = (37, 99, 235)

_LIGHT = ((222, 226, 232), (196, 202, 210), (246, 247, 249))
"""Colours of the ground: cell, section, plane."""

_DARK = ((52, 58, 68), (78, 86, 98), (26, 29, 34))
"""Likewise, dark."""

_EVERY_ADDRESS = ("0.0.0.0", "::")

_DOCUMENTATION_ADDRESS = ("192.0.2.1", 9)
"""Of RFC 5737. It selects a route; nothing is sent."""


class PageServer(Closing):
    """A server that listens for browsers.

    Args:
        host: Address to listen at. An address that other machines can reach gets a token.
        port: The next free port is taken if it is busy.
        token: Ask for a token on loopback, too.
        dark: Begin with dark colours.
        shadows: Draw shadows in browsers that have a GPU.
        framed_by: Origins whose pages may show the page in a frame.

    Attributes:
        server: viser's server.
        gate: Checks requests and viser's messages.
        channel: The page's own connection.
        url: Where a browser finds the page, with its token if it needs one.
        url_outside: Where other machines find it. Empty: nowhere, or ``url`` is it.
        dark: Whether colours are dark.
        shadows: Whether shadows may be drawn.

    Raises:
        ViewerError: Another viser than 1.1, or the address cannot be used.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 8080,
        *,
        token: bool = False,
        dark: bool = False,
        shadows: bool = True,
        framed_by: tuple[str, ...] = (),
    ) -> None:
        opened = open_server(host, port, token, host_names(host), framed_by)
        self.server = opened.viser
        self.gate = opened.gate
        self.channel = opened.channel
        self.shadows = shadows
        query = f"?token={self.gate.token}" if self.gate.token else ""
        is_every = host in _EVERY_ADDRESS
        outside = own_address() if is_every else ""
        ending = f":{self.server.get_port()}/{query}"
        name = f"[{host}]" if ":" in host else host
        self.url = f"http://{'127.0.0.1' if is_every else name}{ending}"
        self.url_outside = f"http://{outside}{ending}" if outside else ""
        with self.server.atomic():
            self.server.scene.configure_environment_map("warehouse", environment_intensity=0.45)
            self.server.scene.configure_default_lights(cast_shadow=False)
            self.theme(dark)
        self.server.on_client_connect(self._name_page)

    async def _name_page(self, client: ClientHandle) -> None:
        """Give the page its key as the name of an empty node. It repeats the key on the channel."""
        connection = self.server._websock_server._live_connections.get(client.client_id)
        client.scene.add_frame(f"/page/{self.gate.page_of(connection)}", show_axes=False)

    def client_of(self, key: str) -> ClientHandle | None:
        """Return viser's client of a page."""
        live = self.server._websock_server._live_connections
        for client in self.server.get_clients().values():
            if self.gate.page_of(live.get(client.client_id)) == key:
                return client
        return None

    def cast_shadows(self, key: str, *, on: bool) -> None:
        """Draw shadows on one page, or none."""
        client = self.client_of(key)
        if client is not None:
            client.scene.configure_default_lights(cast_shadow=on and self.shadows)

    def theme(self, dark: bool) -> None:
        """Set the colours of ground and background, and the scheme that the page follows."""
        self.dark = dark
        self.server.gui.configure_theme(
            dark_mode=dark, show_logo=False, show_share_button=False, brand_color=_BRAND
        )
        cell, section, plane = _DARK if dark else _LIGHT
        self.server.scene.add_grid(
            "/ground",
            infinite_grid=True,
            cell_size=0.1,
            section_size=0.5,
            cell_color=cell,
            section_color=section,
            plane_color=plane,
            plane_opacity=1.0,
            shadow_opacity=0.35,
            fade_distance=9.0,
            fade_strength=1.5,
        )
        background = np.full((2, 2, 3), plane, np.uint8)
        self.server.scene.set_background_image(background, format="png")

    def close(self) -> None:
        """Stop the server."""
        with quiet():
            self.server.stop()


def host_names(host: str) -> tuple[str, ...]:
    """Return the names under which browsers may call a server that listens at an address.

    These are the name that the address was given by or, of a server at every address, the names of
    this machine. A server can be called by its address, too.
    """
    if host in _EVERY_ADDRESS:
        name = socket.gethostname().lower()
        return (name, f"{name}.local")
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(host)
        return ()
    return (host.lower(),)


def own_address() -> str:
    """Return this machine's address in its network, empty without a network."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(_DOCUMENTATION_ADDRESS)
        return str(probe.getsockname()[0])
    return ""
