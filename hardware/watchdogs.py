"""Who acts when the program that drives an arm ends, pauses or dies.

    who fails                        who acts                       when, and what happens
    -------------------------------  -----------------------------  ------------------------------------------
    a person or the system ends      ``ExitGuard``: signals become  at once: the arm is left as ``on_exit``
    the program                      exceptions                     says, then the handlers from before run
    the program stops commanding     ``Heartbeat``: a thread        ``stale_ms`` after the last command: the
                                                                    arm holds; after 2 s ``on_stale``
    program, computer or cable       Bus Watchdog of every servo    ``watchdog_ms`` after the last packet: it
                                                                    stops and holds with torque on

The heartbeat must act well before the Bus Watchdogs do: ``least_watchdog_ms`` says how much.

A signal handler must not talk to the bus: it may run in the middle of a packet.  It raises, the transaction
unwinds, and whoever owns the arm leaves it on a clean line.  Functions marked ``uninterrupted`` (enabling and
leaving an arm) are carried through first: a signal that comes meanwhile is kept and raised at their end.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import logging
import math
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from types import CodeType, FrameType
from typing import Any, NoReturn, ParamSpec, TypeVar

log = logging.getLogger(__name__)

WATCHDOG_UNIT_MS = 20
"""One count of the register Bus Watchdog (address 98 of every X series table)."""

BEAT = 0.05
"""s between two beats of the heartbeat."""

GIVE_UP = 2.0
"""s without a command after which ``on_stale`` = park or torque_off is carried out."""

PATIENCE = 5.0
"""s after which a program that swallowed the exception of a signal gets another one."""

P = ParamSpec("P")
R = TypeVar("R")


def stale_time(stale_ms: int, period: float) -> float:
    """s without a command after which an arm is held: never within three control cycles."""
    return max(0.001 * stale_ms, 3.0 * period)


def least_watchdog_ms(stale_ms: int, period: float) -> int:
    """The shortest Bus Watchdog that the heartbeat always beats.

    The arm is found stale by the first beat after ``stale_time``; holding it takes up to two control cycles.
    A Bus Watchdog of so many ms or more trips only where the heartbeat cannot run.
    """
    needed_ms = 1000.0 * (stale_time(stale_ms, period) + BEAT + 2.0 * period)
    return WATCHDOG_UNIT_MS * (math.floor(needed_ms / WATCHDOG_UNIT_MS + 1e-9) + 1)


# -------------------------------------------------------------------------------------- the heartbeat


class Heartbeat:
    """Calls ``beat`` every ``BEAT`` seconds until stopped, from a thread of its own.

    A program that is alive and busy with something else would not see a servo that overheats, and the Bus
    Watchdogs would trip although nothing is wrong.  ``beat`` must not raise.
    """

    def __init__(self, beat: Callable[[], None]) -> None:
        self._beat = beat
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """From here on; may be called again after ``stop``.

        Raises:
            RuntimeError: The system gives no thread.
        """
        if self._thread is not None and self._thread.is_alive() and not self._stop.is_set():
            return  # one that is dismissed may live for a beat, and does nothing
        self._stop = threading.Event()
        thread = threading.Thread(target=self._run, args=(self._stop,), name="heartbeat", daemon=True)
        thread.start()
        self._thread = thread  # only now: one that never started cannot be waited for

    def dismiss(self) -> None:
        """No beat begins from here on, and what one has begun ends soon."""
        self._stop.set()

    def stop(self) -> None:
        """No beat begins after this returns; may be called any number of times, also from ``beat``."""
        self._stop.set()
        thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout=GIVE_UP)

    def stopping(self) -> bool:
        """Whether the thread is to end."""
        return self._stop.is_set()

    def _run(self, stop: threading.Event) -> None:
        while not stop.wait(BEAT):
            self._beat()


# -------------------------------------------------------------------------------------------- signals


_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
SIGNALS: tuple[int, ...] = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
"""Signals that end a program here: no SIGHUP on Windows, but SIGBREAK (Ctrl-Break, a closed console)."""


def uninterrupted(function: Callable[P, R]) -> Callable[P, R]:
    """Carries a function through: a signal that comes meanwhile is raised when it is over.

    From its first instruction on: the handler finds this frame on the stack, so there is no moment between
    the call and the protection.
    """

    @functools.wraps(function)
    def carried_through(*args: P.args, **kwargs: P.kwargs) -> R:
        over = False  # read by the handler, in this frame
        try:
            return function(*args, **kwargs)
        finally:
            over = True  # noqa: F841 - from here on a signal is raised where it comes
            _HANDLERS.deliver()

    _CARRIED_THROUGH.add(carried_through.__code__)  # type: ignore[attr-defined]  # functools.wraps hides it
    return carried_through


_CARRIED_THROUGH: set[CodeType] = set()


def _is_carried_through(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code in _CARRIED_THROUGH and not frame.f_locals.get("over", False):
            return True
        frame = frame.f_back
    return False


class ExitGuard:
    """One arm's share in the handlers of the signals that end a program, and a last resort at its end.

    Handlers are installed only from the main thread (Python allows no other) and only for signals that the
    process does not ignore.  In another thread only the last resort is armed: a program that enables arms
    there installs a guard of its own in the main thread first, and leaves them when the exception comes.

    Args:
        last_resort: Called by ``atexit`` if the guard was not removed before; must not raise.

    Attributes:
        received: Signals since ``install``.
    """

    def __init__(self, last_resort: Callable[[], object]) -> None:
        self._last_resort = last_resort
        self.received = 0

    def install(self, *, handle_signals: bool = True) -> None:
        """From here on signals end in an exception.  May be called again, also after ``remove``.

        Args:
            handle_signals: False: the program keeps its own handlers and leaves the arm itself.  Only the
                last resort at the end of the interpreter is armed.
        """
        self.received = 0
        atexit.unregister(self._last_resort)  # not twice
        atexit.register(self._last_resort)
        if handle_signals:
            _HANDLERS.add(self)

    def remove(self) -> None:
        """The arm is left; with the last one the handlers from before are given back.

        May be called from any thread, any number of times.
        """
        atexit.unregister(self._last_resort)
        _HANDLERS.discard(self)


class _Handler:
    """What is installed for a signal, and what was installed before it."""

    def __init__(self, previous: Any) -> None:
        self.previous = previous

    def __call__(self, number: int, frame: FrameType | None) -> None:
        _HANDLERS.handle(number, frame, self.previous)


class _Handlers:
    """The handlers of this process: installed with the first arm, given back with the last.

    Another part of the program may install its own above ours while arms are enabled.  Then ours stay below
    it, and pass on what comes once the arms are left.
    """

    def __init__(self) -> None:
        self._guards: list[ExitGuard] = []
        self._raised_at: float | None = None
        self._kept: list[int] = []  # came while something was carried through, and not raised yet
        self._owed: dict[int, Any] = {}  # signal -> the handler from before, to be called

    def add(self, guard: ExitGuard) -> None:
        if guard not in self._guards:
            self._guards.append(guard)
        if not _in_main_thread():
            if not any(isinstance(signal.getsignal(number), _Handler) for number in SIGNALS):
                log.warning(
                    "not in the main thread: SIGINT and SIGTERM cannot be turned into an orderly exit"
                )
            return
        self._raised_at = None
        for number in SIGNALS:
            current = signal.getsignal(number)
            if current not in (signal.SIG_IGN, None) and not isinstance(current, _Handler):
                signal.signal(number, _Handler(current))

    def discard(self, guard: ExitGuard) -> None:
        if guard in self._guards:
            self._guards.remove(guard)
        if not self._guards:
            if _in_main_thread():
                self._give_back()
            else:
                _call_in_main_thread(self._settle)

    def handle(self, number: int, frame: FrameType | None, previous: Any) -> None:
        if not self._guards:
            self._give_back()
            _pass_on(number, frame, previous)
            return
        for guard in self._guards:
            guard.received += 1
        self._owed.setdefault(number, previous)
        if _is_carried_through(frame):
            self._kept.append(number)
        elif self._raised_at is None or time.monotonic() - self._raised_at > PATIENCE:
            self._raise(number)

    def deliver(self) -> None:
        """Something was carried through: what came meanwhile is raised.

        Once all arms are left the handlers from before are called first, each once.
        """
        if not _in_main_thread():
            return  # signals come in the main thread, and there ``discard`` settles what is owed
        kept, self._kept = self._kept, []
        if not self._guards:
            owed, self._owed = self._owed, {}
            with ExitStack() as calls:
                for number, previous in reversed(owed.items()):
                    if not _is_default(previous):
                        calls.callback(previous, number, None)
        # An earlier one may be unwinding the program already.
        if kept and not isinstance(sys.exc_info()[1], (KeyboardInterrupt, SystemExit)):
            self._raise(kept[0])

    def _raise(self, number: int) -> NoReturn:
        """As a shell would report it: 128 + number; Ctrl-C as Python does it."""
        self._raised_at = time.monotonic()
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)

    def _settle(self) -> None:
        """The last arm was left by another thread."""
        if self._guards:
            return  # a new one is there
        self._give_back()
        owed, self._owed = self._owed, {}
        for number, previous in owed.items():
            if not _is_default(previous):
                signal.raise_signal(number)

    @staticmethod
    def _give_back() -> None:
        for number in SIGNALS:
            while isinstance(current := signal.getsignal(number), _Handler):
                signal.signal(number, current.previous)


_HANDLERS = _Handlers()


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _is_default(previous: Any) -> bool:
    """What Python or the system does by itself: the exception that is raised stands for it."""
    return previous in (None, signal.SIG_DFL, signal.default_int_handler)


def _pass_on(number: int, frame: FrameType | None, previous: Any) -> None:
    """A signal for which there is no arm any more."""
    if callable(previous):
        previous(number, frame)
    else:
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)


def _call_in_main_thread(action: Callable[[], object]) -> None:
    """Soon, between two instructions of the main thread, where Python lets handlers be changed."""

    def call(_: object) -> int:
        action()
        return 0

    callback = ctypes.PYFUNCTYPE(ctypes.c_int, ctypes.c_void_p)(call)
    _PENDING.append(callback)
    ctypes.pythonapi.Py_AddPendingCall(callback, None)


_PENDING: deque[Any] = deque(maxlen=16)  # what C is about to call must stay alive
