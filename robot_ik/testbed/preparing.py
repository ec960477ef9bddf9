"""Prepares a setup beside the session's loop, and compiles its kernels in other processes.

The processes (``kernels.precompile``) write the kernels to the cache, from which the session loads
them. If a process fails, the session compiles.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydantic import TypeAdapter

from robot_ik.compiled_goals import has_levels
from robot_ik.errors import RobotIkError
from robot_ik.goals import Goal
from robot_ik.kernels import jit, priorities
from robot_ik.kernels.precompile import Precompilation
from robot_ik.robot import Robot, load_robot
from robot_ik.solvers.base import Solver
from robot_ik.solvers.iterative import IterativeSolver
from robot_ik.testbed.commands import SetCourse, SetRobot, SetupCommand
from robot_ik.testbed.problem_text import problem_text
from robot_ik.testbed.robot_goals import RobotGoals, first_ball
from robot_ik.testbed.setup import MethodChoice, Ready, Setup, prepare, warm_drag

_log = logging.getLogger(__name__)

_NICENESS = 10
"""Niceness of the processes. The page, and the browser that loads it, come first."""

_SETUP = TypeAdapter(Setup)
"""Converts a setup to JSON for the processes, and back."""


def is_compiled(goals: Sequence[Goal], solver: Solver) -> bool:
    """Return whether the kernel of a method for such goals is in the cache; True if unknown."""
    if not isinstance(solver, IterativeSolver):
        return True
    return jit.compiled(solver.module_for(has_levels(goals)).solve)


class Compilers:
    """Runs the processes, one job at a time."""

    def __init__(self) -> None:
        self._running: list[Precompilation] = []
        self._lock = threading.Lock()
        self._over = False

    def setup(
        self, setup: Setup, missing: Sequence[MethodChoice], say: Callable[[str], None]
    ) -> None:
        """Compile the missing methods of a setup. Return when it is done or has failed."""
        for half in filter(None, (missing[::2], missing[1::2])):
            # The session itself computes what a figure can do, and shows the progress.
            choices = tuple(half)
            count: Any = len(half)
            part = replace(setup, count=count, choices=choices, figure="off")
            self._start("prepare_setup", _SETUP.dump_json(part).decode())
        self._follow(" and ".join(choice.method for choice in missing), say)

    def drag(self, robot: str, say: Callable[[str], None]) -> None:
        """Compile the kernels of dragging. Return when it is done or has failed."""
        self._start("prepare_drag", robot)
        self._follow("the kernels of dragging parts", say)

    def close(self) -> None:
        """End the processes and start no more."""
        with self._lock:
            self._over = True
            self._end()

    def _end(self) -> None:
        for compilation in self._running:
            compilation.close()
        self._running = []

    def _start(self, function: str, argument: str) -> None:
        with self._lock:
            if not self._over:
                compilation = Precompilation(f"{__name__}:{function}", argument, niceness=_NICENESS)
                self._running.append(compilation)

    def _follow(self, what: str, say: Callable[[str], None]) -> None:
        """Wait for the processes and show their progress."""
        running = list(self._running)
        names = itertools.chain.from_iterable(
            compilation.compiled_functions() for compilation in running
        )
        for count, _ in enumerate(names, start=1):
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
    """Prepares setups, one after the other.

    Args:
        setup: What the session begins with.
        robot: The robot of the setup.
        done: Called with each result.
        beside: Prepare on a thread, from ``begin`` on. Else at once.

    Attributes:
        can_drag: Whether the kernels of dragging are ready.
    """

    def __init__(
        self, setup: Setup, robot: Robot, done: Callable[[SetupDone], None], *, beside: bool
    ) -> None:
        self._setup = setup
        self._robot = robot
        self._done = done
        self._beside = beside
        self._ready: Ready | None = None
        self._jobs: queue.Queue[SetupCommand | type[Preparer] | None] = queue.Queue()
        self._thread: threading.Thread | None = None
        self._compilers = Compilers()
        self.can_drag = False
        self._text = "preparing …"

    @property
    def doing(self) -> str:
        """Description of the present preparation. Empty without one."""
        return self._text if self._jobs.unfinished_tasks else ""

    def begin(self) -> None:
        """Prepare what the session begins with, on the thread, at the first call."""
        if self._beside and self._thread is None:
            self._thread = threading.Thread(target=self._work, name="testbed-preparer", daemon=True)
            self._thread.start()
            self.ask(None)

    def ask(self, command: SetupCommand | None) -> None:
        """Prepare the setup after a command. None: what the session begins with."""
        self._jobs.put(command)
        if not self._beside:
            self._do(self._jobs.get())

    def close(self) -> None:
        """End, without waiting for a compiler."""
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
            if isinstance(command, SetRobot | SetCourse):
                self._say(f"loading {wanted.robot} …")
                robot = load_robot(wanted.robot)
            ready = prepare(wanted, robot, self._ready, self._say, self._compile)
        except RobotIkError as error:
            self._done(SetupDone(command, error=problem_text(error)))
        except Exception as error:  # without a result the page would wait forever
            _log.exception("cannot prepare %s", command)
            self._done(SetupDone(command, error=f"the command cannot be prepared: {error}"))
        else:
            self._setup = ready.setup
            self._robot = robot
            self._ready = ready
            self._done(SetupDone(command, ready=ready))
            self._warm_drag(robot)
        finally:
            self._jobs.task_done()

    def _compile(
        self, setup: Setup, robot: Robot, goals: RobotGoals, solvers: Sequence[Solver]
    ) -> None:
        """Compile missing methods in other processes: a compiler here would hold up the page."""
        if not self._beside:
            return
        missing: dict[str, MethodChoice] = {}
        for choice, solver in zip(setup.choices, solvers, strict=False):
            with contextlib.suppress(RobotIkError):  # ``prepare`` reports the reason
                if not is_compiled(goals.all(first_ball(robot), solver), solver):
                    missing[choice.method] = choice
        if missing:
            self._say("starting to compile …")
            self._compilers.setup(setup, list(missing.values()), self._say)

    def _warm_drag(self, robot: Robot) -> None:
        """Prepare dragging after the first answer, so that the answer does not wait for it."""
        if not self.can_drag:
            self._say("preparing to drag parts …")
            if self._beside and not jit.compiled(priorities.solve):
                self._compilers.drag(self._setup.robot, self._say)
            with contextlib.suppress(RobotIkError):  # a model without a part that can be dragged
                warm_drag(robot)
            self.can_drag = True

    def _say(self, text: str) -> None:
        self._text = text


def prepare_setup(text: str) -> None:
    """Prepare a setup (JSON), so that its kernels are compiled."""
    setup = _SETUP.validate_json(text)
    prepare(setup, load_robot(setup.robot), None, logging.getLogger(__name__).debug)


def prepare_drag(robot: str) -> None:
    """Prepare dragging, so that its kernels are compiled."""
    warm_drag(load_robot(robot))
