"""Runs of the figure: balls or a marker as input, frames and decisions as output."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.figure.abilities import Abilities
from robot_ik.figure.decide import Decision
from robot_ik.figure.figure import RATE
from robot_ik.figure.gait import FLAT
from robot_ik.figure.lion import HOLD, LEAN, REACH, Lion
from robot_ik.figure.session import FigureFrame, FigureSession
from robot_ik.geometry import Pose, axis_rotations
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.ar.motion import DrawnMotion, marker_from_base
from robot_ik.testbed.ar.overlay import ArReport, ArRequest, PictureProgress, run_ar

REACHED_DISTANCE = 0.005
"""m. A hand at this distance from the ball has reached it."""

MARKER_NOISE = 0.03
"""m. A smaller change of the marker is noise, because the figure is drawn at a quarter of its size.
"""

IDLE_TIME = 0.5
"""Seconds without an action after which the run of a ball ends."""

LONGEST_RUN = 60.0
"""Seconds after which the run of a ball ends in any case."""

CIRCLE_PERIOD = 20.0
"""Seconds of one round of the ball that moves in a circle."""

RANDOM_PERIOD = 3.0
"""Seconds for which the random ball stays at a position."""


@dataclass(frozen=True)
class FigureRequest:
    """A request for a run of the figure.

    Attributes:
        balls: Positions of the ball, m. Each is kept until the figure does nothing any more.
        path: Motion of the ball, instead of ``balls``.
        seconds: Duration of the motion of the ball, s.
        stance: x, y (m) and heading (rad) of the figure at the start.
        seed: Seed of the random path.
    """

    balls: tuple[tuple[float, float, float], ...] = ()
    path: Literal["circle", "random"] | None = None
    seconds: float = 12.0
    stance: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0


@dataclass
class Performance:
    """What the figure did.

    Attributes:
        frames: All frames.
        decisions: Decisions with their times, s.
        errors: Action, and distance of hand and ball after it, m. After a reach or a bend it is
            the last distance, for a jump the smallest one.
    """

    frames: list[FigureFrame] = field(default_factory=list)
    decisions: list[tuple[float, Decision]] = field(default_factory=list)
    errors: list[tuple[str, float]] = field(default_factory=list)

    @property
    def arrived(self) -> bool:
        """Whether each hand that moved to a ball reached it."""
        return all(error <= REACHED_DISTANCE for _, error in self.errors)


def moving_ball(
    path: str, t: float, seed: int, stance: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return the position of a moving ball, m.

    Args:
        path: ``circle``: around the figure. ``random``: another position every few seconds.
        t: Time, s.
        seed: Seed of the random positions.
        stance: x, y (m) and heading (rad) of the figure at the start.
    """
    if path == "circle":
        angle = 2 * math.pi * t / CIRCLE_PERIOD
        x = 0.2 + 1.2 * math.cos(angle)
        y = 1.2 * math.sin(angle)
        z = 1.2 + 0.3 * math.sin(3 * angle)
    else:
        rng = np.random.default_rng([seed, int(t / RANDOM_PERIOD)])
        x = rng.uniform(0.2, 0.8)
        y = rng.uniform(-0.6, 0.6)
        z = rng.uniform(0.3, 1.9)
    position = axis_rotations("z", stance[2]) @ np.array([x, y, z])
    return float(position[0] + stance[0]), float(position[1] + stance[1]), float(position[2])


def run_figure(abilities: Abilities, request: FigureRequest) -> Iterator[FigureFrame]:
    """Yield the frames of a figure that is shown balls."""
    session = FigureSession(abilities, stance=request.stance)
    if request.path is not None:
        for k in range(int(request.seconds * RATE)):
            session.set_ball(moving_ball(request.path, k / RATE, request.seed, request.stance))
            yield session.step()
        return
    for ball in request.balls:
        session.set_ball(ball)
        idle_frames = 0
        for _ in range(int(LONGEST_RUN * RATE)):
            yield session.step()
            idle_frames = 0 if session.busy else idle_frames + 1
            if idle_frames > IDLE_TIME * RATE:
                break


def run_marker(
    abilities: Abilities,
    stance: tuple[float, float, float],
    positions: Iterator[tuple[float, Array | None]],
) -> Iterator[FigureFrame]:
    """Yield the frames of a figure whose ball is a marker.

    Args:
        abilities: What the figure can do.
        stance: x, y (m) and heading (rad) of the figure at the start.
        positions: Times (s), and positions (3,) of the marker in the world, m, or None.
    """
    figure = MarkerFigure(abilities, stance)
    for t, position in positions:
        yield from figure.run_until(t, position)


class MarkerFigure:
    """A figure that acts on a marker in the pictures of a camera.

    Attributes:
        frames: All frames.
    """

    def __init__(self, abilities: Abilities, stance: tuple[float, float, float]) -> None:
        self._session = FigureSession(abilities, stance=stance)
        self._ball = np.full(3, np.inf)
        self.frames: list[FigureFrame] = []

    def run_until(self, t: float, position: Array | None) -> list[FigureFrame]:
        """Return the frames up to a time.

        Args:
            t: Time, s.
            position: Position of the marker (3,), m. None: its last position.
        """
        if position is not None and np.linalg.norm(position - self._ball) > MARKER_NOISE:
            self._ball = position
            self._session.set_ball(position)
        first = len(self.frames)
        while len(self.frames) / RATE <= t:
            self.frames.append(self._session.step())
        return self.frames[first:]


def draw_on_camera(
    abilities: Abilities,
    stance: tuple[float, float, float],
    camera: ArRequest,
    progress: PictureProgress,
) -> tuple[ArReport, list[FigureFrame]]:
    """Draw a figure that acts on a marker into the pictures of a camera."""
    figures: list[MarkerFigure] = []

    def make_motion(_robot: Robot, drawn: DrawnRobot) -> DrawnMotion:
        figure = MarkerFigure(abilities, stance)
        figures.append(figure)

        def q_at(time: float, marker: Pose | None) -> Array:
            position = None if marker is None else marker_from_base(marker, drawn)
            figure.run_until(time, position)
            return figure.frames[-1].q

        return DrawnMotion(q_at)

    report = run_ar(camera, progress, robot=abilities.figure.robot, mover=make_motion)
    return report, figures[-1].frames


def run_lion(lion: Lion, balls: Sequence[tuple[float, float, float]]) -> Iterator[FigureFrame]:
    """Yield the frames of a lion that is shown balls. A ball out of reach is one frame."""
    t = 0.0
    contact = np.array([FLAT, FLAT])
    no_zmp = np.full(2, np.nan)
    # The reach ends when the paw begins to move back.
    reach_share = (LEAN + REACH + HOLD) / (2 * (LEAN + REACH) + HOLD)
    for ball in balls:
        decision = lion.decide(ball)
        paw = decision.arm
        position = np.asarray(ball, dtype=float)
        q = lion.reach(ball, paw, rate=RATE).q if paw else [lion.relaxed]
        reach_frames = len(q) * reach_share
        for k, row in enumerate(q):
            t += 1.0 / RATE
            action = "stand"
            phase = 1.0
            if paw:
                action = "reach" if k < reach_frames else "rest"
                phase = min(1.0, (k + 1) / reach_frames)
            yield FigureFrame(t, row, action, phase, contact, no_zmp, position, decision)


def watch(
    robot: Robot,
    hands: Mapping[str, str],
    frames: Iterator[FigureFrame],
    on_frame: Callable[[FigureFrame], None] = lambda _frame: None,
) -> Performance:
    """Run through frames and measure how near the hands come to the ball.

    Args:
        robot: The robot.
        hands: Frame of the hand of each arm that a decision may name.
        frames: The frames.
        on_frame: Called with each frame.
    """
    performance = Performance()
    nearest = np.inf
    for frame in frames:
        before = performance.frames[-1] if performance.frames else None
        if before is None or frame.decision is not before.decision:
            performance.decisions.append((frame.t, frame.decision))
        performance.frames.append(frame)
        on_frame(frame)

        arm = frame.decision.arm
        if frame.action not in ("reach", "bend", "jump") or arm is None:
            continue
        hand = robot.forward(frame.q, hands[arm]).position
        error = float(np.linalg.norm(hand - frame.ball))
        nearest = min(nearest, error) if frame.action == "jump" else error
        if frame.phase >= 1.0:
            performance.errors.append((frame.action, nearest))
            nearest = np.inf
    return performance
