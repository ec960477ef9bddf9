"""The lion: a paw reaches a ball while the other three stand, and he looks at it.

After the one of Šimunić's thesis.  Key poses first (relaxed, leaning onto three paws with his eyes on the
ball, reaching), the motion through them next (``Keyframes``), then each of its frames again by inverse
kinematics, with the standing paws and the centre of mass as needed goals and the frame itself as posture.
Any model serves whose ``robot.toml`` names tools that end in ``_paw``, and one that is called ``gaze``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.budget import Budget
from robot_ik.errors import ModelError, TrajectoryError
from robot_ik.figure.balance import hull, hull_edges, inset
from robot_ik.figure.decide import Decision
from robot_ik.figure.figure import chain
from robot_ik.goals import (
    AimGoal,
    CenterOfMassGoal,
    Goal,
    HalfSpaceGoal,
    PoseGoal,
    PositionGoal,
    PostureGoal,
)
from robot_ik.inverse_kinematics import solve
from robot_ik.motion.keyframes import Keyframes
from robot_ik.motion.timing import minimum_jerk
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot

# m: the centre of mass stays so far inside the triangle of the standing paws.
MARGIN = 0.03
# m: so near a paw's sole must come to the ball's middle.
NEAR = 2e-3
# s: leaning over, reaching, holding.
LEAN, REACH, HOLD = 0.7, 0.9, 0.4
# rad/s: quick for a lion, slow for his joints.
_SPEED = 4.0
# Largest angle between straight forward and his gaze, degrees.
_GAZE_LIMIT_DEG = 100.0
# A paw whose pose is not found by then is taken to be out of reach.
_SEARCH = Budget(iterations=1200, restarts=6)
_FRAME = Budget(iterations=60, restarts=0)


def is_lion(robot: Robot) -> bool:
    """Whether it has four paws and a gaze."""
    return len(paws_of(robot)) == 4 and "gaze" in robot.frames


def paws_of(robot: Robot) -> tuple[str, ...]:
    """Frames of its paws."""
    return tuple(name for name in robot.file.tools if name.endswith("_paw"))


class Lion:
    """Reaches for balls from his relaxed pose.

    Attributes:
        robot: The model.
        relaxed: (nq,) home, all paws on the floor.
        paws: Frames of the paws.
    """

    def __init__(self, robot: Robot | None = None) -> None:
        """Takes the lion that ships, or another model.

        Raises:
            ModelError: It has not four paws and a gaze.
        """
        self.robot = robot or load_robot("lion")
        self.relaxed = np.array(self.robot.home)
        self.paws = paws_of(self.robot)
        if not is_lion(self.robot):
            raise ModelError(
                f"{self.robot.name!r} has the paws {', '.join(self.paws) or 'none'}", path=self.robot.path,
                hint="name four tools …_paw and one gaze in its robot.toml",
            )  # fmt: skip
        self._prints = {paw: self.robot.forward(self.relaxed, paw) for paw in self.paws}
        self._span = {paw: self._way_from_root(paw) for paw in self.paws}

    def decide(self, ball: ArrayLike) -> Decision:
        """``reach`` with the nearest paw that gets to ``ball`` (3,), its frame the arm, else ``nothing``.

        Each is tried by solving for its pose.
        """
        position = _ball(ball)
        if position is None:
            return Decision("nothing", None, "there is no ball: its position is not finite")
        if position[2] < 0.0:
            return Decision("nothing", None, f"the ball lies {-1e3 * position[2]:.0f} mm under the floor")
        away = {paw: float(np.linalg.norm(self._prints[paw].position - position)) for paw in self.paws}
        for paw in sorted(self.paws, key=away.__getitem__):
            if self._reaching(paw, position) is not None:
                reason = f"{paw} is {away[paw]:.2f} m away, and reaches it on the other three"
                return Decision("reach", paw, reason)
        return Decision("nothing", None, "no paw reaches it while the other three stand")

    def reach(self, ball: ArrayLike, paw: str | None = None, *, rate: float = 60.0) -> Keyframes:
        """The whole motion: leans over, reaches, holds, and comes back to the relaxed pose.

        Args:
            ball: (3,) world, metres.
            paw: Which; None: as ``decide`` says.
            rate: Frames a second.

        Raises:
            TrajectoryError: No paw, or not this one, reaches the ball; says why.
        """
        if paw is None:
            decision = self.decide(ball)
            if decision.arm is None:
                raise TrajectoryError(f"he does not reach {np.asarray(ball).tolist()}: {decision.reason}")
            paw = decision.arm
        elif paw not in self.paws:
            raise TrajectoryError(f"there is no paw {paw!r}", hint=f"his paws: {', '.join(self.paws)}")
        position = _ball(ball)
        end = None if position is None else self._reaching(paw, position)
        if position is None or end is None:
            raise TrajectoryError(f"{paw} does not reach {np.asarray(ball).tolist()} while the others stand")
        # All paws on the floor, the weight on the other three, his eyes on the ball.
        lean = self._posed(self.paws, position, self._mass(paw), [])
        keys = [self.relaxed, lean, end, end, lean, self.relaxed]
        plan = Keyframes.through(
            self.robot, keys, durations=(LEAN, REACH, HOLD, REACH, LEAN), velocity_limits=_SPEED
        )
        return self._standing(plan, paw, rate)

    def support(self, paw: str | None) -> Array:
        """(3, 2) or (4, 2): where the paws stand that do, the others than ``paw``."""
        return np.array([self._prints[p].position[:2] for p in self.paws if p != paw])

    # --------------------------------------------------------------------------- poses

    def _reaching(self, paw: str, ball: Array) -> Array | None:
        """The pose with the paw at the ball; None: not found."""
        goals: list[Goal] = [PositionGoal(paw, ball)]
        rest = [p for p in self.paws if p != paw]
        for p in rest:  # farther than all bones from a standing paw to this one, laid end to end
            if float(np.linalg.norm(self._prints[p].position - ball)) > self._span[p] + self._span[paw]:
                return None
        q = self._posed(rest, ball, self._mass(paw), goals)
        near = float(np.linalg.norm(self.robot.measure(q, paw).position - ball)) < NEAR
        stands = all(self.robot.measure(q, p).distance(self._prints[p])[0] < NEAR for p in rest)
        return q if near and stands else None

    def _way_from_root(self, frame: str) -> float:
        """Length of the bones between the free base and a frame."""
        model, at = self.robot.model, self.robot.frame(frame)
        bones = [at.local.position, *model.body_pos[chain(model, at.body, 0)[:-1]]]
        return float(np.linalg.norm(bones, axis=1).sum())

    def _posed(self, standing: Sequence[str], ball: Array, mass: Array, more: Sequence[Goal]) -> Array:
        goals = [
            *self._needed(standing, mass), *more,
            AimGoal("gaze", self._looked_at(ball), axis="x", soft=True),
            PostureGoal(self.relaxed, joints={self.robot.joints[0]: 0.3}, soft=True, priority=1),
        ]  # fmt: skip
        return np.array(solve(self.robot, goals, solver="lm", start=self.relaxed, budget=_SEARCH).q)

    def _looked_at(self, ball: Array) -> Array:
        """The ball, or the limit of his gaze when it lies behind him."""
        eye = self.robot.forward(self.relaxed, "gaze").position
        to_ball = ball - eye
        base = self.robot.model.jnt_bodyid[int(self.robot.tree.joint_ids[0])]  # that the free joint carries
        body = str(self.robot.model.body(int(base)).name)
        forward = self.robot.forward(self.relaxed, body).rotation[:, 0]
        limit, lateral = np.radians(_GAZE_LIMIT_DEG), to_ball - float(to_ball @ forward) * forward
        if np.linalg.norm(lateral) < 1e-9 or np.arctan2(np.linalg.norm(lateral), to_ball @ forward) <= limit:
            return ball
        across = lateral / np.linalg.norm(lateral)
        return np.asarray(eye + np.linalg.norm(to_ball) * (np.cos(limit) * forward + np.sin(limit) * across))

    def _needed(self, standing: Sequence[str], mass: Array) -> list[Goal]:
        prints: list[Goal] = [PoseGoal.at(paw, self._prints[paw]) for paw in standing]
        return [*prints, CenterOfMassGoal(None, mass, axes="xy")]

    def _mass(self, paw: str | None) -> Array:
        """Where the centre of mass shall be: as relaxed, but ``MARGIN`` inside the triangle without a paw."""
        centre = self.robot.center_of_mass(self.relaxed)
        if paw is not None:
            normal, offset = hull_edges(hull(self.support(paw)))
            centre[:2] = inset(normal, offset, centre[:2], MARGIN)
        return centre

    def _standing(self, plan: Keyframes, paw: str, rate: float) -> Keyframes:
        """The frames of a plan, each with the paws that stand exactly where they stand."""
        relaxed, leaning = self._mass(None), self._mass(paw)
        up, down = float(plan.times[1]), float(plan.times[4])
        times = np.arange(0.0, plan.duration, 1.0 / rate)
        rows, q = [self.relaxed], self.relaxed
        for t in times[1:].tolist():
            lifted = up < t < down
            share = min(1.0, t / up, (plan.duration - t) / (plan.duration - down))
            standing = [p for p in self.paws if p != paw or not lifted]
            goals = self._needed(standing, relaxed + minimum_jerk(share) * (leaning - relaxed))
            if lifted:
                goals.append(HalfSpaceGoal(paw, (0.0, 0.0, 0.0), "z"))
            goals.append(PostureGoal(plan.at(t), soft=True))
            q = np.array(solve(self.robot, goals, solver="lm", start=q, budget=_FRAME).q)
            rows.append(q)
        rows.append(self.relaxed)
        return Keyframes(self.robot, np.append(times, plan.duration), rows)


def _ball(ball: ArrayLike) -> Array | None:
    """Its position, if it has one."""
    position = np.asarray(ball, dtype=float)
    return position if position.shape == (3,) and bool(np.isfinite(position).all()) else None
