"""Targets: grids, cubes, and the file of bodies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robot_ik.camera.target_files import load_bodies
from robot_ik.camera.targets import MarkerTarget, marker, marker_cube, marker_grid
from robot_ik.errors import CameraError, ConfigError


def test_the_grid_reads_like_a_page() -> None:
    board = marker_grid(3, 2, 0.04, 0.01, first_id=10)
    place = {i: p.position.tolist() for i, (_, p) in board.markers.items()}
    assert place[10] == pytest.approx([-0.05, 0.025, 0.0])
    assert place[12] == pytest.approx([0.05, 0.025, 0.0])
    assert place[15] == pytest.approx([0.05, -0.025, 0.0])
    assert {i: size for i, (size, _) in board.markers.items()} == dict.fromkeys(range(10, 16), 0.04)


def test_the_sides_of_a_cube_look_outwards_and_stand_upright() -> None:
    cube = marker_cube([5, 6, 7, 8, 9, 4], 0.04, 0.05)
    outwards = [(0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0), (0, 1, 0), (0, -1, 0)]
    for (_, pose), out in zip(cube.markers.values(), outwards, strict=True):
        assert pose.rotation[:, 2] == pytest.approx(np.array(out, float), abs=1e-12)
        assert pose.position == pytest.approx(0.025 * np.array(out), abs=1e-12)
    for i in (5, 6, 7, 8):
        assert cube.markers[i][1].rotation[:, 1] == pytest.approx([0, 1, 0], abs=1e-12)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: marker_grid(0, 2, 0.05, 0.01), "0 x 2 markers"),
        (lambda: marker_grid(2, 2, 0.05, 0.0), "gaps of 0 mm is impossible"),
        (lambda: marker_grid(2, 2, 50.0, 12.0), r"marker size of 50.0 m(.|\n)*50 mm are 0.05"),
        (lambda: marker_cube([1, 1], 0.04, 0.05), "one to six different"),
        (lambda: marker_cube([1], 0.05, 0.05), "do not fit on a cube"),
        (lambda: MarkerTarget({}), "has no markers"),
        (lambda: marker(50, 0.05), "DICT_5X5_50 has no marker 50"),
        (lambda: marker(5, 0.05, "DICT_9X9"), "unknown marker dictionary"),
        (lambda: marker_grid(10, 10, 0.02, 0.005), "DICT_5X5_50 has no marker 50"),
    ],
)
def test_impossible_targets_are_refused(make, text: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(CameraError, match=text):
        make()


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
    assert bodies["flag"].dictionary == "DICT_5X5_50"
    assert load_bodies(file, "4x4_50")["flag"].dictionary == "DICT_4X4_50"


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
        ("id = 21", "id = 20", r"markers\[1\]: marker 20 appears twice"),
        ("id = 21", "id = 99", r"body\[0\]: DICT_5X5_50 has no marker 99"),
        ("id = 3", "id = true", r"markers\[0\].id: True is not right; allowed: a"),
        (
            "wxyz = [1, 0, 1, 0]",
            "wxyz = [1, 0]",
            r"\[1\].wxyz: \[1, 0\] is not right; allowed: 4 numbers",
        ),
        ("wxyz = [1, 0, 1, 0]", "wxyz = [0, 0, 0, 0]", r"markers\[1\].wxyz: a zero quaternion"),
        (
            'dictionary = "DICT_5X5_50"',
            'dictionary = "DICT_5X5"',
            r"unknown marker dictionary 'DICT_5X5'",
        ),
        ('"flag"\n', '"flag"\ndictionary = "DICT_5X5_50"\n', None),
        (
            "id = 3, size = 0.05}",
            "id = 3, size = 0.05}, 7",
            r"markers\[1\]: 7 is not right; allowed: ",
        ),
    ],
)
def test_errors_of_the_file_are_reported(
    tmp_path: Path, old: str, new: str, text: str | None
) -> None:
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
