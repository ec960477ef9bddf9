"""Draw the actions of the figure: `python docs/make/figure_pictures.py [FOLDER]`.

It draws a picture for each decision, and film strips of walk, turn, reach, bend and jump. The
default folder is docs/images/figure.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.framing import fitted_camera, portrait_lens
from robot_ik.camera.drawing.studio import SEAMLESS, Body, photograph
from robot_ik.camera.image import write_image
from robot_ik.commands.figure_film import FilmMaker
from robot_ik.commands.figure_runs import FigureRequest, run_figure, watch
from robot_ik.figure.abilities import Abilities, load_abilities
from robot_ik.figure.figure import Figure, load_figure
from robot_ik.figure.session import FigureFrame
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

_BALL_BEHIND = (-1.8, -0.3, 1.2)
"""A ball for which the figure turns."""

_STRIP_WIDTH = 165
"""Width of each picture of a film strip, px."""


def frames_for(abilities: Abilities, ball: tuple[float, float, float]) -> list[FigureFrame]:
    """Return the frames of the action for a ball."""
    frames = run_figure(abilities, FigureRequest((ball,)))
    return watch(abilities.figure.robot, abilities.figure.hands, frames).frames


def hand_error(figure: Figure, frame: FigureFrame) -> float:
    """Return the distance between the ball and the acting hand, m."""
    hand = figure.hands[frame.decision.arm or "right"]
    return float(np.linalg.norm(figure.robot.forward(frame.q, hand).position - frame.ball))


def strip(
    figure: Figure, q: Array, count: int, view_deg: tuple[float, float], *, follow: bool = False
) -> Image:
    """Return a picture of ``count`` of the frames (n, nq) beside each other."""
    optics = portrait_lens(2 * _STRIP_WIDTH, 560)
    indices = np.linspace(0, len(q) - 1, count).astype(int)
    rows = q[indices].copy()
    if follow:
        rows[:, :2] = 0.0
    surfaces = [surface_points(figure.model, row) for row in rows]
    points = np.concatenate([*surfaces, np.zeros((1, 3))])
    camera = fitted_camera(points, view_deg, optics)
    tiles = [photograph([Body(figure.model, row)], optics, camera, SEAMLESS).image for row in rows]
    image = np.concatenate(tiles, axis=1)
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return np.asarray(half, dtype=np.uint8)


def frames_of(action: str, frames: list[FigureFrame]) -> Array:
    """Return the joint values (n, nq) of the frames of an action."""
    return np.array([frame.q for frame in frames if frame.action == action])


def save(folder: Path, name: str, image: Image) -> None:
    """Write a picture."""
    file = folder / f"{name}.png"
    write_image(file, image)
    print(file)


def main(folder: Path) -> None:
    """Draw all pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    abilities = load_abilities(load_figure())
    figure = abilities.figure
    runs = {action: frames_for(abilities, ball) for action, ball in BALLS.items()}
    for action, frames in runs.items():
        of_action = [frame for frame in frames if frame.action == action] or frames
        frame = of_action[-1]
        if action == "walk":
            frame = of_action[len(of_action) // 2]
        elif action == "jump":
            frame = min(of_action, key=lambda candidate: hand_error(figure, candidate))
        maker = FilmMaker(figure.robot, size=(480, 480))
        save(folder, f"decision-{action}", maker.picture(frame))

    walk = frames_of("walk", runs["walk"])
    cycle = walk[len(walk) // 3 :][:70]
    save(folder, "strip-walk", strip(figure, cycle, 9, (-90.0, 6.0), follow=True))
    save(folder, "strip-bend", strip(figure, frames_of("bend", runs["bend"]), 7, (-60.0, 8.0)))
    save(folder, "strip-reach", strip(figure, frames_of("reach", runs["reach"]), 6, (-50.0, 8.0)))
    save(
        folder, "strip-jump", strip(figure, frames_of("jump", runs["jump"])[20:], 10, (-60.0, 4.0))
    )
    turn = frames_of("walk", frames_for(abilities, _BALL_BEHIND))
    save(folder, "strip-turn", strip(figure, turn, 9, (-30.0, 8.0), follow=True))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
