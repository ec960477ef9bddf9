"""What a session needs that must load or compile: made ready beside its loop, compiled in other processes.

Python compiles one thing at a time, and holds up all other threads of its process meanwhile: the page would
stutter for half a minute.  What these processes have compiled the session takes from the cache; should one
fail, the session compiles it.

    python -m robot_ik.testbed.preparing < JSON        all of a setup
    python -m robot_ik.testbed.preparing puma560       what dragging a part needs

Each writes a line for every function that it has compiled.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import IO, Any

from numba.core import event
from pydantic import TypeAdapter

from robot_ik.compiled_goals import has_levels
from robot_ik.errors import RobotIkError
from robot_ik.goals import Goal
from robot_ik.kernels import jit, priorities
from robot_ik.robot import Robot, load_robot
from robot_ik.solvers.base import Solver
from robot_ik.solvers.iterative import IterativeSolver
from robot_ik.testbed.commands import SetRobot, SetupCommand
from robot_ik.testbed.setup import (
    MethodChoice,
    Ready,
    RobotGoals,
    Setup,
    first_ball,
    prepare,
    warm_drag,
)

_log = logging.getLogger(__name__)

_NICE = 10  # of the processes: the page, and the browser that loads it, come first
_SETUP = TypeAdapter(Setup)  # how the setup reaches the process


def is_compiled(goals: Sequence[Goal], solver: Solver) -> bool:
    """Return whether the kernel of a method for such goals is in the cache; True if unknown."""
    if not isinstance(solver, IterativeSolver):
        return True
    return jit.compiled(solver.module_for(has_levels(goals)).solve)


class Compilers:
    """Runs the processes, one job at a time."""

    def __init__(self) -> None:
        self._running: list[subprocess.Popen[bytes]] = []
        self._lock, self._over = threading.Lock(), False

    def setup(self, setup: Setup, missing: Sequence[MethodChoice], say: Callable[[str], None]) -> None:
        """Returns when the missing methods of a setup are compiled, or that has failed."""
        for half in filter(None, (missing[::2], missing[1::2])):
            # What a figure can do is found once, and by the session, which says how far that has come.
            part = replace(setup, count=len(half), choices=tuple(half), figure="off")  # type: ignore[arg-type]
            self._start(given=_SETUP.dump_json(part))
        self._follow(" and ".join(choice.method for choice in missing), say)

    def drag(self, robot: str, say: Callable[[str], None]) -> None:
        """Returns when what dragging needs is compiled, or that has failed."""
        self._start(robot)
        self._follow("what dragging parts needs", say)

    def close(self) -> None:
        """Ends them, and starts no more."""
        with self._lock:
            self._over = True
            self._end()

    def _end(self) -> None:
        for process in self._running:
            process.kill()
            process.wait()
            if process.stdout is None:
                raise RuntimeError("the child process has no output")
            process.stdout.close()
        self._running = []

    def _start(self, *arguments: str, given: bytes = b"") -> None:
        with self._lock, contextlib.suppress(OSError):  # no process to be had: it is compiled here, then
            if not self._over and sys.executable:
                process = subprocess.Popen(
                    [sys.executable, "-m", __name__, *arguments],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                )  # fmt: skip
                self._running.append(process)
                if process.stdin is None:
                    raise RuntimeError("the child process has no input")
                process.stdin.write(given)
                process.stdin.close()

    def _follow(self, what: str, say: Callable[[str], None]) -> None:
        """Waits for the processes and says how far they are."""
        with contextlib.suppress(ValueError):  # closed meanwhile: the session is over
            lines = itertools.chain.from_iterable(process.stdout or () for process in self._running)
            for count, _ in enumerate(lines, start=1):
                say(f"compiling {what}, once on this machine: {count} functions so far …")
        with self._lock:
            self._end()


@dataclass(frozen=True)
class SetupDone:
    """The result of preparing a command beside the loop.

    Attributes:
        command: The command. None for the setup that the session begins with.
        ready: What the loop needs. None if it cannot be prepared.
        error: Why not.
    """

    command: SetupCommand | None = None
    ready: Ready | None = None
    error: str = ""


class Preparer:
    """Makes setups ready, one after the other.

    Args:
        setup: What the session begins with.
        robot: That of the setup.
        done: Called with what came of each.
        beside: On a thread, from ``begin`` on; else at once.
    """

    def __init__(
        self, setup: Setup, robot: Robot, done: Callable[[SetupDone], None], *, beside: bool
    ) -> None:
        self._setup, self._robot, self._done, self._beside = setup, robot, done, beside
        self._ready: Ready | None = None
        self._jobs: queue.Queue[SetupCommand | type[Preparer] | None] = queue.Queue()
        self._thread: threading.Thread | None = None
        self._compilers = Compilers()
        self.can_drag = False
        self._text = "preparing …"

    @property
    def doing(self) -> str:
        """As text; empty: nothing."""
        return self._text if self._jobs.unfinished_tasks else ""

    def begin(self) -> None:
        """What the session begins with, beside the loop; once."""
        if self._beside and self._thread is None:
            self._thread = threading.Thread(target=self._work, name="testbed-preparer", daemon=True)
            self._thread.start()
            self.ask(None)

    def ask(self, command: SetupCommand | None) -> None:
        """Prepares what the command asks for; None: what the session begins with."""
        self._jobs.put(command)
        if not self._beside:
            self._do(self._jobs.get())

    def close(self) -> None:
        """No more; what is being compiled is not waited for."""
        self._compilers.close()
        if self._thread is not None:
            self._jobs.put(Preparer)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not Preparer:
            self._do(job)
        self._jobs.task_done()

    def _do(self, command: Any) -> None:
        self._text = "preparing …"
        try:
            wanted = self._setup if command is None else self._setup.after(command)
            robot = self._robot
            if isinstance(command, SetRobot):
                self._say(f"loading {command.name} …")
                robot = load_robot(wanted.robot)
            ready = prepare(wanted, robot, self._ready, self._say, self._compile)
        except RobotIkError as error:
            self._done(SetupDone(command, error=str(error).splitlines()[0]))
        except Exception as error:  # on a thread it is seen nowhere else, and the page waits for ever
            _log.exception("cannot prepare %s", command)
            self._done(SetupDone(command, error=f"cannot do that: {error}"))
        else:
            self._setup, self._robot, self._ready = ready.setup, robot, ready
            self._done(SetupDone(command, ready=ready))
            self._warm_drag(robot)
        finally:
            self._jobs.task_done()

    def _compile(self, setup: Setup, robot: Robot, goals: RobotGoals, solvers: Sequence[Solver]) -> None:
        """In other processes, what takes long: a compiler here would hold up the page."""
        if not self._beside:
            return
        missing: dict[str, MethodChoice] = {}
        for choice, solver in zip(setup.choices, solvers, strict=False):
            with contextlib.suppress(RobotIkError):  # it cannot serve these goals: ``prepare`` says why
                if not is_compiled(goals.all(first_ball(robot), solver), solver):
                    missing[choice.method] = choice
        if missing:
            self._say("starting to compile …")
            self._compilers.setup(setup, list(missing.values()), self._say)

    def _warm_drag(self, robot: Robot) -> None:
        """After the first answer: who drags nothing does not wait for it."""
        if not self.can_drag:
            self._say("preparing to drag parts …")
            if self._beside and not jit.compiled(priorities.solve):
                self._compilers.drag(self._setup.robot, self._say)
            with contextlib.suppress(RobotIkError):  # a model of which nothing can be dragged
                warm_drag(robot)
            self.can_drag = True

    def _say(self, text: str) -> None:
        self._text = text


# ---------------------------------------------------------------------------------------- the processes


class _Reporter(event.Listener):
    """Writes a line for every function that was compiled."""

    def __init__(self, out: IO[str]) -> None:
        self._out = out

    def on_start(self, event: Any) -> None: ...

    def on_end(self, event: Any) -> None:
        with contextlib.suppress(OSError):  # the parent has closed its end of the pipe
            self._out.write(event.data["dispatcher"].py_func.__name__ + "\n")
            self._out.flush()


def main(arguments: Sequence[str]) -> None:
    """One process; see the module."""
    if hasattr(os, "nice"):
        os.nice(_NICE)
    # Standard output is a pipe to the parent, which counts its lines.
    event.register("numba:compile", _Reporter(sys.stdout))
    if arguments:
        warm_drag(load_robot(arguments[0]))
    else:
        setup = _SETUP.validate_json(sys.stdin.buffer.read())
        prepare(setup, load_robot(setup.robot), None, lambda text: None)


if __name__ == "__main__":
    main(sys.argv[1:])
