"""The page before there is a robot."""

from __future__ import annotations

import gzip
import time
import urllib.request

import pytest

pytest.importorskip("viser", reason="needs the extra web")
from viser._messages import EnableLightsMessage

from robot_ik.cli.main import main
from robot_ik.testbed.frontends import page_server
from robot_ik.testbed.frontends.page_server import PageServer
from tests.doc_pages import script
from tests.waiting import LONG, wait_for

PageClient = script("measure_page").PageClient


def _lights(opened: PageServer) -> list[bool]:
    """Whether lights cast shadows, in the order in which the browsers heard of it."""
    server = opened.server._websock_server
    buffers = [
        server._broadcast_buffer, *(one.message_buffer for one in server._client_state_from_id.values())
    ]  # fmt: skip
    messages = [message for buffer in buffers for message in list(buffer.message_from_id.values())]
    return [message.cast_shadow for message in messages if isinstance(message, EnableLightsMessage)]


def test_the_address_for_other_machines_is_named_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(page_server, "own_address", lambda: "192.0.2.7")
    argv = "--robot tabletop_puma --no-open --no-camera --viewer browser --seconds 0.1 --port 8795"
    for host, outside in (("0.0.0.0", True), ("127.0.0.1", False)):
        assert main(["view", "--host", host, *argv.split()]) == 0
        said = capsys.readouterr().out
        assert "http://127.0.0.1:879" in said and ("http://192.0.2.7:879" in said) == outside
        assert said.count("token=") == 2 * outside


def test_shadows_come_after_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a GPU they take a browser more than a second, in which it would show nothing."""
    monkeypatch.setattr(page_server, "_SHADOWS_AFTER", 0.2)
    with PageServer(port=8790) as opened:
        assert _lights(opened) == [False]
        with PageClient(opened.url):
            wait_for(lambda: _lights(opened) == [False, True], "no shadows")
    with PageServer(port=8790, shadows=False) as opened, PageClient(opened.url):
        time.sleep(0.4)
        assert _lights(opened) == [False]


@pytest.mark.parametrize("encoding", ["identity", "gzip"])
def test_the_page_carries_the_script_that_watches_the_connection(encoding: str) -> None:
    with PageServer(port=8790) as opened:
        request = urllib.request.Request(opened.url, headers={"Accept-Encoding": encoding})
        with urllib.request.urlopen(request, timeout=LONG) as reply:
            body, headers = reply.read(), reply.headers
    assert headers["Content-Encoding"] == encoding and int(headers["Content-Length"]) == len(body)
    page = gzip.decompress(body) if encoding == "gzip" else body
    assert page.count(b"connection-lost") == 1 and page.rstrip().endswith(b"</html>")
