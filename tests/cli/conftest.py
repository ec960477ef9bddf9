"""Fixtures of the former commands; those of all commands are in ``tests/commands``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tests.commands.conftest import (
    Desk,
    Run,
    _plain_environment,
    arm_file,
    desk,
    robot_ik,
    robot_ik_child,
)
from tests.hardware.joints import with_servo

__all__ = ["Desk", "Run", "_plain_environment", "arm_file", "desk", "robot_ik", "robot_ik_child"]


Hand = Callable[[str, Callable[[], object]], None]


@pytest.fixture
def nominal(desk: Desk, tmp_path: Path) -> Path:
    """The arm file before calibration: zeros and directions nobody has looked at."""
    joints = tuple(with_servo(j, direction=1, zero_ticks=2048) for j in desk.config.joints)
    path = tmp_path / "nominal.toml"
    replace(desk.config, joints=joints, file=None).save(path)
    return path


@pytest.fixture
def calibrate(
    robot_ik: Callable[..., Run], desk: Desk, nominal: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Run]:
    """``calibrate(hand, options …)``: ``hand(step, sample)`` does what the step asks for."""
    from robot_ik.cli import servo_hand
    from robot_ik.jobs import hand_guiding

    def run(hand: Hand, *options: object) -> Run:
        class Scripted:
            def __init__(self, *options: object) -> None:
                pass

            def step(self, text: str, sample: Callable[[], object]) -> None:
                hand(text, sample)
                sample()

            def note(self, text: str) -> None:
                pass

            def again(self, error: Exception) -> bool:
                return False

        monkeypatch.setattr(servo_hand, "Prompts", Scripted)
        monkeypatch.setattr(hand_guiding, "STILL_SAMPLES", 2)
        arm = () if "--arm" in options else ("--arm", nominal)
        return robot_ik("servo", "calibrate", tmp_path / "mine.toml", "--bus", desk.port, *arm, *options)

    return run


def _good_hand(desk: Desk, reach: float = 95.0, pose: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Hand:
    """Sweeps each joint ``reach`` degrees both ways, goes to the pose, wiggles in the positive direction."""

    def hand(text: str, sample: Callable[[], object]) -> None:
        if text.startswith("1."):
            for joint in desk.config.names:
                for way in (*[reach / 2] * 2, *[-reach / 2] * 4, *[reach / 2] * 2):
                    desk.turn(joint, way)
                    sample()
        elif text.startswith("2."):
            for joint, degrees in zip(desk.config.names, pose, strict=True):
                desk.turn(joint, degrees)
        else:
            (joint,) = [name for name in desk.config.names if name in text]
            desk.turn(joint, 10.0)

    return hand


@pytest.fixture
def good_hand(desk: Desk) -> Callable[..., Hand]:
    """``good_hand(reach=…, pose=…)``: one that does what ``calibrate`` asks for."""
    return lambda **wishes: _good_hand(desk, **wishes)


@pytest.fixture
def mine(calibrate: Callable[..., Run], desk: Desk, tmp_path: Path) -> Path:
    """A calibrated arm."""
    assert calibrate(_good_hand(desk)).code == 0
    return tmp_path / "mine.toml"
