"""Ground truth of decisions: seeded random starts of damped Gauss-Newton on MuJoCo; nothing is shared with
the product but its model and two numbers of a jump (where the centre of mass takes off).

A pose is admissible when it is inside limits, both feet stand where they stood, the centre of mass is 10 mm
inside the soles, the palm within 5 mm of the ball, no shape but the soles under the floor, and no body
deeper than 2 mm in another.  *Reach*: one exists in the upright box.  *Bend*: one exists.  *Jump*: the trunk
upright, the palm can be over the centre of mass by what a take-off of 2.6 m/s leaves, within 50 mm laterally.
*Walk*: none of these here, but one at some point beside the ball.  Else *nothing*.  A ball whose label is
another one with margins of 15 mm and 0 mm (jump: 60 mm for 40 mm laterally) is a border case.

``python tests/figure/judge.py COUNT SEED > judged_balls.csv`` judges random balls by 64 starts.
"""

import hashlib
import sys
from collections.abc import Callable, Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from robot_ik.figure.figure import Figure, load_figure
from robot_ik.figure.jump import forward_at_take_off, highest_take_off

Array = NDArray[np.float64]

UPRIGHT_DEG = {
    "knee_pitch": (0, 25),
    "hip_pitch": (-15, 30),
    "torso_pitch": (-10, 10),
    "pelvis_pitch": (-10, 10),
}
STARTS = 64
STRICT, LAX = (0.005, 0.010), (0.015, 0.0)
"""Palm from the ball, and centre of mass inside the soles, m."""
# A ball that so many starts all miss by so much, m, is out of reach.
_FAR = ((4, 0.2), (8, 0.1), (16, 0.05), (32, 0.03))
_TAKE_OFF, _GRAVITY, _COLUMN = 2.6, 9.81, (0.04, 0.06)
BORDER = "border"
LOW, HIGH = (-0.3, -0.9, 0.05), (1.0, 0.9, 2.9)
"""Balls are drawn from this box about the feet."""


class Judge:
    """Asks for admissible poses of one model."""

    def __init__(self, figure: Figure) -> None:
        self.model, self.home = figure.model, figure.home
        self.data = mujoco.MjData(self.model)
        self.joints = [self.model.joint(j).name for j in range(1, self.model.njnt)]
        self.lower, self.upper = self.model.jnt_range[1:].T.copy()
        self.set_pose(self.home)
        self.feet = {s: (self.site(f"{s}_foot")) for s in ("left", "right")}
        self.shapes = [g for g in range(self.model.ngeom) if self.model.geom_contype[g]]
        self.body = [self.model.body(b).name for b in self.model.geom_bodyid]
        points = [p for g in self.shapes if self.body[g].endswith(("_foot", "_toes")) for p in self.lowest(g)]
        self.hull = ConvexHull(np.array([p[:2] for p in points if p[2] < 0.003])).equations
        self.off = np.array([forward_at_take_off(figure), 0.0, highest_take_off(figure)])

    def set_pose(self, q: Array) -> None:
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def site(self, name: str) -> tuple[Array, Array]:
        i = self.model.site(name).id
        return self.data.site_xpos[i].copy(), self.data.site_xmat[i].reshape(3, 3).copy()

    def lowest(self, g: int) -> list[Array]:
        """Low points of a geom: of boxes the corners, of capsules the ends, of ellipsoids the bottom."""
        at, rotation = self.data.geom_xpos[g], self.data.geom_xmat[g].reshape(3, 3)
        size, kind = self.model.geom_size[g], self.model.geom_type[g]
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            return [at + rotation @ (size * (2 * np.array(k) - 1)) for k in np.ndindex(2, 2, 2)]
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            return [at + rotation[:, 2] * s * size[1] - [0, 0, size[0]] for s in (-1, 1)]
        if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            down = -rotation[2]
            return [at + rotation @ (size**2 * down / np.linalg.norm(size * down))]
        return [at - [0, 0, size[0]]]

    def over(self) -> float:
        """How far the centre of mass is inside the soles."""
        return float(-(self.hull[:, :2] @ self.data.subtree_com[0][:2] + self.hull[:, 2]).max())

    def limits(self, kind: str) -> tuple[Array, Array]:
        low, high = self.lower.copy(), self.upper.copy()
        if kind == "reach":
            for k, joint in enumerate(self.joints):
                for part, (a, b) in UPRIGHT_DEG.items():
                    if joint.endswith(part):
                        low[k], high[k] = max(low[k], np.radians(a)), min(high[k], np.radians(b))
        return low, high

    def admissible(
        self, q: Array, ball: Array, arm: str, kind: str, margins: tuple[float, float] = STRICT
    ) -> bool:
        """Whether a pose, of whomever, is admissible."""
        near, inside = margins
        low, high = self.limits(kind)
        self.set_pose(q)
        if np.linalg.norm(self.site(f"{arm}_hand")[0] - ball) > near or self.over() < inside:
            return False
        if (q[7:] < low - 1e-9).any() or (q[7:] > high + 1e-9).any():
            return False
        for side, (position, rotation) in self.feet.items():
            p, r = self.site(f"{side}_foot")
            angle = np.arccos(np.clip((np.trace(r @ rotation.T) - 1) / 2, -1.0, 1.0))
            if np.linalg.norm(p - position) > 2e-4 or angle > 2e-3:
                return False
        for g in self.shapes:
            if not self.body[g].endswith(("_foot", "_toes")) and min(p[2] for p in self.lowest(g)) < 0.0:
                return False
        mujoco.mj_forward(self.model, self.data)
        return all(self.data.contact[c].dist > -0.002 for c in range(self.data.ncon))

    def rows(self, ball: Array, arm: str) -> tuple[Array, Array]:
        """Errors of feet, palm and balance at the pose in ``data``, and their slopes."""
        m, d, nv = self.model, self.data, self.model.nv
        out, jac = [], []
        jp, jr = np.empty((3, nv)), np.empty((3, nv))
        for side, (position, rotation) in self.feet.items():
            i = m.site(f"{side}_foot").id
            p, r = self.site(f"{side}_foot")
            mujoco.mj_jacSite(m, d, jp, jr, i)
            e = rotation @ r.T
            out += [
                10 * (position - p),
                2.5 * np.array([e[2, 1] - e[1, 2], e[0, 2] - e[2, 0], e[1, 0] - e[0, 1]]),
            ]
            jac += [10 * jp, 5 * jr]
        i = m.site(f"{arm}_hand").id
        mujoco.mj_jacSite(m, d, jp, None, i)
        out.append(10 * (ball - d.site_xpos[i]))
        jac.append(10 * jp)
        mujoco.mj_jacSubtreeCom(m, d, jp, 0)
        over = self.hull[:, :2] @ d.subtree_com[0][:2] + self.hull[:, 2] + STRICT[1] + 0.002
        out.append(-10 * np.maximum(over, 0.0))
        jac.append(10 * (over > 0)[:, None] * (self.hull[:, :2] @ jp[:2]))
        return np.concatenate(out), np.vstack(jac)

    def solve(self, ball: Array, arm: str, kind: str, rng: np.random.Generator) -> Array:
        """From a random start to the ball, bent by a random amount where it may bend."""
        low, high = self.limits(kind)
        bend = rng.uniform(0, 1) if kind == "bend" else 0.0
        squat = self.model.key("squat").qpos
        q = self.home.copy()
        q[2] += bend * (squat[2] - self.home[2])
        middle = self.home[7:] + bend * (squat[7:] - self.home[7:])
        spread = 0.25 if kind == "reach" else 0.5
        q[7:] = np.clip(middle + spread * rng.normal(size=self.model.nv - 6), low, high)
        free = np.ones(self.model.nv, dtype=bool)
        return self.descend(q, low, high, free, lambda: self.rows(ball, arm))

    def descend(
        self,
        q: Array,
        low: Array,
        high: Array,
        may: NDArray[np.bool_],
        rows: Callable[[], tuple[Array, Array]],
    ) -> Array:
        """Damped Gauss-Newton; joints at a limit that push outwards are left out."""
        rest, damping, idle = q[7:].copy(), 1e-2, 0
        self.set_pose(q)
        e, jac = rows()
        for _ in range(80):
            weak = np.concatenate([np.zeros(6), 2e-3 * (rest - q[7:])])
            free, step = may.copy(), np.zeros(self.model.nv)
            for _ in range(3):
                a = jac[:, free]
                step[:] = 0.0
                step[free] = np.linalg.solve(
                    a.T @ a + (damping + 2e-3) * np.eye(free.sum()), a.T @ e + weak[free]
                )
                beyond = (q[7:] + step[6:] < low) | (q[7:] + step[6:] > high)
                out = np.concatenate([np.zeros(6, dtype=bool), beyond])
                if not (out & free).any():
                    break
                free &= ~out
            new = q.copy()
            mujoco.mj_integratePos(self.model, new, step, 1.0)
            new[7:] = np.clip(new[7:], low, high)
            self.set_pose(new)
            after, slope = rows()
            if after @ after < e @ e:
                idle = idle + 1 if after @ after > 0.99 * (e @ e) else 0
                q, e, jac, damping = new, after, slope, max(damping / 3, 1e-7)
            else:
                damping *= 4
            if e @ e < 1e-9 or idle > 5 or damping > 1e3:
                break
        return q

    def state(self, ball: Array, kind: str, starts: int, seed: int) -> str:
        """``yes``, ``border`` or ``no``: whether some arm has an admissible pose."""
        border = False
        for arm in ("right", "left") if ball[1] < 0 else ("left", "right"):
            rng, least = np.random.default_rng([seed, kind == "bend", arm == "left"]), np.inf
            for k in range(starts):
                q = self.solve(ball, arm, kind, rng)
                self.set_pose(q)
                least = min(least, float(np.linalg.norm(self.site(f"{arm}_hand")[0] - ball)))
                if self.admissible(q, ball, arm, kind):
                    return "yes"
                border = border or self.admissible(q, ball, arm, kind, LAX)
                if any(k + 1 >= count and least > error for count, error in _FAR):
                    break
        return BORDER if border else "no"

    def jumps(self, ball: Array, starts: int, seed: int) -> str:
        """As ``state``: whether the palm comes beside the centre of mass to where a jump brings it."""
        for radius, answer in zip(_COLUMN, ("yes", BORDER), strict=True):
            if any(self.column(ball, arm, starts, seed, radius) < 1e-3 for arm in ("right", "left")):
                return answer
        return "no"

    def column(self, ball: Array, arm: str, starts: int, seed: int, radius: float) -> float:
        """How far the palm stays from the column over the centre of mass that a jump needs, m."""
        m, d = self.model, self.data
        arms = ("clavicle", "shoulder", "elbow", "wrist")
        may = np.concatenate(
            [np.zeros(6, dtype=bool), [j.startswith(arm) and any(p in j for p in arms) for j in self.joints]]
        )
        want = ball - self.off
        low, high = want[2] - _TAKE_OFF**2 / (2 * _GRAVITY), want[2] - 1e-3
        i, jp, jc = m.site(f"{arm}_hand").id, np.empty((3, m.nv)), np.empty((3, m.nv))

        def rows() -> tuple[Array, Array]:
            mujoco.mj_jacSite(m, d, jp, None, i)
            mujoco.mj_jacSubtreeCom(m, d, jc, 0)
            at = d.site_xpos[i] - d.subtree_com[0]
            off = np.array([*want[:2], np.clip(at[2], low, high)]) - at
            far = float(np.linalg.norm(off[:2]))
            off[:2] *= max(0.0, far - radius) / max(far, 1e-9)
            return 10 * off, 10 * (jp - jc)

        rng, least = np.random.default_rng([seed, 7, arm == "left"]), np.inf
        for k in range(starts // 2):
            q = self.home.copy()
            q[7:] = np.where(may[6:], rng.uniform(self.lower, self.upper), self.home[7:])
            self.descend(q, self.lower, self.upper, may, rows)
            least = min(least, float(np.linalg.norm(rows()[0])) / 10)
            if least < 1e-3 or (k >= 3 and least > 0.1) or (k >= 11 and least > 0.02):
                break
        return least

    def inside(self, ball: Array) -> bool:
        """Whether a body part, arms aside, holds the ball: rays both ways from it hit one convex shape."""
        self.set_pose(self.home)
        way = np.array([0.36, 0.48, 0.8])
        for g in self.shapes:
            if any(part in self.body[g] for part in ("clavicle", "arm", "hand", "shoulder")):
                continue
            size, kind = self.model.geom_size[g], int(self.model.geom_type[g])
            rotation = np.ascontiguousarray(self.data.geom_xmat[g])
            hits = [
                mujoco.mju_rayGeom(self.data.geom_xpos[g], rotation, size, ball, way * s, kind)
                for s in (1, -1)
            ]
            if min(hits) >= 0.0:
                return True
        return False

    def label(self, ball: Array, starts: int = STARTS, seed: int = 0) -> str:
        """The right decision, or ``border``."""
        if self.inside(ball):
            return "nothing"
        for kind in ("reach", "bend"):
            found = self.state(ball, kind, starts, seed)
            if found != "no":
                return kind if found == "yes" else BORDER
        found = self.jumps(ball, starts, seed)
        if found != "no":
            return "jump" if found == "yes" else BORDER
        return self.elsewhere(ball, starts, seed)

    def elsewhere(self, ball: Array, starts: int, seed: int) -> str:
        """``walk`` where some place beside the ball has an action; only its height is the same there."""
        positions = [np.array([x, -0.2, ball[2]]) for x in (0.4, 0.5, 0.3)]
        for kind in ("reach", "bend"):
            if any(self.state(there, kind, 8, seed) == "yes" for there in positions):
                return "walk"
        columns = [np.array([x, y, ball[2]]) for x in (0.0, 0.1, 0.2) for y in (-0.1, -0.2, -0.3)]
        found = min(self.column(there, "right", 16, seed, 0.04) for there in columns)
        return "walk" if found < 1e-3 else "nothing" if found > 0.01 else BORDER


def drawn(count: int, seed: int) -> Iterator[tuple[int, Array]]:
    rng = np.random.default_rng(seed)
    for k in range(count):
        yield k, rng.uniform(LOW, HIGH).round(4)


def digest(figure: Figure) -> str:
    return hashlib.sha256(figure.robot.path.read_bytes()).hexdigest()[:16]


def main(count: int, seed: int, first: int = 0) -> None:
    figure = load_figure()
    judge = Judge(figure)
    print(f"# python tests/figure/judge.py {count} {seed}: model sha256 {digest(figure)}, {STARTS} starts")
    for k, ball in drawn(count, seed):
        if k >= first:
            print(",".join(f"{x:g}" for x in ball) + f",{judge.label(ball, STARTS, seed + k)}", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
