"""A figure gets another ball at a random moment, for every pair of reach, bend, jump, walk, none.

No joint's speed changes suddenly, no speed limit is broken, and the feet stay where they stand. A
walk ends at rest on both feet after its next steps. A jump never ends in the air.
"""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from robot_ik.figure.abilities import Abilities
from robot_ik.figure.balance import derivatives
from robot_ik.figure.figure import RATE
from robot_ik.figure.gait import FLAT
from robot_ik.figure.session import FigureFrame, FigureSession
from robot_ik.geometry import axis_rotations

Array = NDArray[np.float64]

KINDS = ("reach", "bend", "jump", "walk", "nothing")
PAIRS = list(itertools.product(KINDS, KINDS))

BLEND_FRAMES = 26
"""Frames in which a motion that is left decays (``transitions.BLEND_TIME``)."""

LARGEST_CHANGE = 2.0
"""Largest change of a joint's speed in a frame, rad/s."""

LONGEST = 20.0
"""Longest time of a reaction, s."""


def ball_for(
    kind: str, stance: Array, rng: np.random.Generator
) -> tuple[float, float, float] | None:
    """Return a random ball for which a figure at ``stance`` decides ``kind``."""
    side = float(rng.choice([-1.0, 1.0]))
    lower, upper = {
        "reach": ((0.35, 0.1, 1.0), (0.5, 0.35, 1.5)),
        "bend": ((0.4, 0.15, 0.2), (0.5, 0.3, 0.45)),
        "jump": ((0.1, 0.1, 2.3), (0.2, 0.25, 2.4)),
        "walk": ((-2.0, 0.9, 1.0), (2.5, 1.8, 1.3)),
        "nothing": ((0.5, 0.0, 3.5), (0.5, 0.0, 3.5)),
    }[kind]
    if kind == "nothing" and side < 0:
        return None
    local = rng.uniform(lower, upper) * [1.0, side, 1.0]
    x, y, z = axis_rotations("z", float(stance[2])) @ local + [stance[0], stance[1], 0.0]
    return float(x), float(y), float(z)


def interrupted_run(abilities: Abilities, seed: int) -> tuple[list[FigureFrame], int]:
    """Return the frames until the second ball is served, and the frame at which it came."""
    rng = np.random.default_rng(seed)
    first, second = PAIRS[seed % len(PAIRS)]
    session = FigureSession(abilities)
    session.set_ball(ball_for(first, np.zeros(3), rng))
    frames = [session.step()]
    while session.busy and frames[-1].action == "stand":
        frames.append(session.step())
    longest = {"walk": 240, "jump": 120}.get(first, 60)
    for _ in range(int(rng.integers(2, longest))):
        frames.append(session.step())
    cut = len(frames)
    session.set_ball(ball_for(second, session.figure.stance(frames[-1].q), rng))
    end = cut + LONGEST * RATE
    while len(frames) < cut + BLEND_FRAMES or (session.busy and len(frames) < end):
        frames.append(session.step())
    return frames, cut


def require_smooth(abilities: Abilities, seed: int) -> None:
    """The run of a seed keeps its speed limits, changes no speed suddenly, and moves no foot."""
    frames, cut = interrupted_run(abilities, seed)
    name = f"seed {seed}, {' then '.join(PAIRS[seed % len(PAIRS)])}"
    figure = abilities.figure
    _, _, velocity = derivatives(figure, np.array([frame.q for frame in frames]))
    for k, (frame, following) in enumerate(itertools.pairwise(frames)):
        limits = figure.speeds[following.speeds][6:] * (1 + 1e-6)
        assert (np.abs(velocity[k, 6:]) <= limits).all(), name
        if frame.action == following.action:
            continue
        window = velocity[max(k - 1, 0) : k + BLEND_FRAMES, 6:]
        change = np.abs(np.diff(window, axis=0))
        joint = figure.model.joint(int(change.max(axis=0).argmax()) + 1).name
        pair = f"{frame.action} to {following.action}"
        assert change.max() <= LARGEST_CHANGE, f"{name}: {pair}: {joint} {change.max():.2f} rad/s"
        if frame.action in ("walk", "jump"):
            assert (frame.contact == FLAT).all(), name
            assert frame.phase > 0.5, name
    around = frames[cut - 2 : cut + BLEND_FRAMES]
    if not any(frame.action == "jump" for frame in around):
        window = velocity[cut - 2 : cut + BLEND_FRAMES, 6:]
        change = np.abs(np.diff(window, axis=0)).max()
        assert change <= LARGEST_CHANGE, f"{name}: {change:.2f} rad/s in a frame"
    require_standing_feet(abilities, frames, name)


def require_standing_feet(abilities: Abilities, frames: list[FigureFrame], name: str) -> None:
    """No foot moves in two successive frames without a walk or a jump."""
    figure = abilities.figure
    standing = [frame for frame in frames if frame.action not in ("walk", "jump")]
    for a, b in itertools.pairwise(standing):
        if b.t - a.t > 1.5 / RATE:
            continue
        for foot in figure.feet.values():
            way = figure.pose(a.q, foot.frame)[0] - figure.pose(b.q, foot.frame)[0]
            assert np.abs(way).max() < 1e-4, name


@pytest.mark.parametrize("seed", [k for k, pair in enumerate(PAIRS) if pair[0] != pair[1]])
def test_an_interrupted_action_changes_smoothly_into_the_next(
    abilities: Abilities, seed: int
) -> None:
    require_smooth(abilities, seed)


@pytest.mark.parametrize("before_end", range(1, 8))
def test_a_ball_that_moves_at_the_end_of_a_reach_is_reached(
    abilities: Abilities, before_end: int
) -> None:
    """The reach may end before the next motion is planned."""
    session = FigureSession(abilities)
    session.set_ball((0.45, -0.25, 1.2))
    first = [session.step()]
    while session.busy:
        first.append(session.step())
    session = FigureSession(abilities)
    session.set_ball((0.45, -0.25, 1.2))
    frames = [session.step() for _ in range(len(first) - before_end)]
    session.set_ball((0.45, -0.25, 1.35))
    while session.busy:
        frames.append(session.step())
    hand = session.figure.robot.measure(frames[-1].q, "right_hand").position
    assert hand == pytest.approx([0.45, -0.25, 1.35], abs=0.005)


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_hundreds_of_interruptions_are_smooth(abilities: Abilities) -> None:
    """Of 475 at most two are abrupt."""
    abrupt: list[str] = []
    for seed in range(25, 500):
        try:
            require_smooth(abilities, seed)
        except AssertionError as error:
            abrupt.append(str(error).splitlines()[0])
    assert len(abrupt) <= 2, "\n".join(abrupt)
