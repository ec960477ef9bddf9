"""Errors between the joint angles and the servos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from robot_ik.errors.base import RobotIkError


class HardwareError(RobotIkError):
    """Root of everything that can go wrong between the joint angles and the servos."""


class BusNotOpenError(HardwareError):
    """The port is missing, not a serial port, not permitted or already in use."""


class BusDisconnectedError(HardwareError):
    """The port went away while it was in use (cable pulled, adapter reset)."""


class BusTimeoutError(HardwareError):
    """A servo did not answer.

    Attributes:
        joint, id, register, port: Who was asked what, and where.
        last_good: Seconds since the last good reply, ``None`` if there never was one.
        everyone: Nobody else answers either.
    """

    def __init__(
        self,
        *,
        id: int,
        register: str,
        port: str,
        joint: str = "",
        last_good: float | None = None,
        everyone: bool = False,
        hint: str = "check power, cable, id and baud rate",
    ) -> None:
        self.id = id
        self.register = register
        self.port = port
        self.joint = joint
        self.last_good = last_good
        self.everyone = everyone
        who = f"servo id {id}" + (f" (joint {joint!r})" if joint else "")
        when = "it never answered" if last_good is None else f"last answer {last_good:.2f} s ago"
        asked = f"no servo answers on {port}" if everyone else f"no answer from {who} on {port} ({register})"
        super().__init__(f"{asked}; {when}", hint=hint)


class BusCorruptError(HardwareError):
    """An answer came but cannot be trusted (checksum, length); nothing of it was used."""


class ServoRefusedError(HardwareError):
    """A servo answered an instruction with an error number (Protocol 2.0, ERR bits 0-6).

    Attributes:
        id, register: Who and what.
        code: The number; ``reason`` is its name in the manual.
    """

    def __init__(self, *, id: int, register: str, code: int, reason: str, joint: str = "") -> None:
        self.id = id
        self.register = register
        self.code = code
        self.reason = reason
        self.joint = joint
        who = f"servo id {id}" + (f" (joint {joint!r})" if joint else "")
        super().__init__(f"{who} refused {register}: {reason} (error {code})")


class ServoMismatchError(HardwareError):
    """The servos found on the bus are not the ones that the arm file, or another ``source``, names.

    Attributes:
        expected: Servo id -> "joint: model" as the source says.
        found: Servo id -> model as the bus says.
    """

    def __init__(
        self,
        expected: Mapping[int, str],
        found: Mapping[int, str],
        *,
        port: str,
        hint: str = "",
        source: str = "the arm file",
    ) -> None:
        self.expected = dict(expected)
        self.found = dict(found)
        self.port = port
        ids = sorted({*expected, *found})
        width = max([len(expected.get(i, "")) for i in ids] + [8])
        rows = [f"  {'id':>3}  {'expected':<{width}}  found"]
        rows += [f"  {i:>3}  {expected.get(i, '-'):<{width}}  {found.get(i, 'missing')}" for i in ids]
        super().__init__(
            f"the servos on {port} are not those of {source}; nothing was switched on\n" + "\n".join(rows),
            hint=hint
            or "check power, cable, ids, the arm file; robot-ik servo scan looks at every baud rate",
        )


class MotorFaultError(HardwareError):
    """A servo has shut down or the arm has latched a fault.

    Attributes:
        joint: Joint name; ``status``: decoded hardware error names.
    """

    def __init__(self, joint: str, status: Sequence[str], *, hint: str = "") -> None:
        self.joint = joint
        self.status = tuple(status)
        super().__init__(f"joint {joint!r} is in fault: {', '.join(status)}", hint=hint)


class StopRequestedError(HardwareError):
    """Somebody asked the arm to stop: ``robot-ik stop``, a key, another thread."""


class UnsafeCommandError(HardwareError, ValueError):
    """A command that must not be obeyed even in part; nothing was sent."""

    def __init__(self, asked: str, allowed: str) -> None:
        self.asked = asked
        self.allowed = allowed
        super().__init__(f"refused: {asked}; allowed: {allowed}. Nothing was sent to any servo.")


class ArmStateError(HardwareError):
    """The arm is not in a state in which this can be done."""
