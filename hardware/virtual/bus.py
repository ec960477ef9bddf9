"""The virtual bus: instruction packets in, status packets out."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import RobotIkError
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import GRIPPER
from robot_ik.hardware.virtual.families import VIRTUAL_FAMILIES
from robot_ik.hardware.virtual.faults import Fault, Injected
from robot_ik.hardware.virtual.schedule import WireSchedule
from robot_ik.hardware.virtual.wire import VirtualWire
from robot_ik.ports import Array, Clock

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.world import World
    from robot_ik.robot import Robot

DEFAULT_FAMILY = "dynamixel_x"
"""Family of a bus without servos."""

DEFAULT_MODEL = "XM430-W350"
"""Model of a servo that is added to a bus without servos."""

DEFAULT_BAUD = 1_000_000
"""bit/s of a servo that is added to a bus without servos."""


class VirtualBus:
    """Servos of one family on one wire. Safe to call from any thread.

    Args:
        servos: Virtual servos. Two may have the same id by mistake; their replies then collide.
        clock: Clock of the times at which bytes arrive.
        seed: Seed of the random faults.

    Attributes:
        family: Name of the servo family.
        side: The servos' side of the wire protocol.
        world: Moves the shafts by a model of the arm; None: the profiles move them.
        wire: Transmits the replies to the host.
        echo: The adapter returns what was sent.
        unplugged: The port is unplugged. ``PtyPort`` and ``SimBus`` then take it away.
        latency: Extra delay of every reply, as of a USB adapter, s.
    """

    def __init__(self, servos: Iterable[Any], clock: Clock, seed: int = 0) -> None:
        self.servos = tuple(servos)
        self.family: str = self.servos[0].table.family if self.servos else DEFAULT_FAMILY
        self.side = VIRTUAL_FAMILIES[self.family].side
        self.clock = clock
        self.lock = threading.RLock()
        self.world: World | None = None
        self.echo = False
        self.unplugged = False
        self.latency = 0.0
        self.schedule = WireSchedule(clock)
        self._built: dict[int | str, Any] = {servo.id: servo for servo in self.servos}
        self.wire = VirtualWire((servo.id for servo in self.servos), seed, self.side)
        self._injected: list[Injected] = []
        self._parser = self.side.parser()
        self._wakers: list[Callable[[], None]] = []

    @classmethod
    def from_config(
        cls,
        config: ArmConfig,
        clock: Clock,
        start: ArrayLike | Mapping[str, float] | None = None,
        *,
        seed: int = 0,
    ) -> VirtualBus:
        """Return the servos of an arm file with its settings, without torque.

        Args:
            config: Arm.
            clock: Clock of the servos.
            start: Joint values at first, see ``start_values``.
            seed: Seed of the random faults.

        Raises:
            ConfigError: ``start`` has another shape or is not finite.
        """
        values = start_values(config, start)
        make = VIRTUAL_FAMILIES[config.family.name].from_drive
        servos = [
            make(
                drive,
                clock,
                drive.joint.nearest_ticks(values[drive.name], drive.servo),
                config.baud,
            )
            for drive in config.drives
        ]
        bus = cls(servos, clock, seed)
        bus._built |= {joint.name: bus.servo(joint.servo.id) for joint in config.joints}
        return bus

    def servo(self, name: int | str) -> Any:
        """Return a servo by the id that it was built with, or the first servo of a joint.

        Raises:
            KeyError: There is no such servo.
        """
        if name not in self._built:
            raise KeyError(f"no servo {name!r}; there are {', '.join(map(str, self._built))}")
        return self._built[name]

    def reseed(self, seed: int) -> None:
        """Restart the random generator of the faults. The faults stay."""
        with self.lock:
            self.wire.reseed(seed)

    def inject(self, *faults: Fault) -> None:
        """Inject faults now, or at their time counted from now.

        Raises:
            KeyError: There is no such servo.
            KeyProblem: Servos of this family do not have the fault.
        """
        for fault in faults:
            fault.require_family(self.family)
        with self.lock:
            self._injected = [injected for injected in self._injected if not injected.over]
            for fault in faults:
                self._injected.append(Injected(fault, self))
        self._wake()

    def clear(self, kind: str | None = None) -> int:
        """Take back all faults, or those of one kind. Servos that shut down restart.

        The last fault is taken back first.

        Returns:
            Number of faults taken back.
        """
        with self.lock:
            chosen = [
                injected
                for injected in self._injected
                if not injected.over and kind in (None, injected.fault.kind)
            ]
            for injected in reversed(chosen):
                injected.end()
        self._wake()
        return len(chosen)

    def _wake(self) -> None:
        for wake in self._wakers:
            wake()

    def when_changed(self, wake: Callable[[], None]) -> None:
        """Call ``wake`` after every change of faults, to wake a sleeping thread."""
        self._wakers.append(wake)

    def another(self, id: int) -> Any:
        """Return a new servo like the first one of the bus. It is not added to the bus."""
        model = self.servos[0].table.model if self.servos else DEFAULT_MODEL
        baud = self.servos[0].baud if self.servos else DEFAULT_BAUD
        return VIRTUAL_FAMILIES[self.family].another(model, id, self.clock, baud)

    def add(self, servo: Any) -> None:
        """Add a servo to the wire. Its id may be in use."""
        with self.lock:
            self.servos = (*self.servos, servo)
            self._built.setdefault(servo.id, servo)

    def remove(self, servo: Any) -> None:
        """Remove a servo from the wire."""
        with self.lock:
            self.servos = tuple(s for s in self.servos if s is not servo)

    def true_angles(self, config: ArmConfig) -> Array:
        """Return the true joint values, (n,) rad, hidden offsets included.

        These are the values that a camera would see.
        """
        with self.lock:
            self.advance()
            return np.array(
                [
                    joint.value(
                        (-1 if joint.servo.reverse else 1) * self._built[joint.servo.id].true_ticks
                    )
                    for joint in config.joints
                ]
            )

    def advance(self) -> None:
        """Bring the world and the scheduled faults up to the present time."""
        with self.lock:
            self.schedule.run()
            if self.world is not None:
                self.world.advance(self.clock.now())

    def handle(self, data: bytes, baud: int | None = None) -> bytes:
        """Return the reply of ``respond`` without its delay."""
        return self.respond(data, baud)[0]

    def respond(self, data: bytes, baud: int | None = None) -> tuple[bytes, float]:
        """Take bytes from the host and return what the servos send.

        Args:
            data: Any part of any number of instruction packets.
            baud: Rate of the host, bit/s. Servos with another rate ignore the bytes. None: every
                servo receives them.

        Returns:
            Bytes of the reply, and the time that the servos waited before it in s.
        """
        with self.lock:
            self.advance()
            delay = 0.0
            replies = [data] if self.echo else []
            for packet in self._parser.feed(data, self.clock.now()):
                self.schedule.count()
                listeners = [
                    s for s in self.servos if not s.deaf and (baud is None or s.baud == baud)
                ]
                answer = self.side.execute(packet, listeners, self.wire.rng)
                delay += answer.delay
                replies += self.wire.carry(answer.packets, self.clock.now())
            return b"".join(replies), delay + (self.latency if replies else 0.0)


def start_values(
    config: ArmConfig, start: ArrayLike | Mapping[str, float] | None
) -> dict[str, float]:
    """Return the joint values of simulated servos at first: joint -> rad or m.

    Args:
        config: Arm.
        start: (n,) values of all joints, or of the joints that carry the tool; or joint -> value.
            By default 0 or the limit next to it, and the middle of the range for gripper joints.

    Raises:
        ConfigError: ``start`` has another shape or is not finite.
    """
    values = {
        joint.name: sum(joint.limits) / 2.0 if joint.group == GRIPPER else 0.0
        for joint in config.joints
    }
    if isinstance(start, Mapping):
        values |= start
    elif start is not None:
        q = np.asarray(start, dtype=float)
        names = {config.names, config.chain.names}
        given = next((joints for joints in names if q.shape == (len(joints),)), None)
        if given is None or not np.isfinite(q).all():
            counts = " or ".join(str(count) for count in sorted({len(joints) for joints in names}))
            raise config.wrong(f"start {q.tolist()} is no pose", "", f"{counts} angles, rad")
        values |= dict(zip(given, q.tolist(), strict=True))
    return {
        joint.name: min(max(values[joint.name], joint.limits[0]), joint.limits[1])
        for joint in config.joints
    }


def robot_of(config: ArmConfig) -> Robot | None:
    """Return the robot of an arm file with the arm's joints; None without its model."""
    from robot_ik.robot import load_robot

    try:
        return load_robot(config.robot_source, joints=config.chain.names)
    except RobotIkError:
        return None


def home_of(config: ArmConfig) -> dict[str, float] | None:
    """Return the home pose of that robot, joint -> rad or m; None without its model."""
    robot = robot_of(config)
    return None if robot is None else dict(zip(robot.joints, robot.home.tolist(), strict=True))
