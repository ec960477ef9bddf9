"""Motions in time: trajectories, moves, key poses, sources of goals, recording."""

from robot_ik.motion.key_poses import KeyPoses
from robot_ik.motion.keyframes import Keyframes
from robot_ik.motion.line import line_move
from robot_ik.motion.sources import CurveSource, ManualSource, RandomSource, ScriptSource
from robot_ik.motion.timing import PROFILES
from robot_ik.motion.trajectory import RecorderSink, Trajectory, joint_move

__all__ = [
    "PROFILES",
    "CurveSource",
    "KeyPoses",
    "Keyframes",
    "ManualSource",
    "RandomSource",
    "RecorderSink",
    "ScriptSource",
    "Trajectory",
    "joint_move",
    "line_move",
]
