"""Wrong arguments of public functions and classes raise an error of the package."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import RobotIkError, UnknownFrameError
from robot_ik.ports import JointReading


@pytest.fixture(scope="module")
def puma():
    return rik.load_robot("puma560")


@pytest.fixture(scope="module")
def goal(puma):
    return rik.PoseGoal.at(None, puma.forward(puma.home + 0.3))


class Sink:
    """A sink and a source of joint angles that must not be called."""

    def __init__(self, robot=None):
        self.robot = robot

    def send(self, q, now):
        raise AssertionError

    def read(self):
        return JointReading(self.robot.home, 0.0)


def still(robot):
    return rik.Trajectory([0.0], [robot.home], robot.joints)


def follow(robot, **options):
    return rik.follow(robot, None, sinks=[Sink()], solver="lm", start=robot.home, **options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r, goal: rik.solve_batch(r, [[0.3, 0.1, 0.8]], threads=1.5), "threads: 1.5"),
        (lambda r, goal: rik.solve_batch(r, [[0.3, 0.1, 0.8]], threads="2"), "threads: '2'"),
        (lambda r, goal: rik.solve_all(4, goal), "needs a robot, not 4"),
        (lambda r, goal: rik.joint_move("puma560", r.home, r.home), "needs a robot, not 'puma560'"),
        (lambda r, goal: rik.load_robot("puma560", joints=4), "no joint called|unknown joint '4'"),
        (lambda r, goal: rik.load_robot("puma560", tool=["gripper"]), "unknown frame"),
        (lambda r, goal: r.forward(r.home, ["gripper"]), "unknown frame"),
        (lambda r, goal: r.center_of_mass(r.home, ["link1"]), "unknown frame"),
        (lambda r, goal: r.integrate(r.home, [1.0]), "dq must be 6 numbers, not 1"),
        (lambda r, goal: r.integrate(r.home, [np.nan] * 6), "dq must be finite"),
        (lambda r, goal: r.check_q(10**400), "must be 6 numbers"),
        (lambda r, goal: r.outside(r.home, np.nan), "slack must be finite"),
        (lambda r, goal: r.sample(1), "1 is not a random generator"),
        (lambda r, goal: rik.make_solver("lm", patience=1.5), "patience: 1.5 is not allowed"),
        (lambda r, goal: rik.make_solver("lm", progress="x"), "allowed: a number"),
        (lambda r, goal: rik.PoseGoal.at(None, (1, 2, 3)), "not a pose"),
        (lambda r, goal: rik.PositionGoal(None, (1, 2, 10**400)), "position must be 3 numbers"),
        (lambda r, goal: rik.Problem(r, goal).retarget((0, 0, 1), None), "no goal None"),
        (lambda r, goal: rik.Pose.from_rotation(2.0 * np.eye(3)), "it scales or mirrors"),
        (lambda r, goal: rik.Pose.from_rotation([1, 0, 0]), r"is \(3, 3\), not \(3,\)"),
        (lambda r, goal: rik.Pose.from_matrix("x"), r"must be numbers \(4, 4\)"),
        (lambda r, goal: rik.Pose() @ (1.0, 2.0), r"\(3,\) or \(n, 3\)"),
        (lambda r, goal: rik.Trajectory("x", [[1.0]], ["a"]), "times of a trajectory"),
        (lambda r, goal: rik.Trajectory([0.0], [[1.0]], 4), "joints are names, not 4"),
        (lambda r, goal: still(r).at("now"), "the time is 'now'"),
        (lambda r, goal: rik.joint_move(r, r.home, r.home, speed="x"), "speed is 'x'"),
        (lambda r, goal: rik.joint_move(r, r.home, r.home, rate=None), "rate is None Hz"),
        (lambda r, goal: rik.joint_move(r, r.home, r.home, profile=["quintic"]), "unknown profile"),
        (lambda r, goal: rik.execute([r.home], [Sink()]), "not a trajectory"),
        (lambda r, goal: rik.execute(still(r), Sink()), "not a list of sinks"),
        (lambda r, goal: rik.execute(still(r), [print]), "not a list of sinks"),
        (lambda r, goal: rik.execute(still(r), [Sink()], settle="x"), "settle is 'x' s"),
        (
            lambda r, goal: rik.execute(still(r), [Sink()], source=Sink(r), start_tolerance=np.nan),
            "is nan",
        ),
        (lambda r, goal: follow(r, duration=np.nan), "duration is nan s"),
        (lambda r, goal: follow(r, tolerance=1), "tolerance: 1"),
    ],
)
def test_wrong_arguments_are_refused_with_a_message(puma, goal, call, message):
    with pytest.raises(RobotIkError, match=message):
        call(puma, goal)


def test_an_unknown_frame_is_not_replaced_by_the_tool():
    with pytest.raises(UnknownFrameError):
        rik.load_robot("puma560", tool="")
