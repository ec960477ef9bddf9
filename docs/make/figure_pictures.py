"""Draws what the figure does: `python docs/make/figure_pictures.py [FOLDER]`, by default docs/images/figure.

A picture for each decision, and film strips of walk, turn, reach, bend and jump.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.studio import SEAMLESS, Body, photograph
from robot_ik.camera.image import write_image
from robot_ik.figure.abilities import Abilities, load_abilities
from robot_ik.figure.figure import Figure, load_figure
from robot_ik.figure.session import FigureFrame
from robot_ik.jobs.figure import FigureRequest, FilmMaker, run_figure, watch
from robot_ik.jobs.gallery import fitted_camera, lens
from robot_ik.ports import Array, Image

FOLDER = Path(__file__).resolve().parents[1] / "images" / "figure"
BALLS: dict[str, tuple[float, float, float]] = {
    "reach": (0.45, -0.25, 1.45),
    "bend": (0.5, -0.2, 0.15),
    "jump": (0.25, -0.2, 2.4),
    "walk": (2.6, 0.9, 1.2),
    "nothing": (0.6, 0.0, 3.2),
}
"""A ball for each decision of a figure at the origin."""
_STRIP_WIDTH = 165  # px of each picture of a film strip


def played(abilities: Abilities, ball: tuple[float, float, float]) -> list[FigureFrame]:
    """What the figure does about a ball."""
    frames = run_figure(abilities, FigureRequest((ball,)))
    return watch(abilities.figure.robot, abilities.figure.hands, frames).frames


def off_the_ball(figure: Figure, frame: FigureFrame) -> float:
    """Distance of ball and the hand that acts, m."""
    hand = figure.hands[frame.decision.arm or "right"]
    return float(np.linalg.norm(figure.robot.forward(frame.q, hand).position - frame.ball))


def strip(
    figure: Figure, q: Array, count: int, view_deg: tuple[float, float], *, follow: bool = False
) -> Image:
    """Some of the frames (n, nq) beside each other, painted."""
    optics = lens(2 * _STRIP_WIDTH, 560)
    picks = np.linspace(0, len(q) - 1, count).astype(int)
    moved = q[picks].copy()
    if follow:
        moved[:, :2] -= moved[:, :2].copy()
    points = np.concatenate([*(surface_points(figure.model, row) for row in moved), np.zeros((1, 3))])
    camera = fitted_camera(points, view_deg, optics)
    tiles = [photograph([Body(figure.model, row)], optics, camera, SEAMLESS).image for row in moved]
    whole = np.concatenate(tiles, axis=1)
    return np.asarray(cv2.resize(whole, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def main(folder: Path) -> None:
    """Draws them all."""
    folder.mkdir(parents=True, exist_ok=True)
    abilities = load_abilities(load_figure())
    figure, runs = abilities.figure, {action: played(abilities, ball) for action, ball in BALLS.items()}

    def save(name: str, image: Image) -> None:
        write_image(folder / f"{name}.png", image)
        print(folder / f"{name}.png")

    for action, frames in runs.items():
        shown = [frame for frame in frames if frame.action == action] or frames
        pick = shown[len(shown) // 2] if action == "walk" else shown[-1]
        if action == "jump":  # the palm at the ball
            pick = min(shown, key=lambda frame: off_the_ball(figure, frame))
        save(f"decision-{action}", FilmMaker(figure.robot, size=(480, 480)).picture(pick))

    def only(name: str, frames: list[FigureFrame]) -> Array:
        return np.array([frame.q for frame in frames if frame.action == name])

    walked = only("walk", runs["walk"])
    save("strip-walk", strip(figure, walked[len(walked) // 3 :][:70], 9, (-90.0, 6.0), follow=True))
    save("strip-bend", strip(figure, only("bend", runs["bend"]), 7, (-60.0, 8.0)))
    save("strip-reach", strip(figure, only("reach", runs["reach"]), 6, (-50.0, 8.0)))
    save("strip-jump", strip(figure, only("jump", runs["jump"])[20:], 10, (-60.0, 4.0)))
    behind = only("walk", played(abilities, (-1.8, -0.3, 1.2)))
    save("strip-turn", strip(figure, behind, 9, (-30.0, 8.0), follow=True))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
