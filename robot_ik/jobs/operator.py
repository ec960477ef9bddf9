"""``Operator``: the source of commands in teleoperation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

Angles = Mapping[str, float]
"""Joint -> value, rad (m of a slide)."""


class Operator(ABC):
    """Gives the values that the joints of the follower should have.

    Attributes:
        over: Whether the person has ended the teleoperation.
    """

    over = False

    @abstractmethod
    def engage(self, follower: Angles) -> None:
        """Start to lead the follower at its present values.

        Args:
            follower: Present values of the follower.
        """

    @abstractmethod
    def command(self, now: float) -> Angles:
        """Return the command of a moment.

        Args:
            now: s on the follower's clock.

        Raises:
            HardwareError: The leader is lost.
        """

    def go_on_from(self, command: Angles) -> None:  # noqa: B027 - optional
        """Continue from the command that was sent, because a collision limited the last one.

        Args:
            command: Joint -> value, rad (m of a slide).
        """

    def feel(self, follower: Angles) -> None:  # noqa: B027 - optional
        """Take the present values of the follower, for force feedback."""

    def recover(self, timeout: float) -> None:  # noqa: B027 - optional: keys are never lost
        """Connect the leader again after it was lost.

        Args:
            timeout: s to wait.

        Raises:
            HardwareError: The leader was not connected again in time.
        """
