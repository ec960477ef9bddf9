"""How to get there in time: trajectories, moves, goal sources, the recorder."""

from robot_ik.motion.profiles import PROFILES
from robot_ik.motion.record import RecorderSink
from robot_ik.motion.trajectory import Trajectory, joint_move

__all__ = ["PROFILES", "RecorderSink", "Trajectory", "joint_move"]
