"""Run a session without a window and without a thread, and replay its log."""

from __future__ import annotations

from collections.abc import Sequence

from robot_ik.testbed.commands import Command, CommandLog
from robot_ik.testbed.loop import replayed
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View


def view_after(session: Session, *commands: Command, ticks: int = 30) -> View:
    """Return the view after sending commands and running a number of ticks."""
    for command in commands:
        session.send(command)
    for _ in range(ticks):
        session.tick()
    return session.view()


def run_script(session: Session, script: Sequence[tuple[int, Command]], ticks: int) -> CommandLog:
    """Run a session, send each command before its tick, and return the log."""
    for tick in range(ticks):
        due = [command for at, command in script if at == tick]
        view_after(session, *due, ticks=1)
    return session.log()


def require_equal_replay(log: CommandLog) -> View:
    """Replay a log that is read from its text. Return the last view, which has the same digest."""
    *_, session = replayed(CommandLog.parse(log.text().splitlines(), "log"))
    view = session.view()
    assert view.digest() == log.digest
    return view
