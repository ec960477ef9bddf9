"""Frames of a figure's whole body: constraints row by row, solved frame by frame."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.figure.figure import DT, Figure
from robot_ik.kernels import whole_body
from robot_ik.kernels.block import Block
from robot_ik.kernels.whole_body import HARD
from robot_ik.ports import Array

_MAX_STEPS = 8
"""Default of the largest number of steps per frame."""

_REST_STEP = 1e-3
"""A step shorter than this (rad, m) is the last of a frame whose hard rows are met."""

_HARD_TOLERANCE = 1e-6
"""Error (m, rad) at which a hard row counts as met."""


@dataclass(frozen=True, eq=False)
class _Row:
    """One constraint in all frames, as ``kernels.whole_body`` reads it.

    Attributes:
        kind: What the row constrains.
        node: Node of the frame. -1 for the whole body.
        local: (12,) pose of the frame in its node: position and rotation matrix.
        axes: Bits of the axes that count.
        share: (nv,) 1 for joints that serve the row, 0 for the others.
        target: (frames, 12) targets.
        weight: (frames,) weights.
    """

    kind: int
    node: int
    local: Array
    axes: int
    share: Array
    target: Array
    weight: Array


class FrameRows:
    """Constraints of a sequence of frames.

    Args:
        figure: The figure.
        frames: Number of frames.
    """

    def __init__(self, figure: Figure, frames: int) -> None:
        self.figure = figure
        self.frames = frames
        self._rows: list[_Row] = []

    def _add(
        self,
        kind: int,
        frame: str | None,
        target: Array,
        weight: ArrayLike,
        axes: str = "xyz",
        joints: tuple[str, ...] = (),
    ) -> None:
        robot = self.figure.robot
        node, local = robot.attachment(frame) if frame else (-1, np.zeros(12))
        share = np.ones(robot.nv)
        if joints:
            share[:] = 0.0
            share[[self.figure.addresses(joint)[1] for joint in joints]] = 1.0
        targets = np.zeros((self.frames, 12))
        first = 3 if kind == whole_body.ROTATION else 0
        targets[:, first:][:, : target.shape[-1]] = target
        bits = sum(1 << "xyz".index(axis) for axis in axes)
        weights = np.broadcast_to(np.asarray(weight, dtype=float), self.frames)
        self._rows.append(_Row(kind, node, local, bits, share, targets, weights))

    def position(
        self, frame: str, target: Array, weight: ArrayLike = HARD, axes: str = "xyz"
    ) -> None:
        """Constrain the origin of a frame to (3,) or (n, 3)."""
        self._add(whole_body.POSITION, frame, target, weight, axes)

    def orientation(self, frame: str, target: Array, weight: ArrayLike = HARD) -> None:
        """Constrain the rotation of a frame to (3, 3) or (n, 3, 3)."""
        self._add(whole_body.ROTATION, frame, target.reshape(*target.shape[:-2], 9), weight)

    def center(self, target: Array, weight: ArrayLike = HARD, axes: str = "xyz") -> None:
        """Constrain the centre of mass to (3,) or (n, 3)."""
        self._add(whole_body.CENTER_OF_MASS, None, target, weight, axes)

    def aim(self, target: Array, weight: ArrayLike) -> None:
        """Aim the gaze at (3,) or (n, 3) with the joints of the neck.

        A figure without a gaze gets no constraint. A figure without a neck uses all joints.
        """
        if self.figure.gaze is not None:
            self._add(whole_body.AIM, self.figure.gaze, target, weight, joints=self.figure.neck)

    def momentum(self, weight: ArrayLike = HARD) -> None:
        """Constrain the angular momentum about the centre of mass between two frames to zero."""
        self._add(whole_body.MOMENTUM, None, np.zeros(3), weight)

    def feet(self, poses: Mapping[str, tuple[Array, Array]], weight: ArrayLike = HARD) -> None:
        """Constrain the poses of both feet.

        Args:
            poses: By side, position (3,) or (n, 3) and rotation (3, 3) or (n, 3, 3).
            weight: Weight of all these rows.
        """
        for side, foot in self.figure.feet.items():
            position, rotation = poses[side]
            self.position(foot.frame, position, weight)
            self.orientation(foot.frame, rotation, weight)

    def solve(
        self,
        posture: Array,
        stiffness: Array,
        start: Array,
        before_start: Array | None = None,
        *,
        limits: tuple[Array, Array] | None = None,
        speeds: str | None = "daily",
        max_steps: int = _MAX_STEPS,
    ) -> Frames:
        """Solve the frames, one after the other.

        Args:
            posture: (nq,) or (n, nq) wanted posture where the rows leave freedom.
            stiffness: (nv,) or (n, nv) weights of the posture.
            start: (nq,) the frame before the first.
            before_start: (nq,) the frame before ``start``. Default: the figure was at rest.
            limits: (nv,) lower and upper limits inside those of the model.
            speeds: Set of joint speed limits that every frame keeps. None: no speed limits.
            max_steps: Largest number of steps per frame.
        """
        stiffnesses = np.array(np.broadcast_to(stiffness, (self.frames, self.figure.robot.nv)))
        prepared = self.prepare(posture, stiffnesses[0], limits=limits, speeds=speeds)
        count = self.frames
        solved = Frames(
            np.empty((count, self.figure.robot.nq)),
            np.empty(count),
            np.empty(count, dtype=np.int64),
        )
        last = np.array(start)
        last_but_one = np.array(start if before_start is None else before_start)

        # One call of the kernel solves frames with equal stiffness.
        changes = np.flatnonzero((np.diff(stiffnesses, axis=0) != 0.0).any(axis=1)) + 1
        for first, end in itertools.pairwise([0, *changes.tolist(), count]):
            prepared.body.arrays["stiffness"][:] = stiffnesses[first]
            prepared.solve(
                solved, first, end, last, last_but_one, max_steps, _REST_STEP, _HARD_TOLERANCE
            )
            last_but_one = solved.q[end - 2].copy() if end > first + 1 else last
            last = solved.q[end - 1].copy()
        return solved

    def prepare(
        self,
        posture: Array,
        stiffness: Array,
        *,
        limits: tuple[Array, Array] | None = None,
        speeds: str | None = "daily",
    ) -> PreparedRows:
        """Return the rows with the memory of their solves. Arguments are those of ``solve``."""
        robot = self.figure.robot
        rows = self._rows
        groups = len(rows)
        lower, upper = limits or (robot.tree.lower, robot.tree.upper)
        no_limits = np.full(robot.nv, np.inf)
        sizes = {
            "g": groups,
            "h": 3 * groups,
            "nq": robot.nq,
            "nv": robot.nv,
            "n": robot.tree.size,
            "b": robot.tree.size + 1,
            "k": max(3 * groups, robot.nv),
        }
        inputs: dict[str, NDArray[Any] | Block] = {
            "tree": robot.tree.block,
            "masses": self.figure.masses,
            "kind": np.array([row.kind for row in rows], dtype=np.int64),
            "node": np.array([row.node for row in rows], dtype=np.int64),
            "local": np.array([row.local for row in rows]).reshape(groups, 12),
            "axes": np.array([row.axes for row in rows], dtype=np.int64),
            "share": np.array([row.share for row in rows]),
            "inertia": self.figure.inertia,
            "stiffness": np.array(stiffness, order="C"),
            "lower": lower,
            "upper": upper,
            "stride": self.figure.speeds.get(speeds or "", no_limits) * DT,
        }
        return PreparedRows(
            whole_body.WHOLE_BODY.allocate(sizes, inputs),
            np.ascontiguousarray(np.stack([row.target for row in rows], axis=1)),
            np.ascontiguousarray(np.stack([row.weight for row in rows], axis=1)),
            np.array(np.broadcast_to(posture, (self.frames, robot.nq)), order="C"),
        )


@dataclass(eq=False)
class PreparedRows:
    """Rows with the memory of their solves. The arrays may be changed between solves, in place.

    Attributes:
        body: Memory of ``WHOLE_BODY``. After a solve it holds the state of the last step.
        target: (frames, groups, 12) targets in the order in which the rows were added.
        weight: (frames, groups) weights.
        posture: (frames, nq) wanted postures.
    """

    body: Block
    target: Array
    weight: Array
    posture: Array

    def solve(
        self,
        solved: Frames,
        first: int,
        end: int,
        last: Array,
        last_but_one: Array,
        max_steps: int,
        rest_step: float,
        hard_tolerance: float,
    ) -> None:
        """Write frames ``first`` to ``end - 1`` into ``solved``.

        Args:
            solved: Receives the frames.
            first: First frame.
            end: Frame after the last.
            last: (nq,) the frame before the first.
            last_but_one: (nq,) the frame before ``last``.
            max_steps: Largest number of steps per frame.
            rest_step: A shorter step is the last of a frame whose hard rows are met.
            hard_tolerance: Error at which a hard row counts as met.
        """
        self.body["max_steps"] = max_steps
        self.body["rest"] = rest_step
        self.body["close"] = hard_tolerance
        whole_body.solve_frames(
            self.body.address,
            self.target[first:end].reshape(-1, 12),
            self.weight[first:end],
            self.posture[first:end],
            solved.q[first:end],
            last,
            last_but_one,
            solved.error[first:end],
            solved.steps[first:end],
        )


@dataclass(frozen=True)
class Frames:
    """Solved frames.

    Attributes:
        q: (n, nq) joint values.
        error: (n,) largest error of a hard row in each frame, m or rad.
        steps: (n,) steps taken.
    """

    q: Array
    error: Array
    steps: NDArray[np.int64]
