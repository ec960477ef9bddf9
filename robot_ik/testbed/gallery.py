"""The gallery: every robot at home and at work, one picture each, and all on one sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.overlay import DARK, ORANGE, WHITE
from robot_ik.camera.drawing.studio import SEAMLESS, Body, Photo, photograph
from robot_ik.camera.drawing.text import text_size, write
from robot_ik.camera.image import write_image
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import ModelError
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.ports import Array, Image
from robot_ik.robot import Robot
from robot_ik.solution import Solution
from robot_ik.support import support_goals, supported_frames
from robot_ik.testbed.gallery_scene import GalleryScene, gallery_scene
from robot_ik.workcell.progress import Progress

# Focal length in picture heights: a long lens, so that limbs near to it do not look swollen.
_FOCAL = 2.4
# Part of the picture left free on every side of the robot.
_MARGIN = 0.06
# Steps of the search for a viewpoint from which the robot fills the picture; each settles most of the rest.
_FIT_STEPS = 40


def lens(width: int, height: int) -> CameraIntrinsics:
    """The gallery's lens for pictures of that size."""
    focal = _FOCAL * height
    return CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def fitted_camera(points: Array, view_deg: tuple[float, float], intrinsics: CameraIntrinsics) -> Pose:
    """``pose_world_camera`` from where ``points`` (n, 3), world, just fill the picture.

    ``view_deg`` is the direction from which to look: azimuth from x towards y, and elevation.
    """
    azimuth, elevation = np.radians(view_deg)
    back = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    rotation = Pose.look_at(back, np.zeros(3)).rotation
    seen = points @ rotation  # camera axes, origin in the world's
    low, high = seen.min(axis=0), seen.max(axis=0)
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
    space = np.array(intrinsics.size) * (1 - 2 * _MARGIN)
    distance = 2.0 * size * intrinsics.fx / float(space.min())
    for _ in range(_FIT_STEPS):
        depth = seen[:, 2] - centre[2] + distance
        pixels = (seen[:, :2] - centre[:2]) / depth[:, None] * intrinsics.fx
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        centre[:2] += (low + high) / 2 * distance / intrinsics.fx
        # Half of what it takes: what reaches far towards the camera grows much faster than it comes nearer.
        distance = max(distance * math.sqrt(float(((high - low) / space).max())), 0.51 * size)
    return Pose.from_rotation(rotation, rotation @ centre + distance * back)


#: Height of a picture, pixels; it may be this much wider than high before it is cropped to the robot.
HEIGHT = 560
_WIDEST = 1.6
# A picture is cropped to the robot and this part of its height on both sides, but keeps the least width.
_AIR, _SLIMMEST = 0.10, 0.42
# Robots without a scene of their own: so many random poses are tried until one is above the floor.
_TRIES = 100
# The sheet: its width, the gap between cards, and how much wider than high a full row of pictures is.
_SHEET_WIDTH, _GAP, _ROW = 1280, 8, 6.6
_GREY, _PAPER = (120, 114, 110), [round(255 * tone) for tone in SEAMLESS.wall]


@dataclass(frozen=True)
class Portrait:
    """One robot's two pictures: at home and at work, with their captions.

    ``photos`` are uncropped, ``pair`` cropped for the sheet; ``image`` (BGR) has both with captions.
    """

    robot: Robot
    captions: tuple[str, str]
    photos: tuple[Photo, Photo]
    image: Image
    solution: Solution
    pair: tuple[Image, Image]


def pose_at_work(robot: Robot, scene: GalleryScene, floor: float, seed: int) -> Solution:
    """Solves for what the robot does in its second picture.

    Where the scene has no goals it reaches for a random position above the floor, whose height is ``floor``.
    """
    if not scene.goals:
        return solve(robot, _random_goal(robot, floor, np.random.default_rng(seed)), seed=seed)
    goals = support_goals(robot, scene.goals)
    for frame, numbers in scene.goals.items():
        position = numbers[:3]
        goals.append(
            PoseGoal(frame, position, numbers[3:]) if len(numbers) == 7 else PositionGoal(frame, position)
        )
    return solve(robot, goals, seed=seed)


def _random_goal(robot: Robot, floor: float, rng: np.random.Generator) -> Goal:
    q = robot.sample(rng)
    for _ in range(_TRIES):
        if float(surface_points(robot.model, robot.qpos(q))[:, 2].min()) >= floor - 1e-3:
            break
        q = robot.sample(rng)
    return PositionGoal(None, robot.forward(q).position)


def draw_robot(robot: Robot, seed: int = 0, height: int = HEIGHT) -> Portrait:
    """Draws one robot at home and at work, seen from the same viewpoint; ``height`` of a picture in pixels.

    Raises:
        ModelError: The model has nothing that can be seen.
    """
    scene = gallery_scene(robot)
    at_home = surface_points(robot.model, robot.qpos(robot.home))
    if not len(at_home):
        raise ModelError(f"{robot.path} has no visible geom to draw", path=robot.path)
    floor = float(at_home[:, 2].min())
    solution = pose_at_work(robot, scene, floor, seed)
    at_work = surface_points(robot.model, robot.qpos(solution.q))
    optics = lens(round(_WIDEST * height), height)
    camera = fitted_camera(np.concatenate([at_home, at_work]), scene.view_deg, optics)
    photos = [
        photograph([Body(robot.model, robot.qpos(q))], optics, camera, SEAMLESS, floor=floor)
        for q in (robot.home, solution.q)
    ]
    work = replace(photos[1], image=_with_goals(photos[1], solution))
    home = robot.file.home if isinstance(robot.file.home, str) else "home"
    captions = (home, scene.about)
    pair = (_cropped(photos[0]), _cropped(work))
    image = _card(robot, captions, pair)
    return Portrait(robot, captions, (photos[0], work), image, solution, pair)


def _with_goals(photo: Photo, solution: Solution) -> Image:
    """The picture with a dot on every position that something was to reach."""
    image = photo.image.copy()
    radius = max(2.5, photo.image.shape[0] / 110)
    moved = [goal for goal in solution.goals if isinstance(goal, PositionGoal | PoseGoal)]
    kept = supported_frames(solution.robot, gallery_scene(solution.robot).goals)
    positions = [goal.target.position for goal in moved if goal.frame not in kept]
    for position in positions:
        seen = photo.camera.inverse().apply(position)
        at = photo.intrinsics.project(seen[None])[0]
        if not (seen[2] > 0 and (np.abs(at) < 2 * image.shape[1]).all()):
            continue  # an unreachable goal may be behind the lens
        centre = tuple(int(v) for v in np.rint(at * 256))
        for r, colour in ((radius + 1.5, WHITE), (radius, ORANGE)):
            cv2.circle(image, centre, round(r * 256), colour, -1, cv2.LINE_AA, 8)
    return image


def _cropped(photo: Photo) -> Image:
    height, width = photo.coverage.shape
    columns = np.flatnonzero(photo.coverage.max(axis=0) > 0)
    low, high = (int(columns[0]), int(columns[-1]) + 1) if len(columns) else (0, width)
    half = max((high - low) / 2 + _AIR * height, _SLIMMEST * height / 2)
    middle = (low + high) / 2
    return photo.image[:, max(0, round(middle - half)) : min(width, round(middle + half))]


def _card(robot: Robot, captions: tuple[str, str], pair: tuple[Image, Image]) -> Image:
    """One robot's picture: name and title above, captions below."""
    height = pair[0].shape[0]
    letter = max(9, height // 28)
    top, below = round(2.4 * letter), round(2.0 * letter)
    width = sum(image.shape[1] for image in pair) + 2
    card = np.full((top + height + below, width, 3), _PAPER, dtype=np.uint8)
    write(card, robot.name, (letter, round(1.5 * letter)), round(1.2 * letter), DARK, bold=True)
    x = 0
    for image, caption in zip(pair, captions, strict=True):
        card[top : top + height, x : x + image.shape[1]] = image
        space = image.shape[1] - 2 * letter
        size = min(letter, max(8, letter * space // max(1, text_size(caption, letter)[0])))
        write(card, caption, (x + letter, top + height + round(1.1 * letter)), size, _GREY)
        x += image.shape[1] + 2
    return card


def contact_sheet(portraits: Sequence[Portrait]) -> Image:
    """All robots on one sheet, in rows that are filled from edge to edge."""
    total = sum(map(_aspect, portraits))
    count = max(1, round(total / _ROW))
    rows: list[list[Portrait]] = [[] for _ in range(count)]
    begin = 0.0
    for portrait in portraits:  # its middle says in which row it stands
        rows[min(count - 1, int((begin + _aspect(portrait) / 2) / total * count))].append(portrait)
        begin += _aspect(portrait)
    strips = []
    for row in filter(None, rows):
        space = _SHEET_WIDTH - _GAP * (len(row) + 1)
        # a few robots are not blown up
        strips.append(_strip(row, round(space / max(sum(map(_aspect, row)), _ROW / 2))))
    height = sum(strip.shape[0] + _GAP for strip in strips) + _GAP
    sheet = np.full((height, _SHEET_WIDTH, 3), 255, dtype=np.uint8)
    y = _GAP
    for strip in strips:
        x = max(0, (_SHEET_WIDTH - strip.shape[1]) // 2)
        sheet[y : y + strip.shape[0], x : x + strip.shape[1]] = strip[:, : _SHEET_WIDTH - x]
        y += strip.shape[0] + _GAP
    return sheet


def _aspect(portrait: Portrait) -> float:
    return sum(image.shape[1] / image.shape[0] for image in portrait.pair)


def _strip(row: Sequence[Portrait], height: int) -> Image:
    """Robots beside each other at one height, each with its name."""
    cards = []
    for portrait in row:
        small = [
            cv2.resize(
                image, (round(height * image.shape[1] / image.shape[0]), height), interpolation=cv2.INTER_AREA
            )
            for image in portrait.pair
        ]
        card = np.concatenate(small, axis=1)
        head = np.full((30, card.shape[1], 3), _PAPER, dtype=np.uint8)
        write(head, portrait.robot.name, (12, 22), 17, DARK, bold=True)
        cards += [np.concatenate([head, card]), np.full((height + 30, _GAP, 3), 255, dtype=np.uint8)]
    return np.concatenate(cards[:-1], axis=1)


def draw_gallery(
    robots: Sequence[Robot], folder: Path, seed: int = 0, progress: Progress = lambda name, share: None
) -> tuple[list[Portrait], list[Path]]:
    """Draws every robot into ``folder``/NAME.png, and all on gallery.png: the portraits and the files.

    ``progress`` is given a robot's name before it is drawn, and the share of all that is done.

    Raises:
        OutputError: A file cannot be written.
    """
    portraits, written = [], []
    for k, robot in enumerate(robots):
        progress(robot.name, k / len(robots))
        portraits.append(draw_robot(robot, seed))
        written.append(folder / f"{robot.name}.png")
        write_image(written[-1], portraits[-1].image)
    written.append(folder / "gallery.png")
    write_image(written[-1], contact_sheet(portraits))
    return portraits, written
