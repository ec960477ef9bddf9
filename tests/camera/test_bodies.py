"""Bodies with several markers: layouts, their file, and boards in pictures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from robot_ik.camera.bodies import MarkerBody, cube_body, grid_body, load_bodies
from robot_ik.camera.corner_refinement import unrefined
from robot_ik.camera.observations import BodyObservation, estimate_body, marker_points
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA as CAMERA
from robot_ik.camera.synthetic.pictures import random_pose, render_markers
from robot_ik.camera.tracker import MarkerTracker
from robot_ik.errors import CameraError, ConfigError
from robot_ik.geometry import Pose, quat_multiply, rotation_exp

FACING = np.array([0.0, 1.0, 0.0, 0.0])
DICTIONARY = "DICT_4X4_50"


def seen_boards(
    body: MarkerBody, distance: float, count: int, seed: int, hidden: float = 0.0
) -> Iterator[tuple[Pose, BodyObservation]]:
    """Pictures of a board, ``hidden`` of it behind a straight edge of any direction."""
    rng = np.random.default_rng(seed)
    tracker = MarkerTracker(CAMERA, DICTIONARY, body.sizes)
    half = max(np.abs(p.position[:2]).max() + size / 2 for size, p in body.markers.values())
    for k in range(count):
        pose = random_pose(CAMERA, rng, distance, size=2.1 * half)
        markers = {i: (size, pose.compose(p)) for i, (size, p) in body.markers.items()}
        cover = None
        if hidden:
            way = rng.uniform(0, 2 * np.pi)
            out, along = np.array([np.cos(way), np.sin(way)]), np.array([-np.sin(way), np.cos(way)])
            edge = out * (1 - 2 * hidden) * half
            outline = [edge + 3 * half * (a * out + b * along) for a, b in ((0, -1), (0, 1), (1, 1), (1, -1))]
            cover = CAMERA.project(pose.apply(np.column_stack([outline, np.zeros(4)])))
        gray = render_markers(CAMERA, markers, rng, margin=0.24, cover=cover)
        seen = tracker.observe_body(Frame(np.repeat(gray[:, :, None], 3, axis=2), 0.5 * k, k), body)
        assert seen is not None
        yield pose, seen


def errors(pairs: list[tuple[Pose, BodyObservation]]) -> np.ndarray:
    """(n, 2) metres and degrees."""
    off = np.array([seen.pose_camera_body.distance(pose) for pose, seen in pairs])
    return off * (1.0, 180 / np.pi)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_a_board_of_four_meets_its_target_at_one_metre() -> None:
    pairs = list(seen_boards(grid_body(2, 2, 0.05, 0.012), 1.0, 12, seed=1))
    off = errors(pairs)
    assert rms(off[:, 0]) <= 0.3e-3
    assert rms(off[:, 1]) <= 0.2
    assert off[:, 1].max() <= 1.0
    assert all(seen.ids == (0, 1, 2, 3) and seen.ambiguity < 0.6 for _, seen in pairs)


def test_half_a_board_is_enough() -> None:
    pairs = list(seen_boards(grid_body(3, 3, 0.05, 0.012), 0.8, 12, seed=3, hidden=0.5))
    off = errors(pairs)
    assert np.mean([len(seen.ids) for _, seen in pairs]) < 5
    assert rms(off[:, 0]) <= 1e-3
    assert rms(off[:, 1]) <= 0.3


def exact(body: MarkerBody, pose: Pose) -> dict:
    corners = {
        i: CAMERA.project(pose.compose(p).apply(marker_points(size))) for i, (size, p) in body.markers.items()
    }
    return {i: unrefined(c, CAMERA, 0.05) for i, c in corners.items()}


def test_a_flat_board_far_away_keeps_its_doubt_and_a_cube_has_none() -> None:
    pose = Pose((0.0, 0.0, 8.0), quat_multiply(FACING, rotation_exp([0.4, 0.2, 0.0])))
    board = grid_body(2, 2, 0.05, 0.012)
    rng = np.random.default_rng(2)
    noisy = {
        i: unrefined(c.corners + rng.normal(0, 0.05, (4, 2)), CAMERA, 0.05)
        for i, c in exact(board, pose).items()
    }
    seen = estimate_body(noisy, board.markers, CAMERA)
    assert seen is not None and seen.alternative is not None
    assert seen.ambiguity > 0.7
    best = min((seen.pose_camera_body, seen.alternative), key=lambda p: p.distance(pose)[1])
    assert best.distance(pose)[1] < 0.1
    cube = cube_body([0, 1], 0.04, 0.05)
    turned = Pose((0.0, 0.0, 0.8), quat_multiply(FACING, rotation_exp([0.0, -0.7, 0.0])))
    body = estimate_body(exact(cube, turned), cube.markers, CAMERA)
    assert body is not None and body.ids == (0, 1)
    assert body.alternative is None and body.ambiguity == 0.0
    assert body.pose_camera_body.distance(turned)[1] < 1e-4


def test_markers_that_disagree_a_little_count_less() -> None:
    """A marker glued on half a millimetre off: too near to be thrown out, too far to be believed."""
    board = grid_body(3, 3, 0.03, 0.01)
    pose = Pose((0.01, 0.02, 0.6), quat_multiply(FACING, rotation_exp([0.5, 0.1, 0.0])))
    seen = exact(board, pose)
    seen[0] = unrefined(seen[0].corners + np.array([0.25, 0.1]), CAMERA, 0.05)
    body = estimate_body(seen, board.markers, CAMERA)
    assert body is not None and body.rejected == ()
    from robot_ik.camera.pose_fit import CornerData, fit_pose

    points = np.concatenate([p.apply(marker_points(s)) for s, p in board.markers.values()])
    plain, _ = fit_pose(CornerData.of(points, [seen[i] for i in board.markers], CAMERA), pose)
    assert body.pose_camera_body.distance(pose)[0] < 0.6 * plain.distance(pose)[0]


# ------------------------------------------------------------------------------------ layouts


def test_the_grid_reads_like_a_page() -> None:
    board = grid_body(3, 2, 0.04, 0.01, first_id=10)
    place = {i: p.position.tolist() for i, (_, p) in board.markers.items()}
    assert place[10] == pytest.approx([-0.05, 0.025, 0.0])
    assert place[12] == pytest.approx([0.05, 0.025, 0.0])
    assert place[15] == pytest.approx([0.05, -0.025, 0.0])
    assert board.sizes == dict.fromkeys(range(10, 16), 0.04)


def test_the_sides_of_a_cube_look_outwards_and_stand_upright() -> None:
    cube = cube_body([5, 6, 7, 8, 9, 4], 0.04, 0.05)
    outwards = [(0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0), (0, 1, 0), (0, -1, 0)]
    for (_, pose), out in zip(cube.markers.values(), outwards, strict=True):
        assert pose.rotation[:, 2] == pytest.approx(np.array(out, float), abs=1e-12)
        assert pose.position == pytest.approx(0.025 * np.array(out), abs=1e-12)
    for i in (5, 6, 7, 8):
        assert cube.markers[i][1].rotation[:, 1] == pytest.approx([0, 1, 0], abs=1e-12)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: grid_body(0, 2, 0.05, 0.01), "0 x 2 markers"),
        (lambda: grid_body(2, 2, 0.05, 0.0), "gaps of 0 mm is not possible"),
        (lambda: grid_body(2, 2, 50.0, 12.0), r"marker size of 50.0 m(.|\n)*50.0 mm are 0.05"),
        (lambda: cube_body([1, 1], 0.04, 0.05), "one to six different"),
        (lambda: cube_body([1], 0.05, 0.05), "do not fit on a cube"),
        (lambda: MarkerBody("empty", {}), "has no markers"),
        (
            lambda: MarkerBody("far", {50: (0.05, Pose())}, "DICT_5X5_50"),
            "marker 50, which is not in DICT_5X5",
        ),
        (lambda: MarkerBody("what", {5: (0.05, Pose())}, "DICT_9X9"), "unknown marker dictionary"),
    ],
)
def test_bodies_that_cannot_be_are_refused(make, text: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(CameraError, match=text):
        make()


def test_a_body_of_another_dictionary_is_not_looked_for() -> None:
    body = MarkerBody("cube", {1: (0.05, Pose())}, "DICT_5X5_50")
    frame = Frame(np.zeros((480, 640, 3), np.uint8), 0.0, 0)
    assert MarkerTracker(CAMERA, "5x5_50").observe_body(frame, body) is None
    with pytest.raises(CameraError, match="are of DICT_5X5_50, but DICT_4X4_50 is looked for"):
        MarkerTracker(CAMERA, "DICT_4X4_50").observe_body(frame, body)


# --------------------------------------------------------------------------------------- file

GOOD = """
[[body]]
name = "cube"
dictionary = "DICT_5X5_50"
markers = [
  {id = 20, size = 0.07, position = [0, 0, 0.04]},
  {id = 21, size = 0.07, position = [0.04, 0, 0], wxyz = [1, 0, 1, 0]},
]

[[body]]
name = "flag"
markers = [{id = 3, size = 0.05}]
"""


def test_bodies_come_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "bodies.toml"
    file.write_text(GOOD)
    bodies = load_bodies(file)
    assert list(bodies) == ["cube", "flag"]
    size, pose = bodies["cube"].markers[21]
    assert size == 0.07 and pose.position.tolist() == [0.04, 0.0, 0.0]
    assert pose.rotation[:, 2] == pytest.approx([1, 0, 0])
    assert bodies["flag"].dictionary is None


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("[[body]]", "[[bodies]]", r"bodies: unknown key 'bodies'; allowed: body"),
        (GOOD, "", "body: this key is missing; allowed: one table"),
        (GOOD, "x = ", "not valid TOML"),
        ('name = "flag"\n', "", r"body\[1\].name: this key is missing"),
        ('name = "flag"', 'name = "cube"', r"two bodies are named 'cube'"),
        ("size = 0.05", "side = 0.05", r"markers\[0\].side: unknown key 'side'"),
        ("size = 0.05", "size = 50", r"body\[1\]: a marker size of 50.0 m"),
        ("id = 21", "id = 20", r"markers\[1\]: marker 20 comes twice"),
        ("id = 21", "id = 99", r"body\[0\]: the body 'cube' has marker 99"),
        ("id = 3", "id = true", r"markers\[0\].id: True is not right; allowed: a"),
        ("wxyz = [1, 0, 1, 0]", "wxyz = [1, 0]", r"\[1\].wxyz: \[1, 0\] is not right; allowed: 4 numbers"),
        ("wxyz = [1, 0, 1, 0]", "wxyz = [0, 0, 0, 0]", r"markers\[1\].wxyz: a quaternion of zeros"),
        ('dictionary = "DICT_5X5_50"', 'dictionary = "DICT_5X5"', r"unknown marker dictionary 'DICT_5X5'"),
        ('"flag"\n', '"flag"\ndictionary = "DICT_5X5_50"\n', None),
        ('id = 3, size = 0.05}', 'id = 3, size = 0.05}, 7', r"markers\[1\]: 7 is not right; allowed: "),
    ],
)  # fmt: skip
def test_what_is_wrong_in_the_file_is_reported(tmp_path: Path, old: str, new: str, text: str | None) -> None:
    file = tmp_path / "bodies.toml"
    assert old in GOOD
    file.write_text(GOOD.replace(old, new))
    if text is None:
        assert load_bodies(file)["flag"].dictionary == "DICT_5X5_50"
        return
    with pytest.raises(ConfigError, match=text) as caught:
        load_bodies(file)
    assert str(file) in str(caught.value)


def test_a_missing_file_and_a_marker_on_two_bodies(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none.toml: .* cannot be read: No such file"):
        load_bodies(tmp_path / "none.toml")
    file = tmp_path / "two.toml"
    file.write_text(GOOD.replace('dictionary = "DICT_5X5_50"\n', "").replace("id = 3", "id = 20"))
    with pytest.raises(ConfigError, match="marker 20 is on 'cube' and on 'flag'"):
        load_bodies(file)
