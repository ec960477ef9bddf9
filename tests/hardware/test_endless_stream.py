"""Bytes come without end: every call returns in time and memory stays bounded."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
import tracemalloc
import tty
from collections.abc import Callable, Iterator
from typing import NamedTuple

import pytest

from robot_ik.errors import HardwareError
from robot_ik.hardware import packets
from robot_ik.hardware.bus import BROADCAST_ID, Counters
from robot_ik.hardware.family import family_of
from robot_ik.hardware.models import control_table
from robot_ik.hardware.packets import FastParser, StatusParser
from robot_ik.hardware.registers import Register
from robot_ik.hardware.serial_bus import CYCLE_TIME, SerialBus
from robot_ik.hardware.serial_port import LONGEST_DRAIN, RESPONSE_TIME, SleepingPortHandler
from robot_ik.hardware.virtual import protocol1
from robot_ik.hardware.virtual.protocol import build_status

MODELS = {"dynamixel_x": "XM430-W350", "feetech_sts": "STS3215"}
"""Family -> model whose registers are read."""

BAUD = 1_000_000
IDS = range(1, 7)

MARGIN = 0.3
"""s that a busy machine may add."""

STREAMS = {
    "no header": b"\x55\x00\xaa" * 300,
    "only 0xff": b"\xff" * 1000,
    "headers of long packets": (b"\xff\xff\xfd\x00\x01\x00\x04\x55") * 100,
    "headers that are no status": (b"\xff\xff\xfd\x00\x01\x04\x00\x02") * 100,
    "another servo's replies": build_status(99, 0, b"\x01\x02\x03\x04") * 60,
    "its own replies, damaged": (build_status(1, 0, b"\x01\x02\x03\x04")[:-1] + b"\x00") * 60,
}

STS_STREAMS = {
    "only 0xff": b"\xff" * 1000,
    "headers of long packets": b"\xff\xff\x01\xfa\x00" * 100,
    "headers that are no status": b"\xff\xff\x01\x00\x02" * 100,
    "another servo's replies": protocol1.build_status(99, 0, b"\x01\x02") * 60,
    "its own replies, damaged": (protocol1.build_status(1, 0, b"\x01\x02")[:-1] + b"\x00") * 60,
}

FAMILY_STREAMS = {"dynamixel_x": STREAMS, "feetech_sts": STS_STREAMS}

_TALKER = """
import os, select, sys
file, text = int(sys.argv[1]), bytes.fromhex(sys.argv[2])
os.set_blocking(file, False)
while True:
    try:
        os.write(file, text)
    except BlockingIOError:
        select.select([], [file], [], 0.01)
    try:
        os.read(file, 4096)  # what the bus sends is taken: the port is not full
    except BlockingIOError:
        pass
"""


SLOWER = ("no header", "headers that are no status", "another servo's replies")
"""Streams that the soak adds for all calls. The parsers are tried with every stream."""


class Line(NamedTuple):
    """A line on which another process writes as fast as it can.

    Attributes:
        path: Name of the port.
        family: Servo family whose packets the stream resembles.
    """

    path: str
    family: str

    def bus(self) -> SerialBus:
        """Return a closed bus on this line."""
        return SerialBus(self.path, BAUD, family_of(self.family).protocol)

    def register(self, name: str) -> Register:
        """Return a register of the family's servos."""
        return control_table(MODELS[self.family])[name]


@pytest.fixture(
    params=[
        pytest.param(
            (family, name), marks=pytest.mark.soak if name in SLOWER else (), id=f"{family}-{name}"
        )
        for family, streams in FAMILY_STREAMS.items()
        for name in streams
    ]
)
def line(request: pytest.FixtureRequest, real_time: None) -> Iterator[Line]:
    """A port on which another process writes as fast as it can."""
    family, name = request.param
    master, slave = os.openpty()
    tty.setraw(slave)
    talker = subprocess.Popen(
        [sys.executable, "-c", _TALKER, str(master), FAMILY_STREAMS[family][name].hex()],
        pass_fds=[master],
    )
    yield Line(os.ttyname(slave), family)
    talker.kill()
    talker.wait()
    os.close(master)
    os.close(slave)


def _seconds(call: Callable[[], object], limit: float) -> float:
    """How long a call takes.

    A call that is not back after ``limit`` s fails the test, and is left behind.
    """

    def run() -> None:
        with contextlib.suppress(HardwareError):
            call()

    thread = threading.Thread(target=run, daemon=True)
    begin = time.monotonic()
    thread.start()
    thread.join(limit)
    assert not thread.is_alive(), f"not back after {limit:.2f} s"
    return time.monotonic() - begin


SINGLE = LONGEST_DRAIN + 3 * (RESPONSE_TIME + 0.001) + 2 * LONGEST_DRAIN
"""s for a request to one servo: the line is drained, and the request is sent three times."""

GROUP = LONGEST_DRAIN + max(CYCLE_TIME, RESPONSE_TIME + 0.002)
"""s for a request to several servos."""


def calls(line: Line, bus: SerialBus) -> dict[str, tuple[Callable[[], object], float]]:
    """Return name -> (call, s that it may take)."""
    position = line.register("present_position")
    goal = line.register("goal_position")
    everyone = dict.fromkeys(IDS, position)
    within = 0.01
    return {
        "read": (lambda: bus.read(1, position), SINGLE),
        "write": (lambda: bus.write(1, goal, 5), SINGLE),
        "ping": (lambda: bus.ping(1), SINGLE),
        "reboot": (lambda: bus.reboot(1), SINGLE),
        "write to all": (lambda: bus.write(BROADCAST_ID, goal, 5), 0.0),
        "sync_write": (lambda: bus.sync_write(goal, dict.fromkeys(IDS, 5)), 0.0),
        "sync_read": (lambda: bus.sync_read(IDS, position), GROUP),
        "fast sync_read": (lambda: bus.sync_read(IDS, position), GROUP),
        "exchange": (
            lambda: bus.exchange(goal, {1: 5}, everyone, within),
            LONGEST_DRAIN + RESPONSE_TIME + 0.002,
        ),
        "broadcast_ping": (bus.broadcast_ping, LONGEST_DRAIN + bus.listening_time),
    }


def test_every_call_returns_in_time_on_a_line_that_never_ends(line: Line) -> None:
    bus = line.bus()
    assert _seconds(bus.open, MARGIN) < MARGIN
    for name, (call, promised) in calls(line, bus).items():
        bus.use_fast_reads(IDS if name.startswith("fast") else [])
        took = _seconds(call, promised + MARGIN)
        assert took < promised + MARGIN, name
    assert bus.counters.bytes_received > 10_000, "the line was silent: nothing was tried"
    assert _seconds(bus.close, MARGIN) < MARGIN


def test_a_line_that_never_ends_fills_no_memory(line: Line) -> None:
    position = line.register("present_position")
    bus = line.bus()
    bus.open()
    tracemalloc.start()
    try:
        _seconds(lambda: bus.read(1, position), 5.0)
        _seconds(lambda: bus.sync_read(IDS, position), 5.0)
        bus.use_fast_reads(IDS)
        _seconds(lambda: bus.sync_read(IDS, position), 5.0)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
        bus.close()
    assert peak < 300_000


@pytest.mark.parametrize("stream", STREAMS.values(), ids=STREAMS)
@pytest.mark.parametrize("make", [StatusParser, lambda: FastParser([(id, 4) for id in IDS])])
def test_a_parser_keeps_no_more_than_a_packet(
    make: Callable[[], StatusParser | FastParser], stream: bytes
) -> None:
    parser = make()
    parser.feed(stream)
    tracemalloc.start()
    try:
        for _ in range(8):
            parser.feed(stream)
        snapshot = tracemalloc.take_snapshot()
    finally:
        tracemalloc.stop()
    # Of the parsers alone: threads of other tests may read beside this one.
    own = snapshot.filter_traces([tracemalloc.Filter(True, packets.__file__)])
    assert sum(trace.size for trace in own.traces) < 3000, "what was fed is kept"


def test_what_came_in_time_is_read_by_a_program_that_was_stopped_meanwhile(real_time: None) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    port = SleepingPortHandler(os.ttyname(slave), 1_000_000, Counters())
    try:
        port.openPort()
        port.setPacketTimeoutMillis(1.0)
        os.write(master, bytes(range(200)))
        time.sleep(0.05)
        assert port.readPort(11) + port.readPort(100) == bytes(range(111))
        port.setPacketTimeoutMillis(1.0)
        time.sleep(0.05)
        os.write(master, bytes(4000))  # an endless stream is no reply
        assert sum(len(port.readPort(1000)) for _ in range(50)) <= 1024
    finally:
        port.closePort()
        os.close(master)
        os.close(slave)


def test_a_port_that_takes_bytes_one_by_one_is_given_up(real_time: None) -> None:
    class Slow(SleepingPortHandler):
        def _write(self, data: bytes) -> int:
            time.sleep(0.05)
            return 1

    master, slave = os.openpty()
    port = Slow(os.ttyname(slave), 1_000_000, Counters())
    try:
        port.openPort()
        begin = time.monotonic()
        with pytest.raises(OSError, match="takes no bytes"):
            port.writePort(bytes(100))
        assert time.monotonic() - begin < 0.5 + MARGIN
    finally:
        port.closePort()
        os.close(master)
        os.close(slave)
