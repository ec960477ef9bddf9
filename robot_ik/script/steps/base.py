"""Base classes and field types of the steps.

Lengths are metres, angles degrees (``_deg``), tolerances millimetres and degrees, times seconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar, get_args

from pydantic import AfterValidator, Field

from robot_ik.config import KeyProblem, Pair, Table, Word
from robot_ik.hardware import SIMULATED
from robot_ik.script.state import RunState, StepResult, error_classes


def require_known(what: str, name: str | None, known: Iterable[str], key: str = "") -> None:
    """Raise ``KeyProblem`` unless a name is None or known.

    Args:
        what: Kind of the name for the error, such as ``joint``.
        name: The name to check.
        known: All allowed names.
        key: Key of the script that holds the name.
    """
    if name is None:
        return
    names = list(known)
    if name not in names:
        raise KeyProblem.unknown(what, name, names, key)


def _check_error_class(name: str) -> str:
    require_known("error", name, error_classes())
    return name


def _check_span(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] > span[1]:
        raise KeyProblem(f"{list(span)} is empty", allowed="[from, to]")
    return span


#: Longest duration of a step, seconds: one day.
LONGEST = 86_400.0
#: A number that is not negative.
NotNegative = Annotated[float, Field(ge=0.0)]
#: A duration of a step, seconds.
Seconds = Annotated[float, Field(gt=0.0, le=LONGEST)]
#: Shortest and longest allowed duration, seconds.
Span = Annotated[Pair, AfterValidator(_check_span)]
#: A share of a limit, above 0 and at most 1.
Share = Annotated[float, Field(gt=0.0, le=1.0)]
#: Name of an error class of ``robot_ik.errors``.
ErrorClass = Annotated[Word, AfterValidator(_check_error_class)]


#: The kinds of steps by the value of ``do``. Each class registers itself.
STEPS: dict[str, type[ScriptStep]] = {}


class ScriptStep(Table):
    """A step of a script. A subclass with a key ``do`` is a kind of step.

    Attributes:
        do: Kind of the step.
        name: Title of the step in the report. Empty: a title made from ``title_keys``.
    """

    title_keys: ClassVar[tuple[str, ...]] = ()
    """Keys whose values follow ``do`` in the title of a step without a name."""
    simulated_only: ClassVar[bool] = False
    """Whether the step is rejected on a real port. It injects faults or restarts servos."""

    do: str
    name: str = ""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        STEPS.update(dict.fromkeys(get_args(cls.model_fields["do"].annotation), cls))

    @property
    def needs_camera(self) -> bool:
        """Whether the step needs the synthetic camera."""
        return False

    @property
    def title(self) -> str:
        """Title of the step in the report."""
        if self.name:
            return self.name
        parts = [self.do]
        for key in self.title_keys:
            value = getattr(self, key)
            if isinstance(value, dict):
                unit = " mm" if key == "joints_mm" else "°"
                parts += [f"{joint} {number:g}{unit}" for joint, number in value.items()]
            elif isinstance(value, tuple):
                parts += [f"{number:g}" for number in value]
            elif value is not None:
                parts.append(f"{value:g} s" if key == "seconds" else str(value))
        return " ".join(parts)

    def check(self, state: RunState) -> None:
        """Check that the robot, the arm and the bus fit the step. Open and move nothing.

        Raises:
            KeyProblem: The robot, the arm or the bus does not fit.
        """
        if state.simulated:
            return
        if self.simulated_only:
            problem = f"{self.do!r} needs simulated servos, and this is a real port"
            raise KeyProblem(problem, "do", SIMULATED)
        if self.needs_camera:
            problem = "the synthetic camera cannot take pictures of a real scene"
            raise KeyProblem(problem, "do", "other steps, or robot-ik reach")

    def run(self, state: RunState, result: StepResult) -> None:
        """Run the step and write what was measured into ``result``.

        Raises:
            StepFailed: The step did not do what it should.
            RobotIkError: The arm, the camera or the solver failed.
        """
        raise NotImplementedError


def step_class(table: Mapping[str, Any]) -> type[ScriptStep]:
    """Return the class of a step from its table in the script.

    Raises:
        KeyProblem: The key ``do`` is missing or names no kind of step.
    """
    if "do" not in table:
        raise KeyProblem("this key is missing", "do", ", ".join(STEPS))
    if not isinstance(table["do"], str) or table["do"] not in STEPS:
        raise KeyProblem.unknown("step", table["do"], STEPS, "do")
    return STEPS[table["do"]]


class Action(ScriptStep):
    """A step that takes time.

    Attributes:
        time_limit_s: Longest allowed duration, seconds. None: no limit.
        raises: Class of the error that the step must end with. None: no error is allowed.
    """

    time_limit_s: Seconds | None = None
    raises: ErrorClass | None = None


class Framed(ScriptStep):
    """A step that moves or measures a frame of the robot.

    Attributes:
        frame: Name of the frame. None: the robot's tool.
    """

    frame: str | None = None

    def check(self, state: RunState) -> None:
        """Check that the robot has the frame."""
        super().check(state)
        require_known("frame", self.frame, state.robot.frames, "frame")
