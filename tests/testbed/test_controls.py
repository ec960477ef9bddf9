"""Every control of the page, moved as a browser moves it, does something."""

from __future__ import annotations

import dataclasses
import queue
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs the extra web")
import viser

from robot_ik.figure.decide import Decision
from robot_ik.geometry import Pose
from robot_ik.robot import load_robot
from robot_ik.testbed.arrangement import FIELD_OF_VIEW
from robot_ik.testbed.commands import Command, MoveGoal, SetMotion, SetRobot, Start
from robot_ik.testbed.frontends.browser import Page
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.frontends.panels import FigurePanel, MeasuredPanel, joint_bars, missing_text
from robot_ik.testbed.session import Session
from tests.doc_pages import script
from tests.waiting import LONG, wait_for

PageClient = script("measure_page").PageClient

ELSEWHERE = {"Path", "Hand over"}
"""A field that a button reads, and a button that acts on the gate: they, and the camera, have own tests."""


ONE_JOINT = """<robot name="mine"><link name="base"/><link name="arm">
<visual><geometry><mesh filename="package://mine/upper&lt;1&gt;.stl"/></geometry></visual>
<visual><geometry><mesh filename="fore.dae"/></geometry></visual>
<collision><geometry><mesh filename="fore.dae"/></geometry></collision>
<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="a" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


class Sent(queue.SimpleQueue[Command]):
    """The commands of a page that nobody executes."""


@pytest.fixture
def session() -> Iterator[Session]:
    with Session(Start(methods=("lm",)), beside=False) as made:
        yield made


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
        assert (splits is not None) == ("to the goal" in name)
        if splits is not None:
            assert np.diff(np.log10(splits)) == pytest.approx(1.0)


def test_menus_wait_for_what_is_being_prepared(controls: tuple[Page, Any, Sent]) -> None:
    """Compiling may take half a minute: a menu that goes back meanwhile looks as if it had refused."""
    page, view = controls[0], controls[0]._view
    menu = page._goals._kind
    menu.handle.value, menu._touched = "aim at the ball", -np.inf  # chosen a while ago
    page._goals.show(dataclasses.replace(view, busy="compiling lm …"))
    assert menu.value == "aim at the ball"
    page._goals.show(dataclasses.replace(view, busy=""))
    assert menu.value == "pose"


def test_who_only_watches_is_told_so_once(
    controls: tuple[Page, Any, Sent], monkeypatch: pytest.MonkeyPatch
) -> None:
    page, told = controls[0], []
    monkeypatch.setattr(viser.ClientHandle, "add_notification", lambda *given, **named: told.append(given))
    connection = next(iter(page.server._websock_server._live_connections.values()))
    for _ in range(20):  # a drag sends so many a second
        page._correct(connection, {"type": "SceneNodeDragMessage", "name": "/robot/ball"})
    assert len(told) == 1


def test_a_page_that_is_loaded_anew_sees_a_ball_that_was_taken_away(
    controls: tuple[Page, Any, Sent],
) -> None:
    page = controls[0]
    client = next(iter(page.server.get_clients().values()))
    before, ball = page._view, np.array((3.0, 2.0, 1.0))
    page._view = dataclasses.replace(before, ball=Pose(ball))
    try:
        page._fit_camera(page._scene, client)
    finally:
        page._view = before
    forward = client.camera.look_at - client.camera.position
    to_ball = ball - client.camera.position
    cosine = forward @ to_ball / np.linalg.norm(forward) / np.linalg.norm(to_ball)
    assert np.arccos(cosine) < 0.5 * FIELD_OF_VIEW * max(1.0, client.camera.aspect)


def test_what_a_figure_decides_is_a_sentence() -> None:
    decision = Decision("walk", "left", "the ball is far", then="reach")
    acting = SimpleNamespace(waiting=False, decision=decision, action="walk", phase=0.5)
    shown = FigurePanel._figure_text(SimpleNamespace(can_act=True, figure=acting))  # type: ignore[arg-type]
    assert shown.startswith("<b>walk</b>, then reach with the left hand<br>the ball is far")


def test_a_row_says_how_the_last_solve_ended_and_what_is_off(session: Session) -> None:
    for command in (SetMotion("hand"), MoveGoal((0.0, 0.0, 9.0))):
        session.send(command)
    for _ in range(60):
        session.tick()
    one = session.view().instances[0]
    row = MeasuredPanel._row(0, one, acting=False)
    assert one.status != "converged" and f"<small>{one.status}</small>" in row and "mm</td>" in row
    aimed = dataclasses.replace(one, error=0.0, angle=0.5)
    assert aimed.off == "28.65°" and "28.65°</td>" in MeasuredPanel._row(0, aimed, acting=False)


def test_meshes_that_are_not_drawn_are_named_on_the_page(tmp_path: Path) -> None:
    model = tmp_path / "mine.urdf"
    model.write_text(ONE_JOINT)
    with Session(Start(), beside=False) as session:
        assert session.view().missing_meshes == ()
        session.send(SetRobot(str(model)))
        session.tick()
        view = session.view()
    assert view.missing_meshes == ("package://mine/upper<1>.stl", "fore.dae")
    shown = missing_text(view.missing_meshes)
    assert "2 meshes are not drawn" in shown
    assert "package://mine/upper&lt;1&gt;.stl" in shown and "fore.dae" in shown
    assert missing_text(()) == ""


def test_no_joint_stands_at_minus_zero() -> None:
    robot = load_robot("tabletop_puma")
    q = np.full(robot.nq, -1e-9)
    view = SimpleNamespace(instances=[SimpleNamespace(q=q)])
    shown = joint_bars(view, robot)  # type: ignore[arg-type]
    assert ">0.0°<" in shown and "-0.0" not in shown
