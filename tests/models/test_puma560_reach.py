"""The scene of `robot-ik reach` with the PUMA 560: markers within reach and in the picture."""

import math
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.models.arm_checks import check_way_from_ready, posed, site, solve

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[2] / "models" / "puma560"


@cache
def load(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / name))


@cache
def settings() -> dict[str, Any]:
    scene: dict[str, Any] = tomllib.loads((FOLDER / "robot.toml").read_text())["reach"]
    return scene


def goal(x: float, y: float, yaw: float) -> tuple[Array, Array]:
    """Return a pose over a marker at (x, y): z into the marker, x along the marker's x."""
    reach = settings()
    c = math.cos(yaw)
    s = math.sin(yaw)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ np.diag([1.0, -1.0, -1.0])
    return np.array([x, y, reach["table"]["height"] + reach["hover"]]), rotation


@pytest.mark.parametrize("yaw_deg", [-90.0, -20.0, 45.0, 100.0])
@pytest.mark.parametrize("x", [-0.50, -0.44, -0.38, -0.32])
@pytest.mark.parametrize("y", [-0.20, -0.12, 0.05])
def test_markers_on_the_table_are_reached_elbow_up(x: float, y: float, yaw_deg: float) -> None:
    model = load("scene.xml")
    q = solve(model, "gripper", *goal(x, y, math.radians(yaw_deg)))
    check_way_from_ready(model, q, "link3", above=1.0)


def camera() -> tuple[Array, Array]:
    """Position and (3, 3) rotation of the scene's camera; columns right, down, forward."""
    shot = settings()["camera"]
    eye = np.array(shot["position"])
    forward = np.array(shot["look_at"]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return eye, np.stack([right, np.cross(forward, right), forward], axis=1)


def pixels(points: Array) -> Array:
    """Return the pinhole image (n, 2) of points (n, 3). The distortion is less than the margin."""
    shot = settings()["camera"]
    eye, axes = camera()
    local = (points - eye) @ axes
    assert np.all(local[:, 2] > 0.1)
    centre = np.array([shot["width"] - 1, shot["height"] - 1]) / 2
    image: Array = centre + shot["focal"] * local[:, :2] / local[:, 2:]
    return image


def square(centre: Array, axes: Array, size: float) -> Array:
    """A grid of (49, 3) points on a printed marker."""
    span = np.linspace(-size / 2, size / 2, 7)
    return np.array([centre + axes @ [u, v, 5e-4] for u in span for v in span])


def is_visible(model: mujoco.MjModel, data: mujoco.MjData, points: Array) -> bool:
    """Return whether all points are 40 px inside the picture and no geom hides one."""
    shot = settings()["camera"]
    image = pixels(points)
    eye = camera()[0]
    hit = np.zeros(1, np.int32)
    if np.any(image < 40) or np.any(image > [shot["width"] - 40, shot["height"] - 40]):
        return False
    for point in points:
        distance = float(np.linalg.norm(point - eye))
        ray = mujoco.mj_ray(model, data, eye, (point - eye) / distance, None, 1, -1, hit)
        if 0 <= ray < distance - 4e-4:
            return False
    return True


def table_marker() -> tuple[Array, Array, float]:
    marker = settings()["marker"]
    yaw = math.radians(marker["yaw_deg"])
    c = math.cos(yaw)
    s = math.sin(yaw)
    return (
        np.array(marker["position"]),
        np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]),
        marker["size"],
    )


def test_table_marker_lies_on_the_table_and_is_seen_from_home_and_ready() -> None:
    model = load("scene.xml")
    reach = settings()
    centre, axes, size = table_marker()
    assert centre[2] == reach["table"]["height"]
    for k, key in enumerate(("x", "y")):
        assert reach["table"][key][0] + size < centre[k] < reach["table"][key][1] - size
    for name in ("home", "ready"):
        assert is_visible(model, posed(model, model.key(name).qpos), square(centre, axes, size)), (
            name
        )


def test_two_sides_of_the_gripper_cube_are_seen_at_the_goal() -> None:
    model = load("scene.xml")
    reach = settings()
    centre = table_marker()[0]
    q = solve(
        model, "gripper", *goal(centre[0], centre[1], math.radians(reach["marker"]["yaw_deg"]))
    )
    assert q is not None
    data = posed(model, q)
    eye = camera()[0]
    visible = 0
    for number in reach["tool_marker"]["ids"]:
        position, axes = site(data, f"marker_{number}")
        away = eye - position
        facing = float(away @ axes[:, 2] / np.linalg.norm(away))
        if facing > math.cos(math.radians(60)):
            assert is_visible(model, data, square(position, axes, reach["tool_marker"]["size"])), (
                number
            )
            assert 1.1 < np.linalg.norm(away) < 1.6
            visible += 1
    assert visible == 2


@pytest.mark.parametrize("key", ["home", "ready"])
def test_the_whole_moving_arm_is_in_the_picture(key: str) -> None:
    model = load("puma560.xml")
    data = posed(model, model.key(key).qpos)
    image = pixels(data.geom_xpos[model.geom_bodyid > model.body("base").id])
    shot = settings()["camera"]
    assert np.all(image > 30) and np.all(image < [shot["width"] - 30, shot["height"] - 30])
