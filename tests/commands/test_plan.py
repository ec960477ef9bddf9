"""``robot-ik plan``: the motion that it writes keeps away from the obstacles of the scene file."""

import itertools
import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.collision.obstacle_file import load_obstacles

SCENE = """<mujoco><worldbody>
  <geom name="post" type="box" size=".03 .03 .6" pos="-.45 -.3 .6"/>
  <geom name="ceiling" type="box" size=".6 .6 .02" pos="0 0 1.6"/>
</worldbody></mujoco>"""

MARGIN = 0.004


@pytest.fixture
def scene_file(tmp_path):
    file = tmp_path / "scene.xml"
    file.write_text(SCENE)
    return file


def ends(robot, scene):
    """Start and goal, free, on both sides of the post."""
    rng = np.random.default_rng(1)
    rows = np.array([robot.sample(rng) for _ in range(400)])
    rows = rows[scene.free(rows, 3 * MARGIN)]
    shares = np.linspace(0.0, 1.0, 200)[:, None]
    for first, last in itertools.pairwise(rows):
        if not scene.free(first + shares * (last - first), MARGIN).all():
            return first, last
    raise AssertionError("no blocked line")


def test_the_motion_is_written_and_free(robot_ik, scene_file, tmp_path):
    robot = rik.load_robot("puma560")
    scene = rik.Scene(robot, load_obstacles(scene_file))
    start, goal = ends(robot, scene)
    out = tmp_path / "motion.csv"
    arguments = ("plan", "--scene", scene_file, "--margin", MARGIN, "--start", *start.tolist())
    run = robot_ik(*arguments, "--goal-q", *goal.tolist(), "--out", out, "--json")
    assert run.code == 0, run
    facts = json.loads(run.out)
    assert facts["schema"] == 1
    assert facts["found"]
    assert facts["status"] == "found"
    assert facts["certified"]
    assert facts["clearance"] == facts["margin"] == MARGIN
    assert facts["corners"][0] == start.tolist()
    assert facts["corners"][-1] == goal.tolist()
    motion = rik.Trajectory.load_csv(out)
    assert motion.joints == robot.joints
    assert motion.duration == pytest.approx(facts["duration"])
    assert all(scene.clearance(q).distance >= MARGIN - 1e-6 for q in motion.q)
    again = robot_ik(*arguments, "--goal-q", *goal.tolist(), "--json")
    assert json.loads(again.out)["corners"] == facts["corners"]


def test_the_table_names_proof_and_corners(robot_ik, scene_file):
    robot = rik.load_robot("puma560")
    goal = robot.forward(robot.home).position - (0.0, 0.0, 0.05)
    run = robot_ik("plan", "--scene", scene_file, "--goal", *goal.tolist())
    assert run.code == 0, run
    assert "every part keeps 5.0 mm" in run.out
    assert "joint1" in run.out
    assert "goal" in run.out


def test_a_goal_in_an_obstacle_is_not_achieved(robot_ik, scene_file):
    run = robot_ik("plan", "--scene", scene_file, "--goal", -0.45, -0.3, 0.8, "--json")
    assert run.code == 1
    facts = json.loads(run.out)
    assert facts["status"] == "goal_blocked"
    assert "post" in facts["meaning"]
    assert facts["corners"] is None
    assert facts["duration"] is None


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--goal", "0.1"),
        ("--goal", "0", "0", "1", "--goal-q", "0", "0", "0", "0", "0", "0"),
        ("--goal-q", "0", "0"),
        ("--goal-q", "0", "0", "0", "0", "0", "nan"),
        ("--goal", "-0.4", "-0.1", "0.7", "--start", "1"),
        ("--goal", "-0.4", "-0.1", "0.7", "--margin", "-1"),
        ("--goal", "-0.4", "-0.1", "0.7", "--scene", "missing.xml"),
        ("--goal", "-0.4", "-0.1", "0.7", "--allowed", "gripper"),
        ("--goal", "-0.4", "-0.1", "0.7", "--ignore", "gripper:moon"),
        ("--goal", "-0.4", "-0.1", "0.7", "--robot", "humanoid"),
    ],
)
def test_wrong_input_is_one_sentence(robot_ik, arguments):
    robot_ik("plan", *arguments).assert_one_screen_error()


def test_an_existing_file_is_kept(robot_ik, tmp_path):
    out = tmp_path / "motion.csv"
    out.write_text("mine")
    robot_ik("plan", "--goal", -0.4, -0.1, 0.7, "--out", out).assert_one_screen_error()
    assert out.read_text() == "mine"


def test_reach_refuses_a_blocked_motion_and_goes_round_with_avoid(robot_ik, tmp_path):
    robot = rik.load_robot("puma560")
    goal = robot.home.copy()
    goal[0] += 0.9
    middle = robot.forward(0.5 * (robot.home + goal)).position
    position = " ".join(map(str, middle.tolist()))
    post = f'<geom name="post" type="box" size=".02 .02 .1" pos="{position}"/>'
    file = tmp_path / "post.xml"
    file.write_text(f"<mujoco><worldbody>{post}</worldbody></mujoco>")
    scene = rik.Scene(robot, load_obstacles(file))
    assert scene.free(robot.home, 0.006)
    assert scene.free(goal, 0.006)
    pose = robot.forward(goal)
    numbers = [*pose.position.tolist(), *pose.wxyz.tolist()]
    out = tmp_path / "reach"
    common = ("reach", "--bus", "sim", "--goal", *numbers, "--scene", file, "--out", out)
    refused = robot_ik(*common, "--overwrite")
    assert refused.code == 1
    assert "would touch post" in refused.err
    round_it = robot_ik(*common, "--overwrite", "--avoid", "--json")
    assert round_it.code == 0, round_it
    motion = rik.Trajectory.load_csv(out / "trajectory.csv")
    assert len(motion) > 10
    assert all(scene.clearance(q).distance > 0.0045 for q in motion.q)
    robot_ik("reach", "--avoid", "--line").assert_one_screen_error()
    robot_ik("reach", "--avoid", "--follow").assert_one_screen_error()
    robot_ik("reach", "--scene", tmp_path / "missing.xml").assert_one_screen_error()


WALL = """<mujoco><worldbody>
  <geom name="wall" type="box" size=".01 3 3"/>
  <body name="car"><joint name="x" type="slide" axis="1 0 0" range="-1 1"/>
    <joint name="y" type="slide" axis="0 1 0" range="-1 1"/><geom type="sphere" size=".05"/></body>
</worldbody></mujoco>"""


CHILD = """import sys, threading
from robot_ik.commands.main import main
from robot_ik.motion import plan as module
search = module.plan

def plan(*arguments, **options):
    threading.Timer(1.0, print, ("searching",), {"file": sys.stderr, "flush": True}).start()
    return search(*arguments, **options)

module.plan = plan
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for a child")
def test_ctrl_c_ends_an_endless_search(tmp_path):
    """The search itself prints the line about the work in progress."""
    (tmp_path / "wall.xml").write_text(WALL)
    arguments = ["plan", "--robot", str(tmp_path / "wall.xml"), "--start", "-0.5", "0"]
    arguments += ["--goal-q", "0.5", "0", "--iterations", str(1 << 40)]
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stderr is not None
    for line in child.stderr:
        if "searching" in line:
            break
    child.send_signal(signal.SIGINT)
    _, rest = child.communicate(timeout=60)
    assert child.returncode == 130
    assert "Traceback" not in rest
