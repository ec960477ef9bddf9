"""``robot-ik teleop``: an arm, a gamepad, or the keys of the terminal, lead another arm."""

from __future__ import annotations

import contextlib
import os
import select
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import OnExit, Range, positive, require, single, wrong
from robot_ik.cli.connection import (
    bus_argument,
    driving,
    load_arm,
    port_name,
    require_model,
    single_keys,
)
from robot_ik.hardware import bus_row
from robot_ik.robot_file import SERVO_ROBOT

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.jobs.teleop import Jog, Operator, TeleopReport

KEYS, GAMEPAD = "keys", "gamepad"
"""As ``--leader``: no arm, but the keys of the terminal, or the first gamepad."""
_ONLY_PORT = "the only USB serial port"


@dataclass(frozen=True)
class TeleopOptions:
    """Leads an arm by another one that a person guides, by a gamepad, or by the keys of this terminal.

        robot-ik teleop --leader l.toml --leader-bus PORT --follower-bus PORT
        robot-ik teleop --follower tabletop_puma --follower-bus pty

    Time is virtual where leader and follower are both on `sim`, else real.

    The follower goes slowly to where the leader is, then follows within its limits and caps. A leader that
    is lost commands nothing: the follower holds, then does what `on_stale` of its arm file says; when the
    leader is back they are engaged anew. With [collisions] in its arm file the follower stops before it
    would touch. Ctrl-C ends it. The leader is always left without torque.

    Exit code 0: done. 1: an arm failed, or the leader did not come back. 2: wrong input or environment.
    130: Ctrl-C.
    """

    leader: Annotated[str, arg(metavar="FILE|NAME|keys|gamepad")] = KEYS
    """Arm file of what leads, `keys`, or `gamepad` (extra `gamepad`)."""
    follower: Annotated[str, arg(metavar="FILE|NAME")] = SERVO_ROBOT
    """Arm file of what follows, or a robot of the catalogue that has one."""
    leader_bus: Annotated[str, bus_argument(default=_ONLY_PORT)] = ""
    follower_bus: Annotated[str, bus_argument(default=_ONLY_PORT, text="The same of the follower.")] = ""
    by: Literal["joints", "hand"] = "joints"
    """joints: those of the same name follow, range onto range; hand: the hand does, so arms may differ."""
    scale: Annotated[float, Range(0.01, 100.0)] = 1.0
    """Hand to hand: metres of the follower for one of the leader."""
    force_feedback: Annotated[float, Range(0.0, 1.0)] = 0.0
    """Share of the leader's currents that push it to where the follower is; needs current-based positions."""
    seconds: Annotated[float | None, single("S", "until Ctrl-C"), positive(86400.0, " s")] = None
    """End by itself after so many seconds."""
    on_exit: OnExit = ""


def run(options: TeleopOptions) -> int:
    """Leads; 1 where an arm failed."""
    _check(options)
    from robot_ik.jobs.teleop import LeaderArm, open_pair, teleoperate
    from robot_ik.workcell.arm_guard import guard_of

    follower_file = load_arm(options.follower)
    require_model(follower_file)
    guard = guard_of(follower_file)
    leader_file = None if options.leader in (KEYS, GAMEPAD) else load_arm(options.leader)
    if leader_file is not None:
        require_model(leader_file)
    leader_port = "" if leader_file is None else port_name(options.leader_bus, "--leader-bus")
    follower_port = port_name(options.follower_bus, "--follower-bus")
    leader, follower = open_pair(leader_file, follower_file, leader_port, follower_port, options.on_exit)
    operator: Operator
    with contextlib.ExitStack() as stack:
        if leader is not None:
            stack.enter_context(leader)
            operator = LeaderArm(leader, follower_file, options.by, options.scale, options.force_feedback)
        else:
            made = _keyboard if options.leader == KEYS else _gamepad
            operator = made(stack, follower, follower_file, options)
        # The keys of the terminal have another reader.
        stack.enter_context(driving(follower, space=options.leader != KEYS))
        teleoperate(
            operator,
            follower,
            seconds=options.seconds,
            over=lambda: operator.over,
            done=_show,
            guard=guard,
        )
    return console.DONE


def _check(options: TeleopOptions) -> None:
    port = options.leader_bus
    real = port != "" and not bus_row(port).virtual
    shared = real and port == options.follower_bus and options.leader not in (KEYS, GAMEPAD)
    require(not shared, "--leader-bus", f"{port} is the follower's, too", "two ports")


def _show(report: TeleopReport) -> None:
    lost = f", the leader lost {console.count_of(report.lost, 'time')}" if report.lost else ""
    engaged = console.count_of(report.engaged, "time")
    blocked = ""
    if report.blocked:
        blocked = f", held back {console.count_of(report.blocked, 'time')} by a collision"
    console.say(
        f"{report.end} after {report.seconds:.1f} s: {report.ticks} commands, "
        f"engaged {engaged}{lost}{blocked}; {1e3 * report.delay:.1f} ms from the leader to the packet"
    )


def _keyboard(stack: contextlib.ExitStack, follower: Arm, file: ArmConfig, options: TeleopOptions) -> Jog:
    from robot_ik.jobs.teleop import JOINT_KEYS, KeyboardJog

    typed = stack.enter_context(_typed(endless=options.seconds is not None))
    keys = KeyboardJog(file, typed, stop=follower.request_stop, hand=options.by == "hand")
    pairs = zip(keys.joints, JOINT_KEYS, strict=False)
    console.say("joints: " + ", ".join(f"{pair[0]}/{pair[1]} {joint.name}" for joint, pair in pairs), "dim")
    console.say("hand: w/s x, a/d y, r/f z; i/k, j/l, u/o turn about x, y, z", "dim")
    console.say(f"Tab: {_other(keys)}; - finer, + coarser; space: stop and hold; Esc ends", "dim")
    return keys


def _gamepad(stack: contextlib.ExitStack, follower: Arm, file: ArmConfig, options: TeleopOptions) -> Jog:
    from robot_ik.jobs.gamepad import Gamepad, PadDevice

    device, hand = stack.enter_context(PadDevice()), options.by == "hand"
    pad = Gamepad(file, device.read, recover=device.recover, stop=follower.request_stop, hand=hand)
    console.say(f"{device.name}: left stick x, y; triggers z; right stick and shoulders turn", "dim")
    console.say(
        f"in joints the same six move one each; up and down: the gripper; Y: {_other(pad)}; "
        "B: stop and hold; Start ends",
        "dim",
    )
    return pad


def _other(jog: Jog) -> str:
    """What the change of mode leads to."""
    return "joints" if jog.hand else "hand"


@contextlib.contextmanager
def _typed(endless: bool) -> Iterator[Callable[[], str]]:
    """Gives what was typed since it was last asked; at no terminal, what comes on standard input.

    Args:
        endless: Go on where the input has ended; else its end is that of the command: no key can end it.
    """
    from robot_ik.jobs.teleop import QUIT

    if sys.stdin is None:
        raise wrong("--leader keys", "standard input is closed", "a terminal, or a pipe that keys come from")
    file = sys.stdin.fileno()

    def read() -> str:
        text = b""
        while select.select([file], [], [], 0.0)[0]:
            try:
                more = os.read(file, 64)
            except OSError:  # the terminal has hung up
                more = b""
            if not more:
                return text.decode(errors="ignore") + ("" if endless else QUIT)
            text += more
        return text.decode(errors="ignore")

    with single_keys():
        yield read
