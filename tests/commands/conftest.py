"""Runs of the command line: in this process, or in a child process."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from robot_ik.commands import terminal
from robot_ik.commands.main import main
from robot_ik.hardware import discovery
from robot_ik.workcell import vision
from tests.commands.reach_runs import arms, full_pictures, healthy, reach, seen_smaller
from tests.hardware.joints import with_servo

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.hardware.virtual.servo import VirtualServo

__all__ = ["arms", "full_pictures", "healthy", "reach"]

SCREEN = 25
"""Lines of a terminal, the prompt included."""
ANSI = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")


@dataclass(frozen=True)
class Run:
    """Result of one command line."""

    code: int
    out: str
    err: str

    def assert_one_screen_error(self, code: int = 2) -> None:
        """Check that stderr has a short text without traceback, and stdout nothing."""
        assert self.code == code, self
        assert self.out == "", self
        assert self.err.strip(), self
        assert "Traceback" not in self.err, self.err
        assert len(self.err.splitlines()) < SCREEN, self.err


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("COLUMNS", "ROBOT_IK_DEBUG", "FORCE_COLOR", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    # A busy machine must not change what a command prints.
    monkeypatch.setattr(terminal, "SILENCE_SECONDS", 600.0)


@pytest.fixture
def robot_ik(capsys: pytest.CaptureFixture[str]) -> Callable[..., Run]:
    """``robot_ik("solve", "--goal", …) -> Run``, in this process."""

    def run(*arguments: object) -> Run:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        output = capsys.readouterr()
        return Run(code, output.out, output.err)

    return run


@pytest.fixture
def robot_ik_child() -> Callable[..., Run]:
    """The same in a child process, with extra environment variables."""

    def run(*arguments: object, **variables: str) -> Run:
        done = subprocess.run(
            [sys.executable, "-m", "robot_ik", *map(str, arguments)],
            capture_output=True,
            text=True,
            env={**os.environ, **variables},
            stdin=subprocess.DEVNULL,
            check=False,
        )
        return Run(done.returncode, done.stdout, done.stderr)

    return run


_HEAD = """schema = 1
name = "three servos"
robot = "arm.xml"
"""
_JOINT = """
[[joints]]
name = "joint{k}"
id = {k}
model = "{model}"
mode = "{mode}"
direction = {direction}
zero_ticks = {zero}
ratio = {ratio}
lower_deg = -100.0
upper_deg = 100.0
velocity_deg = 300.0
acceleration_deg = 3000.0
"""
_ROWS = (
    ("XM430-W350", "position", 1, 2048, 1.0),
    ("XL430-W250", "extended_position", -1, 1000, 2.0),
    ("XL330-M288", "position", 1, 1800, 1.0),
)
#: The model of that arm: wider limits than its arm file.
_MODEL = """<mujoco><compiler angle="degree"/><worldbody>
<body><joint name="joint1" axis="0 0 1" range="-120 120"/><geom size="0.01"/>
<body pos="0 0 0.1"><joint name="joint2" axis="0 1 0" range="-110 110"/><geom size="0.01"/>
<body pos="0 0 0.1"><joint name="joint3" axis="0 1 0" range="-120 120"/><geom size="0.01"/>
<site name="tip" pos="0 0 0.1"/></body></body></body></worldbody></mujoco>
"""


@dataclass(frozen=True)
class Desk:
    """Three servos of different model, mode, direction, zero and ratio behind a port.

    Attributes:
        port: Path of the pty.
        arm: Path of the arm file. Its model is beside it.
        config: The arm file.
        bus: The simulated servos.
    """

    port: str
    arm: Path
    config: ArmConfig
    bus: VirtualBus

    @property
    def at(self) -> tuple[str, ...]:
        """Options that lead there."""
        return ("--bus", self.port, "--arm", str(self.arm))

    def servo(self, id: int) -> VirtualServo:
        return self.bus.servo(id)

    def turn(self, joint: str, degrees: float) -> None:
        """Turn a joint without torque by hand, at once."""
        row = self.config.joint(joint)
        with self.bus.lock:
            self.servo(row.servo.id).rotate_by_hand(math.radians(degrees) * row.ticks_per(0.0))

    def torque(self) -> list[bool]:
        with self.bus.lock:
            return [servo.torque for servo in self.bus.servos]


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    rows = [
        _JOINT.format(k=k, model=m, mode=mode, direction=d, zero=z, ratio=r)
        for k, (m, mode, d, z, r) in enumerate(_ROWS, 1)
    ]
    (tmp_path / "arm.xml").write_text(_MODEL, encoding="utf-8")
    path = tmp_path / "desk.toml"
    path.write_text(
        _HEAD.replace("arm.xml", str(tmp_path / "arm.xml")) + "".join(rows), encoding="utf-8"
    )
    return path


@pytest.fixture
def desk(arm_file: Path, real_time: None) -> Iterator[Desk]:
    """The servos of ``arm_file`` at q = 0 on a pty."""
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.hardware.virtual.pty import PtyPort
    from robot_ik.ports import RealClock

    config = ArmConfig.load(arm_file)
    bus = VirtualBus.from_config(config, RealClock())
    with PtyPort(bus, match_baud=True) as port:
        yield Desk(port.path, arm_file, config, bus)


Hand = Callable[[str, Callable[[], object]], None]


@pytest.fixture
def nominal(desk: Desk, tmp_path: Path) -> Path:
    """The arm file before calibration: zeros and directions are not measured."""
    joints = tuple(with_servo(j, direction=1, zero_ticks=2048) for j in desk.config.joints)
    path = tmp_path / "nominal.toml"
    replace(desk.config, joints=joints, file=None).save(path)
    return path


@pytest.fixture
def calibrate(
    robot_ik: Callable[..., Run],
    desk: Desk,
    nominal: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., Run]:
    """``calibrate(hand, options …)``: ``hand(step, sample)`` carries out the step."""
    from robot_ik.commands import servo_calibrate
    from robot_ik.workcell import hand_calibration

    def run(hand: Hand, *options: object) -> Run:
        class Scripted:
            def __init__(self, *options: object) -> None:
                pass

            def step(self, text: str, sample: Callable[[], object]) -> None:
                hand(text, sample)
                sample()

            def note(self, text: str) -> None:
                pass

            def again(self, error: Exception) -> bool:
                return False

        monkeypatch.setattr(servo_calibrate, "Prompts", Scripted)
        monkeypatch.setattr(hand_calibration, "STILL_SAMPLES", 2)
        arm = () if "--arm" in options else ("--arm", nominal)
        return robot_ik(
            "servo", "calibrate", tmp_path / "mine.toml", "--bus", desk.port, *arm, *options
        )

    return run


def _good_hand(desk: Desk, reach: float = 95.0, pose: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Hand:
    """Sweep each joint by ``reach`` degrees both ways, hold the pose, and turn each joint."""

    def hand(text: str, sample: Callable[[], object]) -> None:
        if text.startswith("1."):
            for joint in desk.config.names:
                for way in (*[reach / 2] * 2, *[-reach / 2] * 4, *[reach / 2] * 2):
                    desk.turn(joint, way)
                    sample()
        elif text.startswith("2."):
            for joint, degrees in zip(desk.config.names, pose, strict=True):
                desk.turn(joint, degrees)
        else:
            (joint,) = [name for name in desk.config.names if name in text]
            desk.turn(joint, 10.0)

    return hand


@pytest.fixture
def good_hand(desk: Desk) -> Callable[..., Hand]:
    """``good_hand(reach=…, pose=…)``: a hand that carries out every step of ``calibrate``."""
    return lambda **wishes: _good_hand(desk, **wishes)


@pytest.fixture
def mine(calibrate: Callable[..., Run], desk: Desk, tmp_path: Path) -> Path:
    """A calibrated arm."""
    assert calibrate(_good_hand(desk)).code == 0
    return tmp_path / "mine.toml"


@pytest.fixture(scope="module")
def light_pictures() -> Iterator[None]:
    """Pictures of half the size, for a test file that makes many."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vision, "scene_for", seen_smaller)
        yield


@pytest.fixture
def quick_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scan 20 ids, and wait for replies no longer than simulated servos need."""
    monkeypatch.setattr(discovery.SerialBus, "listening_time", 0.03)
    monkeypatch.setattr(discovery, "RESPONSE_TIME", 0.006)
    monkeypatch.setattr(discovery, "IDS", range(20))


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """``ports("/dev/…", …)`` sets the serial ports of this machine."""
    from serial.tools import list_ports

    def set_ports(*names: str) -> None:
        rows = [
            SimpleNamespace(
                device=name, description="U2D2", vid=0x0403, pid=0x6014, serial_number="FT1"
            )
            for name in names
        ]
        monkeypatch.setattr(list_ports, "comports", lambda: rows)

    return set_ports
