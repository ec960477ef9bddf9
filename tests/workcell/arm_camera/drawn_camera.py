"""A light synthetic camera for tests of arm and camera: 640x480 pixels, nothing but markers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType, ModuleType
from typing import Any

import numpy as np
import pytest

from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.camera import SyntheticScene
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.geometry import Pose
from robot_ik.workcell.arm_camera import camera_and_board, verify


class DrawnCamera(FrameSource):
    """Pictures of the markers of a scene, with the robot's markers at its true joint angles.

    Attributes:
        hidden: Ids of markers that are not drawn. None: no marker is drawn.
        displaced: Distance in px by which a marker is drawn to the right of its place, by id.
    """

    live = True
    hidden: tuple[int, ...] | None = ()
    displaced: Mapping[int, float] = MappingProxyType({})

    def __init__(
        self, scene: SyntheticScene, true_q: Any, seed: int = 0, clock: Any = None
    ) -> None:
        self.scene = scene
        self.true_q = true_q
        self.size = scene.intrinsics.size
        self.rng = np.random.default_rng(seed)

    def read(self) -> Frame:
        scene = self.scene
        q = self.true_q()
        pose_camera_world = scene.camera(q).inverse()
        markers: dict[int, tuple[float, Pose]] = {}
        for marker in scene.markers:
            pose = pose_camera_world.compose(marker.pose_world(scene, q, 0.0))
            pixels = self.displaced.get(marker.id, 0.0)
            if pixels:
                shift = pixels * pose.position[2] / scene.intrinsics.fx
                pose = Pose(pose.position + np.array([shift, 0.0, 0.0]), pose.wxyz)
            is_facing = pose.rotation[:, 2] @ pose.position < 0 < pose.position[2]
            if is_facing and self.hidden is not None and marker.id not in self.hidden:
                markers[marker.id] = (marker.size, pose)
        # Near markers hide far ones.
        by_depth = sorted(markers.items(), key=lambda item: -item[1][1].position[2])
        image = render_markers(
            scene.intrinsics,
            dict(by_depth),
            self.rng,
            dictionary=scene.markers[0].dictionary,
            margin=0.15,
        )
        return Frame(np.repeat(image[:, :, None], 3, axis=2), 0.0, 0)


def use_drawn_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the synthetic camera of hand-eye and verify by a ``DrawnCamera``."""
    monkeypatch.setattr(camera_and_board, "SyntheticSource", DrawnCamera)
    for module in (camera_and_board, verify):
        _use_small_pictures(monkeypatch, module)


def _use_small_pictures(monkeypatch: pytest.MonkeyPatch, module: ModuleType) -> None:
    scene_for = module.scene_for

    def small_scene_for(*arguments: Any) -> Any:
        return replace(scene_for(*arguments), intrinsics=STANDARD_CAMERA)

    monkeypatch.setattr(module, "scene_for", small_scene_for)
