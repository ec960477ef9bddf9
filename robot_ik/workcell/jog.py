"""Jogging: a person moves the joints or the tool of an arm in steps, within its limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from robot_ik.geometry import Pose
from robot_ik.hardware.config import ArmConfig
from robot_ik.ports import Array
from robot_ik.workcell.operator import Angles, Operator
from robot_ik.workcell.tool_follower import ToolFollower

JOINT_KEYS = ("qa", "ws", "ed", "rf", "tg", "yh", "uj", "ik", "ol")
"""Two keys for each joint, forwards and back: columns of the keyboard from the left."""

TOOL_KEYS: Mapping[str, tuple[int, int]] = {
    "w": (0, 1),
    "s": (0, -1),
    "a": (1, 1),
    "d": (1, -1),
    "r": (2, 1),
    "f": (2, -1),
    "i": (3, 1),
    "k": (3, -1),
    "j": (4, 1),
    "l": (4, -1),
    "u": (5, 1),
    "o": (5, -1),
}
"""Key -> axis of the world (0 to 2: along, 3 to 5: about) and its sign."""

MODE_KEY = "\t"
"""Switches between joints and tool."""

FINER = "-"
"""Halves the steps."""

COARSER = "+"
"""Doubles the steps."""

STOP = " "
"""Stops the arm, which then holds."""

QUIT = "\x1b"
"""Ends the command."""

STEP = 0.01
"""Distance of one key press, m."""

ROTATION = np.radians(3.0)
"""Rotation of one key press, rad."""

MIN_FACTOR = 0.1
"""Smallest factor of the steps."""

MAX_FACTOR = 4.0
"""Largest factor of the steps."""


class Jog(Operator):
    """Moves joints, or the tool in the axes of the world.

    Args:
        config: Arm file of the follower.
        read: Returns the keys or buttons that are pressed, or were since the last call.
        stop: Makes the follower hold.
        moves_tool: Move the tool instead of joints.

    Attributes:
        joints: Joints of the follower.
        angles: Joint -> commanded value, rad (m of a slide).
        moves_tool: The tool is moved instead of joints.
        stop: Makes the follower hold.
    """

    def __init__(
        self,
        config: ArmConfig,
        read: Callable[[], Any],
        *,
        stop: Callable[[], object] = lambda: None,
        moves_tool: bool = False,
    ) -> None:
        self.joints = config.joints
        self.angles: dict[str, float] = {}
        self.moves_tool = moves_tool
        self.stop = stop
        self._tool = ToolFollower(config)
        self._read = read

    def engage(self, follower: Angles) -> None:
        self.angles = {joint.name: follower[joint.name] for joint in self.joints}
        self._tool.engage(self.angles)

    def go_on_from(self, command: Angles) -> None:
        self.angles |= command
        self._tool.engage(self.angles)

    def switch_mode(self) -> None:
        """Move the tool instead of joints, or joints instead of the tool."""
        self.moves_tool = not self.moves_tool
        self._tool.engage(self.angles)

    def move_joint(self, number: int, rotation: float, slide: float) -> None:
        """Move one joint.  Does nothing if there is no joint of this number.

        Args:
            number: Index in ``joints``.
            rotation: Step of a hinge, rad.
            slide: Step of a slide, m.
        """
        if number >= len(self.joints):
            return
        joint = self.joints[number]
        step = slide if joint.slides else rotation
        if step:
            lower, upper = joint.limits
            self.angles[joint.name] = min(max(self.angles[joint.name] + step, lower), upper)

    def move_tool(self, along: Array, about: Array) -> None:
        """Move the tool in the axes of the world.

        Args:
            along: (3,) m.
            about: (3,) rad.
        """
        rotation = Pose().plus(np.concatenate([np.zeros(3), about])).rotation
        pose = self._tool.pose
        target = Pose.from_rotation(rotation @ pose.rotation, pose.position + along)
        self.angles |= self._tool.go(target, exactly=True)


class KeyboardJog(Jog):
    """Jogs by the keys of a terminal.

    A terminal does not report how long a key is down, so each press is one step.
    """

    _factor = 1.0

    def command(self, now: float) -> Angles:  # noqa: ARG002 - each press is one step
        for key in self._read():
            self._press(key.lower())
        return dict(self.angles)

    def _press(self, key: str) -> None:
        if key == STOP:
            self.stop()
        elif key == QUIT:
            self.over = True
        elif key == MODE_KEY:
            self.switch_mode()
        elif key in (FINER, COARSER):
            factor = self._factor * (2.0 if key == COARSER else 0.5)
            self._factor = float(np.clip(factor, MIN_FACTOR, MAX_FACTOR))
        elif not self.moves_tool:
            self._press_joint(key)
        elif key in TOOL_KEYS:
            axis, sign = TOOL_KEYS[key]
            motion = np.zeros(6)
            motion[axis] = sign * self._factor * (STEP if axis < 3 else ROTATION)
            self.move_tool(motion[:3], motion[3:])

    def _press_joint(self, key: str) -> None:
        for number, pair in enumerate(JOINT_KEYS):
            if key in pair:
                factor = self._factor if key == pair[0] else -self._factor
                self.move_joint(number, factor * ROTATION, factor * STEP)
