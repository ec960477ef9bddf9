"""``[collisions]`` of an arm file in reach, scripts and teleoperation, on virtual time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import (
    ConfigError,
    MotionBlockedError,
    NotConvergedError,
    UnsafeCommandError,
)
from robot_ik.goals import PoseGoal
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.ports import Array
from robot_ik.robot_arm import open_robot
from robot_ik.script import ScriptRequest, parse_script, run_script
from robot_ik.workcell.arm_guard import ArmGuard
from robot_ik.workcell.guided_motion import playable
from robot_ik.workcell.jog import KeyboardJog
from robot_ik.workcell.leader_arm import LeaderArm
from robot_ik.workcell.motion_condition import motion_condition
from robot_ik.workcell.robot_setup import ArmRequest, prepare_robot
from robot_ik.workcell.teleop import teleoperate
from tests.commands.reach_runs import run_reach

NAME = "tabletop_puma"

BALL = """<mujoco><worldbody>
<geom name="ball" size="{radius}" pos="{x} {y} {z}"/>
</worldbody></mujoco>"""


def arm_with(folder: Path, keys: str) -> Path:
    """The arm file of the tabletop PUMA with a table ``[collisions]``."""
    text = Path(ArmConfig.load(NAME).file or "").read_text(encoding="utf-8")
    path = folder / "arm.toml"
    path.write_text(text.replace("[bus]", f"[collisions]\n{keys}\n\n[bus]", 1), encoding="utf-8")
    return path


def with_ball(folder: Path, position: Array, radius: float = 0.02) -> Path:
    """The same with a ball in its scene."""
    x, y, z = position.tolist()
    text = BALL.format(radius=radius, x=x, y=y, z=z)
    (folder / "scene.xml").write_text(text, encoding="utf-8")
    return arm_with(folder, 'scene = "scene.xml"\nmargin = 0.004')


@pytest.fixture(scope="module")
def robot() -> rik.Robot:
    return rik.load_robot(NAME)


@pytest.fixture(scope="module")
def goal(robot: rik.Robot) -> Array:
    """Joint angles (nq,) to which a turn of the first joint leads."""
    q = robot.home.copy()
    q[0] += 0.8
    return q


def middle(robot: rik.Robot, goal: Array) -> Array:
    return robot.forward(0.5 * (robot.home + goal)).position


def test_the_table_is_read_and_written_again(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(BALL.format(radius=0.1, x=1, y=0, z=0), encoding="utf-8")
    keys = 'scene = "scene.xml"\nmargin = 0.002\nground = -0.1\nignore = [["link1", "base"]]'
    config = ArmConfig.load(arm_with(tmp_path, keys))
    table = config.collisions
    assert table is not None
    assert Path(table.scene) == tmp_path / "scene.xml"
    assert (table.margin, table.ground, table.ignore) == (0.002, -0.1, (("link1", "base"),))
    other = tmp_path / "elsewhere"
    other.mkdir()
    config.save(other / "arm.toml")
    assert 'scene = "../scene.xml"' in (other / "arm.toml").read_text(encoding="utf-8")
    again = ArmConfig.load(other / "arm.toml")
    assert again.collisions is not None
    assert Path(again.collisions.scene).resolve() == (tmp_path / "scene.xml").resolve()
    assert again.collisions.ignore == table.ignore
    assert ArmConfig.load(NAME).collisions is None


def test_an_opened_robot_has_the_condition_of_its_arm_file(
    tmp_path: Path, robot: rik.Robot
) -> None:
    assert open_robot(NAME).collisions is None
    file = arm_with(tmp_path, "ground = -0.02")
    opened = open_robot(NAME, file)
    assert opened.collisions is not None
    assert opened.collisions.margin == 0.005
    assert [item.name for item in opened.collisions.scene.obstacles] == ["ground"]
    solution = rik.solve(opened.robot, robot.forward(robot.home), collisions=opened.collisions)
    assert solution.converged


def test_the_fingers_of_a_gripper_count_where_they_are(tmp_path: Path, robot: rik.Robot) -> None:
    """At the end of the motion a ball touches the fingers if they are open."""
    fingers = ["finger_left", "finger_right"]
    whole = rik.load_robot(NAME, joints=[*robot.joints, *fingers])

    def posture(q: Array, opening: float) -> Array:
        angles = dict(zip(robot.joints, q.tolist(), strict=True)) | {"finger_left": opening}
        return whole.apply_couplings([angles.get(name, 0.0) for name in whole.joints])

    begin = robot.home.copy()
    begin[5] += 0.5
    body = whole.model.body("finger_left").id
    closed, opened = (whole.data_at(posture(robot.home, x)).xpos[body].copy() for x in (0.0, 0.018))
    outwards = (opened - closed) / np.linalg.norm(opened - closed)
    for distance in np.linspace(0.0, 0.06, 61):
        file = with_ball(tmp_path, opened + distance * outwards, 0.004)
        scene = rik.Scene(whole, rik.load_obstacles(tmp_path / "scene.xml"))
        clear = [scene.clearance(posture(robot.home, x)).distance for x in (0.0, 0.018)]
        if clear[0] > 0.008 and clear[1] < 0.003:
            break
    else:
        pytest.fail("no place touches the open fingers only")
    guard = ArmGuard(ArmConfig.load(file))
    move = rik.joint_move(robot, begin, robot.home)
    positions = dict(zip(robot.joints, begin.tolist(), strict=True))
    assert guard.checked(move, positions | {"finger_left": 0.0}).certified
    with pytest.raises(MotionBlockedError, match=r"finger_left would .* ball"):
        guard.checked(move, positions | {"finger_left": 0.018})


def test_reach_refuses_before_torque_with_a_reason(
    tmp_path: Path, robot: rik.Robot, goal: Array
) -> None:
    file = with_ball(tmp_path, middle(robot, goal))
    pose = robot.forward(goal)
    free = run_reach(robot=NAME, goal=PoseGoal.at(None, pose))
    assert free.error is None
    report = run_reach(robot=NAME, arm=str(file), goal=PoseGoal.at(None, pose))
    assert isinstance(report.error, MotionBlockedError)
    assert "ball" in str(report.error)
    assert 0.0 < report.error.time < 3.0
    assert report.execution is None
    servos = report.setup.opened.virtual_bus  # type: ignore[union-attr]
    assert servos is not None
    assert not any(servo.torque for servo in servos.servos)
    assert report.setup.true_q() == pytest.approx(robot.home, abs=2e-3)


def test_reach_reports_a_colliding_goal(tmp_path: Path, robot: rik.Robot, goal: Array) -> None:
    pose = robot.forward(goal)
    file = with_ball(tmp_path, pose.position)
    report = run_reach(robot=NAME, arm=str(file), goal=PoseGoal.at(None, pose))
    assert isinstance(report.error, NotConvergedError)
    assert "ball" in str(report.error)
    assert report.execution is None


def test_reach_arrives_by_a_free_way(tmp_path: Path, robot: rik.Robot, goal: Array) -> None:
    file = with_ball(tmp_path, middle(robot, goal) + np.array((0.0, 0.0, 0.2)))
    wanted = PoseGoal.at(None, robot.forward(goal))
    report = run_reach(robot=NAME, arm=str(file), goal=wanted)
    assert report.error is None
    assert report.trajectory is not None
    assert report.trajectory.certified


def test_reach_goes_around_the_obstacles_of_the_arm_file(
    tmp_path: Path, robot: rik.Robot, goal: Array
) -> None:
    file = with_ball(tmp_path, middle(robot, goal))
    wanted = PoseGoal.at(None, robot.forward(goal))
    report = run_reach(robot=NAME, arm=str(file), goal=wanted, avoid=True)
    assert report.error is None
    assert report.trajectory is not None and report.trajectory.certified
    scene = rik.Scene(robot, rik.load_obstacles(tmp_path / "scene.xml"))
    clearances = [scene.clearance(q).distance for q in report.trajectory.q]
    assert min(clearances) >= 0.004 - 1e-6, "the margin of the arm file is not kept"


def test_a_scene_of_the_request_comes_before_that_of_the_arm_file(
    tmp_path: Path, robot: rik.Robot
) -> None:
    (tmp_path / "other.xml").write_text(BALL.format(radius=0.05, x=1, y=0, z=0), encoding="utf-8")
    other = tmp_path / "other.xml"
    arm_condition = rik.CollisionAvoidance(rik.Scene(robot), margin=0.004)
    assert motion_condition(robot, None, False, arm_condition) is None
    assert motion_condition(robot, None, True, arm_condition) is arm_condition
    alone = motion_condition(robot, None, True, None)
    assert alone is not None and alone.scene.obstacles == ()
    for avoid in (False, True):
        given = motion_condition(robot, other, avoid, arm_condition)
        assert given is not None and [one.name for one in given.scene.obstacles] == ["ball"]


SCRIPT = """
schema = 1
name = "to and fro"
robot = "tabletop_puma"
{steps}
"""


def test_a_script_fails_at_the_step_that_would_touch(
    tmp_path: Path, robot: rik.Robot, goal: Array
) -> None:
    file = with_ball(tmp_path, middle(robot, goal))
    turned = [float(np.degrees(value)) for value in goal]
    joints = ", ".join(f"{n} = {v:.3f}" for n, v in zip(robot.joints, turned, strict=True))
    end = robot.forward(goal).position.round(4).tolist()
    begin = robot.forward(robot.home).position
    along = (robot.forward(goal).position - begin).round(4).tolist()
    for step in (
        f'do = "joints"\njoints_deg = {{ {joints} }}',
        f'do = "position"\nposition = {end}',
        f'do = "line"\nby = {along}',
    ):
        script = parse_script(SCRIPT.format(steps=f"[[steps]]\n{step}"), tmp_path / "s.toml")
        report = run_script(script, ScriptRequest(arm_file=file))
        assert not report.passed, step
        found = report.steps[0].found
        assert "MotionBlockedError" in found or "NotConvergedError" in found, (step, found)
        assert "ball" in found


@contextmanager
def follower(file: Path, start: Array) -> Iterator[Arm]:
    with open_arm(ArmConfig.load(file), "sim", on_exit="hold", start=start) as arm:
        yield arm


def test_a_leader_leads_the_follower_up_to_the_obstacle_and_back(
    tmp_path: Path, robot: rik.Robot, goal: Array
) -> None:
    file = with_ball(tmp_path, middle(robot, goal))
    config = ArmConfig.load(file)
    guard = ArmGuard(config)
    names = config.chain.names
    scene = rik.Scene(robot, rik.load_obstacles(tmp_path / "scene.xml"))

    class Leads(LeaderArm):
        """Leads to the other side of the ball and back; it has no arm."""

        def __init__(self, arm: Arm) -> None:
            self.arm = arm
            self.nearest = np.inf

        def engage(self, follower: dict[str, float]) -> None:  # type: ignore[override]
            self.begin = dict(follower)

        def command(self, now: float) -> dict[str, float]:
            self.nearest = min(self.nearest, scene.clearance(self.chain_q()).distance)
            q = goal if now < 3.0 else robot.home
            return self.begin | dict(zip(names, q.tolist(), strict=True))

        def feel(self, follower: dict[str, float]) -> None:  # type: ignore[override]
            pass

        def chain_q(self) -> Array:
            positions = self.arm.positions()
            return np.array([positions[name] for name in names])

    with follower(file, robot.home) as arm:
        leader = Leads(arm)
        report = teleoperate(leader, arm, seconds=8.0, guard=guard)
        assert report.blocked > 50
        # The servos are a little behind their commands, which keep 0.9 times the margin.
        assert 0.003 < leader.nearest < 0.02
        assert leader.chain_q() == pytest.approx(robot.home, abs=0.02)
        assert guard.contact == ""


def test_keys_that_lead_into_an_obstacle_do_not_add_up(
    tmp_path: Path, robot: rik.Robot, goal: Array
) -> None:
    """After ten keys into the ball one key back moves the arm at once."""
    file = with_ball(tmp_path, middle(robot, goal))
    guard = ArmGuard(ArmConfig.load(file))
    keys = iter([*("q" * 40), *("" for _ in range(100)), "a"])
    with follower(file, robot.home) as arm:
        jog = KeyboardJog(arm.config, lambda: next(keys, ""))
        stops: list[float] = []

        def over() -> bool:
            stops.append(arm.positions()["joint1"])
            return False

        report = teleoperate(jog, arm, seconds=4.0, over=over, guard=guard)
        assert report.blocked > 0
        assert max(stops) < 0.8 + robot.home[0]
        assert stops[-1] < max(stops) - np.radians(2.0)


def test_a_scene_that_is_wrong_is_refused_before_anything_is_opened(tmp_path: Path) -> None:
    for keys, key in (
        ('scene = "nowhere.xml"', "collisions.scene"),
        ('ignore = [["nobody", "link1"]]', "collisions.ignore"),
    ):
        with pytest.raises(ConfigError, match=key):
            prepare_robot(ArmRequest(robot=NAME, bus="sim", arm_file=arm_with(tmp_path, keys)))


def test_a_script_that_follows_a_circle_through_the_ball_stops_before_it(
    tmp_path: Path, robot: rik.Robot
) -> None:
    center = robot.forward(robot.home).position + np.array((0.0, 0.05, 0.0))
    file = with_ball(tmp_path, center + np.array((0.0, 0.05, 0.0)))
    scene = rik.Scene(robot, rik.load_obstacles(tmp_path / "scene.xml"))
    assert scene.clearance(robot.home).distance > 0.02
    step = f"""[[steps]]
do = "follow"
path = "circle"
seconds = 4.0
center = {center.round(4).tolist()}
radius = 0.05
period = 4.0
"""
    record = tmp_path / "commands.csv"
    script = parse_script(SCRIPT.format(steps=step), tmp_path / "s.toml")
    report = run_script(script, ScriptRequest(arm_file=file, record=record))
    assert not report.passed
    sent = rik.Trajectory.load_csv(record)
    order = [sent.joints.index(name) for name in robot.joints]
    distances = [scene.clearance(q[order]).distance for q in sent.q]
    assert 0.9 * 0.004 <= min(distances) < 0.02


def test_a_recording_is_played_within_the_acceleration_caps(tmp_path: Path) -> None:
    """Else the limiter would leave the path that is checked."""
    plain = ArmConfig.load(NAME)
    guarded = ArmConfig.load(arm_with(tmp_path, ""))
    q = np.tile(rik.load_robot(NAME, joints=plain.names).home, (101, 1))
    times = np.linspace(0.0, 2.0, 101)
    q[:, 0] += 0.2 * np.sin(9.0 * times)
    motion = rik.Trajectory(times, q, plain.names)

    def peak(played: rik.Trajectory) -> float:
        """Largest acceleration of joint1 over 50 ms, rad/s²: linear samples have corners."""
        return float(np.abs(np.diff(played.q[::5, 0], 2)).max() / 0.05**2)

    assert peak(playable(motion, plain, 1.0)[0]) > 1.1 * plain.acceleration[0]
    played, stretch = playable(motion, guarded, 1.0)
    assert peak(played) <= 1.02 * plain.acceleration[0]
    assert stretch > 1.1


def test_a_command_that_is_not_finite_is_refused(tmp_path: Path, robot: rik.Robot) -> None:
    file = arm_with(tmp_path, "")
    guard = ArmGuard(ArmConfig.load(file))
    with follower(file, robot.home) as arm:
        arm.enable()
        guard.begin(arm.positions())
        with pytest.raises(UnsafeCommandError):
            guard.send(arm, {"joint1": np.nan})
        sent = guard.send(arm, {"joint1": robot.home[0] + 0.1})
        assert sent["joint1"] == pytest.approx(robot.home[0], abs=0.01)


def test_reach_without_servos_uses_the_scene_too(
    tmp_path: Path, robot: rik.Robot, goal: Array
) -> None:
    file = with_ball(tmp_path, middle(robot, goal))
    wanted = PoseGoal.at(None, robot.forward(goal))
    report = run_reach(robot=NAME, bus="none", arm=str(file), goal=wanted)
    assert isinstance(report.error, MotionBlockedError)
