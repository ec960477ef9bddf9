"""Steps that wait, hold, inject faults, clear faults and recover from a fault."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from robot_ik.config import Word
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.servo import ServoId
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.script.state import RunState, StepFailed, StepResult
from robot_ik.script.steps.base import LONGEST, Action, NotNegative, ScriptStep

#: Time to wait for an unplugged port if the step has no time limit, seconds.
RECONNECT_TIMEOUT = 2.0


class WaitStep(Action):
    """Keep the last command for a time.

    Attributes:
        seconds: Duration of the step.
    """

    title_keys = ("seconds",)

    do: Literal["wait"]
    seconds: Annotated[float, Field(ge=0.0, le=LONGEST)]

    def run(self, state: RunState, _result: StepResult) -> None:
        """Repeat the last command, or only wait if the servos have no torque."""
        if state.arm.state in (ArmState.ENABLED, ArmState.HOLD):
            state.setup.repeat(self.seconds)
        else:
            clock = state.setup.clock
            clock.sleep_until(clock.now() + self.seconds)


class HoldStep(Action):
    """Hold the arm at its present position."""

    do: Literal["hold"]

    def run(self, state: RunState, _result: StepResult) -> None:
        """Hold the arm."""
        state.arm.hold()
        state.setup.stand()


class InjectStep(ScriptStep):
    """Inject a fault into the virtual bus.

    Attributes:
        kind: A name of ``FAULTS``. The kind determines whether it needs ``joint`` or ``id``, and
            ``value``.
        joint: Joint of the servo.
        id: Bus id of the servo, instead of ``joint``.
        value: Strength of the fault, in the unit of its kind.
        in_s: Delay until the fault begins, seconds.
        for_s: Duration of the fault, seconds. None: until ``clear``.
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
        """The fault.

        Raises:
            KeyProblem: The kind is unknown, or does not allow the value.
        """
        return Fault(
            self.kind,
            self.id,
            self.value,
            joint=self.joint,
            at_s=self.in_s,
            for_s=self.for_s,
        )

    def check(self, state: RunState) -> None:
        """Check the fault, and that the arm has its servo."""
        super().check(state)
        self.fault.require_servo(state.config)

    def run(self, state: RunState, _result: StepResult) -> None:
        """Inject the fault."""
        state.servos.inject(self.fault)


class ClearStep(ScriptStep):
    """End injected faults, and restart the servos that shut down.

    Attributes:
        kind: Kind of the faults. None: all faults.
    """

    title_keys = ("kind",)
    simulated_only = True

    do: Literal["clear"]
    kind: str | None = None

    def run(self, state: RunState, result: StepResult) -> None:
        """End the faults and report their number."""
        result.numbers["cleared"] = state.servos.clear(self.kind)


class RecoverStep(Action):
    """Recover the arm from a fault: open the port or restart the servos, then enable torque."""

    simulated_only = True

    do: Literal["recover"]

    def run(self, state: RunState, result: StepResult) -> None:
        """Open an unplugged port, or restart the servos that shut down. Enable torque afterwards.

        Raises:
            StepFailed: The arm has no fault.
            HardwareError: The cause of the fault persists.
        """
        arm = state.arm
        if arm.state is not ArmState.FAULT:
            raise StepFailed(f"there is no fault: the arm is {arm.state.value}")
        if arm.bus.is_open:
            restarted = arm.reset_fault()
            result.numbers["restarted"] = list(restarted)
            result.found = f"restarted: {', '.join(restarted)}" if restarted else ""
        else:
            timeout = RECONNECT_TIMEOUT if self.time_limit_s is None else self.time_limit_s
            arm.reconnect(timeout)
        state.setup.enable_torque()
