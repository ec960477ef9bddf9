"""Arms, buses and servos for the hardware tests, and functions as fixtures."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import HardwareError
from robot_ik.hardware import BUSES, open_arm
from robot_ik.hardware.arm import Arm, ArmState
from robot_ik.hardware.bus import BusStatus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.registers import Register
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.electrics import Load
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.protocol import ErrorCode, Packet, Parser
from robot_ik.hardware.virtual.pty import PtyPort
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import RealClock, VirtualClock

Array = NDArray[np.float64]

_HEAD = """schema = 1
name = "six X servos"
robot = "puma560"

[bus]
baud = 1_000_000
rate_hz = 100
watchdog_ms = 200
on_exit = "torque_off"
"""

_JOINT = """
[[joints]]
name = "joint{k}"
id = {k}
model = "{model}"
mode = "extended_position"
direction = {direction}
zero_ticks = {zero}
ratio = {ratio}
lower_deg = -160.0
upper_deg = 160.0
velocity_deg = 90.0
acceleration_deg = 360.0
"""


def arm_text() -> str:
    """Six joints that differ in model, direction, zero and ratio, so that a mix-up shows."""
    rows = [
        ("XM430-W350", 1, 2048, 1.0),
        ("XM430-W350", -1, 1024, 1.0),
        ("XM430-W350", 1, 2048, 2.0),
        ("XL430-W250", -1, 3000, 1.0),
        ("XL430-W250", 1, 2048, 1.0),
        ("XM430-W350", 1, 100, 1.5),
    ]
    joints = [
        _JOINT.format(k=k, model=m, direction=d, zero=z, ratio=r)
        for k, (m, d, z, r) in enumerate(rows, 1)
    ]
    return _HEAD + "".join(joints)


@pytest.fixture
def arm_toml() -> str:
    """Text of a correct arm file."""
    return arm_text()


@pytest.fixture
def arm_path(tmp_path: Path, arm_toml: str) -> Path:
    """A correct arm file."""
    path = tmp_path / "arm.toml"
    path.write_text(arm_toml, encoding="utf-8")
    return path


@pytest.fixture
def arm_config(arm_path: Path) -> ArmConfig:
    """Six joints that differ in model, direction, zero and ratio."""
    return ArmConfig.load(arm_path)


_DT = 0.01


@pytest.fixture
def start() -> Array:
    """(6,) rad, where the arms of these tests stand at first."""
    return np.array([0.1, 0.2, 0.3, -0.4, 0.5, 0.6])


@pytest.fixture(params=[row.name for row in BUSES.values() if row.virtual])
def any_arm(
    request: pytest.FixtureRequest, arm_config: ArmConfig, start: Array, real_time: None
) -> Iterator[Arm]:
    """On each of the buses that need no hardware."""
    with open_arm(arm_config, request.param, start=start) as arm:
        yield arm


@pytest.fixture
def arm(arm_config: ArmConfig, start: Array) -> Iterator[Arm]:
    """In process, on virtual time."""
    with open_arm(arm_config, "sim", start=start) as arm:
        yield arm


@pytest.fixture(scope="session")
def dt() -> float:
    """Seconds from one command of ``stream`` to the next."""
    return _DT


@pytest.fixture(scope="session")
def registers() -> Callable[[Arm, str], list[int]]:
    """A register of every servo, straight from its memory: not over the bus under test."""

    def registers(arm: Arm, name: str) -> list[int]:
        return [servo.memory.values[name] for servo in arm.bus.virtual_bus.servos]

    return registers


@pytest.fixture(scope="session")
def stream() -> Callable[[Arm, Iterable[object]], None]:
    """Sends commands one by one, each at its time."""

    def stream(arm: Arm, commands: Iterable[object]) -> None:
        begin = arm.clock.now()
        for k, q in enumerate(commands):
            now = begin + (k + 1) * _DT
            arm.clock.sleep_until(now)
            arm.send(q, now)

    return stream


@pytest.fixture(scope="session")
def smooth() -> Callable[[Array, ArrayLike, float], Array]:
    """A quintic from rest to rest: another motion law than anything in the arm."""

    def smooth(start: Array, end: ArrayLike, seconds: float) -> Array:
        s = np.linspace(0, 1, round(seconds / _DT))
        return start + np.outer(10 * s**3 - 15 * s**4 + 6 * s**5, np.asarray(end) - start)

    return smooth


@pytest.fixture(scope="session")
def enable_fails() -> Callable[[Arm], None]:
    """``enable`` of an arm whose servos get torque and are not heard for a moment then."""

    def enable_fails(arm: Arm) -> None:
        original = arm.bus.sync_write
        begun = []

        def then_silent(register: Register, values: Mapping[int, int]) -> None:
            original(register, values)
            if register.name == "torque_enable" and any(values.values()):
                begun.append(True)

        read = arm.bus.sync_read

        def unheard(ids: Collection[int], register: Register) -> dict[int, BusStatus]:
            if begun and register.name == "present_position":
                raise HardwareError("nothing is heard")
            return read(ids, register)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(arm.bus, "sync_write", then_silent)
            patch.setattr(arm.bus, "sync_read", unheard)
            with pytest.raises(HardwareError, match="nothing is heard"):
                arm.enable()
        assert begun

    return enable_fails


class Bench:
    """One servo, its clock, and access to registers by name through the checked way."""

    V_UNIT = 0.229 * 4096 / 60  # ticks/s

    def __init__(
        self, model: str = "XM430-W350", load: Load | None = None, **options: object
    ) -> None:
        self.clock = VirtualClock(start=12.0)
        self.servo = VirtualServo(model, 1, self.clock, **options)  # type: ignore[arg-type]
        if load is not None:
            self.servo.shaft.load = load

    def wait(self, seconds: float) -> None:
        self.clock.sleep_until(self.clock.now() + seconds)

    def write(self, name: str, value: int) -> ErrorCode:
        self.servo.hear()
        register = self.servo.table[name]
        return self.servo.write(register.address, register.encode(value))

    def read(self, name: str) -> int:
        register = self.servo.table[name]
        data, error = self.servo.read(register.address, register.size)
        assert error == ErrorCode.NONE
        return register.decode(data)

    def set(self, **values: int) -> None:
        for name, value in values.items():
            assert self.write(name, value) == ErrorCode.NONE, name


@pytest.fixture(scope="session")
def make_bench() -> Callable[..., Bench]:
    """``make_bench(model, ...)``: one servo by itself, with its own clock."""
    return Bench


@pytest.fixture
def clock() -> VirtualClock:
    """Shafts move when the test says so."""
    return VirtualClock()


@pytest.fixture
def bus(clock: VirtualClock) -> VirtualBus:
    """Ids 1..3 at 100, 200, 300 ticks; ids are not in order on the wire."""
    return VirtualBus(
        [VirtualServo("XM430-W350", id, clock, position_ticks=100 * id) for id in (3, 1, 2)], clock
    )


@pytest.fixture
def arm_bus(arm_config: ArmConfig, clock: VirtualClock) -> VirtualBus:
    """The servos of the arm file."""
    return VirtualBus.from_config(arm_config, clock)


@pytest.fixture
def sim(arm_bus: VirtualBus) -> SimBus:
    """The same servos, asked in process."""
    sim = SimBus(arm_bus)
    sim.open()
    return sim


@pytest.fixture
def pty(arm_bus: VirtualBus, real_time: None) -> Iterator[PtyPort]:
    """The same servos behind a serial port."""
    with PtyPort(arm_bus) as port:
        yield port


@pytest.fixture(scope="session")
def parse() -> Callable[[bytes], list[Packet]]:
    """The packets in some bytes."""
    return lambda reply: Parser().feed(reply, 0.0)


class Lab:
    """An arm file with everything that the rows need."""

    def __init__(
        self, config: ArmConfig, start: Array, stream: Any, smooth: Any, registers: Any
    ) -> None:
        self.config = config
        self.start = start
        self.stream = stream
        self.smooth = smooth
        self.registers = registers

    def arm(self, *before: Fault, on: str = "sim", config=None, start=None) -> Arm:
        config = config or self.config
        start = self.start if start is None else start
        bus = VirtualBus.from_config(
            config, VirtualClock() if on == "sim" else RealClock(), start=start
        )
        bus.inject(*before)
        return open_arm(config, on, virtual_bus=bus)

    def drive(self, arm: Arm, cycles: int = 3) -> None:
        self.stream(arm, [self.start] * cycles)

    def fault(self, arm: Arm, error: type[HardwareError], *faults: Fault) -> HardwareError:
        """Enables, injects in the middle of a motion, and gives what is reported to the program."""
        arm.enable()
        self.drive(arm)
        arm.bus.virtual_bus.inject(*faults)
        with pytest.raises(error) as caught:
            self.stream(arm, self.smooth(self.start, self.start + 0.2, 1.0))
        return caught.value

    def torque(self, arm: Arm) -> list[bool]:
        return [servo.torque for servo in arm.bus.virtual_bus.servos]

    def follows_a_bad_wire(
        self, cycles: int = 120, fresh: float = 0.9, *, echo: bool = False, **chances: float
    ) -> Arm:
        """Every measured value is true, and no joint lags, with every fault of the wire."""
        with self.arm() as arm:
            arm.enable()
            arm.bus.virtual_bus.inject(
                *(Fault(kind, value=chance) for kind, chance in chances.items())
            )
            arm.bus.virtual_bus.inject(*([Fault("echo")] if echo else []))
            complete = 0
            for q in self.smooth(self.start, self.start + 0.4, cycles / 100):
                self.stream(arm, [q])
                measured = arm.read().q
                true = arm.bus.virtual_bus.true_angles(self.config)
                assert (np.abs(measured - true) <= arm.resolution + 3.0 * arm.ages).all()
                assert np.abs(true - q).max() < 0.05
                complete += arm.ages.max() == 0.0
            assert complete >= fresh * cycles and arm.state is ArmState.ENABLED
            arm.bus.virtual_bus.clear()
        assert arm.exit_report.ok
        return arm


@pytest.fixture
def lab(arm_config: ArmConfig, start: Array, stream: Any, smooth: Any, registers: Any) -> Lab:
    return Lab(arm_config, start, stream, smooth, registers)
