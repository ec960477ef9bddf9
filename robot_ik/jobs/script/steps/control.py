"""Steps that wait and hold, let faults happen and take them back, and lead out of one."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from robot_ik.config import Word
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.servo import ServoId
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.jobs.script.state import RunState, StepFailed, StepResult
from robot_ik.jobs.script.steps.base import LONGEST, Action, NotNegative, ScriptStep

PATIENCE = 2.0
"""s to wait for a port that has gone."""


class WaitStep(Action):
    """The arm stays where it was sent to."""

    title_keys = ("seconds",)

    do: Literal["wait"]
    seconds: Annotated[float, Field(ge=0.0, le=LONGEST)]

    def run(self, now: RunState, result: StepResult) -> None:
        if now.arm.state in (ArmState.ENABLED, ArmState.HOLD):
            now.setup.repeat(self.seconds)
        else:
            now.setup.clock.sleep_until(now.setup.clock.now() + self.seconds)


class HoldStep(Action):
    """The arm holds where it is."""

    do: Literal["hold"]

    def run(self, now: RunState, result: StepResult) -> None:
        now.arm.hold()
        now.setup.stand()


class InjectStep(ScriptStep):
    """Lets a fault of the virtual bus happen.

    Attributes:
        kind: A name of ``FAULTS``; ``joint`` or ``id`` and ``value`` as it wants them.
        in_s: So much later; ``for_s``: until it is taken back, else for good or until ``clear``.
    """

    title_keys = ("kind", "joint")
    simulated_only = True

    do: Literal["inject"]
    kind: Word
    joint: str | None = None
    id: ServoId | None = None
    value: float | None = None
    in_s: NotNegative = 0.0
    for_s: NotNegative | None = None

    @property
    def fault(self) -> Fault:
        """What it injects; KeyProblem: there is no such kind, or not with such a value."""
        return Fault(self.kind, self.id, self.value, joint=self.joint, at_s=self.in_s, for_s=self.for_s)

    def check(self, now: RunState) -> None:
        super().check(now)
        self.fault.require_servo(now.config)

    def run(self, now: RunState, result: StepResult) -> None:
        now.servos.inject(self.fault)


class ClearStep(ScriptStep):
    """Takes back the faults that were injected, all or those of one kind; restarts servos that shut down."""

    title_keys = ("kind",)
    simulated_only = True

    do: Literal["clear"]
    kind: str | None = None

    def run(self, now: RunState, result: StepResult) -> None:
        result.numbers["cleared"] = now.servos.clear(self.kind)


class RecoverStep(Action):
    """Out of a fault: port opened, servos restarted, everything verified anew; then torque again."""

    simulated_only = True

    do: Literal["recover"]

    def run(self, now: RunState, result: StepResult) -> None:
        """Opens a port that had gone, or restarts what has shut down; then torque where the arm stands.

        Raises:
            StepFailed: There is no fault.
            HardwareError: The cause is still there; the fault stays.
        """
        arm = now.arm
        if arm.state is not ArmState.FAULT:
            raise StepFailed(f"there is no fault: the arm is {arm.state.value}")
        if not arm.bus.is_open:
            arm.reconnect(PATIENCE if self.time_limit_s is None else self.time_limit_s)
        else:
            restarted = arm.reset_fault()
            result.numbers["restarted"] = list(restarted)
            result.found = f"restarted: {', '.join(restarted)}" if restarted else ""
        now.setup.enable_torque()
