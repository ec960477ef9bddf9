"""The programs of theses S12 and A00 on the page, in a real browser.

docs/theory/theses.md names the test of each row.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from robot_ik.testbed.commands import (
    DragLink,
    MoveGoal,
    Release,
    Reset,
    SetBase,
    SetCount,
    SetGoalKind,
    SetMethod,
    SetMotion,
    SetRobot,
    Start,
)
from robot_ik.testbed.view import View
from tests.testbed.browser_window import PIXEL, Window, open_window
from tests.testbed.conftest import Bed, running_bed
from tests.waiting import LONG, wait_for

pytest.importorskip("viser", reason="needs the extra web")
FRAMES = 60
"""Frames of a case: the page takes 1000."""


@pytest.fixture(scope="module")
def bench() -> Iterator[Bed]:
    """A session with its page, whose loop runs on a thread."""
    with running_bed(Start("seven_segment", count=2), 8618) as bed:
        yield bed


@pytest.fixture(scope="module")
def window(chromium: Any, bench: Bed) -> Iterator[Window]:
    opened = open_window(chromium, bench.page.url, scene=True, width=1280, height=800)
    yield opened
    assert opened.errors() == []
    opened.page.close()


def shown(bench: Bed, robot: str, count: int = 1) -> View:
    """Shows a robot as it was loaded, with the ball by hand."""
    loaded = bench.apply(SetRobot(robot), SetCount(count), SetMethod(0, "dls"))  # type: ignore[arg-type]
    assert (loaded.robot, loaded.count, loaded.base) == (robot, count, "")
    view = bench.apply(Reset(), SetMotion("hand"))
    assert view.running and view.motion == "hand" and view.instances[0].method == "dls"
    return view


# S12: the comparison


def test_a_click_on_the_name_of_a_method_unfolds_its_parameters(window: Window, bench: Bed) -> None:
    shown(bench, "seven_segment", 2)
    window.open_tab("Methods")
    name = window.page.get_by_role("button", name="parameters of robot 2")
    slider = window.page.locator(".rk-method").nth(1).get_by_role("slider", name="max iterations")
    assert slider.is_hidden()
    name.click()
    slider.wait_for()
    name.click()
    slider.wait_for(state="hidden")


def test_each_robot_has_its_method_options_attempts_distance_and_limits(
    window: Window, bench: Bed
) -> None:
    shown(bench, "seven_segment", 2)
    window.open_tab("Methods")
    page = window.page
    second = page.locator(".rk-method").nth(1)
    second.get_by_role("combobox", name="method of robot 2").select_option("dls")
    bench.until(lambda view: view.instances[1].method == "dls" and not view.busy)
    second.get_by_role("button", name="parameters of robot 2").click()
    for label, text, holds in (
        ("damping", "10", lambda one: dict(one.options)["damping"] == 10.0),
        ("max step", "0.196", lambda one: dict(one.options)["max_step"] == 0.196),
        ("clamp", "0.1", lambda one: dict(one.options)["clamp"] == 0.1),
        ("max iterations", "7", lambda one: one.budget.iterations == 7),
        ("success distance", "50", lambda one: one.distance == pytest.approx(0.05)),
    ):
        field = second.get_by_role("textbox", name=f"{label} as a number", exact=True)
        field.fill(text)
        field.press("Enter")
        bench.until(lambda view, holds=holds: holds(view.instances[1]), label)
    second.get_by_role("switch", name="alternative").click()
    bench.until(lambda view: dict(view.instances[1].options)["alternative"], "alternative Jacobian")
    second.get_by_role("switch", name="joint limits").click()
    view = bench.until(lambda view: view.instances[1].limited, "limits are not switched")
    assert not view.instances[0].limited and dict(view.instances[0].options)["damping"] == 0.05
    slider = second.get_by_role("slider", name="damping", exact=True)
    page.wait_for_function("slider => slider.value === '1000'", arg=slider.element_handle())
    second.get_by_role("combobox", name="method of robot 2").select_option("transpose")
    bench.until(lambda view: view.instances[1].method == "transpose" and not view.busy)
    field = second.get_by_role("textbox", name="fixed alpha as a number")
    field.fill("0.01")
    field.press("Enter")
    bench.until(lambda view: dict(view.instances[1].options)["fixed_alpha"] == 0.01)
    window.leave_fields()
    page.keyboard.press("o")
    bench.until(lambda view: view.limits, "O does not switch the limits of all")
    second.get_by_role("button", name="parameters of robot 2").click()


def test_keys_show_one_two_or_four_robots(window: Window, bench: Bed) -> None:
    shown(bench, "seven_segment", 1)
    window.leave_fields()
    for key, count in (("2", 2), ("4", 4), ("1", 1)):
        window.press(
            key, lambda count=count: bench.view.busy or bench.view.count == count, f"key {key}"
        )
        bench.until(lambda view, count=count: view.count == count and not view.busy)


def test_the_ball_goes_by_hand_on_a_curve_and_at_random(window: Window, bench: Bed) -> None:
    shown(bench, "seven_segment", 1)
    window.open_tab("Methods")
    page = window.page
    page.get_by_role("button", name="On a curve").click()
    bench.until(lambda view: view.motion == "curve")
    page.get_by_role("button", name="Random", exact=True).click()
    bench.until(lambda view: view.motion == "random")
    for text, seconds in (("0", 0.0), ("3.5", 3.5)):
        field = page.get_by_role("textbox", name="new place after as a number")
        field.fill(text)
        field.press("Enter")
        bench.until(lambda view, seconds=seconds: view.pace == seconds, f"pace {text}")
    field = page.get_by_role("textbox", name="speed as a number")
    field.fill("0.5")
    field.press("Enter")
    bench.until(lambda view: view.speed == 0.5)
    page.get_by_role("button", name="Pause", exact=True).click()
    bench.until(lambda view: not view.running)
    page.get_by_role("button", name="Start", exact=True).click()
    bench.until(lambda view: view.running)
    page.get_by_role("button", name="Reset robot and ball (R)").click()
    bench.until(lambda view: view.motion == "curve", "Reset")
    page.get_by_role("button", name="By hand").click()
    bench.until(lambda view: view.motion == "hand")


def test_statistics_show_time_attempts_solved_and_the_largest_jump(
    window: Window, bench: Bed
) -> None:
    shown(bench, "seven_segment", 1)
    window.open_tab("Methods")
    bench.session.send(SetMotion("curve"))
    view = bench.until(lambda view: view.instances[0].statistics.count > 60)
    card = window.page.locator(".rk-method").first
    cells = {
        label: card.locator(f".rk-stats div:has(small:text-is('{label}')) b")
        for label in ("steps", "time", "jump", "solved")
    }
    wait_for(lambda: cells["jump"].inner_text().endswith("°"))
    jump = float(cells["jump"].inner_text().removesuffix("°"))
    assert 0.0 < jump < 90.0 and cells["time"].inner_text().endswith("µs")
    assert cells["solved"].inner_text().endswith("%") and float(cells["steps"].inner_text()) >= 0
    bench.session.send(SetMotion("hand"))
    bench.until(lambda view: view.motion == "hand" and view.instances[0].met)
    now = bench.view.now
    count = bench.until(lambda view: view.now > now + 2.0).instances[0].statistics.count
    now = bench.view.now
    later = bench.until(lambda view: view.now > now + 2.0).instances[0].statistics.count
    assert later == count, "frames without a request are counted"
    assert view.instances[0].statistics.count <= 1000


def test_a_ball_out_of_reach_leaves_the_arm_calm(window: Window, bench: Bed) -> None:
    shown(bench, "seven_segment", 1)
    bench.session.send(SetGoalKind("position"))
    bench.session.send(MoveGoal((9.0, 9.0, 3.0)))
    bench.until(lambda view: view.instances[0].status == "unreachable", "it is not proven")
    window.open_tab("Methods")
    window.page.locator(".rk-word").first.get_by_text("unreachable").wait_for()
    now = bench.view.now
    q = bench.until(lambda view: view.now > now + 4.0).instances[0].q
    now = bench.view.now
    later = bench.until(lambda view: view.now > now + 1.0).instances[0].q
    assert np.abs(later - q).max() < 1e-3


def test_one_few_or_all_steps_in_a_frame(window: Window, bench: Bed) -> None:
    shown(bench, "seven_segment", 1)
    window.open_tab("Methods")
    bench.session.send(SetMotion("random"))
    window.page.get_by_role("button", name="parameters of robot 1").click()
    field = window.page.get_by_role("textbox", name="max iterations as a number")
    for most in (1, 5, 1000):
        field.fill(str(most))
        field.press("Enter")
        bench.until(lambda view, most=most: view.instances[0].budget.iterations == most)
        view = bench.view
        assert view.restarts or view.instances[0].iterations <= most
    window.page.get_by_role("button", name="parameters of robot 1").click()


def test_a_button_runs_the_four_cases_and_shows_table_4_1(window: Window, bench: Bed) -> None:
    shown(bench, "puma560", 1)
    window.open_tab("Methods")
    page = window.page
    run_cases = page.get_by_role("button", name="Run the four cases")
    page.evaluate(
        """frames => {
            const real = Worker.prototype.postMessage;
            Worker.prototype.postMessage = function (message) {
                if (message.send?.action === "run_cases") message.send.frames = frames;
                return real.call(this, message);
            };
        }""",
        FRAMES,
    )
    run_cases.click()
    table = page.get_by_role("dialog", name="table 4.1 of thesis S12")
    table.wait_for(timeout=1e3 * LONG)  # methods may have to be compiled
    rows = [row.inner_text().split("\t") for row in table.locator("tr").all()]
    assert [row[0].strip() for row in rows[1:]] == ["ccd", "transpose", "pseudoinverse", "dls"]
    cells = [cell.split() for row in rows[1:] for cell in row[1:]]
    assert len(cells) == 16 and all(len(cell) == 10 for cell in cells), cells
    assert cells[0][:5] == ["1.1", "/", "20", "/", "99"], "the thesis's own cell"
    view = bench.view
    assert view.robot == "seven_segment" and view.count == 4 and view.limits
    assert all(one.budget.iterations == 100 and one.distance == 0.05 for one in view.instances)
    assert dict(view.instances[3].options)["max_step"] == pytest.approx(np.pi / 16.0)
    table.get_by_role("button", name="Close").click()
    table.wait_for(state="hidden")
    page.reload()  # the real number of frames again
    page.get_by_role("tab", name="Methods", exact=True).wait_for()


def test_the_lions_paw_follows_the_ball(window: Window, bench: Bed) -> None:
    shown(bench, "lion")
    window.open_tab("Goals")
    page = window.page
    page.get_by_role("combobox", name="effector").select_option("front_right_paw")
    view = bench.until(lambda view: view.tool == "front_right_paw", "the nose stays the effector")
    on = {extra.name: extra.on for extra in view.extras}
    assert not on["keep front_right_paw"] and on["keep front_left_paw"]
    bench.session.send(SetMotion("curve"))
    bench.until(lambda view: view.instances[0].statistics.count > 60)
    assert bench.view.instances[0].statistics.solved > 0.9


# A00: pose


def click_part(window: Window, bench: Bed, body: str) -> None:
    """Clicks a body of the first instance in the 3D view."""
    number = bench.session.robot.model.body(body).id
    place = bench.view.instances[0].xpos[number]
    x, y = window.page.evaluate(PIXEL, [float(value) for value in place])
    window.page.mouse.move(x + 1, y + 1)
    window.page.wait_for_timeout(400)
    window.page.mouse.move(x, y)
    window.page.wait_for_timeout(200)
    window.page.mouse.click(x, y)


def test_base_and_effector_are_chosen_by_clicks_on_parts(window: Window, bench: Bed) -> None:
    shown(bench, "puma560")
    page = window.page
    window.open_tab("Goals")
    page.wait_for_function("() => window.__viserMutable.nodeRefFromName['/robot/ball']")
    pick = page.get_by_role("button", name="Choose the effector by a click on a part")
    before = bench.view.tool

    def choose() -> None:
        if pick.get_attribute("aria-pressed") != "true":
            pick.click()
        page.get_by_text("Click the part that follows the ball.").wait_for()
        click_part(window, bench, "link4")

    window.repeat_until(choose, lambda: bench.view.tool != before, "no part was chosen")
    tool = bench.view.tool
    body = bench.session.robot.frame(tool).body
    assert bench.session.robot.model.body(body).name.startswith("link")
    base = page.get_by_role("combobox", name="base")
    base.select_option("link1")
    bench.until(lambda view: view.base == "link1")
    assert "joint1" not in bench.session.robot.joints
    page.get_by_text(f"those from link1 to {tool}").wait_for()
    base.select_option("")
    bench.until(lambda view: view.base == "")


def test_pins_hold_frames_with_weights_and_priorities(window: Window, bench: Bed) -> None:
    shown(bench, "humanoid")
    page = window.page
    window.open_tab("Goals")
    bench.session.send(SetMethod(0, "lm"))
    bench.until(lambda view: view.instances[0].method == "lm" and not view.busy)
    page.get_by_role("combobox", name="frame to pin").select_option("left_hand")
    view = bench.until(lambda view: view.pins, "nothing is pinned")
    robot = bench.session.robot
    place = robot.measure(view.instances[0].q, "left_hand").position
    assert np.linalg.norm(place - view.pins[0].position) < 0.02
    weight = page.get_by_role("textbox", name="weight of pin left_hand")
    weight.fill("2.5")
    weight.press("Enter")
    bench.until(lambda view: view.pins[0].weight == 2.5)
    page.get_by_role("combobox", name="priority of pin left_hand").select_option("3")
    bench.until(lambda view: view.pins[0].priority == 3)
    page.get_by_role("checkbox", name="left_hand may turn").click()
    bench.until(lambda view: view.pins[0].wxyz is not None)
    page.get_by_role("button", name="remove the pin of left_hand").click()
    bench.until(lambda view: not view.pins)


def test_weights_and_priorities_of_goals(window: Window, bench: Bed) -> None:
    shown(bench, "humanoid")
    page = window.page
    window.open_tab("Goals")
    weight = page.get_by_role("textbox", name="weight of posture")
    weight.fill("0.2")
    weight.press("Enter")
    page.get_by_role("combobox", name="priority of gaze").select_option("5")
    page.get_by_role("switch", name="hold left_hand").click()

    def is_so(view: View) -> bool:
        extras = {extra.name: extra for extra in view.extras}
        return (
            extras["posture"].weight == 0.2
            and extras["gaze"].priority == 5
            and extras["hold left_hand"].on
        )

    bench.until(is_so, "weight, priority or switch")


@pytest.mark.parametrize(
    "kind", ["pose", "position", "orientation", "aim", "line", "plane", "half_space"]
)
def test_every_kind_of_goal_is_on_the_page(kind: str, window: Window, bench: Bed) -> None:
    if bench.view.robot != "puma560" or bench.view.base:
        shown(bench, "puma560")
    window.open_tab("Goals")
    window.page.get_by_role("combobox", name="what the ball asks").select_option(kind)
    bench.until(lambda view: view.kind == kind and not view.busy, kind)
    bench.until(lambda view: view.instances[0].met, "the method does not support it")


def test_stiffness_is_set_by_a_slider(window: Window, bench: Bed) -> None:
    shown(bench, "puma560")
    page = window.page
    window.open_tab("Joints")
    page.get_by_text("Stiffness of the joints").click()
    slider = page.get_by_role("slider", name="joint2", exact=True).last
    slider.focus()
    slider.press("End")
    bench.until(lambda view: dict(view.stiffness).get("joint2") == 100.0, "stiffness")
    assert bench.session.robot.stiffness[1] == 100.0


def test_a_chain_is_opened_from_the_gallery(window: Window, bench: Bed) -> None:
    shown(bench, "puma560")
    page = window.page
    page.get_by_role("button", name="robot", exact=True).click()
    page.get_by_role("spinbutton", name="links of a chain").fill("4")
    page.get_by_role("button", name="Show the chain").click()
    bench.until(lambda view: view.robot == "chain:4", "no chain")
    page.get_by_role("button", name="robot", exact=True).get_by_text("chain4").wait_for()


def test_courses_run_and_say_where_the_goal_was_lost(window: Window, bench: Bed) -> None:
    shown(bench, "puma560")
    page = window.page
    window.open_tab("Methods")
    for number, joints in ((1, 3), (6, 5), (13, 2)):
        page.get_by_role("button", name=f"course {number}", exact=True).click()
        view = bench.until(lambda view, number=number: view.course and view.course.number == number)
        assert view.robot == f"chain:{joints}" and view.motion == "course"
        page.get_by_text(f"Test {number}: ").wait_for()
    bench.until(lambda view: view.course and view.course.frame > 20)
    page.get_by_text("Thesis: unsolved: J is square and singular").wait_for()
    assert page.locator(".rk-courses button").count() == 13


def test_a_dragged_part_shows_the_pull(window: Window, bench: Bed) -> None:
    shown(bench, "puma560")
    session = bench.session
    session.send(DragLink(0, "link4", (0.0, 0.0, 0.0), (0.6, 0.6, 0.9)))
    view = bench.until(lambda view: view.pull is not None, "no drag")
    assert view.dragged == "link4" and view.pull is not None and view.pull.shape == (2, 3)
    window.page.wait_for_function(
        "() => window.__viserMutable.nodeRefFromName['/robot/pull']?.visible"
    )
    session.send(Release())
    bench.until(lambda view: view.pull is None)


def test_shell_regions_and_test_cube_are_drawn(window: Window, bench: Bed) -> None:
    shown(bench, "humanoid")
    page = window.page
    window.open_tab("Scene")
    shell = "name => window.__viserMutable.nodeRefFromName[name]"
    pictures = page.get_by_role("group", name="reach")
    pictures.get_by_role("button", name="Space", exact=True).click()
    page.wait_for_function(shell, arg="/regions/reach/shell", timeout=1e3 * LONG)
    pictures.get_by_role("button", name="None", exact=True).click()
    for name, nodes in (
        ("Regions of the figure", tuple(f"/regions/figure/{k}" for k in ("reach", "bend", "jump"))),
        ("Test cube", ("/cube/edges", "/cube/axes", "/cube/marks")),
    ):
        switch = page.get_by_role("switch", name=name, exact=True)
        switch.click()
        for node in nodes:
            page.wait_for_function(shell, arg=node, timeout=1e3 * LONG)
        switch.click()
        for node in nodes:
            page.wait_for_function("name => !window.__viserMutable.nodeRefFromName[name]", arg=node)


def test_a_base_is_kept_when_a_page_is_loaded_again(window: Window, bench: Bed) -> None:
    shown(bench, "puma560")
    bench.session.send(SetBase("link2"))
    bench.until(lambda view: view.base == "link2")
    window.page.reload()
    window.open_tab("Goals")
    base = window.page.get_by_role("combobox", name="base")
    window.page.wait_for_function("menu => menu.value === 'link2'", arg=base.element_handle())
