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
from robot_ik.cli.connection import ONLY_PORT, bus_argument, driving, load_arm, port_name
from robot_ik.cli.terminal_keys import single_keys
from robot_ik.hardware import bus_row
from robot_ik.robot_file import SERVO_ROBOT

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.jobs.jog import Jog
    from robot_ik.jobs.operator import Operator
    from robot_ik.jobs.teleop import TeleopReport

KEYS = "keys"
"""Value of ``--leader``: the keys of the terminal instead of an arm."""

GAMEPAD = "gamepad"
"""Value of ``--leader``: the first gamepad instead of an arm."""

READ_BYTES = 64
"""Bytes read from standard input at once."""


@dataclass(frozen=True)
class TeleopOptions:
    """Leads an arm by another one that a person guides, by a gamepad, or by the keys here.

        robot-ik teleop --leader l.toml --leader-bus PORT --follower-bus PORT
        robot-ik teleop --follower tabletop_puma --follower-bus pty

    Time is virtual if leader and follower are both on `sim`, else real.

    The follower goes slowly to where the leader is, then follows within its limits and caps. A
    leader that is lost commands nothing: the follower holds, then does what `on_stale` of its arm
    file says; when the leader is back they are engaged anew. With [collisions] in its arm file the
    follower stops before it would touch. Ctrl-C ends it. The leader is always left without torque.

    Exit code 0: done. 1: an arm failed, or the leader did not come back. 2: wrong input or
    environment. 130: Ctrl-C.
    """

    leader: Annotated[str, arg(metavar="FILE|NAME|keys|gamepad")] = KEYS
    """Arm file of the leader, `keys`, or `gamepad` (extra `gamepad`)."""
    follower: Annotated[str, arg(metavar="FILE|NAME")] = SERVO_ROBOT
    """Arm file of the follower, or a robot of the catalogue that has one."""
    leader_bus: Annotated[str, bus_argument(default=ONLY_PORT)] = ""
    follower_bus: Annotated[
        str, bus_argument(default=ONLY_PORT, text="The same of the follower.")
    ] = ""
    by: Literal["joints", "hand"] = "joints"
    """joints: joints of the same name, range onto range; hand: the hand, so arms may differ."""
    scale: Annotated[float, Range(0.01, 100.0)] = 1.0
    """Hand to hand: metres of the follower for one of the leader."""
    force_feedback: Annotated[float, Range(0.0, 1.0)] = 0.0
    """Share of the leader's currents that push it to the follower; in current-based mode only."""
    seconds: Annotated[float | None, single("S", "until Ctrl-C"), positive(86400.0, " s")] = None
    """Duration, s."""
    on_exit: OnExit = ""


def run(options: TeleopOptions) -> int:
    """Lead the follower; 1 if an arm failed."""
    _check(options)
    from robot_ik.jobs.leader_arm import LeaderArm
    from robot_ik.jobs.teleop import open_pair, teleoperate
    from robot_ik.workcell.arm_guard import guard_of

    follower_config = load_arm(options.follower)
    guard = guard_of(follower_config)
    leader_config = None
    leader_port = ""
    if options.leader not in (KEYS, GAMEPAD):
        leader_config = load_arm(options.leader)
        leader_port = port_name(options.leader_bus, "--leader-bus")
    follower_port = port_name(options.follower_bus, "--follower-bus")
    leader, follower = open_pair(
        leader_config, follower_config, leader_port, follower_port, options.on_exit
    )
    operator: Operator
    with contextlib.ExitStack() as stack:
        if leader is not None:
            stack.enter_context(leader)
            operator = LeaderArm(
                leader, follower_config, options.by, options.scale, options.force_feedback
            )
        elif options.leader == KEYS:
            operator = _keyboard(stack, follower, follower_config, options)
        else:
            operator = _gamepad(stack, follower, follower_config, options)
        # If the keys of the terminal lead, they have another reader.
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
    """Check that leader and follower are on two ports.

    Raises:
        ConfigError: They share a port.
    """
    port = options.leader_bus
    is_real = port != "" and not bus_row(port).virtual
    has_leader_arm = options.leader not in (KEYS, GAMEPAD)
    shared = is_real and has_leader_arm and port == options.follower_bus
    require(not shared, "--leader-bus", f"{port} is the follower's, too", "two ports")


def _show(report: TeleopReport) -> None:
    """Print the report."""
    lost = f", the leader lost {console.count_of(report.lost, 'time')}" if report.lost else ""
    engaged = console.count_of(report.engaged, "time")
    blocked = ""
    if report.blocked:
        blocked = f", held back {console.count_of(report.blocked, 'time')} by a collision"
    console.say(
        f"{report.end} after {report.seconds:.1f} s: {report.ticks} commands, "
        f"engaged {engaged}{lost}{blocked}; "
        f"{1e3 * report.delay:.1f} ms from the leader to the packet"
    )


def _keyboard(
    stack: contextlib.ExitStack, follower: Arm, config: ArmConfig, options: TeleopOptions
) -> Jog:
    """Return the keys as an operator, and say what they do."""
    from robot_ik.jobs.jog import JOINT_KEYS, KeyboardJog

    typed = stack.enter_context(_typed(endless=options.seconds is not None))
    keys = KeyboardJog(config, typed, stop=follower.request_stop, hand=options.by == "hand")
    pairs = zip(keys.joints, JOINT_KEYS, strict=False)
    joints = ", ".join(f"{pair[0]}/{pair[1]} {joint.name}" for joint, pair in pairs)
    console.say(f"joints: {joints}", "dim")
    console.say("hand: w/s x, a/d y, r/f z; i/k, j/l, u/o turn about x, y, z", "dim")
    console.say(
        f"Tab: {_other_mode(keys)}; - finer, + coarser; space: stop and hold; Esc ends", "dim"
    )
    return keys


def _gamepad(
    stack: contextlib.ExitStack, follower: Arm, config: ArmConfig, options: TeleopOptions
) -> Jog:
    """Return the gamepad as an operator, and say what its buttons do."""
    from robot_ik.jobs.gamepad import Gamepad, PadDevice

    device = stack.enter_context(PadDevice())
    pad = Gamepad(
        config,
        device.read,
        recover=device.recover,
        stop=follower.request_stop,
        hand=options.by == "hand",
    )
    console.say(
        f"{device.name}: left stick x, y; triggers z; right stick and shoulders turn", "dim"
    )
    console.say(
        "in joints the same six move one each; up and down: the gripper; "
        f"Y: {_other_mode(pad)}; B: stop and hold; Start ends",
        "dim",
    )
    return pad


def _other_mode(jog: Jog) -> str:
    """Return the mode after a change."""
    return "joints" if jog.hand else "hand"


@contextlib.contextmanager
def _typed(*, endless: bool) -> Iterator[Callable[[], str]]:
    """Yield a function that returns what was typed since the last call.

    Without a terminal it returns what comes on standard input.

    Args:
        endless: Go on if the input has ended.  Otherwise its end is that of the command, because no
            key can end it.

    Raises:
        ConfigError: Standard input is closed.
    """
    from robot_ik.jobs.jog import QUIT

    if sys.stdin is None:
        raise wrong(
            "--leader keys", "standard input is closed", "a terminal, or a pipe that sends keys"
        )
    file = sys.stdin.fileno()

    def read() -> str:
        text = b""
        while select.select([file], [], [], 0.0)[0]:
            try:
                data = os.read(file, READ_BYTES)
            except OSError:  # the terminal has hung up
                data = b""
            if not data:
                return text.decode(errors="ignore") + ("" if endless else QUIT)
            text += data
        return text.decode(errors="ignore")

    with single_keys():
        yield read
