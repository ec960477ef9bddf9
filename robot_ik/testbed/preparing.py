"""What a session needs that must load or compile, made ready beside its loop."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from robot_ik.errors import RobotIkError
from robot_ik.kernels import jit
from robot_ik.kernels.priorities import lm_levels
from robot_ik.robot import Robot, load_robot
from robot_ik.solvers.base import Solver
from robot_ik.testbed.commands import Command, SetRobot
from robot_ik.testbed.compiling import Compilers, is_compiled
from robot_ik.testbed.setup import Ready, RobotGoals, Setup, first_ball, prepare, warm_drag

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SetupDone(Command):
    """A command that was prepared beside the loop, and what came of it."""

    command: Command | None = None
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
        self._jobs: queue.SimpleQueue[Command | type[Preparer] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._waiting = 0
        self._compilers = Compilers()
        self.can_drag = False
        self._lock = threading.Lock()
        self._text = "preparing …"

    @property
    def doing(self) -> str:
        """As text; empty: nothing."""
        return self._text if self._waiting else ""

    def begin(self) -> None:
        """What the session begins with, beside the loop; once."""
        if self._beside and self._thread is None:
            self._thread = threading.Thread(target=self._work, name="testbed-preparer", daemon=True)
            self._thread.start()
            self.ask(None)

    def ask(self, command: Command | None) -> None:
        """Prepares what the command asks for; None: what the session begins with."""
        self._count(1)
        if self._beside:
            self._jobs.put(command)
        else:
            self._do(command)

    def close(self) -> None:
        """No more; what is being compiled is not waited for."""
        self._compilers.close()
        self._jobs.put(Preparer)

    def _work(self) -> None:
        while True:
            job = self._jobs.get()
            if job is Preparer:
                return
            self._do(job)  # type: ignore[arg-type]

    def _do(self, command: Command | None) -> None:
        self._text = "preparing …"
        try:
            wanted = self._setup if command is None else self._setup.after(command)
            if isinstance(command, SetRobot):
                self._say(f"loading {command.name} …")
                robot = load_robot(wanted.robot)
            else:
                robot = self._robot
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
            self._count(-1)

    def _compile(self, setup: Setup, robot: Robot, goals: RobotGoals, solvers: Sequence[Solver]) -> None:
        """In other processes, what takes long: a compiler here would hold up the page."""
        if not self._beside:
            return
        missing = []
        for solver in solvers:
            with contextlib.suppress(RobotIkError):  # it cannot serve these goals: ``prepare`` says why
                if not is_compiled(robot, goals.all(first_ball(robot), solver), solver):
                    missing.append(solver)
        if missing:
            self._say("starting to compile …")
            self._compilers.setup(setup, missing, self._say)

    def _warm_drag(self, robot: Robot) -> None:
        """After the first answer: who drags nothing does not wait for it."""
        if not self.can_drag:
            self._say("preparing to drag parts …")
            if self._beside and not jit.compiled(lm_levels):
                self._compilers.drag(self._setup.robot, self._say)
            with contextlib.suppress(RobotIkError):  # a model of which nothing can be dragged
                warm_drag(robot)
            self.can_drag = True

    def _count(self, change: int) -> None:
        with self._lock:
            self._waiting += change

    def _say(self, text: str) -> None:
        self._text = text
