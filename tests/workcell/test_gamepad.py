"""A gamepad leads an arm. The device is a virtual gamepad of SDL."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from robot_ik.commands.main import main
from robot_ik.errors import HardwareError
from robot_ik.geometry import Pose
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.config import ArmConfig
from robot_ik.ports import Array
from robot_ik.robot import load_robot
from robot_ik.workcell.gamepad import DEAD_ZONE, Gamepad, PadDevice, PadState
from robot_ik.workcell.jog import KeyboardJog
from robot_ik.workcell.teleop import teleoperate
from tests.workcell.test_teleop import arm_file, each_tick, home


def led(
    read: Callable[[], PadState], *, moves_tool: bool = True, seconds: float = 1.5
) -> tuple[Array, Array, dict[str, float], ArmConfig]:
    """Return the joints (n,) of the follower before and after, the latter by name, and its file."""
    begin = home("tabletop_puma")
    follower = open_arm(arm_file("tabletop_puma"), "sim", on_exit="hold", start=begin)
    pad = Gamepad(follower.config, read, stop=follower.request_stop, moves_tool=moves_tool)
    with follower:
        teleoperate(pad, follower, seconds=seconds, over=lambda: pad.over)
        return begin, follower.read().q[:6], follower.positions(), follower.config


def test_sticks_move_the_hand_along_the_axes_of_the_world() -> None:
    states = iter([PadState(left=(0.0, 1.0))] * 21 + [PadState(triggers=(0.0, 1.0))] * 20)
    begin, q, _, config = led(lambda: next(states, PadState()))
    robot = load_robot("tabletop_puma")
    moved = robot.forward(q).position - robot.forward(begin).position
    assert moved == pytest.approx(
        [0.12 * 20 / config.rate_hz, 0.0, 0.12 * 20 / config.rate_hz], abs=3e-3
    )
    assert robot.forward(q).distance(robot.forward(begin))[1] < 0.02


def test_a_hand_at_the_end_of_its_reach_stops_there_as_it_is_and_comes_back_without_drift() -> None:
    config = arm_file("tabletop_puma")
    robot = load_robot("tabletop_puma")
    jog = KeyboardJog(config, str, moves_tool=True)
    begin = dict(zip(config.chain.names, home("tabletop_puma").tolist(), strict=True))
    jog.engage(begin | {joint.name: joint.limits[0] for joint in config.group("gripper")})

    def tool() -> Pose:
        return robot.forward(np.array([jog.angles[name] for name in robot.joints]))

    first = tool()
    there = 0
    for _ in range(100):
        before = tool()
        jog.move_tool(np.array((0.002, 0.0, 0.0)), np.zeros(3))
        there += tool().distance(before)[0] > 1e-3
    assert 20 < there < 80, "it was to come to the end of its reach on the way"
    assert tool().distance(first)[1] < 0.01 and tool().position[2] == pytest.approx(
        first.position[2], abs=1e-3
    )
    for _ in range(there):
        jog.move_tool(np.array((-0.002, 0.0, 0.0)), np.zeros(3))
    assert tool().distance(first)[0] < 5e-4


def test_in_joints_the_same_six_move_one_each_within_its_limits() -> None:
    begin, q, _, config = led(lambda: PadState(left=(0.0, 1.0)), moves_tool=False, seconds=8.0)
    assert q[0] == pytest.approx(config.upper[0], abs=0.005)
    assert q[1:] == pytest.approx(begin[1:], abs=0.005)


def test_a_button_changes_between_hand_and_joints_and_another_moves_the_gripper() -> None:
    states = iter(
        [PadState(pressed=frozenset({"y"}))] * 2
        + [PadState((0.0, 1.0), pressed=frozenset({"up"}))] * 20
    )
    begin, q, angles, config = led(lambda: next(states, PadState()))
    assert q[0] > begin[0] + 0.05 and q[1:] == pytest.approx(begin[1:], abs=0.005)
    gripper = config.group("gripper")[0]
    assert angles[gripper.name] > gripper.limits[0] + 0.001


def test_a_stick_that_is_let_go_moves_nothing() -> None:
    begin, q, _, _ = led(lambda: PadState(left=(0.9 * DEAD_ZONE, -0.9 * DEAD_ZONE)), seconds=0.5)
    assert np.abs(q - begin).max() < 1e-3


def test_one_button_stops_and_another_ends() -> None:
    states = iter([PadState(pressed=frozenset({"b"}))])
    with pytest.raises(HardwareError, match="stop"):
        led(lambda: next(states, PadState(left=(0.0, 1.0))), seconds=0.5)
    states = iter([PadState(pressed=frozenset({"start"}))])
    begin, q, _, _ = led(lambda: next(states, PadState(left=(0.0, 1.0))), seconds=5.0)
    assert np.abs(q - begin).max() < 0.01


@pytest.fixture
def virtual_pad(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Return a function that sets the state of a virtual gamepad in the SDL of pygame."""
    pygame = pytest.importorskip("pygame", reason="needs the extra gamepad")
    libraries = list(Path(pygame.__file__).parents[1].glob("pygame_ce.libs/libSDL2-2*"))
    if not libraries:
        pytest.skip("this build of pygame has no SDL of its own to make up a gamepad with")
    for name in ("SDL_VIDEODRIVER", "SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS"):
        monkeypatch.setenv(name, "dummy" if "DRIVER" in name else "1")
    sdl = ctypes.CDLL(str(libraries[0]))
    sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
    from pygame._sdl2 import controller

    pygame.display.init()
    controller.init()
    number = [sdl.SDL_JoystickAttachVirtual(1, 6, 15, 0)]  # 1: a gamepad; its axes and buttons
    stick = ctypes.c_void_p(sdl.SDL_JoystickOpen(number[0]))

    def change(*, axis: int = -1, button: int = -1, value: int = 0, away: bool = False) -> None:
        if axis >= 0:
            sdl.SDL_JoystickSetVirtualAxis(stick, axis, ctypes.c_int16(value))
        if button >= 0:
            sdl.SDL_JoystickSetVirtualButton(stick, button, ctypes.c_uint8(value))
        if away:
            sdl.SDL_JoystickDetachVirtual(number.pop())

    yield change
    if number:
        sdl.SDL_JoystickDetachVirtual(number[0])


def test_a_device_is_read_and_found_missing(virtual_pad: Callable[..., None]) -> None:
    with PadDevice() as device:
        assert device.name and device.read() == PadState()
        virtual_pad(axis=0, value=32767)
        virtual_pad(axis=1, value=-32768)  # SDL's y is down
        virtual_pad(button=1, value=1)
        state = device.read()
        assert state.left == (1.0, 1.0) and state.pressed == {"b"}
        virtual_pad(away=True)
        with pytest.raises(HardwareError, match="disconnected"):
            device.read()
        with pytest.raises(HardwareError, match="connected again"):
            device.recover(0.0)


def test_a_gamepad_that_is_lost_commands_nothing(virtual_pad: Callable[..., None]) -> None:
    begin = home("tabletop_puma")
    follower = open_arm(arm_file("tabletop_puma"), "sim", on_exit="hold", start=begin)
    with PadDevice() as device, follower:
        pad = Gamepad(follower.config, device.read, recover=device.recover)
        virtual_pad(axis=1, value=-32768)

        over = each_tick(follower, lambda time: time > 0.3 and virtual_pad(away=True))
        with pytest.raises(HardwareError, match="connected again"):
            teleoperate(pad, follower, seconds=5.0, patience=0.2, over=over)
        assert follower.state is ArmState.HOLD


def test_without_a_gamepad_the_keys_are_suggested(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pygame", reason="needs the extra gamepad")
    words = "teleop --leader gamepad --follower tabletop_puma --follower-bus sim --seconds 0.1"
    assert main(words.split()) == 2
    assert "--leader keys" in capsys.readouterr().err
