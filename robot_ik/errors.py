"""Every error this package raises, as one tree.

The text of an error tells what was given. Where they are known it adds what is allowed, as
``ConfigError.allowed``, and what to try, as ``RobotIkError.hint``.
Constructors take data and keep it as attributes, so that a program can act on the cause
without reading the text.  "No solution" is not an error: it is a ``Solution`` whose status says so.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robot_ik.solution import Solution


#: Name on the package index. ``robot-ik`` there is another project, which also installs ``robot_ik``.
DISTRIBUTION = "robot-ik-testbed"


#: Ratio of ``difflib`` from which a name is suggested. With two letters of three swapped it is 0.67.
#: Names that only share some letters, such as record and seconds, have at most 0.62.
CLOSE = 0.65


def install_command(extra: str = "") -> str:
    """Return the shell command that installs this package, with an optional extra."""
    return f'pip install "{DISTRIBUTION}[{extra}]"' if extra else f"pip install {DISTRIBUTION}"


def close_matches(name: str, known: Iterable[str], count: int = 3) -> list[str]:
    """Known names most like ``name``, best first, without regard to case and leading dashes."""
    name = str(name)  # None or a number is an unknown name too
    by_letters = {item.lower().lstrip("-"): item for item in known}
    letters = name.lower().lstrip("-")
    found = difflib.get_close_matches(letters, list(by_letters), n=count, cutoff=CLOSE)
    return [by_letters[item] for item in found]


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint with the known names that are close, if any."""
    close = close_matches(name, known)
    return f"did you mean {' or '.join(close)}?" if close else ""


def unknown_name_text(kind: str, name: str, known: Sequence[str]) -> str:
    """One sentence for an unknown name: the close ones first, then what exists."""
    shown = repr(name)
    text = f"unknown {kind} {shown if len(shown) <= 60 else shown[:59] + '…'}"
    if not known:
        return f"{text}; there is no {kind} at all here."
    shown = ", ".join(list(known)[:30]) + (", …" if len(known) > 30 else "")
    if close := close_matches(name, known):
        return f"{text}; did you mean {' or '.join(map(repr, close))}? Known: {shown}."
    return f"{text}; known: {shown}."


def apart(*values: float, digits: int = 1, form: str = "f") -> list[str]:
    """Numbers as text, with as many digits as it takes to distinguish those that differ.

    At least ``digits`` behind the point (``form`` "f") or in all ("g").
    """
    texts: list[str] = []
    for count in range(digits, 18):
        texts = [f"{value:.{count}{form}}" for value in values]
        if len(set(texts)) >= len(set(values)):
            break
    return texts


class RobotIkError(Exception):
    """Root of all errors of this package; ``hint`` is what to try next, if anything."""

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint

    def __str__(self) -> str:
        text = super().__str__()
        return f"{text}\n{self.hint}" if self.hint else text


class CameraError(RobotIkError):
    """Root of the errors of pictures, markers and calibrations."""


class CameraNotFoundError(CameraError):
    """The camera, file or URL cannot be opened; the hint lists what exists."""


class FrameTimeoutError(CameraError):
    """The source stopped delivering pictures."""


class FrameSizeError(CameraError):
    """Pictures have another size than asked for, or than the calibration is made for."""


class MarkerNotFoundError(CameraError):
    """A picture was taken but the wanted marker is not in it."""


class CalibrationError(CameraError):
    """A calibration is missing, malformed, implausible or made for another camera."""


class ConfigError(RobotIkError, ValueError):
    """A configuration file is wrong: ``file``, dotted ``key`` (empty: the whole), what is ``allowed``."""

    def __init__(
        self, problem: str, *, file: Path | str, key: str = "", allowed: str = "", hint: str = ""
    ) -> None:
        self.file, self.key, self.allowed = file, key, allowed
        where = f"{file}: {key}: " if key else f"{file}: "
        super().__init__(where + problem + (f"; allowed: {allowed}" if allowed else ""), hint=hint)


class MissingExtraError(RobotIkError, ImportError):
    """An optional package is not installed; the message is the command that installs it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        self.package, self.extra = package, extra
        super().__init__(
            f"{purpose} needs the package {package!r}, which is not installed",
            hint=f"install it with: {install_command(extra)}",
        )


class ViewerError(RobotIkError):
    """A window cannot be opened; the hint says what to run instead."""


class OutputError(RobotIkError, OSError):
    """A result cannot be written where it was asked for."""


class HardwareError(RobotIkError):
    """Root of everything that can go wrong between the joint angles and the servos."""


class BusNotOpenError(HardwareError):
    """The port is missing, not a serial port, not permitted or already in use."""


class BusDisconnectedError(HardwareError):
    """The port went away while it was in use (cable pulled, adapter reset)."""


def _servo(id: int, joint: str) -> str:
    return f"servo id {id}" + (f" (joint {joint!r})" if joint else "")


class BusTimeoutError(HardwareError):
    """A servo, or ``everyone``, did not answer; ``last_good``: seconds since a reply, None: never."""

    def __init__(
        self,
        *,
        id: int,
        register: str,
        port: str,
        joint: str = "",
        last_good: float | None = None,
        everyone: bool = False,
        hint: str = "check power, cable, id and baud rate",
    ) -> None:
        self.id, self.register, self.port, self.joint = id, register, port, joint
        self.last_good, self.everyone = last_good, everyone
        when = "it never answered" if last_good is None else f"last answer {last_good:.2f} s ago"
        asked = f"no answer from {_servo(id, joint)} on {port} ({register})"
        super().__init__(f"no servo answers on {port}; {when}" if everyone else f"{asked}; {when}", hint=hint)


class BusCorruptError(HardwareError):
    """An answer came but cannot be trusted (checksum, length); nothing of it was used."""


class ServoRefusedError(HardwareError):
    """A servo answered with an error number (Protocol 2.0, ERR bits 0-6); ``reason`` is its name."""

    def __init__(self, *, id: int, register: str, code: int, reason: str, joint: str = "") -> None:
        self.id, self.register, self.code, self.reason, self.joint = id, register, code, reason, joint
        super().__init__(f"{_servo(id, joint)} refused {register}: {reason} (error {code})")


class ServoMismatchError(HardwareError):
    """The servos found (id -> model) are not those that the arm file, or another ``source``, names."""

    def __init__(
        self, expected: Mapping[int, str], found: Mapping[int, str], *, port: str, hint: str = "",
        source: str = "the arm file",
    ) -> None:  # fmt: skip
        self.expected, self.found, self.port = dict(expected), dict(found), port
        ids = sorted({*expected, *found})
        width = max([len(expected.get(i, "")) for i in ids] + [8])
        rows = [f"  {'id':>3}  {'expected':<{width}}  found"]
        rows += [f"  {i:>3}  {expected.get(i, '-'):<{width}}  {found.get(i, 'missing')}" for i in ids]
        text = f"the servos on {port} are not those of {source}; nothing was switched on\n" + "\n".join(rows)
        usual = "check power, cable, ids, the arm file; robot-ik servo scan looks at every baud rate"
        super().__init__(text, hint=hint or usual)


class MotorFaultError(HardwareError):
    """A servo has shut down or the arm has latched a fault; ``status``: decoded hardware error names."""

    def __init__(self, joint: str, status: Sequence[str], *, hint: str = "") -> None:
        self.joint, self.status = joint, tuple(status)
        super().__init__(f"joint {joint!r} is in fault: {', '.join(status)}", hint=hint)


class StopRequestedError(HardwareError):
    """Somebody asked the arm to stop: ``robot-ik stop``, a key, another thread."""


class UnsafeCommandError(HardwareError, ValueError):
    """A command that must not be obeyed even in part; nothing was sent."""

    def __init__(self, asked: str, allowed: str) -> None:
        self.asked = asked
        self.allowed = allowed
        super().__init__(f"refused: {asked}; allowed: {allowed}. Nothing was sent to any servo.")


class ArmStateError(HardwareError):
    """The arm is not in a state in which this can be done."""


class ModelError(RobotIkError):
    """A robot model cannot be found, read or used; ``reason`` is what the reader (usually MuJoCo) said."""

    def __init__(
        self, message: str, *, path: Path | str | None = None, reason: str = "", hint: str = ""
    ) -> None:
        super().__init__(message, hint=hint)
        self.path, self.reason = path, reason


class InvalidModelError(ModelError, ValueError):
    """No model can be made of these values, or what was given as a robot is no name, path, text or spec."""


class InvalidPoseError(RobotIkError, ValueError):
    """A pose of the wrong shape, of numbers that are not finite, or of no orientation."""


class _UnknownName(RobotIkError, LookupError):
    kind = "name"

    def __init__(self, name: str, known: Iterable[str], *, hint: str = "") -> None:
        self.name, self.known = name, tuple(known)
        self.close = tuple(close_matches(name, self.known))
        super().__init__(unknown_name_text(self.kind, name, self.known), hint=hint)


class UnknownRobotError(_UnknownName, ModelError, ValueError):
    """No robot of that name in the catalogue."""

    kind = "robot"


class UnknownFrameError(_UnknownName, ModelError):
    """The robot has no frame (tool, site or body) of that name."""

    kind = "frame"


class UnknownJointError(_UnknownName, ModelError):
    """The robot has no joint of that name."""

    kind = "joint"


def require_joints(joints: Iterable[str], names: Sequence[str], source: str = "") -> None:
    """Raises ``UnknownJointError`` unless all are among ``names``; ``source`` is what names them."""
    for joint in joints:
        if joint not in names:
            raise UnknownJointError(joint, names, hint=f"named by {source}" if source else "")


class UnsupportedJointError(ModelError):
    """A joint exists but cannot be used in the way asked."""


class GoalError(RobotIkError, ValueError):
    """Something is wrong with what was asked of the robot."""


class InvalidGoalError(GoalError):
    """The goal itself is malformed: shape, NaN, zero quaternion, negative weight."""


class UnsupportedGoalError(GoalError):
    """The solver cannot serve this kind of goal; the message names the ones that can."""

    def __init__(self, solver: str, goal: str, able: Iterable[str]) -> None:
        self.solver, self.goal, self.able = solver, goal, tuple(able)
        hint = f"these can: {', '.join(self.able)}" if self.able else "no solver can yet"
        super().__init__(f"solver {solver!r} cannot serve {goal}", hint=hint)


class ProblemInUseError(RobotIkError):
    """A call on a ``Problem`` began while another thread's had not ended; nothing was changed."""

    def __init__(self) -> None:
        super().__init__(
            "this Problem is being solved by another thread: its arrays are in use",
            hint="give each thread a Problem of its own (copy.copy(problem)), or let them take turns",
        )


class UnknownSolverError(_UnknownName):
    """No solver of that name in the ``SOLVERS`` table."""

    kind = "solver"


class NotConvergedError(RobotIkError):
    """Raised only by ``Solution.require()``; carries the solution that was found."""

    def __init__(self, message: str, solution: Solution) -> None:
        super().__init__(message)
        self.solution = solution


class TrajectoryError(RobotIkError):
    """No path within the limits joins the given configurations or poses."""


NOT_ACHIEVED_ERRORS = (NotConvergedError, MarkerNotFoundError, TrajectoryError, MotorFaultError)
"""Errors that mean "tried, not achieved"; every other one is wrong input or environment."""
