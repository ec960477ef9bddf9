"""Pictures of targets at known poses."""

from __future__ import annotations

import numpy as np

from benchmarks.camera.accuracy import frame_of
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.camera.targets import MarkerTarget
from robot_ik.geometry import Pose


def board_picture(
    target: MarkerTarget,
    pose: Pose,
    *,
    displaced: int = -1,
    displacement: float = 0.0,
    seed: int = 0,
) -> Frame:
    """Return a frame with a target; one of its markers is displaced along x, metres."""
    placed = {}
    for marker_id, (size, pose_target_marker) in target.markers.items():
        if marker_id == displaced:
            pose_target_marker = Pose((displacement, 0.0, 0.0)).compose(pose_target_marker)
        placed[marker_id] = (size, pose.compose(pose_target_marker))
    rng = np.random.default_rng(seed)
    return frame_of(render_markers(STANDARD_CAMERA, placed, rng, dictionary=target.dictionary))
