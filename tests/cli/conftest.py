"""Fixtures of the former commands; those of all commands are in ``tests/commands``."""

from __future__ import annotations

from tests.commands.conftest import (
    Desk,
    Run,
    _plain_environment,
    arm_file,
    desk,
    robot_ik,
    robot_ik_child,
)

__all__ = ["Desk", "Run", "_plain_environment", "arm_file", "desk", "robot_ik", "robot_ik_child"]
