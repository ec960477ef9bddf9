"""The program of thesis P11 in a real browser: live AR, modes, keys, overlay, CCD, wire, prior."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from robot_ik.testbed.commands import (
    MoveGoal,
    SetCount,
    SetFigure,
    SetMethod,
    SetMotion,
    SetRunning,
    Start,
)
from robot_ik.testbed.robot_goals import NATURAL_POSE
from robot_ik.testbed.view import View
from tests.testbed.browser_window import Window, open_window
from tests.testbed.conftest import Bed, running_bed
from tests.waiting import LONG

pytest.importorskip("viser", reason="needs the extra web")
BALL = (0.45, -0.30, 1.25)
"""In reach of the right hand of the figure that stands at the origin, metres."""


@pytest.fixture(scope="module")
def figure_bed() -> Iterator[Bed]:
    """The figure with its page, whose loop runs on a thread."""
    with running_bed(Start("humanoid"), 8617) as bed:
        yield bed


@pytest.fixture(scope="module")
def window(chromium: Any, figure_bed: Bed) -> Iterator[Window]:
    opened = open_window(chromium, figure_bed.page.url, scene=False, width=1280, height=720)
    yield opened
    assert opened.errors() == []
    opened.page.close()


def in_mode(bed: Bed, mode: Any) -> None:
    """Bring the figure into a mode, with one robot and a ball by hand."""
    view = bed.apply(SetCount(1), SetRunning(True), SetFigure(mode))
    assert (view.figure.mode if view.figure else "off") == mode


def hand_distance(bed: Bed, view: View) -> float:
    """Return the distance of the nearer hand from the ball that is drawn, by MuJoCo, metres."""
    q = view.instances[0].q
    hands = [bed.session.robot.measure(q, f"{side}_hand").position for side in ("left", "right")]
    return min(float(np.linalg.norm(hand - view.ball.position)) for hand in hands)


def test_one_button_begins_arkineman_in_the_picture(window: Window, figure_bed: Bed) -> None:
    page = window.page
    window.open_tab("AR")
    page.get_by_role("button", name="ARKineMan").click()
    figure_bed.until(lambda view: view.figure and view.figure.mode == "active", "nothing decides")
    picture = page.get_by_role("img", name="augmented reality")
    picture.wait_for()
    drawn = "image => image.naturalWidth === 640"
    page.wait_for_function(drawn, arg=picture.element_handle(), timeout=1e3 * LONG)
    page.wait_for_function("document.querySelector('.rk-ar-bar').innerText.includes('pictures/s')")
    box = picture.bounding_box()
    assert box["width"] > 0.65 * 1280, "the picture does not fill the view"


def test_keys_move_the_ball_along_the_axes_of_the_board(window: Window, figure_bed: Bed) -> None:
    in_mode(figure_bed, "active")
    window.blur()
    for key, axis, sign in (
        ("ArrowRight", 0, 1.0),
        ("ArrowLeft", 0, -1.0),
        ("ArrowUp", 1, 1.0),
        ("ArrowDown", 1, -1.0),
        ("w", 2, 1.0),
        ("s", 2, -1.0),
    ):
        figure_bed.session.send(MoveGoal(BALL))
        figure_bed.until(lambda view: np.allclose(view.ball.position, BALL))

        def moved(axis: int = axis, sign: float = sign) -> bool:
            return sign * (figure_bed.view.ball.position - BALL)[axis] > 0.004

        window.press(key, moved, f"{key} does not move the ball")
        step = figure_bed.view.ball.position - BALL
        others = [k for k in range(3) if k != axis]
        assert np.abs(step[others]).max() < 1e-9, f"{key} moves the ball to the side"
    hint = window.page.locator(".rk-hint")
    assert "ball x" in hint.inner_text(), "the page does not show the keys"


def test_the_mouse_drags_the_ball_in_the_picture(window: Window, figure_bed: Bed) -> None:
    in_mode(figure_bed, "active")
    page = window.page
    figure_bed.session.send(MoveGoal(BALL))
    figure_bed.until(lambda view: np.allclose(view.ball.position, BALL))
    picture = page.get_by_role("img", name="augmented reality")
    for _ in range(3):  # the first two may show an older ball
        args = [picture.element_handle(), picture.get_attribute("src")]
        page.wait_for_function("([image, before]) => image.src !== before", arg=args)

    def drag() -> None:
        u, v, _ = figure_bed.page.ar._ball
        box = picture.bounding_box()
        scale = min(box["width"] / 640.0, box["height"] / 480.0)
        x = box["x"] + 0.5 * (box["width"] - 640.0 * scale) + u * scale
        y = box["y"] + 0.5 * (box["height"] - 480.0 * scale) + v * scale
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 40.0, y - 25.0, steps=4)
        page.mouse.up()

    window.repeat_until(
        drag,
        lambda: float(np.linalg.norm(figure_bed.view.ball.position - BALL)) > 0.05,
        "the ball was not dragged in the picture",
    )
    assert figure_bed.view.ball.position[2] > BALL[2] + 0.01, "up in the picture is not up"


def test_delay_and_remedies_are_switched_and_shown(window: Window, figure_bed: Bed) -> None:
    page = window.page
    window.open_tab("AR")
    page.get_by_role("combobox", name="delay of the tracker").select_option("200")
    page.get_by_role("switch", name="Delayed video").click()
    figures = page.locator(".rk-ar-tab .rk-stats")
    page.wait_for_function(
        """() => {
            const cells = [...document.querySelectorAll(".rk-ar-tab .rk-stats div")];
            const of = (name) => parseFloat(
                cells.find((cell) => cell.innerText.startsWith(name)).innerText.split("\\n")[1]);
            return of("delay") >= 200 && of("error") > 0.5;
        }"""
    )
    settings = figure_bed.page.ar.settings

    def click(name: str, **wanted: object) -> None:
        """Click a switch and wait for its effect: each click sends all settings of the page."""
        page.get_by_role("switch", name=name).click()
        window.blur()
        window.wait_until(lambda: settings() | wanted == settings(), f"{name}: no effect")

    click("Prediction", predict=True)
    click("Image shift", shift=True)
    assert figures.is_visible()
    assert settings() | {"seconds": 0.2, "sync": "latest"} == settings()
    click("Prediction", predict=False)
    click("Image shift", shift=False)
    click("Delayed video", sync="tracked")
    page.get_by_role("combobox", name="delay of the tracker").select_option("0")
    usual = {"seconds": 0.0, "sync": "tracked", "predict": False, "shift": False}
    window.wait_until(lambda: settings() | usual == settings(), "not all are back")


def test_a_marker_is_the_ball(window: Window, figure_bed: Bed) -> None:
    in_mode(figure_bed, "active")
    window.open_tab("AR")
    before = np.array(figure_bed.view.ball.position)
    window.page.get_by_role("button", name="Marker", exact=True).click()
    window.page.get_by_label("Marker id").wait_for()
    figure_bed.until(lambda view: np.linalg.norm(view.ball.position - before) > 0.1)
    window.page.get_by_role("button", name="Keys, mouse").click()
    window.repeat_until(
        lambda: None, lambda: figure_bed.page.ar.settings()["ball"] == "virtual", "stays"
    )


def test_the_picture_goes_into_the_corner_and_away(window: Window, figure_bed: Bed) -> None:
    page = window.page
    picture = page.get_by_role("img", name="augmented reality")
    window.open_tab("AR")
    page.get_by_role("button", name="Corner", exact=True).click()
    page.wait_for_function("document.querySelector('.rk-ar').getBoundingClientRect().width < 400")
    window.blur()
    page.keyboard.press("x")
    picture.wait_for(state="hidden")
    window.repeat_until(
        lambda: None, lambda: not figure_bed.page.ar.is_on, "the camera is still on"
    )


def test_passive_mode_locks_the_ball_until_it_is_left(window: Window, figure_bed: Bed) -> None:
    in_mode(figure_bed, "active")
    page = window.page
    window.blur()
    bed = figure_bed
    window.press("i", lambda: bed.view.figure.mode == "passive", "I does not change the mode")
    bed.session.send(MoveGoal(BALL))
    bed.until(lambda view: np.allclose(view.ball.position, BALL) and view.figure.waiting)
    page.get_by_text("place the ball, press Space").wait_for()
    window.press("Space", lambda: bed.view.figure.locked, "Space does not start")
    page.get_by_text("the ball is locked", exact=False).first.wait_for()
    page.keyboard.press("w")
    page.get_by_text("the ball is locked while the figure acts").wait_for()
    bed.session.send(SetMotion("random"))
    bed.until(lambda view: view.message)
    view = bed.view
    assert np.array_equal(view.ball.position, BALL) and view.motion == "hand"
    bed.until(lambda view: hand_distance(bed, view) < 0.01, "the hand goes to another ball")
    window.press("i", lambda: bed.view.figure.mode == "active", "I does not leave the mode")
    window.press(
        "w",
        lambda: bed.view.ball.position[2] > BALL[2] + 0.004,
        "the ball is still locked",
    )


def test_reset_returns_figure_and_ball(window: Window, figure_bed: Bed) -> None:
    in_mode(figure_bed, "active")
    bed = figure_bed
    bed.session.send(MoveGoal(BALL))
    bed.until(lambda view: view.figure.action != "stand")
    window.blur()
    start = np.array(bed.session.robot.home)

    def is_back() -> bool:
        return not np.allclose(bed.view.ball.position, BALL)

    window.press("r", is_back, "R does not return the ball")
    bed.session.send(SetRunning(False))
    bed.until(lambda view: not view.running)
    assert np.abs(bed.view.instances[0].q[:3] - start[:3]).max() < 0.05
    bed.session.send(SetRunning(True))


def test_the_overlay_shows_ball_mode_and_decision_and_is_switched(
    window: Window, figure_bed: Bed
) -> None:
    in_mode(figure_bed, "active")
    page = window.page
    figure_bed.session.send(MoveGoal(BALL))
    ball = page.locator(".rk-ball")
    page.wait_for_function("document.querySelector('.rk-ball').innerText.includes('1.250')")
    assert "0.450" in ball.inner_text() and "-0.300" in ball.inner_text()
    page.get_by_text("active · follows the ball").wait_for()
    page.locator(".rk-decision").get_by_text("reach", exact=False).first.wait_for()
    window.blur()
    page.keyboard.press("l")
    ball.wait_for(state="hidden")
    page.keyboard.press("l")
    ball.wait_for()


def test_ccd_and_other_methods_drive_an_arm_of_the_figure(window: Window, figure_bed: Bed) -> None:
    in_mode(figure_bed, "off")
    page = window.page
    window.open_tab("Methods")
    bed = figure_bed
    robot = bed.session.robot
    legs = [
        int(robot.tree.qadr[k])
        for k, name in enumerate(robot.joints)
        if "hip" in name or "knee" in name
    ]
    for name in ("ccd", "fabrik", "triangulation"):
        page.get_by_role("combobox", name="method of robot 1").select_option(name)
        bed.until(lambda view, name=name: view.instances[0].method == name and not view.busy)
        bed.session.send(MoveGoal(BALL))
        view = bed.until(
            lambda view: view.instances[0].met and np.allclose(view.ball.position, BALL),
            f"{name} does not bring the hand to the ball",
        )
        one = view.instances[0]
        assert one.able and "towards the ball" in one.note
        tool = robot.measure(one.q).position
        assert np.linalg.norm(tool - BALL) < 1e-3, "MuJoCo finds the hand elsewhere"
        still = [*range(7), *legs]
        assert np.abs(one.q[still] - robot.home[still]).max() < 1e-12, "root or legs move"
    bed.session.send(SetMethod(0, "lm"))
    bed.until(lambda view: view.instances[0].method == "lm" and not view.busy)


def test_the_learned_prior_is_a_goal_of_the_page(window: Window, figure_bed: Bed) -> None:
    in_mode(figure_bed, "off")
    window.open_tab("Goals")
    figure_bed.until(lambda view: not view.busy)
    switch = window.page.get_by_role("switch", name=NATURAL_POSE)
    switch.click()
    window.blur()
    figure_bed.until(
        lambda view: any(extra.name == NATURAL_POSE and extra.on for extra in view.extras)
    )
    figure_bed.until(lambda view: not view.busy and view.instances[0].able)
    switch.click()
    figure_bed.until(
        lambda view: not any(extra.name == NATURAL_POSE and extra.on for extra in view.extras)
    )


def test_robots_are_drawn_as_wire(window: Window, figure_bed: Bed) -> None:
    window.open_tab("Scene")
    window.page.get_by_role("switch", name="Wire").click()
    there = "on => Boolean(window.__viserMutable.nodeRefFromName['/robot/wire']) === on"
    window.page.wait_for_function(there, arg=True)
    lines = figure_bed.page._scene._wire._lines.points
    one = figure_bed.view.instances[0]
    ends = lines.reshape(-1, 1, 3)
    nearest = np.linalg.norm(ends - one.xpos, axis=2).min(axis=0)
    assert (nearest[1:] < 1e-3).all(), "the lines do not go from joint to joint"
    window.page.get_by_role("switch", name="Wire").click()
    window.page.wait_for_function(there, arg=False)
