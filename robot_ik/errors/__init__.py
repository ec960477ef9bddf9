"""Every error this package raises, as one tree.

The text of each error has the same form: what was asked, what is possible, what to try.
Constructors take data and keep it as attributes, so that a program can act on the cause
without reading the text.  "No solution" is not an error: it is a ``Solution`` whose status says so.
"""

from robot_ik.errors.base import (
    RobotIkError,
    apart,
    close_matches,
    unknown_name_text,
)
from robot_ik.errors.camera import (
    CalibrationError,
    CameraError,
    CameraNotFoundError,
    FrameSizeError,
    FrameTimeoutError,
    MarkerNotFoundError,
)
from robot_ik.errors.environment import (
    ConfigError,
    MissingExtraError,
    OutputError,
    ViewerError,
)
from robot_ik.errors.hardware import (
    ArmStateError,
    BusCorruptError,
    BusDisconnectedError,
    BusNotOpenError,
    BusTimeoutError,
    HardwareError,
    MotorFaultError,
    ServoMismatchError,
    ServoRefusedError,
    StopRequestedError,
    UnsafeCommandError,
)
from robot_ik.errors.robot import (
    GoalError,
    InvalidGoalError,
    InvalidModelError,
    InvalidPoseError,
    ModelError,
    NotConvergedError,
    ProblemInUseError,
    TrajectoryError,
    UnknownFrameError,
    UnknownJointError,
    UnknownRobotError,
    UnknownSolverError,
    UnsupportedGoalError,
    UnsupportedJointError,
)

__all__ = [
    "ArmStateError",
    "BusCorruptError",
    "BusDisconnectedError",
    "BusNotOpenError",
    "BusTimeoutError",
    "CalibrationError",
    "CameraError",
    "CameraNotFoundError",
    "ConfigError",
    "FrameSizeError",
    "FrameTimeoutError",
    "GoalError",
    "HardwareError",
    "InvalidGoalError",
    "InvalidModelError",
    "InvalidPoseError",
    "MarkerNotFoundError",
    "MissingExtraError",
    "ModelError",
    "MotorFaultError",
    "NotConvergedError",
    "OutputError",
    "ProblemInUseError",
    "RobotIkError",
    "ServoMismatchError",
    "ServoRefusedError",
    "StopRequestedError",
    "TrajectoryError",
    "UnknownFrameError",
    "UnknownJointError",
    "UnknownRobotError",
    "UnknownSolverError",
    "UnsafeCommandError",
    "UnsupportedGoalError",
    "UnsupportedJointError",
    "ViewerError",
    "apart",
    "close_matches",
    "unknown_name_text",
]
