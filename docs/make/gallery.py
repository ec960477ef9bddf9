"""Draw robots at home and while they reach: one picture each, and all on one sheet.

    python docs/make/gallery.py [ROBOT ...] [--out FOLDER] [--seed N]

ROBOT is a name of the catalogue, or an MJCF or URDF file. By default all bundled robots are drawn.
Exit code 1: a goal in a picture is out of reach.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.framing import fitted_camera, portrait_lens
from robot_ik.camera.drawing.overlay import DARK, ORANGE, WHITE
from robot_ik.camera.drawing.studio import SEAMLESS, Body, Photo, photograph
from robot_ik.camera.drawing.text import text_size, write
from robot_ik.camera.image import write_image
from robot_ik.errors import ModelError
from robot_ik.files import make_folder
from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.ports import Array, Image
from robot_ik.robot import Robot, load_robot
from robot_ik.robot_file import catalogue
from robot_ik.solution import Solution
from robot_ik.support import support_goals, supported_frames
from robot_ik.testbed.gallery_scene import GalleryScene, gallery_scene

HEIGHT = 560
"""Height of a picture, px."""

WIDEST = 1.6
"""Width of a picture in heights, before it is cropped to the robot."""

SIDE_SPACE = 0.10
"""Space that is left beside the robot, in picture heights."""

SLIMMEST = 0.42
"""Least width of a cropped picture, in picture heights."""

TRIES = 100
"""Random poses that are tried for a robot without a scene, until one is above the floor."""

FLOOR_TOLERANCE = 1e-3
"""m. A geom may be this far below the floor."""

SHEET_WIDTH = 1280
"""Width of the sheet, px."""

GAP = 8
"""Space between two cards on the sheet, px."""

ROW_ASPECT = 6.6
"""Width of a full row of pictures in heights."""

NAME_HEIGHT = 30
"""Height of the row with the name above a robot on the sheet, px."""

NAME_SIZE = 17
"""Letter size of the name on the sheet, px."""

CAPTION_COLOUR = (120, 114, 110)
"""BGR colour of the captions."""

PAPER = tuple(round(255 * tone) for tone in SEAMLESS.wall)
"""BGR colour around the pictures, that of the wall in them."""

DOT_FRACTION = 256
"""Parts of a pixel in coordinates of circles (8 bits of fraction)."""


@dataclass(frozen=True)
class Portrait:
    """Two pictures of a robot: at home and at work.

    Attributes:
        robot: The robot.
        captions: Captions of the two pictures.
        photos: The pictures, not cropped.
        image: Both pictures with name and captions, BGR.
        solution: The pose at work.
        pair: The pictures, cropped to the robot, BGR.
    """

    robot: Robot
    captions: tuple[str, str]
    photos: tuple[Photo, Photo]
    image: Image
    solution: Solution
    pair: tuple[Image, Image]

    @property
    def aspect(self) -> float:
        """Width of both cropped pictures in heights."""
        return sum(image.shape[1] / image.shape[0] for image in self.pair)


def pose_at_work(robot: Robot, scene: GalleryScene, floor: float, seed: int) -> Solution:
    """Return the pose of the second picture.

    Args:
        robot: The robot.
        scene: Its goals. Without goals the robot reaches for a random position above the floor.
        floor: Height of the floor, m.
        seed: Seed of the random position and of the solver.
    """
    if not scene.goals:
        goal = random_goal(robot, floor, np.random.default_rng(seed))
        return solve(robot, goal, seed=seed)
    goals = support_goals(robot, scene.goals)
    for frame, numbers in scene.goals.items():
        position = numbers[:3]
        if len(numbers) == 7:
            goals.append(PoseGoal(frame, position, numbers[3:]))
        else:
            goals.append(PositionGoal(frame, position))
    return solve(robot, goals, seed=seed)


def random_goal(robot: Robot, floor: float, rng: np.random.Generator) -> Goal:
    """Return a reachable position of the tool, for a pose above the floor if one is found."""
    q = robot.sample(rng)
    for _ in range(TRIES):
        lowest = float(surface_points(robot.model, robot.qpos(q))[:, 2].min())
        if lowest >= floor - FLOOR_TOLERANCE:
            break
        q = robot.sample(rng)
    return PositionGoal(None, robot.forward(q).position)


def draw_robot(robot: Robot, seed: int = 0, height: int = HEIGHT) -> Portrait:
    """Draw a robot at home and at work, from the same viewpoint.

    Args:
        robot: The robot.
        seed: Seed of the pose at work.
        height: Height of a picture, px.

    Raises:
        ModelError: The model has no visible geom.
    """
    scene = gallery_scene(robot)
    at_home = surface_points(robot.model, robot.qpos(robot.home))
    if not len(at_home):
        raise ModelError(f"{robot.path} has no visible geom to draw", path=robot.path)
    floor = float(at_home[:, 2].min())
    solution = pose_at_work(robot, scene, floor, seed)
    at_work = surface_points(robot.model, robot.qpos(solution.q))

    lens = portrait_lens(round(WIDEST * height), height)
    camera = fitted_camera(np.concatenate([at_home, at_work]), scene.view_deg, lens)

    def photo_of(q: Array) -> Photo:
        return photograph([Body(robot.model, robot.qpos(q))], lens, camera, SEAMLESS, floor=floor)

    home = photo_of(robot.home)
    work = photo_of(solution.q)
    work = replace(work, image=with_goals(work, solution))
    home_name = robot.file.home if isinstance(robot.file.home, str) else "home"
    captions = (home_name, scene.about)
    pair = (cropped(home), cropped(work))
    image = card(robot.name, captions, pair)
    return Portrait(robot, captions, (home, work), image, solution, pair)


def with_goals(photo: Photo, solution: Solution) -> Image:
    """Return the picture with a dot on each goal, except those that keep a foot in place."""
    image = photo.image.copy()
    radius = max(2.5, image.shape[0] / 110)
    kept = supported_frames(solution.robot, gallery_scene(solution.robot).goals)
    for goal in solution.goals:
        if not isinstance(goal, PositionGoal | PoseGoal) or goal.frame in kept:
            continue
        position = photo.camera.inverse().apply(goal.target.position)
        pixel = photo.intrinsics.project(position[None])[0]
        # An unreachable goal may be behind the camera or far outside the picture.
        if position[2] <= 0 or (np.abs(pixel) >= 2 * image.shape[1]).any():
            continue
        centre = tuple(int(value) for value in np.rint(pixel * DOT_FRACTION))
        for dot_radius, colour in ((radius + 1.5, WHITE), (radius, ORANGE)):
            size = round(dot_radius * DOT_FRACTION)
            cv2.circle(image, centre, size, colour, -1, cv2.LINE_AA, 8)
    return image


def cropped(photo: Photo) -> Image:
    """Return the columns of a picture that show the robot, with space on both sides."""
    height, width = photo.coverage.shape
    columns = np.flatnonzero(photo.coverage.max(axis=0) > 0)
    left = int(columns[0]) if len(columns) else 0
    right = int(columns[-1]) + 1 if len(columns) else width
    half = max((right - left) / 2 + SIDE_SPACE * height, SLIMMEST * height / 2)
    middle = (left + right) / 2
    first = max(0, round(middle - half))
    last = min(width, round(middle + half))
    return photo.image[:, first:last]


def card(name: str, captions: tuple[str, str], pair: tuple[Image, Image]) -> Image:
    """Return two pictures beside each other, with a name above and captions below."""
    height = pair[0].shape[0]
    letter = max(9, height // 28)
    top = round(2.4 * letter)
    bottom = round(2.0 * letter)
    width = sum(image.shape[1] for image in pair) + 2
    result = np.full((top + height + bottom, width, 3), PAPER, dtype=np.uint8)
    write(result, name, (letter, round(1.5 * letter)), round(1.2 * letter), DARK, bold=True)
    x = 0
    for image, caption in zip(pair, captions, strict=True):
        result[top : top + height, x : x + image.shape[1]] = image
        space = image.shape[1] - 2 * letter
        fitting = letter * space // max(1, text_size(caption, letter)[0])
        size = min(letter, max(8, fitting))
        baseline = top + height + round(1.1 * letter)
        write(result, caption, (x + letter, baseline), size, CAPTION_COLOUR)
        x += image.shape[1] + 2
    return result


def contact_sheet(portraits: Sequence[Portrait]) -> Image:
    """Return all robots on one sheet, in rows from edge to edge."""
    strips = []
    for row in sheet_rows(portraits):
        space = SHEET_WIDTH - GAP * (len(row) + 1)
        # The lower bound keeps a few robots from being enlarged to the width of the sheet.
        aspect = max(sum(portrait.aspect for portrait in row), ROW_ASPECT / 2)
        strips.append(strip(row, round(space / aspect)))
    height = sum(image.shape[0] + GAP for image in strips) + GAP
    sheet = np.full((height, SHEET_WIDTH, 3), 255, dtype=np.uint8)
    y = GAP
    for image in strips:
        x = max(0, (SHEET_WIDTH - image.shape[1]) // 2)
        sheet[y : y + image.shape[0], x : x + image.shape[1]] = image[:, : SHEET_WIDTH - x]
        y += image.shape[0] + GAP
    return sheet


def sheet_rows(portraits: Sequence[Portrait]) -> list[list[Portrait]]:
    """Return the portraits in rows of about equal width, in their order."""
    total = sum(portrait.aspect for portrait in portraits)
    count = max(1, round(total / ROW_ASPECT))
    rows: list[list[Portrait]] = [[] for _ in range(count)]
    start = 0.0
    for portrait in portraits:
        middle = start + portrait.aspect / 2
        rows[min(count - 1, int(middle / total * count))].append(portrait)
        start += portrait.aspect
    return [row for row in rows if row]


def strip(row: Sequence[Portrait], height: int) -> Image:
    """Return robots beside each other, ``height`` px high, each below its name."""
    gap = np.full((height + NAME_HEIGHT, GAP, 3), 255, dtype=np.uint8)
    parts = []
    for portrait in row:
        pictures = np.concatenate([scaled(image, height) for image in portrait.pair], axis=1)
        head = np.full((NAME_HEIGHT, pictures.shape[1], 3), PAPER, dtype=np.uint8)
        write(head, portrait.robot.name, (12, 22), NAME_SIZE, DARK, bold=True)
        parts += [np.concatenate([head, pictures]), gap]
    return np.concatenate(parts[:-1], axis=1)


def scaled(image: Image, height: int) -> Image:
    """Return a picture at another height, px, with the same aspect."""
    width = round(height * image.shape[1] / image.shape[0])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def draw_gallery(
    robots: Sequence[Robot], folder: Path, seed: int = 0, height: int = HEIGHT
) -> tuple[list[Portrait], list[Path]]:
    """Draw each robot into ``folder``/NAME.png, and all robots into ``folder``/gallery.png.

    Returns:
        The portraits, and the files: one for each robot, and the sheet.

    Raises:
        OutputError: A file cannot be written.
    """
    portraits = []
    files = []
    for robot in robots:
        portrait = draw_robot(robot, seed, height)
        file = folder / f"{robot.name}.png"
        write_image(file, portrait.image)
        portraits.append(portrait)
        files.append(file)
    sheet = folder / "gallery.png"
    write_image(sheet, contact_sheet(portraits))
    return portraits, [*files, sheet]


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the robots of a command line. Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", metavar="ROBOT", default=[])
    parser.add_argument("--out", type=Path, default=Path("runs/gallery"), metavar="FOLDER")
    parser.add_argument("--seed", type=int, default=0, metavar="N")
    options = parser.parse_args(arguments)
    robots = [load_robot(name) for name in options.robots or catalogue()]
    portraits, files = draw_gallery(robots, make_folder(options.out), options.seed)
    for portrait, file in zip(portraits, files, strict=False):
        print(f"{portrait.robot.name}: {portrait.solution.status.name}, {file}")
    print(f"all on one sheet: {files[-1]}")
    return 0 if all(portrait.solution.converged for portrait in portraits) else 1


if __name__ == "__main__":
    sys.exit(main())
