"""Poses that take a ball: the hand as near as it comes, the feet where they are.

All balls here are seen from the middle between the feet, x forward.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.balance import hull, hull_edges, inset
from robot_ik.figure.figure import Figure, lowest_points, once_each, shape_points
from robot_ik.figure.frames import FrameRows, Frames
from robot_ik.geometry import axis_rotations
from robot_ik.ports import Array

AT_BALL, BALANCED, TOUCHING = 0.005, 0.010, 0.002
"""Palm at most so far from the ball, centre of mass at least so far inside the soles' hull, self-contact
at most so deep, m: what an admissible pose is."""
REACH, BEND = "reach", "bend"

# Posture weights: the girdle and the wrists are moved last, the arm first.
STIFF = {
    "*": 0.1, "*shoulder*": 0.15, "*elbow*": 0.15, "*clavicle*": 2.0, "*wrist*": 3.0, "head*": 3.0,
    "torso*": 1.0, "pelvis*": 1.0, "*toe*": 100.0,
}  # fmt: skip
# Steps towards the ball; the hand's weight grows a hundredfold on the way, so that it goes as far as it can.
_STEPS = 12
# A hand that stays farther away comes no nearer by leaning, m; frames of the last millimetres.
_HOPELESS = 0.3
# Most damped steps to a ball, and the damping of the first.
_MOST, _DAMPING = 60, 1.0
# No progress: so many steps that each leave more than this share of what is short.
_PATIENCE, _GAIN = 3, 0.97
# Of the elbow from the body, rad.
_ABDUCTION = 0.7
# A body that is lower than this is held there, m.
_CLEAR = 0.003
# From poses nearby: most steps, those of all, and after how many a ball still so far, m, is out of reach.
_BRIEF, _BUDGET, _OUT = 45, 90, ((3, 0.12), (4, 0.06), (8, 0.02))
_STAND, _PULL = 3e4, 300.0
NEARLY = 0.02
"""A hand that stays nearer to a ball than this, m, is tried from other poses."""
_FRESH = 6


# Degrees of joints that a figure without bending keeps to: what separates ``reach`` from ``bend``.
_UPRIGHT = {
    "knee_pitch": (0.0, 25.0),
    "hip_pitch": (-15.0, 30.0),
    "torso_pitch": (-10.0, 10.0),
    "pelvis_pitch": (-10.0, 10.0),
}


@once_each
def limits_of(figure: Figure, kind: str) -> tuple[Array, Array]:
    """(nv,) lower and upper joint limits of a ``reach`` or a ``bend``."""
    lower, upper = figure.robot.lower.copy(), figure.robot.upper.copy()
    if kind != REACH:
        return lower, upper
    for joint in figure.robot.joints:
        for part, (low, high) in _UPRIGHT.items():
            if joint.endswith(part):
                v = figure.addresses(joint)[1]
                lower[v], upper[v] = max(lower[v], np.radians(low)), min(upper[v], np.radians(high))
    return lower, upper


def depth(figure: Figure, ball: Array) -> float:
    """How deep to bend for a ball, 0 to 1, by its height against the hanging hand and the floor."""
    hanging = float(figure.pose(figure.home, next(iter(figure.hands.values())))[0][2])
    return float(np.clip(0.15 + 0.85 * (hanging - ball[2] + 0.1) / hanging, 0.15, 1.0))


@dataclass(frozen=True, eq=False)
class FigurePose:
    """How a figure would take a ball."""

    q: Array  # (nq,) at home in its own frame
    error: float  # distance of palm and ball, m
    flaw: str  # why it is not admissible, as text; empty where it is


def find_pose(figure: Figure, ball: Array, arm: str, kind: str, starts: Array | None = None) -> FigurePose:
    """The pose nearest to a ball, standing upright (``reach``) or with any posture (``bend``).

    Feet where they are.  First the natural one; where it does not do, poses nearby that do (``starts``), if
    possible one in which no bodies touch.  Without those it searches: the natural one stretched as far as
    balance allows, another swivel of the arm, and some poses that are far from it, which takes a hundred
    times as long.

    Args:
        figure: Who.
        ball: (3,) seen from the feet.
        arm: Which hand.
        kind: ``reach`` or ``bend``.
        starts: (n, nq) poses that reach balls nearby, the nearest first (``abilities.Map.nearby``).
    """
    natural = _attempt(figure, ball, arm, kind)
    if starts is None:
        done = not natural.flaw or natural.error > _HOPELESS
        return natural if done else _searched(figure, ball, arm, kind, natural)
    if not natural.flaw:
        if not touches_itself(figure, natural.q[None]):
            return natural
        wide = _attempt(figure, ball, arm, kind, abduction=_ABDUCTION)
        if not wide.flaw and not touches_itself(figure, wide.q[None]):
            return wide
    best = best_pose(figure, ball, arm, kind, starts, untouched=True) or natural
    return best if not best.flaw or (natural.flaw and best.error < natural.error) else natural


def best_pose(
    figure: Figure, ball: Array, arm: str, kind: str, starts: Array, *, quick: bool = False,
    untouched: bool = False,
) -> FigurePose | None:  # fmt: skip
    """The first admissible pose by short steps from ``starts`` (n, nq), or the nearest; None without starts.

    Starts nearby agree on what is out of reach: ``quick``, a ball that is missed by far is not tried again,
    nor is it reported by how much.  ``untouched``: one in which no bodies touch is preferred.
    """
    best: FigurePose | None = None
    polish, spent = _polish(figure, arm, kind), 0
    for k, start in enumerate(starts):
        pose = polish(start, ball, quick=quick)
        spent += polish.tried
        if pose.flaw.endswith("floor"):
            pose = polish(pose.q, ball, quick=quick, above=True)
            spent += polish.tried
        if best is None or (best.flaw and (not pose.flaw or pose.error < best.error)):
            best = pose
        if untouched and not pose.flaw:
            if touches_itself(figure, pose.q[None]):
                continue
            return pose
        unreachable = pose.error > NEARLY or (pose.error > AT_BALL and k >= 3) or spent > _BUDGET
        if not pose.flaw or (quick and unreachable):
            break
    return best


def _searched(figure: Figure, ball: Array, arm: str, kind: str, best: FigurePose) -> FigurePose:
    """The first admissible pose from the natural one and from others, or the nearest of all."""
    polish, natural = _polish(figure, arm, kind), best

    def stretched() -> Iterator[FigurePose]:
        yield polish(natural.q, ball)
        for share in (1.0, 0.3) if kind == BEND else (1.0,):
            yield polish(_attempt(figure, ball, arm, kind, upright=0.5, share=share).q, ball)

    def swivelled() -> Iterator[FigurePose]:
        flat = best.flaw.endswith("floor")
        for abduction in (0.0,) if flat else (0.7, 1.2):
            pose = _attempt(figure, ball, arm, kind, abduction=abduction, flat=flat)
            yield polish(pose.q, ball) if pose.flaw and pose.error < _HOPELESS else pose

    def scattered() -> Iterator[FigurePose]:
        rng = np.random.default_rng(0)
        for _ in range(_FRESH):
            yield polish(_scattered(figure, kind, rng), ball)

    for search, near in ((stretched, np.inf), (swivelled, AT_BALL), (scattered, NEARLY)):
        if best.error > near:
            continue
        for pose in search():
            if not pose.flaw:
                return pose
            best = min(best, pose, key=lambda one: one.error)
    return best


def _scattered(figure: Figure, kind: str, rng: np.random.Generator) -> Array:
    """(nq,) a random pose about home, or between home and deeply bent."""
    limits = limits_of(figure, kind)
    bend = float(rng.uniform(0.0, 1.0)) if kind == BEND else 0.0
    q = figure.home + bend * (figure.bent - figure.home)
    q[:2], q[3:7] = figure.home[:2], figure.home[3:7]
    spread = (0.25 if kind == REACH else 0.5) * rng.normal(size=len(q) - 7)
    q[7:] = np.clip(q[7:] + spread, limits[0][6:], limits[1][6:])
    for foot in figure.feet.values():
        if foot.toes is not None:  # nothing else keeps them from the floor
            q[foot.toes[0]] = figure.home[foot.toes[0]]
    return np.asarray(q)


class _Polish:
    """From a pose nearby to a ball, with no posture of its own: damped steps that each come nearer.

    The damping of Levenberg and Marquardt (Nocedal & Wright, *Numerical Optimization*, section 10.3).  The
    centre of mass is free while it is far enough inside the soles, and held at the border else; so is what
    goes under the floor, where that is asked for.
    """

    def __init__(self, figure: Figure, arm: str, kind: str) -> None:
        self.figure, self.arm, self.tried = figure, arm, 0
        rows = FrameRows(figure, 1)
        rows.feet(figure.feet_at_home, _STAND)
        rows.position(figure.hands[arm], np.zeros(3), _PULL)
        rows.center(np.zeros(3), 0.0, axes="xy")
        rows.position(figure.hands[arm], np.array([0.0, 0.0, _CLEAR]), 0.0, axes="z")  # of what is lowest
        self.flat = [foot.toes[0] for foot in figure.feet.values() if foot.toes is not None]
        self.even, self.toes = figure.stiffnesses({"*": 1.0}), figure.stiffnesses({"*": 0.0, "*toe*": 1e4})
        self.ready = rows.prepare(figure.home, self.even, limits=limits_of(figure, kind), speeds=None)
        self.found = Frames(np.empty((1, figure.robot.nq)), np.empty(1), np.empty(1, dtype=np.int64))
        # Where the solver stood last: position and rotation of each row's frame, and the centre of mass.
        self.pose, self.center = self.ready.body.arrays["pose"], self.ready.body.arrays["center"]
        self.node, self.local = self.ready.body.arrays["node"], self.ready.body.arrays["local"]
        at_home = list(figure.feet_at_home.values())
        self.feet = np.array([np.concatenate([position, matrix.ravel()]) for position, matrix in at_home])

    def __call__(self, start: Array, ball: Array, *, quick: bool = False, above: bool = False) -> FigurePose:
        """The pose that comes nearest to a ball (3,) from ``start`` (nq,); ``quick``: if it comes to it.

        ``above``: with all bodies above the floor.
        """
        ready, center_row = self.ready, 2 * len(self.feet) + 1
        ready.target[0, center_row - 1, :3] = ball
        q, damping, gains, held = np.array(start, dtype=float), _DAMPING, [0.0], False
        q[self.flat] = self.figure.home[self.flat]
        ready.solve(self.found, 0, 1, q, q, 0, 0.0, 0.0)  # no step: where it stands
        short, off, outside, low = self._short(ball, q, above)
        for tried in range(1, (_BRIEF if quick else _MOST) + 1):
            self.tried = tried
            ready.weight[0, center_row] = 0.0 if outside is None else _PULL
            if outside is not None:
                ready.target[0, center_row, :2] = outside
            ready.weight[0, -1] = 0.0 if low is None else _PULL
            if low is not None:
                self.node[-1], self.local[-1] = low
            ready.body.arrays["stiffness"][:] = damping * self.even + self.toes
            ready.posture[0] = q
            ready.solve(self.found, 0, 1, q, q, 1, 0.0, 0.0)
            new = self.found.q[0].copy()
            found = self._short(ball, new, above)
            if found[0] < short:
                gains.append(found[0] / short)
                q, (short, off, outside, low), held = new, found, False
                damping = max(0.2 * damping, 1e-4)
                if short < 0.4 * AT_BALL and off < 3e-5 and outside is None:
                    break
            elif not held and any(border is not None for border in found[2:]):  # again, along it
                outside, low, held = *found[2:], True
            else:
                damping *= 5.0
            stalled = len(gains) > _PATIENCE and min(gains[-_PATIENCE:]) > _GAIN
            unreachable = quick and any(tried >= after and short > limit for after, limit in _OUT)
            if damping > 1e3 or (short > AT_BALL and (stalled or unreachable)):
                break
        return _judged(self.figure, q, ball, self.arm, off)

    def _short(
        self, ball: Array, q: Array, above: bool
    ) -> tuple[float, float, Array | None, tuple[int, Array] | None]:
        """What is short of the ball (with feet, balance and floor), how far the feet are off, what to hold.

        That is where balance is, and the node and position of what is under the floor, by the solver's own
        forward pass.
        """
        normal, offset = support(self.figure)
        center, n = self.center[:2], 2 * len(self.feet)
        off = float(np.abs(self.pose[0:n:2] - self.feet).max())  # m, or about as much as the angle, rad
        missing = max(0.0, BALANCED + 0.0005 - float((normal @ center - offset).min()))
        away = self.pose[n, :3] - ball
        body, point, height = _lowest(self.figure, self.figure.at(q)) if above else (0, center, np.inf)
        under = 10.0 * min(height, 0.0)  # no finger goes into the floor for a ball
        short = float(np.sqrt(away @ away + missing**2 + 10.0 * off**2 + under**2))
        outside = inset(normal, offset, center, BALANCED + 0.001) if missing else None
        return short, off, outside, self._node_and_position(body, point) if height < _CLEAR else None

    def _node_and_position(self, body: int, point: Array) -> tuple[int, Array]:
        """The solver's node and position of a point of a body."""
        node, local = self.figure.robot.attachment(body)
        row = np.zeros(12)
        row[:3] = local[:3] + local[3:].reshape(3, 3) @ point
        return node, row


_polish = once_each(_Polish)


def _attempt(
    figure: Figure, ball: Array, arm: str, kind: str, *, abduction: float = 0.0, flat: bool = False,
    upright: float = 30.0, share: float = 1.0,
) -> FigurePose:  # fmt: skip
    start, s = figure.home, np.minimum(1.0, np.arange(1, _STEPS + 1) / (0.75 * _STEPS))
    deep = 0.0 if kind == REACH else share * depth(figure, ball)
    rows = FrameRows(figure, _STEPS)
    rows.feet(figure.feet_at_home)
    here, sole = figure.center_at_home[:2], figure.feet["left"].sole
    middle = np.array([(sole.front + sole.rear) / 2 - 0.01, 0.0])  # over it balance is safest
    rows.center(here + (middle - here) * s[:, None], upright, axes="xy")
    hand = figure.hands_at_home[arm]
    rows.position(figure.hands[arm], hand + (ball - hand) * s[:, None], 10.0 ** (2.0 + 4.0 * s**2))
    rows.orientation(figure.trunk, axis_rotations("y", np.radians(4.0 + 62.0 * deep) * s), 0.5)
    rows.aim(ball, 8.0)
    goal = start + (figure.bent - start) * deep
    goal[:7] = start[:7]
    if flat:
        rows.orientation(figure.hands[arm], axis_rotations("y", -np.pi / 2), 0.3 * s)
    if abduction:
        goal = figure.posture({f"{arm}_shoulder_roll": abduction, f"{arm}_shoulder_yaw": -abduction}, goal)
    posture = start + (goal - start) * s[:, None]
    stiff = np.minimum(figure.stiffnesses(STIFF), 0.1) + figure.stiffnesses({"*": 0.0, "*toe*": 1e4})
    frames = rows.solve(posture, stiff, start, limits=limits_of(figure, kind), speeds=None, steps=6)
    return _judged(figure, frames.q[-1], ball, arm, float(frames.error[-1]))


@once_each
def support(figure: Figure) -> tuple[Array, Array]:
    """Edges of the hull of the soles at home, as of ``hull_edges``."""
    found, data = [], figure.at(figure.home)
    for body, geoms in (part for foot in figure.feet.values() for part in foot.parts):
        matrix = data.xmat[body].reshape(3, 3)
        points = np.concatenate([shape_points(figure.model, g, matrix[2:3])[:, 0] for g in geoms])
        world = data.xpos[body] + points @ matrix.T
        found.append(world[world[:, 2] < 0.003, :2])
    return hull_edges(hull(np.concatenate(found)))


def _judged(figure: Figure, q: Array, ball: Array, arm: str, hard: float = 0.0) -> FigurePose:
    """A pose with its error and why it is not admissible, by MuJoCo; contacts are looked at last."""
    normal, offset = support(figure)
    error = float(np.linalg.norm(figure.pose(q, figure.hands[arm])[0] - ball))
    center, flaw = figure.center(q), ""
    if error > AT_BALL:
        flaw = f"the hand stays {100 * error:.0f} cm away"
    elif hard > 1e-4:
        flaw = "the feet would move"
    elif (normal @ center[:2] - offset).min() < BALANCED:
        flaw = "balance would be lost"
    return FigurePose(q, error, flaw or _collision(figure))


def _collision(figure: Figure) -> str:
    """What runs into what, or goes under the floor, at the pose in ``data``; empty where nothing does."""
    model, data = figure.model, figure.data
    mujoco.mj_collision(model, data)
    for c in range(data.ncon):
        if data.contact[c].dist < -TOUCHING:
            names = sorted(
                model.body(model.geom_bodyid[g]).name.replace("_", " ") for g in data.contact[c].geom
            )
            return f"its {names[0]} would run into its {names[1]}"
    body, _, height = _lowest(figure, data)
    low = str(model.body(body).name).replace("_", " ")
    return f"the {low} would go under the floor" if height < 0.0 else ""


def touches_itself(figure: Figure, q: Array) -> bool:
    """Whether bodies touch in any of some frames (n, nq), by MuJoCo."""
    for row in q:
        data = figure.at(row)
        mujoco.mj_collision(figure.model, data)
        if data.ncon and (data.contact.dist < 0.0).any():
            return True
    return False


@once_each
def _no_soles(figure: Figure) -> NDArray[np.int64]:
    """Colliding geoms that are no soles."""
    soles = [body for foot in figure.feet.values() for body, _ in foot.parts]
    return np.flatnonzero((figure.model.geom_contype != 0) & ~np.isin(figure.model.geom_bodyid, soles))


def _lowest(figure: Figure, data: mujoco.MjData) -> tuple[int, Array, float]:
    """The lowest body but for the soles, which point of it (3,) in its frame, and that point's height, m."""
    model, may_not = figure.model, _no_soles(figure)
    least: tuple[int, Array, float] = 0, np.zeros(3), np.inf
    near = data.geom_xpos[may_not, 2] < model.geom_rbound[may_not] + _CLEAR
    for g in may_not[near].tolist():
        body = int(model.geom_bodyid[g])
        low, position = lowest_points(model, [g], data.xmat[body].reshape(3, 3)[2:3])
        height = float(low[0, 0] + data.xpos[body, 2])
        if height < least[2]:
            least = body, position[0, 0], height
    return least
