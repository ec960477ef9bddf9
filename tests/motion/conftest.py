"""Robots with any limits, for planning in joint space."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from robot_ik.robot import Robot, load_robot


@cache
def slides_robot(lower: tuple[float, ...], upper: tuple[float, ...], balls: int) -> Robot:
    """Return a robot of slides with limits, and of balls behind them."""
    body = "".join(
        f'<body><joint name="b{k}" type="ball"/><geom size="0.1"/></body>' for k in range(balls)
    )
    for k in reversed(range(len(lower))):
        limits = f'range="{lower[k]!r} {upper[k]!r}" limited="true"'
        joint = f'<joint name="j{k}" type="slide" {limits}/>'
        body = f'<body name="link{k}">{joint}<geom size="0.1"/>{body}</body>'
    return load_robot(f'<mujoco model="numbers"><worldbody>{body}</worldbody></mujoco>')


def make_number_robot(velocity, acceleration, lower=None, upper=None, balls=0):
    n = len(velocity)
    low = (-3.0,) * n if lower is None else tuple(lower)
    high = (3.0,) * n if upper is None else tuple(upper)
    robot = slides_robot(low, high, balls)
    ones = np.ones(3 * balls)
    return replace(
        robot,
        velocity_limits=np.append(np.array(velocity, dtype=float), ones),
        acceleration_limits=np.append(np.array(acceleration, dtype=float), ones),
    )


@pytest.fixture(scope="session")
def number_robot():
    """Factory of robots of slides with the given motion limits."""
    return make_number_robot


@pytest.fixture(scope="session")
def puma():
    """The bundled PUMA 560."""
    return load_robot("puma560")
