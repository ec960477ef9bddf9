"""A robot of numbers only: enough for planning in joint space, with no model file behind it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest


@dataclass(frozen=True)
class NumberRobot:
    """What `joint_move` reads of a robot."""

    joints: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    velocity_limits: np.ndarray
    acceleration_limits: np.ndarray
    name: str = "numbers"
    nq: int = field(default=0)
    nv: int = field(default=0)


def make_number_robot(velocity, acceleration, lower=None, upper=None, extra_q=0):
    n = len(velocity)
    return NumberRobot(
        joints=tuple(f"j{k}" for k in range(n)),
        lower=np.full(n, -3.0) if lower is None else np.array(lower, dtype=float),
        upper=np.full(n, 3.0) if upper is None else np.array(upper, dtype=float),
        velocity_limits=np.array(velocity, dtype=float),
        acceleration_limits=np.array(acceleration, dtype=float),
        nq=n + extra_q,
        nv=n,
    )


@pytest.fixture(scope="session")
def number_robot():
    """Factory of `NumberRobot`."""
    return make_number_robot


@pytest.fixture(scope="session")
def puma():
    """The shipped PUMA 560."""
    from robot_ik.robot import load_robot

    return load_robot("puma560")
