"""The bus on a port: ports that cannot be opened, pulled cables, transactions cut short."""

from __future__ import annotations

import errno
import os
import select
import subprocess
import sys
import threading
import time
import tty
from types import SimpleNamespace

import pytest
from serial.tools import list_ports

from robot_ik.errors import BusCorruptError, BusDisconnectedError, BusNotOpenError, BusTimeoutError
from robot_ik.hardware import serial_bus
from robot_ik.hardware.dynamixel import DynamixelBus
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.serial_port import describe_failure
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.protocol import Parser, build_status
from robot_ik.hardware.virtual.pty import PtyPort
from robot_ik.ports import RealClock

XM = X_TABLES["XM430-W350"]
POSITION = XM["present_position"]
pytestmark = pytest.mark.usefixtures("real_time")


@pytest.fixture
def served(arm_config):
    with PtyPort(VirtualBus.from_config(arm_config, RealClock())) as port:
        yield port


@pytest.fixture
def bus(served):
    bus = DynamixelBus(served.path)
    bus.open()
    yield bus
    bus.close()


class Scripted:
    """The other end of a pty. It answers each instruction with bytes (and pauses) of a script."""

    def __init__(self, script):
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self._slave = slave
        self._script = iter(script)
        self._stop = threading.Event()
        self.requests = []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        parser = Parser()
        while not self._stop.is_set():
            if not select.select([self.master], [], [], 0.02)[0]:
                continue
            for packet in parser.feed(os.read(self.master, 1024), time.monotonic()):
                self.requests.append(packet)
                for piece in next(self._script, []):
                    if isinstance(piece, float):
                        time.sleep(piece)
                    else:
                        os.write(self.master, piece)

    def close(self):
        self._stop.set()
        self._thread.join()
        os.close(self.master)
        os.close(self._slave)


@pytest.fixture
def scripted():
    opened = []

    def make(*script, **options):
        end = Scripted(script)
        bus = DynamixelBus(end.path, **options)
        bus.open()
        opened.append((bus, end))
        return bus, end

    yield make
    for bus, end in opened:
        bus.close()
        end.close()


def int32(value: int) -> bytes:
    return value.to_bytes(4, "little", signed=True)


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("/dev/no_such_port", "no such port"),
        ("/etc/hostname", "not a serial port"),
        ("/dev", "not a serial port"),
        ("/dev/null", "not a serial port"),
    ],
)
def test_what_is_not_a_serial_port_is_named(path, reason):
    with pytest.raises(BusNotOpenError) as caught:
        DynamixelBus(path).open()
    assert path in str(caught.value) and reason in str(caught.value)
    assert "--bus sim or pty" in caught.value.hint


def test_the_second_opener_is_refused(served, bus):
    second = DynamixelBus(served.path)
    with pytest.raises(BusNotOpenError, match="already open"):
        second.open()
    assert bus.ping(1) == XM.number  # and the first is not disturbed
    bus.close()
    second.open()
    second.close()


def test_another_process_is_refused_as_well(served, bus):
    code = """
import sys
from robot_ik.errors import BusNotOpenError
from robot_ik.hardware.dynamixel import DynamixelBus
try:
    DynamixelBus(sys.argv[1]).open()
except BusNotOpenError as error:
    print(error)
    sys.exit(7 if "already open" in str(error) else 1)
"""
    done = subprocess.run([sys.executable, "-c", code, served.path], capture_output=True, text=True)
    assert done.returncode == 7
    if sys.platform == "linux":
        assert f"(process {os.getpid()})" in done.stdout  # by name: which program to close


def test_permission_is_explained_and_the_ports_there_are_listed(monkeypatch):
    ports = [SimpleNamespace(device="/dev/ttyUSB0", description="U2D2")]
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    error = describe_failure("/dev/ttyUSB1", PermissionError(errno.EACCES, "denied"))
    assert (
        "may not open" in str(error)
        and "dialout" in error.hint
        and "/dev/ttyUSB0 (U2D2)" in error.hint
    )
    ports.clear()
    assert (
        "no serial port on this machine"
        in describe_failure("x", FileNotFoundError(errno.ENOENT, "")).hint
    )


@pytest.mark.parametrize("baud", [57_600, 1_000_000, 4_000_000, 4_500_000])
def test_every_rate_of_a_servo_can_be_set_even_those_the_sdk_does_not_know(served, baud):
    bus = DynamixelBus(served.path, baud)
    bus.open()
    try:
        assert bus.ping(1) == XM.number and served.client_baud() == baud
    finally:
        bus.close()


def test_an_impossible_rate_lists_the_possible_ones(served):
    with pytest.raises(BusNotOpenError, match="57600"):
        DynamixelBus(served.path, 123).open()


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x01\x02\x03", b"\x01\x02\x03\x04\x05"])
def test_an_answer_of_the_wrong_length_is_never_decoded(scripted, data):
    bus, _ = scripted(*[[build_status(1, 0, data)]] * 3)
    with pytest.raises(BusCorruptError):
        bus.read(1, POSITION)
    assert bus.counters.corrupt == 3 and bus.counters.retries == 2


def test_a_short_answer_in_a_sync_read_costs_one_servo_one_try(scripted):
    bus, end = scripted(
        [build_status(1, 0, int32(-5)), build_status(2, 0, b"\x01\x02")],
        [build_status(2, 0, int32(70))],
    )
    answers = bus.sync_read([1, 2], POSITION)
    assert (answers[1].data, answers[2].data) == (-5, 70)
    assert end.requests[1].params[4:] == bytes([2])  # only the missing servo is asked again


def test_wrong_id_duplicate_and_garbage_are_passed_over(scripted):
    good = build_status(1, 0, int32(42))
    bus, _ = scripted(
        [b"\xff\xff\x00noise", build_status(9, 0, int32(1)), good, good, b"\xff\xff\xfd"], [good]
    )
    assert bus.read(1, POSITION).data == 42
    assert bus.read(1, POSITION).data == 42


def test_answers_out_of_order_go_to_their_own_servo(scripted):
    bus, _ = scripted([build_status(2, 0x80, int32(2)), build_status(1, 0, int32(1))])
    answers = bus.sync_read([1, 2], POSITION)
    assert (answers[1].data, answers[1].alert, answers[2].data, answers[2].alert) == (
        1,
        False,
        2,
        True,
    )


def test_a_late_answer_is_never_taken_for_that_of_another_question(scripted):
    late = [0.05, build_status(1, 0, int32(111))]  # 50 ms: after the 34 ms a servo has
    bus, end = scripted(late, [build_status(1, 0, int32(222))], retries=0)
    with pytest.raises(BusTimeoutError):
        bus.read(1, POSITION)
    assert bus.read(1, XM["goal_position"]).data == 222
    assert len(end.requests) == 2


def test_waiting_for_a_silent_servo_sleeps(bus):
    begin = time.monotonic()
    cpu = time.process_time()
    for _ in range(4):
        with pytest.raises(BusTimeoutError):
            bus.ping(99)
    waited = time.monotonic() - begin
    used = time.process_time() - cpu
    assert waited > 0.3 and used < 0.5 * waited  # the SDK alone would use all of it


def test_one_dead_servo_slows_the_cycle_only_until_it_is_known(arm_config, served, bus):
    served.bus.servo(1).silent = True
    first = bus.sync_read(arm_config.servo_ids, POSITION)
    assert [id for id, s in first.items() if s.data is None] == [1]
    retries = bus.counters.retries
    assert 1 <= retries <= 2  # bounded by number and by the time of a cycle
    bus.sync_read(arm_config.servo_ids, POSITION)
    assert bus.counters.retries == retries
    served.bus.servo(1).silent = False
    assert bus.sync_read(arm_config.servo_ids, POSITION)[1].data is not None


def test_a_pulled_cable_is_reported_at_once_and_closing_is_quiet(served, bus, arm_config):
    bus.ping(1)
    served.close()
    with pytest.raises(BusDisconnectedError, match="went away"):
        bus.sync_read(arm_config.servo_ids, POSITION)
    assert not bus.is_open
    bus.close()


def test_a_cable_pulled_while_waiting_wakes_the_reader(monkeypatch):
    monkeypatch.setattr(serial_bus, "RESPONSE_TIME", 5.0)
    master, slave = os.openpty()
    tty.setraw(slave)
    bus = DynamixelBus(os.ttyname(slave))
    bus.open()
    os.close(slave)
    puller = threading.Timer(0.2, os.close, [master])
    puller.start()
    begin = time.monotonic()
    with pytest.raises(BusDisconnectedError):
        bus.ping(1)
    assert time.monotonic() - begin < 4.0
    puller.join()


class Interrupt(BaseException):
    """As KeyboardInterrupt, but not taken by pytest for the user's."""


@pytest.mark.parametrize("method", ["writePort", "receive", "clear"])
def test_an_exception_anywhere_in_a_transaction_leaves_the_port_usable(bus, method, monkeypatch):
    handler = bus._handler
    original = getattr(handler, method)
    hit = []

    def once(*arguments):
        if not hit:
            hit.append(True)
            raise Interrupt
        return original(*arguments)

    monkeypatch.setattr(handler, method, once)
    for action in (lambda: bus.read(99 if method == "isPacketTimeout" else 2, POSITION),):
        with pytest.raises(Interrupt):
            action()
    assert not handler.is_using  # or the next packet, torque off perhaps, would be dropped
    bus.write(2, XM["torque_enable"], 1)
    bus.write(2, XM["torque_enable"], 0)
    assert bus.read(2, XM["torque_enable"]).data == 0
    assert not handler.is_using


def test_an_interrupted_read_does_not_answer_the_next_question(bus, served, monkeypatch):
    served.bus.servo(1).memory.set("profile_velocity", 7)
    handler = bus._handler
    with monkeypatch.context() as cut, pytest.raises(Interrupt):
        cut.setattr(handler, "receive", lambda *a: (_ for _ in ()).throw(Interrupt()))
        bus.read(1, POSITION)
    assert bus.read(1, XM["profile_velocity"]).data == 7
