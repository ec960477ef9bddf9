"""``[collisions]`` of an arm file on the page: the arm holds before it touches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import ConfigError
from robot_ik.hardware.config import ArmConfig
from robot_ik.motion import Trajectory
from robot_ik.ports import Array
from robot_ik.testbed.arm import ArmLink, ArmView
from robot_ik.testbed.filming import arm_link
from tests.waiting import wait_for

pytestmark = pytest.mark.usefixtures("real_time")

NAME = "tabletop_puma"


@pytest.fixture(scope="module")
def robot() -> rik.Robot:
    return rik.load_robot(NAME)


@pytest.fixture(scope="module")
def goal(robot: rik.Robot) -> Array:
    """Joint angles (nq,) behind the ball."""
    q = robot.home.copy()
    q[0] += 0.8
    return q


@pytest.fixture
def arm_file(tmp_path: Path, robot: rik.Robot, goal: Array) -> Path:
    """The arm file with a ball between home and the goal."""
    x, y, z = robot.forward(0.5 * (robot.home + goal)).position
    ball = f'<geom name="ball" size=".02" pos="{x} {y} {z}"/>'
    scene = f"<mujoco><worldbody>{ball}</worldbody></mujoco>"
    (tmp_path / "scene.xml").write_text(scene, encoding="utf-8")
    text = Path(ArmConfig.load(NAME).file or "").read_text(encoding="utf-8")
    table = '[collisions]\nscene = "scene.xml"\nmargin = 0.004\n\n[bus]'
    path = tmp_path / "arm.toml"
    path.write_text(text.replace("[bus]", table, 1), encoding="utf-8")
    return path


@pytest.fixture
def link(arm_file: Path) -> Iterator[ArmLink]:
    made = arm_link(NAME, arm_file, "sim")
    yield made
    made.close()


def until(
    link: ArmLink, robot: rik.Robot, wanted: Array, holds: Callable[[ArmView], object], what: str
) -> ArmView:
    """The view of the arm as soon as it is as it should be; the session wants ``wanted`` (nq,)."""

    def tick() -> ArmView | None:
        link.follow(robot, wanted, True)
        view = link.view()
        assert view.state != "fault", view
        return view if holds(view) else None

    return wait_for(tick, lambda: f"{what}: {link.view()}")


def test_the_arm_holds_before_the_ball_and_goes_on_when_the_way_is_free(
    link: ArmLink, robot: rik.Robot, goal: Array, tmp_path: Path
) -> None:
    scene = rik.Scene(robot, rik.load_obstacles(tmp_path / "scene.xml"))
    nearest = [np.inf]

    def is_held(view: ArmView) -> bool:
        if view.q is not None:
            nearest[0] = min(nearest[0], scene.clearance(view.q).distance)
        return "ball" in view.message

    until(link, robot, robot.home, lambda view: view.q is not None, "no reading")
    link.ask("follow")
    view = until(link, robot, goal, is_held, "it does not hold")
    assert "would" in view.message
    assert " mm " in view.message
    until(link, robot, goal, lambda view: is_held(view) and view.apart > 0.1, "it goes on")
    home = robot.home

    def is_home(view: ArmView) -> bool:
        return view.q is not None and bool(np.abs(view.q - home).max() < 0.01)

    view = until(link, robot, home, is_home, "it does not come back")
    assert view.message == ""
    assert nearest[0] > 0.0


def test_a_recording_through_the_ball_is_not_repeated(
    link: ArmLink, robot: rik.Robot, goal: Array
) -> None:
    until(link, robot, robot.home, lambda view: view.q is not None, "no reading")
    link.recording = Trajectory([0.0, 2.0], [robot.home, goal], robot.joints)
    link.ask("replay")
    view = until(link, robot, robot.home, lambda view: "ball" in view.message, "it is repeated")
    assert "would" in view.message
    view = until(link, robot, robot.home, lambda view: view.mode == "hold", "it does not hold")
    assert view.q == pytest.approx(robot.home, abs=0.01)


def test_a_wrong_scene_is_refused_before_the_arm_is_opened(arm_file: Path) -> None:
    (arm_file.parent / "scene.xml").unlink()
    with pytest.raises(ConfigError, match=r"collisions\.scene"):
        arm_link(NAME, arm_file, "sim")
