"""Actions without steps: reach, bend and the return to rest.

An action is a sequence of frames with an exact end. All actions are computed in the frame of the
stance (``Figure.stance``) and moved into the world at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.balance import compensate, zero_moment_points
from robot_ik.figure.curves import smooth
from robot_ik.figure.figure import DT, GRAVITY, Figure, in_stance_frame
from robot_ik.figure.frames import FrameRows, Frames
from robot_ik.figure.gait import FLAT
from robot_ik.figure.pose_search import find_pose
from robot_ik.figure.poses import REACH, STIFFNESS, support, touches_itself
from robot_ik.figure.walk import Walk
from robot_ik.geometry import (
    axis_rotations,
    matrix_to_quat,
    quat_to_matrix,
    rotation_exp,
    rotation_log,
)
from robot_ik.motion.timing import QUINTIC_PEAK_VELOCITY, minimum_jerk
from robot_ik.ports import Array


@dataclass(frozen=True)
class ActionOptions:
    """Parameters of reach, bend and rest.

    Attributes:
        reach_speed: Peak speed of a hand that reaches, m/s (Flash & Hogan 1985: 0.3 to 0.5 m in
            0.5 to 0.8 s).
        bend_speed: Peak speed of a hand while the figure bends, m/s.
        min_time: Shortest duration of a motion, s.
        glance_speed: Peak angular speed of the gaze, rad/s (heads rotate at 3 to 6 rad/s).
        glance_time: Shortest time of a glance, s.
        upright: Cosine of the largest lean of the trunk at which a hand moves straight to a ball:
            15 degrees.
        inside: A zero-moment point at least this far inside the soles needs no correction, m.
        rounds: Rounds of the correction of the zero-moment point.
        largest_error: Largest error of the zero-moment point that one round corrects, m.
        error_time: Time over which errors of the zero-moment point are smoothed, s.
        abrupt: Largest change of a joint's speed in a frame, rad/s.
        slower: Factor of the duration where a motion loses balance or is abrupt.
        elbow_away: Angle of the elbows away from the body in a further try where bodies touch, rad.
        tries: Number of tries.
        late: Share of the duration after which a hand that follows the posture is pulled to its
            ball.
        late_weight: Weight of the hand in that part.
        hold: Time for which the hand stays at its ball, s.
        check_every: Self-contact is checked in every frame of this number.
        reach_joint_speed: Share of the joint speed limits that a motion uses.
        bend_joint_speed: Largest joint speed of a bend, rad/s.
        rest_joint_share: Share of the joint speed limits that the return to rest uses.
        rest_joint_speed: Largest joint speed of the return to rest, rad/s.
        gaze_weight: Weight of the gaze.
    """

    reach_speed: float = 1.6
    bend_speed: float = 0.7
    min_time: float = 0.45
    glance_speed: float = 2.5
    glance_time: float = 0.45
    upright: float = 0.966
    inside: float = 0.005
    rounds: int = 3
    largest_error: float = 0.12
    error_time: float = 0.02
    abrupt: float = 1.8
    slower: float = 1.35
    elbow_away: float = 0.35
    tries: int = 4
    late: float = 0.8
    late_weight: float = 300.0
    hold: float = 0.2
    check_every: int = 2
    reach_joint_speed: float = 0.75
    bend_joint_speed: float = 3.0
    rest_joint_share: float = 0.6
    rest_joint_speed: float = 2.5
    gaze_weight: float = 8.0


ACTING = ActionOptions()
"""The parameters of all actions."""

_MIN_DISTANCE = 0.1
"""Smallest distance of a ball from the eyes for the direction of a glance, m."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Frames of an action.

    Attributes:
        action: ``stand``, ``reach``, ``bend``, ``jump``, ``walk`` or ``rest``.
        q: (n, nq) frames.
        contact: (n, 2) state of each foot: ``gait.AIR``, ``HEEL``, ``FLAT`` or ``TOE``.
        error: (n,) largest error of a hard row, m or rad.
        zmp: (n, 2) planned zero-moment point.
        interruptible: (n,) whether another motion may follow each frame.
        speeds: Set of joint speed limits that the motion keeps.
    """

    action: str
    q: Array
    contact: NDArray[np.int64]
    error: Array
    zmp: Array
    interruptible: NDArray[np.bool_]
    speeds: str = "daily"

    def __len__(self) -> int:
        return len(self.q)


def to_stance_frame(figure: Figure, q: Array) -> tuple[Array, Array]:
    """Return ``q`` (nq,) in the frame of its stance, and that stance (x, y, heading)."""
    stance = figure.stance(q)
    x, y = -(axis_rotations("z", -stance[2])[:2, :2] @ stance[:2])
    return figure.placed(q, x, y, -stance[2]), stance


def placed_motion(figure: Figure, motion: Motion, stance: Array) -> Motion:
    """Return a motion in the frame of a stance, moved into the world."""
    rotation = axis_rotations("z", float(stance[2]))
    q = np.array([figure.placed(row, *stance) for row in motion.q])
    return replace(motion, q=q, zmp=motion.zmp @ rotation[:2, :2].T + stance[:2])


def _standing_motion(
    figure: Figure, action: str, frames: Frames, center: Array, stance: Array
) -> Motion:
    """Return a motion with flat feet, from frames in the frame of a stance."""
    count = len(frames.q)
    motion = Motion(
        action=action,
        q=frames.q,
        contact=np.full((count, 2), FLAT),
        error=frames.error,
        zmp=np.broadcast_to(center, (count, 2)),
        interruptible=np.ones(count, dtype=bool),
    )
    return placed_motion(figure, motion, stance)


def _add_glance(
    figure: Figure, rows: FrameRows, q: Array, ball: Array, t: Array, within: float
) -> None:
    """Add rows to ``rows`` that turn the gaze to a ball, smoothly so that the neck does not jerk.

    Args:
        figure: The figure.
        rows: Receives the rows.
        q: (nq,) first pose of the motion.
        ball: (3,) the ball.
        t: (n,) times of the frames, s.
        within: Shortest time of the glance, s.
    """
    if figure.gaze is None:
        return
    eyes, rotation = figure.pose(q, figure.gaze)
    distance = max(float(np.linalg.norm(ball - eyes)), _MIN_DISTANCE)
    forward = rotation[:, 0]
    to_ball = (ball - eyes) / distance
    angle = float(np.arccos(np.clip(forward @ to_ball, -1.0, 1.0)))
    s = minimum_jerk(t / max(within, glance_time(figure, q, ball)))[:, None]

    # The target moves along an arc. The straight line between two opposite directions would pass
    # through the head.
    if angle > 1e-3:
        arc = np.sin((1 - s) * angle) * forward + np.sin(s * angle) * to_ball
    else:
        arc = (1 - s) * forward + s * to_ball
    arc = arc / np.maximum(np.linalg.norm(arc, axis=1, keepdims=True), 1e-6)
    rows.aim((eyes + distance * arc) * (1 - s) + ball * s, ACTING.gaze_weight)


def glance_time(figure: Figure, q: Array, ball: Array | None) -> float:
    """Return the time that the gaze needs to reach a ball, s."""
    if figure.gaze is None or ball is None:
        return 0.0
    eyes, rotation = figure.pose(q, figure.gaze)
    to_ball = (ball - eyes) / max(float(np.linalg.norm(ball - eyes)), _MIN_DISTANCE)
    angle = float(np.arccos(np.clip(rotation[:, 0] @ to_ball, -1.0, 1.0)))
    return QUINTIC_PEAK_VELOCITY * angle / ACTING.glance_speed


def return_to_rest(figure: Figure, q: Array, *, gaze_target: Array | None = None) -> Motion:
    """Return the motion to the home pose. The feet do not move.

    Args:
        figure: The figure.
        q: (nq,) first pose.
        gaze_target: (3,) point at which the figure looks, in the world. None: no such point.
    """
    start, stance = to_stance_frame(figure, q)
    difference = figure.robot.difference(start, figure.home)[6:]
    limits = np.minimum(
        ACTING.rest_joint_share * figure.speeds["daily"][6:], ACTING.rest_joint_speed
    )
    target = None if gaze_target is None else in_stance_frame(stance, gaze_target)
    duration = max(
        ACTING.min_time,
        QUINTIC_PEAK_VELOCITY * float((np.abs(difference) / limits).max()),
        glance_time(figure, start, target),
    )

    def add_rows(rows: FrameRows, t: Array, _duration: float) -> None:
        if target is not None:
            _add_glance(figure, rows, start, target, t, ACTING.glance_time)

    transfer = _Transfer(
        figure=figure,
        start=start,
        goal=figure.home,
        hold=0.1,
        stiffness=figure.stiffnesses(STIFFNESS),
        trunk_weight=3.0,
        arms=tuple(figure.hands),
        add_rows=add_rows,
    )
    frames = transfer.fastest(duration)
    return _standing_motion(figure, "rest", frames, figure.center_at_home[:2], stance)


def reach_ball(
    figure: Figure, q: Array, ball: Array, arm: str, kind: str, *, end: Array | None = None
) -> Motion:
    """Return the motion of a hand to a ball.

    The posture changes to the pose at the end. Soft rows pull the hand to the ball, because the
    joints often cannot follow a hard line.

    Args:
        figure: The figure.
        q: (nq,) first pose.
        ball: (3,) the ball in the world.
        arm: Side of the hand.
        kind: ``reach`` stands upright, with the hand on a nearly straight path. ``bend`` leans.
        end: (nq,) pose at the ball, in the frame of the stance. Default: the pose is searched.
    """
    start, stance = to_stance_frame(figure, q)
    ball = in_stance_frame(stance, np.asarray(ball, dtype=float))
    hand = figure.pose(start, figure.hands[arm])[0]
    goal = find_pose(figure, ball, arm, kind).q if end is None else end
    trunk_up = figure.pose(goal, figure.trunk)[1][2, 2]

    # A straight path of the hand while the trunk leans would straighten elbow and knees.
    is_upright = kind == REACH and trunk_up > ACTING.upright
    difference = figure.robot.difference(start, goal)[6:]
    largest_speed = np.inf if is_upright else ACTING.bend_joint_speed
    limits = np.minimum(ACTING.reach_joint_speed * figure.speeds["daily"][6:], largest_speed)
    hand_speed = ACTING.reach_speed if is_upright else ACTING.bend_speed
    duration = max(
        ACTING.min_time,
        QUINTIC_PEAK_VELOCITY * float(np.linalg.norm(ball - hand)) / hand_speed,
        QUINTIC_PEAK_VELOCITY * float((np.abs(difference) / limits).max()),
        glance_time(figure, start, ball),
    )

    def add_rows(rows: FrameRows, t: Array, duration: float) -> None:
        if is_upright:
            s = minimum_jerk(t / duration)
            weight = 30.0 * 10.0 ** (2 * s)
            rows.position(figure.hands[arm], hand + (ball - hand) * s[:, None], weight)
            _add_glance(figure, rows, start, ball, t, within=0.6)
        else:
            share = minimum_jerk((t / duration - ACTING.late) / (1 - ACTING.late))
            rows.position(figure.hands[arm], ball, ACTING.late_weight * share)
            _add_glance(figure, rows, start, ball, t, within=0.7 * duration)

    transfer = _Transfer(
        figure=figure,
        start=start,
        goal=goal,
        hold=ACTING.hold,
        stiffness=figure.stiffnesses(STIFFNESS | {"*hip_pitch": 1.0, "*knee_pitch": 1.0}),
        trunk_weight=20.0 if is_upright else 3.0,
        arms=(arm,),
        add_rows=add_rows,
    )
    frames = transfer.fastest(duration)
    return _standing_motion(figure, kind, frames, figure.center(goal)[:2], stance)


def walk_motion(walk: Walk) -> Motion:
    """Return a walk as a motion. It may be interrupted when both feet stand flat at its end."""
    times = np.arange(1, len(walk.frames.q) + 1) * DT
    return Motion(
        action="walk",
        q=walk.frames.q,
        contact=walk.contact,
        error=walk.frames.error,
        zmp=walk.zmp,
        interruptible=times > walk.strikes[-1] + 0.5,
    )


@dataclass(frozen=True, eq=False)
class _Transfer:
    """A motion from one pose to another without steps.

    Attributes:
        figure: The figure.
        start: (nq,) first pose, in the frame of the stance.
        goal: (nq,) last pose of posture, centre of mass and trunk.
        hold: Time for which the goal is held, s.
        stiffness: (nv,) weights of the posture.
        trunk_weight: Weight of the rotation of the trunk.
        arms: Sides of the arms whose elbows leave a body that they touch.
        add_rows: Adds rows to the frames at times (n,), s, of a motion of a duration, s.
    """

    figure: Figure
    start: Array
    goal: Array
    hold: float
    stiffness: Array
    trunk_weight: float
    arms: Sequence[str]
    add_rows: Callable[[FrameRows, Array, float], None]

    def fastest(self, duration: float) -> Frames:
        """Return the frames of the shortest duration that keeps balance and touches no body.

        Args:
            duration: Duration of the first try, s.

        Returns:
            The best try, if none keeps balance without a self-contact.
        """
        best: Frames | None = None
        best_rating = (False, False, -np.inf)
        abduction = 0.0
        for _ in range(ACTING.tries):
            frames, margin, is_steady = self._try(duration, abduction)
            touches = touches_itself(self.figure, frames.q[:: ACTING.check_every])
            rating = (not touches, is_steady, margin)
            if best is None or rating > best_rating:
                best = frames
                best_rating = rating
            if is_steady and not touches:
                break
            if not is_steady:
                duration *= ACTING.slower
            if touches:
                abduction += ACTING.elbow_away
        if best is None:
            raise RuntimeError("no duration was tried")
        return best

    def _try(self, duration: float, abduction: float) -> tuple[Frames, float, bool]:
        """Return frames whose zero-moment point follows the planned centre of mass.

        Args:
            duration: Duration of the transfer, s.
            abduction: Angle of the elbows away from the body in the middle of the transfer, rad.

        Returns:
            The frames, the smallest distance of the zero-moment point from the border of the soles,
            m, and whether the motion keeps balance and is not abrupt.
        """
        figure = self.figure
        t = np.arange(1, round((duration + self.hold) / DT) + 1, dtype=np.float64) * DT
        s = minimum_jerk(t / duration)
        away = abduction * 16 * (s * (1 - s)) ** 2
        rolls = {f"{side}_shoulder_roll": away for side in self.arms}
        elbows = figure.posture(rolls, np.zeros((len(s), figure.robot.nq)))
        posture = self.start + (self.goal - self.start) * s[:, None] + elbows
        first_rotation = figure.pose(self.start, figure.trunk)[1]
        last_rotation = figure.pose(self.goal, figure.trunk)[1]
        first_center = figure.center(self.start)[:2]
        last_center = figure.center(self.goal)[:2]
        planned = first_center + (last_center - first_center) * s[:, None]
        center = planned
        normal, offset = support(figure)
        omega2 = np.full(len(t), GRAVITY / figure.center_at_home[2])
        for remaining_rounds in reversed(range(ACTING.rounds)):
            rows = FrameRows(figure, len(t))
            rows.feet(figure.feet_at(self.start))
            rows.center(center, axes="xy")
            trunk = _interpolated_rotations(first_rotation, last_rotation, s)
            rows.orientation(figure.trunk, trunk, self.trunk_weight)
            self.add_rows(rows, t, duration)
            frames = rows.solve(posture, self.stiffness, self.start)
            points, _ = zero_moment_points(figure, frames.q)
            margin = float((points[1:-1] @ normal.T - offset).min())
            if margin >= ACTING.inside or not remaining_rounds:
                break
            largest = ACTING.largest_error
            error = smooth(np.clip(points - planned, -largest, largest), ACTING.error_time / DT)
            error[:2] = 0.0
            error[-2:] = 0.0
            center = center + compensate(error, omega2)
        change = float(np.abs(np.diff(frames.q[:, 7:], n=2, axis=0)).max()) / DT
        return frames, margin, margin >= 0.0 and change <= ACTING.abrupt


def _interpolated_rotations(first: Array, last: Array, s: Array) -> Array:
    """Return rotations (n, 3, 3) on the shortest arc between two, at shares ``s`` (n,)."""
    vector = rotation_log(matrix_to_quat(last @ first.T))
    return np.array([quat_to_matrix(rotation_exp(vector * share)) @ first for share in s])
