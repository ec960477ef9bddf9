"""A print before a camera covers exactly the pixels, and parts of pixels, that geometry says."""

import numpy as np
import pytest

from robot_ik.camera.drawing.prints import (
    Print,
    ProjectedPrint,
    blank_paper,
    marker_print,
    project_print,
)
from robot_ik.camera.drawing.rays import ray_field
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose, rotation_exp

# A pixel is a millimetre at a distance of a metre.
LENS = CameraIntrinsics(320, 240, 1000.0, 1000.0, 160.0, 120.0)
BENT = CameraIntrinsics(320, 240, 400.0, 400.0, 158.0, 121.0, (-0.18, 0.06, 0.0006, -0.0004, 0.0))


def seen(sheet: Print, pose: Pose, lens: CameraIntrinsics = LENS) -> ProjectedPrint:
    print_ = project_print(sheet, pose, ray_field(lens))
    assert print_ is not None
    return print_


@pytest.mark.parametrize("turn", [0.0, 0.2, 0.7853981634, 2.0])
def test_a_square_has_its_area_and_its_centre_at_every_rotation(turn: float) -> None:
    centre = np.array([0.0123, -0.0087])
    side = 0.0404
    found = seen(blank_paper(side), Pose((*centre, 1.0), rotation_exp([0.0, 0.0, turn])))
    assert found.coverage.sum() == pytest.approx(1e6 * side**2, abs=1e-6)
    x0, y0, x1, y1 = found.box
    x, y = np.meshgrid(np.arange(x0, x1), np.arange(y0, y1))
    middle = [(found.coverage * along).sum() / found.coverage.sum() for along in (x, y)]
    # A pixel that is covered in part counts by its middle; that cancels on opposite sides.
    assert middle == pytest.approx(1e3 * centre + (160.0, 120.0), abs=5e-3)
    assert found.visible == 1.0


def test_one_edge_cuts_pixels_where_it_runs() -> None:
    found = seen(
        Print.of_boxes(np.array([[0.0, -0.02, 0.0103, 0.04]]), (-0.03, -0.02, 0.06, 0.04)),
        Pose((0, 0, 1)),
    )
    x0, y0, _, _ = found.box
    row = found.ink[120 - y0, 160 - x0 :][:13]
    # Pixel 0 is half ink: it reaches from -0.5 to 0.5 mm.
    assert row == pytest.approx([0.5, *[1.0] * 9, 0.8, 0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("tilt", [0.0, 0.6, 1.05])
def test_a_tilted_marker_under_a_lens_is_the_mean_of_very_many_rays(tilt: float) -> None:
    sheet = marker_print("DICT_5X5_50", 7, 0.05, 0.0125)
    pose = Pose((0.02, -0.01, 0.3), rotation_exp([0, tilt, 0.3]))
    found = seen(sheet, pose, BENT)
    x0, y0, x1, y1 = found.box
    pixels = np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), axis=-1).reshape(-1, 2)
    cells = np.pad(sheet.ink, 1)
    total = np.zeros(len(pixels))
    steps = (np.arange(24) + 0.5) / 24 - 0.5
    for across in steps:
        for down in steps:
            rays = BENT.unproject(pixels + np.array([across, down]))
            normal = pose.rotation[:, 2]
            points = rays * (normal @ pose.position / (rays @ normal))[:, None]
            x, y = ((points - pose.position) @ pose.rotation[:, :2]).T
            total += cells[np.searchsorted(sheet.y, y), np.searchsorted(sheet.x, x)]
    away = (found.ink * found.coverage).ravel() - total / len(steps) ** 2
    # The share of a pixel by which an edge is off is how many pixels the edge is off.
    assert np.abs(away).max() < 6e-3
    assert np.sqrt((away[away != 0.0] ** 2).mean()) < 2e-3
    assert abs(away.sum()) < 2e-4 * np.count_nonzero(away)


def test_a_print_is_seen_from_its_front_only_and_not_beside_the_picture() -> None:
    field = ray_field(LENS)
    assert (
        project_print(blank_paper(0.04), Pose((0, 0, 1), rotation_exp([0, np.pi, 0])), field)
        is None
    )
    assert project_print(blank_paper(0.04), Pose((0.5, 0, 1)), field) is None
    assert project_print(blank_paper(0.04), Pose((0, 0, -1)), field) is None


def test_an_object_in_front_covers_its_share_of_every_pixel() -> None:
    field = ray_field(LENS)
    pose = Pose((0, 0, 1))
    found = project_print(
        blank_paper(0.04), pose, field, lambda pixels, depth: pixels[:, 0] < 165.25
    )
    assert found is not None
    row = found.coverage[120 - found.box[1], 160 - found.box[0] :][:8]
    # Visibility is tested at the middles of quarters of a pixel: 5.25 mm leaves one quarter of
    # pixel 5.
    assert row == pytest.approx([0.0] * 5 + [0.25, 1.0, 1.0])
    assert found.visible == pytest.approx((20.0 - 5.25) / 40.0, abs=1e-3)


def test_a_flat_print_has_the_share_of_ink_in_each_pixel() -> None:
    boxes = np.array([[0.5, 0.0, 1.0, 2.0], [3.0, 1.25, 9.0, 0.5], [-5.0, 2.5, 6.0, 9.0]])
    grey = Print.of_boxes(boxes, (0.0, 0.0, 5.0, 3.0), np.array([1.0, 0.4, 1.0])).flat(5, 3)
    share = [[0.5, 0.5, 0, 0, 0], [0.5, 0.5, 0, 0.2, 0.2], [0.5, 0, 0, 0, 0]]
    assert grey.tolist() == np.rint(255.0 * (1.0 - np.array(share))).tolist()
    assert grey.flags["C_CONTIGUOUS"]


def test_ink_bleeds_to_every_side_and_the_darker_one_shows_where_two_overlap() -> None:
    plain, bled = (marker_print("DICT_4X4_50", 0, 0.04, 0.01, bleed) for bleed in (0.0, 0.0005))
    found = [float((p.ink * np.diff(p.y)[:, None] * np.diff(p.x)).sum()) for p in (plain, bled)]
    assert found[1] > found[0] + 4 * 0.04 * 0.0005
    assert set(np.unique(bled.ink)) == {0.0, 1.0}
    half = Print.of_boxes(
        np.array([[0.0, 0, 2, 1], [1.0, 0, 2, 1]]), (0, 0, 3, 1), np.array([0.5, 1.0])
    )
    assert half.ink.tolist() == [[0.5, 1.0, 1.0]]
