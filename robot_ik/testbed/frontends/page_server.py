"""The page before there is a robot: a server behind its gate, an address, an empty scene.

It imports neither models nor solvers, so a browser loads the page while the program does.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket

import numpy as np
from viser import ClientHandle

from robot_ik.ports import Closing
from robot_ik.testbed.frontends.gate import open_server, quiet

_BRAND = (37, 99, 235)
_SHADOWS_AFTER = 4.0  # seconds of a browser with the page
# Cell, section and plane of the ground.
_LIGHT = ((222, 226, 232), (196, 202, 210), (246, 247, 249))
_DARK = ((52, 58, 68), (78, 86, 98), (26, 29, 34))


class PageServer(Closing):
    """What listens for browsers; a context manager.

    Args:
        host: Address to listen at; one that others can reach gets a token.
        port: The next free one is taken where it is busy.
        token: Ask for a token on loopback, too.
        names: Further names under which this machine is known.
        dark: Dark to begin with.
        shadows: Draw them; without a GPU the browser is quicker without.

    Attributes:
        server, gate: See ``open_server``.
        url: Where a browser finds the page, with its token if it needs one.
        url_outside: Where other machines find it; empty: nowhere, or ``url`` is it.
        dark: Whether it is.

    Raises:
        ViewerError: Another viser than 1.1, or the address cannot be used.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 8080,
        *,
        token: bool = False,
        names: tuple[str, ...] = (),
        dark: bool = False,
        shadows: bool = True,
    ) -> None:
        self.server, self.gate = open_server(host, port, token, names)
        query = f"?token={self.gate.token}" if self.gate.token else ""
        every = host in ("0.0.0.0", "::")
        outside, behind = own_address() if every else "", f":{self.server.get_port()}/{query}"
        self.url = f"http://{'127.0.0.1' if every else host}{behind}"
        self.url_outside = f"http://{outside}{behind}" if outside else ""
        with self.server.atomic():
            self.server.gui.set_panel_label("robot_ik testbed")
            self.server.scene.configure_environment_map("warehouse", environment_intensity=0.45)
            self.server.scene.configure_default_lights(cast_shadow=False)
            self.theme(dark)
        if shadows:
            self.server.on_client_connect(self._cast_shadows)

    async def _cast_shadows(self, client: ClientHandle) -> None:
        """Shadows come when the robot is there: without a GPU they take a browser more than a second."""

        def cast() -> None:
            if client.client_id in self.server.get_clients():
                client.scene.configure_default_lights(cast_shadow=True)

        asyncio.get_running_loop().call_later(_SHADOWS_AFTER, cast)

    def theme(self, dark: bool) -> None:
        """Panels, ground and background."""
        self.dark = dark
        self.server.gui.configure_theme(
            dark_mode=dark, show_logo=False, show_share_button=False, brand_color=_BRAND
        )
        cell, section, plane = _DARK if dark else _LIGHT
        self.server.scene.add_grid(
            "/ground", infinite_grid=True, cell_size=0.1, section_size=0.5, cell_color=cell,
            section_color=section, plane_color=plane, plane_opacity=1.0, shadow_opacity=0.35,
            fade_distance=9.0, fade_strength=1.5,
        )  # fmt: skip
        self.server.scene.set_background_image(np.full((2, 2, 3), plane, np.uint8), format="png")

    def close(self) -> None:
        """Stops the server."""
        with quiet():
            self.server.stop()


def own_address() -> str:
    """This machine's address in its network; empty where it is in none."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # of documentation: chooses the way there, and sends nothing
        return str(probe.getsockname()[0])
    return ""
