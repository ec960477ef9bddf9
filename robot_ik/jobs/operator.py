"""What leads an arm in teleoperation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

Angles = Mapping[str, float]
"""Joint -> value, rad (m of a slide)."""


class Operator(ABC):
    """Gives the values that the joints of the follower should have.

    Attributes:
        over: A person wants to end.
    """

    over = False

    @abstractmethod
    def engage(self, follower: Angles) -> None:
        """Lead from here on.

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

    def go_on_from(self, command: Angles) -> None:  # noqa: B027 - most lead by where they are
        """Take what was sent as the last command: a collision held the follower back.

        Args:
            command: Joint -> value, rad (m of a slide).
        """

    def feel(self, follower: Angles) -> None:  # noqa: B027 - most operators feel nothing
        """Take the present values of the follower, for force feedback."""

    def recover(self, timeout: float) -> None:  # noqa: B027 - keys are never lost
        """Connect the leader again after it was lost.

        Args:
            timeout: s to wait.

        Raises:
            HardwareError: It did not come back.
        """
