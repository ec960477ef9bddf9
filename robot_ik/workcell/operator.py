"""Interface of every leader of an arm in teleoperation: keys, a gamepad, another arm."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

Angles = Mapping[str, float]
"""Joint -> value, rad (m of a slide)."""


class Operator(ABC):
    """Gives the values that the joints of the follower should have.

    Attributes:
        over: The person has ended the teleoperation.
    """

    over = False

    @abstractmethod
    def engage(self, follower: Angles) -> None:
        """Begin to lead the follower at its present values.

        Args:
            follower: Present values of the follower.
        """

    @abstractmethod
    def command(self, now: float) -> Angles:
        """Return the command for a time.

        Args:
            now: s on the follower's clock.

        Raises:
            HardwareError: The leader is lost.
        """

    def go_on_from(self, command: Angles) -> None:  # noqa: B027 - optional for leaders
        """Continue from the command that was sent, because a collision held the follower back.

        Args:
            command: Joint -> value that was sent, rad (m of a slide).
        """

    def recover(self, timeout: float) -> None:  # noqa: B027 - optional for leaders
        """Connect the leader again after it was lost.

        Args:
            timeout: s to wait.

        Raises:
            HardwareError: The leader did not come back.
        """
