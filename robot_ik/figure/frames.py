"""Frames of a figure's whole body: what they shall do, row by row, solved a few at a time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.figure.figure import DT, Figure
from robot_ik.kernels import whole_body
from robot_ik.kernels.block import Block
from robot_ik.kernels.whole_body import HARD
from robot_ik.ports import Array

# Work that is done a little at a time yields between its parts and returns its result.
_Result = TypeVar("_Result")
_Given = ParamSpec("_Given")
Slices = Generator[None, None, _Result]
SLICE, _STEPS = 60, 8
"""Frames solved between two yields, some 3 ms, where each takes so many steps at most."""
_REST, _CLOSE = 1e-3, 1e-6
"""A step shorter than the first (rad, m) is a frame's last if its hard rows are as close as the second."""


def finished(slices: Slices[_Result]) -> _Result:
    """The result of work in slices, done at once."""
    while True:
        try:
            next(slices)
        except StopIteration as end:
            return cast(_Result, end.value)


def at_once(work: Callable[_Given, Slices[_Result]]) -> Callable[_Given, _Result]:
    """Work in slices as a function that does all of it."""
    return lambda *given, **options: finished(work(*given, **options))


class FrameRows:
    """What a run of frames shall do: rows of ``kernels.whole_body``, frame by frame."""

    def __init__(self, figure: Figure, frames: int) -> None:
        self.figure, self.frames = figure, frames
        # Of each row its kind, node, local, axes and share, as the kernel has them, its targets and weights.
        self._rows: list[tuple[int, int, Array, int, Array, Array, Array]] = []

    def _add(
        self, kind: int, frame: str | None, target: Array, weight: ArrayLike, axes: str = "xyz",
        joints: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        node, local = self.figure.robot.attachment(frame) if frame else (-1, np.zeros(12))
        share = np.ones(self.figure.robot.nv)
        if joints:
            share[:] = 0.0
            share[[self.figure.addresses(joint)[1] for joint in joints]] = 1.0
        row = np.zeros((self.frames, 12))
        row[:, 3 if kind == whole_body.ROTATION else 0 :][:, : target.shape[-1]] = target
        bits = sum(1 << "xyz".index(axis) for axis in axes)
        weights = np.broadcast_to(np.asarray(weight, dtype=float), self.frames)
        self._rows.append((kind, node, local, bits, share, row, weights))

    def position(self, frame: str, target: Array, weight: ArrayLike = HARD, axes: str = "xyz") -> None:
        """A frame's origin at (3,) or (n, 3)."""
        self._add(whole_body.POSITION, frame, target, weight, axes)

    def orientation(self, frame: str, target: Array, weight: ArrayLike = HARD) -> None:
        """A frame's rotation (3, 3) or (n, 3, 3)."""
        self._add(whole_body.ROTATION, frame, target.reshape(*target.shape[:-2], 9), weight)

    def center(self, target: Array, weight: ArrayLike = HARD, axes: str = "xyz") -> None:
        """The centre of mass at (3,) or (n, 3)."""
        self._add(whole_body.CENTER_OF_MASS, None, target, weight, axes)

    def aim(self, target: Array, weight: ArrayLike) -> None:
        """The eyes, if there are any, at (3,) or (n, 3), by the neck where there is one: no trunk bends."""
        if self.figure.gaze is not None:
            self._add(whole_body.AIM, self.figure.gaze, target, weight, joints=self.figure.neck)

    def momentum(self, weight: ArrayLike = HARD) -> None:
        """No angular momentum about the centre of mass between a frame and the one before."""
        self._add(whole_body.MOMENTUM, None, np.zeros(3), weight)

    def feet(self, poses: Mapping[str, tuple[Array, Array]], weight: ArrayLike = HARD) -> None:
        """Both feet, by side: (3,) or (n, 3), and (3, 3) or (n, 3, 3)."""
        for side, foot in self.figure.feet.items():
            self.position(foot.frame, poses[side][0], weight)
            self.orientation(foot.frame, poses[side][1], weight)

    def slices(
        self, posture: Array, stiffness: Array, start: Array, second: Array | None = None, *,
        limits: tuple[Array, Array] | None = None, speeds: str | None = "daily",
        steps: int = _STEPS,
    ) -> Slices[Frames]:  # fmt: skip
        """The frames, some at a time.

        Args:
            posture: (nq,) or (n, nq) wanted where the rows leave freedom.
            stiffness: (nv,) or (n, nv) weights of the posture.
            start: (nq,) the frame before the first.
            second: (nq,) the frame before that; default: at rest.
            limits: (nv,) lower and upper limits inside the model's.
            speeds: Set of joint speed limits that no frame breaks; None: as fast as need be.
            steps: Most steps a frame.
        """
        each = np.array(np.broadcast_to(stiffness, (self.frames, self.figure.robot.nv)))
        ready = self.prepare(posture, each[0], limits=limits, speeds=speeds)
        n, nq = self.frames, self.figure.robot.nq
        changes = np.flatnonzero((np.diff(each, axis=0) != 0.0).any(axis=1)) + 1
        found = Frames(np.empty((n, nq)), np.empty(n), np.empty(n, dtype=np.int64))
        before, here = np.array(start if second is None else second), np.array(start)
        some = max(1, SLICE * _STEPS // steps)  # frames that may take more steps, fewer at a time
        cuts = sorted({*range(0, n, some), *changes.tolist(), n})
        for a, b in itertools.pairwise(cuts):
            ready.body.arrays["stiffness"][:] = each[a]
            ready.solve(found, a, b, here, before, steps, _REST, _CLOSE)
            before, here = (found.q[b - 2] if b > a + 1 else here).copy(), found.q[b - 1].copy()
            if b < n and b % some == 0:
                yield
        return found

    solve = at_once(slices)

    def prepare(
        self, posture: Array, stiffness: Array, *, limits: tuple[Array, Array] | None = None,
        speeds: str | None = "daily",
    ) -> PreparedRows:  # fmt: skip
        """The rows with their tables, for many solves; arguments as those of ``solve``."""
        robot, groups = self.figure.robot, len(self._rows)
        kind, node, local, axes, share, targets, weights = zip(*self._rows, strict=True)
        lower, upper = limits or (robot.tree.lower, robot.tree.upper)
        n, sizes = robot.tree.size, {"g": groups, "h": 3 * groups, "nq": robot.nq, "nv": robot.nv}
        sizes |= {"n": n, "b": n + 1, "k": max(3 * groups, robot.nv)}
        given: dict[str, NDArray[Any] | Block] = {
            "tree": robot.tree.block,
            "masses": self.figure.masses,
            "kind": np.array(kind, dtype=np.int64),
            "node": np.array(node, dtype=np.int64),
            "local": np.array(local).reshape(groups, 12),
            "axes": np.array(axes, dtype=np.int64),
            "share": np.array(share),
            "inertia": self.figure.inertia,
            "stiffness": np.array(stiffness, order="C"),
            "lower": lower,
            "upper": upper,
            "stride": self.figure.speeds.get(speeds or "", np.full(robot.nv, np.inf)) * DT,
        }
        return PreparedRows(
            whole_body.WHOLE_BODY.allocate(sizes, given),
            np.ascontiguousarray(np.stack(targets, axis=1)),
            np.ascontiguousarray(np.stack(weights, axis=1)),
            np.array(np.broadcast_to(posture, (self.frames, robot.nq)), order="C"),
        )


@dataclass(eq=False)
class PreparedRows:
    """Rows with the memory of their solves.  All of it may change between solves, in place."""

    body: Block  # of ``WHOLE_BODY``: what the kernel writes is as the last step left it
    target: Array  # (frames, groups, 12), in the order in which the rows were added
    weight: Array  # (frames, groups)
    posture: Array  # (frames, nq)

    def solve(
        self, found: Frames, a: int, b: int, here: Array, before: Array, steps: int, rest: float, close: float
    ) -> None:
        """Frames a to b into ``found``, after ``here`` and ``before`` that (nq,)."""
        self.body["max_steps"] = steps
        self.body["rest"] = rest
        self.body["close"] = close
        whole_body.solve_frames(
            self.body.address, self.target[a:b].reshape(-1, 12), self.weight[a:b], self.posture[a:b],
            found.q[a:b], here, before, found.error[a:b], found.steps[a:b],
        )  # fmt: skip


@dataclass(frozen=True)
class Frames:
    """What ``FrameRows.solve`` found."""

    q: Array  # (n, nq)
    error: Array  # (n,) largest error of a hard row in each frame, m or rad
    steps: NDArray[np.int64]  # (n,) steps taken
