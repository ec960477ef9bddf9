"""The jump: crouch, push, flight with the palm at the ball at the apex, and landing.

The centre of mass follows quintics until take-off and from landing on, and a parabola between. It
moves forwards after a zero-moment point that goes from mid foot to the toes and back. In flight the
angular momentum is zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import InvalidGoalError
from robot_ik.figure.actions import Motion, glance_time, placed_motion, to_stance_frame
from robot_ik.figure.balance import zero_moment_points
from robot_ik.figure.curves import monotone_curve, quintic, smooth
from robot_ik.figure.figure import (
    DT,
    GRAVITY,
    SIDES,
    Figure,
    cached_per_figure,
    in_stance_frame,
)
from robot_ik.figure.frames import FrameRows, Frames
from robot_ik.figure.gait import AIR, FLAT, TOE
from robot_ik.figure.poses import STIFFNESS, touches_itself
from robot_ik.geometry import axis_rotations
from robot_ik.kernels.whole_body import HARD
from robot_ik.motion.timing import minimum_jerk
from robot_ik.ports import Array


@dataclass(frozen=True)
class JumpOptions:
    """Parameters of a jump. Lengths in m, times in s.

    Attributes:
        fastest: Largest speed of the centre of mass at take-off, m/s. Trained men without run-up
            reach 2.4 to 2.9 (Bobbert et al. 1996).
        slowest: Smallest speed at take-off, m/s. A shorter flight is too short for the arm. A lower
            ball is reached with a bent arm.
        crouch: Depth of the crouch below the waiting height.
        ready_depth: Depth of the waiting height below home. Straight knees cannot hold a height.
        leg_reserve: Length by which the legs could still stretch at take-off.
        ankle_distance: Position of the weight at rest, in front of the ankles. The hips are
            behind, so that the heels stay on the floor in the crouch.
        sole_deg: Pitch of the sole at take-off, degrees.
        landing_pitch: Pitch of the sole at landing, as a share of that at take-off.
        landing_depth: Depth of the landing as a share of the push. In a deeper landing the ankles
            reach their limits before the heels are on the floor.
        heels_down: Share of the landing after which the heels are on the floor.
        calm: Time in which the trunk turns upright after landing.
        wait_time: Duration of the transition to the waiting height.
        crouch_time: Duration of the crouch.
        rise_time: Longest duration of the rise after landing.
        stand_time: Time at rest after the rise.
        heel_rise: Share of the push before take-off in which the heels rise.
        tuck: Height by which the feet are drawn up in flight. Feet drawn up lower the acting arm
            relative to the centre of mass.
        foot_hold_after: Time after take-off in which the feet are held.
        foot_hold_before: Time before landing in which the feet are held.
        swing_early: Time before the push at which the arms begin to swing forwards.
        swing_left: Remaining angle of the swing of the arms at take-off, rad.
        hand_decades: Powers of ten by which the weight of the hand grows until the apex.
        foot_decades: Powers of ten by which the weight of the feet falls until the apex. A body
            that reaches a ball at the rim leans.
        trunk_decades: Powers of ten by which the weight of the trunk falls until the apex.
        corrections: Rounds in which the dynamics of the whole body correct the motion.
        time_step: Time step of the integration of the centre of mass.
        largest_error: Largest error of the zero-moment point that one round corrects.
        feedback: Share of the error that later rounds correct.
        error_time: Time over which errors of the zero-moment point are smoothed.
        loaded: Share of the weight above which a zero-moment point counts.
        tie_smooth: Rounds after the first are pulled in flight to the frames of the previous round,
            smoothed over this time. Without it legs and spine move abruptly near the apex.
        tie_stiffness: Stiffness of that pull.
        tie_begin: Time before take-off in which the pull grows.
        tie_end: Time before landing in which the pull fades.
        variants: (abduction of the other arm in rad, additional speed in m/s). The next variant is
            tried if bodies touch: the acting arm then need not stretch over the head.
        gaze_weight: Weight of the gaze.
    """

    fastest: float = 2.6
    slowest: float = 1.7
    crouch: float = 0.18
    ready_depth: float = 0.02
    leg_reserve: float = 0.015
    ankle_distance: float = 0.01
    sole_deg: float = 50.0
    landing_pitch: float = 0.85
    landing_depth: float = 0.7
    heels_down: float = 0.6
    calm: float = 0.4
    wait_time: float = 0.45
    crouch_time: float = 0.5
    rise_time: float = 0.7
    stand_time: float = 0.3
    heel_rise: float = 0.7
    tuck: float = 0.02
    foot_hold_after: float = 0.08
    foot_hold_before: float = 0.12
    swing_early: float = 0.12
    swing_left: float = 0.9
    hand_decades: float = 6.7
    foot_decades: float = 3.0
    trunk_decades: float = 0.5
    corrections: int = 3
    time_step: float = 0.002
    largest_error: float = 0.25
    feedback: float = 0.7
    error_time: float = 0.02
    loaded: float = 0.42
    tie_smooth: float = 0.04
    tie_stiffness: float = 2.0
    tie_begin: float = 0.15
    tie_end: float = 0.1
    variants: tuple[tuple[float, float], ...] = ((0.0, 0.0), (0.35, 0.0), (0.35, 0.5), (0.35, 0.9))
    gaze_weight: float = 6.0


JUMPING = JumpOptions()
"""The parameters of all jumps."""

_MAX_STEPS = 20
"""Largest number of solver steps per frame."""


@dataclass(frozen=True, eq=False)
class JumpPlan:
    """Times and heights of a jump, in closed form. The figure stands at the origin.

    Attributes:
        figure: The figure.
        ready: (nq,) pose in which it waits.
        ball: (3,) the ball.
        arm: Side of the acting hand.
        speed: Speed of the centre of mass at take-off, m/s.
        wait: Height of the centre of mass at the waiting height, m.
        low: Height in the crouch, m.
        high: Height at take-off, m.
        landed: Height at the end of the landing, m.
        ends: (6,) end of waiting, crouch, push, flight, landing and rise, s.
        heel_time: Time before take-off in which the heels rise, s.
        abduction: Angle of the other arm away from the trunk in flight, rad.
    """

    figure: Figure = field(repr=False)
    ready: Array = field(repr=False)
    ball: Array
    arm: str
    speed: float
    wait: float
    low: float
    high: float
    landed: float
    ends: Array
    heel_time: float
    abduction: float

    @property
    def push_start(self) -> float:
        """End of the crouch, s."""
        return float(self.ends[1])

    @property
    def take_off(self) -> float:
        """Time of take-off, s."""
        return float(self.ends[2])

    @property
    def landing(self) -> float:
        """Time at which the feet meet the floor, s."""
        return float(self.ends[3])

    @property
    def landed_time(self) -> float:
        """End of the landing, s."""
        return float(self.ends[4])

    @property
    def end(self) -> float:
        """End of the rise, s."""
        return float(self.ends[5])

    @property
    def flight(self) -> float:
        """Time in the air, s."""
        return 2 * self.speed / GRAVITY

    @property
    def apex(self) -> float:
        """Time of the apex, s."""
        return self.take_off + self.flight / 2

    def height(self, t: Array) -> Array:
        """Return heights (n,) of the centre of mass at times ``t`` (n,)."""
        number = np.array
        rest = (number(self.wait), number(0.0), number(0.0))
        speed = self.speed
        push = 1.5 * speed * speed / (2 * (self.high - self.low))
        brake = 1.35 * speed * speed / (2 * (self.high - self.landed))
        low = (number(self.low), number(0.0), number(push))
        take_off = (number(self.high), number(speed), number(-GRAVITY))
        touch_down = (number(self.high), number(-speed), number(-GRAVITY))
        landed = (number(self.landed), number(0.0), number(brake))
        starts = np.concatenate([[0.0], self.ends])
        spans = np.diff(starts)
        pieces = [
            quintic(*rest, *rest, spans[0]),
            quintic(*rest, *low, spans[1]),
            quintic(*low, *take_off, spans[2]),
            np.array([0.0, 0.0, 0.0, -GRAVITY / 2, speed, self.high]),
            quintic(*touch_down, *landed, spans[4]),
            quintic(*landed, *rest, spans[5]),
            quintic(*rest, *rest, 1.0),
        ]
        numbers = np.clip(np.searchsorted(self.ends, t, side="left"), 0, 6)
        return np.array(
            [np.polyval(pieces[k], time - starts[k]) for k, time in zip(numbers, t, strict=True)]
        )


def highest_take_off(figure: Figure) -> float:
    """Return the height of the centre of mass at take-off, legs nearly straight and heels up, m."""
    wait = float(figure.center(figure.home)[2]) - JUMPING.ready_depth
    _, sole_height = figure.feet["left"].sole.stand(np.radians(JUMPING.sole_deg))
    return wait + float(sole_height) - JUMPING.leg_reserve


@cached_per_figure
def forward_at_take_off(figure: Figure) -> float:
    """Return the distance of the centre of mass at take-off in front of the feet's middle, m.

    It is computed for a jump of medium height.
    """
    plan = plan_jump(figure, np.array([0.1, 0.0, 0.0]), next(iter(figure.hands)), 2.0)
    return float(_forward_motion(plan, np.array([plan.apex]))[0][0])


def plan_jump(
    figure: Figure, ball: Array, arm: str, speed: float, abduction: float = 0.0
) -> JumpPlan:
    """Return the plan of a jump of a figure at the origin.

    Args:
        figure: The figure.
        ball: (3,) the ball.
        arm: Side of the acting hand.
        speed: Speed of the centre of mass at take-off, m/s.
        abduction: Angle of the other arm away from the trunk in flight, rad.

    Raises:
        InvalidGoalError: The speed is larger than that of the fastest jump.
    """
    if not 0.0 < speed <= JUMPING.fastest:
        raise InvalidGoalError(
            f"the ball at {ball[2]:.2f} m needs {speed:.2f} m/s at take-off, more than "
            f"{JUMPING.fastest} m/s",
            hint="use a lower ball",
        )
    speed = max(speed, JUMPING.slowest)
    ready = _ready_pose(figure)
    wait = float(figure.center(ready)[2])
    home_height = float(figure.center(figure.home)[2])
    high = highest_take_off(figure) + wait - home_height + JUMPING.ready_depth
    crouch = JUMPING.crouch * float(np.clip(speed / 2.0, 0.5, 1.0))
    travel = high - wait + crouch
    landed = high - JUMPING.landing_depth * travel
    push = 1.84 * travel / speed
    flight = 2 * speed / GRAVITY
    landing = 1.76 * travel / speed
    brake = 1.35 * speed**2 / (2 * (high - landed))
    # A longer rise overshoots: the acceleration may be at most 20 times the way / T².
    rise = min(JUMPING.rise_time, float(np.sqrt(17 * (wait - landed) / brake)))
    return JumpPlan(
        figure=figure,
        ready=ready,
        ball=ball,
        arm=arm,
        speed=speed,
        wait=wait,
        low=wait - crouch,
        high=high,
        landed=landed,
        ends=np.cumsum([JUMPING.wait_time, JUMPING.crouch_time, push, flight, landing, rise]),
        heel_time=JUMPING.heel_rise * push,
        abduction=abduction,
    )


@cached_per_figure
def _ready_pose(figure: Figure) -> Array:
    """Return the pose (nq,) of standing with slightly bent knees."""
    frames = 12
    rows = FrameRows(figure, frames)
    home = figure.home
    rows.feet(figure.feet_at_home)
    center = figure.center(home)
    share = minimum_jerk(np.linspace(0.1, 1, frames))[:, None]
    goal = np.array([JUMPING.ankle_distance, 0.0, center[2] - JUMPING.ready_depth])
    rows.center(center + (goal - center) * share)
    rows.orientation(figure.trunk, np.eye(3), 40.0)
    return rows.solve(home, figure.stiffnesses(STIFFNESS), home, speeds=None).q[-1]


def _forward_motion(
    plan: JumpPlan, times: Array, error: tuple[Array, Array] | None = None
) -> tuple[Array, Array]:
    """Return the forward position of the centre of mass and its zero-moment point.

    They follow x'' = ω² (x − p) with ω² = (g + z'') / z, at rest at take-off, after landing and at
    the end. The point p goes from mid foot to the toes and back. Bumps of p meet the conditions at
    the ends, which are linear in the sizes of the bumps.

    Args:
        plan: The plan of the jump.
        times: (n,) times, s.
        error: Times (k,), and errors (k,) of the zero-moment point of the whole body at them.

    Returns:
        Two arrays (n,), m.
    """
    dt = JUMPING.time_step
    t = np.arange(0, plan.end + 0.3, dt)
    z = plan.height(t)
    omega2 = (np.gradient(np.gradient(z, dt), dt) + GRAVITY) / z
    correction = np.zeros(len(t)) if error is None else np.interp(t, *error)

    # With the heels up the toes are the only support.
    left_foot = plan.figure.feet["left"]
    toe = left_foot.sole.front + (0.02 if left_foot.toes else -0.017)
    middle = JUMPING.ankle_distance
    position = np.zeros(len(t))
    take_off = int(plan.take_off / dt)
    landing = int(plan.landing / dt)
    count = len(t)

    def bump(start: float, end: float) -> Array:
        rising = np.clip((t - start) / (end - start), 0, 1)
        falling = np.clip((end - t) / (end - start), 0, 1)
        return 64 * (rising * falling) ** 3

    def integrate(p: Array, x: float, first: int, end: int) -> tuple[float, float]:
        """Write positions from ``first`` to ``end``; return the last position and speed."""
        speed = 0.0
        pairs = zip(omega2[first:end].tolist(), p[first:end].tolist(), strict=True)
        for k, (w, point) in enumerate(pairs, start=first):
            position[k] = x
            speed += w * (x - point) * dt
            x += speed * dt
        return x, speed

    # Until take-off one bump brings the speed to zero.
    roll_time = plan.take_off - plan.heel_time * 0.7 - plan.push_start
    p = middle + (toe - middle) * minimum_jerk((t - plan.push_start) / roll_time) - correction
    push_bump = bump(float(plan.ends[0]), plan.take_off - plan.heel_time)
    _, speed_without = integrate(p, middle, 0, take_off)
    _, speed_with = integrate(p + push_bump, middle, 0, take_off)
    size = -speed_without / (speed_with - speed_without)
    x, _ = integrate(p + size * push_bump, middle, 0, take_off)
    position[take_off:landing] = x

    # From landing on a bump and the end point bring position and speed to rest.
    heel_time = JUMPING.heels_down * (plan.landed_time - plan.landing)
    s = minimum_jerk((t - plan.landing - 0.7 * heel_time) / (0.6 * heel_time))
    landing_bump = bump(plan.landing + 0.7 * heel_time, plan.end)

    def after_landing(bump_size: float, end_point: float) -> Array:
        return toe * (1 - s) + end_point * s + bump_size * landing_bump - correction

    def residual(bump_size: float, end_point: float) -> Array:
        reached = integrate(after_landing(bump_size, end_point), x, landing, count)
        return np.array(reached) - [end_point, 0.0]

    without = residual(0.0, 0.0)
    columns = [residual(1.0, 0.0) - without, residual(0.0, 1.0) - without]
    bump_size, end_point = np.linalg.solve(np.stack(columns, axis=1), -without)
    residual(bump_size, end_point)
    is_before = t < plan.take_off
    points = np.where(is_before, p + size * push_bump, after_landing(bump_size, end_point))
    return np.interp(times, t, position), np.interp(times, t, points + correction)


def _foot_motion(plan: JumpPlan, t: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return pitch (n,), height (n,) of the lowest point above the floor and contact (n,)."""
    top = np.radians(JUMPING.sole_deg)
    share = JUMPING.landing_pitch
    in_air = (t > plan.take_off) & (t < plan.landing)
    s = np.clip((t - plan.take_off) / plan.flight, 0, 1)
    rising = top * minimum_jerk((t - plan.take_off + plan.heel_time) / plan.heel_time)
    heel_time = JUMPING.heels_down * (plan.landed_time - plan.landing)
    falling = share * top * (1 - minimum_jerk((t - plan.landing) / heel_time))
    flying = top * (1 - (1 - share) * minimum_jerk(s))
    pitch = np.where(in_air, flying, np.where(t <= plan.take_off, rising, falling))
    tuck = JUMPING.tuck * min(1.0, (plan.speed / 2.2) ** 2) * 64 * (s * (1 - s)) ** 3
    lift = np.where(in_air, plan.height(t) - plan.high + tuck, 0.0)
    contact = np.where(in_air, AIR, np.where(pitch > 1e-4, TOE, FLAT))
    return pitch, lift, contact


def _arm_angles(plan: JumpPlan, t: Array, top: Array) -> dict[str, Array]:
    """Return angles (n,) of the arms' joints by name.

    The arms go backwards in the crouch, and forwards and up in the push. An arm that rises in
    flight rotates the whole body, so most of its motion comes before.

    Args:
        plan: The plan of the jump.
        t: (n,) times, s.
        top: (nq,) pose of the acting arm at the apex.
    """
    figure = plan.figure
    other = "left" if plan.arm == "right" else "right"
    knots = np.array(
        [
            0.0,
            plan.push_start - JUMPING.swing_early,
            plan.take_off - 0.03,
            plan.apex - 0.05,
            plan.apex + 0.05,
            plan.landing + 0.05,
            plan.landed_time + 0.2,
            plan.end + 0.3,
        ]
    )
    grid = np.arange(0.0, knots[-1] + 0.1, 0.005)

    def curve(values: list[float]) -> Array:
        through_knots = monotone_curve(knots, np.array(values), grid)
        return np.interp(t, grid, smooth(through_knots, 0.03 / 0.005))

    angles: dict[str, Array] = {}
    for joint in figure.robot.joints:
        part = joint.removeprefix(f"{plan.arm}_")
        if part == joint or not any(
            name in part for name in ("shoulder", "elbow", "wrist", "clavicle")
        ):
            continue
        address = figure.addresses(joint)[0]
        home = float(figure.home[address])
        apex = float(top[address])
        # Values in the crouch, in the push, on the way down and after landing.
        middle = [home, home + 0.6 * (apex - home), home + 0.5 * (apex - home), home]
        if part == "elbow_pitch":
            middle = [0.35, 0.7, 0.7, 0.6]
        elif part == "shoulder_pitch":
            swing_left = JUMPING.swing_left
            middle = [-0.3, apex - swing_left, apex - 1.2 * swing_left, 0.5]
        angles[joint] = curve([home, *middle[:2], apex, apex, *middle[2:], home])
    swing = [0.02, -0.6, 1.1, 0.6, 0.6, 0.6, 0.5, 0.02]
    angles[f"{other}_shoulder_pitch"] = curve(swing)
    angles[f"{other}_elbow_pitch"] = curve([0.3, 0.35, 0.7, 0.7, 0.7, 0.7, 0.6, 0.3])
    roll = f"{other}_shoulder_roll"
    if plan.abduction and roll in figure.robot.joints:
        aside = curve([0.0, 0.0, *[plan.abduction] * 5, 0.0])
        angles[roll] = figure.home[figure.addresses(roll)[0]] + aside
    return angles


def _arm_at_apex(plan: JumpPlan, palm: Array) -> Array:
    """Return a pose (nq,) with upright trunk and the palm at the apex.

    Args:
        plan: The plan of the jump.
        palm: (3,) position of the palm beside the centre of mass.
    """
    figure = plan.figure
    arm = plan.arm
    frames = 8
    q = figure.home
    raised = {
        f"{arm}_shoulder_pitch": 2.75,
        f"{arm}_elbow_pitch": 0.3,
        f"{arm}_clavicle_roll": 0.5,
    }
    share = np.linspace(0.125, 1, frames)[:, None]
    for _ in range(3):
        rows = FrameRows(figure, frames)
        hand = figure.pose(q, figure.hands[arm])[0]
        goal = figure.center(q) + palm
        rows.position(figure.hands[arm], hand + (goal - hand) * share)
        rows.orientation(figure.trunk, np.eye(3))
        rows.center(figure.center(q))
        stiffness = figure.stiffnesses(STIFFNESS)
        solved = rows.solve(figure.posture(raised), stiffness, q, speeds=None, max_steps=_MAX_STEPS)
        q = solved.q[-1]
    return q


def _solve(
    plan: JumpPlan,
    x: Array,
    palm: Array,
    top: Array,
    t: Array,
    start: Array,
    before: Array | None,
) -> tuple[Frames, NDArray[np.int64]]:
    """Return the frames of a jump and the contact (n,) of both feet.

    Args:
        plan: The plan of the jump.
        x: (n,) forward position of the centre of mass.
        palm: (3,) position of the palm beside the centre of mass at the apex.
        top: (nq,) pose of the acting arm at the apex.
        t: (n,) times, s.
        start: (nq,) first pose.
        before: (n, nq) frames of the previous round.
    """
    figure = plan.figure
    count = len(t)
    pitch, lift, contact = _foot_motion(plan, t)
    in_air = contact == AIR
    rows = FrameRows(figure, count)

    # In the middle of the flight the feet have less weight than the centre of mass and the
    # momentum. At take-off and landing the floor determines their poses.
    release = plan.take_off + JUMPING.foot_hold_after
    catch = plan.landing - JUMPING.foot_hold_before
    is_released = (t > release) & (t < catch)
    near_apex = minimum_jerk((t - release) / (plan.apex - release))
    near_apex = near_apex * minimum_jerk((catch - t) / (catch - plan.apex))
    released_weight = 10.0 ** (3.5 - JUMPING.foot_decades * near_apex)
    rolled, height = figure.feet["left"].sole.stand(pitch)
    poses = {}
    for side, foot in figure.feet.items():
        stand = figure.pose(plan.ready, foot.frame)[0]
        position = np.column_stack([stand[0] + rolled, np.full(count, stand[1]), height + lift])
        poses[side] = (position, axis_rotations("y", pitch))
    rows.feet(poses, np.where(is_released, released_weight, HARD))

    # The centre of mass begins at that of the first pose.
    z = plan.height(t)
    center = np.column_stack([x, np.zeros(count), z])
    begin = minimum_jerk(t / plan.ends[0])[:, None]
    start_center = figure.center(start)
    rows.center(start_center + (center - start_center) * begin)

    # Before and after the flight the weight of the momentum row changes gradually. A sudden change
    # would cause a jerk of the trunk.
    rows.momentum(np.where(in_air, HARD, 0.0))
    half_push = (plan.take_off - plan.push_start) / 2
    push_middle = (plan.push_start + plan.take_off) / 2
    stillness = minimum_jerk((t - push_middle) / half_push) * (t <= plan.take_off)
    calming = 1 - minimum_jerk((t - plan.landing) / JUMPING.calm)
    stillness = stillness + calming * (t >= plan.landing)
    rows.momentum(500.0 * stillness**2)

    depth = np.clip((plan.wait - (z - lift)) / 0.3, 0, 1.2)
    settling = np.where(t <= plan.take_off, 1.0, minimum_jerk((t - plan.landing) / 0.4))
    flying_weight = 4.0 * 10.0 ** (-JUMPING.trunk_decades * near_apex)
    trunk_weight = np.where(in_air, flying_weight, 40.0 * settling + 4.0)
    lean = axis_rotations("y", np.radians(60.0) * depth)
    rows.orientation(figure.trunk, lean, trunk_weight)
    if figure.gaze is not None:
        eyes, rotation = figure.pose(start, figure.gaze)
        first_target = eyes + rotation[:, 0] * np.linalg.norm(plan.ball - eyes)
        # The glance ends before the push.
        within = min(max(0.6, glance_time(figure, start, plan.ball)), 1.0)
        target = first_target + (plan.ball - first_target) * minimum_jerk(t / within)[:, None]
        rows.aim(target, JUMPING.gaze_weight)

    # The weight of the hand grows by a constant factor per frame. A power of time would pull the
    # arm to the ball within two frames.
    reach_time = plan.apex - 0.01 - plan.take_off + 0.05
    nearness = minimum_jerk((t - plan.take_off + 0.05) / reach_time)
    leave_time = plan.landing - plan.apex
    nearness = nearness * (1 - minimum_jerk((t - plan.apex - 0.01) / leave_time))
    hand_weight = 10.0 ** (JUMPING.hand_decades * nearness - 3)
    rows.position(figure.hands[plan.arm], center + palm, hand_weight)

    posture = _posture(plan, t, depth, top, pitch, contact)
    posture = start + (posture - start) * begin
    patterns = STIFFNESS | {"*shoulder*": 1.0, "*elbow*": 1.0, "*toe*": 1e5}
    stiffness = figure.stiffnesses(patterns)
    if before is not None:
        smoothed = smooth(before, JUMPING.tie_smooth / DT)
        posture, stiffness = _tied(plan, t, smoothed, posture, stiffness)
    frames = rows.solve(posture, stiffness, start, speeds="jump", max_steps=_MAX_STEPS)
    return frames, contact


def _tied(
    plan: JumpPlan, t: Array, target: Array, posture: Array, stiffness: Array
) -> tuple[Array, Array]:
    """Return posture (n, nq) and stiffness (n, nv) that pull to frames in flight.

    Two springs at a joint equal one between their targets with the sum of their stiffnesses.

    Args:
        plan: The plan of the jump.
        t: (n,) times, s.
        target: (n, nq) frames.
        posture: (n, nq) posture without the pull.
        stiffness: (nv,) its stiffness.
    """
    begin = minimum_jerk((t - plan.take_off) / JUMPING.tie_begin + 1.0)
    share = begin * minimum_jerk((plan.landing - t) / JUMPING.tie_end)
    tied = plan.figure.stiffnesses({"*": JUMPING.tie_stiffness, "*toe*": 0.0})
    free = stiffness * np.where(tied > 0.0, 1.0 - share[:, None], 1.0)
    total = free + share[:, None] * tied
    part = 1.0 - free[:, 6:] / total[:, 6:]
    joints = posture[:, 7:] + part * (target - posture)[:, 7:]
    return np.concatenate([posture[:, :7], joints], axis=1), total


def _posture(
    plan: JumpPlan,
    t: Array,
    depth: Array,
    top: Array,
    pitch: Array,
    contact: NDArray[np.int64],
) -> Array:
    """Return postures (n, nq) of a jump.

    Args:
        plan: The plan of the jump.
        t: (n,) times, s.
        depth: (n,) depth of the crouch, from 0 to 1.2.
        top: (nq,) pose of the acting arm at the apex.
        pitch: (n,) pitch of the soles, rad.
        contact: (n,) contact of the feet.
    """
    figure = plan.figure
    bends = {
        "hip_pitch": 0.06 + 1.2 * depth,
        "knee_pitch": 0.12 + 1.5 * depth,
        "ankle_pitch": 0.06 + 0.4 * depth,
    }
    moves = {f"{side}_{joint}": angle for side in SIDES for joint, angle in bends.items()}
    moves |= _arm_angles(plan, t, top)
    postures = figure.posture(moves, np.tile(figure.home, (len(t), 1)))

    # The toes are level on the floor. They straighten in flight and are level again before they
    # touch the floor.
    straightening = 1 - minimum_jerk((t - plan.take_off) / 0.3)
    level = pitch * np.where(t > plan.landing, 1.0, straightening)
    back = minimum_jerk((t - plan.apex) / (plan.landing - plan.apex))
    level = np.where(contact == AIR, np.maximum(level, pitch * back), level)
    for foot in figure.feet.values():
        if foot.toes is not None:
            postures[:, foot.toes[0]] = level
    return postures


def jump(figure: Figure, q: Array, ball: Array, arm: str = "right", speed: float = 2.0) -> Motion:
    """Return a jump on the spot with the palm at a ball overhead at the apex.

    Args:
        figure: The figure.
        q: (nq,) standing near home.
        ball: (3,) the ball in the world.
        arm: Side of the acting hand.
        speed: Speed at take-off, m/s (``Abilities.take_off``). It is increased where bodies would
            touch.

    Raises:
        InvalidGoalError: The speed is larger than that of the fastest jump.
    """
    start, stance = to_stance_frame(figure, q)
    ball = in_stance_frame(stance, np.asarray(ball, dtype=float))
    first: Motion | None = None
    for variant_speed, abduction in _variants(speed):
        motion = _jump_at_origin(plan_jump(figure, ball, arm, variant_speed, abduction), start)
        if not touches_itself(figure, motion.q):
            return placed_motion(figure, motion, stance)
        first = first or motion
    if first is None:
        raise RuntimeError("no variant of the jump was tried")
    return placed_motion(figure, first, stance)


def _variants(speed: float) -> list[tuple[float, float]]:
    """Return (speed, abduction) of the tries. Near the fastest take-off some are equal."""
    variants = [
        (max(speed, min(speed + additional, JUMPING.fastest)), abduction)
        for abduction, additional in JUMPING.variants
    ]
    return list(dict.fromkeys(variants))


def _jump_at_origin(plan: JumpPlan, start: Array) -> Motion:
    """Return the jump of a plan from ``start`` (nq,), in the frame of the stance."""
    # One frame is at the apex, the moment of the touch.
    t = np.arange(1, int((plan.end + JUMPING.stand_time) / DT) + 1) * DT
    t = t + (plan.apex - t[np.abs(t - plan.apex).argmin()])
    apex_height = plan.height(np.array([plan.apex]))[0]
    x, points = _forward_motion(plan, t)

    # The palm moves by millimetres in later rounds. Its row corrects that.
    top = _arm_at_apex(plan, _palm_at_apex(plan, t, x, apex_height))
    frames, contact = _solve(plan, x, _palm_at_apex(plan, t, x, apex_height), top, t, start, None)
    error = np.zeros(len(t))
    for round_number in range(JUMPING.corrections):
        remaining = _pressure_error(plan, frames.q, points, contact)
        error = remaining if round_number == 0 else error + JUMPING.feedback * remaining
        x, points = _forward_motion(plan, t, (t, error))
        palm = _palm_at_apex(plan, t, x, apex_height)
        frames, contact = _solve(plan, x, palm, top, t, start, frames.q)
    return Motion(
        action="jump",
        q=frames.q,
        contact=np.column_stack([contact, contact]),
        error=frames.error,
        zmp=np.column_stack([points, np.zeros(len(t))]),
        interruptible=(t > plan.end + 0.1) | (t < 0.2),
        speeds="jump",
    )


def _palm_at_apex(plan: JumpPlan, t: Array, x: Array, apex_height: float) -> Array:
    """Return the position (3,) of the ball beside the centre of mass at the apex."""
    return plan.ball - np.array([np.interp(plan.apex, t, x), 0.0, apex_height])


def _pressure_error(plan: JumpPlan, q: Array, points: Array, contact: NDArray[np.int64]) -> Array:
    """Return the smoothed error (n,) of the zero-moment point of the whole body, forwards.

    Args:
        plan: The plan of the jump.
        q: (n, nq) frames.
        points: (n,) planned zero-moment point.
        contact: (n,) contact of the feet.
    """
    actual, force = zero_moment_points(plan.figure, q)
    weight = plan.figure.mass * GRAVITY
    is_loaded = (contact != AIR) & (force > JUMPING.loaded * weight)
    largest = JUMPING.largest_error
    error = np.where(is_loaded, np.clip(actual[:, 0] - points, -largest, largest), 0.0)
    error[:2] = 0.0
    error[-2:] = 0.0
    return smooth(error, JUMPING.error_time / DT)
