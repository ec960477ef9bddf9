"""The port of the virtual bus: bytes, time, files, threads, and its link."""

from __future__ import annotations

import os
import select
import threading
import time
from pathlib import Path

import pytest
import serial

from robot_ik.errors import OutputError
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.protocol import Instruction, build, build_status
from robot_ik.hardware.virtual.pty import PtyPort
from tests.waiting import LONG


def _opens(path: str) -> bool:
    try:
        serial.Serial(path, 1_000_000).close()
    except (serial.SerialException, OSError):
        return False
    return True


def test_a_rate_without_a_terminal_constant_is_reported_too(pty: PtyPort) -> None:
    with serial.Serial(pty.path, 4_500_000):
        assert pty.client_baud() == 4_500_000


def test_wire_time_and_latency_are_spent(arm_bus: VirtualBus) -> None:
    request = build(1, Instruction.PING)
    for wire_baud, arm_bus.latency, expected in ((9600, 0.0, 24 * 10 / 9600), (0, 0.030, 0.030)):
        with (
            PtyPort(arm_bus, wire_baud=wire_baud) as pty,
            serial.Serial(pty.path, 1_000_000, timeout=LONG) as client,
        ):
            start = time.monotonic()
            client.write(request)
            assert len(client.read(14)) == 14
            assert time.monotonic() - start >= expected


def test_a_client_that_sets_nothing_gets_its_bytes_unchanged(pty: PtyPort) -> None:
    client = os.open(pty.path, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(client, build(1, Instruction.PING))
        reply = b""
        while len(reply) < 14 and select.select([client], [], [], LONG)[0]:
            reply += os.read(client, 100)
        assert reply == build_status(1, 0, b"\xfc\x03\x30")
    finally:
        os.close(client)


def test_a_packet_in_pieces_is_answered_when_complete(pty: PtyPort) -> None:
    with serial.Serial(pty.path, 1_000_000, timeout=0.1) as client:
        request = build(1, Instruction.PING)
        client.write(request[:5])
        assert client.read(1) == b""
        client.write(request[5:])  # the servos' clock stands still: no gap for them
        client.timeout = LONG
        assert len(client.read(14)) == 14


def test_an_idle_port_costs_no_time(pty: PtyPort) -> None:
    start = time.process_time()
    time.sleep(0.5)
    assert time.process_time() - start < 0.2


def test_close_pulls_the_cable(arm_bus: VirtualBus) -> None:
    pty = PtyPort(arm_bus)
    threads = threading.active_count()
    with serial.Serial(pty.path, 1_000_000, timeout=0.2) as client:
        pty.close()
        pty.close()
        with pytest.raises((serial.SerialException, OSError)):
            client.write(build(1, Instruction.PING))
            client.read(1)
    assert threading.active_count() == threads - 1
    assert not os.path.exists(pty.path) or not _opens(pty.path)


def test_closing_does_not_wait_for_a_slow_wire(arm_bus: VirtualBus) -> None:
    arm_bus.latency = 60.0
    pty = PtyPort(arm_bus)
    with serial.Serial(pty.path, 1_000_000) as client:
        client.write(build(1, Instruction.PING))
        time.sleep(0.1)
        start = time.monotonic()
        pty.close()
        assert time.monotonic() - start < 10.0


def test_no_file_is_left_open(arm_bus: VirtualBus) -> None:
    folder = Path("/proc/self/fd")
    if not folder.exists():
        pytest.skip("only Linux lists a process's files")
    before = len(list(folder.iterdir()))
    for _ in range(3):
        PtyPort(arm_bus).close()
    assert len(list(folder.iterdir())) == before


def test_link_is_made_and_removed(arm_bus: VirtualBus, tmp_path: Path) -> None:
    link = tmp_path / "ttyDXL"
    with PtyPort(arm_bus, link) as first:
        assert os.readlink(link) == first.path
        with PtyPort(arm_bus, link) as second:  # a stale link, or another bus: the newest wins
            assert os.readlink(link) == second.path
            first.close()
            assert os.readlink(link) == second.path
    assert not link.is_symlink()
    assert list(tmp_path.glob(".*")) == []


def test_link_never_overwrites_a_file(arm_bus: VirtualBus, tmp_path: Path) -> None:
    precious = tmp_path / "notes.txt"
    precious.write_text("keep me")
    with pytest.raises(OutputError, match="not a symbolic link"):
        PtyPort(arm_bus, precious)
    assert precious.read_text() == "keep me"
    with pytest.raises(OutputError, match="cannot make the link"):
        PtyPort(arm_bus, tmp_path / "missing" / "link")
