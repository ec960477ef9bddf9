"""Pictures in a studio: what hides what, light from the viewer's side, shadows, and the floor."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from robot_ik.camera.drawing.studio import (
    SEAMLESS,
    Body,
    Photo,
    ball_model,
    photograph,
    tiled_room,
)
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose

LENS = CameraIntrinsics(320, 240, 400.0, 400.0, 159.5, 119.5)
CAMERA = Pose.look_at((0.0, -1.5, 0.8), (0.0, 0.0, 0.15))
RED = (1.0, 0.0, 0.0, 1.0)


def pixel(position: tuple[float, float, float]) -> tuple[int, int]:
    """Row and column at which the camera sees a position."""
    x, y = np.rint(LENS.project(CAMERA.inverse().apply(np.array(position))))
    return int(y), int(x)


def seen(*bodies: Body) -> Photo:
    return photograph(bodies, LENS, CAMERA, SEAMLESS)


def test_a_body_in_front_hides_the_one_behind_it_in_any_order(
    model_of: Callable[..., mujoco.MjModel],
) -> None:
    wall = Body(model_of("<geom type='box' size='.3 .02 .3' rgba='0 0 1 1'/>"), [])
    ball = Body(ball_model(0.05, RED), [], Pose((0.0, 0.2, 0.15)))
    for bodies in ((wall, ball), (ball, wall)):
        image = seen(*bodies).image.astype(int)
        assert not ((image[..., 2] > image[..., 0] + 60) & (image[..., 1] < 100)).any()
    near = Body(ball_model(0.05, RED), [], Pose((0.0, -0.2, 0.15)))
    blue, green, red = seen(near, wall).image[pixel((0.0, -0.25, 0.15))]
    assert red > max(blue, green) + 60


def test_a_ball_is_shaded_as_a_sphere_from_the_upper_left() -> None:
    image = seen(Body(ball_model(0.15, RED), [], Pose((0.0, 0.0, 0.15)))).image
    row, column = pixel((0.0, 0.0, 0.15))
    upper_left = int(image[row - 20, column - 20, 2])
    lower_right = int(image[row + 20, column + 20, 2])
    assert upper_left > lower_right + 60


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 180.0, 270.0])
def test_a_black_body_shows_its_shape_from_every_side(
    azimuth: float, model_of: Callable[..., mujoco.MjModel]
) -> None:
    model = model_of("<geom type='box' size='.15 .15 .15' pos='0 0 .15' rgba='0 0 0 1'/>")
    angle = np.radians(azimuth + 30.0)
    camera = Pose.look_at((1.3 * np.cos(angle), 1.3 * np.sin(angle), 0.9), (0.0, 0.0, 0.15))
    photo = photograph([Body(model, [])], LENS, camera, SEAMLESS)
    tones = photo.image[photo.coverage == 255].mean(axis=1)
    # Three sides with three tones, none of them black.
    assert tones.min() > 12
    assert np.percentile(tones, 95) > np.percentile(tones, 5) + 12


def test_a_body_casts_a_shadow_beside_it_and_shadows_do_not_add_up(
    model_of: Callable[..., mujoco.MjModel],
) -> None:
    model = model_of("<geom type='box' size='.1 .1 .15' pos='0 0 .15' rgba='.7 .7 .7 1'/>")
    empty = seen().image.astype(int)
    once = seen(Body(model, []))
    twice = seen(Body(model, []), Body(model, []))
    free = once.coverage == 0
    darker = (empty - once.image).max(axis=2)
    assert (darker[free] > 60).sum() > 300, "no shadow"
    assert np.abs(once.image[free].astype(int) - twice.image[free]).max() <= 1
    _, columns = np.nonzero((darker > 60) & free)
    assert columns.mean() > pixel((0.0, 0.0, 0.0))[1], "the light comes from the left"


def test_the_tiles_are_fixed_on_the_floor_and_fade_into_the_wall() -> None:
    room = tiled_room(extent=1.0, tile_side=0.5)
    photo = photograph([], LENS, CAMERA, room)
    tones = {}
    for x, y in ((0.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.0, 0.5)):
        tones[x, y] = int(photo.image[pixel((x, y, 0.0))][1])
    assert abs(tones[0.0, 0.0] - tones[0.5, 0.5]) <= 2
    assert abs(tones[0.5, 0.0] - tones[0.0, 0.5]) <= 2
    assert abs(tones[0.0, 0.0] - tones[0.5, 0.0]) > 10
    high = Pose.look_at((0.0, -1.5, 0.2), (0.0, 0.0, 0.3))
    wall = photograph([], LENS, high, room).image[0, 0]
    assert wall.tolist() == [round(255 * tone) for tone in room.wall]
