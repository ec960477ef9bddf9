"""Poses with a hand at a ball, without steps.

All balls here are given in the frame of the stance: the middle between the feet, x forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.figure import Figure, cached_per_figure
from robot_ik.figure.frames import FrameRows
from robot_ik.figure.hull import hull, hull_edges
from robot_ik.figure.soles import lowest_points, shape_points
from robot_ik.geometry import axis_rotations
from robot_ik.ports import Array

REACH = "reach"
"""The kind of poses that stand upright."""

BEND = "bend"
"""The kind of poses with any posture."""

PALM_TOLERANCE = 0.005
"""Largest distance of palm and ball in an admissible pose, m."""

BALANCE_MARGIN = 0.010
"""Smallest distance of the centre of mass from the border of the soles' hull, m."""

CONTACT_TOLERANCE = 0.002
"""Largest depth of a self-contact in an admissible pose, m."""

FEET_TOLERANCE = 1e-4
"""Largest error of the feet in an admissible pose, m or rad."""

FLOOR_CLEARANCE = 0.003
"""A body lower than this is held above the floor, m."""

STIFFNESS = {
    "*": 0.1,
    "*shoulder*": 0.15,
    "*elbow*": 0.15,
    "*clavicle*": 2.0,
    "*wrist*": 3.0,
    "head*": 3.0,
    "torso*": 1.0,
    "pelvis*": 1.0,
    "*toe*": 100.0,
}
"""Weights of the posture, by patterns of joint names: the arm moves before girdle and wrist."""

_UPRIGHT_DEG = {
    "knee_pitch": (0.0, 25.0),
    "hip_pitch": (-15.0, 30.0),
    "torso_pitch": (-10.0, 10.0),
    "pelvis_pitch": (-10.0, 10.0),
}
"""Ranges of joints of an upright figure, degrees. They separate ``reach`` from ``bend``."""


@cached_per_figure
def limits_of(figure: Figure, kind: str) -> tuple[Array, Array]:
    """Return the lower and upper joint limits (nv,) of a ``reach`` or a ``bend``."""
    lower = figure.robot.lower.copy()
    upper = figure.robot.upper.copy()
    if kind != REACH:
        return lower, upper
    for joint in figure.robot.joints:
        for part, (lower_deg, upper_deg) in _UPRIGHT_DEG.items():
            if joint.endswith(part):
                v = figure.addresses(joint)[1]
                lower[v] = max(lower[v], np.radians(lower_deg))
                upper[v] = min(upper[v], np.radians(upper_deg))
    return lower, upper


@dataclass(frozen=True, eq=False)
class FigurePose:
    """A pose with a hand near a ball.

    Attributes:
        q: (nq,) pose in the frame of the stance.
        error: Distance of palm and ball, m.
        violation: Why the pose is not admissible. Empty for an admissible pose.
    """

    q: Array
    error: float
    violation: str


def checked_pose(figure: Figure, q: Array, ball: Array, arm: str, feet_error: float) -> FigurePose:
    """Return a pose with its error and its violation, by MuJoCo.

    Args:
        figure: The figure.
        q: (nq,) the pose.
        ball: (3,) the ball.
        arm: Side of the hand.
        feet_error: Error of the feet, m or rad.
    """
    normal, offset = support(figure)
    error = float(np.linalg.norm(figure.pose(q, figure.hands[arm])[0] - ball))
    center = figure.center(q)
    if error > PALM_TOLERANCE:
        violation = f"the hand stays {100 * error:.0f} cm away"
    elif feet_error > FEET_TOLERANCE:
        violation = "the feet would move"
    elif (normal @ center[:2] - offset).min() < BALANCE_MARGIN:
        violation = "balance would be lost"
    else:
        violation = ""
    # The check of contacts takes longest, so it is last.
    return FigurePose(q, error, violation or _collision(figure, q))


def natural_pose(
    figure: Figure,
    ball: Array,
    arm: str,
    kind: str,
    *,
    abduction: float = 0.0,
    palm_down: bool = False,
    center_weight: float = 30.0,
    bend_share: float = 1.0,
) -> FigurePose:
    """Return the pose after some frames that move the hand to a ball from a natural posture.

    Args:
        figure: The figure.
        ball: (3,) the ball.
        arm: Side of the hand.
        kind: ``reach`` or ``bend``.
        abduction: Angle of the elbow away from the body, rad.
        palm_down: Whether the hand is horizontal.
        center_weight: Weight of the centre of mass in the middle of the soles.
        bend_share: Share of the usual bend.
    """
    frames = 12
    start = figure.home
    s = np.minimum(1.0, np.arange(1, frames + 1) / (0.75 * frames))
    depth = 0.0 if kind == REACH else bend_share * bend_depth(figure, ball)
    rows = FrameRows(figure, frames)
    rows.feet(figure.feet_at_home)

    # Balance is safest above the middle of the soles.
    center = figure.center_at_home[:2]
    sole = figure.feet["left"].sole
    middle = np.array([(sole.front + sole.rear) / 2 - 0.01, 0.0])
    rows.center(center + (middle - center) * s[:, None], center_weight, axes="xy")

    # The weight of the hand grows ten thousandfold, so that the hand comes as near as it can.
    hand = figure.hands_at_home[arm]
    hand_weight = 10.0 ** (2.0 + 4.0 * s**2)
    rows.position(figure.hands[arm], hand + (ball - hand) * s[:, None], hand_weight)
    lean = np.radians(4.0 + 62.0 * depth) * s
    rows.orientation(figure.trunk, axis_rotations("y", lean), 0.5)
    rows.aim(ball, 8.0)

    goal = start + (figure.bent - start) * depth
    goal[:7] = start[:7]
    if palm_down:
        rows.orientation(figure.hands[arm], axis_rotations("y", -np.pi / 2), 0.3 * s)
    if abduction:
        angles = {f"{arm}_shoulder_roll": abduction, f"{arm}_shoulder_yaw": -abduction}
        goal = figure.posture(angles, goal)
    posture = start + (goal - start) * s[:, None]
    toes = figure.stiffnesses({"*": 0.0, "*toe*": 1e4})
    stiffness = np.minimum(figure.stiffnesses(STIFFNESS), 0.1) + toes
    solved = rows.solve(
        posture, stiffness, start, limits=limits_of(figure, kind), speeds=None, max_steps=6
    )
    return checked_pose(figure, solved.q[-1], ball, arm, float(solved.error[-1]))


def bend_depth(figure: Figure, ball: Array) -> float:
    """Return the depth of the bend for a ball, from 0 to 1, by its height and that of the hand."""
    hand = figure.hands[next(iter(figure.hands))]
    hanging = float(figure.pose(figure.home, hand)[0][2])
    return float(np.clip(0.15 + 0.85 * (hanging - ball[2] + 0.1) / hanging, 0.15, 1.0))


@cached_per_figure
def support(figure: Figure) -> tuple[Array, Array]:
    """Return the edges of the hull of the soles at home, as ``hull_edges``."""
    points = []
    data = figure.data_at(figure.home)
    for foot in figure.feet.values():
        for body, geoms in foot.parts:
            rotation = data.xmat[body].reshape(3, 3)
            local = [shape_points(figure.model, geom, rotation[2:3])[:, 0] for geom in geoms]
            world = data.xpos[body] + np.concatenate(local) @ rotation.T
            points.append(world[world[:, 2] < FLOOR_CLEARANCE, :2])
    return hull_edges(hull(np.concatenate(points)))


def _collision(figure: Figure, q: Array) -> str:
    """Return which bodies collide, or which is below the floor, at ``q`` (nq,); empty if none."""
    model = figure.model
    data = figure.data_at(q)
    mujoco.mj_collision(model, data)
    for index in range(data.ncon):
        contact = data.contact[index]
        if contact.dist < -CONTACT_TOLERANCE:
            names = sorted(_body_name(model, model.geom_bodyid[geom]) for geom in contact.geom)
            return f"its {names[0]} would collide with its {names[1]}"
    body, _, height = lowest_body(figure, data)
    return f"the {_body_name(model, body)} would be under the floor" if height < 0.0 else ""


def _body_name(model: mujoco.MjModel, body: int) -> str:
    return str(model.body(body).name).replace("_", " ")


def touches_itself(figure: Figure, q: Array) -> bool:
    """Return whether bodies touch in any of some frames (n, nq), by MuJoCo."""
    for row in q:
        data = figure.data_at(row)
        mujoco.mj_collision(figure.model, data)
        if data.ncon and (data.contact.dist < 0.0).any():
            return True
    return False


@cached_per_figure
def _geoms_without_soles(figure: Figure) -> NDArray[np.int64]:
    """Return the colliding geoms that are not soles."""
    soles = [body for foot in figure.feet.values() for body, _ in foot.parts]
    is_sole = np.isin(figure.model.geom_bodyid, soles)
    return np.flatnonzero((figure.model.geom_contype != 0) & ~is_sole)


def lowest_body(figure: Figure, data: mujoco.MjData) -> tuple[int, Array, float]:
    """Return the lowest body except the soles, if one is near the floor.

    Returns:
        The body, its lowest point (3,) in its frame, and the height of that point, m. The height
        is infinite if no body is near the floor.
    """
    model = figure.model
    geoms = _geoms_without_soles(figure)
    lowest: tuple[int, Array, float] = (0, np.zeros(3), np.inf)
    is_near = data.geom_xpos[geoms, 2] < model.geom_rbound[geoms] + FLOOR_CLEARANCE
    for geom in geoms[is_near].tolist():
        body = int(model.geom_bodyid[geom])
        up = data.xmat[body].reshape(3, 3)[2:3]
        heights, positions = lowest_points(model, [geom], up)
        height = float(heights[0, 0] + data.xpos[body, 2])
        if height < lowest[2]:
            lowest = (body, positions[0, 0], height)
    return lowest
