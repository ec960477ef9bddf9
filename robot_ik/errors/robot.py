"""Errors of models, goals and solving."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from robot_ik.errors.base import RobotIkError, close_matches, unknown_name_text

if TYPE_CHECKING:
    from robot_ik.solution import Solution


class ModelError(RobotIkError):
    """A robot model cannot be found, read or used.

    Attributes:
        path: The file, when there is one.
        reason: What the reader (usually MuJoCo) said.
    """

    def __init__(
        self, message: str, *, path: Path | str | None = None, reason: str = "", hint: str = ""
    ) -> None:
        super().__init__(message, hint=hint)
        self.path = path
        self.reason = reason


class InvalidModelError(ModelError, ValueError):
    """No model can be made of these values."""


class InvalidPoseError(RobotIkError, ValueError):
    """A pose of the wrong shape, of numbers that are not finite, or of no orientation."""


class _UnknownName(ModelError, LookupError):
    kind = "name"

    def __init__(self, name: str, known: Iterable[str], *, hint: str = "") -> None:
        self.name = name
        self.known = tuple(known)
        self.close = tuple(close_matches(name, self.known))
        super().__init__(unknown_name_text(self.kind, name, self.known), hint=hint)


class UnknownRobotError(_UnknownName, ValueError):
    """No robot of that name in the catalogue, or what was given is no name at all."""

    kind = "robot"


class UnknownFrameError(_UnknownName):
    """The robot has no frame (tool, site or body) of that name."""

    kind = "frame"


class UnknownJointError(_UnknownName):
    """The robot has no joint of that name."""

    kind = "joint"


class UnsupportedJointError(ModelError):
    """A joint exists but cannot be used in the way asked."""


class GoalError(RobotIkError, ValueError):
    """Something is wrong with what was asked of the robot."""


class InvalidGoalError(GoalError):
    """The goal itself is malformed: shape, NaN, zero quaternion, negative weight."""


class UnsupportedGoalError(GoalError):
    """The solver cannot serve this kind of goal; the message names the ones that can."""

    def __init__(self, solver: str, goal: str, able: Iterable[str]) -> None:
        self.solver = solver
        self.goal = goal
        self.able = tuple(able)
        super().__init__(
            f"solver {solver!r} cannot serve {goal}",
            hint=f"these can: {', '.join(self.able)}" if self.able else "no solver can yet",
        )


class ProblemInUseError(RobotIkError):
    """A call on a ``Problem`` began while another thread's had not ended; nothing was changed."""

    def __init__(self) -> None:
        super().__init__(
            "this Problem is being solved by another thread: its arrays are in use",
            hint="give each thread a Problem of its own (copy.copy(problem)), or let them take turns",
        )


class UnknownSolverError(RobotIkError, LookupError):
    """No solver of that name in the ``SOLVERS`` table."""

    def __init__(self, name: str, known: Iterable[str]) -> None:
        self.name = name
        self.known = tuple(known)
        self.close = tuple(close_matches(name, self.known))
        super().__init__(unknown_name_text("solver", name, self.known))


class NotConvergedError(RobotIkError):
    """Raised only by ``Solution.require()``; carries the solution that was found."""

    def __init__(self, message: str, solution: Solution) -> None:
        super().__init__(message)
        self.solution = solution


class TrajectoryError(RobotIkError):
    """No path within the limits joins the given configurations or poses."""
