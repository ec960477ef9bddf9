"""Table 4.1 of S12: its numbers, and the parameters with which its program ran.

K. Šimunić, *Interactive inverse kinematic model*, FER Zagreb 2012, section 4: an arm of seven
segments, four methods, four cases.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from robot_ik.compiled_goals import length_scale
from robot_ik.goals import PositionGoal
from robot_ik.robot import Robot, load_robot

ROBOT = "seven_segment"
"""The arm. The thesis does not state its lengths."""

TOOL = "tip"
"""Frame that follows the ball."""

SEGMENTS = 7
"""Bones of the arm. One iteration of CCD rotates one bone in the thesis, and all bones here."""

LIMIT_DEG = 45.0
"""Joint limits about x and z in cases 3 and 4, degrees to both sides."""

ITERATIONS = 100
"""Largest number of attempts of a solve."""

DISTANCE = 0.05
"""Distance that counts as a success. The thesis gives it without a unit; metres here."""

ALPHA = 0.01
"""Factor of every angle of a step."""

LAMBDA = 1.1
"""Damping of DLS, a length here. The thesis gives it without a unit."""

MAX_STEP = math.pi / 16.0
"""Largest angle of a step of DLS, rad."""

FREE = 1e6
"""Clamp and largest step of methods for which the thesis states none: no limit in practice."""

PATIENCE = 1000
"""Iterations without progress that end a solve. The program of the thesis has no such limit."""

METHODS = ("ccd", "transpose", "pseudoinverse", "dls")

Cell = tuple[float, float, float]
"""Mean time of a solve in ms, mean iterations, per cent solved."""

THESIS_CELLS: dict[str, tuple[Cell, Cell, Cell, Cell]] = {
    "ccd": ((1.1, 20, 99), (5.0, 210, 75), (5.0, 83, 92), (16.7, 232, 74)),
    "transpose": ((5.0, 28, 78), (15.4, 92, 15), (45.6, 93, 8), (47.8, 99, 3)),
    "pseudoinverse": ((7.0, 25, 96), (21.8, 79, 47), (23.8, 40, 81), (51.9, 88, 29)),
    "dls": ((3.5, 18, 100), (19.0, 100, 0), (27.8, 55, 69), (50.0, 99, 2)),
}
"""Table 4.1: the cells of cases 1 to 4 by method."""


@dataclass(frozen=True)
class ArmCase:
    """One of the four cases.

    Attributes:
        number: 1 to 4.
        curve: Whether the target moves on a curve. Else it is at a random position in each frame.
        limited: Whether joints are limited.
    """

    number: int
    curve: bool
    limited: bool

    @property
    def title(self) -> str:
        """Such as ``curve, ±45°``."""
        limits = f"±{LIMIT_DEG:g}°" if self.limited else "no limits"
        return f"{'curve' if self.curve else 'random'}, {limits}"


CASES = (
    ArmCase(1, curve=True, limited=False),
    ArmCase(2, curve=False, limited=False),
    ArmCase(3, curve=True, limited=True),
    ArmCase(4, curve=False, limited=True),
)


def make_arm(limited: bool) -> Robot:
    """Return the arm, with its limits or without: ±45° about x and z, the twist free."""
    arm = load_robot(ROBOT)
    return arm.with_optional_limits() if limited else arm


def method_options(method: str, gain: float = ALPHA) -> dict[str, Any]:
    """Return the options with which a method steps as in the thesis.

    Args:
        method: A name of ``METHODS``.
        gain: Factor of every step.
    """
    options: dict[str, Any] = {"patience": PATIENCE, "progress": 0.0}
    if method != "ccd":
        options |= {"gain": gain, "alternative": True, "clamp": FREE, "max_step": FREE}
    if method == "dls":
        # The position rows are divided by the length scale of the goal. λ is a length here, so it
        # is divided too.
        arm = make_arm(limited=False)
        scale = length_scale(arm, PositionGoal(TOOL, (0.0, 0.0, 0.0)))
        options |= {"damping": LAMBDA / scale, "max_step": MAX_STEP}
    return options


def iterations_of(method: str, iterations: float) -> float:
    """Return iterations as the thesis counts them: CCD rotates one bone in an iteration."""
    return iterations * (SEGMENTS if method == "ccd" else 1)
