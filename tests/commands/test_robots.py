"""``robot-ik robots``: its output is the content of the model folders."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from robot_ik.robot import load_robot
from robot_ik.robot_file import catalogue

MIXED = """
<mujoco><worldbody><body name="base"><freejoint name="float"/><geom size=".1"/>
  <body name="arm"><joint name="turn" axis="0 0 1"/><geom size=".1"/>
    <body name="rod"><joint name="push" type="slide" range="-.1 .2"/><geom size=".1"/>
      <body name="cup"><joint name="socket" type="ball" range="0 90"/><geom size=".1"/>
        <site name="tip"/></body>
</body></body></body></worldbody></mujoco>
"""


def test_every_robot_is_listed(robot_ik: Any) -> None:
    run = robot_ik("robots")
    assert run.code == 0 and "puma560" in catalogue()
    for name in catalogue():
        line = next(line for line in run.out.splitlines() if line.startswith(name))
        robot = load_robot(name)
        assert str(len(robot.joints)) in line.split()
        assert robot.tool in line and robot.file.title in line


def test_the_list_as_json(robot_ik: Any) -> None:
    rows = json.loads(robot_ik("robots", "--json").out)["robots"]
    assert [row["name"] for row in rows] == list(catalogue())
    puma = next(row for row in rows if row["name"] == "puma560")
    assert puma["tools"][0] == "gripper" and "flange" in puma["tools"]
    assert puma["joints"] == list(load_robot("puma560").joints)
    assert Path(puma["arm_file"]).is_file()


def test_the_list_loads_no_model() -> None:
    code = (
        "import sys; from robot_ik.commands.main import main; main(['robots']); "
        "sys.exit('mujoco' in sys.modules)"
    )

    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def test_one_robot_in_degrees(robot_ik: Any) -> None:
    robot = load_robot("puma560")
    run = robot_ik("robots", "puma560")
    assert run.code == 0
    for k, joint in enumerate(robot.joints):
        cells = next(line.split() for line in run.out.splitlines() if line.startswith(joint + " "))
        assert cells[1] == "hinge" and cells[-1] == "deg"
        shown = [float(cell) for cell in cells[2:5]]
        wanted = [robot.lower[k], robot.upper[k], robot.home[k]]
        assert shown == pytest.approx([math.degrees(value) for value in wanted], abs=0.051)
    assert "gripper (default)" in run.out and str(robot.path) in run.out


def test_one_robot_as_json_keeps_every_digit(robot_ik: Any) -> None:
    robot = load_robot("puma560")
    facts = json.loads(robot_ik("robots", "puma560", "--json").out)
    for name in ("lower", "upper", "home", "velocity_limits", "acceleration_limits"):
        assert facts[name] == list(getattr(robot, name))
    assert set(facts["frames"]) == set(robot.frames)
    assert facts["schema"] == 1


def test_any_model_with_every_kind_of_joint(robot_ik: Any, tmp_path: Path) -> None:
    file = tmp_path / "mixed.xml"
    file.write_text(MIXED)
    run = robot_ik("robots", file)
    assert run.code == 0
    rows = {line.split()[0]: line.split() for line in run.out.splitlines() if line.strip()}
    assert rows["float"][1] == "free" and rows["socket"][1] == "ball"
    assert rows["push"][1:5] == ["slide", "-0.1", "0.2", "0"] and rows["push"][-1] == "m"
    assert rows["turn"][2:4] == ["-", "-"]  # no limits
    assert rows["socket"][3] == "90.0"
    assert json.loads(robot_ik("robots", file, "--json").out)["lower"][6] is None  # minus infinity


def test_unknown_robot_names_the_close_one(robot_ik: Any) -> None:
    run = robot_ik("robots", "pumma560")
    run.assert_one_screen_error()
    assert "'puma560'" in run.err


def test_a_broken_model_names_file_and_reason(robot_ik: Any, tmp_path: Path) -> None:
    file = tmp_path / "broken.xml"
    file.write_text("<mujoco><worldbody><body><geom/></body>")
    run = robot_ik("robots", file)
    run.assert_one_screen_error()
    assert str(file) in run.err and "XML" in run.err


def test_a_model_with_nameless_and_free_joints_is_shown(robot_ik: Any, tmp_path: Path) -> None:
    path = tmp_path / "float.xml"
    path.write_text(
        '<mujoco><worldbody><body name="a"><freejoint/><geom size=".1"/><body><joint axis="0 0 1"/>'
        '<geom size=".1"/><site name="tip"/></body></body></worldbody></mujoco>'
    )
    run = robot_ik("robots", path)
    assert run.code == 0 and "joint_0  free" in run.out and "joint_1  hinge" in run.out
    assert robot_ik("solve", "--robot", path, "--goal", 0.1, 0.2, 0.3).code == 0
