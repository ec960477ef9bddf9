"""A figure that is shown another ball at a random moment: reach, bend, jump, walk and nothing, each for each.

No joint's speed changes at once, no speed limit is broken, feet stay where they stand; a walk is left at
rest on both feet after its next steps, a jump never in the air.
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
# A motion that is left decays within this many frames (``actions.BLEND``).
_WINDOW = 26
_MOST = 2.0  # rad/s in a frame
_LONGEST = 20.0  # s


def a_ball(kind: str, stance: Array, rng: np.random.Generator) -> tuple[float, float, float] | None:
    """Somewhere where a figure at ``stance`` would do that."""
    side = float(rng.choice([-1.0, 1.0]))
    low, high = {
        "reach": ((0.35, 0.1, 1.0), (0.5, 0.35, 1.5)),
        "bend": ((0.4, 0.15, 0.2), (0.5, 0.3, 0.45)),
        "jump": ((0.1, 0.1, 2.3), (0.2, 0.25, 2.4)),
        "walk": ((-2.0, 0.9, 1.0), (2.5, 1.8, 1.3)),
        "nothing": ((0.5, 0.0, 3.5), (0.5, 0.0, 3.5)),
    }[kind]
    if kind == "nothing" and side < 0:
        return None
    x, y, z = rng.uniform(low, high) * [1.0, side, 1.0]
    x, y, z = axis_rotations("z", float(stance[2])) @ np.array([x, y, z]) + [stance[0], stance[1], 0.0]
    return float(x), float(y), float(z)


def interrupted(abilities: Abilities, seed: int) -> tuple[list[FigureFrame], int]:
    """Frames until the second ball is dealt with, and when it came."""
    rng = np.random.default_rng(seed)
    first, second = PAIRS[seed % len(PAIRS)]
    session = FigureSession(abilities)
    session.set_ball(a_ball(first, np.zeros(3), rng))
    frames = [session.step()]
    while session.busy and frames[-1].action == "stand":
        frames.append(session.step())
    for _ in range(int(rng.integers(2, {"walk": 240, "jump": 120}.get(first, 60)))):
        frames.append(session.step())
    cut = len(frames)
    session.set_ball(a_ball(second, session.figure.stance(frames[-1].q), rng))
    while len(frames) < cut + _WINDOW or (session.busy and len(frames) < cut + _LONGEST * RATE):
        frames.append(session.step())
    return frames, cut


def require_smooth(abilities: Abilities, seed: int) -> None:
    frames, cut = interrupted(abilities, seed)
    name = f"seed {seed}, {' then '.join(PAIRS[seed % len(PAIRS)])}"
    figure, q = abilities.figure, np.array([f.q for f in frames])
    _, _, speed = derivatives(figure, q)
    for k, frame in enumerate(frames[:-1]):
        assert (np.abs(speed[k, 6:]) <= figure.speeds[frames[k + 1].speeds][6:] * (1 + 1e-6)).all(), name
        left, after = frame.action, frames[k + 1].action
        if left != after:
            change = np.abs(np.diff(speed[max(k - 1, 0) : k + _WINDOW, 6:], axis=0))
            worst = figure.model.joint(int(change.max(axis=0).argmax()) + 1).name
            assert change.max() <= _MOST, f"{name}: {left} to {after}: {worst} {change.max():.2f} rad/s"
        if left in ("walk", "jump") and left != after:
            assert (frame.contact == FLAT).all() and frame.phase > 0.5, name
    change = np.abs(np.diff(speed[cut - 2 : cut + _WINDOW, 6:], axis=0)).max()
    around = {f.action for f in frames[cut - 2 : cut + _WINDOW]}
    if "jump" not in around:
        assert change <= _MOST, f"{name}: {change:.2f} rad/s in a frame"
    standing = [f for f in frames if f.action not in ("walk", "jump")]
    for foot in figure.feet.values():
        for a, b in itertools.pairwise(standing):
            if b.t - a.t < 1.5 / RATE:
                moved = figure.pose(a.q, foot.frame)[0] - figure.pose(b.q, foot.frame)[0]
                assert np.abs(moved).max() < 1e-4, name


@pytest.mark.parametrize("seed", [k for k, pair in enumerate(PAIRS) if pair[0] != pair[1]])
def test_an_action_that_is_interrupted_goes_over_smoothly(abilities: Abilities, seed: int) -> None:
    require_smooth(abilities, seed)


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_hundreds_of_interruptions_go_over_smoothly(abilities: Abilities) -> None:
    """Of 475 at most two are abrupt: none was when this was written."""
    abrupt: list[str] = []
    for seed in range(25, 500):
        try:
            require_smooth(abilities, seed)
        except AssertionError as error:
            abrupt.append(str(error).splitlines()[0])
    assert len(abrupt) <= 2, "\n".join(abrupt)
