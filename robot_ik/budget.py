"""``Budget``: how many steps, restarts and seconds a solve may take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from robot_ik.errors import OptionError
from robot_ik.geometry import INTEGER, REAL

# The largest count of a kernel.
_MAX_COUNT = 1 << 62


@dataclass(frozen=True)
class Budget:
    """How long a solve may take.

    A budget of iterations gives bit-equal results for a seed. A budget of seconds does not.

    Attributes:
        iterations: Steps of all descents together.
        seconds: Wall-clock limit; None for none.
        restarts: Random restarts; None for the default of the solver.
    """

    iterations: int = 20_000
    seconds: float | None = None
    restarts: int | None = None

    def __post_init__(self) -> None:
        for name in ("iterations", "restarts"):
            count: Any = getattr(self, name)
            if count is None and name == "restarts":
                continue
            if not (isinstance(count, INTEGER) and 0 <= count <= _MAX_COUNT):
                raise OptionError(name, f"{count!r}", "0 to 2^62", owner="budget")
        seconds: Any = self.seconds
        if seconds is not None and not (isinstance(seconds, REAL) and seconds >= 0):
            raise OptionError("seconds", f"{seconds!r}", "0 or more, or None", owner="budget")
