"""Ground truth of "reach" and "bend": seeded random starts of damped Gauss-Newton on MuJoCo; nothing is
shared with the product.

A pose is admissible (figure.md f) when it is inside limits, both feet stand where they stood, the centre
of mass is over
the soles, the palm at the ball, no shape but the soles under the floor, and no body runs into another.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from robot_ik.figure.figure import Figure

Array = NDArray[np.float64]

UPRIGHT_DEG = {
    "knee_pitch": (0, 25),
    "hip_pitch": (-15, 30),
    "torso_pitch": (-10, 10),
    "pelvis_pitch": (-10, 10),
}


class Judge:
    """Asks for admissible poses of one model."""

    def __init__(self, figure: Figure) -> None:
        self.model, self.home = figure.model, figure.home
        self.data = mujoco.MjData(self.model)
        self.joints = [self.model.joint(j).name for j in range(1, self.model.njnt)]
        self.lower, self.upper = self.model.jnt_range[1:].T.copy()
        self.place(self.home)
        self.feet = {s: (self.site(f"{s}_foot")) for s in ("left", "right")}
        points = []
        for g in range(self.model.ngeom):
            name = self.model.body(self.model.geom_bodyid[g]).name
            if name.endswith(("_foot", "_toes")) and self.model.geom_contype[g]:
                points += self.lowest(g)
        self.hull = ConvexHull(np.array([p[:2] for p in points if p[2] < 0.003])).equations

    def place(self, q: Array) -> None:
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def site(self, name: str) -> tuple[Array, Array]:
        i = self.model.site(name).id
        return self.data.site_xpos[i].copy(), self.data.site_xmat[i].reshape(3, 3).copy()

    def lowest(self, g: int) -> list[Array]:
        """Low points of a geom: of boxes the corners, of capsules the ends, of ellipsoids the bottom."""
        at, turn = self.data.geom_xpos[g], self.data.geom_xmat[g].reshape(3, 3)
        size, kind = self.model.geom_size[g], self.model.geom_type[g]
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            return [at + turn @ (size * (2 * np.array(k) - 1)) for k in np.ndindex(2, 2, 2)]
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            return [at + turn[:, 2] * s * size[1] - [0, 0, size[0]] for s in (-1, 1)]
        if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            down = -turn[2]
            return [at + turn @ (size**2 * down / np.linalg.norm(size * down))]
        return [at - [0, 0, size[0]]]

    def over(self) -> float:
        """How far the centre of mass is inside the soles."""
        return float(-(self.hull[:, :2] @ self.data.subtree_com[0][:2] + self.hull[:, 2]).max())

    def admissible(self, q: Array, ball: Array, arm: str, near: float, inside: float) -> bool:
        self.place(q)
        for side, (place, turn) in self.feet.items():
            p, r = self.site(f"{side}_foot")
            if np.linalg.norm(p - place) > 2e-4 or np.arccos(min(1.0, (np.trace(r @ turn.T) - 1) / 2)) > 2e-3:
                return False
        if np.linalg.norm(self.site(f"{arm}_hand")[0] - ball) > near or self.over() < inside:
            return False
        for g in range(self.model.ngeom):
            name = self.model.body(self.model.geom_bodyid[g]).name
            touches = self.model.geom_contype[g] and not name.endswith(("_foot", "_toes"))
            if touches and min(p[2] for p in self.lowest(g)) < 0.0:
                return False
        mujoco.mj_forward(self.model, self.data)
        return all(self.data.contact[c].dist > -0.002 for c in range(self.data.ncon))

    def found(
        self, ball: Array, arm: str, kind: str, starts: int, seed: int, near: float, inside: float
    ) -> bool:
        rng = np.random.default_rng([seed, kind == "bend", arm == "left"])
        low, high = self.lower.copy(), self.upper.copy()
        if kind == "reach":
            for k, joint in enumerate(self.joints):
                for part, (a, b) in UPRIGHT_DEG.items():
                    if joint.endswith(part):
                        low[k], high[k] = max(low[k], np.radians(a)), min(high[k], np.radians(b))
        for _ in range(starts):
            q = self.solve(ball, arm, kind, low, high, rng, inside)
            if self.admissible(q, ball, arm, near, inside):
                return True
        return False

    def solve(
        self,
        ball: Array,
        arm: str,
        kind: str,
        low: Array,
        high: Array,
        rng: np.random.Generator,
        inside: float,
    ) -> Array:
        """Damped Gauss-Newton from a random start; joints at a limit that push outwards are left out."""
        m, d, nv = self.model, self.data, self.model.nv
        spread = 0.25 if kind == "reach" else 0.5
        bend = rng.uniform(0, 1) if kind == "bend" else 0.0
        squat = m.key("squat").qpos
        q = self.home.copy()
        q[2] += bend * (squat[2] - self.home[2])
        middle = self.home[7:] + bend * (squat[7:] - self.home[7:])
        q[7:] = np.clip(middle + spread * rng.normal(size=nv - 6), low, high)
        rest, damping, best = q[7:].copy(), 1e-2, np.inf
        jp, jr, jc = np.zeros((3, nv)), np.zeros((3, nv)), np.zeros((3, nv))

        def rows() -> tuple[Array, Array]:
            out, jac = [], []
            for side, (place, turn) in self.feet.items():
                i = m.site(f"{side}_foot").id
                p, r = self.site(f"{side}_foot")
                mujoco.mj_jacSite(m, d, jp, jr, i)
                e = turn @ r.T
                out += [
                    10 * (place - p),
                    2.5 * np.array([e[2, 1] - e[1, 2], e[0, 2] - e[2, 0], e[1, 0] - e[0, 1]]),
                ]
                jac += [10 * jp.copy(), 5 * jr.copy()]
            mujoco.mj_jacSite(m, d, jp, jr, m.site(f"{arm}_hand").id)
            out.append(10 * (ball - self.site(f"{arm}_hand")[0]))
            jac.append(10 * jp.copy())
            mujoco.mj_jacSubtreeCom(m, d, jc, 0)
            over = self.hull[:, :2] @ d.subtree_com[0][:2] + self.hull[:, 2] + inside + 0.002
            out.append(-10 * np.maximum(over, 0.0))
            jac.append(10 * (over > 0)[:, None] * (self.hull[:, :2] @ jc[:2]))
            return np.concatenate(out), np.vstack(jac)

        self.place(q)
        e, jac = rows()
        for _ in range(80):
            weak = np.concatenate([np.zeros(6), 2e-3 * (rest - q[7:])])
            step = np.zeros(nv)
            free = np.ones(nv, dtype=bool)
            for _ in range(3):
                a = jac[:, free]
                step[:] = 0.0
                step[free] = np.linalg.solve(
                    a.T @ a + (damping + 2e-3) * np.eye(free.sum()), a.T @ e + weak[free]
                )
                out = np.concatenate(
                    [np.zeros(6, dtype=bool), (q[7:] + step[6:] < low) | (q[7:] + step[6:] > high)]
                )
                if not (out & free).any():
                    break
                free &= ~out
            new = q.copy()
            mujoco.mj_integratePos(m, new, step, 1.0)
            new[7:] = np.clip(new[7:], low, high)
            self.place(new)
            after, slope = rows()
            if after @ after < e @ e:
                q, e, jac, damping = new, after, slope, max(damping / 3, 1e-7)
                if abs(best - e @ e) < 1e-12 and e @ e < 1e-8:
                    break
                best = float(e @ e)
            else:
                damping *= 4
                if damping > 1e3:
                    break
        return q

    def label(self, ball: Array, starts: int, seed: int) -> str | None:
        """``reach``, ``bend``, ``neither``; None where another margin gives another answer (a border
        case)."""
        answers = set()
        for near, inside in ((0.005, 0.010), (0.015, 0.0)):
            answer = "neither"
            for kind in ("reach", "bend"):
                if any(self.found(ball, arm, kind, starts, seed, near, inside) for arm in ("right", "left")):
                    answer = kind
                    break
            answers.add(answer)
        return answers.pop() if len(answers) == 1 else None
