"""Teleoperation: an arm, or the keys of a terminal, lead; another arm follows within its limits.

Joint to joint a leader's angle goes to the follower's joint of the same name, each range onto the other's.
Hand to hand the follower's hand repeats what the leader's has done since they were engaged.  Engaging never
jumps.  A leader that is lost commands nothing: then the follower's own ``on_stale`` decides.
"""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from robot_ik.budget import Budget
from robot_ik.errors import ArmStateError, ConfigError, HardwareError, UnsafeCommandError
from robot_ik.execution import Schedule
from robot_ik.geometry import Pose
from robot_ik.goals import BEST, EXACT, PoseGoal
from robot_ik.hardware import bus_row, open_arm, simulated_servos
from robot_ik.hardware.arm import Arm, ArmState
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.watchdogs import stale_time
from robot_ik.jobs.robot_setup import robot_named_in
from robot_ik.motion.timing import minimum_jerk
from robot_ik.ports import Array, Clock, RealClock, VirtualClock
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.workcell.arm_guard import ArmGuard
from robot_ik.workcell.guided_motion import approach_profile

log = logging.getLogger(__name__)

LOST = 0.2
"""s without a good sample of the leader after which it counts as lost; a wire loses a packet now and then."""
_BUDGET = Budget(iterations=30, restarts=0)
_WHOLE = 6  # joints that can carry any pose of a hand
_MET = 1e-3, 1e-2  # m and rad: so near a step of the hand has come where it should

Angles = Mapping[str, float]


class Operator(ABC):
    """What leads: says where each joint of the follower should be; ``over``: a person wants to end."""

    over = False

    @abstractmethod
    def engage(self, follower: Angles) -> None:
        """From here on; the follower is at ``follower`` (joint -> rad, m of a slide)."""

    @abstractmethod
    def command(self, now: float) -> Angles:
        """Joint -> rad (m of a slide) at ``now``, s; HardwareError: it is lost."""

    def go_on_from(self, command: Angles) -> None:  # noqa: B027 - most lead by where they are
        """Take ``command`` (joint -> rad, m of a slide) as the last one: a collision held it back."""

    def feel(self, follower: Angles) -> None:  # noqa: B027 - most give nothing back
        """Where the follower is, for those who give it back to the hand."""

    def recover(self, timeout: float) -> None:  # noqa: B027 - keys are never lost
        """Back after it was lost; HardwareError: not within ``timeout`` s."""


class JointCoupling:
    """Angles of a leader as those of a follower: by name, each range onto the other's.

    ``names`` are the joints that both have, those of grippers too.

    Raises:
        ConfigError: They share no joint.
    """

    def __init__(self, leader: ArmConfig, follower: ArmConfig) -> None:
        both = [(joint, follower) for joint in leader.joints if joint.name in follower.names]
        if not both:
            raise ConfigError(
                f"no joint of {leader.name} is one of {follower.name}",
                file=leader.file or leader.name, key="joints",
                allowed=f"names of {', '.join(follower.names)}; or hand to hand: --by hand",
            )  # fmt: skip
        self.names = tuple(joint.name for joint, _ in both)
        self._ranges = {joint.name: (joint.limits, other.joint(joint.name).limits) for joint, other in both}

    def follower(self, leader: Angles) -> dict[str, float]:
        """Of the follower; beyond an end of a range it stays there."""
        return {n: float(np.interp(leader[n], *self._ranges[n])) for n in self.names}

    def leader(self, follower: Angles) -> dict[str, float]:
        return {n: float(np.interp(follower[n], *self._ranges[n][::-1])) for n in self.names}


class Hand:
    """The hand of a follower, led by inverse kinematics from the last command (``pose``) on."""

    def __init__(self, config: ArmConfig) -> None:
        robot = load_robot(robot_named_in(config))
        chain = config.chain
        self.names = chain.names
        self._order = [robot.joints.index(name) for name in chain.names]
        lower, upper = np.full((2, robot.nv), np.inf) * [[-1.0], [1.0]]
        lower[self._order], upper[self._order] = chain.lower, chain.upper
        self._robot = robot.with_limits(lower, upper)
        self._q = self._robot.home.copy()
        self.pose = self._robot.forward(self._q)
        # An arm that cannot carry every pose needs the position, with the best orientation there.
        self._whole = self._robot.nv >= _WHOLE
        orientation = EXACT if self._whole else BEST
        self._problem = Problem(
            self._robot,
            PoseGoal(None, self.pose.position, self.pose.wxyz, orientation=orientation),
            solver="lm" if self._whole else "auto",
            budget=_BUDGET,
            keep_branch=True,
        )

    def engage(self, angles: Angles) -> Pose:
        """Where it is at ``angles``, from where it is led on."""
        self._q = self._robot.home.copy()
        self._q[self._order] = [angles[name] for name in self.names]
        self._q = self._robot.clip(self._q)
        self.pose = self._robot.forward(self._q)
        return self.pose

    def go(self, pose: Pose, *, exactly: bool = False) -> dict[str, float]:
        """Joint -> rad that bring the hand there, or as near as it comes.

        ``exactly``: there, or not at all; steps that add up must neither drift, nor rotate the hand at the
        end of its reach.
        """
        whole = self._whole
        found = self._problem.solve(self._q, target=pose).q
        if np.isfinite(found).all():
            there = self._robot.forward(found)
            away, angle = there.distance(pose)
            met = away < _MET[0] and (angle < _MET[1] or not whole)
            if met or not exactly:
                self._q = found
                self.pose = Pose(pose.position, pose.wxyz if whole else there.wxyz) if exactly else there
        return dict(zip(self.names, self._q[self._order].tolist(), strict=True))


class LeaderArm(Operator):
    """An arm that a person guides; torque is off, unless it shall push back.

    Args:
        arm: Connected.
        follower: Arm file of what follows.
        by: ``joints`` or ``hand``.
        scale: Hand to hand: metres of the follower for one of the leader.
        force: Share of its currents by which the leader is pushed to where the follower is; 0: none.

    Raises:
        ConfigError: They share no joint, or these servos cannot be pushed gently.
    """

    def __init__(
        self, arm: Arm, follower: ArmConfig, by: Literal["joints", "hand"], scale: float, force: float
    ) -> None:
        self._arm, self._scale, self._force = arm, scale, force
        self._joints: JointCoupling | None = None
        self._begin: tuple[Pose, Pose] | None = None
        self._last: tuple[dict[str, float], float] = {}, -np.inf
        if by == "joints":
            self._joints = JointCoupling(arm.config, follower)
        else:
            self._leader, self._hand = Hand(arm.config), Hand(follower)
        if force:
            self._require_gentle()

    def _require_gentle(self) -> None:
        stiff = [j.name for j in self._arm.config.joints if not j.servo.presses]
        if stiff or self._joints is None:
            raise ConfigError(
                "force feedback needs a leader whose servos push with a limited current, joint to joint"
                + (f"; {', '.join(stiff)} cannot" if stiff else ""),
                file=self._arm.config.file or self._arm.config.name, key="mode",
                allowed="current_based_position for every joint, or no --force-feedback",
            )  # fmt: skip

    def engage(self, follower: Angles) -> None:
        if self._joints is None:
            self._hand.engage(follower)
            self._begin = self._leader.engage(self._read()), self._hand.pose
        elif self._force and self._arm.state is ArmState.CONNECTED:
            self._arm.enable()
            currents = {j.name: j.current for j in self._arm.config.joints if j.current is not None}
            self._arm.limit_current({name: self._force * mA for name, mA in currents.items()})

    def command(self, now: float) -> Angles:
        here = self._read()
        if self._joints is not None:
            return self._joints.follower(here)
        if self._begin is None:
            raise RuntimeError("command() before engage()")
        leader, hand = self._begin
        seen = self._leader.engage(here)
        step = self._scale * (seen.position - leader.position)
        rotation = seen.rotation @ leader.rotation.T @ hand.rotation
        return self._hand.go(Pose.from_rotation(rotation, hand.position + step))

    def feel(self, follower: Angles) -> None:
        if self._force and self._joints is not None and self._arm.state is not ArmState.CONNECTED:
            wanted = self._joints.leader(follower)
            self._arm.send({n: wanted[n] for n in self._arm.joints if n in wanted}, self._arm.clock.now())

    def recover(self, timeout: float) -> None:
        self._arm.reconnect(timeout)
        self._last = {}, -np.inf

    def _read(self) -> dict[str, float]:
        """Joint -> rad, measured now, or for ``LOST`` s what was measured last."""
        now = self._arm.clock.now()
        try:
            self._arm.read()
            if float(self._arm.ages.max()) > LOST:
                raise HardwareError("the leader does not answer", hint="look at its cable and supply")
        except HardwareError:
            if now - self._last[1] > LOST:
                raise
            return self._last[0]
        self._last = self._arm.positions(), now
        return self._last[0]


JOINT_KEYS = ("qa", "ws", "ed", "rf", "tg", "yh", "uj", "ik", "ol")
"""Two keys for each joint, forwards and back: columns of the keyboard from the left."""
HAND_KEYS: Mapping[str, tuple[int, int]] = {
    "w": (0, 1), "s": (0, -1), "a": (1, 1), "d": (1, -1), "r": (2, 1), "f": (2, -1),
    "i": (3, 1), "k": (3, -1), "j": (4, 1), "l": (4, -1), "u": (5, 1), "o": (5, -1),
}  # fmt: skip
"""Key -> axis of the world (0 to 2: along, 3 to 5: about) and its sign."""
MODE_KEY, FINER, COARSER, STOP, QUIT = "\t", "-", "+", " ", "\x1b"
_STEP, _ROTATION = 0.01, np.radians(3.0)  # m or rad (joints and rotations) of one key press
_FINEST, _COARSEST = 0.1, 4.0


class Jog(Operator):
    """Moves joints, or the ``hand`` in the axes of the world; never beyond the limits.

    ``angles`` are commanded, joint -> rad (m of a slide); ``joints`` are the follower's, grippers last;
    ``read`` gives what was pressed since it was last asked, or is pressed now; ``stop`` makes the follower
    hold.
    """

    def __init__(
        self,
        config: ArmConfig,
        read: Callable[[], Any],
        *,
        stop: Callable[[], object] = lambda: None,
        hand: bool = False,
    ) -> None:
        self._hand, self._read = Hand(config), read
        self.joints = config.joints
        self.angles: dict[str, float] = {}
        self.hand, self.stop = hand, stop

    def engage(self, follower: Angles) -> None:
        self.angles = {joint.name: follower[joint.name] for joint in self.joints}
        self._hand.engage(self.angles)

    def go_on_from(self, command: Angles) -> None:
        self.angles |= command
        self._hand.engage(self.angles)

    def change(self) -> None:
        """The hand instead of joints, or joints instead of the hand."""
        self.hand = not self.hand
        self._hand.engage(self.angles)

    def move_joint(self, number: int, rotation: float, slide: float) -> None:
        """One joint by ``rotation``, rad, or ``slide``, m; nothing where there is none of that number."""
        if number >= len(self.joints):
            return
        joint = self.joints[number]
        step, (low, high) = slide if joint.slides else rotation, joint.limits
        if step:
            self.angles[joint.name] = min(max(self.angles[joint.name] + step, low), high)

    def move_hand(self, along: Array, about: Array) -> None:
        """The hand ``along`` (3,), metres, and ``about`` (3,), radians, the axes of the world."""
        rotation = Pose().plus(np.concatenate([np.zeros(3), about])).rotation
        pose = self._hand.pose
        pose = Pose.from_rotation(rotation @ pose.rotation, pose.position + along)
        self.angles |= self._hand.go(pose, exactly=True)


class KeyboardJog(Jog):
    """The keys of a terminal jog joints, or the hand in the axes of the world.

    A terminal says when a key goes down and not how long it stays: each press is one step.  ``stop`` is
    called at the space bar.
    """

    _size = 1.0

    def command(self, now: float) -> Angles:
        for key in self._read():
            self._press(key.lower())
        return dict(self.angles)

    def _press(self, key: str) -> None:
        if key == STOP:
            self.stop()
        elif key == QUIT:
            self.over = True
        elif key == MODE_KEY:
            self.change()
        elif key in (FINER, COARSER):
            self._size = float(np.clip(self._size * (2.0 if key == COARSER else 0.5), _FINEST, _COARSEST))
        elif not self.hand:
            for number, pair in enumerate(JOINT_KEYS):
                if key in pair:
                    size = self._size if key == pair[0] else -self._size
                    self.move_joint(number, size * _ROTATION, size * _STEP)
        elif key in HAND_KEYS:
            axis, sign = HAND_KEYS[key]
            motion = np.zeros(6)
            motion[axis] = sign * self._size * (_STEP if axis < 3 else _ROTATION)
            self.move_hand(motion[:3], motion[3:])


class Blend:
    """From where the follower stands into what it is led to: what lies between dies away, at rest first."""

    def __init__(self, here: Angles, there: Angles, config: ArmConfig, now: float) -> None:
        self._apart = {name: here[name] - there[name] for name in there}
        distance = np.array([self._apart.get(name, 0.0) for name in config.names])
        self._begin, self.seconds = now, approach_profile(distance, config).duration

    def __call__(self, there: Angles, now: float) -> dict[str, float]:
        passed = now - self._begin
        left = 0.0 if passed >= self.seconds else 1.0 - float(minimum_jerk(passed / self.seconds))
        return {name: value + left * self._apart.get(name, 0.0) for name, value in there.items()}


@dataclass
class TeleopReport:
    """What happened.

    Attributes:
        engaged, lost: How often leader and follower were engaged, and the leader was lost.
        delay: Median seconds from reading the leader to the follower's packet.
        blocked: Number of commands that were held back, because parts would have touched.
        end: Why it ended, as text; as it is where an arm failed, or Ctrl-C ended it.
    """

    ticks: int = 0
    engaged: int = 0
    lost: int = 0
    seconds: float = 0.0
    delay: float = 0.0
    blocked: int = 0
    end: str = "it was broken off"


_DELAYS = 4096  # samples of which the median is taken


def teleoperate(
    operator: Operator,
    follower: Arm,
    *,
    seconds: float | None = None,
    patience: float = 10.0,
    over: Callable[[], bool] = lambda: False,
    done: Callable[[TeleopReport], None] = lambda report: None,
    guard: ArmGuard | None = None,
) -> TeleopReport:
    """Leads the connected follower, which is enabled here, until it is over; the caller leaves the arms.

    ``seconds``: how long; None: until ``over``, which is asked once a tick.  ``patience``: s to wait for a
    leader that was lost.  ``done`` is given the report however it ends: by an error or Ctrl-C, too.
    ``guard`` holds the follower where the next step would touch, and logs what is in the way.

    Raises:
        HardwareError: The follower failed, or the leader did not come back.
    """
    clock, rate = follower.clock, follower.config.rate_hz
    if follower.state is ArmState.CONNECTED:
        follower.enable()
    report, schedule = TeleopReport(), Schedule(clock)
    begin, blend = schedule.origin, None
    delays: list[float] = []
    try:
        while not over() and (seconds is None or clock.now() - begin < seconds):
            now = schedule.wait(report.ticks / rate, 1.0 / rate if report.ticks else 0.0)
            report.ticks += 1
            if blend is None:
                follower.read()
            try:
                if blend is None:
                    here = follower.positions()
                    operator.engage(here)
                    blend = Blend(here, operator.command(now), follower.config, now)
                    if guard is not None:
                        guard.begin(here)
                    report.engaged += 1
                read = time.perf_counter()
                wanted = operator.command(now)
            except (UnsafeCommandError, ArmStateError):
                raise
            except HardwareError:
                report.lost, blend = report.lost + 1, None
                _wait_for(operator, follower, patience)
                schedule.origin = clock.now() - report.ticks / rate
                continue
            if guard is None:
                follower.send(blend(wanted, now), now)
            else:
                _send_guarded(follower, blend(wanted, now), guard, operator, report)
            if len(delays) < _DELAYS:
                delays.append(time.perf_counter() - read)
            operator.feel(follower.positions())
        report.end = "it was ended" if over() else "the time was over"
    finally:
        report.seconds = clock.now() - begin
        report.delay = float(np.median(delays)) if delays else 0.0
        done(report)
    return report


def _send_guarded(
    follower: Arm, command: Angles, guard: ArmGuard, operator: Operator, report: TeleopReport
) -> None:
    """Send what the guard allows of a command; log what is in the way when that changes."""
    before = guard.contact
    sent = guard.send(follower, command)
    if guard.contact:
        report.blocked += 1
        operator.go_on_from({name: sent[name] for name in command})
    if guard.contact and not before:
        log.warning("the arm holds: %s", guard.contact)
    elif before and not guard.contact:
        log.warning("the way is free again")


def _wait_for(operator: Operator, follower: Arm, patience: float) -> None:
    """Commands nothing until the leader is back: the follower's heartbeat holds it, then ``on_stale``.

    On virtual time no heartbeat runs; there the arm is held when the heartbeat would have.

    Raises:
        HardwareError: It did not come back, or the follower gave up meanwhile.
    """
    if isinstance(follower.clock, VirtualClock):
        config = follower.config
        follower.clock.sleep_until(follower.clock.now() + stale_time(config.stale_ms, 1.0 / config.rate_hz))
        follower.hold()
    operator.recover(patience)
    if follower.state is ArmState.FAULT and follower.fault is not None:
        raise follower.fault.with_traceback(None)


def open_pair(
    leader: ArmConfig | None,
    follower: ArmConfig,
    leader_bus: str,
    follower_bus: str,
    on_exit: str = "",
) -> tuple[Arm | None, Arm]:
    """Both arms, disconnected; simulated ones share a clock, which is virtual where both buses' time is.

    ``leader`` None: a person leads, by keys or a gamepad, and time is real: nobody leads in virtual time.
    ``on_exit`` is how the follower is left, empty: as its file says.
    """
    virtual_time = leader is not None and all(bus_row(b).virtual_time for b in (leader_bus, follower_bus))
    clock: Clock = VirtualClock() if virtual_time else RealClock()

    def made(config: ArmConfig, bus: str, way_out: str | None) -> Arm:
        servos = simulated_servos(config, clock) if bus_row(bus).virtual else None
        return open_arm(config, bus, virtual_bus=servos, on_exit=way_out)

    first = None if leader is None else made(leader, leader_bus, "torque_off")
    return first, made(follower, follower_bus, on_exit or None)
