"""Poses that take a ball: the hand as near as it comes, the feet where they are.

All balls here are seen from the middle between the feet, x ahead.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.balance import hull, hull_margin, inset
from robot_ik.figure.figure import Figure, Rows, lowest_points, rotation
from robot_ik.kernels.whole_body import HARD

Array = NDArray[np.float64]

AT_BALL, BALANCED, TOUCHING = 0.005, 0.010, 0.002
"""Palm at most so far from the ball, centre of mass at least so far inside the soles' hull, self-contact
at most so
deep, m: what an admissible pose is."""
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
# Frames of a block of the last millimetres, how many blocks, and how much each holds on to the one before:
# first more, then less.
_BLOCK, _BLOCKS, _DAMPING = 3, 20, (1.0, 0.1)
_STAND, _PULL = 3e3, 300.0
# A hand that stays nearer than this is tried from other poses, so many.
_NEARLY, _FRESH = 0.02, 6


def pinned(figure: Figure, q: Array, rows: Rows) -> None:
    """Both feet stay where they are at q."""
    poses = {side: figure.pose(q, foot.frame) for side, foot in figure.feet.items()}
    rows.feet(
        {side: pose[0] for side, pose in poses.items()}, {side: pose[1] for side, pose in poses.items()}
    )


def support_middle(figure: Figure) -> Array:
    """(2,) middle of the soles, seen from the middle between the feet: over it balance is safest."""
    sole = figure.feet["left"].sole
    return np.array([(sole.front + sole.rear) / 2 - 0.01, 0.0])


def upright_limits(figure: Figure) -> tuple[Array, Array]:
    """Joint limits of a figure that reaches without bending: what separates ``reach`` from ``bend``."""
    if "figure.upright" not in figure.robot.memory:
        figure.robot.memory["figure.upright"] = _upright(figure)
    found: tuple[Array, Array] = figure.robot.memory["figure.upright"]
    return found


def _upright(figure: Figure) -> tuple[Array, Array]:
    lower, upper = figure.robot.lower.copy(), figure.robot.upper.copy()
    box = {
        "knee_pitch": (0.0, 25.0),
        "hip_pitch": (-15.0, 30.0),
        "torso_pitch": (-10.0, 10.0),
        "pelvis_pitch": (-10.0, 10.0),
    }
    for joint in figure.robot.joints:
        for part, (low, high) in box.items():
            if joint.endswith(part):
                v = figure.place(joint)[1]
                lower[v], upper[v] = max(lower[v], np.radians(low)), min(upper[v], np.radians(high))
    return lower, upper


def depth(figure: Figure, ball: Array) -> float:
    """How deep to bend for a ball, 0 to 1, by its height against the hanging hand and the floor."""
    hanging = float(figure.pose(figure.home, next(iter(figure.hands.values())))[0][2])
    return float(np.clip(0.15 + 0.85 * (hanging - ball[2] + 0.1) / hanging, 0.15, 1.0))


@dataclass(frozen=True, eq=False)
class Pose:
    """How a figure would take a ball.

    Attributes:
        q: (nq,) at home in its own frame.
        miss: Distance of palm and ball, m.
        flaw: Why it is not admissible, in words; empty where it is.
    """

    q: Array
    miss: float
    flaw: str


def find_pose(figure: Figure, ball: Array, arm: str, kind: str) -> Pose:
    """The pose nearest to a ball, standing upright (``reach``) or any way it can (``bend``).

    Feet where they are.  First the natural one; where it does not do, that one stretched as far as balance
    allows, another swivel of the arm, and some poses that are far from it.
    """
    limits = upright_limits(figure) if kind == REACH else (figure.robot.lower, figure.robot.upper)
    best = _attempt(figure, ball, arm, kind, limits)
    if not best.flaw or best.miss > _HOPELESS:
        return best
    for pose in _stretched(figure, ball, arm, kind, limits, best.q):
        if not pose.flaw:
            return pose
        best = min(best, pose, key=lambda one: one.miss)
    if best.miss <= AT_BALL:  # another swivel of the arm, or a flat hand
        flat = best.flaw.endswith("floor")
        for aside in (0.0,) if flat else (0.7, 1.2):
            pose = _attempt(figure, ball, arm, kind, limits, aside=aside, flat=flat)
            if pose.flaw and pose.miss < _HOPELESS:
                pose = _polished(figure, ball, arm, limits, pose.q)
            if not pose.flaw:
                return pose
    if best.miss < _NEARLY:
        rng = np.random.default_rng(0)
        for _ in range(_FRESH):
            q = _scattered(figure, kind, limits, rng)
            for pose in _stretched(figure, ball, arm, kind, limits, q, leaning=False):
                if not pose.flaw:
                    return pose
                best = min(best, pose, key=lambda one: one.miss)
    return best


def _stretched(
    figure: Figure, ball: Array, arm: str, kind: str, limits: tuple[Array, Array], q: Array, *,
    leaning: bool = True,
) -> Iterator[Pose]:  # fmt: skip
    """Leaning and stretching as far as balance allows, from poses nearby."""
    starts = [q]
    if leaning:
        starts += [
            _attempt(figure, ball, arm, kind, limits, upright=0.5, share=share).q
            for share in ((1.0, 0.3) if kind == BEND else (1.0,))
        ]
    for start in starts:
        yield _polished(figure, ball, arm, limits, start)


def _scattered(figure: Figure, kind: str, limits: tuple[Array, Array], rng: np.random.Generator) -> Array:
    """(nq,) a random pose about home, or between home and deeply bent."""
    bend = float(rng.uniform(0.0, 1.0)) if kind == BEND else 0.0
    q = figure.home + bend * (figure.bent - figure.home)
    q[:2], q[3:7] = figure.home[:2], figure.home[3:7]
    spread = (0.25 if kind == REACH else 0.5) * rng.normal(size=len(q) - 7)
    q[7:] = np.clip(q[7:] + spread, limits[0][6:], limits[1][6:])
    for foot in figure.feet.values():
        if foot.toes is not None:  # nothing else keeps them from the floor
            q[foot.toes[0]] = figure.home[foot.toes[0]]
    return np.asarray(q)


def _polished(figure: Figure, ball: Array, arm: str, limits: tuple[Array, Array], q: Array) -> Pose:
    """From a pose nearby, with no posture of its own, by short steps: long ones get caught at limits.

    The centre of mass is free while it is far enough inside the soles, and held at the border else.
    """
    feet, corners = figure.feet_at_home, _support(figure)
    last, hard, held = np.inf, np.inf, None
    for k in range(_BLOCKS):
        rows = Rows(figure, _BLOCK)
        # Hard rows of legs at their limits contradict each other until the hand is nearly there.
        stand = HARD if last < AT_BALL else _STAND
        for side, (place, turn) in feet.items():
            rows.position(figure.feet[side].frame, place, stand)
            rows.turned(figure.feet[side].frame, turn, stand)
        rows.position(figure.hands[arm], ball, _PULL)
        if held is not None:
            rows.center(np.array([*held, 0.0]), _PULL, axes="xy")
        damping = figure.stiffnesses({"*": _DAMPING[k > 1], "*toe*": 100.0})
        frames = rows.solve(q, damping, q, limits=limits, speeds=None, steps=3)
        q, hard = frames.q[-1], _feet_off(figure, frames.q[-1])
        center = figure.center(q)[:2]
        miss = float(np.linalg.norm(figure.pose(q, figure.hands[arm])[0] - ball))
        outside = hull_margin(corners, center) < BALANCED + 0.0005
        if not outside and (
            (miss < 0.5 * AT_BALL and hard < 3e-5) or (k > 3 and AT_BALL < miss > 0.93 * last)
        ):
            break
        last = miss if k > 1 else np.inf
        held = inset(corners, center, BALANCED + 0.001) if outside or held is not None else None
    return _judged(figure, q, ball, arm, hard)


def _feet_off(figure: Figure, q: Array) -> float:
    """How far the feet are from where they stand at home, m or (roughly) rad."""
    off = 0.0
    for side, (place, turn) in figure.feet_at_home.items():
        there, rotated = figure.pose(q, figure.feet[side].frame)
        off = max(off, float(np.linalg.norm(there - place)), float(np.linalg.norm(rotated - turn)))
    return off


def _judged(figure: Figure, q: Array, ball: Array, arm: str, hard: float) -> Pose:
    miss = float(np.linalg.norm(figure.pose(q, figure.hands[arm])[0] - ball))
    return Pose(q, miss, flaw_of(figure, q, ball, arm, hard))


def _attempt(
    figure: Figure, ball: Array, arm: str, kind: str, limits: tuple[Array, Array], *,
    aside: float = 0.0, flat: bool = False, upright: float = 30.0, share: float = 1.0,
) -> Pose:  # fmt: skip
    start, s = figure.home, np.minimum(1.0, np.arange(1, _STEPS + 1) / (0.75 * _STEPS))
    deep = 0.0 if kind == REACH else share * depth(figure, ball)
    rows = Rows(figure, _STEPS)
    feet = figure.feet_at_home
    rows.feet({s: pose[0] for s, pose in feet.items()}, {s: pose[1] for s, pose in feet.items()})
    here = figure.center_at_home[:2]
    way = np.column_stack([here + (support_middle(figure) - here) * s[:, None], np.zeros(_STEPS)])
    rows.center(way, upright, axes="xy")
    hand = figure.hands_at_home[arm]
    rows.position(figure.hands[arm], hand + (ball - hand) * s[:, None], 10.0 ** (2.0 + 4.0 * s**2))
    rows.turned(figure.trunk, rotation("y", np.radians(4.0 + 62.0 * deep) * s), 0.5)
    if figure.gaze is not None:
        rows.aim(figure.gaze, ball, 8.0, figure.neck or None)
    goal = start + (figure.bent - start) * deep
    goal[:7] = start[:7]
    if flat:
        rows.turned(figure.hands[arm], rotation("y", -np.pi / 2), 0.3 * s)
    if aside:
        goal = figure.posture({f"{arm}_shoulder_roll": aside, f"{arm}_shoulder_yaw": -aside}, goal)
    posture = start + (goal - start) * s[:, None]
    stiff = np.minimum(figure.stiffnesses(STIFF), 0.1)
    frames = rows.solve(posture, stiff, start, limits=limits, speeds=None, steps=6)
    return _judged(figure, frames.q[-1], ball, arm, float(frames.miss[-1]))


def _support(figure: Figure) -> Array:
    """(h, 2) hull of the soles at home."""
    known = figure.robot.memory.get("figure.support")
    if known is None:
        found, data = [], figure.data
        data.qpos[:] = figure.home
        mujoco.mj_kinematics(figure.model, data)
        for foot in figure.feet.values():
            for body, geoms in foot.parts:
                turn = data.xmat[body].reshape(3, 3)
                _, points = lowest_points(figure.model, list(geoms), turn[2:3])
                world = data.xpos[body] + points[0] @ turn.T
                found.append(world[world[:, 2] < 0.003, :2])
        known = figure.robot.memory["figure.support"] = hull(np.concatenate(found))
    return np.asarray(known)


def flaw_of(figure: Figure, q: Array, ball: Array, arm: str, hard: float = 0.0) -> str:
    """Why a pose is not admissible, by MuJoCo; empty where it is."""
    model, data = figure.model, figure.data
    corners = _support(figure)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    hand = figure.robot.frame(figure.hands[arm])
    palm = data.xpos[hand.body] + data.xmat[hand.body].reshape(3, 3) @ hand.local.position
    miss = float(np.linalg.norm(palm - ball))
    if miss > AT_BALL:
        return f"the hand stays {100 * miss:.0f} cm away"
    if hard > 1e-4:
        return "the feet would move"
    margin = hull_margin(corners, data.subtree_com[0][:2])
    if margin < BALANCED:
        return "balance would be lost"
    for c in range(data.ncon):
        if data.contact[c].dist < -TOUCHING:
            names = sorted(
                model.body(model.geom_bodyid[g]).name.replace("_", " ") for g in data.contact[c].geom
            )
            return f"its {names[0]} would run into its {names[1]}"
    low = _lowest(figure, data)
    return f"the {low} would go under the floor" if low else ""


def _lowest(figure: Figure, data: mujoco.MjData) -> str:
    """Name of a body that is under the floor; soles may touch it."""
    model = figure.model
    soles = {body for foot in figure.feet.values() for body, _ in foot.parts}
    for g in range(model.ngeom):
        body = int(model.geom_bodyid[g])
        if model.geom_contype[g] and body not in soles and data.geom_xpos[g, 2] < model.geom_rbound[g]:
            up = data.xmat[body].reshape(3, 3)[2:3]
            low, _ = lowest_points(model, [g], up)
            if low[0, 0] + data.xpos[body, 2] < 0.0:
                return str(model.body(body).name).replace("_", " ")
    return ""
