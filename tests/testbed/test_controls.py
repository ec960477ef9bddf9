"""Every control of the page, moved as a browser moves it, does something."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs the extra web")
from robot_ik.robot import load_robot
from robot_ik.testbed.commands import Command, SetRobot, Start
from robot_ik.testbed.frontends.browser import Page
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.frontends.panels import joint_bars
from robot_ik.testbed.session import Session
from tests.doc_pages import script
from tests.waiting import LONG, wait_for

PageClient = script("measure_page").PageClient

ELSEWHERE = {"Path", "Hand over"}
"""A field that a button reads, and a button that acts on the gate: they, and the camera, have own tests."""


class Sent(queue.SimpleQueue[Command]):
    """The commands of a page that nobody executes."""


@pytest.fixture(scope="module")
def controls() -> Iterator[tuple[Page, Any, Sent]]:
    """A page that shows everything, and what looks at it; no loop runs."""
    sent = Sent()
    with Session(Start(), beside=False) as session:
        for _ in range(3):
            session.tick()
        session.send = sent.put  # type: ignore[method-assign]
        with Page(session, PageServer(port=8730, shadows=False)) as page, PageClient(page.url) as client:
            wait_for(lambda: page.server._websock_server._client_state_from_id)
            yield page, client, sent


def another(handle: Any) -> Any:
    """A value of a widget that it does not have."""
    if options := getattr(handle, "options", None):
        return options[-1]
    value = handle.value
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        low, high = (getattr(handle, side, None) for side in ("min", "max"))
        step = 1 if isinstance(value, int) else 0.01
        return value + step if high is None or value + step <= high else low
    return "text"


def counts(page: Page, buffers: list[Any]) -> list[int]:
    """How many messages were sent, once what came before has had all its effects."""
    found: list[int] = []
    while found != (found := [buffer.message_counter for buffer in buffers]):
        for _ in range(6):  # every panel has had its turn
            page.draw(page._view)
        time.sleep(0.02)
    return found


def effect(page: Page, client: Any, sent: Sent, message: dict[str, Any]) -> str:
    """What a message led to: a command, or what the page sent but the value itself; empty: nothing."""
    server = page.server._websock_server
    buffers = [
        server._broadcast_buffer,
        *(one.message_buffer for one in server._client_state_from_id.values()),
    ]
    before = counts(page, buffers)
    deadline = time.monotonic() + LONG
    client._send(message)
    while time.monotonic() < deadline:
        page.draw(page._view)
        if not sent.empty():
            return type(sent.get()).__name__
        if buffers[1].message_counter > before[1]:
            return "something for this browser"
        for number in range(before[0], buffers[0].message_counter):
            found = buffers[0].message_from_id.get(number)
            # Not the value itself; nor menus that go back to what the session has.
            if found is not None and "value" not in getattr(found, "updates", ()):
                return type(found).__name__
        time.sleep(0.005)
    return ""


def test_every_control_leads_to_a_command_or_changes_the_page(
    controls: tuple[Page, Any, Sent],
) -> None:
    page, client, sent = controls
    dead = []
    for uuid, handle in list(page.server.gui._gui_input_handle_from_uuid.items()):
        name = getattr(handle, "label", "?")
        if name in ELSEWHERE or not handle.visible:
            continue
        message = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": another(handle)}}
        if not effect(page, client, sent, message):
            dead.append(name)
    assert dead == []


def test_every_key_leads_to_a_command_or_changes_the_page(controls: tuple[Page, Any, Sent]) -> None:
    page, client, sent = controls
    handles = page.server.gui._command_handle_from_uuid
    dead = [
        handle.label
        for uuid, handle in handles.items()
        if not effect(page, client, sent, {"type": "CommandTriggerMessage", "uuid": uuid})
    ]
    assert len(handles) > 10 and dead == []


def test_a_model_is_loaded_by_its_path(controls: tuple[Page, Any, Sent]) -> None:
    page, client, sent = controls
    inputs = page.server.gui._gui_input_handle_from_uuid
    uuid_of = {getattr(handle, "label", ""): uuid for uuid, handle in inputs.items()}
    for name, value in (("Path", " arms/mine.xml "), ("Load", True)):
        client._send({"type": "GuiUpdateMessage", "uuid": uuid_of[name], "updates": {"value": value}})
    assert sent.get(timeout=LONG) == SetRobot("arms/mine.xml")
    with Session(Start(), beside=False) as session:
        session.send(SetRobot("arms/mine.xml"))
        session.tick()
        assert session.view().message == "there is no file arms/mine.xml"


def test_a_plot_of_distances_has_ticks_at_decades_only(controls: tuple[Page, Any, Sent]) -> None:
    plots = controls[0]._measured._plots
    for (_, name), plot in plots.items():
        splits = plot.axes[1].get("splits")
        assert (splits is not None) == name.startswith("distance")
        if splits is not None:
            assert np.diff(np.log10(splits)) == pytest.approx(1.0)


def test_no_joint_stands_at_minus_zero() -> None:
    robot = load_robot("tabletop_puma")
    q = np.full(robot.nq, -1e-9)
    view = SimpleNamespace(instances=[SimpleNamespace(q=q)])
    shown = joint_bars(view, robot)  # type: ignore[arg-type]
    assert ">0.0°<" in shown and "-0.0" not in shown
