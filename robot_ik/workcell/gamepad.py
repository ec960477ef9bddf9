"""A gamepad leads an arm: the deflection of a stick is the speed of joints or of the tool.

SDL reads it (pygame-ce, extra ``gamepad``), with the layouts of some hundred gamepads.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_ik.errors import HardwareError, MissingExtraError
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import GRIPPER
from robot_ik.ports import Array, Closing
from robot_ik.workcell.jog import Jog
from robot_ik.workcell.operator import Angles

DEAD_ZONE = 0.15
"""Share of a stick's range in which a released stick may rest."""

SPEED = 0.12
"""m/s of a stick at its end."""

ANGULAR_SPEED = np.radians(45.0)
"""rad/s (joints, rotations) of a stick at its end."""

LONGEST_STEP = 0.1
"""s for which a stick counts at most after a pause."""

FULL_DEFLECTION = 32767.0
"""SDL's number for a stick at its end."""

POLL_PERIOD = 0.2
"""s between two searches for a gamepad."""

RECONNECT_HINT = "check its cable and its battery"

BUTTONS = {
    "a": "A",
    "b": "B",
    "x": "X",
    "y": "Y",
    "back": "BACK",
    "start": "START",
    "left_shoulder": "LEFTSHOULDER",
    "right_shoulder": "RIGHTSHOULDER",
    "up": "DPAD_UP",
    "down": "DPAD_DOWN",
}
"""Name of a button -> its name in SDL."""


@dataclass(frozen=True)
class PadState:
    """Positions of sticks and triggers, and pressed buttons.

    Attributes:
        left: Left stick: to the right and forwards, -1 to 1.
        right: Right stick, the same.
        triggers: Left and right, 0 to 1.
        pressed: Buttons that are down: ``a b x y back start left_shoulder right_shoulder up down``.
    """

    left: tuple[float, float] = (0.0, 0.0)
    right: tuple[float, float] = (0.0, 0.0)
    triggers: tuple[float, float] = (0.0, 0.0)
    pressed: frozenset[str] = frozenset()

    def axes(self) -> Array:
        """Return (6,) shares of full speed: along and about x, y, z, or of the first six joints."""
        shoulders = ("right_shoulder" in self.pressed) - ("left_shoulder" in self.pressed)
        pushed = (self.left[1], -self.left[0], self.triggers[1] - self.triggers[0])
        axes = np.array((*pushed, float(shoulders), self.right[1], -self.right[0]))
        # Beyond the dead zone, squared: slow near its edge.
        share = np.clip((np.abs(axes) - DEAD_ZONE) / (1.0 - DEAD_ZONE), 0.0, 1.0)
        return np.asarray(np.sign(axes) * share**2)


class Gamepad(Jog):
    """Sticks, triggers and shoulders jog the tool in the axes of the world, or joints.

    B stops and holds, Y switches between joints and tool, up and down move the gripper, Start ends.

    Args:
        config: Arm file of the follower.
        read: Gives the state of the gamepad.  Raises ``HardwareError`` if it is disconnected.
        recover: Waits for the gamepad, s.
        stop: Makes the follower hold.
        moves_tool: Move the tool instead of joints.
    """

    def __init__(
        self,
        config: ArmConfig,
        read: Callable[[], PadState],
        *,
        recover: Callable[[float], None] = lambda _timeout: None,
        stop: Callable[[], object] = lambda: None,
        moves_tool: bool = True,
    ) -> None:
        super().__init__(config, read, stop=stop, moves_tool=moves_tool)
        self._wait = recover
        self._grippers = [k for k, joint in enumerate(self.joints) if joint.group == GRIPPER]
        self._down: frozenset[str] = frozenset()
        self._last: float | None = None

    def engage(self, follower: Angles) -> None:
        self._last = None
        super().engage(follower)

    def command(self, now: float) -> Angles:
        state = self._read()
        newly_pressed = state.pressed - self._down
        self._down = state.pressed
        if "b" in newly_pressed:
            self.stop()
        if "y" in newly_pressed:
            self.switch_mode()
        self.over |= "start" in newly_pressed
        passed = 0.0 if self._last is None else min(now - self._last, LONGEST_STEP)
        self._last = now
        axes = passed * state.axes()
        if not self.moves_tool:
            for number, share in enumerate(axes.tolist()):
                if number not in self._grippers:
                    self.move_joint(number, share * ANGULAR_SPEED, share * SPEED)
        elif axes.any():
            self.move_tool(SPEED * axes[:3], ANGULAR_SPEED * axes[3:])
        grip = passed * (("up" in state.pressed) - ("down" in state.pressed))
        for number in self._grippers[:1]:
            if self.joints[number].open_end == "lower":
                grip = -grip
            self.move_joint(number, grip * ANGULAR_SPEED, grip * SPEED)
        return dict(self.angles)

    def recover(self, timeout: float) -> None:
        self._wait(timeout)


class PadDevice(Closing):
    """The first gamepad of this machine; a context manager.

    Raises:
        MissingExtraError: pygame-ce is not installed.
        HardwareError: There is no gamepad.
    """

    def __init__(self) -> None:
        # By default SDL needs a display and the focus, and handles SIGTERM itself.
        for name in ("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "SDL_NO_SIGNAL_HANDLERS"):
            os.environ.setdefault(name, "1")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
            from pygame._sdl2 import controller
        except ImportError:
            raise MissingExtraError("pygame-ce", "gamepad", "a gamepad") from None
        self._pygame = pygame
        self._controllers = controller
        self._pad: Any = None
        pygame.display.init()
        controller.init()
        if not self._find():
            self.close()
            raise HardwareError(
                "no gamepad is connected",
                hint="plug one in and press a button, or lead by keys: --leader keys",
            )

    @property
    def name(self) -> str:
        """Name of the gamepad."""
        return str(self._pad.name)

    def _find(self) -> bool:
        self._pygame.event.pump()
        numbers = range(self._pygame.joystick.get_count())
        number = next((k for k in numbers if self._controllers.is_controller(k)), None)
        self._pad = None if number is None else self._controllers.Controller(number)
        return self._pad is not None

    def read(self) -> PadState:
        """Return the present state.

        Raises:
            HardwareError: The gamepad is disconnected.
        """
        pygame = self._pygame
        pad = self._pad
        pygame.event.pump()
        if pad is None or not pad.attached():
            raise HardwareError("the gamepad is disconnected", hint=RECONNECT_HINT)

        def axis(name: str) -> float:
            value = float(pad.get_axis(getattr(pygame, f"CONTROLLER_AXIS_{name}")))
            return max(-1.0, value / FULL_DEFLECTION)

        pressed = {
            name
            for name, button in BUTTONS.items()
            if pad.get_button(getattr(pygame, f"CONTROLLER_BUTTON_{button}"))
        }
        return PadState(
            (axis("LEFTX"), -axis("LEFTY")),
            (axis("RIGHTX"), -axis("RIGHTY")),
            (max(0.0, axis("TRIGGERLEFT")), max(0.0, axis("TRIGGERRIGHT"))),
            frozenset(pressed),
        )

    def recover(self, timeout: float) -> None:
        """Wait until a gamepad is connected again.

        Args:
            timeout: s to wait.

        Raises:
            HardwareError: No gamepad was connected in time.
        """
        end = time.monotonic() + timeout
        while not self._find():
            if time.monotonic() > end:
                raise HardwareError(
                    f"no gamepad was connected again within {timeout:g} s", hint=RECONNECT_HINT
                )
            time.sleep(POLL_PERIOD)

    def close(self) -> None:
        self._pad = None
        self._controllers.quit()
        self._pygame.display.quit()
