"""Independent judge of decisions: seeded random starts of damped Gauss-Newton on MuJoCo.

It shares nothing with the figure but the model and two numbers of a jump: where the centre of mass
takes off.

A pose is admissible if it is inside the joint limits, both feet stand at home, the centre of mass
is 10 mm inside the soles, the palm is within 5 mm of the ball, no shape but the soles is below the
floor, and no body is deeper than 2 mm in another. The labels of a ball:

- ``reach``: an admissible pose exists with upright joints.
- ``bend``: an admissible pose exists.
- ``jump``: with upright trunk the palm comes to where a take-off of 2.6 m/s brings the ball, within
  50 mm to the sides.
- ``walk``: none of these, but one of them exists at some place beside the ball.
- ``nothing``: none of these.
- ``border``: the label changes with margins of 15 mm and 0 mm (jump: 60 mm for 40 mm).

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
"""Ranges of the joints of a reach, degrees."""

STARTS = 64
"""Random starts for each ball."""

STRICT = (0.005, 0.010)
"""Largest distance of palm and ball, and smallest margin of the centre of mass, m."""

LAX = (0.015, 0.0)
"""The same for border cases, m."""

MISSES = ((4, 0.2), (8, 0.1), (16, 0.05), (32, 0.03))
"""(starts, distance in m): a ball that so many starts all miss by that distance is out of reach."""

TAKE_OFF = 2.6
"""Fastest take-off, m/s."""

GRAVITY = 9.81
"""m/s²."""

COLUMNS = (0.04, 0.06)
"""Horizontal distances of palm and ball at the apex of a jump, m: certain, and border."""

BORDER = "border"

LOWER = (-0.3, -0.9, 0.05)
UPPER = (1.0, 0.9, 2.9)
"""Corners of the box about the feet from which balls are drawn, m."""

SOLES = ("_foot", "_toes")
ARM_PARTS = ("clavicle", "shoulder", "elbow", "wrist")


class Judge:
    """Searches admissible poses of one model."""

    def __init__(self, figure: Figure) -> None:
        self.model = figure.model
        self.home = figure.home
        self.data = mujoco.MjData(self.model)
        self.joints = [self.model.joint(j).name for j in range(1, self.model.njnt)]
        self.lower = self.model.jnt_range[1:, 0].copy()
        self.upper = self.model.jnt_range[1:, 1].copy()
        self.set_pose(self.home)
        self.feet = {side: self.site(f"{side}_foot") for side in ("left", "right")}
        self.shapes = [g for g in range(self.model.ngeom) if self.model.geom_contype[g]]
        self.body = [self.model.body(b).name for b in self.model.geom_bodyid]
        soles = [g for g in self.shapes if self.body[g].endswith(SOLES)]
        points = [point for g in soles for point in self.low_points(g)]
        on_floor = np.array([point[:2] for point in points if point[2] < 0.003])
        self.hull = ConvexHull(on_floor).equations
        self.take_off = np.array([forward_at_take_off(figure), 0.0, highest_take_off(figure)])

    def set_pose(self, q: Array) -> None:
        """Put the model's bodies at ``q`` (nq,)."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def site(self, name: str) -> tuple[Array, Array]:
        """Return position (3,) and rotation (3, 3) of a site."""
        i = self.model.site(name).id
        return self.data.site_xpos[i].copy(), self.data.site_xmat[i].reshape(3, 3).copy()

    def low_points(self, geom: int) -> list[Array]:
        """Return points (3,) of a geom one of which is its lowest."""
        position = self.data.geom_xpos[geom]
        rotation = self.data.geom_xmat[geom].reshape(3, 3)
        size = self.model.geom_size[geom]
        kind = self.model.geom_type[geom]
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            corners = [size * (2 * np.array(k) - 1) for k in np.ndindex(2, 2, 2)]
            return [position + rotation @ corner for corner in corners]
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            axis = rotation[:, 2]
            return [position + axis * sign * size[1] - [0, 0, size[0]] for sign in (-1, 1)]
        if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            down = -rotation[2]
            return [position + rotation @ (size**2 * down / np.linalg.norm(size * down))]
        return [position - [0, 0, size[0]]]

    def balance_margin(self) -> float:
        """Return how far the centre of mass is inside the soles, m."""
        return float(-self.hull_distances().max())

    def hull_distances(self) -> Array:
        """Return the distances of the centre of mass from the edges, negative inside, m."""
        center = self.data.subtree_com[0][:2]
        return np.asarray(self.hull[:, :2] @ center + self.hull[:, 2])

    def limits(self, kind: str) -> tuple[Array, Array]:
        """Return the joint limits of a kind."""
        lower = self.lower.copy()
        upper = self.upper.copy()
        if kind == "reach":
            for k, joint in enumerate(self.joints):
                for part, (lower_deg, upper_deg) in UPRIGHT_DEG.items():
                    if joint.endswith(part):
                        lower[k] = max(lower[k], np.radians(lower_deg))
                        upper[k] = min(upper[k], np.radians(upper_deg))
        return lower, upper

    def admissible(
        self,
        q: Array,
        ball: Array,
        arm: str,
        kind: str,
        margins: tuple[float, float] = STRICT,
    ) -> bool:
        """Return whether a pose from any source is admissible."""
        palm_distance, balance = margins
        lower, upper = self.limits(kind)
        self.set_pose(q)
        if np.linalg.norm(self.site(f"{arm}_hand")[0] - ball) > palm_distance:
            return False
        if self.balance_margin() < balance:
            return False
        if (q[7:] < lower - 1e-9).any() or (q[7:] > upper + 1e-9).any():
            return False
        for side, (home_position, home_rotation) in self.feet.items():
            position, rotation = self.site(f"{side}_foot")
            cosine = (np.trace(rotation @ home_rotation.T) - 1) / 2
            angle = np.arccos(np.clip(cosine, -1.0, 1.0))
            if np.linalg.norm(position - home_position) > 2e-4 or angle > 2e-3:
                return False
        for geom in self.shapes:
            if self.body[geom].endswith(SOLES):
                continue
            if min(point[2] for point in self.low_points(geom)) < 0.0:
                return False
        mujoco.mj_forward(self.model, self.data)
        return all(self.data.contact[c].dist > -0.002 for c in range(self.data.ncon))

    def rows(self, ball: Array, arm: str) -> tuple[Array, Array]:
        """Return residuals of feet, palm and balance at the pose in ``data``, and the Jacobian."""
        model = self.model
        data = self.data
        residuals = []
        jacobians = []
        jac_position = np.empty((3, model.nv))
        jac_rotation = np.empty((3, model.nv))
        for side, (home_position, home_rotation) in self.feet.items():
            i = model.site(f"{side}_foot").id
            position, rotation = self.site(f"{side}_foot")
            mujoco.mj_jacSite(model, data, jac_position, jac_rotation, i)
            e = home_rotation @ rotation.T
            turn = np.array([e[2, 1] - e[1, 2], e[0, 2] - e[2, 0], e[1, 0] - e[0, 1]])
            residuals += [10 * (home_position - position), 2.5 * turn]
            jacobians += [10 * jac_position, 5 * jac_rotation]
        i = model.site(f"{arm}_hand").id
        mujoco.mj_jacSite(model, data, jac_position, None, i)
        residuals.append(10 * (ball - data.site_xpos[i]))
        jacobians.append(10 * jac_position)
        mujoco.mj_jacSubtreeCom(model, data, jac_position, 0)
        outside = self.hull_distances() + STRICT[1] + 0.002
        residuals.append(-10 * np.maximum(outside, 0.0))
        edges = self.hull[:, :2] @ jac_position[:2]
        jacobians.append(10 * (outside > 0)[:, None] * edges)
        return np.concatenate(residuals), np.vstack(jacobians)

    def solve(self, ball: Array, arm: str, kind: str, rng: np.random.Generator) -> Array:
        """Return a pose (nq,) from a random start, bent by a random amount if it may bend."""
        lower, upper = self.limits(kind)
        bend = rng.uniform(0, 1) if kind == "bend" else 0.0
        squat = self.model.key("squat").qpos
        q = self.home.copy()
        q[2] += bend * (squat[2] - self.home[2])
        middle = self.home[7:] + bend * (squat[7:] - self.home[7:])
        spread = 0.25 if kind == "reach" else 0.5
        q[7:] = np.clip(middle + spread * rng.normal(size=self.model.nv - 6), lower, upper)
        movable = np.ones(self.model.nv, dtype=bool)
        return self.descend(q, lower, upper, movable, lambda: self.rows(ball, arm))

    def descend(
        self,
        q: Array,
        lower: Array,
        upper: Array,
        movable: NDArray[np.bool_],
        rows: Callable[[], tuple[Array, Array]],
    ) -> Array:
        """Return a minimum (nq,) by damped Gauss-Newton with active joint limits."""
        rest = q[7:].copy()
        damping = 1e-2
        idle = 0
        self.set_pose(q)
        residual, jacobian = rows()
        for _ in range(80):
            posture = np.concatenate([np.zeros(6), 2e-3 * (rest - q[7:])])
            step = self.limited_step(q, lower, upper, movable, residual, jacobian, posture, damping)
            candidate = q.copy()
            mujoco.mj_integratePos(self.model, candidate, step, 1.0)
            candidate[7:] = np.clip(candidate[7:], lower, upper)
            self.set_pose(candidate)
            new_residual, new_jacobian = rows()
            before = residual @ residual
            after = new_residual @ new_residual
            if after < before:
                idle = idle + 1 if after > 0.99 * before else 0
                q = candidate
                residual = new_residual
                jacobian = new_jacobian
                damping = max(damping / 3, 1e-7)
            else:
                damping *= 4
            if residual @ residual < 1e-9 or idle > 5 or damping > 1e3:
                break
        return q

    def limited_step(
        self,
        q: Array,
        lower: Array,
        upper: Array,
        movable: NDArray[np.bool_],
        residual: Array,
        jacobian: Array,
        posture: Array,
        damping: float,
    ) -> Array:
        """Return a damped step (nv,). Joints at a limit that push outwards do not move."""
        free = movable.copy()
        step = np.zeros(self.model.nv)
        for _ in range(3):
            a = jacobian[:, free]
            matrix = a.T @ a + (damping + 2e-3) * np.eye(free.sum())
            step[:] = 0.0
            step[free] = np.linalg.solve(matrix, a.T @ residual + posture[free])
            moved = q[7:] + step[6:]
            is_outside = np.concatenate(
                [np.zeros(6, dtype=bool), (moved < lower) | (moved > upper)]
            )
            if not (is_outside & free).any():
                break
            free &= ~is_outside
        return step

    def state(self, ball: Array, kind: str, starts: int, seed: int) -> str:
        """Return ``yes``, ``border`` or ``no``: whether some arm has an admissible pose."""
        is_border = False
        for arm in ("right", "left") if ball[1] < 0 else ("left", "right"):
            rng = np.random.default_rng([seed, kind == "bend", arm == "left"])
            nearest = np.inf
            for k in range(starts):
                q = self.solve(ball, arm, kind, rng)
                self.set_pose(q)
                distance = float(np.linalg.norm(self.site(f"{arm}_hand")[0] - ball))
                nearest = min(nearest, distance)
                if self.admissible(q, ball, arm, kind):
                    return "yes"
                is_border = is_border or self.admissible(q, ball, arm, kind, LAX)
                if any(k + 1 >= count and nearest > miss for count, miss in MISSES):
                    break
        return BORDER if is_border else "no"

    def jumps(self, ball: Array, starts: int, seed: int) -> str:
        """Return as ``state`` whether a jump brings the palm of some arm to a ball."""
        for radius, answer in zip(COLUMNS, ("yes", BORDER), strict=True):
            for arm in ("right", "left"):
                if self.column_error(ball, arm, starts, seed, radius) < 1e-3:
                    return answer
        return "no"

    def column_error(self, ball: Array, arm: str, starts: int, seed: int, radius: float) -> float:
        """Return the distance of the palm from the column above the centre of mass, m."""
        model = self.model
        data = self.data
        is_arm = [
            joint.startswith(arm) and any(part in joint for part in ARM_PARTS)
            for joint in self.joints
        ]
        movable = np.concatenate([np.zeros(6, dtype=bool), is_arm])
        target = ball - self.take_off
        lowest = target[2] - TAKE_OFF**2 / (2 * GRAVITY)
        highest = target[2] - 1e-3
        i = model.site(f"{arm}_hand").id
        jac_palm = np.empty((3, model.nv))
        jac_center = np.empty((3, model.nv))

        def rows() -> tuple[Array, Array]:
            mujoco.mj_jacSite(model, data, jac_palm, None, i)
            mujoco.mj_jacSubtreeCom(model, data, jac_center, 0)
            palm = data.site_xpos[i] - data.subtree_com[0]
            error = np.array([*target[:2], np.clip(palm[2], lowest, highest)]) - palm
            lateral = float(np.linalg.norm(error[:2]))
            error[:2] *= max(0.0, lateral - radius) / max(lateral, 1e-9)
            return 10 * error, 10 * (jac_palm - jac_center)

        rng = np.random.default_rng([seed, 7, arm == "left"])
        least = np.inf
        for k in range(starts // 2):
            q = self.home.copy()
            q[7:] = np.where(movable[6:], rng.uniform(self.lower, self.upper), self.home[7:])
            self.descend(q, self.lower, self.upper, movable, rows)
            least = min(least, float(np.linalg.norm(rows()[0])) / 10)
            is_missed = (k >= 3 and least > 0.1) or (k >= 11 and least > 0.02)
            if least < 1e-3 or is_missed:
                break
        return least

    def inside(self, ball: Array) -> bool:
        """Return whether a body part, arms excepted, contains a ball.

        The rays in both directions from inside meet one convex shape.
        """
        self.set_pose(self.home)
        direction = np.array([0.36, 0.48, 0.8])
        for geom in self.shapes:
            parts = ("clavicle", "arm", "hand", "shoulder")
            if any(part in self.body[geom] for part in parts):
                continue
            size = self.model.geom_size[geom]
            kind = int(self.model.geom_type[geom])
            position = self.data.geom_xpos[geom]
            rotation = np.ascontiguousarray(self.data.geom_xmat[geom])
            distances = [
                mujoco.mju_rayGeom(position, rotation, size, ball, direction * sign, kind)
                for sign in (1, -1)
            ]
            if min(distances) >= 0.0:
                return True
        return False

    def label(self, ball: Array, starts: int = STARTS, seed: int = 0) -> str:
        """Return the right decision for a ball, or ``border``."""
        if self.inside(ball):
            return "nothing"
        for kind in ("reach", "bend"):
            state = self.state(ball, kind, starts, seed)
            if state != "no":
                return kind if state == "yes" else BORDER
        state = self.jumps(ball, starts, seed)
        if state != "no":
            return "jump" if state == "yes" else BORDER
        return self.elsewhere(ball, starts, seed)

    def elsewhere(self, ball: Array, starts: int, seed: int) -> str:
        """Return ``walk`` if a ball of the same height has an action at some place."""
        places = [np.array([x, -0.2, ball[2]]) for x in (0.4, 0.5, 0.3)]
        for kind in ("reach", "bend"):
            if any(self.state(place, kind, 8, seed) == "yes" for place in places):
                return "walk"
        columns = [np.array([x, y, ball[2]]) for x in (0.0, 0.1, 0.2) for y in (-0.1, -0.2, -0.3)]
        error = min(self.column_error(place, "right", 16, seed, 0.04) for place in columns)
        if error < 1e-3:
            return "walk"
        return "nothing" if error > 0.01 else BORDER


def drawn_balls(count: int, seed: int) -> Iterator[tuple[int, Array]]:
    """Yield numbers and random balls."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        yield k, rng.uniform(LOWER, UPPER).round(4)


def digest(figure: Figure) -> str:
    """Return a digest of the model."""
    return hashlib.sha256(figure.robot.path.read_bytes()).hexdigest()[:16]


def main(count: int, seed: int, first: int = 0) -> None:
    """Print the judged balls as CSV."""
    figure = load_figure()
    judge = Judge(figure)
    command = f"python tests/figure/judge.py {count} {seed}"
    print(f"# {command}: model sha256 {digest(figure)}, {STARTS} starts")
    for k, ball in drawn_balls(count, seed):
        if k >= first:
            cells = [f"{x:g}" for x in ball]
            print(",".join([*cells, judge.label(ball, STARTS, seed + k)]), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
