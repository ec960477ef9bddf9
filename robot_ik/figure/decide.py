"""Decisions: reach, bend, jump, walk or nothing, by the position of a ball and the abilities.

The order is fixed. A ball that a hand reaches standing is reached. Otherwise the figure bends for a
ball that a hand reaches bending, and jumps for a ball that a jump reaches. Otherwise it walks to a
stance from which one of these actions reaches the ball, or it does nothing. Of two arms the one
with the nearer shoulder acts; within 20 mm it is the arm that acted last, or the right one.

Pađen (2011) decides by fixed regions. Here the regions are those of the model (``abilities``), and
every "reach", "bend" and "jump" is confirmed before it is reported.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import InvalidGoalError
from robot_ik.figure.abilities import DECISION_STARTS, Abilities
from robot_ik.figure.figure import (
    Figure,
    bodies_between,
    cached_per_figure,
    in_stance_frame,
)
from robot_ik.figure.poses import BEND, REACH
from robot_ik.geometry import axis_rotations
from robot_ik.ports import Array

_WITHOUT_STEPS = (REACH, BEND, "jump")
ACTIONS = (*_WITHOUT_STEPS, "walk", "nothing")


@dataclass(frozen=True)
class DecisionOptions:
    """Parameters of the decision. Lengths in m.

    Attributes:
        hysteresis: A figure that reaches, bends or jumps continues until the ball is this far
            outside its reach.
        workspace: Largest distance of a ball.
        same_arm: Difference of the distances to the shoulders up to which the last arm acts.
        heading_step_deg: Step of the headings of stances, degrees.
        per_radian: Cost of a rotation by one radian, in metres of path.
        comfort: Weight of the distance of the ball from the comfortable position.
        comfort_forward: Comfortable position of the ball in front of the chest.
        comfort_lateral: Comfortable position of the ball to the side of the arm.
        stances: Number of stances that are examined.
        solves: Number of different balls, in the frames of these stances, that are solved.
        starts: Number of poses from which each of them is solved.
        at_feet: A ball nearer than this is at the feet, which occupy the best stances.
        at_feet_factor: Factor of stances and solves for such a ball.
    """

    hysteresis: float = 0.03
    workspace: float = 8.0
    same_arm: float = 0.02
    heading_step_deg: float = 15.0
    per_radian: float = 0.35
    comfort: float = 0.8
    comfort_forward: float = 0.4
    comfort_lateral: float = 0.2
    stances: int = 6
    solves: int = 3
    starts: int = 3
    at_feet: float = 0.3
    at_feet_factor: int = 4


DECIDING = DecisionOptions()
"""The parameters of all decisions."""

_HEADINGS = np.radians(np.arange(-180.0, 180.0, DECIDING.heading_step_deg))
"""Headings of stances relative to that of the figure, rad."""

_VERTICAL = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Decision:
    """Action of a figure, and its reason.

    Attributes:
        action: ``reach``, ``bend``, ``jump``, ``walk`` or ``nothing``.
        arm: Side of the hand that acts, after the walk if there is one. None: no hand acts.
        reason: A sentence for the user.
        stance: (x, y, heading) to which it walks. None: it does not walk.
        then: Action at that stance.
        speed: Smallest speed at the take-off of a jump, m/s.
    """

    action: str
    arm: str | None
    reason: str
    stance: tuple[float, float, float] | None = None
    then: str | None = None
    speed: float | None = None


class Decider:
    """Decides for one figure.

    Args:
        abilities: Abilities of the figure.
    """

    def __init__(self, abilities: Abilities) -> None:
        self.abilities = abilities

    @property
    def figure(self) -> Figure:
        """The figure."""
        return self.abilities.figure

    def decide(
        self,
        ball: ArrayLike | None,
        stance: ArrayLike = (0.0, 0.0, 0.0),
        last: Decision | None = None,
    ) -> Decision:
        """Return the decision for a ball.

        Args:
            ball: (3,) in the world, m. None or NaN: no ball is seen.
            stance: (x, y, heading) of the middle between the feet.
            last: Previous decision, for the choice of the arm and the hysteresis.

        Raises:
            InvalidGoalError: The ball is not three numbers.
        """
        stance = np.asarray(stance, dtype=float)
        point = _as_point(ball)
        refusal = self._refusal(point, stance)
        if refusal:
            return Decision("nothing", None, refusal)
        local = in_stance_frame(stance, point)
        arms = self._ordered_arms(local, last)
        decision = self._without_steps(local, arms)
        if last is not None and last.arm in arms and last.action in _WITHOUT_STEPS:
            is_lesser = decision is None or (
                ACTIONS.index(decision.action) > ACTIONS.index(last.action)
            )
            if is_lesser:
                decision = self._continued(local, last, last.arm) or decision
        return decision or self._walk(point, stance)

    def _refusal(self, point: Array, stance: Array) -> str:
        """Return why a ball is out of every reach. Empty if it may be in reach."""
        if not np.isfinite(point).all():
            return "no ball is seen"
        if not self.figure.hands:
            return "the figure has no hands"
        distance = float(np.linalg.norm(point[:2] - stance[:2]))
        if point[2] < 0.0:
            return f"the ball is {-100 * point[2]:.0f} cm under the floor"
        if distance > DECIDING.workspace:
            return (
                f"the ball is {distance:.1f} m away, outside the workspace of "
                f"{DECIDING.workspace:g} m"
            )
        part = inside_body(self.figure, in_stance_frame(stance, point))
        return f"the ball is inside its {part}" if part else ""

    def _ordered_arms(self, local: Array, last: Decision | None) -> list[str]:
        """Return the arms in the order in which they are tried for a ball (3,)."""
        distances = {
            arm: float(np.linalg.norm(shoulder - local))
            for arm, shoulder in self.abilities.shoulders.items()
        }
        arms = sorted(distances, key=lambda arm: (distances[arm], arm != "right"))
        if len(arms) == 2 and distances[arms[1]] - distances[arms[0]] < DECIDING.same_arm:
            first = last.arm if last is not None and last.arm in arms else "right"
            arms.sort(key=lambda arm: arm != first)
        return arms

    def _without_steps(self, local: Array, arms: list[str]) -> Decision | None:
        """Return the first action without steps that an arm can take for a ball (3,)."""
        for kind in _WITHOUT_STEPS:
            for arm in arms:
                decision = self._confirmed(kind, local, arm)
                if decision is not None:
                    return decision
        return None

    def _confirmed(
        self, kind: str, local: Array, arm: str, starts: int = DECISION_STARTS
    ) -> Decision | None:
        """Return a decision without steps that solves confirm, or None.

        Args:
            kind: ``reach``, ``bend`` or ``jump``.
            local: (3,) the ball in the frame of the stance.
            arm: Side of the hand.
            starts: Number of poses from which the solves begin.
        """
        if kind == "jump":
            speed = self.abilities.take_off(local, arm)
            if speed is None:
                return None
            reason = (
                f"the ball is overhead: a jump of {speed:.1f} m/s or more brings the {arm} hand "
                "to it"
            )
            return Decision(kind, arm, reason, speed=speed)
        if self.abilities.confirmed_pose(kind, local, arm, starts) is None:
            return None
        how = "standing" if kind == REACH else "only bending down"
        return Decision(kind, arm, f"the {arm} hand reaches the ball {how}")

    def _continued(self, local: Array, last: Decision, arm: str) -> Decision | None:
        """Return the last action for a ball (3,) that is a little outside its reach, or None."""
        to_shoulder = self.abilities.shoulders[arm] - local
        distance = max(float(np.linalg.norm(to_shoulder)), DECIDING.hysteresis)
        nearer = local + to_shoulder * (DECIDING.hysteresis / distance)
        decision = self._confirmed(last.action, nearer, arm)
        if decision is None:
            return None
        if last.action == "jump":
            return replace(decision, reason=last.reason)
        reason = f"the ball is at the edge of what the {arm} hand reaches"
        return replace(decision, reason=reason)

    def _walk(self, ball: Array, stance: Array) -> Decision:
        """Return a walk to the cheapest stance from which a ball (3,) is in reach, or nothing."""
        distance = float(np.linalg.norm(ball[:2] - stance[:2]))
        factor = DECIDING.at_feet_factor if distance < DECIDING.at_feet else 1
        verbs = {REACH: "reached", BEND: "reached bending", "jump": "reached jumping"}
        for kind, verb in verbs.items():
            # At many stances the ball has the same position in the frame of the stance.
            is_in_reach: dict[tuple[str, bytes], bool] = {}
            stances = self._stances(kind, ball, stance, factor)
            for goal, arm, local in stances[: factor * DECIDING.stances]:
                key = (arm, local.tobytes())
                if key not in is_in_reach and len(is_in_reach) < factor * DECIDING.solves:
                    confirmed = self._confirmed(kind, local, arm, DECIDING.starts)
                    is_in_reach[key] = confirmed is not None
                if not is_in_reach.get(key):
                    continue
                is_nearer = float(np.linalg.norm(ball[:2] - goal[:2])) < distance
                where = "nearer" if is_nearer else "farther off"
                how = f"{verb} with the {arm} hand from {where}"
                reason = f"the ball is {distance:.2f} m away: it can be {how}"
                x, y, heading = goal.tolist()
                return Decision("walk", arm, reason, (x, y, heading), kind)
        if ball[2] > max(map(self.abilities.highest_palm, self.figure.hands)):
            reason = f"a ball at a height of {ball[2]:.2f} m is out of reach, jumping too"
        else:
            reason = "no stance was found from which a hand reaches the ball"
        return Decision("nothing", None, reason)

    def _stances(
        self, kind: str, ball: Array, stance: Array, factor: int
    ) -> list[tuple[Array, str, Array]]:
        """Return stances from which an action may reach a ball, the cheapest first.

        Args:
            kind: ``reach``, ``bend`` or ``jump``.
            ball: (3,) the ball in the world.
            stance: (3,) present stance.
            factor: Factor of the number of stances.

        Returns:
            Stance (3,), arm, and the ball (3,) in the frame of that stance.
        """
        arms = list(self.figure.hands)
        headings = _HEADINGS + stance[2]
        rotations = axis_rotations("z", headings)[:, :2, :2]
        stances_by_arm = []
        balls_by_arm = []
        sides_by_arm = []
        for side, arm in enumerate(arms):
            if kind == "jump":
                cells = self.abilities.highest_at(arm)[None]
            else:
                cells = self.abilities.maps[kind, arm].comfortable(float(ball[2]))
            xy = ball[:2] - np.einsum("hij,cj->hci", rotations, cells)
            all_headings = np.repeat(headings, len(cells))
            stances_by_arm.append(np.column_stack([xy.reshape(-1, 2), all_headings]))
            local = np.column_stack([cells, np.full(len(cells), ball[2])])
            balls_by_arm.append(np.tile(local, (len(headings), 1)))
            sides_by_arm.append(np.full(len(headings) * len(cells), side))
        stances = np.concatenate(stances_by_arm)
        balls = np.concatenate(balls_by_arm)
        sides = np.concatenate(sides_by_arm)

        angles = np.abs((stances[:, 2] - stance[2] + np.pi) % (2 * np.pi) - np.pi)
        ways = np.linalg.norm(stances[:, :2] - stance[:2], axis=1)
        comfort_y = DECIDING.comfort_lateral
        lateral = np.array([comfort_y if arm == "left" else -comfort_y for arm in arms])[sides]
        discomfort = np.abs(balls[:, 0] - DECIDING.comfort_forward)
        discomfort = discomfort + np.abs(balls[:, 1] - lateral)
        cost = ways + DECIDING.per_radian * angles + DECIDING.comfort * discomfort
        count = min(4 * factor * DECIDING.stances, len(cost))
        cheapest = np.sort(np.argpartition(cost, count - 1)[:count])
        order = cheapest[np.argsort(cost[cheapest], kind="stable")]

        # Alternatives should differ from each other: the two best, then every fourth.
        spread = [i for n, i in enumerate(order) if n < 2 or n % 4 == 0]
        return [(stances[i], arms[sides[i]], balls[i]) for i in spread]


def _as_point(ball: ArrayLike | None) -> Array:
    """Return a ball as (3,) numbers. NaN stands for no ball.

    Raises:
        InvalidGoalError: The ball is not three numbers.
    """
    try:
        point = np.full(3, np.nan) if ball is None else np.asarray(ball, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidGoalError(f"a ball is three numbers, not {ball!r}") from error
    if point.shape != (3,):
        raise InvalidGoalError(
            f"a ball is three numbers, not {ball!r}", hint="give one ball at a time: (x, y, z)"
        )
    return point


def inside_body(figure: Figure, local: Array) -> str:
    """Return the body part that contains a point, without arms. Empty if there is none.

    Args:
        figure: The figure.
        local: (3,) point in the frame of the stance.
    """
    model = figure.model
    geoms, positions, rotations = _trunk_shapes(figure)
    is_near = ((local - positions) ** 2).sum(axis=1) <= model.geom_rbound[geoms] ** 2
    box = int(mujoco.mjtGeom.mjGEOM_BOX)
    for i in np.flatnonzero(is_near).tolist():
        geom = int(geoms[i])
        # A mesh counts as its box.
        kind = min(int(model.geom_type[geom]), box)
        # Shapes are convex: from inside, rays up and down both meet the surface.
        distances = [
            mujoco.mju_rayGeom(
                positions[i], rotations[i], model.geom_size[geom], local, direction, kind
            )
            for direction in _VERTICAL
        ]
        if min(distances) >= 0.0:
            return str(model.body(int(model.geom_bodyid[geom])).name).replace("_", " ")
    return ""


@cached_per_figure
def _trunk_shapes(figure: Figure) -> tuple[NDArray[np.int64], Array, Array]:
    """Return colliding geoms of no arm, and their positions (g, 3) and rotations (g, 9) at home."""
    model = figure.model
    data = figure.data_at(figure.home)
    trunk = figure.robot.frame(figure.trunk).body
    arm_bodies = [
        body
        for hand in figure.hands.values()
        for body in bodies_between(model, figure.robot.frame(hand).body, trunk)
    ]
    is_arm = np.isin(model.geom_bodyid, arm_bodies)
    geoms = np.flatnonzero((model.geom_contype != 0) & ~is_arm)
    return geoms, data.geom_xpos[geoms].copy(), data.geom_xmat[geoms].copy()
