"""pytest fixtures for tests of robot programs: an arm, its simulated servos, and their faults.

pytest finds this module wherever robot_ik is installed (entry point ``pytest11``). Nothing is
imported before a test uses a fixture. To test another arm, override ``virtual_arm_config``.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.hardware.virtual.faults import FaultFile
    from robot_ik.robot_arm import RobotArm


@pytest.fixture
def virtual_arm_config() -> ArmConfig:
    """Arm file of the desk arm. To test another arm, define a fixture of this name."""
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.robot_file import SERVO_ROBOT, catalogue

    return ArmConfig.load(catalogue()[SERVO_ROBOT] / "arm.toml")


@pytest.fixture
def virtual_arm_start(virtual_arm_config: ArmConfig) -> dict[str, float] | None:
    """Initial joint values by name, rad or m: the robot's home, or zeros without its model."""
    from robot_ik.hardware.virtual.bus import home_of

    return home_of(virtual_arm_config)


@pytest.fixture
def virtual_bus(
    request: pytest.FixtureRequest,
    virtual_arm_config: ArmConfig,
    virtual_arm_start: dict[str, float] | None,
) -> VirtualBus:
    """Simulated servos with registers, shafts and faults.

    Their time is virtual: it passes only during a sleep on ``virtual_bus.clock``. In a test that
    uses ``virtual_port`` their time is real.
    """
    from robot_ik.hardware import simulated_servos
    from robot_ik.ports import RealClock, VirtualClock

    clock = RealClock() if "virtual_port" in request.fixturenames else VirtualClock()
    return simulated_servos(virtual_arm_config, clock, virtual_arm_start)


@pytest.fixture
def virtual_robot(virtual_arm_config: ArmConfig, virtual_bus: VirtualBus) -> Iterator[RobotArm]:
    """A robot and its enabled arm on the simulated servos.

    The end of the test applies the exit policy of the arm file.
    """
    from robot_ik.robot_arm import open_robot

    config = virtual_arm_config
    with open_robot(config.robot_source, config, "sim", virtual_bus=virtual_bus) as opened:
        opened.enable()
        yield opened


@pytest.fixture
def virtual_arm(
    request: pytest.FixtureRequest, virtual_arm_config: ArmConfig, virtual_bus: VirtualBus
) -> Iterator[Arm]:
    """The arm of ``virtual_robot``; without that fixture, an arm that needs no model."""
    from robot_ik.hardware import open_arm

    if "virtual_robot" in request.fixturenames:
        yield request.getfixturevalue("virtual_robot").arm
        return
    with open_arm(virtual_arm_config, "sim", virtual_bus=virtual_bus) as arm:
        arm.enable()
        yield arm


@pytest.fixture
def virtual_port(virtual_bus: VirtualBus) -> Iterator[str]:
    """Path of a serial port with the simulated servos, for programs in any language.

    The test is skipped on systems without pseudo terminals (Windows).
    """
    try:
        from robot_ik.hardware.virtual.pty import PtyPort
    except ImportError as reason:
        pytest.skip(f"this system has no pseudo terminals ({reason})")
    with PtyPort(virtual_bus) as port:
        yield str(port.path)


class FaultPlayer:
    """Injects faults into the servos of a test. Times count from the call."""

    def __init__(self, config: ArmConfig, bus: VirtualBus) -> None:
        self._config = config
        self._bus = bus

    def __call__(self, source: str | Path) -> FaultFile:
        """Play a file of faults, or its text.

        Raises:
            ConfigError: It cannot be read, or a key is unknown, missing or out of range.
        """
        from robot_ik.hardware.virtual.faults import load_faults, parse_faults

        text = isinstance(source, str) and "\n" in source
        loaded = (
            parse_faults(str(source), self._config) if text else load_faults(source, self._config)
        )
        self._bus.reseed(loaded.seed)
        self._bus.inject(*loaded.faults)
        return loaded

    def inject(
        self,
        kind: str,
        joint: str | None = None,
        *,
        id: int | None = None,
        value: float | None = None,
        in_s: float = 0.0,
        for_s: float | None = None,
    ) -> None:
        """Inject one fault of the virtual bus, in ``in_s`` seconds, for ``for_s`` or forever.

        Raises:
            ConfigError: The kind, the joint or the value does not exist.
        """
        from robot_ik.hardware.virtual.faults import make_fault

        fault = make_fault(
            self._config,
            "fault_script",
            kind=kind,
            joint=joint,
            id=id,
            value=value,
            at_s=in_s,
            for_s=for_s,
        )
        self._bus.inject(fault)

    def clear(self, kind: str | None = None) -> int:
        """Clear all faults, or those of one kind, and return their number.

        Servos that shut down restart.
        """
        return self._bus.clear(kind)


@pytest.fixture
def fault_script(virtual_arm_config: ArmConfig, virtual_bus: VirtualBus) -> FaultPlayer:
    """Player of faults: ``fault_script(file)``, ``.inject(kind, joint)`` and ``.clear()``."""
    return FaultPlayer(virtual_arm_config, virtual_bus)
