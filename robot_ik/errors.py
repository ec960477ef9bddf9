"""Every error that this package raises, as one tree.

A message says what was given, what is allowed and what to try. Constructors take data and keep it
as attributes, so that a program can act on the cause without reading the message. A goal that is
not reached is not an error: it is a ``Solution`` with a status.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robot_ik.solution import Solution

LONGEST_NAME = 60
"""Characters of a name in a message, and of a name for which close names are looked up."""

MAX_NAMES = 30
"""Names that a message lists at most."""

DISTRIBUTION = "robot-ik-testbed"
"""Name on the package index. ``robot-ik`` is another project, which installs ``robot_ik`` too."""


def install_command(extra: str = "") -> str:
    """Return the shell command that installs this package, with an optional extra."""
    return f'pip install "{DISTRIBUTION}[{extra}]"' if extra else f"pip install {DISTRIBUTION}"


def close_matches(name: str, known: Iterable[str], count: int = 3) -> list[str]:
    """Return the known names that ``name`` may be a typing error of, best first.

    A typing error is one wrong, missing, additional or exchanged letter for each three letters of
    the name, in names of at least three letters. Case and leading dashes do not count. Another
    number is not a typing error: ``joint9`` does not mean ``joint1``. A word or the beginning of a
    known name is close to it too: ``elbow`` to ``elbow_joint``.

    Args:
        name: The unknown name. Values of other types are compared by their text.
        known: The names that exist.
        count: The largest number of names to return.
    """
    given = str(name).lower().lstrip("-")
    if not 0 < len(given) <= LONGEST_NAME:
        return []
    ranked = []
    for item in known:
        rank = _typing_errors(given, item.lower().lstrip("-"))
        if rank is not None:
            ranked.append((rank, item))
    ranked.sort(key=lambda pair: pair[0])
    return [item for _, item in ranked[:count]]


def _typing_errors(given: str, known: str) -> int | None:
    """Return the number of typing errors between two names, None if they are not close."""
    limit = max(len(given), len(known)) // 3
    if not _have_other_numbers(given, known) and abs(len(given) - len(known)) <= limit:
        distance = _edit_distance(given, known)
        if distance <= limit:
            return distance
    if len(given) >= 3 and (known.startswith(given) or given in re.split(r"[^a-z0-9]+", known)):
        return limit + 1
    return None


def _have_other_numbers(first: str, second: str) -> bool:
    """Return whether a digit of one name is replaced in the other."""
    digits = re.sub(r"\D", "", first)
    others = re.sub(r"\D", "", second)
    return len(digits) == len(others) and sorted(digits) != sorted(others)


def _edit_distance(first: str, second: str) -> int:
    """Return the edit distance in which exchanged neighbours count as one error.

    This is the optimal string alignment distance (Damerau 1964).
    """
    before_last: list[int] = []
    last = list(range(len(second) + 1))
    for i, letter in enumerate(first, 1):
        row = [i]
        for j, other in enumerate(second, 1):
            cost = min(last[j] + 1, row[j - 1] + 1, last[j - 1] + (letter != other))
            if i > 1 and j > 1 and letter == second[j - 2] and other == first[i - 2]:
                cost = min(cost, before_last[j - 2] + 1)
            row.append(cost)
        before_last = last
        last = row
    return last[-1]


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a question with the close names, empty if there are none."""
    close = close_matches(name, known)
    return f"did you mean {' or '.join(close)}?" if close else ""


def unknown_name_text(kind: str, name: str, known: Sequence[str]) -> str:
    """Return the message for an unknown name: close names first, then the known names.

    Args:
        kind: The kind of thing that has the name: "robot".
        name: The unknown name.
        known: The names that exist.
    """
    quoted = repr(name)
    if len(quoted) > LONGEST_NAME:
        quoted = quoted[: LONGEST_NAME - 1] + "…"
    text = f"unknown {kind} {quoted}"
    if not known:
        return f"{text}; there is no {kind}."
    names = ", ".join(list(known)[:MAX_NAMES]) + (", …" if len(known) > MAX_NAMES else "")
    close = close_matches(name, known)
    if close:
        return f"{text}; did you mean {' or '.join(map(repr, close))}? Known: {names}."
    return f"{text}; known: {names}."


def distinct_texts(*values: float, digits: int = 1, form: str = "f") -> list[str]:
    """Return numbers as text, with enough digits that different numbers differ.

    Args:
        values: The numbers.
        digits: The smallest number of digits: after the point for form "f", in total for form "g".
        form: The format of the numbers, "f" or "g".
    """
    texts: list[str] = []
    for count in range(digits, 18):
        texts = [f"{value:.{count}{form}}" for value in values]
        if len(set(texts)) >= len(set(values)):
            break
    return texts


class RobotIkError(Exception):
    """Root of all errors of this package.

    Attributes:
        hint: What to try. Empty if there is no advice.
    """

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint

    def __str__(self) -> str:
        text = super().__str__()
        return f"{text}\n{self.hint}" if self.hint else text


class CameraError(RobotIkError):
    """Root of the errors of cameras, markers and calibrations."""


class CameraNotFoundError(CameraError):
    """A camera, file or URL cannot be opened. The hint lists the cameras that exist."""


class FrameTimeoutError(CameraError):
    """A source of pictures has stopped."""


class FrameSizeError(CameraError):
    """Pictures have another size than requested or than the calibration is for."""


class MarkerNotFoundError(CameraError):
    """The requested marker is not in the picture."""


class CalibrationError(CameraError):
    """A calibration is missing, malformed, implausible or of another camera."""


class ConfigError(RobotIkError, ValueError):
    """A configuration file is wrong.

    Attributes:
        problem: What is wrong.
        file: The file.
        key: The dotted key. Empty for the whole file.
        allowed: What is allowed.
    """

    def __init__(
        self,
        problem: str,
        *,
        file: Path | str,
        key: str = "",
        allowed: str = "",
        hint: str = "",
    ) -> None:
        super().__init__(_located(problem, (str(file), key), allowed), hint=hint)
        self.problem = problem
        self.file = file
        self.key = key
        self.allowed = allowed


class OptionError(RobotIkError, ValueError):
    """An argument of a function or an option of a solver is wrong.

    Attributes:
        option: Name of the argument or option. Empty if the problem concerns several.
        problem: What is wrong.
        allowed: What is allowed.
        owner: What has the option: "solver lm". Empty for an argument of the called function.
    """

    def __init__(
        self,
        option: str,
        problem: str,
        allowed: str = "",
        *,
        owner: str = "",
        hint: str = "",
    ) -> None:
        super().__init__(_located(problem, (owner, option), allowed), hint=hint)
        self.option = option
        self.problem = problem
        self.allowed = allowed
        self.owner = owner


def _located(problem: str, places: Iterable[str], allowed: str) -> str:
    """Return a message that begins with the place of a problem and ends with what is allowed."""
    text = ": ".join([*filter(None, places), problem])
    return f"{text}; allowed: {allowed}" if allowed else text


class MissingExtraError(RobotIkError, ImportError):
    """An optional package is not installed. The hint is the command that installs it.

    Attributes:
        package: The package that is missing.
        extra: The extra of this package that installs it.
        purpose: What needs the package.
    """

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        self.package = package
        self.extra = extra
        self.purpose = purpose
        super().__init__(
            f"{purpose} needs the package {package!r}, which is not installed",
            hint=f"install it with: {install_command(extra)}",
        )


class ViewerError(RobotIkError):
    """A window cannot be opened. The hint names an alternative command."""


class OutputError(RobotIkError, OSError):
    """A result cannot be written to the requested place."""


class HardwareError(RobotIkError):
    """Root of the errors of buses, servos and arms."""


class BusNotOpenError(HardwareError):
    """A port is missing, not a serial port, not permitted or already in use."""


class BusDisconnectedError(HardwareError):
    """A port disappeared while it was in use: the cable was pulled or the adapter was reset."""


def _servo(id: int, joint: str) -> str:
    return f"servo id {id}" + (f" (joint {joint!r})" if joint else "")


class BusTimeoutError(HardwareError):
    """A servo did not answer.

    Attributes:
        id: Id of the servo.
        register: Register that was read or written.
        port: The port.
        joint: Name of the joint, if known.
        last_good: Seconds since the last reply. None if the servo never answered.
        all_servos: Whether no servo of the bus answers.
    """

    def __init__(
        self,
        *,
        id: int,
        register: str,
        port: str,
        joint: str = "",
        last_good: float | None = None,
        all_servos: bool = False,
        hint: str = "check power, cable, id and baud rate",
    ) -> None:
        self.id = id
        self.register = register
        self.port = port
        self.joint = joint
        self.last_good = last_good
        self.all_servos = all_servos
        when = "it never answered" if last_good is None else f"last answer {last_good:.2f} s ago"
        if all_servos:
            text = f"no servo answers on {port}"
        else:
            text = f"no answer from {_servo(id, joint)} on {port} ({register})"
        super().__init__(f"{text}; {when}", hint=hint)


class BusCorruptError(HardwareError):
    """A reply has a wrong checksum or length. No part of it was used."""


class ServoRefusedError(HardwareError):
    """A servo replied with an error number.

    Attributes:
        id: Id of the servo.
        register: Register that was read or written.
        code: The error number (Protocol 2.0, bits 0 to 6 of ERR).
        reason: Name of the error.
        joint: Name of the joint, if known.
    """

    def __init__(self, *, id: int, register: str, code: int, reason: str, joint: str = "") -> None:
        self.id = id
        self.register = register
        self.code = code
        self.reason = reason
        self.joint = joint
        super().__init__(f"{_servo(id, joint)} refused {register}: {reason} (error {code})")


class ServoMismatchError(HardwareError):
    """The servos on a bus are not the servos that the arm file names.

    Attributes:
        expected: Model of each id in the arm file.
        detected: Model of each id on the bus.
        port: The port.
    """

    def __init__(
        self,
        expected: Mapping[int, str],
        detected: Mapping[int, str],
        *,
        port: str,
        hint: str = "",
        source: str = "the arm file",
    ) -> None:
        self.expected = dict(expected)
        self.detected = dict(detected)
        self.port = port
        ids = sorted({*expected, *detected})
        width = max([len(expected.get(id, "")) for id in ids] + [len("expected")])
        rows = [f"  {'id':>3}  {'expected':<{width}}  detected"]
        for id in ids:
            model = expected.get(id, "-")
            rows.append(f"  {id:>3}  {model:<{width}}  {detected.get(id, 'missing')}")
        text = f"the servos on {port} are not those of {source}; nothing was switched on"
        usual = (
            "check power, cable, ids, the arm file; robot-ik servo scan looks at every baud rate"
        )
        super().__init__("\n".join((text, *rows)), hint=hint or usual)


class MotorFaultError(HardwareError):
    """A servo has shut down, or the arm is in its latched fault state.

    Attributes:
        joint: Name of the joint.
        status: Names of the hardware errors.
    """

    def __init__(self, joint: str, status: Sequence[str], *, hint: str = "") -> None:
        self.joint = joint
        self.status = tuple(status)
        super().__init__(f"joint {joint!r} is in fault: {', '.join(status)}", hint=hint)


class StopRequestedError(HardwareError):
    """A stop of the arm was requested by ``robot-ik stop``, a key or another thread."""


class UnsafeCommandError(HardwareError, ValueError):
    """A command was refused. Nothing was sent to any servo.

    Attributes:
        command: The refused command.
        allowed: What is allowed.
    """

    def __init__(self, command: str, allowed: str) -> None:
        self.command = command
        self.allowed = allowed
        super().__init__(f"refused: {command}; allowed: {allowed}. Nothing was sent to any servo.")


class ArmStateError(HardwareError):
    """The operation is not possible in the state of the arm."""


class ModelError(RobotIkError):
    """A robot model cannot be found, read or used.

    Attributes:
        path: The model file, if there is one.
        reason: Message of the reader, usually MuJoCo.
    """

    def __init__(
        self,
        message: str,
        *,
        path: Path | str | None = None,
        reason: str = "",
        hint: str = "",
    ) -> None:
        super().__init__(message, hint=hint)
        self.path = path
        self.reason = reason


class InvalidModelError(ModelError, ValueError):
    """A model cannot be built from the given values, or a value has a wrong type."""


class InvalidPoseError(RobotIkError, ValueError):
    """A pose has a wrong shape, a number that is not finite, or a zero quaternion."""


class _UnknownName(RobotIkError, LookupError):
    """A name does not exist.

    Attributes:
        name: The unknown name.
        known: The names that exist.
        close: The known names that ``name`` may be a typing error of.
    """

    kind = "name"

    def __init__(self, name: str, known: Iterable[str], *, hint: str = "") -> None:
        self.name = name
        self.known = tuple(known)
        self.close = tuple(close_matches(name, self.known))
        super().__init__(unknown_name_text(self.kind, name, self.known), hint=hint)


class UnknownRobotError(_UnknownName, ModelError, ValueError):
    """The catalogue has no robot of this name."""

    kind = "robot"


class UnknownFrameError(_UnknownName, ModelError):
    """The robot has no frame (tool, site or body) of this name."""

    kind = "frame"


class UnknownJointError(_UnknownName, ModelError):
    """The robot has no joint of this name."""

    kind = "joint"


def require_joints(joints: Iterable[str], names: Sequence[str], source: str = "") -> None:
    """Raise ``UnknownJointError`` for the first joint that is not among ``names``.

    Args:
        joints: Names to check.
        names: Names that exist.
        source: What names the joints, for the message.
    """
    for joint in joints:
        if joint not in names:
            raise UnknownJointError(joint, names, hint=f"named by {source}" if source else "")


class UnsupportedJointError(ModelError):
    """A joint exists but cannot be used for the requested purpose."""


class CollisionError(RobotIkError):
    """Root of the errors of scenes, obstacles and collision checks."""


class InvalidObstacleError(CollisionError, ValueError):
    """An obstacle is malformed: a size that is not positive, a name that exists already, NaN."""


class UnknownObstacleError(_UnknownName, CollisionError):
    """The scene has no obstacle of this name."""

    kind = "obstacle"


class UnknownPartError(_UnknownName, CollisionError):
    """The scene has no body or geom of this name."""

    kind = "body or geom"


class UnsupportedGeomError(CollisionError):
    """A geom that takes part in collisions has a type whose distance is not exact.

    Attributes:
        geom: Name of the geom.
        type: Its type: height field or signed distance function.
    """

    def __init__(self, geom: str, type: str) -> None:
        self.geom = geom
        self.type = type
        super().__init__(
            f"geom {geom!r} is a {type}, whose distances are not exact",
            hint="replace it by boxes or meshes, or set contype and conaffinity of the geom to 0",
        )


class ReachabilityMapError(RobotIkError):
    """A folder that holds no reachability map, or a map that does not fit its robot."""


class GoalError(RobotIkError, ValueError):
    """Root of the errors of goals."""


class InvalidGoalError(GoalError):
    """A goal is malformed: wrong shape, NaN, zero quaternion, negative weight."""


class UnsupportedGoalError(GoalError):
    """A solver does not support a kind of goal. The hint names the solvers that do.

    Attributes:
        solver: Name of the solver.
        goal: The goal in words.
        able: Names of the solvers that support the goal.
    """

    def __init__(self, solver: str, goal: str, able: Iterable[str]) -> None:
        self.solver = solver
        self.goal = goal
        self.able = tuple(able)
        names = ", ".join(self.able)
        hint = f"these solvers do: {names}" if names else "no solver supports it yet"
        super().__init__(f"solver {solver!r} does not support {goal}", hint=hint)


class ProblemInUseError(RobotIkError):
    """Two threads called a ``Problem`` at the same time. Nothing was changed."""

    def __init__(self) -> None:
        super().__init__(
            "this Problem is being solved by another thread: its arrays are in use",
            hint="give each thread a Problem of its own (copy.copy(problem)), or use a lock",
        )


class UnknownSolverError(_UnknownName):
    """``SOLVERS`` has no solver of this name."""

    kind = "solver"


class NotConvergedError(RobotIkError):
    """A solve did not converge, or its result is refused. Usually from ``Solution.require()``.

    Attributes:
        solution: The solution with its status.
    """

    def __init__(self, message: str, solution: Solution) -> None:
        super().__init__(message)
        self.solution = solution


class TrajectoryError(RobotIkError):
    """No path within the limits connects the given configurations or poses."""


class MotionBlockedError(TrajectoryError, CollisionError):
    """A motion would touch, or come nearer than the margin.

    Attributes:
        time: Seconds from the start of the motion.
        pair: Names of the two parts.
        distance: Smallest known distance of the two parts on the motion, m; negative: the
            depth of their contact.
        margin: The required distance, m.
        q: Joint angles (nq,) at ``time``.
    """

    def __init__(
        self, time: float, pair: tuple[str, str], distance: float, margin: float, q: object
    ) -> None:
        self.time = time
        self.pair = pair
        self.distance = distance
        self.margin = margin
        self.q = q
        if time > 0.0:
            text = f"{contact_text(pair, distance, margin)} at {time:.2f} s"
            hint = "move around it, or give the pair as ignore if they may touch"
        else:
            text = f"{contact_text(pair, distance, margin)} at the start"
            hint = "move these parts apart first, or give the pair as ignore if they may touch"
        super().__init__(text, hint=hint)


def contact_text(pair: tuple[str, str], distance: float, margin: float) -> str:
    """Return in words that two parts would touch, or come nearer than a margin.

    Args:
        pair: Names of the two parts.
        distance: Their distance, m; negative: the depth of their contact.
        margin: The required distance, m.
    """
    first, second = pair
    if distance < 0.0:
        return f"{first} would touch {second} by {-1e3 * distance:.1f} mm"
    return (
        f"{first} would come within {1e3 * distance:.1f} mm of {second} "
        f"(margin {1e3 * margin:.1f} mm)"
    )


class PlanningError(TrajectoryError):
    """``plan`` found no motion. Only ``Plan.require()`` raises it.

    Attributes:
        plan: The plan with its status.
    """

    def __init__(self, message: str, plan: object, *, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.plan = plan


NOT_ACHIEVED_ERRORS = (NotConvergedError, MarkerNotFoundError, TrajectoryError, MotorFaultError)
"""Errors that mean "tried and not achieved". All others mean wrong input or environment."""
