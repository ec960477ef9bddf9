"""The table of joint positions: its columns, and the cells without a value."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest

from robot_ik.errors import ConfigError
from robot_ik.geometry import Pose
from robot_ik.motion.joint_table import JointTable, Moment, read_positions, table_text

JOINTS = ("a", "b, upper")


def test_each_kind_of_value_has_its_columns() -> None:
    table = JointTable(JOINTS, ("phase",))
    goal = Pose((1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0))
    moment = Moment(
        0.5,
        commanded=np.array([0.1, 0.2]),
        measured=np.array([0.3, 0.4]),
        goal=goal,
        text="on",
        robot=2,
        extra={"phase": 0.25},
    )
    assert dict(zip(table.header, table.row(moment), strict=True)) == {
        "time_s": 0.5,
        "robot": 2,
        "commanded.a": 0.1,
        "commanded.b, upper": 0.2,
        "measured.a": 0.3,
        "measured.b, upper": 0.4,
        "goal_x": 1.0,
        "goal_y": 2.0,
        "goal_z": 3.0,
        "goal_qw": 0.0,
        "goal_qx": 1.0,
        "goal_qy": 0.0,
        "goal_qz": 0.0,
        "text": "on",
        "phase": 0.25,
    }


def test_a_table_of_known_moments_has_no_empty_columns() -> None:
    moments = [
        Moment(0.0, measured=np.zeros(2)),
        Moment(0.1, text="late"),
        Moment(0.2, measured=np.ones(2)),
    ]
    rows = list(csv.reader(io.StringIO(table_text(JOINTS, moments, ("phase",)))))
    assert rows == [
        ["time_s", "measured.a", "measured.b, upper", "text"],
        ["0.0", "0.0", "0.0", ""],
        ["0.1", "", "", "late"],
        ["0.2", "1.0", "1.0", ""],
    ]


def test_the_robots_of_a_table_are_kept_apart(tmp_path: Path) -> None:
    file = tmp_path / "two.csv"
    moments = [Moment(0.1 * k, commanded=np.zeros(2), robot=k) for k in range(2)]
    file.write_text(table_text(JOINTS, moments))
    with pytest.raises(ConfigError, match="several robots"):
        read_positions(file)


def test_joints_are_read_in_the_given_order(tmp_path: Path) -> None:
    file = tmp_path / "one.csv"
    file.write_text(table_text(JOINTS, [Moment(0.0, commanded=np.array([0.1, 0.2]))]))
    positions = read_positions(file, JOINTS[::-1])
    assert positions.joints == JOINTS[::-1]
    assert positions.q.tolist() == [[0.2, 0.1]]
    with pytest.raises(ConfigError, match="no column of the joint 'c'"):
        read_positions(file, ("a", "c"))
