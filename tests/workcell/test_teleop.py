"""Leading an arm by another one, both simulated on one virtual clock; and by keys."""

from __future__ import annotations

import fcntl
import itertools
import os
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from robot_ik.commands.main import main
from robot_ik.errors import ConfigError, HardwareError
from robot_ik.hardware import open_arm, ports
from robot_ik.hardware.arm import Arm, ArmState
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import Array, Clock, RealClock, VirtualClock
from robot_ik.robot import load_robot
from robot_ik.workcell.jog import KeyboardJog
from robot_ik.workcell.leader_arm import JointCoupling, LeaderArm
from robot_ik.workcell.teleop import Blend, open_pair, teleoperate

MODELS = Path(__file__).resolve().parents[2] / "models"


def arm_file(name: str) -> ArmConfig:
    return ArmConfig.load(MODELS / name / "arm.toml")


@contextmanager
def pair(
    leader: str, follower: str, starts: tuple[Array | None, Array | None]
) -> Iterator[tuple[Arm, Arm]]:
    clock = VirtualClock()

    def made(name: str, start: Array | None, on_exit: str) -> Arm:
        servos = VirtualBus.from_config(arm_file(name), clock, start)
        return open_arm(arm_file(name), "sim", virtual_bus=servos, on_exit=on_exit)

    with (
        made(leader, starts[0], "torque_off") as first,
        made(follower, starts[1], "hold") as second,
    ):
        yield first, second


def guide(arm: Arm, q: Array) -> None:
    """A person turns the limp shafts of an arm to q (n,)."""
    assert arm.bus.virtual_bus is not None
    here = dict(zip(arm.joints, arm.bus.virtual_bus.true_angles(arm.config), strict=True))
    names = arm.joints if len(q) == len(arm.joints) else arm.config.chain.names
    goal = dict(zip(names, np.asarray(q).tolist(), strict=True))
    for drive in arm.config.drives:
        if drive.name in goal:
            way = drive.position(goal[drive.name]) - drive.position(here[drive.name])
            arm.bus.virtual_bus.servo(drive.id).rotate_by_hand(way)


def chain_q(arm: Arm) -> Array:
    """The measured joints that carry the tool."""
    return arm.read().q[[arm.joints.index(name) for name in arm.config.chain.names]]


def home(name: str) -> Array:
    robot = load_robot(name)
    return robot.home[[robot.joints.index(joint) for joint in arm_file(name).chain.names]]


def each_tick(arm: Arm, tick: Callable[[float], object]) -> Callable[[], bool]:
    """Return an ``over`` that is always false and calls ``tick(time)`` at each tick, s."""
    begin = arm.clock.now()

    def over() -> bool:
        tick(arm.clock.now() - begin)
        return False

    return over


def waved(begin: Array, arm: Arm) -> Callable[[], bool]:
    """A person who moves the leader to and fro, and ends at 0.15 rad from where it began."""

    def wave(time: float) -> None:
        guide(arm, begin + 0.15 * (0.5 - 0.5 * np.cos(np.pi * min(1.0, time / 2.0))))

    return each_tick(arm, wave)


def test_joint_to_joint_the_follower_goes_there_without_a_jump_and_follows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begin = home("tabletop_puma")
    apart = begin + np.array([0.4, -0.2, 0.3, 0.0, 0.2, 0.0])
    with pair("tabletop_puma", "tabletop_puma", (begin, apart)) as (leader, follower):
        sent: list[list[float]] = []
        behind: list[float] = []
        operator = LeaderArm(leader, follower.config, "joints", 1.0)
        send = follower.send

        def noted(command: dict[str, float], now: float) -> None:
            send(command, now)
            sent.append([command[name] for name in follower.config.chain.names])
            behind.append(np.abs(chain_q(follower) - sent[-1]).max())

        monkeypatch.setattr(follower, "send", noted)
        report = teleoperate(operator, follower, seconds=4.0, over=waved(begin, leader))
        assert report.engaged == 1 and report.lost == 0 and max(behind) < 0.05
        q = np.array(sent)
        assert np.abs(q[0] - apart).max() < 1e-3  # engaged where it stands
        steps = np.abs(np.diff(q, axis=0)) * follower.config.rate_hz
        assert (steps <= follower.config.chain.velocity).all()
        assert np.abs(q[-1] - begin - 0.15).max() < 0.01
        assert np.abs(chain_q(follower) - begin - 0.15).max() < 0.02
        assert (
            leader.state is ArmState.CONNECTED
        )  # nobody gave it torque: no force feedback unless asked


def test_hand_to_hand_between_different_arms() -> None:
    begin = home("tabletop_puma")
    other = home("wx250s")
    with pair("tabletop_puma", "wx250s", (begin, other)) as (leader, follower):
        one = load_robot("tabletop_puma")
        two = load_robot("wx250s", joints=follower.config.chain.names)
        operator = LeaderArm(leader, follower.config, "tool", 0.5)
        report = teleoperate(operator, follower, seconds=2.5, over=waved(begin, leader))
        assert report.engaged == 1
        led = one.forward(chain_q(leader)).position - one.forward(begin).position
        follower_q = np.array([follower.positions()[n] for n in two.joints])
        start = dict(zip(follower.config.chain.names, other, strict=True))
        start_q = np.array([start[n] for n in two.joints])
        moved = two.forward(follower_q).position - two.forward(start_q).position
        assert np.linalg.norm(led) > 0.03
        assert np.linalg.norm(moved - 0.5 * led) < 0.005


def test_ranges_are_laid_onto_each_other_and_names_must_agree() -> None:
    koch = arm_file("koch_v11")
    puma = arm_file("tabletop_puma")
    same = JointCoupling(koch, koch)
    angles = {joint.name: 0.3 * sum(joint.limits) for joint in koch.joints}
    assert same.follower(angles) == pytest.approx(angles) and "gripper" in same.names
    ends = {joint.name: 9.0 for joint in koch.joints}
    assert same.follower(ends) == pytest.approx({j.name: j.limits[1] for j in koch.joints})
    with pytest.raises(ConfigError, match="--mode tool"):
        JointCoupling(koch, puma)


def silence(arm: Arm, on: bool) -> None:
    assert arm.bus.virtual_bus is not None
    for servo in arm.bus.virtual_bus.servos:
        servo.silent = on


def test_a_leader_that_is_lost_commands_nothing_and_is_engaged_anew() -> None:
    begin = home("tabletop_puma")
    with pair("tabletop_puma", "tabletop_puma", (begin, begin)) as (leader, follower):
        operator = LeaderArm(leader, follower.config, "joints", 1.0)
        states: list[ArmState] = []

        def tick(time: float) -> None:
            states.append(follower.state)
            if time > 1.0 and not states.count(ArmState.HOLD) and operator_lost[0] == 0:
                operator_lost[0] = 1
                silence(leader, True)

        operator_lost = [0]
        recover = operator.recover

        def back(timeout: float) -> None:
            states.append(follower.state)
            silence(leader, False)
            guide(leader, begin + 0.2)  # it stands elsewhere when it comes back
            recover(timeout)

        operator.recover = back  # type: ignore[method-assign]
        report = teleoperate(operator, follower, seconds=3.0, over=each_tick(follower, tick))
        assert report.lost == 1 and report.engaged == 2
        assert ArmState.HOLD in states
        assert np.abs(chain_q(follower) - begin - 0.2).max() < 0.02


def test_a_leader_that_stays_away_ends_it_and_the_follower_holds() -> None:
    begin = home("tabletop_puma")
    with pair("tabletop_puma", "tabletop_puma", (begin, begin)) as (leader, follower):
        operator = LeaderArm(leader, follower.config, "joints", 1.0)

        over = each_tick(follower, lambda time: silence(leader, time > 0.5))
        with pytest.raises(HardwareError):
            teleoperate(operator, follower, seconds=5.0, patience=0.5, over=over)
        assert follower.state is ArmState.HOLD


def test_a_follower_that_fails_is_no_lost_leader() -> None:
    begin = home("tabletop_puma")
    with pair("tabletop_puma", "tabletop_puma", (begin, begin)) as (leader, follower):
        operator = LeaderArm(leader, follower.config, "joints", 1.0)
        asked: list[float] = []
        operator.recover = asked.append  # type: ignore[method-assign]
        over = each_tick(follower, lambda time: silence(follower, time > 0.2))
        with pytest.raises(HardwareError):
            teleoperate(operator, follower, seconds=5.0, over=over)
        assert asked == [] and follower.state is ArmState.FAULT


def keyed(text: str, moves_tool: bool, seconds: float = 1.5) -> tuple[Array, Array, Arm]:
    begin = home("tabletop_puma")
    follower = open_arm(arm_file("tabletop_puma"), "sim", on_exit="hold", start=begin)
    waiting = list(text)
    keys = KeyboardJog(
        follower.config, lambda: waiting.pop(0) if waiting else "", moves_tool=moves_tool
    )
    with follower:
        teleoperate(keys, follower, seconds=seconds, over=lambda: keys.over)
        return begin, chain_q(follower), follower


def test_keys_jog_joints_within_their_limits() -> None:
    begin, q, _ = keyed("qqqs+d", moves_tool=False)
    step = np.radians(3.0)
    assert (q - begin) == pytest.approx([3 * step, -step, -2 * step, 0, 0, 0], abs=0.005)
    begin, q, follower = keyed("q" * 60, moves_tool=False, seconds=4.0)
    assert q[0] == pytest.approx(follower.upper[0], abs=0.005)


def test_keys_jog_the_tool_in_the_axes_of_the_world() -> None:
    robot = load_robot("tabletop_puma")
    begin, q, _ = keyed("rrw", moves_tool=True)
    way = robot.forward(q).position - robot.forward(begin).position
    assert way == pytest.approx([0.01, 0.0, 0.02], abs=2e-3)
    assert robot.forward(q).distance(robot.forward(begin))[1] < 0.02
    begin, q, _ = keyed("\trr", moves_tool=False)
    assert (robot.forward(q).position - robot.forward(begin).position)[2] == pytest.approx(
        0.02, abs=2e-3
    )


def test_escape_ends_it() -> None:
    begin, q, _ = keyed("\x1b" + 20 * "q", moves_tool=False)
    assert np.abs(q - begin).max() < 0.01


def test_a_blend_begins_where_the_follower_is_and_ends_where_it_is_led() -> None:
    config = arm_file("tabletop_puma")
    here = dict.fromkeys(config.names, 1.0)
    there = dict.fromkeys(config.names, 0.0)
    blend = Blend(here, there, config, 10.0)
    assert blend(there, 10.0) == here and blend(there, 10.0 + blend.seconds) == pytest.approx(there)
    times = np.linspace(10.0, 10.0 + blend.seconds, 500)
    q = np.array([list(blend(there, t).values()) for t in times])
    speed = np.abs(np.diff(q, axis=0)).max(axis=0) / (times[1] - times[0])
    assert (speed <= 0.26 * config.velocity).all()


def test_wrong_options_of_teleop_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["teleop", "--follower", "tabletop_puma", "--follower-bus", "sim", "--scale", "0"])
        == 2
    )
    assert main(["teleop", "--leader", "nobody", "--follower-bus", "sim"]) == 2
    same = ["--leader", "koch_v11", "--leader-bus", "/dev/tty1", "--follower-bus", "/dev/tty1"]
    assert main(["teleop", *same]) == 2
    assert "two ports" in capsys.readouterr().err
    monkeypatch.setattr(ports, "serial_ports", list)
    assert main(["teleop"]) == 2
    assert "--follower-bus: this argument is required" in capsys.readouterr().err
    assert main(["teleop", "--leader", "koch_v11", "--follower-bus", "sim"]) == 2
    assert "--leader-bus: no port is given" in capsys.readouterr().err


def test_the_command_leads_a_simulated_arm(capsys: pytest.CaptureFixture[str]) -> None:
    words = (
        "teleop --leader tabletop_puma --leader-bus sim --follower tabletop_puma --follower-bus sim"
    )
    assert main([*words.split(), "--seconds", "1", "--on-exit", "torque_off"]) == 0
    assert "engaged 1 time;" in capsys.readouterr().out


def test_ctrl_c_ends_it_with_the_summary(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("robot_ik.workcell.teleop.Blend.__call__", interrupted_at_the_tenth())
    words = (
        "teleop --leader tabletop_puma --leader-bus sim --follower tabletop_puma --follower-bus sim"
    )
    assert main([*words.split(), "--on-exit", "torque_off"]) == 130
    summary = "ended early after 0.1 s: 10 commands, engaged 1 time;"
    printed = capsys.readouterr()
    assert summary in printed.out
    assert printed.err.index("torque is off") < printed.err.index("interrupted")


def interrupted_at_the_tenth() -> Callable[..., dict[str, float]]:
    """In place of a blend: Ctrl-C comes at the tenth command."""
    counted = itertools.count(1)

    def lead(self: Blend, there: dict[str, float], now: float) -> dict[str, float]:
        if next(counted) == 10:
            raise KeyboardInterrupt
        return there

    return lead


@pytest.mark.parametrize(
    ("leader", "leader_bus", "clock"),
    [(None, "", RealClock), ("koch_v11", "pty", RealClock), ("koch_v11", "sim", VirtualClock)],
)
def test_nobody_leads_in_virtual_time(
    leader: str | None, leader_bus: str, clock: type[Clock]
) -> None:
    config = None if leader is None else arm_file(leader)
    _, follower = open_pair(config, arm_file("tabletop_puma"), leader_bus, "sim")
    assert isinstance(follower.clock, clock)


def test_keys_from_a_closed_input_are_refused_and_an_input_that_ends_ends_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "teleop",
        "--follower",
        "tabletop_puma",
        "--follower-bus",
        "sim",
        "--on-exit",
        "torque_off",
    ]
    monkeypatch.setattr(sys, "stdin", None)  # as a shell's <&- leaves it
    assert main(words) == 2
    assert "standard input is closed" in capsys.readouterr().err
    with open(os.devnull) as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        assert main(words) == 0
        assert "ended by the operator" in capsys.readouterr().out
        assert main([*words, "--seconds", "0.3"]) == 0
        assert "end of the given time" in capsys.readouterr().out


@pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")
def test_the_keys_of_a_terminal_have_one_reader() -> None:
    """If the keys lead, the space bar is one of them, and no second thread takes keys away."""
    keys, terminal = os.openpty()
    words = "teleop --follower tabletop_puma --follower-bus sim --on-exit torque_off"
    child = subprocess.Popen(
        [sys.executable, "-m", "robot_ik", *words.split()],
        stdin=terminal,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    lines = []
    try:
        for line in child.stderr:
            lines.append(line.strip())
            if line.strip().endswith("Esc ends"):
                break
        os.write(keys, b"\x1b")
        out, err = child.communicate()
    finally:
        child.kill()
        os.close(keys)
        os.close(terminal)
    assert child.returncode == 0, err
    assert "ended by the operator" in out
    assert "space: stop and hold" not in [*lines, *err.splitlines()]
