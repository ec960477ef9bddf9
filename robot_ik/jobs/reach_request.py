"""What a reach shall do, and what shall go wrong on purpose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from robot_ik.camera.goals.lost import LostPolicy
from robot_ik.geometry import Pose
from robot_ik.goals import Goal


@dataclass(frozen=True)
class Rehearsal:
    """What shall go wrong, to see that it is noticed; for simulated servos and the synthetic camera.

    Attributes:
        zero_offset_deg: Joint -> degrees by which its servo's shaft is ahead of what its registers say.
        stuck: Joints whose shaft does not move.
        cover_gripper: Hide the gripper's markers in the second picture.
        blank_marker: Leave the target's paper white.
        marker_at: x, y, z in metres and yaw in degrees of the printed marker instead of the stage's own.
    """

    zero_offset_deg: Mapping[str, float] = field(default_factory=dict)
    stuck: tuple[str, ...] = ()
    cover_gripper: bool = False
    blank_marker: bool = False
    marker_at: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class ReachRequest:
    """What ``run_reach`` shall do; every default is the embedded demonstration.

    Attributes:
        robot: Catalogue name, or path of an MJCF or URDF file.
        solver: Name of a method; empty: the robot's own, else ``auto``.
        goal: Instead of a marker.
        frame: What shall get there; None: the robot's tool.
        camera: ``synthetic``, or what ``open_source`` opens.
        intrinsics: Calibration file of a real camera.
        pose_world_camera: Where a real camera stands; None: where the stage's stands.
        marker_id, marker_size, dictionary: The target; None: the stage's.
        bus: ``pty``, ``sim``, ``none`` or a serial port.
        arm_file: None: the one beside the model, else a generic one.
        speed: Share of the joints' speed limits.
        line: Move the tool on a straight line.
        follow: Seconds to go on following the marker; 0: not at all.
        when_lost, lost_after: What to do (``hold``, ``park`` at home, ``stop``) after so many seconds without
            the marker while following.
        lead: Seconds to predict the marker beyond each tick.
        view: Mirror the motion in a window.
        seed: Of restarts and of the synthetic camera's noise.
        rehearsal: What shall go wrong.
    """

    robot: str = "puma560"
    solver: str = ""
    goal: Goal | None = None
    frame: str | None = None
    camera: str = "synthetic"
    intrinsics: Path | None = None
    pose_world_camera: Pose | None = None
    marker_id: int | None = None
    marker_size: float | None = None
    dictionary: str | None = None
    bus: str = "pty"
    arm_file: Path | None = None
    speed: float = 1.0
    line: bool = False
    follow: float = 0.0
    when_lost: LostPolicy = "hold"
    lost_after: float = 2.0
    lead: float = 0.0
    view: bool = False
    seed: int = 0
    rehearsal: Rehearsal = Rehearsal()
