"""``[collisions]`` of an arm file: the servo commands refuse what would touch, and send nothing."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.hardware.arm import Arm
from robot_ik.motion import Trajectory

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")

JOINTS = ("joint1", "joint2", "joint3")

BALL = """<mujoco><worldbody>
<geom name="ball" size="0.02" pos="{x} 0 {z}"/>
</worldbody></mujoco>"""


def at_bend(degrees: float) -> str:
    """Return a scene with a ball where the last body of the desk arm is at this joint2."""
    angle = np.radians(degrees)
    return BALL.format(x=0.1 * np.sin(angle), z=0.1 + 0.1 * np.cos(angle))


@pytest.fixture
def guarded(desk: Any) -> Any:
    """The desk arm with a ball in the way of joint2, at 40 degrees."""
    (desk.arm.parent / "scene.xml").write_text(at_bend(40.0), encoding="utf-8")
    with_collisions(desk, 'scene = "scene.xml"\nmargin = 0.004')
    return desk


def with_collisions(desk: Any, keys: str) -> None:
    head, joints = desk.arm.read_text(encoding="utf-8").split("\n[[joints]]", 1)
    head = head.split("\n[collisions]")[0]
    text = f"{head}\n[collisions]\n{keys}\n\n[[joints]]{joints}"
    desk.arm.write_text(text, encoding="utf-8")


def goals(desk: Any) -> list[int]:
    return [servo.memory.values["goal_position"] for servo in desk.bus.servos]


def degrees(desk: Any) -> list[float]:
    return np.degrees(desk.bus.true_angles(desk.config)).tolist()


def test_a_free_move_arrives_and_a_blocked_one_sends_nothing(robot_ik: Any, guarded: Any) -> None:
    run = robot_ik("servo", "move", "joint2=-30", "joint1=10", *guarded.at, "--speed", 1)
    assert run.code == 0, run.err
    assert degrees(guarded) == pytest.approx([10.0, -30.0, 0.0], abs=0.4)
    robot_ik("servo", "move", "joint2=0", "joint1=0", *guarded.at, "--speed", 1)
    before = goals(guarded), degrees(guarded)
    run = robot_ik("servo", "move", "joint2=80", *guarded.at)
    assert run.code == 1
    assert "ball" in run.err
    assert " mm " in run.err
    assert " s" in run.err
    assert (goals(guarded), degrees(guarded)) == before
    assert guarded.torque() == [False] * 3


def test_all_joints_move_together_so_that_the_checked_path_is_the_real_one(
    robot_ik: Any, guarded: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each at its own speed, joint2 would arrive when joint1 has gone a third of its way."""
    sent: list[dict[str, float]] = []
    send = Arm.send

    def noted(self: Arm, q: Any, now: float) -> Any:
        sent.append(dict(q))
        return send(self, q, now)

    monkeypatch.setattr(Arm, "send", noted)
    run = robot_ik("servo", "move", "joint1=90", "joint2=-30", *guarded.at, "--speed", 0.5)
    assert run.code == 0, run.err
    assert degrees(guarded) == pytest.approx([90.0, -30.0, 0.0], abs=0.4)
    turns = np.degrees([[command["joint1"], command["joint2"]] for command in sent])
    assert len(turns) > 20
    assert turns[:, 1] == pytest.approx(-turns[:, 0] / 3.0, abs=0.2)


def test_a_recording_that_would_touch_is_refused_before_torque(
    robot_ik: Any, guarded: Any, tmp_path: Path
) -> None:
    free = tmp_path / "free.csv"
    Trajectory([0.0, 0.5], np.radians([[0, 0, 0], [20, -20, 0]]), JOINTS).save_csv(free)
    run = robot_ik("servo", "replay", free, *guarded.at)
    assert run.code == 0, run.err
    assert degrees(guarded) == pytest.approx([20.0, -20.0, 0.0], abs=0.5)
    before = goals(guarded), degrees(guarded)
    for name, rows in (
        ("through", [[0, 0, 0], [0, 80, 0]]),
        ("begins beyond", [[-20, 80, 0], [-20, 80, 10]]),  # the way to its start is blocked
    ):
        file = tmp_path / f"{name}.csv"
        Trajectory([0.0, 0.5], np.radians(rows), JOINTS).save_csv(file)
        run = robot_ik("servo", "replay", file, *guarded.at)
        assert run.code == 1, (name, run)
        assert "ball" in run.err
        assert (goals(guarded), degrees(guarded)) == before
        assert guarded.torque() == [False] * 3


def test_an_arm_that_stands_in_contact_is_led_out_but_not_further_in(
    robot_ik: Any, guarded: Any
) -> None:
    (guarded.arm.parent / "scene.xml").write_text(at_bend(10.0), encoding="utf-8")
    before = goals(guarded)
    run = robot_ik("servo", "move", "joint2=5", *guarded.at)
    assert run.code == 1
    assert "would touch ball" in run.err
    assert goals(guarded) == before
    run = robot_ik("servo", "move", "joint2=-30", *guarded.at, "--speed", 1)
    assert run.code == 0, run.err
    assert degrees(guarded)[1] == pytest.approx(-30.0, abs=0.4)


@pytest.mark.parametrize(
    ("keys", "scene", "named"),
    [
        ('scene = "nowhere.xml"', "", ("collisions.scene", "there is no scene file")),
        ('scene = "scene.xml"', "no XML", ("collisions.scene",)),
        (
            'scene = "scene.xml"',
            '<mujoco><worldbody><geom size=".1" pos="nan 0 0"/></worldbody></mujoco>',
            ("collisions.scene",),
        ),
        (
            'scene = "scene.xml"',
            '<mujoco><worldbody><body name="arm"><joint/><geom size=".1"/></body></worldbody>'
            "</mujoco>",
            ("collisions.scene", "'arm'", "joint"),
        ),
        ("margin = nan", "", ("collisions.margin",)),
        ("margin = -0.1", "", ("collisions.margin",)),
        ('margin = "wide"', "", ("collisions.margin",)),
        ("ground = inf", "", ("collisions.ground",)),
        ('ignore = [["joint1"]]', "", ("collisions.ignore", "2 names")),
        ('ignore = [["a", "b"]]', "", ("collisions.ignore", "'a'")),
        ('sceen = "scene.xml"', "", ("sceen", "scene")),
        ("ground = 0.3", "", ("collisions.ignore", "every posture", "ground")),
    ],
)
@pytest.mark.parametrize("command", ["move joint2=5", "replay free.csv"])
def test_wrong_tables_are_named_and_nothing_is_sent(
    command: str,
    keys: str,
    scene: str,
    named: tuple[str, ...],
    robot_ik: Any,
    desk: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Trajectory([0.0, 0.5], np.radians([[0, 0, 0], [20, 0, 0]]), JOINTS).save_csv(Path("free.csv"))
    (desk.arm.parent / "scene.xml").write_text(scene or at_bend(40.0), encoding="utf-8")
    with_collisions(desk, keys)
    before = goals(desk)
    run = robot_ik("servo", *command.split(), *desk.at)
    run.assert_one_screen_error()
    for word in named:
        assert word in run.err, run.err
    assert goals(desk) == before
    assert desk.torque() == [False] * 3


def test_teleop_by_keys_stops_before_it_touches(
    robot_ik: Any, guarded: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Keys from standard input jog joint2 towards the ball, by 3 degrees a key."""
    read, write = os.pipe()
    os.write(write, b"w" * 30)
    with os.fdopen(read) as keys:
        monkeypatch.setattr("sys.stdin", keys)
        at = ("--follower-bus", guarded.port, "--follower", guarded.arm)
        run = robot_ik("teleop", *at, "--seconds", 2.0, "--on-exit", "torque_off")
    os.close(write)
    assert run.code == 0, run.err
    assert "would" in run.err
    assert "ball" in run.err
    assert "held back" in run.out
    bend = np.radians(degrees(guarded)[1])
    hand = 0.1 * np.array([np.sin(bend), 1.0 + np.cos(bend)])
    ball = 0.1 * np.array([np.sin(np.radians(40.0)), 1.0 + np.cos(np.radians(40.0))])
    assert np.linalg.norm(hand - ball) > 0.03 + 0.003
    assert degrees(guarded)[1] > 5.0
