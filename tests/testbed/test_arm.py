"""The servo arm that follows the testbed: simulated servos, real time."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from robot_ik.commands import view as view_command
from robot_ik.commands.main import main
from robot_ik.errors import ConfigError
from robot_ik.motion import Trajectory
from robot_ik.testbed.arm import ArmLink
from robot_ik.testbed.commands import MoveGoal, SetArm, SetRobot, SetRunning, Start
from robot_ik.testbed.filming import arm_link
from robot_ik.testbed.loop import run
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View
from tests.waiting import wait_for

pytestmark = pytest.mark.usefixtures("real_time")


@pytest.fixture
def link() -> Iterator[ArmLink]:
    made = arm_link("tabletop_puma", None, "sim")
    yield made
    made.close()


@pytest.fixture
def session(link: ArmLink) -> Session:
    return Session(Start("tabletop_puma"), beside=False, arm=link)


def until(session: Session, holds: Callable[[View], object], what: str) -> View:
    def tick() -> View | None:
        session.tick()
        view = session.view()
        assert view.arm is None or view.arm.state != "fault", f"{what}: {view.arm}"
        return view if holds(view) else None

    return wait_for(tick, lambda: f"{what}: {session.view().arm}")


def test_the_arm_waits_without_torque_then_follows_and_holds(session: Session) -> None:
    view = until(session, lambda v: v.arm is not None and v.arm.q is not None, "no reading")
    assert view.arm is not None and view.arm.state == "connected"
    session.send(MoveGoal((0.2, 0.05, 0.1)))
    session.send(SetArm("follow"))
    view = until(
        session,
        lambda v: v.arm and v.arm.state == "enabled" and v.arm.apart < 0.02,
        "does not follow",
    )
    assert view.arm is not None and view.arm.q is not None
    assert np.abs(view.arm.q - view.instances[0].q).max() < 0.02
    assert np.isfinite(view.arm.xpos).all()
    until(
        session,
        lambda v: v.arm and v.arm.servos and all(s.torque for s in v.arm.servos),
        "no telemetry",
    )
    session.send(SetRunning(False))
    until(session, lambda v: v.arm and v.arm.state == "hold", "stop does not hold the arm")
    session.send(SetArm("follow"))
    view = until(session, lambda v: v.arm and v.arm.mode == "follow", "follow is not taken")
    assert view.arm is not None and view.arm.state == "hold" and "press Start" in view.arm.message
    session.send(SetRunning(True))
    until(session, lambda v: v.arm and v.arm.state == "enabled", "it does not go on")
    session.send(SetArm("release"))
    until(session, lambda v: v.arm and v.arm.state == "connected", "torque stays on")


def stays(session: Session, link: ArmLink, state: str) -> None:
    """Fail if the arm leaves a state within 30 cycles of the arm and 30 ticks of the session."""
    cycles = link._arm.clock.now() + 30.0 / link._arm.config.rate_hz
    end = session.view().tick + 30

    def ran(view: View) -> bool:
        assert view.arm is not None and view.arm.state == state, f"it left {state}: {view.arm}"
        return view.tick >= end and link._arm.clock.now() >= cycles

    until(session, ran, "the arm's cycles do not go on")


def test_start_after_stop_does_not_move_the_arm(session: Session, link: ArmLink) -> None:
    session.send(SetArm("follow"))
    until(session, lambda v: v.arm and v.arm.state == "enabled", "does not follow")
    for command in (SetRunning(False), SetRunning(True)):  # both before the next tick
        session.send(command)
    view = until(session, lambda v: v.arm and v.arm.state == "hold", "stop does not hold the arm")
    assert view.running and view.arm is not None and view.arm.mode == "hold"
    assert "press Follow" in view.arm.message
    stays(session, link, "hold")
    session.send(SetArm("follow"))
    until(session, lambda v: v.arm and v.arm.state == "enabled", "does not follow again")


def test_an_arm_without_torque_is_reported_as_limp(session: Session, link: ArmLink) -> None:
    """Hold does not switch the torque on. An arm that was reported as holding would be released."""
    for before in ("release", "teach"):
        session.send(SetArm("follow"))
        until(
            session,
            lambda v: v.arm and v.arm.state == "enabled" and not v.arm.limp,
            "does not follow",
        )
        session.send(SetArm(before))
        until(session, lambda v: v.arm and v.arm.limp, "not reported as limp")
        session.send(SetArm("hold"))
        view = until(session, lambda v: v.arm and v.arm.mode == "hold", "hold is not taken")
        assert view.arm is not None and view.arm.limp and view.arm.state == "connected"


def test_a_session_that_falls_silent_makes_the_arm_hold(session: Session, link: ArmLink) -> None:
    session.send(SetArm("follow"))
    until(session, lambda v: v.arm and v.arm.state == "enabled", "does not follow")
    wait_for(lambda: link.view().state == "hold", "the arm does not hold")


def test_another_robot_on_the_page_does_not_move_the_arm(session: Session, link: ArmLink) -> None:
    session.send(SetArm("follow"))
    until(session, lambda v: v.arm and v.arm.state == "enabled", "does not follow")
    session.send(SetRobot("koch_v11"))
    view = until(
        session, lambda v: v.arm and v.arm.state == "hold", "the wrong robot moves the arm"
    )
    assert view.robot == "koch_v11" and view.arm is not None and "tabletop_puma" in view.arm.message
    assert not view.arm.is_shown
    session.send(SetArm("follow"))
    view = until(session, lambda v: v.arm and "first" in v.arm.message, "another robot is followed")
    assert view.arm is not None and view.arm.mode == "hold"
    session.send(SetRobot("tabletop_puma"))
    until(session, lambda v: v.arm and v.arm.is_shown, "the arm's robot is not back")
    stays(session, link, "hold")


def test_a_ball_that_jumps_makes_the_arm_walk(session: Session, link: ArmLink) -> None:
    session.send(SetArm("follow"))
    until(
        session,
        lambda v: v.arm and v.arm.state == "enabled" and v.arm.apart < 0.05,
        "does not follow",
    )
    fastest = float(link._arm.config.velocity.max())
    session.send(MoveGoal((-0.15, -0.2, 0.2)))
    last = link.view().q
    most = 0.0
    begin = time.monotonic()
    assert last is not None
    for _ in range(60):
        session.tick()
        time.sleep(0.01)
    now = link.view().q
    assert now is not None
    most = float(np.abs(now - last).max()) / (time.monotonic() - begin)
    assert 0.0 < most <= 1.2 * fastest


def test_what_a_hand_shows_is_recorded_and_repeated(session: Session, link: ArmLink) -> None:
    session.send(SetArm("replay"))
    view = until(session, lambda v: v.arm and v.arm.message, "an empty recording is repeated")
    assert view.arm is not None and "Teach" in view.arm.message and view.arm.mode == "hold"
    session.send(MoveGoal((0.2, 0.05, 0.1)))
    session.send(SetArm("teach"))  # simulated servos are guided by the page's robot
    until(
        session,
        lambda v: v.arm and v.arm.apart < 0.02 and v.arm.state == "connected",
        "no hand guides the servos",
    )
    begin = link.view().q
    session.send(MoveGoal((0.15, -0.1, 0.15)))
    until(
        session,
        lambda v: v.arm and np.abs(v.arm.q - begin).max() > 0.2 and v.arm.apart < 0.02,
        "no way",
    )
    shown = link.view().q
    assert link.view().recorded > 0.0
    session.send(SetArm("release"))
    until(
        session, lambda v: link.recording and v.arm and v.arm.recorded > 0.1, "nothing was recorded"
    )
    assert begin is not None and shown is not None and link.recording is not None
    assert (
        np.abs(link.recording.q[-1] - shown).max() < 0.03
    )  # so far it may still have been from its goal
    for servo in link._arm.config.drives:  # somewhere else meanwhile
        link._arm.bus.virtual_bus.servo(servo.id).rotate_by_hand(100.0)  # type: ignore[union-attr]
    session.send(SetArm("replay"))
    until(session, lambda v: v.arm and v.arm.state == "enabled", "it does not begin")
    until(session, lambda v: v.arm and v.arm.mode == "hold", "it does not end")
    assert np.abs(link.view().q - link.recording.q[-1]).max() < 0.01


def test_stop_ends_a_replay(session: Session, link: ArmLink) -> None:
    shown = Trajectory([0.0, 5.0], 0.1 * np.ones((2, 6)), link._opened.robot.joints)
    link.recording = shown
    session.send(SetArm("replay"))
    until(session, lambda v: v.arm and v.arm.state == "enabled", "it does not begin")
    session.send(SetRunning(False))
    view = until(
        session, lambda v: v.arm and v.arm.state == "hold" and v.arm.mode == "hold", "it goes on"
    )
    assert view.arm is not None and "stopped" in view.arm.message


def test_an_arm_of_the_page_warns_of_no_signals(caplog: pytest.LogCaptureFixture) -> None:
    link = arm_link("tabletop_puma", None, "pty")  # a real clock, a real thread, a real serial line
    try:
        session = Session(Start("tabletop_puma"), beside=False, arm=link)
        session.send(SetArm("follow"))
        until(session, lambda v: v.arm and v.arm.state == "enabled", "does not follow")
        session.send(SetArm("release"))
        until(session, lambda v: v.arm and v.arm.state == "connected", "torque stays on")
        session.send(SetArm("follow"))
        until(session, lambda v: v.arm and v.arm.state == "enabled", "does not follow again")
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    finally:
        link.close()
    assert [row.message for row in caplog.records if "thread" in row.message] == []
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_closing_leaves_the_arm_by_its_policy() -> None:
    link = arm_link("tabletop_puma", None, "sim", "torque_off")
    with Session(Start("tabletop_puma"), beside=False, arm=link) as session:
        session.send(SetArm("follow"))
        until(session, lambda v: v.arm and v.arm.state == "enabled", "does not follow")
    assert link.view().state == "disconnected" and "torque" in link.left


def test_a_page_that_cannot_be_drawn_does_not_end_a_session_with_an_arm(
    session: Session, link: ArmLink, caplog: pytest.LogCaptureFixture
) -> None:
    stop = threading.Event()
    messages = []

    def draw(view: View) -> None:
        messages.append(view.message)
        if len(messages) == 1:
            session.send(SetArm("follow"))
        if view.arm is not None and view.arm.state == "enabled":
            session.send(SetRunning(False))
        if view.arm is not None and view.arm.state == "hold":
            stop.set()
        raise IndexError("index 11 is out of bounds")

    run(session, draw, stop)
    assert link.view().state == "hold"
    assert "IndexError" in messages[-1] and "STOP still works" in messages[-1]
    assert [row.levelname for row in caplog.records if "cannot be drawn" in row.message] == [
        "ERROR"
    ]


def test_a_page_that_cannot_be_drawn_ends_a_session_without_an_arm() -> None:
    def draw(view: View) -> None:
        raise IndexError("index 11 is out of bounds")

    with Session(Start("tabletop_puma"), beside=False) as session, pytest.raises(IndexError):
        run(session, draw, threading.Event())


def test_the_arms_ghost_is_drawn_where_it_differs_from_its_own_robot(
    session: Session, link: ArmLink
) -> None:
    pytest.importorskip("viser", reason="needs the extra web")
    from robot_ik.testbed.frontends.browser import Page
    from robot_ik.testbed.frontends.page_server import PageServer

    def ghost(page: Page) -> bool:
        node = page.server.scene._handle_from_node_name.get("/robot/arm")
        return node is not None and bool(node.visible)

    until(session, lambda v: v.arm and v.arm.q is not None, "no reading")
    with Page(session, PageServer(port=8760, shadows=False)) as page:
        session.send(MoveGoal((0.2, 0.05, 0.1)))
        until(session, lambda v: v.arm and v.arm.apart > 0.1, "the robot stays with the arm")
        page.draw(session.view())
        assert ghost(page)
        session.send(SetRobot("humanoid"))  # of more bodies than the arm has
        view = until(session, lambda v: v.robot == "humanoid", "no other robot")
        page.draw(view)
        assert not ghost(page)
        session.send(SetRobot("tabletop_puma"))
        session.send(MoveGoal((0.2, 0.05, 0.1)))
        until(session, lambda v: v.robot == "tabletop_puma", "the arm's robot is not back")
        session.send(SetArm("follow"))
        view = until(session, lambda v: v.arm and v.arm.apart < 0.01, "does not follow")
        page.draw(view)
        assert not ghost(page)


def test_a_robot_without_an_arm_file_is_said() -> None:
    with pytest.raises(ConfigError, match="arm file"):
        arm_link("panda", None, "sim")


def test_a_signal_while_the_arm_is_left_hides_not_how(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    leave = ArmLink.close

    def close(self: ArmLink) -> None:
        leave(self)
        raise KeyboardInterrupt

    monkeypatch.setattr(ArmLink, "close", close)
    monkeypatch.setattr(view_command.View, "_front_end", lambda *rest: contextlib.nullcontext())
    monkeypatch.setattr(view_command, "run_until_end", lambda *rest: None)
    assert main(["view", "--bus", "sim", "--viewer", "window"]) == 130
    assert capsys.readouterr().err.endswith("not touched\ninterrupted\n")
