"""The loop that runs a session in real time, and the replay of its log."""

from __future__ import annotations

import dataclasses
import logging
import threading
from collections.abc import Callable, Iterator

from robot_ik.ports import Clock, short_switch_interval
from robot_ik.schedule import Schedule, StoppableClock, regular
from robot_ik.testbed import commands
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View

_log = logging.getLogger(__name__)


def replayed(log: commands.CommandLog) -> Iterator[Session]:
    """Yield the session of a log after each tick. The last tick is past all commands.

    Raises:
        RobotIkError: As ``Session``.
    """
    with Session(log.start, beside=False) as session:
        waiting = list(log.commands)
        last = max([log.ticks, *(tick + 1 for tick, _ in waiting)])
        for tick in range(last):
            while waiting and waiting[0][0] <= tick:
                session.send(waiting.pop(0)[1])
            session.tick()
            yield session


def last_view(log: commands.CommandLog) -> View:
    """Return the view at the end of a log; of an empty log, after one tick."""
    log = log if log.ticks or log.commands else dataclasses.replace(log, ticks=1)
    for session in replayed(log):
        last = session
    return last.view()


def _surviving(session: Session, draw: Callable[[View], object]) -> Callable[[View], object]:
    """Return ``draw`` with its exceptions logged, once each, and shown as the message."""
    logged: set[str] = set()

    def drawn(view: View) -> object:
        try:
            return draw(view)
        except Exception as error:
            problem = f"{type(error).__name__}: {error}".splitlines()[0]
            if problem not in logged:
                logged.add(problem)
                _log.exception(
                    "the view cannot be drawn; the session continues because it has an arm"
                )
            session.report(f"the view cannot be drawn ({problem}); STOP still works")
            return None

    return drawn


def run(
    session: Session,
    draw: Callable[[View], object],
    stop: threading.Event,
    *,
    every: int = 2,
    clock: Clock | None = None,
) -> None:
    """Tick a session in real time and draw each ``every``-th view: the only loop of a front end.

    It runs until ``stop`` is set, or ``draw`` returns False, which a closed window does. After a
    stall it continues at the normal rate. ``clock`` is the machine's by default.

    An exception of ``draw`` ends a session without an arm. A session with an arm logs it, shows it
    as its message and continues, so that STOP and other commands still take effect.
    """
    schedule = Schedule(clock or StoppableClock(stop))
    if session.arm is not None:
        draw = _surviving(session, draw)
    with short_switch_interval():
        for _, k in schedule.ticks(regular(commands.RATE)):
            if stop.is_set():
                break
            session.tick()
            if k % every == 0 and draw(session.view()) is False:
                break
