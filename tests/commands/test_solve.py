"""``robot-ik solve``: the joint angles bring the frame to the goal, measured by MuJoCo."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from robot_ik.kernels import jit
from robot_ik.robot import Robot, load_robot
from robot_ik.solvers import SOLVERS

GOAL = ("-0.4", "-0.1", "0.7")


@pytest.fixture(scope="module")
def puma() -> Robot:
    return load_robot("puma560")


def site_pose(robot: Robot, site: str, q: Any) -> tuple[Any, Any]:
    """Position (3,) and rotation (3, 3) from MuJoCo alone."""
    data = mujoco.MjData(robot.model)
    for joint, angle in zip(robot.joints, q, strict=True):
        data.joint(joint).qpos[0] = angle
    mujoco.mj_kinematics(robot.model, data)
    return data.site(site).xpos.copy(), data.site(site).xmat.reshape(3, 3).copy()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("frame", ["gripper", "flange"])
def test_the_angles_reach_the_pose(seed: int, frame: str, puma: Robot, robot_ik: Any) -> None:
    q = puma.sample(np.random.default_rng(seed))
    position, rotation = site_pose(puma, frame, q)
    wxyz = np.empty(4)
    mujoco.mju_mat2Quat(wxyz, rotation.ravel())
    # repr keeps every digit; a leading minus must not be taken for an option
    numbers = [repr(float(value)) for value in (*position, *wxyz)]
    run = robot_ik("solve", "--json", "--frame", frame, "--seed", seed, "--goal", *numbers)
    assert run.code == 0, run
    facts = json.loads(run.out)
    assert facts["converged"] and facts["status"] == "converged" and facts["frame"] == frame
    found, turned = site_pose(puma, frame, facts["q"])
    assert np.linalg.norm(found - position) <= 1e-4
    angle = np.arccos(np.clip((np.trace(turned.T @ rotation) - 1) / 2, -1, 1))
    assert angle <= 1e-3 + 1e-7
    assert facts["error"]["position"] == pytest.approx(np.linalg.norm(found - position), abs=1e-12)
    assert (puma.lower <= facts["q"]).all() and (facts["q"] <= puma.upper).all()
    assert facts["joints"] == list(puma.joints)


def test_what_is_printed(robot_ik: Any) -> None:
    run = robot_ik("solve", "--json", "--goal", *GOAL)
    facts = json.loads(run.out)
    assert facts["schema"] == 2 and facts["robot"] == "puma560" and facts["frame"] == "gripper"
    assert facts["goal"] == {"position": [float(value) for value in GOAL], "wxyz": None}
    assert facts["tolerance"] == {"position": 1e-4, "angle": 1e-3}
    assert isinstance(facts["iterations"], int) and isinstance(facts["restarts"], int)
    assert 0 < facts["seconds"] < 10  # the one time
    assert not any("second" in name for name in facts if name != "seconds")


def test_the_same_seed_gives_the_same_digits(robot_ik: Any) -> None:
    runs = [
        json.loads(robot_ik("solve", "--json", "--goal", *GOAL, "--seed", 4).out) for _ in range(2)
    ]
    for facts in runs:
        del facts["seconds"]
    assert runs[0] == runs[1]


def test_a_start_at_the_goal_stays(puma: Robot, robot_ik: Any) -> None:
    q = puma.sample(np.random.default_rng(3))
    position, _ = site_pose(puma, "gripper", q)
    numbers = [repr(float(value)) for value in position]
    start = [repr(float(value)) for value in q]
    facts = json.loads(robot_ik("solve", "--json", "--goal", *numbers, "--start", *start).out)
    assert facts["iterations"] == 0 and facts["q"] == list(q)


def test_tolerance_and_budget_are_used(robot_ik: Any) -> None:
    fine = json.loads(
        robot_ik("solve", "--json", "--goal", *GOAL, "--position-tolerance", "1e-9").out
    )
    assert fine["converged"] and fine["error"]["position"] <= 1e-9
    run = robot_ik("solve", "--json", "--goal", *GOAL, "--iterations", 1)
    facts = json.loads(run.out)
    assert run.code == 1 and facts["status"] == "iteration_limit" and facts["iterations"] <= 1


@pytest.mark.parametrize("name", SOLVERS)
def test_every_solver_can_be_selected(name: str, robot_ik: Any) -> None:
    # The closed form of the PUMA needs a full pose.
    goal = (*GOAL, 0, 1, 0, 0) if name == "analytic" else GOAL
    run = robot_ik("solve", "--json", "--goal", *goal, "--solver", name)
    found_by = json.loads(run.out)["solver"]
    assert found_by == name or (name in ("auto", "combined") and found_by == "lm")
    # The recursive method is not made for hinges; it must say so by its exit code.
    assert run.code == (1 if name == "recursive" else 0), run


def test_options_of_the_method_reach_it(robot_ik: Any) -> None:
    far = (
        "solve",
        "--json",
        "--solver",
        "lm",
        "--goal",
        "-0.4",
        "-0.1",
        "0.2",
        "0",
        "0.3",
        "0.4",
        "0.5",
        "--seed",
        1,
    )
    assert json.loads(robot_ik(*far, "--restarts", 0).out)["restarts"] == 0


def test_an_unreachable_goal_is_a_result(puma: Robot, robot_ik: Any) -> None:
    run = robot_ik("solve", "--json", "--goal", 9, 0, 0)
    facts = json.loads(run.out)
    assert run.code == 1 and "Traceback" not in run.err
    assert facts["converged"] is False and facts["status"] == "unreachable"
    found, _ = site_pose(puma, "gripper", facts["q"])
    assert facts["error"]["position"] == pytest.approx(np.linalg.norm(found - [9, 0, 0]), rel=1e-9)
    at_home, _ = site_pose(puma, "gripper", puma.home)
    # The result is the nearest pose of the search.
    assert facts["error"]["position"] < np.linalg.norm(at_home - [9, 0, 0])


def test_the_table_for_people(puma: Robot, robot_ik: Any) -> None:
    run = robot_ik("solve", "--goal", *GOAL)
    assert run.code == 0 and len(run.out.splitlines()) < 25
    assert "converged" in run.out and "joint6" in run.out and "deg" in run.out
    assert "1 iteration, 0 restarts" in robot_ik("solve", "--goal", *GOAL, "--iterations", 1).out
    there = puma.forward(puma.home)
    words = ("--goal", *there.position, *there.wxyz, "--start", *(puma.home - 1e-9))
    assert "-0.000" not in robot_ik("solve", *words).out
    assert robot_ik("solve", "--goal", 9, 0, 0).code == 1


MIXED = """
<mujoco><worldbody><body><joint name="lift" type="slide" axis="0 0 1" range="0 1"/><geom size=".1"/>
  <body><joint name="neck" type="ball"/><geom size=".1"/><site name="eye" pos=".3 0 0"/></body>
</body></worldbody></mujoco>
"""


@pytest.mark.parametrize("extra", [[], ["--json"]])
def test_any_model_by_path(extra: list[str], robot_ik: Any, tmp_path: Path) -> None:
    file = tmp_path / "lift.xml"
    file.write_text(MIXED)
    run = robot_ik(
        "solve", "--robot", file, "--frame", "eye", "--goal", "0.1", "0.2", "0.6", *extra
    )
    assert run.code == 0 and "lift" in run.out and "neck" in run.out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--robot", "pumma560", "--goal", *GOAL], ["'puma560'"]),
        (["--solver", "lmm", "--goal", *GOAL], ["'lm'"]),
        (["--frame", "griper", "--goal", *GOAL], ["'gripper'"]),
        (["--goal", "nan", "0", "0"], ["nan", "finite"]),
        (["--goal", "0", "inf", "0"], ["inf", "finite"]),
        (["--goal", *GOAL, "0", "0", "0", "0"], ["zero quaternion", "w, x, y, z"]),
        (["--goal", *GOAL, "1", "0", "0", "nan"], ["nan"]),
        (["--goal", "1", "2"], ["2 numbers", "3", "7"]),
        (["--goal", *GOAL, "1"], ["4 numbers"]),
        ([], ["--goal: no goal is given", "for example"]),
        (["--robot", "nowhere/arm.xml", "--goal", *GOAL], ["nowhere/arm.xml"]),
        (["--goal", *GOAL, "--start", "1", "2"], ["start", "joint6"]),
        (["--goal", *GOAL, "--start", *["nan"] * 6], ["start", "nan"]),
        (["--goal", *GOAL, "--position-tolerance", "0"], ["tolerance"]),
        (["--goal", *GOAL, "--angle-tolerance", "nan"], ["tolerance"]),
        (["--goal", *GOAL, "--iterations", "-5"], ["iterations"]),
        (["--solver", "lm", "--goal", *GOAL, "--set", "patence=5"], ["'patience'"]),
        (["--solver", "lm", "--goal", *GOAL, "--set", "patience=-5"], ["patience", "1 to"]),
        (["--solver", "lm", "--goal", *GOAL, "--set", "patience=many"], ["patience=many", "int"]),
        (["--goal", *GOAL, "--set", "patience"], ["patience", "NAME=VALUE"]),
    ],
)
def test_wrong_input(arguments: list[str], named: list[str], robot_ik: Any) -> None:
    run = robot_ik("solve", *arguments)
    run.assert_one_screen_error()
    for text in named:
        assert text in run.err, run.err


def test_a_broken_model_names_file_and_reason(robot_ik: Any, tmp_path: Path) -> None:
    file = tmp_path / "broken.xml"
    file.write_text(
        '<mujoco><worldbody><body><joint type="hindge"/><geom size="1"/></body>'
        "</worldbody></mujoco>"
    )
    run = robot_ik("solve", "--robot", file, "--goal", *GOAL)
    run.assert_one_screen_error()
    assert str(file) in run.err and "hindge" in run.err


def test_as_a_program(robot_ik: Any, robot_ik_child: Any) -> None:
    run = robot_ik_child("solve", "--json", "--goal", *GOAL)
    assert run.code == 0 and json.loads(run.out)["converged"]
    assert "\x1b" not in run.out + run.err
    robot_ik("solve", "--json", "--goal", "nan", "0", "0").assert_one_screen_error()


def test_a_compilation_is_announced_on_stderr(
    robot_ik: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without cached kernels one line about the compilation is printed. stdout has JSON only."""
    # The kernel itself is loaded: this test needs no compiler.
    robot_ik("solve", "--json", "--goal", *GOAL)
    monkeypatch.setattr(jit, "cache_folder", lambda module: tmp_path)
    monkeypatch.setattr(jit, "_announced", set())
    run = robot_ik("solve", "--json", "--goal", *GOAL)
    assert "compiling" in run.err and len(run.err.splitlines()) == 1, run.err
    assert json.loads(run.out)["converged"]
    assert robot_ik("solve", "--json", "--goal", *GOAL).err == ""


@pytest.mark.soak
def test_the_first_compilation_of_all_is_announced(robot_ik_child: Any, tmp_path: Path) -> None:
    run = robot_ik_child(
        "solve", "--json", "--solver", "ccd", "--goal", *GOAL, XDG_CACHE_HOME=str(tmp_path)
    )
    compiling, *others = run.err.splitlines()
    assert compiling.startswith("compiling solver 'ccd'") and others in ([], ["solve …"]), run.err
    assert json.loads(run.out)["solver"] == "ccd"


def test_a_figure_keeps_its_feet_by_default(robot_ik: Any) -> None:
    figure = load_robot("humanoid")
    feet = {name: figure.measure(figure.home, name) for name in ("left_foot", "right_foot")}
    goal = ("--goal", "0.45", "-0.3", "1.2")
    for options, kept in (((), list(feet)), (("--free-feet",), [])):
        run = robot_ik("solve", "--json", "--robot", "humanoid", *goal, *options)
        assert run.code == 0, run
        facts = json.loads(run.out)
        assert facts["kept"] == kept and facts["frame"] == "right_hand"
        q = np.array(facts["q"])
        assert np.linalg.norm(figure.measure(q).position - (0.45, -0.3, 1.2)) < 1e-3
        moved = [figure.measure(q, name).distance(home)[0] for name, home in feet.items()]
        assert not kept or max(moved) < 1e-3
    run = robot_ik("solve", "--json", "--robot", "humanoid", "--solver", "dls", *goal)
    assert json.loads(run.out)["kept"] == list(feet), "a method without priorities keeps them, too"


def test_base_and_joints_choose_what_moves(robot_ik: Any) -> None:
    goal = ("--goal", "0.3", "-0.35", "1.3")
    run = robot_ik("solve", "--json", "--robot", "humanoid", "--base", "torso", *goal)
    facts = json.loads(run.out)
    assert "right_elbow_pitch" in facts["joints"] and "left_elbow_pitch" not in facts["joints"]
    assert facts["kept"] == [], "nothing moves the feet"
    run = robot_ik("solve", "--json", "--joints", "joint1", "joint2", "joint3", "--goal", *GOAL)
    assert json.loads(run.out)["joints"] == ["joint1", "joint2", "joint3"]
    run = robot_ik("solve", "--robot", "humanoid", "--base", "head", *goal)
    assert run.code == 2 and "right_hand" in run.err
    run = robot_ik("solve", "--json", "--robot", "chain:4", "--goal", "1", "1", "2")
    assert run.code == 0 and json.loads(run.out)["robot"] == "chain4"
