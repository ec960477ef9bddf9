"""``robot-ik servo torque`` and ``reset-fault``: give and take torque, restart what has shut down."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.servo_link import (
    BusOptions,
    Link,
    arm_on,
    driving,
    joints_of,
    load_arm,
    opened,
    require_model,
    tried,
)
from robot_ik.cli.servo_scan import checked_rates

if TYPE_CHECKING:
    from robot_ik.hardware.control_table import Register
    from robot_ik.hardware.recovery import Reset

_ATTEMPTS = 3  # writes before a servo is given up


@dataclass(frozen=True)
class TorqueOptions(BusOptions):
    """Switches torque on (every joint holds where it stands) or off (support the arm: it may fall).

    on checks the servos as any start of the arm does, and leaves them holding, with no watchdog armed.
    off asks nothing first: it is for an arm in any state. Both are read back.
    """

    to: Positional[Annotated[Literal["on", "off"], arg(metavar="on|off")]]
    """What to do."""
    joints: Positional[Annotated[tuple[str, ...], arg(metavar="JOINT …", help_behavior_hint="")]] = ()
    """Only these joints; all if none is named."""
    ids: Annotated[tuple[int, ...], arg(metavar="N …", help_behavior_hint="")] = ()
    """For off: these servo ids, whatever the arm file says."""
    baud: Annotated[int | None, arg(metavar="RATE", help_behavior_hint="(default: the arm file's)")] = None
    """For --ids: the rate of these servos, bits/s."""


def run_torque(options: TorqueOptions) -> int:
    """1 when a servo did not confirm it."""
    if options.ids and (options.joints or options.to == "on"):
        raise wrong("--ids", "only for torque off, and not together with joints", "torque off --ids N …")
    config = load_arm(options.arm)
    if options.to == "on":
        require_model(config)
        arm = arm_on(options, joints_of(config, options.joints), "hold")

        def switch_on() -> int:
            arm.enable()
            return console.DONE

        with driving(arm):
            code = tried(switch_on)
        return code if arm.exit_report is not None and arm.exit_report.ok else console.NOT_ACHIEVED
    register = config.joints[0].table["torque_enable"]
    servos = {servo.id: servo.name for servo in joints_of(config, options.joints).servos}
    if options.ids:
        if bad := [id for id in options.ids if not 0 <= id <= 252]:
            raise wrong("--ids", f"{bad[0]} is no servo id", "0..252")
        servos = {id: f"servo {id}" for id in options.ids}
        if options.baud is not None:
            config = replace(config, baud=checked_rates([options.baud])[0])
    with opened(options, config) as link:
        return _switch_off(link, register, servos, everyone=not options.ids and not options.joints)


def _switch_off(link: Link, register: Register, servos: Mapping[int, str], *, everyone: bool) -> int:
    """All at once first, which needs no answer; then each by itself, read back."""
    from robot_ik.errors import BusDisconnectedError, HardwareError
    from robot_ik.hardware.bus import BROADCAST_ID

    if everyone:
        link.bus.write(BROADCAST_ID, register, 0)
    limp = []
    for id, name in servos.items():
        for _ in range(_ATTEMPTS):
            try:
                link.bus.write(id, register, 0)
                if link.bus.read(id, register).data == 0:
                    limp.append(name)
                    break
            except BusDisconnectedError:
                raise
            except HardwareError as error:
                reason = error
        else:
            console.say(f"error: {name}: {reason.args[0]}; its torque may be ON", "bold red")
    if limp:
        console.out().print(f"torque off, read back: {', '.join(limp)}", markup=False)
    return console.DONE if len(limp) == len(servos) else console.NOT_ACHIEVED


# ------------------------------------------------------------------------------------ reset-fault


@dataclass(frozen=True)
class ResetFaultOptions(BusOptions):
    """Restarts servos that have shut down (overload, heat, voltage …) and looks at them again.

    Remove the cause first. A restarted servo has no torque: support the arm. Nothing is switched on.
    Exit code 1 when an error is still there, or a servo has forgotten whole turns.
    """

    joints: Positional[Annotated[tuple[str, ...], arg(metavar="JOINT …", help_behavior_hint="")]] = ()
    """Only these joints; all if none is named."""


def run_reset_fault(options: ResetFaultOptions) -> int:
    """1 when something is still wrong."""
    from robot_ik.hardware.recovery import reset_servos

    config = joints_of(load_arm(options.arm), options.joints)
    with opened(options, config) as link:
        rows = reset_servos(link.bus, config, link.clock)
    shown = console.table("joint", "id", "was", "is", "what to do")
    for row in rows:
        now = "no answer" if row.after is None else (", ".join(row.after) or "healthy")
        was = (
            "no answer" if row.silence is not None and not row.before else ", ".join(row.before) or "healthy"
        )
        shown.add_row(row.joint, str(row.id), was, now, _advice(row))
    console.out().print(shown)
    return console.DONE if all(row.ok for row in rows) else console.NOT_ACHIEVED


def _advice(row: Reset) -> str:
    if row.ok:
        return "torque is off: robot-ik servo torque on" if row.before else ""
    if row.after is None:
        return "check power, cable, id and baud rate"
    if row.after:
        return "the cause is still there: load, heat, supply?"
    return f"its reading changed by {row.turned} ticks: it forgot whole turns; turn the joint by hand"
