"""Signals that end a program: raised as exceptions, deferred by steps, handlers restored."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from robot_ik.signals import SIGNALS, ExitGuard, deferred_signals, raised_signals
from tests.waiting import wait_for


@pytest.fixture
def guards() -> Iterator[list[ExitGuard]]:
    guards = [ExitGuard(lambda: None) for _ in range(3)]
    yield guards
    for guard in guards:
        guard.remove()


@pytest.fixture
def calls() -> Iterator[list[int]]:
    """Signals that reached the program's handler of SIGTERM."""
    calls: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _frame: calls.append(number))
    yield calls
    signal.signal(signal.SIGTERM, before)


def handlers() -> list[object]:
    return [signal.getsignal(number) for number in SIGNALS]


def test_the_first_signal_raises_and_the_next_are_only_counted(guards):
    guards[0].install()
    with pytest.raises(SystemExit) as caught:
        signal.raise_signal(signal.SIGTERM)
    assert caught.value.code == 143
    signal.raise_signal(signal.SIGTERM)
    signal.raise_signal(signal.SIGINT)
    assert guards[0].received == 3


def test_a_program_that_swallows_the_exception_gets_another_after_a_while(guards, monkeypatch):
    guards[0].install()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    monkeypatch.setattr("robot_ik.signals.PATIENCE", 0.0)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_a_decorated_function_runs_to_its_end_and_raises_the_signal_then(guards):
    guards[0].install()
    done = []

    @deferred_signals()
    def work() -> None:
        signal.raise_signal(signal.SIGINT)
        done.append("complete")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["complete"]


def test_the_outermost_of_nested_decorated_functions_ends_the_wait(guards):
    guards[0].install()
    done = []

    @deferred_signals()
    def inner() -> None:
        signal.raise_signal(signal.SIGINT)

    @deferred_signals()
    def outer() -> None:
        inner()
        done.append("outer")

    with pytest.raises(KeyboardInterrupt):
        outer()
    assert done == ["outer"]


def test_a_decorated_function_does_not_change_the_handlers_of_a_program(calls):
    before = handlers()
    reached: list[object] = []

    @deferred_signals()
    def work() -> None:
        reached.append(handlers())
        signal.raise_signal(signal.SIGTERM)
        assert calls == [signal.SIGTERM]

    work()
    assert reached == [before]


@pytest.mark.parametrize("number", SIGNALS)
def test_a_block_runs_to_its_end_and_raises_the_signal_then(number):
    before = handlers()
    done = []
    with pytest.raises((KeyboardInterrupt, SystemExit)) as caught, deferred_signals():
        signal.raise_signal(number)
        done.append("complete")
    assert done == ["complete"]
    expected = KeyboardInterrupt if number == signal.SIGINT else SystemExit
    assert caught.type is expected
    assert number == signal.SIGINT or caught.value.code == 128 + number
    assert handlers() == before


def test_a_block_passes_the_signal_to_the_handler_of_the_program_at_its_end(calls):
    with deferred_signals():
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        assert calls == []
    assert calls == [signal.SIGTERM]


def test_the_outermost_of_nested_blocks_ends_the_wait(guards):
    guards[0].install()
    done = []
    with pytest.raises(KeyboardInterrupt), deferred_signals():
        with deferred_signals():
            signal.raise_signal(signal.SIGINT)
        done.append("outer")
    assert done == ["outer"]
    assert guards[0].received == 1


def test_an_error_in_a_block_hides_no_signal():
    before = handlers()
    with pytest.raises(KeyboardInterrupt) as caught, deferred_signals():
        signal.raise_signal(signal.SIGINT)
        raise ValueError("in the block")
    assert isinstance(caught.value.__context__, ValueError)
    assert handlers() == before


def test_a_block_that_waits_for_a_signal_handles_it_and_those_that_follow():
    before = handlers()
    main = threading.main_thread().ident
    assert main is not None
    with deferred_signals() as signals:
        threading.Thread(target=signal.pthread_kill, args=(main, signal.SIGTERM)).start()
        assert signals.wait() == signal.SIGTERM
        signal.raise_signal(signal.SIGINT)
    assert handlers() == before


def test_a_block_in_another_thread_touches_no_handler():
    before = handlers()
    reached: list[object] = []

    def work() -> None:
        with deferred_signals():
            reached.append(handlers())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert reached == [before]


def test_raised_signals_leave_the_blocks_of_a_program(calls):
    left = []
    with pytest.raises(SystemExit) as caught, raised_signals(signal.SIGTERM):
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            left.append(True)
    assert left and caught.value.code == 143
    signal.raise_signal(signal.SIGTERM)
    assert calls == [signal.SIGTERM]


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
@pytest.mark.parametrize("elsewhere", [False, True])
def test_the_handlers_from_before_are_restored_in_every_order_of_closing(
    guards, calls, order, elsewhere
):
    before = handlers()
    for guard in guards:
        guard.install()
    assert all(a is not b for a, b in zip(handlers(), before, strict=True))
    for k in order:
        if elsewhere:
            thread = threading.Thread(target=guards[k].remove)
            thread.start()
            thread.join()
        else:
            guards[k].remove()
    wait_for(lambda: handlers() == before)
    signal.raise_signal(signal.SIGTERM)
    assert calls == [signal.SIGTERM]


def test_ignored_signals_stay_ignored(guards):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        guards[0].install()
        with deferred_signals():
            assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_later_handler_stays_and_its_call_reaches_the_first_handler(guards, calls):
    guards[0].install()
    guard_handler = signal.getsignal(signal.SIGTERM)
    assert callable(guard_handler)
    later_calls = []

    def handle(number, frame):
        later_calls.append(number)
        guard_handler(number, frame)

    signal.signal(signal.SIGTERM, handle)
    with pytest.raises(SystemExit):
        signal.raise_signal(signal.SIGTERM)
    guards[0].remove()
    signal.raise_signal(signal.SIGTERM)  # without a guard it passes through to the first handler
    assert later_calls == [signal.SIGTERM] * 2
    assert calls == [signal.SIGTERM]


def test_outside_the_main_thread_no_handler_is_touched(guards):
    before = handlers()
    thread = threading.Thread(target=guards[0].install)
    thread.start()
    thread.join()
    assert handlers() == before


class InterruptingPicture(np.ndarray):
    """A picture that raises SIGINT when its shape is read."""

    @property
    def shape(self):
        signal.raise_signal(signal.SIGINT)
        return super().shape


def test_a_film_keeps_the_picture_during_which_ctrl_c_came(tmp_path: Path):
    av = pytest.importorskip("av", reason="needs the extra video")
    from robot_ik.workcell.films import Film

    film = Film(tmp_path / "film.mp4", 30.0)
    picture = np.zeros((48, 64, 3), np.uint8)
    film.write(picture, 0.0)
    with pytest.raises(KeyboardInterrupt):
        film.write(picture.view(InterruptingPicture), 1.0 / 30.0)
    film.close()
    with av.open(str(tmp_path / "film.mp4")) as container:
        assert len(list(container.decode(video=0))) == 2
