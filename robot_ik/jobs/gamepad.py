"""A gamepad leads an arm: how far its sticks are pushed is how fast joints, or the hand, go.

Read by SDL (pygame-ce, extra ``gamepad``), which knows the layouts of some hundred gamepads.
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
from robot_ik.jobs.teleop import Angles, Jog
from robot_ik.ports import Array, Closing

DEAD_ZONE = 0.15
"""Share of a stick's range: one that is let go may rest within it."""
_SPEED, _ANGULAR_SPEED = 0.12, np.radians(45.0)  # m/s and rad/s (joints, rotations) of a stick at its end
_LONGEST = 0.1  # s: after a pause a stick counts for no more
_FULL = 32767.0  # SDL's number for a stick at its end
_POLL = 0.2  # s


@dataclass(frozen=True)
class PadState:
    """What is pushed and pressed.

    Attributes:
        left, right: Sticks: to the right and forwards, -1 to 1.
        triggers: Left and right, 0 to 1.
        pressed: Buttons that are down: ``a b x y back start left_shoulder right_shoulder up down``.
    """

    left: tuple[float, float] = (0.0, 0.0)
    right: tuple[float, float] = (0.0, 0.0)
    triggers: tuple[float, float] = (0.0, 0.0)
    pressed: frozenset[str] = frozenset()

    def axes(self) -> Array:
        """(6,) x, y, z, and about x, y, z: or the first six joints."""
        shoulders = ("right_shoulder" in self.pressed) - ("left_shoulder" in self.pressed)
        pushed = (self.left[1], -self.left[0], self.triggers[1] - self.triggers[0])
        axes = np.array((*pushed, float(shoulders), self.right[1], -self.right[0]))
        # Without the dead zone; fine near its edge, for the square of what is left.
        share = np.clip((np.abs(axes) - DEAD_ZONE) / (1.0 - DEAD_ZONE), 0.0, 1.0)
        return np.asarray(np.sign(axes) * share**2)


class Gamepad(Jog):
    """Sticks, triggers and shoulders jog the hand in the axes of the world, or joints.

    B stops and holds (``stop``), Y changes between joints and hand, up and down move the gripper, Start ends
    (``over``).  ``read`` raises ``HardwareError`` where the gamepad is gone; ``recover`` waits for it, s.
    """

    def __init__(
        self,
        config: ArmConfig,
        read: Callable[[], PadState],
        *,
        recover: Callable[[float], None] = lambda timeout: None,
        stop: Callable[[], object] = lambda: None,
        hand: bool = True,
    ) -> None:
        super().__init__(config, read, stop=stop, hand=hand)
        self._wait = recover
        self._grippers = [k for k, joint in enumerate(self.joints) if joint.name not in config.names]
        self._down: frozenset[str] = frozenset()
        self._last: float | None = None

    def engage(self, follower: Angles) -> None:
        self._last = None
        super().engage(follower)

    def command(self, now: float) -> Angles:
        state = self._read()
        fresh, self._down = state.pressed - self._down, state.pressed
        if "b" in fresh:
            self.stop()
        if "y" in fresh:
            self.change()
        self.over |= "start" in fresh
        passed = 0.0 if self._last is None else min(now - self._last, _LONGEST)
        self._last = now
        axes = passed * state.axes()
        if not self.hand:
            for number, share in enumerate(axes.tolist()):
                if number not in self._grippers:
                    self.move_joint(number, share * _ANGULAR_SPEED, share * _SPEED)
        elif axes.any():
            self.move_hand(_SPEED * axes[:3], _ANGULAR_SPEED * axes[3:])
        grip = passed * (("up" in state.pressed) - ("down" in state.pressed))
        for number in self._grippers[:1]:
            self.move_joint(number, grip * _ANGULAR_SPEED, grip * _SPEED)
        return dict(self.angles)

    def recover(self, timeout: float) -> None:
        self._wait(timeout)


class PadDevice(Closing):
    """The first gamepad of this machine; a context manager.

    Raises:
        MissingExtraError: Without pygame-ce.
        HardwareError: There is none.
    """

    def __init__(self) -> None:
        # SDL wants a display and the focus, and takes SIGTERM for its own, unless it is told otherwise.
        for name in ("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "SDL_NO_SIGNAL_HANDLERS"):
            os.environ.setdefault(name, "1")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
            from pygame._sdl2 import controller
        except ImportError:
            raise MissingExtraError("pygame-ce", "gamepad", "a gamepad") from None
        self._pygame, self._controllers = pygame, controller
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
        return str(self._pad.name)

    def _find(self) -> bool:
        self._pygame.event.pump()
        numbers = range(self._pygame.joystick.get_count())
        number = next((k for k in numbers if self._controllers.is_controller(k)), None)
        self._pad = None if number is None else self._controllers.Controller(number)
        return self._pad is not None

    def read(self) -> PadState:
        """What is pushed and pressed now; HardwareError: it is gone."""
        pygame, pad = self._pygame, self._pad
        pygame.event.pump()
        if pad is None or not pad.attached():
            raise HardwareError("the gamepad is gone", hint="look at its cable or its battery")

        def axis(name: str) -> float:
            return max(-1.0, float(pad.get_axis(getattr(pygame, f"CONTROLLER_AXIS_{name}"))) / _FULL)

        buttons = "A B X Y BACK START LEFTSHOULDER RIGHTSHOULDER DPAD_UP DPAD_DOWN"
        down = {one for one in buttons.split() if pad.get_button(getattr(pygame, f"CONTROLLER_BUTTON_{one}"))}
        names = {one.lower().removeprefix("dpad_").replace("shoulder", "_shoulder") for one in down}
        return PadState(
            (axis("LEFTX"), -axis("LEFTY")), (axis("RIGHTX"), -axis("RIGHTY")),
            (max(0.0, axis("TRIGGERLEFT")), max(0.0, axis("TRIGGERRIGHT"))), frozenset(names),
        )  # fmt: skip

    def recover(self, timeout: float) -> None:
        """Waits until one is connected again; HardwareError: none was within ``timeout`` s."""
        end = time.monotonic() + timeout
        while not self._find():
            if time.monotonic() > end:
                raise HardwareError("the gamepad did not come back", hint="look at its cable or its battery")
            time.sleep(_POLL)

    def close(self) -> None:
        self._pad = None
        self._controllers.quit()
        self._pygame.display.quit()
