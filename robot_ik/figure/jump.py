"""The jump: crouch, push, flight with the palm on the ball at the apex, landing.

The centre of mass goes by quintics up to take-off and from landing, and by the parabola between; forwards
it follows a zero-moment point from mid foot to the toes and back.  In flight there is no angular momentum.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import InvalidGoalError
from robot_ik.figure.actions import Motion, glance_time, placed_motion, to_stance
from robot_ik.figure.balance import monotone_curve, quintic, smooth, zero_moment_slices
from robot_ik.figure.figure import DT, GRAVITY, SIDES, Figure, in_stance_frame, once_each
from robot_ik.figure.frames import FrameRows, Frames, Slices, at_once
from robot_ik.figure.gait import AIR, FLAT, TOE
from robot_ik.figure.poses import STIFF, touches_itself
from robot_ik.geometry import axis_rotations
from robot_ik.kernels.whole_body import HARD
from robot_ik.motion.timing import minimum_jerk
from robot_ik.ports import Array

TAKE_OFF = 2.6
"""Fastest take-off of the centre of mass, m/s: trained men without run-up reach 2.4 to 2.9 (Bobbert et al.
1996)."""
_CROUCH, _READY, _STRETCH, _CALM = 0.18, 0.02, 0.015, 0.4
"""How far the centre goes down before the push; how much lower than home it waits, for straight knees hold no
height; what is left of the legs at take-off; m; and how long the body takes to turn upright after landing,
s."""
_PITCH_DEG, _LANDED, _ABSORB = 50.0, 0.85, 0.7
"""Sole at take-off, and the share of it at landing; depth of the landing as a share of the push: deeper,
ankles reach their limit before the heels are down."""
_TUCK = 0.02
"""How far the feet are drawn up in flight, m: feet drawn up, and an idle arm held up, leave the acting one
less high over the centre of mass."""
_LEAST = 1.7
"""A jump is no slower than this, m/s: a shorter flight leaves the arm no time; a lower ball is taken with
a bent arm."""
_FINE = 0.002
_CORRECTIONS = 3
"""Rounds of the dynamics filter."""
_EARLY, _LEFT = 0.12, 0.9
"""The arms swing forwards so long before the push, s, and have so far to go at take-off, rad."""
_HEELS = 0.6
"""Share of the absorption after which the heels are down."""
_PULL, _YIELD, _LEAN = 6.7, 3.0, 0.5
"""Powers of ten at the apex: by which the hand's weight has grown, and by which the feet and the trunk give
way: a ball at the rim needs a body that leans."""
_AFTER_TAKE_OFF, _BEFORE_LANDING = 0.08, 0.12
"""Parts of the flight in which the feet are held, s."""
_SOFT, _TIED, _TYING, _LOOSING = 0.04, 2.0, 0.15, 0.1
"""What is free in a frame is tied to its neighbours, else legs and spine whip about the apex: rounds after
the first are drawn in flight to the frames of the round before, smoothed over so long, s, and so strongly,
more and more in so long before take-off, s, and less and less in so long before landing, s."""
_WAYS = (0.0, 0.0), (0.35, 0.0), (0.35, 0.5), (0.35, 0.9)
"""Abduction of the other arm, rad, and by how much faster it jumps, m/s, so that the acting arm need
not stretch over the head: the next of these where bodies touch."""
_MIDDLE = 0.01
"""Where the weight stands at rest, m before the ankles: hips back, so that the heels stay down in the
crouch."""


@dataclass(frozen=True, eq=False)
class JumpPlan:
    """Times and heights of a jump, all in closed form."""

    figure: Figure = field(repr=False)
    ready: Array = field(repr=False)
    ball: Array
    arm: str
    speed: float  # of the centre of mass at take-off, m/s
    wait: float  # height of the centre at first, m
    low: float  # in the crouch
    high: float  # at take-off
    landed: float  # when the landing is absorbed
    ends: Array  # of waiting, crouch, push, flight, absorption and rising, s
    rising: float  # from when on before take-off the heels rise, s
    abduction: float  # of the other arm from the trunk in flight, rad

    @property
    def flight(self) -> float:
        """Time in the air, s."""
        return 2 * self.speed / GRAVITY

    @property
    def apex(self) -> float:
        """Time of the apex, s."""
        return float(self.ends[2]) + self.flight / 2

    def height(self, t: Array) -> Array:
        """(n,) height of the centre of mass."""
        n, v = np.array, self.speed
        d, e = self.high - self.low, self.high - self.landed
        push, absorb = 1.5 * v * v / (2 * d), 1.35 * v * v / (2 * e)
        spans = np.diff(np.concatenate([[0.0], self.ends]))
        rest = (n(self.wait), n(0.0), n(0.0))
        pieces = [
            quintic(*rest, *rest, spans[0]),
            quintic(*rest, n(self.low), n(0.0), n(push), spans[1]),
            quintic(n(self.low), n(0.0), n(push), n(self.high), n(v), n(-GRAVITY), spans[2]),
            np.array([0.0, 0.0, 0.0, -GRAVITY / 2, v, self.high]),
            quintic(n(self.high), n(-v), n(-GRAVITY), n(self.landed), n(0.0), n(absorb), spans[4]),
            quintic(n(self.landed), n(0.0), n(absorb), *rest, spans[5]),
            quintic(*rest, *rest, 1.0),
        ]
        starts = np.concatenate([[0.0], self.ends])
        which = np.clip(np.searchsorted(self.ends, t, side="left"), 0, 6)
        return np.array([np.polyval(pieces[k], u - starts[k]) for k, u in zip(which, t, strict=True)])


def highest_take_off(figure: Figure) -> float:
    """Height of the centre of mass at take-off: legs all but straight, heels up, m."""
    wait = float(figure.center(figure.home)[2]) - _READY
    return wait + float(figure.feet["left"].sole.stand(np.radians(_PITCH_DEG))[1]) - _STRETCH


@once_each
def forward_at_take_off(figure: Figure) -> float:
    """How far before the middle of the feet the centre of mass takes off, m, in a jump of middling height."""
    plan = plan_jump(figure, np.array([0.1, 0.0, 0.0]), next(iter(figure.hands)), 2.0)
    return float(_forward(plan, np.array([plan.apex]))[0][0])


def plan_jump(figure: Figure, ball: Array, arm: str, speed: float, abduction: float = 0.0) -> JumpPlan:
    """A jump of a figure at home in its own frame with that speed at take-off, m/s.

    Raises:
        InvalidGoalError: Faster than a man jumps.
    """
    if not 0.0 < speed <= TAKE_OFF:
        raise InvalidGoalError(
            f"the ball at {ball[2]:.2f} m needs {speed:.2f} m/s at take-off, more than {TAKE_OFF} m/s",
            hint="a lower ball",
        )
    speed = max(speed, _LEAST)
    ready = _ready(figure)
    wait = float(figure.center(ready)[2])
    high = highest_take_off(figure) + wait - float(figure.center(figure.home)[2]) + _READY
    crouch = _CROUCH * float(np.clip(speed / 2.0, 0.5, 1.0))
    low, d = wait - crouch, high - wait + crouch
    landed = high - _ABSORB * d
    push, flight, absorb = 1.84 * d / speed, 2 * speed / GRAVITY, 1.76 * d / speed
    brake = 1.35 * speed**2 / (2 * (high - landed))
    rise = min(0.7, float(np.sqrt(17 * (wait - landed) / brake)))  # longer overshoots: a0 <= 20 d / T²
    ends = np.cumsum([0.45, 0.5, push, flight, absorb, rise])
    return JumpPlan(figure, ready, ball, arm, speed, wait, low, high, landed, ends, 0.7 * push, abduction)


@once_each
def _ready(figure: Figure) -> Array:
    """Standing with slightly bent knees."""
    rows = FrameRows(figure, 12)
    home = figure.home
    rows.feet(figure.feet_at_home)
    center = figure.center(home)
    share = minimum_jerk(np.linspace(0.1, 1, 12))[:, None]
    goal = np.array([_MIDDLE, 0.0, center[2] - _READY])
    rows.center(center + (goal - center) * share)
    rows.orientation(figure.trunk, np.eye(3), 40.0)
    return rows.solve(home, figure.stiffnesses(STIFF), home, speeds=None).q[-1]


def _forward(plan: JumpPlan, times: Array, error: tuple[Array, Array] | None = None) -> tuple[Array, Array]:
    """At ``times`` (n,) the centre of mass forwards, and the zero-moment point that moves it; (n,) each.

    x'' = ω² (x − p), ω² = (g + z'') / z: at rest at take-off, after landing and at the end.  p goes from mid
    foot to the toes and back, and bumps of it meet the end conditions, which are linear in their sizes.
    ``error``: times and what the whole body's zero-moment point was off by.
    """
    T, dt = plan.ends, _FINE
    t = np.arange(0, T[5] + 0.3, dt)
    z = plan.height(t)
    w2 = (np.gradient(np.gradient(z, dt), dt) + GRAVITY) / z
    off = np.zeros(len(t)) if error is None else np.interp(t, *error)
    sole = plan.figure.feet["left"].sole
    # On the toes when the heels are up: there is no other support.
    toe = sole.front + (0.02 if plan.figure.feet["left"].toes else -0.017)
    mid = _MIDDLE
    out = np.zeros(len(t))
    up, down, n = int(T[2] / dt), int(T[3] / dt), len(t)

    def bump(a: float, b: float) -> Array:
        return 64 * (np.clip((t - a) / (b - a), 0, 1) * np.clip((b - t) / (b - a), 0, 1)) ** 3

    def run(p: Array, x: float, i: int, j: int) -> tuple[float, float]:
        v = 0.0
        for k, (w, q) in enumerate(zip(w2[i:j].tolist(), p[i:j].tolist(), strict=True), start=i):
            out[k] = x
            v += w * (x - q) * dt
            x += v * dt
        return x, v

    p = mid + (toe - mid) * minimum_jerk((t - T[1]) / (T[2] - plan.rising * 0.7 - T[1])) - off
    b = bump(T[0], T[2] - plan.rising)
    v0, v1 = run(p, mid, 0, up)[1], run(p + b, mid, 0, up)[1]
    size = -v0 / (v1 - v0)
    x = run(p + size * b, mid, 0, up)[0]
    out[up:down] = x
    absorb = T[4] - T[3]
    s = minimum_jerk((t - T[3] - 0.7 * _HEELS * absorb) / (0.6 * _HEELS * absorb))
    early = bump(T[3] + 0.7 * _HEELS * absorb, T[5])
    after = lambda a, m: toe * (1 - s) + m * s + a * early - off  # noqa: E731
    residual = lambda a, m: np.array(run(after(a, m), x, down, n)) - [m, 0.0]  # noqa: E731
    r0 = residual(0.0, 0.0)
    sizes = np.linalg.solve(np.stack([residual(1.0, 0.0) - r0, residual(0.0, 1.0) - r0], axis=1), -r0)
    residual(*sizes)
    wanted = np.where(t < T[2], p + size * b, after(*sizes)) + off
    return np.interp(times, t, out), np.interp(times, t, wanted)


def _feet(plan: JumpPlan, t: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Pitch, height over the floor of the lowest point and contact of both feet."""
    up, down, absorb = plan.ends[2], plan.ends[3], plan.ends[4] - plan.ends[3]
    top = np.radians(_PITCH_DEG)
    air = (t > up) & (t < down)
    s = np.clip((t - up) / plan.flight, 0, 1)
    rising = top * minimum_jerk((t - up + plan.rising) / plan.rising)
    falling = _LANDED * top * (1 - minimum_jerk((t - down) / (_HEELS * absorb)))
    pitch = np.where(air, top * (1 - (1 - _LANDED) * minimum_jerk(s)), np.where(t <= up, rising, falling))
    tuck = _TUCK * min(1.0, (plan.speed / 2.2) ** 2) * 64 * (s * (1 - s)) ** 3
    lift = np.where(air, plan.height(t) - plan.high + tuck, 0.0)
    contact = np.where(air, AIR, np.where(pitch > 1e-4, TOE, FLAT))
    return pitch, lift, contact


def _arms(plan: JumpPlan, t: Array, top: Array) -> dict[str, Array]:
    """Angles of the arms: backwards in the crouch, forwards and up in the push; at the apex as ``top``."""
    figure, arm, T = plan.figure, plan.arm, plan.ends
    other = "left" if arm == "right" else "right"
    apex = (plan.apex - 0.05, plan.apex + 0.05)
    knots = np.array([0.0, T[1] - _EARLY, T[2] - 0.03, *apex, T[3] + 0.05, T[4] + 0.2, T[5] + 0.3])
    grid = np.arange(0.0, knots[-1] + 0.1, 0.005)

    def curve(values: list[float]) -> Array:
        return np.interp(t, grid, smooth(monotone_curve(knots, np.array(values), grid), 0.03 / 0.005))

    # An arm that rises in flight rotates the whole body: most of its motion is done before.
    elbow = {"elbow_pitch": [0.35, 0.7, 0.7, 0.6]}
    out: dict[str, Array] = {}
    for joint in figure.robot.joints:
        part = joint.removeprefix(f"{arm}_")
        if part != joint and any(k in part for k in ("shoulder", "elbow", "wrist", "clavicle")):
            a = figure.addresses(joint)[0]
            x0, x1 = float(figure.home[a]), float(top[a])
            w = elbow.get(part, [x0, x0 + 0.6 * (x1 - x0), x0 + 0.5 * (x1 - x0), x0])
            if part == "shoulder_pitch":
                w = [-0.3, x1 - _LEFT, x1 - 1.2 * _LEFT, 0.5]
            out[joint] = curve([x0, w[0], w[1], x1, x1, w[2], w[3], x0])
    out[f"{other}_shoulder_pitch"] = curve([0.02, -0.6, 1.1, 0.6, 0.6, 0.6, 0.5, 0.02])
    out[f"{other}_elbow_pitch"] = curve([0.3, 0.35, 0.7, 0.7, 0.7, 0.7, 0.6, 0.3])
    roll = f"{other}_shoulder_roll"
    if plan.abduction and roll in figure.robot.joints:
        out[roll] = figure.home[figure.addresses(roll)[0]] + curve([0.0, 0.0, *[plan.abduction] * 5, 0.0])
    return out


def _arm_at_apex(plan: JumpPlan, palm: Array) -> Slices[Array]:
    """(nq,) the arm's angles with the palm at its position beside the centre of mass, the trunk upright."""
    figure, arm = plan.figure, plan.arm
    q = figure.home
    raised = {f"{arm}_shoulder_pitch": 2.75, f"{arm}_elbow_pitch": 0.3, f"{arm}_clavicle_roll": 0.5}
    for _ in range(3):
        rows = FrameRows(figure, 8)
        hand, goal = figure.pose(q, figure.hands[arm])[0], figure.center(q) + palm
        rows.position(figure.hands[arm], hand + (goal - hand) * np.linspace(0.125, 1, 8)[:, None])
        rows.orientation(figure.trunk, np.eye(3))
        rows.center(figure.center(q))
        stiff = figure.stiffnesses(STIFF)
        frames = yield from rows.slices(figure.posture(raised), stiff, q, speeds=None, steps=20)
        q = frames.q[-1]
        yield
    return q


def _frames(
    plan: JumpPlan, x: Array, palm: Array, top: Array, t: Array, start: Array, before: Array | None
) -> Slices[tuple[Frames, NDArray[np.int64]]]:
    """Frames at times ``t`` (n,) with the centre of mass at ``x`` (n,) forwards; and the feet's contact."""
    figure, T = plan.figure, plan.ends
    n = len(t)
    pitch, lift, contact = _feet(plan, t)
    rows = FrameRows(figure, n)
    rolled, height = figure.feet["left"].sole.stand(pitch)
    air = contact == AIR
    # In the middle of the flight the feet give way before the centre of mass and the momentum do; where they
    # leave the floor and come back to it they are where the floor wants them.
    up, down = T[2] + _AFTER_TAKE_OFF, T[3] - _BEFORE_LANDING
    loose = (t > up) & (t < down)
    near_apex = minimum_jerk((t - up) / (plan.apex - up)) * minimum_jerk((down - t) / (down - plan.apex))
    standing = np.where(loose, 10.0 ** (3.5 - _YIELD * near_apex), HARD)
    poses = {}
    for side, foot in figure.feet.items():
        at = figure.pose(plan.ready, foot.frame)[0]
        position = np.column_stack([at[0] + rolled, np.full(n, at[1]), height + lift])
        poses[side] = position, axis_rotations("y", pitch)
    rows.feet(poses, standing)
    z = plan.height(t)
    center = np.column_stack([x, np.zeros(n), z])
    begin = minimum_jerk(t / T[0])[:, None]  # from where it stands
    was = figure.center(start)
    rows.center(was + (center - was) * begin)
    rows.momentum(np.where(air, HARD, 0.0))
    # Before and after the flight it comes and goes by and by: rows that are there at once snap the trunk.
    still = minimum_jerk((t - (T[1] + T[2]) / 2) / ((T[2] - T[1]) / 2)) * (t <= T[2])
    still = still + (1 - minimum_jerk((t - T[3]) / _CALM)) * (t >= T[3])
    rows.momentum(500.0 * still**2)
    deep = np.clip((plan.wait - (z - lift)) / 0.3, 0, 1.2)
    on_floor = 40.0 * minimum_jerk((t - T[3] + 1e9 * (t <= T[2])) / 0.4) + 4.0
    upright = np.where(air, 4.0 * 10.0 ** (-_LEAN * near_apex), on_floor)
    rows.orientation(figure.trunk, axis_rotations("y", np.radians(60.0) * deep), upright)
    if figure.gaze is not None:
        eyes, gaze = figure.pose(start, figure.gaze)
        seen = eyes + gaze[:, 0] * np.linalg.norm(plan.ball - eyes)
        within = min(max(0.6, glance_time(figure, start, plan.ball)), 1.0)  # before the push at the latest
        to = seen + (plan.ball - seen) * minimum_jerk(t / within)[:, None]
        rows.aim(to, 6.0)
    # The hand's weight grows by a constant factor a frame: a power of time would seize the arm within two.
    near = minimum_jerk((t - T[2] + 0.05) / (plan.apex - 0.01 - T[2] + 0.05))
    near = near * (1 - minimum_jerk((t - plan.apex - 0.01) / (T[3] - plan.apex)))
    rows.position(figure.hands[plan.arm], center + palm, 10.0 ** (_PULL * near - 3))
    posture = _posture(plan, t, deep, top, pitch, contact)
    posture = start + (posture - start) * begin
    stiff = figure.stiffnesses(STIFF | {"*shoulder*": 1.0, "*elbow*": 1.0, "*toe*": 1e5})
    if before is not None:
        posture, stiff = _tied(plan, t, smooth(before, _SOFT / DT), posture, stiff)
    frames = yield from rows.slices(posture, stiff, start, speeds="jump", steps=20)
    return frames, contact


def _tied(plan: JumpPlan, t: Array, drawn: Array, posture: Array, stiff: Array) -> tuple[Array, Array]:
    """(n, nq) posture and (n, nv) stiffness that give way in flight to a pull to frames ``drawn`` (n, nq)."""
    share = minimum_jerk((t - plan.ends[2]) / _TYING + 1.0) * minimum_jerk((plan.ends[3] - t) / _LOOSING)
    tied = plan.figure.stiffnesses({"*": _TIED, "*toe*": 0.0})
    # Two springs at a joint are one, between where they pull to and as strong as both.
    own = stiff * np.where(tied > 0.0, 1.0 - share[:, None], 1.0)
    both = own + share[:, None] * tied
    part = 1.0 - own[:, 6:] / both[:, 6:]
    return np.concatenate([posture[:, :7], posture[:, 7:] + part * (drawn - posture)[:, 7:]], axis=1), both


def _posture(
    plan: JumpPlan, t: Array, deep: Array, top: Array, pitch: Array, contact: NDArray[np.int64]
) -> Array:
    figure = plan.figure
    bent = {"hip_pitch": 0.06 + 1.2 * deep, "knee_pitch": 0.12 + 1.5 * deep, "ankle_pitch": 0.06 + 0.4 * deep}
    level = pitch * np.where(t > plan.ends[3], 1.0, 1 - minimum_jerk((t - plan.ends[2]) / 0.3))
    back = minimum_jerk((t - plan.apex) / (plan.ends[3] - plan.apex))  # level again before they touch
    level = np.where(contact == AIR, np.maximum(level, pitch * back), level)
    moves = {f"{side}_{joint}": angle for side in SIDES for joint, angle in bent.items()}
    moves |= _arms(plan, t, top)
    out = figure.posture(moves, np.tile(figure.home, (len(t), 1)))
    for foot in figure.feet.values():
        if foot.toes is not None:
            out[:, foot.toes[0]] = level
    return out


def jump_slices(
    figure: Figure, q: Array, ball: Array, arm: str = "right", speed: float = 2.0
) -> Slices[Motion]:
    """The palm on a ball overhead, at the apex; from a stance at home to one where it stood.

    Args:
        figure: Who jumps.
        q: (nq,) standing near home.
        ball: (3,) in the world.
        arm: Which hand.
        speed: At take-off, m/s (``Abilities.take_off`` knows it); more where bodies would touch.

    Raises:
        InvalidGoalError: Faster than a man jumps.
    """
    start, stance = to_stance(figure, q)
    ball = in_stance_frame(stance, np.asarray(ball, dtype=float))
    found: Motion | None = None
    ways = ((max(speed, min(speed + more, TAKE_OFF)), abduction) for abduction, more in _WAYS)
    for faster, abduction in dict.fromkeys(ways):  # near the fastest take-off some are the same
        motion = yield from _motion(plan_jump(figure, ball, arm, faster, abduction), start)
        found = found or motion
        if not touches_itself(figure, motion.q):
            found = motion
            break
        yield
    if found is None:
        raise RuntimeError("no way to jump was tried")
    return placed_motion(figure, found, stance)


jump = at_once(jump_slices)


def _motion(plan: JumpPlan, start: Array) -> Slices[Motion]:
    """The jump from a stance at the origin."""
    figure = plan.figure
    # A frame at the apex: the moment of the touch.
    t = np.arange(1, int((plan.ends[5] + 0.3) / DT) + 1) * DT
    t = t + (plan.apex - t[np.abs(t - plan.apex).argmin()])
    error: tuple[Array, Array] | None = None
    before: Array | None = None
    for k in range(_CORRECTIONS + 1):
        x, p = _forward(plan, t, error)
        # The ball seen from the centre of mass at the apex.
        palm = plan.ball - [np.interp(plan.apex, t, x), 0.0, plan.height(np.array([plan.apex]))[0]]
        yield
        if k == 0:  # the palm moves by millimetres afterwards: its own row sees to that
            top = yield from _arm_at_apex(plan, palm)
        frames, contact = yield from _frames(plan, x, palm, top, t, start, before)
        if k == _CORRECTIONS:
            break
        before = frames.q
        points, force = yield from zero_moment_slices(figure, frames.q)
        held = (contact != AIR) & (force > 0.42 * figure.mass * GRAVITY)
        off = np.where(held, np.clip(points[:, 0] - p, -0.25, 0.25), 0.0)
        off[:2], off[-2:] = 0.0, 0.0
        off = smooth(off, 0.02 / DT)
        error = (t, off if error is None else error[1] + 0.7 * off)
    zmp = np.column_stack([p, np.zeros(len(t))])
    both = np.column_stack([contact, contact])
    free = (t > plan.ends[5] + 0.1) | (t < 0.2)
    return Motion("jump", frames.q, both, frames.error, zmp, free, "jump")
