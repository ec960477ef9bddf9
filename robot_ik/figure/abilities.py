"""Abilities of a figure: reach, bend and jump, computed from its model.

All balls here are given in the frame of the stance: the middle between the feet, x forward.
Abilities depend on nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robot_ik.figure.figure import GRAVITY, Figure, cached_per_figure
from robot_ik.figure.frames import FrameRows
from robot_ik.figure.jump import JUMPING, forward_at_take_off, highest_take_off
from robot_ik.figure.pose_search import best_pose, find_pose
from robot_ik.figure.poses import FigurePose
from robot_ik.figure.reach_map import Maps, load_maps, shoulder_position
from robot_ik.ports import Array

DECISION_STARTS = 8
"""Largest number of start poses of the solves for a ball in a decision."""


@dataclass(frozen=True)
class JumpReachOptions:
    """Parameters of the reach of a jump. Lengths in m.

    Attributes:
        lateral: Largest horizontal distance of palm and ball. The body leans a little
            (``docs/theory/figure.md``).
        min_rise: Smallest rise of the centre of mass in a jump.
        girdle: The shoulder girdle brings an arm this much farther than its length.
        rim: If the palm stays farther than this from the position that a ball requires, no other
            pose of the arm is tried.
        spare: Length that an arm at the apex keeps for corrections.
    """

    lateral: float = 0.05
    min_rise: float = 0.01
    girdle: float = 0.06
    rim: float = 0.2
    spare: float = 0.04


JUMP_REACH = JumpReachOptions()
"""The parameters of all figures."""

_UPRIGHT_PATTERNS = ("*hip*", "*knee*", "*ankle*", "torso*", "pelvis*")
"""Joints that hold the trunk upright."""

_ABOVE_REACH = 1.6
"""Height above the centre of mass, m. No palm reaches it, so a goal there stretches the arm."""


@dataclass(frozen=True, eq=False)
class Abilities:
    """Reachable balls and possible jumps of a figure.

    Attributes:
        figure: The figure.
        maps: Maps of the balls in reach, by kind and arm.
    """

    figure: Figure
    maps: Maps

    @cached_property
    def shoulders(self) -> dict[str, Array]:
        """Shoulders (3,) at home, by arm."""
        return {arm: shoulder_position(self.figure, arm) for arm in self.figure.hands}

    def highest_at(self, arm: str) -> Array:
        """Return where (2,) a jump reaches the highest ball: above the shoulder at take-off."""
        x, y, _ = raised_arm(self.figure, arm)[0]
        return np.array([x + forward_at_take_off(self.figure), y])

    def confirmed_pose(
        self, kind: str, ball: Array, arm: str, starts: int = DECISION_STARTS
    ) -> FigurePose | None:
        """Return an admissible pose at a ball, or None if neither the map nor the solves find one.

        Args:
            kind: ``reach`` or ``bend``.
            ball: (3,) the ball.
            arm: Side of the hand.
            starts: Number of poses of the map from which the solves begin.
        """
        reach_map = self.maps[kind, arm]
        if reach_map.is_out_of_reach(ball):
            return None
        nearby = reach_map.nearby(ball, starts)
        pose = best_pose(self.figure, ball, arm, kind, nearby, quick=True)
        return None if pose is None or pose.violation else pose

    def natural_pose(self, kind: str, ball: Array, arm: str) -> FigurePose:
        """Return the natural pose at a ball, or the nearest one."""
        return find_pose(self.figure, ball, arm, kind, self.maps[kind, arm].nearby(ball))

    def highest_palm(self, arm: str) -> float:
        """Return the height above which no jump brings a palm, m."""
        rise = JUMPING.fastest**2 / (2 * GRAVITY)
        return highest_take_off(self.figure) + rise + _highest_above_center(self.figure, arm)

    def _stretched_palm(self, arm: str, xy: Array) -> Array:
        """Return the highest position (3,) of the palm at ``xy`` (2,), from the centre of mass.

        The result of the latest ``xy`` is cached.
        """
        latest = self.figure.cache.setdefault(f"stretched palm {arm}", {})
        if xy.tobytes() not in latest:
            latest.clear()
            latest[xy.tobytes()] = palm_above_center(self.figure, arm, xy, None)
        return np.asarray(latest[xy.tobytes()])

    def take_off(self, ball: Array, arm: str) -> float | None:
        """Return the speed at take-off that brings the palm to a ball overhead, m/s, or None.

        The trunk is upright. The palm is at its highest position above the centre of mass, or lower
        for a ball that needs only a small jump. A solve confirms it.

        Args:
            ball: (3,) the ball.
            arm: Side of the hand.
        """
        shoulder, length = raised_arm(self.figure, arm)
        take_off_center = [forward_at_take_off(self.figure), 0.0, highest_take_off(self.figure)]
        relative = ball - take_off_center
        lowest = float(relative[2]) - JUMPING.fastest**2 / (2 * GRAVITY)
        distance = float(np.linalg.norm(relative[:2] - shoulder[:2]))
        lateral = max(distance - JUMP_REACH.lateral, 0.0)
        reach = np.hypot(lateral, max(lowest - shoulder[2], 0.0))
        if relative[2] <= 0.0 or reach > length + JUMP_REACH.girdle:
            return None
        if lowest - 1e-3 > _highest_above_center(self.figure, arm):
            return None
        for palm in self._palms(arm, relative, lowest, shoulder[:2]):
            is_beside = float(np.linalg.norm(palm[:2] - relative[:2])) <= JUMP_REACH.lateral
            if is_beside and palm[2] >= lowest - 1e-3:
                rise = float(relative[2] - palm[2] + JUMP_REACH.spare)
                rise = float(np.clip(rise, JUMP_REACH.min_rise, relative[2] - lowest))
                return float(np.sqrt(2 * GRAVITY * rise))
        return None

    def _palms(self, arm: str, relative: Array, lowest: float, shoulder: Array) -> Iterator[Array]:
        """Yield positions (3,) of the palm, from the centre of mass, that may reach a ball.

        Args:
            arm: Side of the hand.
            relative: (3,) the ball, relative to the centre of mass at take-off.
            lowest: Smallest height of the palm above the centre of mass, m.
            shoulder: (2,) shoulder, relative to the centre of mass.
        """
        xy = relative[:2]
        top = float(relative[2]) - JUMP_REACH.min_rise
        palm = self._stretched_palm(arm, xy)
        # If the palm comes higher than the smallest jump requires, the arm is bent.
        yield palm_above_center(self.figure, arm, xy, top) if palm[2] >= top else palm
        is_far = np.linalg.norm(palm[:2] - xy) > JUMP_REACH.rim
        if is_far or palm[2] < lowest - JUMP_REACH.rim:
            return
        inwards = shoulder - xy
        inwards *= (
            0.9 * JUMP_REACH.lateral / max(float(np.linalg.norm(inwards)), JUMP_REACH.lateral)
        )
        if palm[2] < lowest:
            yield palm_above_center(self.figure, arm, xy + inwards, None)
        yield palm_above_center(self.figure, arm, xy, lowest, 0.05)
        yield palm_above_center(self.figure, arm, xy + inwards, lowest, 0.05)


@cached_per_figure
def raised_arm(figure: Figure, arm: str) -> tuple[Array, float]:
    """Return the shoulder (3,) of a raised arm from the centre of mass, and its length, m."""
    shoulder = shoulder_position(figure, arm) - figure.center_at_home
    q = _raised_pose(figure, arm, shoulder[:2], None)
    palm = figure.pose(q, figure.hands[arm])[0]
    raised_shoulder = shoulder_position(figure, arm, q)
    length = float(np.linalg.norm(palm - raised_shoulder))
    return raised_shoulder - figure.center(q), length


@cached_per_figure
def _highest_above_center(figure: Figure, arm: str) -> float:
    """Return the largest height of a palm above the centre of mass, m."""
    shoulder = raised_arm(figure, arm)[0]
    return float(palm_above_center(figure, arm, shoulder[:2], 1.25, 0.05)[2])


def palm_above_center(
    figure: Figure, arm: str, xy: Array, z: float | None, lateral_weight: float = 1.0
) -> Array:
    """Return the palm (3,) relative to the centre of mass, trunk upright and legs as at home.

    Args:
        figure: The figure.
        arm: Side of the hand.
        xy: (2,) wanted horizontal position, m.
        z: Wanted height, m. None: as high as possible.
        lateral_weight: Weight of the horizontal position relative to the height.
    """
    q = _raised_pose(figure, arm, xy, z, lateral_weight)
    return np.asarray(figure.pose(q, figure.hands[arm])[0] - figure.center(q))


def _raised_pose(
    figure: Figure, arm: str, xy: Array, z: float | None, lateral_weight: float = 1.0
) -> Array:
    """Return the pose (nq,) of ``palm_above_center``."""
    frames = 10
    s = np.minimum(1.0, np.arange(1, frames + 1) / (0.7 * frames))[:, None]
    start = figure.posture({f"{arm}_shoulder_pitch": 2.0, f"{arm}_elbow_pitch": 0.4})
    rows = FrameRows(figure, frames)
    center = figure.center(start)
    hand = figure.pose(start, figure.hands[arm])[0]
    goal = center + np.array([xy[0], xy[1], _ABOVE_REACH if z is None else z])
    way = hand + (goal - hand) * s
    rows.position(figure.hands[arm], way, 3e4 * lateral_weight, axes="xy")
    rows.position(figure.hands[arm], way, 30.0 if z is None else 3e4, axes="z")
    rows.center(center)
    rows.orientation(figure.trunk, np.eye(3))
    stiffness = figure.stiffnesses({"*": 0.3} | dict.fromkeys(_UPRIGHT_PATTERNS, 3e4))
    return rows.solve(start, stiffness, start, speeds=None, max_steps=6).q[-1]


def load_abilities(
    figure: Figure, *, progress: Callable[[int, int], None] | None = None
) -> Abilities:
    """Return the abilities of a figure. Computing the maps of a new model takes some minutes.

    Args:
        figure: The figure.
        progress: Called with the number of finished points and of all points.
    """
    abilities = Abilities(figure, load_maps(figure, progress))
    # Fill the cache here, so that the first decision is not delayed.
    for arm in figure.hands:
        abilities.highest_at(arm)
    return abilities
