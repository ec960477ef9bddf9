"""Light and shadow of the empty scene, judged by rays cast at every point."""

from __future__ import annotations

import numpy as np
import pytest

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.scene import Lights, SceneTable, _StillScene
from robot_ik.geometry import Pose

LENS = CameraIntrinsics(320, 240, 400.0, 400.0, 159.5, 119.5)


@pytest.fixture(params=[0.0, 0.75], ids=["top at the origin", "raised"])
def scene(request: pytest.FixtureRequest) -> tuple[_StillScene, SceneTable]:
    table = SceneTable(request.param, (-0.5, 0.5), (-0.4, 0.5))
    camera = Pose.look_at((0.9, -1.2, table.height + 0.9), (0.0, 0.0, table.height))
    return _StillScene(LENS, camera, table, Lights.beside(camera, 1.5), camera.position), table


@pytest.mark.parametrize("source", ["lamp", "ceiling"])
def test_what_lies_above_the_table_is_lit_as_if_every_ray_were_cast(
    scene: tuple[_StillScene, SceneTable], source: str
) -> None:
    still, table = scene
    rng = np.random.default_rng(3)
    floor, top = table.floor_height, table.height
    heights = rng.choice([floor, 0.5 * (floor + top), top, top + 0.3], 400)
    points = np.column_stack([rng.uniform(-1.5, 1.5, (400, 2)), heights])
    cast = np.mean([still._caster.lit(spot, points) for spot in still._lights.spots(source, 8)], axis=0)
    assert np.array_equal(still._lit(points, source, 8), cast)
    assert cast.min() == 0.0 and cast.max() == 1.0  # some of them are in the shadow


def test_the_floor_under_a_table_is_darker_than_beside_it(scene: tuple[_StillScene, SceneTable]) -> None:
    still, table = scene
    floor = np.array([[0.0, 0.0, table.floor_height], [0.0, 4.0, table.floor_height]])
    under, beside = still._lit(floor, "ceiling", 12)
    assert under < 0.5 and beside == 1.0
    above = np.array([[0.0, 0.0, table.height]])
    assert still._lit(above, "lamp", 8) == 1.0 and still._lit(above, "ceiling", 12) == 1.0
