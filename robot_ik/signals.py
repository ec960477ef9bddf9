"""Signals that end a program: raised as exceptions, and deferred by critical steps.

``deferred_signals``    defers the signals that come during a step to the end of the step
``ExitGuard``           turns signals into exceptions while an arm is enabled
``raised_signals``      turns signals into exceptions in a program without a guard

A signal handler may run in the middle of a packet, so it must not use a bus. It raises an
exception, ``KeyboardInterrupt`` for SIGINT and ``SystemExit(128 + number)`` for the others. The
bus then ends its transaction, and the arm is left on a clean line.

Python runs signal handlers in the main thread only. In other threads nothing here has an effect.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import logging
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from types import CodeType, FrameType
from typing import Any, NamedTuple, NoReturn, ParamSpec, Self, TypeVar

log = logging.getLogger(__name__)

PATIENCE = 5.0
"""s after the exception of a signal in which further signals raise none.

Afterwards a signal raises again, for a program that swallowed the first exception.
"""

WAIT_PERIOD = 0.05
"""s between two looks for a signal in ``DeferredSignals.wait``."""

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")

SIGNALS: tuple[int, ...] = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
"""Signals that end a program on this system.

Windows has no SIGHUP. It has SIGBREAK, for Ctrl-Break and a closed console.
"""

P = ParamSpec("P")
R = TypeVar("R")


class _Arrival(NamedTuple):
    """A signal that came.

    Attributes:
        number: Signal number.
        previous: Handler of the program before this module installed its own.
        guarded: An ``ExitGuard`` was installed.
    """

    number: int
    previous: Any
    guarded: bool

    @property
    def raises(self) -> bool:
        """Whether the signal becomes an exception; otherwise the program's own handler decides."""
        return self.guarded or _is_default(self.previous)


class DeferredSignals:
    """Signals that wait for the end of a step; see ``deferred_signals``."""

    def __init__(self) -> None:
        self._arrivals: list[_Arrival] = []
        self._handled = False

    def wait(self) -> int:
        """Wait for a signal and return its number.

        The signals of this block count as handled then: none of them is raised at its end.
        """
        self._handled = True
        while not self._arrivals:
            time.sleep(WAIT_PERIOD)
        return self._arrivals[0].number

    def __enter__(self) -> Self:
        self._arrivals.clear()
        self._handled = False
        _HANDLERS.begin(self)
        return self

    def __exit__(self, *_: object) -> None:
        _HANDLERS.end(self)

    def __call__(self, function: Callable[P, R]) -> Callable[P, R]:
        """Return the function, protected from its first instruction on.

        The signal handler finds the frame of the protected function on the stack, so there is no
        moment between the call and the protection.
        """

        @functools.wraps(function)
        def protected(*args: P.args, **kwargs: P.kwargs) -> R:
            over = False  # the signal handler reads it in this frame
            try:
                return function(*args, **kwargs)
            finally:
                over = True  # noqa: F841 - from here on a signal is raised where it comes
                _HANDLERS.deliver(sys._getframe())

        # functools.wraps hides the attribute from type checkers
        _PROTECTED.add(protected.__code__)  # type: ignore[attr-defined]
        return protected

    def keep(self, arrival: _Arrival) -> None:
        """Keep a signal until the end of the block."""
        self._arrivals.append(arrival)

    def take(self) -> list[_Arrival]:
        """Return the signals that are still to be raised."""
        return [] if self._handled else self._arrivals


def deferred_signals() -> DeferredSignals:
    """Return a context manager and decorator that defers the signals of ``SIGNALS``.

    Signals that come inside wait for its end. Then the program's own handler is called, or, if it
    has none, the exception of the signal is raised. Blocks may be nested: the outermost one ends
    the wait.

    As a context manager it installs handlers for its time. As a decorator it installs none: it has
    an effect while an ``ExitGuard`` or another block is installed. So a program that keeps its own
    handlers keeps them there, too.
    """
    return DeferredSignals()


_PROTECTED: set[CodeType] = set()
"""Code of the frames in which signals wait."""


def _is_protected(frame: FrameType | None) -> bool:
    """Return whether a frame or a caller of it is a protected function that is not over."""
    while frame is not None:
        if frame.f_code in _PROTECTED and not frame.f_locals.get("over", False):
            return True
        frame = frame.f_back
    return False


class ExitGuard:
    """Makes signals raise exceptions, and has a last resort at the end of the interpreter.

    Handlers are installed from the main thread only, because Python allows no other, and only for
    signals that the process does not ignore. In another thread only the last resort is armed. A
    program that enables arms in other threads installs a guard of its own in the main thread and
    leaves the arms when the exception comes.

    Args:
        last_resort: Called by ``atexit`` if the guard was not removed before. It must not raise.

    Attributes:
        received: Number of signals since ``install``.
    """

    def __init__(self, last_resort: Callable[[], object]) -> None:
        self._last_resort = last_resort
        self.received = 0

    def install(self, *, handle_signals: bool = True) -> None:
        """Make signals raise exceptions. May be called again, also after ``remove``.

        Args:
            handle_signals: False: the program keeps its own handlers. Only the last resort at the
                end of the interpreter is armed.
        """
        self.received = 0
        atexit.unregister(self._last_resort)  # not twice
        atexit.register(self._last_resort)
        if handle_signals:
            _HANDLERS.add(self)

    def remove(self) -> None:
        """Remove the guard. The last one restores the handlers from before.

        May be called from any thread, any number of times.
        """
        atexit.unregister(self._last_resort)
        _HANDLERS.discard(self)


@contextlib.contextmanager
def raised_signals(*numbers: int) -> Iterator[None]:
    """Make signals raise ``SystemExit(128 + number)``, so that ``with`` blocks are left.

    Args:
        numbers: Signal numbers.
    """

    def handle(number: int, _frame: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    before = {number: signal.signal(number, handle) for number in numbers if _in_main_thread()}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


class _Handler:
    """The handler of one signal, and the handler that it replaced."""

    def __init__(self, previous: Any) -> None:
        self.previous = previous

    def __call__(self, number: int, frame: FrameType | None) -> None:
        _HANDLERS.handle(number, frame, self.previous)


class _Handlers:
    """The handlers of this process, for all guards and blocks together.

    The first guard or block installs them and the last one restores those from before. Another
    part of the program may install its own handlers above them meanwhile. Then these stay below,
    and pass signals on once the last guard and block are removed.
    """

    def __init__(self) -> None:
        self._guards: list[ExitGuard] = []
        self._blocks: list[DeferredSignals] = []
        self._raised_at: float | None = None
        # Signals that came in a protected function and are still to be raised.
        self._kept: list[int] = []
        # Signal -> handler from before, to be called when the last guard is removed.
        self._postponed: dict[int, Any] = {}

    def add(self, guard: ExitGuard) -> None:
        if guard not in self._guards:
            self._guards.append(guard)
        if not _in_main_thread():
            if not any(isinstance(signal.getsignal(number), _Handler) for number in SIGNALS):
                log.warning(
                    "not in the main thread: SIGINT and SIGTERM cannot be turned into an orderly "
                    "exit"
                )
            return
        self._raised_at = None
        self._install()

    def discard(self, guard: ExitGuard) -> None:
        if guard in self._guards:
            self._guards.remove(guard)
        if _in_main_thread():
            self._restore_if_unused()
        elif not self._guards:
            _call_in_main_thread(self._settle)

    def begin(self, block: DeferredSignals) -> None:
        if not _in_main_thread():
            return
        try:
            self._blocks.append(block)
            self._install()
        except BaseException:  # a signal came before its handler was installed
            self._blocks.remove(block)
            self._restore_if_unused()
            raise

    def end(self, block: DeferredSignals) -> None:
        if block not in self._blocks:
            return
        self._blocks.remove(block)
        self._restore_if_unused()
        for arrival in block.take():
            if self._blocks:
                self._blocks[-1].keep(arrival)
            else:
                self._keep(arrival)
        self.deliver(sys._getframe())

    def handle(self, number: int, frame: FrameType | None, previous: Any) -> None:
        if not self._guards and not self._blocks:
            _restore()
            _pass_on(number, frame, previous)
            return
        for guard in self._guards:
            guard.received += 1
        arrival = _Arrival(number, previous, bool(self._guards))
        if self._blocks:
            self._blocks[-1].keep(arrival)
        elif _is_protected(frame):
            self._keep(arrival)
        else:
            self._postponed.setdefault(number, previous)
            if self._raised_at is None or time.monotonic() - self._raised_at > PATIENCE:
                self._raise(number)

    def _keep(self, arrival: _Arrival) -> None:
        self._postponed.setdefault(arrival.number, arrival.previous)
        if arrival.raises:
            self._kept.append(arrival.number)

    def deliver(self, frame: FrameType) -> None:
        """Raise the signals that came in a step, unless an outer step still runs.

        When the last guard is removed, the handlers from before are called first, each once.

        Args:
            frame: Frame of the caller.
        """
        if not _in_main_thread() or self._blocks or _is_protected(frame):
            return
        kept = self._kept
        self._kept = []
        if not self._guards:
            postponed = self._postponed
            self._postponed = {}
            with contextlib.ExitStack() as calls:
                for number, previous in reversed(postponed.items()):
                    if not _is_default(previous):
                        calls.callback(previous, number, None)
        # An earlier signal may be unwinding the program already.
        if kept and not isinstance(sys.exc_info()[1], (KeyboardInterrupt, SystemExit)):
            self._raise(kept[0])

    def _raise(self, number: int) -> NoReturn:
        """Raise ``KeyboardInterrupt`` for SIGINT, else ``SystemExit`` with a shell's exit code."""
        self._raised_at = time.monotonic()
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)

    def _settle(self) -> None:
        """Restore the handlers after another thread has removed the last guard."""
        if self._guards or self._blocks:
            return
        _restore()
        postponed = self._postponed
        self._postponed = {}
        for number, previous in postponed.items():
            if not _is_default(previous):
                signal.raise_signal(number)

    @staticmethod
    def _install() -> None:
        for number in SIGNALS:
            current = signal.getsignal(number)
            if current not in (signal.SIG_IGN, None) and not isinstance(current, _Handler):
                signal.signal(number, _Handler(current))

    def _restore_if_unused(self) -> None:
        if not self._guards and not self._blocks:
            _restore()


_HANDLERS = _Handlers()


def _restore() -> None:
    """Restore the handlers from before, where no other handler was installed above them."""
    for number in SIGNALS:
        while isinstance(current := signal.getsignal(number), _Handler):
            signal.signal(number, current.previous)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _is_default(previous: Any) -> bool:
    """Return whether a handler is that of Python or of the system, which the exception replaces."""
    return previous in (None, signal.SIG_DFL, signal.default_int_handler)


def _pass_on(number: int, frame: FrameType | None, previous: Any) -> None:
    """Handle a signal as the program did before this module installed its handler."""
    if callable(previous):
        previous(number, frame)
    else:
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)


def _call_in_main_thread(action: Callable[[], object]) -> None:
    """Call a function soon in the main thread, where Python lets handlers be changed."""

    def call(_: object) -> int:
        action()
        return 0

    callback = ctypes.PYFUNCTYPE(ctypes.c_int, ctypes.c_void_p)(call)
    _PENDING.append(callback)
    ctypes.pythonapi.Py_AddPendingCall(callback, None)


_PENDING: deque[Any] = deque(maxlen=16)
"""Callbacks that C is about to call. A reference keeps them alive."""
