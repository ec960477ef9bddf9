"""Each reader of joint positions over time reads the file of each writer."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from robot_ik.commands.figure_recording import save_recording
from robot_ik.commands.reach_picture import trajectory_table
from robot_ik.execution import execute
from robot_ik.figure.decide import Decision
from robot_ik.figure.session import FigureFrame
from robot_ik.motion import Keyframes, Trajectory
from robot_ik.motion.recording import RecordingSink, open_recording
from robot_ik.ports import Array, VirtualClock
from robot_ik.robot import Robot, load_robot
from robot_ik.testbed.ar.motion import make_motion
from robot_ik.testbed.commands import CommandLog, Start
from robot_ik.testbed.filming import film
from robot_ik.workcell.guided_recording import load_motion, measured_table

TIMES = np.array([0.0, 0.02, 0.04, 0.06])
"""Times of the recorded motion, s. The testbed's pictures have a distance of one or more ticks."""


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot("puma560")


@pytest.fixture(scope="module")
def motion(robot: Robot) -> Trajectory:
    """A motion whose numbers need all digits."""
    shares = np.linspace(0.0, 0.1, len(TIMES))[:, None] / 3.0
    q = robot.home + shares * (robot.upper - robot.home)
    return Trajectory(TIMES, q, robot.joints)


def write_trajectory(_robot: Robot, motion: Trajectory, file: Path) -> None:
    """Write as ``robot-ik plan --out`` and the timeline of the page do."""
    motion.save_csv(file)


def write_keyframes(robot: Robot, motion: Trajectory, file: Path) -> None:
    Keyframes(robot, motion.times, motion.q).save_csv(file)


def write_stream(robot: Robot, motion: Trajectory, file: Path) -> None:
    """Write as ``--record`` of reach, run and servo replay does."""
    with open_recording(file, robot.joints) as recording:
        measured = dict.fromkeys(robot.joints, 9.0)
        sink = RecordingSink(recording, robot.joints, lambda: measured)
        for time, q in zip(motion.times, motion.q, strict=True):
            sink.send(q, time)


def write_reach(robot: Robot, motion: Trajectory, file: Path) -> None:
    """Write as ``trajectory.csv`` of a reach."""
    execution = execute(motion, [Drain()], clock=VirtualClock())
    report: Any = SimpleNamespace(execution=execution, robot=robot)
    file.write_text(trajectory_table(report))


def write_guided(_robot: Robot, motion: Trajectory, file: Path) -> None:
    """Write as ``servo record`` and the page do: measured positions only."""
    file.write_text(measured_table(motion))


def write_figure(robot: Robot, motion: Trajectory, file: Path) -> None:
    """Write as ``figure --record`` does."""
    decision = Decision("reach", "right", "the ball is near")
    numbers: Any = np.array([2, 2])
    frames = [
        FigureFrame(time, q, "reach", 0.5, numbers, np.full(2, np.nan), np.full(3, 0.5), decision)
        for time, q in zip(motion.times.tolist(), motion.q, strict=True)
    ]
    save_recording(robot, None, frames, file, seed=0)


class Drain:
    """A sink without effect."""

    def send(self, q: Array, now: float) -> None:
        pass


WRITERS: dict[str, Callable[[Robot, Trajectory, Path], None]] = {
    "Trajectory.save_csv": write_trajectory,
    "Keyframes.save_csv": write_keyframes,
    "--record": write_stream,
    "trajectory.csv of reach": write_reach,
    "servo record": write_guided,
    "figure --record": write_figure,
}


def read_trajectory(file: Path, _robot: Robot) -> Array:
    return Trajectory.load_csv(file).q


def read_keyframes(file: Path, robot: Robot) -> Array:
    return Keyframes.load_csv(file, robot).q


def read_for_replay(file: Path, robot: Robot) -> Array:
    """Read as ``servo replay`` does."""
    return load_motion(file, robot.joints).q


def read_for_ar(file: Path, robot: Robot) -> Array:
    """Read as ``ar --motion`` does."""
    figure: Any = None  # a recording needs no figure
    with contextlib.ExitStack() as stack:
        drawn = make_motion(str(file), robot, figure, stack)
        # A motion repeats, so the last sample is also the first one of the next round.
        return np.array([drawn.q(time, None) for time in TIMES[:-1]])


READERS: dict[str, Callable[[Path, Robot], Array]] = {
    "Trajectory.load_csv": read_trajectory,
    "Keyframes.load_csv": read_keyframes,
    "servo replay": read_for_replay,
    "ar --motion": read_for_ar,
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("writer", WRITERS)
def test_each_reader_reads_the_file_of_each_writer(
    writer: str, reader: str, robot: Robot, motion: Trajectory, tmp_path: Path
) -> None:
    file = tmp_path / "motion.csv"
    WRITERS[writer](robot, motion, file)
    q = READERS[reader](file, robot)
    assert len(q) >= len(motion) - 1
    np.testing.assert_array_equal(q, motion.q[: len(q)])


@pytest.mark.parametrize("reader", READERS)
def test_each_reader_reads_the_recording_of_the_testbed(
    reader: str, robot: Robot, tmp_path: Path
) -> None:
    file = tmp_path / "testbed.csv"
    film(CommandLog(Start("puma560"), ()), None, record=file, seconds=0.2)
    q = READERS[reader](file, robot)
    np.testing.assert_array_equal(q[0], Trajectory.load_csv(file).q[0])
    assert np.isfinite(q).all()


@pytest.mark.parametrize("writer", ["--record", "figure --record"])
def test_the_same_writers_write_mcap(
    writer: str, robot: Robot, motion: Trajectory, tmp_path: Path
) -> None:
    reader = pytest.importorskip("mcap_ros2.reader", reason="needs the extra record")
    file = tmp_path / "motion.mcap"
    WRITERS[writer](robot, motion, file)
    messages = [
        message.ros_msg
        for message in reader.read_ros2_messages(str(file))
        if message.channel.topic == "/joint_commands"
    ]
    assert [tuple(message.name) for message in messages] == [robot.joints] * len(motion)
    np.testing.assert_array_equal([message.position for message in messages], motion.q)
