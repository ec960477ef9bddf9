"""What a step of a script may say: one class a kind, all of them in ``STEPS``.

Lengths are metres, angles degrees (``_deg``), tolerances millimetres and degrees, times seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

_Number = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
# A day: a script that waits longer waits for something else.
_LONGEST = 86_400.0
_Seconds = Annotated[float, Field(gt=0.0, le=_LONGEST, allow_inf_nan=False)]
_Place = Annotated[list[_Number], Field(min_length=3, max_length=3)]
_Turn = Annotated[list[_Number], Field(min_length=4, max_length=4)]
_Span = Annotated[list[_NotNegative], Field(min_length=2, max_length=2)]
_Share = Annotated[float, Field(gt=0.0, le=1.0)]
_Word = Annotated[str, Field(min_length=1)]


class Table(BaseModel):
    """A table of a script: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Step(Table):
    """What every step has.

    Attributes:
        name: For the report; by default what the step does.
    """

    name: str = ""


class Action(Step):
    """A step that takes time.

    Attributes:
        time_limit_s: The step fails when it takes longer.
        raises: Class of the error with which it must end; without it, an error is a failure.
    """

    time_limit_s: _Seconds | None = None
    raises: _Word | None = None


class _Move(Action):
    """A planned motion; it is over when the servos have arrived within the tolerance.

    Attributes:
        speed: Share of the speed limits.
        tolerance_mm, tolerance_deg: Of the frame; or of each slide, and of each other joint.
    """

    speed: _Share | None = None
    tolerance_mm: _Positive = 2.0
    tolerance_deg: _Positive = 0.5


class PoseStep(_Move):
    """The frame goes to a position and an orientation, straight in joint space."""

    do: Literal["pose"]
    position: _Place
    wxyz: _Turn
    frame: str | None = None


class PositionStep(_Move):
    """The frame's origin goes to a position, however it is turned."""

    do: Literal["position"]
    position: _Place
    frame: str | None = None


class LineStep(_Move):
    """The frame moves on a straight line, to a position or by a vector, and keeps its turn unless told."""

    do: Literal["line"]
    position: _Place | None = None
    by: _Place | None = None
    wxyz: _Turn | None = None
    frame: str | None = None
    linear_speed: _Positive = 0.25


class JointsStep(_Move):
    """Joints go to angles, slides to millimetres; those that are not named stay."""

    do: Literal["joints"]
    joints_deg: Annotated[dict[str, _Number], Field(min_length=1)] | None = None
    joints_mm: Annotated[dict[str, _Number], Field(min_length=1)] | None = None


class KeyframeStep(_Move):
    """All joints go to a keyframe of the model."""

    do: Literal["keyframe"]
    keyframe: _Word = "home"


class MarkerStep(_Move):
    """The synthetic camera looks for the printed marker, and the tool goes above it."""

    do: Literal["marker"]


class GripStep(_Move):
    """The gripper opens or closes: to a share of its range, or to a width.

    Attributes:
        opening: 0 closed, 1 open; ``width_mm``: instead, between two fingers that slide.
        force_n: How hard each finger presses from here on, where the servo can be told.
        held: Whether something must be between the fingers then; without it, either is right.
    """

    do: Literal["grip"]
    opening: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    width_mm: _NotNegative | None = None
    force_n: _Positive | None = None
    held: bool | None = None


class FollowStep(Action):
    """The frame follows a goal that moves: round a circle, an eight, or the printed marker.

    Attributes:
        catch_up_s: From here on the frame must be within ``tolerance_mm`` of the goal at every tick.
    """

    do: Literal["follow"]
    path: Literal["circle", "eight", "marker"]
    seconds: _Seconds
    center: _Place | None = None
    radius: _Positive | None = None
    period: _Positive | None = None
    normal: _Place | None = None
    wxyz: _Turn | None = None
    frame: str | None = None
    speed: _Share | None = None
    catch_up_s: _NotNegative = 1.0
    tolerance_mm: _Positive = 10.0


class WaitStep(Action):
    """The arm stays where it was sent to."""

    do: Literal["wait"]
    seconds: Annotated[float, Field(ge=0.0, le=_LONGEST, allow_inf_nan=False)]


class HoldStep(Action):
    """The arm holds where it is."""

    do: Literal["hold"]


class RecoverStep(Action):
    """Out of a fault: port opened, servos restarted, everything verified anew; then torque again."""

    do: Literal["recover"]


class InjectStep(Step):
    """Lets a fault of the virtual bus happen.

    Attributes:
        kind: A name of ``fault_kinds.KINDS``; ``joint`` or ``id`` and ``value`` as it wants them.
        in_s: So much later; ``for_s``: until it is taken back, else for good or until ``clear``.
    """

    do: Literal["inject"]
    kind: _Word
    joint: str | None = None
    id: Annotated[int | None, Field(ge=0, le=252)] = None
    value: _Number | None = None
    in_s: _NotNegative = 0.0
    for_s: _NotNegative | None = None


class ClearStep(Step):
    """Takes back the faults that were injected, all or those of one kind; restarts servos that shut down."""

    do: Literal["clear"]
    kind: str | None = None


class ExpectStep(Step):
    """What must be true now; at least one thing.

    Attributes:
        shafts: Judge by where the simulated shafts really are, not by what the servos say.
        thing: ``position`` is where this one of the script's things lies, not the frame.
        width_mm: Between the fingers, within ``tolerance_mm``.
        state: Of the arm.
        error: Class of the last error; ``joint`` and ``cause``: what it says of them.
        status: Of the last solve.
        step_seconds, run_seconds: How long the last action, and the run, took: from, to.
    """

    do: Literal["expect"]
    position: _Place | None = None
    wxyz: _Turn | None = None
    frame: str | None = None
    joints_deg: dict[str, _Number] | None = None
    joints_mm: dict[str, _Number] | None = None
    keyframe: _Word | None = None
    tolerance_mm: _Positive = 2.0
    tolerance_deg: _Positive = 0.5
    shafts: bool = False
    thing: _Word | None = None
    width_mm: _NotNegative | None = None
    state: Literal["connected", "enabled", "hold", "fault"] | None = None
    error: _Word | None = None
    joint: _Word | None = None
    cause: _Word | None = None
    status: _Word | None = None
    step_seconds: _Span | None = None
    run_seconds: _Span | None = None


AnyStep = (
    PoseStep | PositionStep | LineStep | JointsStep | KeyframeStep | MarkerStep | GripStep | FollowStep
    | WaitStep | HoldStep | RecoverStep | InjectStep | ClearStep | ExpectStep
)  # fmt: skip

STEPS: Mapping[str, type[Step]] = MappingProxyType(
    {
        "pose": PoseStep,
        "position": PositionStep,
        "line": LineStep,
        "joints": JointsStep,
        "keyframe": KeyframeStep,
        "marker": MarkerStep,
        "grip": GripStep,
        "follow": FollowStep,
        "wait": WaitStep,
        "hold": HoldStep,
        "inject": InjectStep,
        "clear": ClearStep,
        "recover": RecoverStep,
        "expect": ExpectStep,
    }
)
"""Every kind of step by the value of ``do``."""


class ThingTable(Table):
    """A box that lies about and can be gripped, in a world with ``physics``.

    Attributes:
        position: Of its centre, m; ``yaw_deg``: turned about the vertical.
    """

    name: _Word
    position: _Place
    yaw_deg: _Number = 0.0
    size_mm: Annotated[list[_Positive], Field(min_length=3, max_length=3)]
    mass_g: _Positive = 50.0


class ScriptFile(Table):
    """A whole script.

    Attributes:
        version: ``schema`` in the file (the name is taken in pydantic's base class).
        robot: Catalogue name, or a path seen from the script.
        arm: Path of an arm file, likewise; by default the one beside the model.
        seed: Of the dice of faults, restarts and the synthetic camera's noise.
        speed: Share of the speed limits of all moves that do not say it themselves.
        marker_at: x, y, z in metres and yaw in degrees of the printed marker; by default the stage's own.
        physics: The robot's MuJoCo model moves the simulated shafts.
        things: What lies on the plane z = 0 of that world.
    """

    version: Annotated[int, Field(alias="schema", ge=1, le=1)]
    name: _Word
    about: str = ""
    robot: _Word = "tabletop_puma"
    arm: str | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    speed: _Share = 0.5
    marker_at: Annotated[list[_Number], Field(min_length=3, max_length=4)] | None = None
    physics: bool = False
    things: list[ThingTable] = []
    steps: Annotated[list[Annotated[AnyStep, Field(discriminator="do")]], Field(min_length=1)]
