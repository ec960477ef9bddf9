"""The driver on Windows and macOS, with simulated ports, errors and signals."""

from __future__ import annotations

import errno
import importlib.util
import signal
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import serial
from serial.tools import list_ports

from robot_ik import signals
from robot_ik.commands.arms import open_port
from robot_ik.errors import BusNotOpenError
from robot_ik.hardware import open_bus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.dynamixel import DynamixelBus
from robot_ik.hardware.ports import port_row, serial_ports, serial_row
from robot_ik.hardware.serial_port import SleepingPortHandler, describe_failure
from robot_ik.hardware.virtual.bus import VirtualBus

WINDOWS = "win32"
MAC = "darwin"


def listed(device: str, about: str = "USB Serial Port", vid: int | None = 0x0403) -> Any:
    return SimpleNamespace(
        device=device, description=about, vid=vid, pid=0x6014, serial_number="FT1"
    )


def names_of(ports: list[Any], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    return [port.device for port in serial_ports()]


def test_ports_of_windows_and_mac_are_listed_without_those_of_the_board(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert names_of([listed("COM10"), listed("COM3")], monkeypatch) == ["COM3", "COM10"]
    mac = ["usbserial-FT1", "Bluetooth-Incoming-Port", "debug-console", "wlan-debug", "usbmodem1"]
    assert names_of([listed(f"/dev/cu.{name}") for name in mac], monkeypatch) == [
        "/dev/cu.usbmodem1",
        "/dev/cu.usbserial-FT1",
    ]


def test_a_windows_port_is_no_file_and_its_latency_is_set_in_the_device_manager(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "platform", WINDOWS)
    row = port_row(listed("COM3"))
    known = {
        "usb": "0403:6014",
        "serial": "FT1",
        "stable": "",
        "latency_ms": None,
        "status": "note",
    }
    assert row.items() >= known.items()
    assert "Device Manager" in row["do"] and "permission" not in row["do"]
    quiet = port_row(listed("COM4", vid=0x1A86))
    assert quiet["status"] == "ok" and quiet["do"] == ""


def test_a_mac_port_may_be_forbidden_and_its_latency_is_the_drivers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", MAC)
    port = tmp_path / "cu.usbserial-FT1"
    port.touch()
    row = serial_row(str(port), "USB", vendor=0x0403)
    assert "16 ms" in row.found and "VCP" in row.do
    gone = serial_row(str(tmp_path / "cu.other"), "USB")
    assert "no permission" in gone.found


def windows_error(name: str, number: int, text: str) -> serial.SerialException:
    """Return pyserial's error on Windows, whose reason is in its text only."""
    return serial.SerialException(
        f"could not open port 'COM3': {name}({number}, '{text}', None, 5)"
    )


def test_a_port_in_use_is_refused_with_the_name_of_its_user_on_every_system(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(list_ports, "comports", lambda: [listed("COM3")])
    errors = {
        WINDOWS: windows_error("PermissionError", 13, "Access is denied."),
        MAC: serial.SerialException(
            errno.EBUSY, "could not open port /dev/cu.usbserial: Resource busy"
        ),
        "linux": serial.SerialException("Could not exclusively lock port /dev/ttyUSB0: [Errno 11]"),
    }
    for system, error in errors.items():
        monkeypatch.setattr(sys, "platform", system)
        failure = describe_failure("COM3", error)
        assert str(failure.args[0]).startswith("cannot open COM3: it is already open")
        assert "close the other program first" in failure.hint and "COM3 (USB" in failure.hint


def test_missing_and_forbidden_ports_differ_from_a_port_in_use(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "platform", WINDOWS)
    gone = windows_error("FileNotFoundError", 2, "The system cannot find the file specified.")
    assert "no such port" in str(describe_failure("COM9", gone))
    denied = PermissionError(errno.EACCES, "Permission denied")
    monkeypatch.setattr(sys, "platform", "linux")
    assert "dialout" in describe_failure("/dev/ttyUSB0", denied).hint
    monkeypatch.setattr(sys, "platform", MAC)
    mac = describe_failure("/dev/tty.usb", denied).hint
    assert "/dev/cu." in mac and "dialout" not in mac


class WindowsPort:
    """A ``serial.Serial`` without a file: bytes go to virtual servos and come back."""

    def __init__(self, bus: VirtualBus, **options: Any) -> None:
        self.options = options
        self._bus = bus
        self._data = b""

    @property
    def in_waiting(self) -> int:
        return len(self._data)

    def read(self, size: int) -> bytes:
        data = self._data[:size]
        self._data = self._data[size:]
        return data

    def write(self, data: bytes) -> int:
        self._data += self._bus.handle(bytes(data))
        return len(data)

    def reset_input_buffer(self) -> None:
        self._data = b""

    def close(self) -> None:
        self.options = {}


def test_the_driver_works_on_a_port_that_is_no_file(
    bus: VirtualBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[WindowsPort] = []

    def make_serial(**options: Any) -> WindowsPort:
        made.append(WindowsPort(bus, **options))
        return made[-1]

    class WindowsBus(DynamixelBus):
        def _make_handler(self) -> SleepingPortHandler:
            return SleepingPortHandler(self.port, self.baud, self.counters, posix=False)

    monkeypatch.setattr(serial, "Serial", make_serial)
    driver = WindowsBus("COM3")
    driver.open()
    assert (
        made[0].options["port"] == "COM3" and made[0].options["exclusive"] is None
    )  # the system's own affair
    assert 0 < made[0].options["timeout"] < 0.01  # it sleeps while it waits
    assert driver.ping(2) == 1020
    present = bus.servo(1).table["present_position"]
    assert driver.read(3, present).data == 300
    driver.use_fast_reads((1, 2, 3))
    goal = bus.servo(1).table["goal_position"]
    goals = dict.fromkeys((1, 2, 3), 5)
    replies = driver.exchange(goal, goals, dict.fromkeys((1, 2, 3), present))
    assert [s.data for s in replies.values()] == [100, 200, 300]
    driver.close()
    assert made[0].options == {}


@pytest.fixture
def without_pty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "robot_ik.hardware.virtual.pty", raising=False)
    monkeypatch.setitem(sys.modules, "fcntl", None)


def test_without_pseudo_terminals_the_bus_pty_names_sim(
    without_pty: None, arm_config: ArmConfig
) -> None:
    with pytest.raises(BusNotOpenError, match="no pseudo terminals") as caught:
        open_bus("pty", arm_config)
    assert "--bus sim" in caught.value.hint
    with (
        pytest.raises(BusNotOpenError, match="no pseudo terminals"),
        open_port("pty", "tabletop_puma"),
    ):
        pass
    open_bus("sim", arm_config).close()


def test_signals_are_those_that_the_system_has(monkeypatch: pytest.MonkeyPatch) -> None:
    if sys.platform != "win32":
        assert signals.SIGNALS == (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    monkeypatch.delattr(signal, "SIGHUP", raising=False)
    monkeypatch.setattr(signal, "SIGBREAK", 21, raising=False)
    spec = importlib.util.find_spec("robot_ik.signals")
    assert spec is not None and spec.loader is not None
    windows = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(windows)
    assert windows.SIGNALS == (signal.SIGINT, signal.SIGTERM, 21)


@pytest.mark.parametrize(
    ("system", "folder"), [(WINDOWS, "AppData/Local"), (MAC, "Library/Caches")]
)
def test_what_is_compiled_is_kept_where_the_system_keeps_such(
    system: str, folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from robot_ik.kernels import jit

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    monkeypatch.setattr(jit, "sys", SimpleNamespace(platform=system))
    assert jit._user_cache() == Path.home() / folder
