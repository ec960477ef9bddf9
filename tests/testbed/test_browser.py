"""The page in a real browser: what is drawn, what is dragged, what the session gets of it."""

from __future__ import annotations

import itertools
import re
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.testbed.camera_picture import CameraPicture
from robot_ik.testbed.commands import (
    DragLink,
    MoveGoal,
    MoveObstacle,
    Nudge,
    Release,
    RemoveObstacle,
    Reset,
    SetCount,
    SetMethod,
    SetMotion,
    SetOption,
    SetRobot,
    SetRunning,
    Start,
)
from robot_ik.testbed.filming import arm_link
from robot_ik.testbed.session import Session
from tests.testbed.browser_window import Window, open_window
from tests.testbed.conftest import Bed, looped, plain_server, running_bed
from tests.waiting import LONG

pytest.importorskip("viser", reason="needs the extra web")
from robot_ik.testbed.frontends.browser import Page

BALL = (-0.45, -0.3, 0.9)
# The orientation of the hand at home, so that `dls` converges from every earlier pose.
TURNED = (0.258819, 0.0, -0.965926, 0.0)
"""Where the ball rests: while nothing moves, a browser without a GPU has nothing to do."""
# Whether the gizmo is drawn at a place; batched meshes follow it a frame later.
AT = """async place => {
    const node = window.__viserMutable.nodeRefFromName["/goal"];
    const seen = node.getWorldPosition(node.position.clone());
    const world = window.__viserMutable.nodeRefFromName["/robot"];
    const wanted = world.localToWorld(node.position.clone().set(...place));
    if (seen.distanceTo(wanted) > 1e-3) return false;
    for (let k = 0; k < 3; k++) await new Promise(requestAnimationFrame);
    return true;
}"""


@pytest.fixture(scope="module")
def window(chromium: Any, bed: Bed) -> Iterator[Window]:
    """The driving browser of all tests. The last test checks its console."""
    bed.until(lambda view: view.tick > 0, "kernels were never ready")
    window = open_window(chromium, bed.page.url, scene=True)
    yield window
    window.page.close()


@pytest.fixture(autouse=True)
def arm_at_rest(bed: Bed) -> None:
    """One arm that has reached a ball at rest."""
    if bed.view.robot != "puma560":
        bed.session.send(SetRobot("puma560"))
    bed.apply(SetCount(1), SetMethod(0, "dls"))
    bed.apply(Reset(), MoveGoal(BALL, TURNED))
    bed.until(lambda view: view.instances[0].status == "converged", "the ball is not met")
    bed.sent.clear()


def test_all_requests_go_to_the_program(window: Window, bed: Bed) -> None:
    asked = [url for url in window.requests if not url.startswith(("blob:", "data:"))]
    assert len(asked) > 10 and all(url.startswith(bed.page.url) for url in asked)


def test_the_card_shows_state_and_statistics_of_the_method(window: Window) -> None:
    window.open_tab("Methods")
    card = window.page.locator(".rk-method").first
    card.get_by_text("ball met", exact=True).wait_for()
    card.get_by_text(re.compile(r"^0\.\d\d")).first.wait_for()
    for label in ("steps", "time", "jump", "solved"):
        assert card.get_by_text(label, exact=True).locator("xpath=..").get_attribute("title")


def test_a_slider_changes_the_solvers_option(window: Window, bed: Bed) -> None:
    window.open_tab("Methods")
    window.page.get_by_role("button", name="parameters of robot 1").click()
    slider = window.page.get_by_role("slider", name="damping", exact=True).first
    before = dict(bed.view.instances[0].options)
    window.press(
        "ArrowRight", lambda: bed.count(SetOption) > 0, "the slider sends nothing", on=slider
    )
    name = next(command for command in bed.sent if isinstance(command, SetOption)).name
    assert name == "damping"
    bed.until(lambda view: dict(view.instances[0].options)[name] != before[name])
    window.page.get_by_role("button", name="parameters of robot 1").click()


def test_a_menu_changes_the_method(window: Window, bed: Bed) -> None:
    window.open_tab("Methods")
    menu = window.page.get_by_role("combobox", name="method of robot 1")
    window.page.wait_for_function("menu => menu.value === 'dls'", arg=menu.element_handle())
    menu.select_option("ccd")
    bed.until(lambda view: view.instances[0].method == "ccd", "the method stayed")


def test_keys_work(window: Window, bed: Bed) -> None:
    window.leave_fields()
    for key, command, holds in (
        ("i", SetMotion, lambda view: view.motion == "curve"),
        ("w", Nudge, lambda view: view.motion == "hand"),
        ("Space", SetRunning, lambda view: not view.running),
        ("r", Reset, lambda view: view.running and view.motion == "curve"),
        ("Escape", SetRunning, lambda view: not view.running),
        ("Space", SetRunning, lambda view: view.running),
    ):
        bed.sent.clear()
        window.press(key, lambda command=command: bed.count(command) > 0, f"{key} sends nothing")
        bed.until(holds, f"{key} does something else")


CAMERA_PLACE = "() => window.__viserMutable.camera.position.toArray()"


def test_keys_move_the_ball_and_not_the_camera_until_c_is_pressed(window: Window, bed: Bed) -> None:
    window.leave_fields()
    before = window.page.evaluate(CAMERA_PLACE)
    window.press(
        "w", lambda: bed.view.ball.position[2] > BALL[2] + 0.005, "W does not lift the ball"
    )
    ball = bed.view.ball.position
    window.press(
        "ArrowUp", lambda: np.linalg.norm(bed.view.ball.position - ball) > 0.005, "no step away"
    )
    step = bed.view.ball.position - ball
    assert abs(step[2]) < 1e-9 and min(abs(step[0]), abs(step[1])) < 1e-9, "not along an axis"
    assert window.page.evaluate(CAMERA_PLACE) == before
    window.page.keyboard.press("c")
    window.page.locator(".rk-hint").get_by_text("keys move the ball").wait_for()
    bed.sent.clear()
    window.page.keyboard.down("w")
    window.page.wait_for_function(
        "before => window.__viserMutable.camera.position.toArray().some("
        "(value, k) => Math.abs(value - before[k]) > 0.01)",
        arg=before,
    )
    window.page.keyboard.up("w")
    assert bed.sent == []
    window.page.keyboard.press("c")
    window.page.locator(".rk-hint").get_by_text("keys move the camera").wait_for()
    window.open_tab("Scene")
    window.page.get_by_role("button", name="Fit the camera").click()
    window.page.wait_for_function(
        "before => window.__viserMutable.camera.position.toArray().every("
        "(value, k) => Math.abs(value - before[k]) < 0.05)",
        arg=before,
    )


def test_dragging_the_ball_moves_ball_and_arm(window: Window, bed: Bed) -> None:
    window.page.wait_for_function(AT, arg=list(BALL))
    before = bed.view
    window.drag(
        lambda: bed.view.ball.position + np.array((0.0, -0.03, -0.02)),
        (50.0, -40.0),
        lambda: bed.count(MoveGoal) > 0,
        "no drag of the ball came",
    )
    moved = bed.until(lambda view: np.linalg.norm(view.ball.position - before.ball.position) > 0.03)
    assert moved.motion == "hand"
    bed.until(lambda view: np.abs(view.instances[0].q - before.instances[0].q).max() > 0.02)


def test_dragging_a_link_takes_the_arm_along(window: Window, bed: Bed) -> None:
    window.page.wait_for_function(AT, arg=list(BALL))
    before = bed.view
    body = bed.session.robot.model.body("link4").id
    window.drag(
        lambda: bed.view.instances[0].xpos[body],
        (-60.0, 30.0),
        lambda: bed.count(DragLink) > 0 and bed.count(Release) > 0,
        "no drag of a part came",
    )
    bed.until(lambda view: np.abs(view.instances[0].q - before.instances[0].q).max() > 0.02)


def test_a_joint_bar_turns_its_joint_and_the_ball_follows(window: Window, bed: Bed) -> None:
    window.open_tab("Joints")
    bar = window.page.get_by_role("slider", name="joint2", exact=True)
    box = bar.bounding_box()
    before = bed.view
    mouse = window.page.mouse
    mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 0.5 * box["height"])
    mouse.down()
    mouse.move(box["x"] + 0.4 * box["width"], box["y"] + 0.5 * box["height"], steps=4)
    mouse.up()
    lower, upper = bed.session.robot.model.joint("joint2").range
    wanted = lower + 0.4 * (upper - lower)
    view = bed.until(lambda view: abs(view.instances[0].q[1] - wanted) < 0.02, "the joint stays")
    assert view.motion == "joints"
    assert np.allclose(view.instances[0].q[[0, 2, 3, 4, 5]], before.instances[0].q[[0, 2, 3, 4, 5]])
    tool = bed.session.robot.measure(view.instances[0].q)
    assert np.allclose(tool.position, view.ball.position, atol=1e-9)
    value = window.page.get_by_role("textbox", name="value of joint2")
    value.fill("-30")
    value.press("Enter")
    bed.until(lambda view: abs(view.instances[0].q[1] + np.radians(30.0)) < 1e-6, "not typed")


def test_key_poses_are_recorded_scrubbed_and_played(window: Window, bed: Bed) -> None:
    page = window.page
    page.get_by_role("button", name="Record pose").click()
    bed.until(lambda view: len(view.timeline.times) == 1)
    first = bed.view.instances[0].q
    window.open_tab("Joints")
    value = page.get_by_role("textbox", name="value of joint1")
    value.fill("40")
    value.press("Enter")
    bed.until(lambda view: abs(view.instances[0].q[0] - np.radians(40.0)) < 1e-6)
    page.get_by_role("button", name="Record pose").click()
    bed.until(lambda view: view.timeline.times == (0.0, 1.0))
    page.locator(".rk-line .key").nth(1).wait_for()
    line = page.get_by_role("slider", name="time", exact=True)
    box = line.bounding_box()
    page.mouse.click(box["x"] + box["width"] / 8.0, box["y"] + 6)  # of four seconds: 0.5 s
    view = bed.until(
        lambda view: view.motion == "timeline", "the robot does not follow the timeline"
    )
    assert 0.4 < view.timeline.now < 0.6
    middle = bed.until(lambda view: view.instances[0].status == "timeline").instances[0].q[0]
    assert first[0] < middle < np.radians(40.0) or first[0] > middle > np.radians(40.0)
    play = page.get_by_role("button", name="Play without inverse kinematics")
    play.click()
    bed.until(
        lambda view: view.timeline.now == 1.0 and not view.timeline.playing, "it does not play"
    )
    assert bed.view.instances[0].q[0] == pytest.approx(np.radians(40.0), abs=1e-9)
    window.open_tab("Record")
    for _ in range(2):
        page.get_by_role("button", name="remove pose").first.click()
        page.wait_for_timeout(200)
    bed.until(lambda view: view.timeline.times == ())


def test_an_obstacle_is_added_measured_and_removed(window: Window, bed: Bed) -> None:
    window.open_tab("Scene")
    window.page.get_by_role("button", name="Cylinder").click()
    window.page.get_by_role("cell", name="cylinder 1", exact=True).wait_for()
    distance = window.page.get_by_role("cell", name=re.compile("cm to|touches"))
    distance.wait_for(timeout=1e3 * LONG)
    assert np.isfinite(bed.view.obstacles[0].distance)
    height = window.page.get_by_role("textbox", name="height of cylinder 1")
    height.fill("62.5")
    height.press("Enter")
    bed.until(lambda view: view.obstacles[0].placed.size[2] == 0.625, "the height stays")
    window.page.get_by_role("button", name="remove cylinder 1").click()
    bed.until(lambda view: view.obstacles == ())


CUBE = "".join(
    f"v {x} {y} {z}\n" for x in (0.0, 0.3) for y in (0.0, 0.3) for z in (0.0, 0.3)
) + "".join(f"f {a} {b} {c}\n" for a, b, c in itertools.combinations(range(1, 9), 3))
"""A mesh file."""

# Names of the red covers that the 3D view shows.
COVERS = """() => Object.entries(window.__viserMutable.nodeRefFromName)
    .filter(([name, node]) => name.startsWith("/robot/contact_") && node.visible)
    .map(([name]) => name)"""


def test_a_mesh_that_the_arm_touches_turns_the_parts_red_with_the_depth(
    window: Window, bed: Bed
) -> None:
    page = window.page
    window.open_tab("Scene")
    file = {"name": "cube.obj", "mimeType": "text/plain", "buffer": CUBE.encode()}
    page.get_by_label("mesh file").set_input_files(file)
    page.get_by_role("cell", name=re.compile("^cube ")).wait_for(timeout=1e3 * LONG)
    bed.session.send(MoveObstacle(0, BALL))
    view = bed.until(lambda view: view.contacts, "the hand does not touch the mesh at the ball")
    contact = view.contacts[0]
    line = f"{' touches '.join(contact.parts)}: {1e3 * contact.depth:.1f} mm deep"
    page.get_by_role("listitem").filter(has_text=line).wait_for()
    page.locator(".rk-contact", has_text=f"{1e3 * contact.depth:.1f} mm").wait_for()
    names = {f"/robot/contact_{body}_0" for one in view.contacts for body in one.bodies}
    page.wait_for_function(
        f"wanted => wanted.every((name) => ({COVERS})().includes(name))", arg=sorted(names)
    )
    bed.session.send(MoveObstacle(0, (3.0, 3.0, 3.0)))
    page.locator(".rk-contact").first.wait_for(state="hidden")
    page.wait_for_function(f"() => ({COVERS})().length === 0")
    bed.session.send(RemoveObstacle(0))
    bed.until(lambda view: view.obstacles == ())


def test_a_motion_is_planned_shown_scrubbed_and_played(window: Window, bed: Bed) -> None:
    page = window.page
    window.open_tab("Scene")
    page.get_by_role("button", name="Plan to the ball").click()
    page.get_by_text("proven to keep 3 mm").wait_for(timeout=1e3 * LONG)
    view = bed.until(lambda view: view.plan.state == "found")
    page.wait_for_function("() => window.__viserMutable.nodeRefFromName['/robot/plan_path']")
    slider = page.get_by_role("slider", name="time of the planned motion")
    for key, now in (("End", view.plan.duration), ("Home", 0.0)):
        window.press(
            key,
            lambda now=now: bed.view.motion == "plan" and abs(bed.view.plan.now - now) < 2e-3,
            "the slider does not show its end",
            on=slider,
        )
    page.locator(".rk-mode").get_by_text("at the goal of the plan").wait_for()
    page.locator(".rk-state").get_by_text("on the planned motion").wait_for()
    home = bed.session.robot.home
    bed.until(lambda view: np.allclose(view.instances[0].q, home, atol=1e-9))
    page.get_by_role("button", name="Play the planned motion").click()
    duration = view.plan.duration
    bed.until(lambda view: view.plan.now == duration and not view.plan.playing, "it does not play")
    assert bed.view.instances[0].error < 1e-3
    page.get_by_role("button", name="remove the planned motion").click()
    bed.until(lambda view: view.plan.state == "none")
    page.wait_for_function("() => !window.__viserMutable.nodeRefFromName['/robot/plan_path']")


def test_the_reach_is_a_cloud_or_a_shell_with_its_scale(window: Window, bed: Bed) -> None:
    page = window.page
    window.open_tab("Scene")
    node = "window.__viserMutable.nodeRefFromName['/robot/reach_map']"
    for name in ("Cloud", "Shell"):
        page.get_by_role("button", name=name, exact=True).click()
        page.get_by_text(re.compile("% of directions")).wait_for(timeout=1e3 * LONG)
        page.wait_for_function(f"() => {node}")
    page.get_by_text("proven out of reach").wait_for()
    page.get_by_role("button", name="None", exact=True).click()
    page.wait_for_function(f"() => !{node}")


def test_a_file_is_saved_by_the_browser(window: Window) -> None:
    window.open_tab("Record")
    with window.page.expect_download() as download:
        window.page.get_by_role("button", name="Save the command log").click()
    assert download.value.suggested_filename == "testbed.jsonl"
    text = download.value.path().read_text()
    assert text.startswith('{"testbed_log": 1')


def test_compare_four_shows_four_cards_and_labels(window: Window, bed: Bed) -> None:
    window.open_tab("Methods")
    window.leave_fields()
    window.press("4", lambda: bed.view.busy or bed.view.count == 4, "there are not four")
    bed.until(lambda view: view.count == 4 and not view.busy, "there are not four")
    for k, name in enumerate(("dls", "lm", "pseudoinverse", "ccd")):
        menu = window.page.get_by_role("combobox", name=f"method of robot {k + 1}")
        menu.wait_for()
        window.page.wait_for_function(
            "([menu, name]) => menu.value === name", arg=[menu.element_handle(), name]
        )
        window.page.locator(".rk-label", has_text=name).wait_for()


def test_the_page_shows_decision_and_reason_of_the_figure(window: Window, bed: Bed) -> None:
    page = window.page
    bed.session.send(SetRobot("humanoid"))
    bed.session.send(SetRunning(False))  # a figure that moves keeps a browser without a GPU busy
    bed.until(lambda view: view.robot == "humanoid" and not view.busy and not view.running)
    page.get_by_role("button", name="Passive", exact=True).click()
    bed.until(lambda view: view.figure and view.figure.mode == "passive", "no figure decides")
    bed.session.send(MoveGoal((0.5, -0.3, 1.3)))
    page.get_by_text("Place the ball, then press Act or Space.").wait_for()
    window.leave_fields()
    window.press("w", lambda: bed.count(Nudge) > 0, "the key does not arrive")
    bed.until(lambda view: view.ball.position[2] > 1.3, "the ball stays")
    bed.session.send(SetRunning(True))
    page.get_by_role("button", name="Act", exact=True).click()
    seen = bed.until(lambda view: view.figure and not view.figure.waiting, "it does not act")
    assert seen.figure is not None and seen.figure.decision.action in (
        "reach",
        "bend",
        "walk",
        "nothing",
    )
    page.get_by_text(seen.figure.decision.reason).first.wait_for()
    ball = bed.view.ball.position
    page.keyboard.press("w")
    page.get_by_text("the ball is locked while the figure acts").wait_for()
    assert np.array_equal(bed.view.ball.position, ball)
    page.keyboard.press("r")
    bed.until(lambda view: view.figure and view.figure.waiting, "R does not reset the figure")
    page.keyboard.press("i")
    bed.until(
        lambda view: view.figure and view.figure.mode == "active", "I does not change the mode"
    )
    bed.session.send(SetRunning(False))
    page.get_by_role("button", name="Methods", exact=True).click()
    bed.until(lambda view: view.figure is None and not view.busy)


CONTROLS = """async () => {
    // Uses every control of the page once, and returns those without a message or a change.
    const sent = [];
    const real = Worker.prototype.postMessage;
    Worker.prototype.postMessage = (message) => { if (message.send) sent.push(message.send); };
    const silent = [];
    const frame = () => new Promise((done) => setTimeout(done, 30));
    const use = async (control) => {
        const name = control.getAttribute("aria-label") || control.textContent || control.title;
        const before = sent.length;
        const shown = document.body.outerHTML.length;
        if (control.matches("input[type=checkbox]")) control.click();
        else if (control.matches("select")) {
            control.selectedIndex = (control.selectedIndex + 1) % control.options.length;
            control.dispatchEvent(new Event("change"));
        } else if (control.matches("input[type=range]")) {
            control.value = Number(control.value) > 500 ? 100 : 900;
            control.dispatchEvent(new Event("input"));
        } else if (control.matches("input")) {
            control.value = "1";
            control.dispatchEvent(new Event("change"));
        } else control.click();
        await frame();
        if (sent.length === before && document.body.outerHTML.length === shown) {
            silent.push(name);
        }
    };
    let count = 0;
    try {
        for (const tab of document.querySelectorAll("[role=tab]")) {
            tab.click();
            await frame();
            const folds = document.querySelectorAll(".rk-name, .rk-rare summary");
            for (const fold of folds) fold.click();
            await frame();
            const found = document.querySelectorAll(
                ".rk-body button:not(.rk-name), .rk-body input, .rk-body select");
            for (const control of found) {
                const isThere = control.isConnected && control.checkVisibility();
                const opens = control.title.startsWith("Load"); // the browser's dialog for files
                if (!isThere || control.disabled || opens) continue;
                count += 1;
                await use(control);
            }
        }
        const bars = document.querySelectorAll(".rk-top button, .rk-time button, .rk-fold");
        for (const control of bars) {
            const opens = control.title.startsWith("Load");
            if (!control.checkVisibility() || control.disabled || opens) continue;
            count += 1;
            await use(control);
            for (const shade of document.querySelectorAll(".rk-shade.shown")) shade.click();
        }
    } finally {
        Worker.prototype.postMessage = real;
    }
    return [count, silent];
}"""


def test_every_control_has_an_effect(chromium: Any, bed: Bed) -> None:
    window = open_window(chromium, bed.page.url, scene=False, width=1280, height=800)
    count, silent = window.page.evaluate(CONTROLS)
    assert count > 60 and silent == []
    assert window.errors() == []
    window.page.close()


def test_a_second_browser_watches_and_its_stop_works(
    chromium: Any, window: Window, bed: Bed
) -> None:
    window.leave_fields()
    window.press("i", lambda: bed.page.gate.driver.page is not None, "the first does not drive")
    bed.session.send(MoveGoal(BALL, TURNED))
    bed.until(lambda view: view.motion == "hand")
    bed.sent.clear()
    watcher = open_window(chromium, bed.page.url, scene=False, width=420, height=760)
    page = watcher.page
    page.get_by_text("You watch.").wait_for()
    notice = page.get_by_text("To drive from here, press Hand over there")
    watcher.press("w", lambda: notice.count() > 0, "a watcher is not told")
    assert bed.sent == []
    page.get_by_role("button", name="STOP").click()
    bed.until(lambda view: not view.running, "a watcher's STOP does nothing")
    assert window.page.get_by_text("You watch.").is_hidden()
    page.close()
    assert watcher.errors() == []


def test_the_console_has_no_errors_after_these_tests(window: Window) -> None:
    assert window.errors() == []


def test_the_page_opens_with_its_token(chromium: Any, guarded: Any) -> None:
    window = open_window(chromium, guarded.url, scene=False, width=420, height=400)
    assert window.page.url == guarded.url.split("?")[0]
    window.page.close()


@pytest.fixture
def arm_bed(real_time: None) -> Iterator[Bed]:
    """A session with simulated servos, its page, and its loop on a thread."""
    link = arm_link("tabletop_puma", None, "sim")
    with running_bed(Start("tabletop_puma"), 8612, link) as bed:
        yield bed


@pytest.fixture(scope="module")
def plain_bed() -> Iterator[Bed]:
    """Another session without servos, its page, and its loop on a thread."""
    with running_bed(Start("tabletop_puma"), 8614) as bed:
        yield bed


WIDTHS = (390, 1000, 1280, 1920)


def test_stop_has_one_place_at_every_width_and_above_every_dialog(
    chromium: Any, plain_bed: Bed
) -> None:
    window = open_window(
        chromium, plain_bed.page.url, scene=False, width=1280, height=800, first_visit=True
    )
    page = window.page
    stop = page.get_by_role("button", name="STOP")
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": 800})
        box = stop.bounding_box()
        assert 6 <= box["y"] <= 7.5 and box["width"] > 90 and box["height"] >= 38
        assert width - 12 <= box["x"] + box["width"] <= width, width
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.set_viewport_size({"width": 1280, "height": 800})
    page.get_by_role("dialog", name="first steps").wait_for()  # of a first visit
    plain_bed.session.send(SetRunning(True))
    before = stop.bounding_box()
    stop.click()
    plain_bed.until(lambda view: not view.running, "STOP does not work over a dialog")
    page.get_by_role("button", name="Start", exact=True).last.click()
    page.get_by_role("dialog", name="first steps").wait_for(state="hidden")
    plain_bed.session.report("a message of many lines " * 20)
    page.get_by_text("a message of many lines").wait_for()
    for name in ("Joints", "Goals", "Arm", "Scene", "Record"):
        window.open_tab(name)
        assert stop.bounding_box() == before
    page.reload()
    page.get_by_role("tab", name="Methods", exact=True).wait_for()
    assert page.get_by_role("dialog", name="first steps").is_hidden(), "shown a second time"
    window.page.close()


def test_robots_get_most_of_the_width_and_panels_give_way(chromium: Any, plain_bed: Bed) -> None:
    window = open_window(chromium, plain_bed.page.url, scene=True, width=1280, height=800)
    page = window.page
    canvas = page.locator("canvas[data-engine]")
    for width in WIDTHS[1:]:
        page.set_viewport_size({"width": width, "height": 800})
        page.wait_for_function(
            "least => document.querySelector('canvas[data-engine]')"
            ".getBoundingClientRect().width >= least",
            arg=0.65 * width,
        )
    page.set_viewport_size({"width": 1280, "height": 800})
    page.keyboard.press("\\")
    page.wait_for_function(
        "document.querySelector('canvas[data-engine]').getBoundingClientRect().width === 1280"
    )
    page.keyboard.press("\\")
    page.set_viewport_size({"width": 390, "height": 844})
    page.wait_for_function(
        "document.querySelector('canvas[data-engine]').getBoundingClientRect().width === 390"
    )
    box = canvas.bounding_box()
    for name in ("Methods", "Joints", "Arm", "Record"):
        tab = page.get_by_role("tab", name=name, exact=True).bounding_box()
        assert tab["y"] >= box["y"] + box["height"] - 1 and tab["y"] + tab["height"] < 844
        assert tab["x"] >= 0 and tab["x"] + tab["width"] <= 390
    window.page.close()


def test_a_robot_is_chosen_in_the_gallery(chromium: Any, plain_bed: Bed) -> None:
    window = open_window(chromium, plain_bed.page.url, scene=False)
    page = window.page
    page.get_by_role("button", name="robot", exact=True).click()
    gallery = page.get_by_role("dialog", name="robots")
    gallery.wait_for()
    cards = gallery.locator("[data-robot]")
    assert [card.get_attribute("data-robot") for card in cards.all()] == list(rik.catalogue())
    assert (
        cards.and_(page.locator("[aria-current=true]")).get_attribute("data-robot")
        == "tabletop_puma"
    )
    for card in cards.all():
        card.scroll_into_view_if_needed()
        drawn = "card => card.querySelector('img').naturalWidth > 100"
        page.wait_for_function(drawn, arg=card.element_handle())
    gallery.get_by_label("path of a model").fill("no/such/robot.urdf")
    gallery.get_by_role("button", name="Load").click()
    page.get_by_text("there is no file no/such/robot.urdf").wait_for()
    page.keyboard.press("g")
    gallery.locator("[data-robot=srs_arm]").click()
    plain_bed.until(lambda view: view.robot == "srs_arm", "the robot stayed")
    page.get_by_role("button", name="robot", exact=True).get_by_text("srs arm").wait_for()
    assert window.errors() == []
    window.page.close()


def test_pictures_of_the_camera_follow_each_other(chromium: Any, plain_bed: Bed) -> None:
    grey = CameraPicture(np.full((9, 16, 3), 128, np.uint8), ((7, 0.5, 0.25),), "a picture")
    with Page(plain_bed.session, plain_server(8615), camera=lambda: lambda: grey) as page:
        window = open_window(chromium, page.url, scene=False)
        image = window.page.get_by_role("img", name="picture of the camera")
        assert image.is_hidden()
        window.page.get_by_role("button", name="Camera", exact=True).click()
        window.page.get_by_role("cell", name="0.500").wait_for()
        window.page.wait_for_function(
            "image => image.naturalWidth === 16", arg=image.element_handle()
        )
        first = image.get_attribute("src")
        window.page.wait_for_function(
            "([image, first]) => image.src !== first", arg=[image.element_handle(), first]
        )
        window.page.keyboard.press("v")
        image.wait_for(state="hidden")
        assert window.errors() == []
        window.page.close()


def test_hold_after_torque_off_says_that_the_arm_is_limp(chromium: Any, arm_bed: Bed) -> None:
    window = open_window(chromium, arm_bed.page.url, scene=False)
    window.open_tab("Arm")
    for button, holds in (
        ("Follow", lambda view: view.arm.state == "enabled"),
        ("Torque off", lambda view: view.arm.mode == "release" and view.arm.limp),
        ("Hold", lambda view: view.arm.mode == "hold"),
    ):
        window.page.get_by_role("button", name=button, exact=True).click()
        arm_bed.until(holds, f"{button} does nothing")
    window.page.get_by_text("The arm is limp").wait_for()
    assert window.page.get_by_text("asked: hold").count() == 0
    window.page.close()


def test_a_page_without_its_program_says_that_stop_does_not_work(
    chromium: Any, real_time: None
) -> None:
    with (
        Session(Start("tabletop_puma"), arm=arm_link("tabletop_puma", None, "sim")) as session,
        Page(session, plain_server(8612)) as page,
        looped(session, page),
    ):
        window = open_window(chromium, page.url, scene=False)
        veil = window.page.locator("#connection-lost")
        window.page.get_by_text("ball met", exact=True).wait_for()  # views arrive
        window.page.wait_for_timeout(1500)  # and a beat, which comes once a second
        veil.wait_for(state="hidden")
    veil.wait_for()
    assert "STOP does not work" in veil.inner_text() and "robot-ik stop" in veil.inner_text()
    assert veil.bounding_box() == {"x": 0, "y": 0, **window.page.viewport_size}
    window.page.close()


def test_a_loop_that_hangs_is_a_lost_connection(chromium: Any, arm_bed: Bed) -> None:
    window = open_window(chromium, arm_bed.page.url, scene=False)
    veil = window.page.locator("#connection-lost")
    hangs = threading.Event()
    go_on = threading.Event()

    def hang(*_: object) -> None:
        hangs.set()
        go_on.wait()

    arm_bed.page._draw_scene = hang  # type: ignore[method-assign]
    try:
        hangs.wait()
        veil.wait_for()
    finally:
        go_on.set()
    veil.wait_for(state="hidden")
    window.page.close()
