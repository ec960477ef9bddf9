"""The painted scene: table, robot and sheets hide and shade each other."""

from __future__ import annotations

import mujoco
import numpy as np

from robot_ik.camera.drawing.prints import PRINT_MARKER, blank_paper
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.painted import PaintedScene, PlacedPrint, SceneTable
from robot_ik.geometry import Pose, rotation_exp

LENS = CameraIntrinsics(320, 240, 400.0, 400.0, 159.5, 119.5, (-0.15, 0.05, 0.0, 0.0, 0.0))
TABLE = SceneTable(0.0, (-0.4, 0.4), (-0.3, 0.3))
CAMERA = Pose.look_at((0.0, -1.0, 0.8), (0.0, 0.0, 0.0))


def scene(body: str = "", camera: Pose = CAMERA, table: SceneTable | None = TABLE) -> PaintedScene:
    xml = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    return PaintedScene(mujoco.MjModel.from_xml_string(xml), LENS, camera, table)


def pixel(position: tuple[float, float, float], camera: Pose = CAMERA) -> tuple[int, int]:
    """Row and column at which a camera sees a position."""
    x, y = np.rint(LENS.project(camera.inverse().apply(np.array(position))))
    return int(y), int(x)


def sheet(pose: Pose, *, on_robot: bool = False) -> PlacedPrint:
    """White paper with its middle and its axes (z out of the paper) at a pose."""
    return PlacedPrint(blank_paper(0.1), pose.compose(PRINT_MARKER), on_robot)


def test_the_table_hides_the_part_of_the_robot_that_is_below_it() -> None:
    pole = "<geom type='cylinder' size='.03 .3' pos='0 .2 0' rgba='0 0 1 1'/>"
    light = scene(pole).expose([]).light
    top = light[pixel((0.0, 0.17, 0.2))]
    below = light[pixel((0.0, 0.17, -0.2))]
    assert top[0] > top[2] + 0.2, "above the table the pole is blue"
    assert below[2] > below[0], "below it there is only the table"


def test_the_robot_casts_a_soft_shadow_on_table_and_sheet() -> None:
    block = "<geom type='box' size='.04 .04 .12' pos='-.15 0 .12'/>"
    empty = scene().expose([]).light
    darker = scene(block).expose([]).light / empty
    row, column = pixel((-0.15, -0.041, 0.12))
    darker[row - 40 : row + 50, column - 25 : column + 26] = 1.0  # the block itself
    share = darker.min(axis=2)
    # The block is slim for a wide light, so its shadow is not the full one.
    shadow = share[(share < 0.98) & (share > 0.55)]
    darkest = float(np.quantile(shadow, 0.05))
    assert darkest < 0.95, "no shadow on the table"
    deep = np.argwhere(np.abs(share - darkest) < 0.02)
    # The edge is soft: there are many degrees of shadow.
    assert len(np.unique(np.round(shadow, 3))) > 15

    # A sheet in the middle of the shadow is as dark as the table is there.
    row, column = deep[len(deep) // 2].tolist()
    ray = CAMERA.rotation @ LENS.unproject(np.array([column, row]))
    x, y, _ = CAMERA.position - ray * CAMERA.position[2] / ray[2]
    paper = sheet(Pose((float(x), float(y), 0.0)))
    lit = scene().expose([], [paper]).light[row, column]
    shaded = scene(block).expose([], [paper]).light[row, column]
    assert np.allclose(shaded / lit, share[row, column], atol=0.02)


def test_objects_behind_a_sheet_cast_no_shadow_on_it() -> None:
    standing = Pose((0.0, 0.0, 0.12), rotation_exp([np.pi / 2, 0.0, 0.0]))
    behind = "<geom type='box' size='.04 .02 .05' pos='0 .1 .15'/>"
    light = scene(behind).expose([], [sheet(standing)]).light
    bare = scene().expose([], [sheet(standing)]).light
    row, column = pixel((0.0, 0.0, 0.12))
    patch = (slice(row - 10, row + 11), slice(column - 10, column + 11))
    assert np.array_equal(light[patch], bare[patch])


def test_a_sheet_on_the_robot_is_seen_and_the_robot_hides_one_behind_it() -> None:
    block = "<geom type='box' size='.06 .06 .06' pos='0 0 .06'/>"
    on_top = sheet(Pose((0.0, 0.0, 0.12)), on_robot=True)
    behind = sheet(Pose((0.08, 0.12, 0.0)))
    first, second = scene(block).expose([], [on_top, behind]).sheets
    assert first is not None and first.visible > 0.99
    assert second is not None and 0.05 < second.visible < 0.95
    (alone,) = scene().expose([], [behind]).sheets
    assert alone is not None and alone.visible > 0.999


def test_without_a_table_the_robot_stands_on_the_floor_with_its_shadow() -> None:
    block = "<geom type='box' size='.05 .05 .1' pos='0 0 .1'/>"
    light = scene(block, table=None).expose([]).light
    bare = scene(table=None).expose([]).light
    assert ((light / bare).min(axis=2) < 0.8).sum() > 200


def test_one_scene_can_be_exposed_again() -> None:
    painted = scene("<geom type='sphere' size='.05' pos='0 0 .1'/>")
    first = painted.expose([], [sheet(Pose((0.1, 0.0, 0.0)))]).light
    again = painted.expose([], [sheet(Pose((0.1, 0.0, 0.0)))]).light
    assert np.array_equal(first, again)
