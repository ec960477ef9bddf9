"""Runs the four cases of table 4.1 of thesis S12 in a session, with the thesis's parameters.

The runner sends commands and reads the statistics of the views. A command log has all its commands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from robot_ik.testbed.commands import (
    Command,
    Reset,
    SetBudget,
    SetCount,
    SetGoalKind,
    SetLimits,
    SetMethod,
    SetMotion,
    SetPace,
    SetRestarts,
    SetRobot,
    SetSpeed,
)
from robot_ik.testbed.view import View
from robot_ik.theses.table_4_1 import (
    CASES,
    DISTANCE,
    ITERATIONS,
    METHODS,
    ROBOT,
    THESIS_CELLS,
    TOOL,
    ArmCase,
    Cell,
    iterations_of,
    method_options,
)

FRAMES = 1000
"""Frames of a case, as many as the statistics of the thesis's program cover."""


@dataclass(frozen=True)
class CaseCell:
    """One cell of the table.

    Attributes:
        method: Name of the method.
        case: Number of the case, 1 to 4.
        thesis: Mean time in ms, mean iterations and per cent solved of the thesis.
        measured: The same, measured in this session. None: not yet.
    """

    method: str
    case: int
    thesis: Cell
    measured: Cell | None


@dataclass(frozen=True)
class CasesView:
    """The run of the cases.

    Attributes:
        running: Whether a case runs.
        case: Its number. 0: none.
        title: What the ball does and whether joints are limited.
        share: Share of all frames that have run, 0 to 1.
        cells: All cells of the table.
    """

    running: bool
    case: int
    title: str
    share: float
    cells: tuple[CaseCell, ...]


class CaseRunner:
    """Runs the cases one after the other.

    Args:
        send: Takes a command for the session.
        frames: Frames of each case, at most those of the statistics.
    """

    def __init__(self, send: Callable[[Command], None], frames: int = FRAMES) -> None:
        self._send = send
        self._frames = frames
        self._measured: dict[tuple[str, int], Cell] = {}
        self._index = -1
        self._stage: Literal["setup", "budgets", "frames"] = "setup"
        self._counted = 0
        self._options = {method: method_options(method) for method in METHODS}

    @property
    def is_running(self) -> bool:
        """Whether a case runs."""
        return 0 <= self._index < len(CASES)

    def start(self, view: View) -> None:
        """Begin with the first case."""
        self._measured = {}
        if not _is_plain_arm(view):
            self._send(SetRobot(ROBOT))
        self._send(SetCount(4))
        self._send(SetGoalKind("position"))
        for k, method in enumerate(METHODS):
            self._send(SetMethod(k, method, tuple(sorted(self._options[method].items()))))
        self._begin(0)

    def _begin(self, index: int) -> None:
        self._index = index
        self._stage = "setup"
        self._counted = 0
        if self.is_running:
            self._send(SetLimits(CASES[index].limited))

    def step(self, view: View) -> None:
        """Take a view. Start the next stage if a case is ready or done. The loop calls it.

        A person who stops the session or chooses another robot ends the run.
        """
        if not self.is_running:
            return
        case = CASES[self._index]
        if self._stage == "frames":
            self._count(view, case)
        elif not self._is_set_up(view, case):
            return
        elif self._stage == "setup":
            # Only now: a robot that was just loaded has the default budgets.
            for k in range(len(METHODS)):
                self._send(SetBudget(k, ITERATIONS, DISTANCE))
            for command in (SetRestarts(False), SetPace(0.0), SetSpeed(1.0)):
                self._send(command)
            self._stage = "budgets"
        elif all(one.distance == DISTANCE for one in view.instances):
            # Reset empties the statistics and puts the arms back to their starts.
            self._send(Reset())
            self._send(SetMotion("curve" if case.curve else "random"))
            self._stage = "frames"

    def _is_set_up(self, view: View, case: ArmCase) -> bool:
        """Return whether robot, methods and limits of a case have taken effect."""
        if not _is_plain_arm(view) or view.count != len(METHODS) or view.kind != "position":
            return False
        return all(
            one.method == method
            and one.limited is case.limited
            and self._options[method].items() <= dict(one.options).items()
            for one, method in zip(view.instances, METHODS, strict=True)
        )

    def _count(self, view: View, case: ArmCase) -> None:
        """Wait for the frames of a case."""
        if not (view.running and self._is_set_up(view, case)):
            self._index = -1
            return
        self._counted = min(one.statistics.count for one in view.instances)
        if self._counted >= self._frames:
            self._note(view, case)
            self._begin(self._index + 1)

    def _note(self, view: View, case: ArmCase) -> None:
        for method, one in zip(METHODS, view.instances, strict=True):
            figures = one.statistics
            self._measured[method, case.number] = (
                1e3 * figures.mean,
                iterations_of(method, figures.iterations),
                100.0 * figures.solved,
            )

    def view(self) -> CasesView:
        """Return what a front end shows."""
        case = CASES[self._index] if self.is_running else None
        done = len(self._measured) / len(METHODS) + min(self._counted / self._frames, 1.0)
        return CasesView(
            running=case is not None,
            case=case.number if case is not None else 0,
            title=case.title if case is not None else "",
            share=done / len(CASES),
            cells=tuple(
                CaseCell(method, k, cell, self._measured.get((method, k)))
                for method in METHODS
                for k, cell in enumerate(THESIS_CELLS[method], 1)
            ),
        )


def _is_plain_arm(view: View) -> bool:
    """Return whether a session shows the arm of the thesis as it was loaded."""
    is_changed = view.base or view.pins or view.stiffness or view.figure or view.tool != TOOL
    return view.robot == ROBOT and not is_changed
