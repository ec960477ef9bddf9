"""The step that gets an arm out of a fault."""

from __future__ import annotations

from robot_ik.hardware.arm import ArmState
from robot_ik.jobs.script.report import StepResult
from robot_ik.jobs.script.situation import Situation, StepFailed
from robot_ik.jobs.script.steps import RecoverStep

PATIENCE = 2.0
"""s to wait for a port that has gone."""


def recover(now: Situation, step: RecoverStep, result: StepResult) -> None:
    """Opens a port that had gone, or restarts what has shut down; then torque where the arm stands.

    Raises:
        StepFailed: There is no fault.
        HardwareError: The cause is still there; the fault stays.
    """
    arm = now.arm
    if arm.state is not ArmState.FAULT:
        raise StepFailed(f"there is no fault: the arm is {arm.state.value}")
    if not arm.bus.is_open:
        arm.reconnect(PATIENCE if step.time_limit_s is None else step.time_limit_s)
    else:
        restarted = arm.reset_fault()
        result.numbers["restarted"] = list(restarted)
        result.found = f"restarted: {', '.join(restarted)}" if restarted else ""
    arm.enable()
    now.stand()
