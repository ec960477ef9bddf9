"""The planner: one thread that plans the motions of a figure while the session shows frames."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TypeVar

from robot_ik.figure.abilities import Abilities

_Result = TypeVar("_Result")


class Planner:
    """Plans motions, one after the other, in a thread.

    The thread has its own figure, because the data and the cache of a figure serve one thread. It
    starts with the first plan and ends with the planner.

    Args:
        abilities: Abilities of the figure. They are not used by the thread.
    """

    def __init__(self, abilities: Abilities) -> None:
        self._abilities = replace(abilities, figure=abilities.figure.duplicate())
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="figure-planner")

    def submit(self, plan: Callable[[Abilities], _Result]) -> Future[_Result]:
        """Plan a motion in the thread. ``plan`` gets the abilities of the thread's figure."""
        return self._executor.submit(plan, self._abilities)
