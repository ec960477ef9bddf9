"""The page before there is a robot."""

from __future__ import annotations

import gzip
import http.client
import socket
import urllib.request

import pytest

pytest.importorskip("viser", reason="needs the extra web")
import viser

from robot_ik.commands.main import main
from robot_ik.testbed.commands import Start
from robot_ik.testbed.frontends import page_server
from robot_ik.testbed.frontends.browser import Page
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.session import Session
from tests.doc_pages import script
from tests.testbed.channel_client import ChannelClient
from tests.waiting import LONG, wait_for

PageClient = script("measure_page").PageClient


def test_the_address_for_other_machines_is_named_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(page_server, "own_address", lambda: "192.0.2.7")
    argv = "--robot tabletop_puma --seconds 0.1"
    for host, outside in (("0.0.0.0", True), ("127.0.0.1", False)):
        assert main(["view", "--host", f"{host}:8795", *argv.split()]) == 0
        said = capsys.readouterr().out
        assert "http://127.0.0.1:879" in said and ("http://192.0.2.7:879" in said) == outside
        assert said.count("token=") == 2 * outside


@pytest.mark.parametrize(
    ("host", "names"),
    [
        ("0.0.0.0", ("lab-pc", "lab-pc.local")),
        ("::", ("lab-pc", "lab-pc.local")),
        ("127.0.0.1", ()),
        ("::1", ()),
        ("Robot.example", ("robot.example",)),
    ],
)
def test_the_names_of_a_server_follow_from_its_address(
    host: str, names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "Lab-PC")
    assert page_server.host_names(host) == names


def test_a_server_at_every_address_answers_to_the_name_of_its_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "Lab-PC")
    with PageServer("0.0.0.0", 8790) as opened:
        port = opened.server.get_port()
        for name, status in (("lab-pc", 200), ("lab-pc.local", 200), ("evil.example", 403)):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=LONG)
            path = f"/?token={opened.gate.token}"
            connection.request("GET", path, headers={"Host": f"{name}:{port}"})
            reply = connection.getresponse()
            assert (reply.status == 403) == (status == 403), (name, reply.status)
            connection.close()


@pytest.mark.parametrize("allowed", [True, False])
def test_shadows_come_to_browsers_with_a_gpu_only(
    allowed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    lights: list[bool] = []
    monkeypatch.setattr(
        viser.SceneApi,
        "configure_default_lights",
        lambda self, enabled=True, cast_shadow=True: lights.append(cast_shadow),
    )
    server = PageServer(port=8790, shadows=allowed)
    with (
        Session(Start("tabletop_puma"), beside=False) as session,
        Page(session, server) as page,
        PageClient(page.url),
        ChannelClient(page.url) as client,
    ):
        assert lights == [False]
        key = wait_for(lambda: set(server.gate.pages)).pop()
        wait_for(lambda: server.client_of(key))
        client.send({"page": key})
        for software in (True, False):
            count = len(lights)
            client.action("report_graphics", software=software)
            wait_for(lambda count=count: len(lights) > count)
            assert lights[-1] is (allowed and not software)


@pytest.mark.parametrize("encoding", ["identity", "gzip"])
def test_the_page_is_visers_with_the_files_of_ours(encoding: str) -> None:
    with PageServer(port=8790) as opened:
        request = urllib.request.Request(opened.url, headers={"Accept-Encoding": encoding})
        with urllib.request.urlopen(request, timeout=LONG) as reply:
            body = reply.read()
            headers = reply.headers
    assert headers.get("Content-Encoding", "identity") == encoding
    assert int(headers["Content-Length"]) == len(body)
    page = gzip.decompress(body) if encoding == "gzip" else body
    assert page.count(b"/testbed/page.js") == 1 and page.rstrip().endswith(b"</html>")


def test_a_page_that_comes_before_the_session_gets_everything_later() -> None:
    server = PageServer(port=8790)
    with ChannelClient(server.url) as early:
        early.send({"command": "reset"})  # nothing can take it yet
        early.until(lambda one: "role" in one.latest)
        assert "program" not in early.latest
        with Session(Start("tabletop_puma"), beside=False) as session, Page(session, server):
            early.until(lambda one: {"program", "robot", "settings", "view"} <= set(one.latest))
            assert early.latest["robot"]["name"] == "tabletop_puma"
            assert len(early.latest["view"]["instances"][0]["joints"]) == 6
