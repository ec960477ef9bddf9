"""``decide``: reach, bend, jump, walk or nothing, by where a ball is and what the figure can do.

In this order: a ball that a hand reaches standing is reached; else one that it reaches bending; else one
that a jump brings the palm to; else, where some free stand point nearby has one of these, the figure walks
there; else it does nothing.  Among the arms the one whose shoulder is nearer; within 20 mm the one that acted
last, else the right.  Pađen (2011) decides by fixed regions; here the regions are the model's own
(``abilities``), and every "reach", "bend" and "jump" is confirmed before it is said.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import InvalidGoalError
from robot_ik.figure.abilities import ASKED, Abilities
from robot_ik.figure.figure import Figure, chain, in_stance_frame, once_each
from robot_ik.figure.poses import BEND, REACH
from robot_ik.geometry import axis_rotations
from robot_ik.ports import Array

_ON_THE_SPOT = (REACH, BEND, "jump")
ACTIONS = (*_ON_THE_SPOT, "walk", "nothing")

HYSTERESIS = 0.03
"""A figure that reaches, bends or jumps goes on until the ball is so far outside what that can do, m."""
WORKSPACE = 8.0
"""A ball farther away than this does not concern the figure, m."""
_SAME_ARM = 0.02
# Stand points: headings in steps of 15 degrees; the body as a disc; a degree costs as much as so many metres.
_HEADINGS = np.radians(np.arange(-180.0, 180.0, 15.0))
_RADIUS, _PER_RADIAN, _TALL = 0.35, 0.35, 1.9
_CELL = 0.1
_UP_AND_DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
# How many of the best stand points are looked at, how many balls seen from there are tried by a solve, and
# each from so many poses; so many times more of both for a ball this near, m, for the best are on its feet.
_TRIES, _SOLVES, _FEW = 6, 3, 3
_MORE, _AT_FEET = 4, 0.3


@dataclass(frozen=True)
class Box:
    """An obstacle: a box on or above the floor."""

    center: tuple[float, float, float]  # (3,) m
    half: tuple[float, float, float]  # (3,) half its edges
    heading_deg: float = 0.0  # turned about the vertical

    def distance(self, xy: Array) -> Array:
        """(n,) distances of points on the floor, 0 inside; inf where the figure passes under or over it."""
        if self.center[2] - self.half[2] > _TALL or self.center[2] + self.half[2] < 0.0:
            return np.full(len(xy), np.inf)
        local = (xy - np.array(self.center[:2])) @ axis_rotations("z", np.radians(self.heading_deg))[:2, :2]
        return np.linalg.norm(np.maximum(np.abs(local) - np.array(self.half[:2]), 0.0), axis=1)


@dataclass(frozen=True)
class HalfSpace:
    """An obstacle: all that is behind a wall, whose normal (horizontal) points to where one may stand."""

    point: tuple[float, float, float]
    normal: tuple[float, float, float]

    def distance(self, xy: Array) -> Array:
        """(n,) distances of points on the floor, negative behind the wall."""
        n = np.array(self.normal[:2]) / max(float(np.linalg.norm(self.normal[:2])), 1e-12)
        return np.asarray((xy - np.array(self.point[:2])) @ n)


Obstacle = Box | HalfSpace


@dataclass(frozen=True)
class Decision:
    """What a figure does, and why."""

    action: str  # ``reach``, ``bend``, ``jump``, ``walk`` or ``nothing``
    arm: str | None  # that acts, after the walk if it walks
    reason: str  # a sentence for the user
    waypoints: tuple[tuple[float, float, float], ...] = ()  # (x, y, heading) each to walk through and to
    then: str | None = None  # what it will do there
    speed: float | None = None  # at take-off of a jump, at least, m/s


class Decider:
    """Decides for one figure among obstacles.

    Args:
        abilities: What it can do.
        obstacles: What it may not walk through.
    """

    def __init__(self, abilities: Abilities, obstacles: Sequence[Obstacle] = ()) -> None:
        self.abilities, self.obstacles = abilities, tuple(obstacles)

    @property
    def figure(self) -> Figure:
        """Who."""
        return self.abilities.figure

    def decide(
        self, ball: ArrayLike | None, stance: ArrayLike = (0.0, 0.0, 0.0), last: Decision | None = None
    ) -> Decision:
        """The decision for a ball.

        Args:
            ball: (3,) in the world, m; None or NaN where none is seen.
            stance: (x, y, heading) of the middle between the feet.
            last: The decision before, for the choice of the arm and the hysteresis.

        Raises:
            InvalidGoalError: Not three numbers.
        """
        stance = np.asarray(stance, dtype=float)
        point, refusal = self._checked_ball(ball, stance)
        if refusal:
            return Decision("nothing", None, refusal)
        local = in_stance_frame(stance, point)
        arms = self._arms(local, last)
        tried = (self._tried(kind, local, arm) for kind in _ON_THE_SPOT for arm in arms)
        found = next(filter(None, tried), None)
        if last is not None and last.arm in arms and last.action in _ON_THE_SPOT:
            lesser = found is None or ACTIONS.index(found.action) > ACTIONS.index(last.action)
            found = (self._still(local, last) if lesser else None) or found
        return found or self._walk(point, stance)

    def _checked_ball(self, ball: ArrayLike | None, stance: Array) -> tuple[Array, str]:
        """The ball as numbers, or why it is out of every reach."""
        try:
            point = np.full(3, np.nan) if ball is None else np.asarray(ball, dtype=float)
        except (TypeError, ValueError) as error:
            raise InvalidGoalError(f"a ball is three numbers, not {ball!r}") from error
        if point.shape != (3,):
            raise InvalidGoalError(
                f"a ball is three numbers, not {ball!r}", hint="one ball at a time: (x, y, z)"
            )
        if not np.isfinite(point).all():
            return point, "no ball is seen"
        if not self.figure.hands:
            return point, "the figure has no hands"
        away = float(np.linalg.norm(point[:2] - stance[:2]))
        if point[2] < 0.0:
            return point, f"the ball is {-100 * point[2]:.0f} cm under the floor"
        if away > WORKSPACE:
            return point, f"the ball is {away:.1f} m away, outside the workspace of {WORKSPACE:g} m"
        part = inside_body(self.figure, in_stance_frame(stance, point))
        return point, f"the ball is inside its {part}" if part else ""

    def _arms(self, local: Array, last: Decision | None) -> list[str]:
        """Arms, the one to use first."""
        distance = {arm: float(np.linalg.norm(at - local)) for arm, at in self.abilities.shoulders.items()}
        arms = sorted(distance, key=lambda arm: (distance[arm], arm != "right"))
        if len(arms) == 2 and distance[arms[1]] - distance[arms[0]] < _SAME_ARM:
            first = last.arm if last is not None and last.arm in arms else "right"
            arms.sort(key=lambda arm: arm != first)
        return arms

    def _tried(self, kind: str, local: Array, arm: str, starts: int = ASKED) -> Decision | None:
        """What needs no step, by that arm, confirmed by solves from so many poses; None: it cannot be."""
        if kind == "jump":
            speed = self.abilities.take_off(local, arm)
            if speed is None:
                return None
            needed = f"a jump of {speed:.1f} m/s or more brings the {arm} hand to it"
            return Decision(kind, arm, f"the ball is overhead: {needed}", speed=speed)
        if self.abilities.can(kind, local, arm, starts) is None:
            return None
        how = "standing" if kind == REACH else "only bending down"
        return Decision(kind, arm, f"the {arm} hand reaches the ball {how}")

    def _still(self, local: Array, last: Decision) -> Decision | None:
        """The last action again for a ball that is hardly outside what it can do."""
        if last.arm is None:
            raise RuntimeError("the last action used no arm")
        nearer = self.abilities.shoulders[last.arm] - local
        drawn = local + nearer * (HYSTERESIS / max(float(np.linalg.norm(nearer)), HYSTERESIS))
        found = self._tried(last.action, drawn, last.arm)
        edge = f"the ball is at the edge of what the {last.arm} hand reaches"
        return found and replace(found, reason=last.reason if last.action == "jump" else edge)

    def _walk(self, ball: Array, stance: Array) -> Decision:
        """To the cheapest free stand point from which the ball can be had, on a free path."""
        away = float(np.linalg.norm(ball[:2] - stance[:2]))
        more = _MORE if away < _AT_FEET else 1
        for kind, verb in ((REACH, "reached"), (BEND, "reached bending"), ("jump", "reached jumping")):
            able: dict[tuple[str, bytes], bool] = {}  # many stand points see the ball alike
            for stand, arm, local in self._stands(kind, ball, stance, more)[: more * _TRIES]:
                seen = arm, local.tobytes()
                if seen not in able and len(able) < more * _SOLVES:
                    able[seen] = self._tried(kind, local, arm, _FEW) is not None
                if not able.get(seen):
                    continue
                waypoints = self.path(stance, stand)
                if waypoints is not None:
                    nearer = float(np.linalg.norm(ball[:2] - stand[:2])) < away
                    how = f"{verb} with the {arm} hand from {'nearer' if nearer else 'farther off'}"
                    reason = f"the ball is {away:.2f} m away: it can be {how}"
                    return Decision("walk", arm, reason, waypoints, kind)
        free = "free " if self.obstacles else ""
        reason = f"no {free}stand point was found from which a hand reaches the ball"
        if ball[2] > max(map(self.abilities.top, self.figure.hands)):
            reason = f"a ball at a height of {ball[2]:.2f} m is out of reach, jumping too"
        return Decision("nothing", None, reason)

    def _stands(self, kind: str, ball: Array, stance: Array, more: int = 1) -> list[tuple[Array, str, Array]]:
        """Free stand points, the cheapest first: (x, y, heading), arm, ball as seen from there."""
        stands, balls, sides, arms = [], [], [], list(self.figure.hands)
        headings = _HEADINGS + stance[2]
        matrices = axis_rotations("z", headings)[:, :2, :2]
        for side, arm in enumerate(arms):
            if kind == "jump":
                cells = self.abilities.under(arm)[None]
            else:
                cells = self.abilities.maps[kind, arm].comfortable(float(ball[2]))
            at = ball[:2] - np.einsum("hij,cj->hci", matrices, cells)
            stands.append(np.column_stack([at.reshape(-1, 2), np.repeat(headings, len(cells))]))
            seen = np.column_stack([cells, np.full(len(cells), ball[2])])
            balls.append(np.tile(seen, (len(headings), 1)))
            sides.append(np.full(len(headings) * len(cells), side))
        points, locals_, which = np.concatenate(stands), np.concatenate(balls), np.concatenate(sides)
        offsets = points[:, :2] - stance[:2]
        angle = np.abs((points[:, 2] - stance[2] + np.pi) % (2 * np.pi) - np.pi)
        distance = np.linalg.norm(offsets, axis=1)
        # Comfortable: the ball before the chest on the side of the arm, half an arm away.
        lateral = np.array([0.2 if arm == "left" else -0.2 for arm in arms])[which]
        comfort = np.abs(locals_[:, 0] - 0.4) + np.abs(locals_[:, 1] - lateral)
        cost = distance + _PER_RADIAN * angle + 0.8 * comfort
        cost[~self.free(points[:, :2])] = np.inf
        few = min(4 * more * _TRIES, len(cost))
        least = np.sort(np.argpartition(cost, few - 1)[:few])
        order = least[np.argsort(cost[least], kind="stable")]
        picks = [i for i in order if np.isfinite(cost[i])]
        # Alternatives that differ: the best, then those at some distance from it.
        spread = [i for n, i in enumerate(picks) if n < 2 or n % 4 == 0]
        return [(points[i], arms[which[i]], locals_[i]) for i in spread]

    def free(self, xy: Array) -> NDArray[np.bool_]:
        """(n,) whether the body, a disc, may stand there."""
        out = np.ones(len(xy), dtype=bool)
        for obstacle in self.obstacles:
            out &= obstacle.distance(xy) > _RADIUS
        return out

    def clear(self, a: Array, b: Array) -> bool:
        """Whether the straight path is free."""
        n = max(2, int(np.linalg.norm(b - a) / 0.05) + 1)
        return bool(self.free(a + (b - a) * np.linspace(0, 1, n)[:, None])[1:].all())

    def path(self, start: Array, end: Array) -> tuple[tuple[float, float, float], ...] | None:
        """Stand points from one to the other round the obstacles; None where there is no free path."""
        goal = (float(end[0]), float(end[1]), float(end[2]))
        if self.clear(start[:2], end[:2]):
            return (goal,)
        cells = self._search(start[:2], end[:2])
        if cells is None:
            return None
        corners, here = [], start[:2]
        for k in range(len(cells) - 1):  # pull the string tight
            if not self.clear(here, cells[k + 1]):
                corners.append(cells[k])
                here = cells[k]
        corners.append(end[:2])
        ways = itertools.pairwise([start[:2], *corners])
        out = [(float(b[0]), float(b[1]), float(np.arctan2(*(b - a)[::-1]))) for a, b in ways]
        return (*out[:-1], goal)

    def _search(self, a: Array, b: Array) -> list[Array] | None:
        """A* over a grid of 0.1 m between two points and a margin about them."""
        low = np.minimum(a, b) - 3.0
        shape = np.ceil((np.maximum(a, b) + 3.0 - low) / _CELL).astype(int) + 1
        grid = low + np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1) * _CELL
        free = self.free(grid.reshape(-1, 2)).reshape(tuple(shape))
        start, goal = (tuple(int(v) for v in np.rint((p - low) / _CELL)) for p in (a, b))
        free[start] = free[goal] = True
        cost: dict[tuple[int, ...], float] = {start: 0.0}
        came: dict[tuple[int, ...], tuple[int, ...]] = {}
        queue = [(0.0, start)]
        steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
        while queue:
            _, here = heapq.heappop(queue)
            if here == goal:
                out = [b]
                while here in came:
                    here = came[here]
                    out.append(low + np.array(here) * _CELL)
                return out[::-1]
            for i, j in steps:
                there = (here[0] + i, here[1] + j)
                if not (0 <= there[0] < shape[0] and 0 <= there[1] < shape[1]) or not free[there]:
                    continue
                new = cost[here] + float(np.hypot(i, j))
                if new < cost.get(there, np.inf):
                    cost[there], came[there] = new, here
                    rest = float(np.hypot(there[0] - goal[0], there[1] - goal[1]))
                    heapq.heappush(queue, (new + rest, there))
        return None


def inside_body(figure: Figure, local: Array) -> str:
    """Name of the body part, arms excepted, that holds a point seen from the feet; empty where none does."""
    model = figure.model
    geoms, positions, matrices = _trunk_shapes(figure)
    near = ((local - positions) ** 2).sum(axis=1) <= model.geom_rbound[geoms] ** 2
    for i in np.flatnonzero(near).tolist():
        g = int(geoms[i])
        size, kind = model.geom_size[g], min(int(model.geom_type[g]), int(mujoco.mjtGeom.mjGEOM_BOX))
        # Shapes are convex: from inside, rays up and down both meet the surface; of a mesh its box counts.
        met = (mujoco.mju_rayGeom(positions[i], matrices[i], size, local, way, kind) for way in _UP_AND_DOWN)
        if min(met) >= 0.0:
            return str(model.body(int(model.geom_bodyid[g])).name).replace("_", " ")
    return ""


@once_each
def _trunk_shapes(figure: Figure) -> tuple[NDArray[np.int64], Array, Array]:
    """Colliding geoms that belong to no arm, and their (g, 3) positions and (g, 9) rotations at home."""
    model, data, frame = figure.model, figure.at(figure.home), figure.robot.frame
    trunk = frame(figure.trunk).body
    arms = [body for hand in figure.hands.values() for body in chain(model, frame(hand).body, trunk)]
    geoms = np.flatnonzero((model.geom_contype != 0) & ~np.isin(model.geom_bodyid, arms))
    return geoms, data.geom_xpos[geoms].copy(), data.geom_xmat[geoms].copy()
