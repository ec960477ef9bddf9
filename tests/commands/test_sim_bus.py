"""The simulated bus as a program: a foreign client uses it, and signals end it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from robot_ik.robot_file import catalogue
from tests.waiting import wait_for

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")
sdk = pytest.importorskip("dynamixel_sdk")

PRESENT_POSITION = 132  # X series control table
XM430_W350 = 1020
Serve = Callable[..., AbstractContextManager["subprocess.Popen[str]"]]


@pytest.fixture
def serve(tmp_path: Path, real_time: None) -> Serve:
    """``with serve("--match-baud") as child``: a served bus with the link ``tmp_path / "arm"``."""

    @contextmanager
    def serving(*arguments: str) -> Iterator[subprocess.Popen[str]]:
        child = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "robot_ik",
                "sim-bus",
                "--link",
                str(tmp_path / "arm"),
                *arguments,
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert child.stdout is not None
        try:
            output = child.stdout.readline().strip()
            assert output == str(tmp_path / "arm"), output
            yield child
        finally:
            child.kill()
            child.communicate()

    return serving


def ping(path: Path, id: int, baud: int = 1_000_000) -> tuple[int, int]:
    """(model number, communication result) from the official SDK."""
    port = sdk.PortHandler(str(path))
    try:
        assert port.openPort() and port.setBaudRate(baud)
        model, result, _ = sdk.PacketHandler(2.0).ping(port, id)
        return model, result
    finally:
        port.closePort()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_official_sdk_can_use_it_and_a_signal_ends_it(
    number: signal.Signals, serve: Serve, tmp_path: Path
) -> None:
    link = tmp_path / "arm"
    with serve() as child:
        assert ping(link, 2) == (XM430_W350, sdk.COMM_SUCCESS)
        port = sdk.PortHandler(str(link))
        assert port.openPort()
        ticks, result, error = sdk.PacketHandler(2.0).read4ByteTxRx(port, 1, PRESENT_POSITION)
        port.closePort()
        assert (result, error) == (sdk.COMM_SUCCESS, 0) and 0 <= ticks < 4096
        child.send_signal(number)
        out, err = child.communicate()
        assert child.returncode == 0
        assert out == "" and "Traceback" not in err
        assert "joint1" in err and "closed" in err
    assert not os.path.lexists(link)


def test_faults_reach_the_wire(serve: Serve, tmp_path: Path) -> None:
    with serve("--fault", "silent:joint1"):
        assert ping(tmp_path / "arm", 1)[1] == sdk.COMM_RX_TIMEOUT
        assert ping(tmp_path / "arm", 2)[1] == sdk.COMM_SUCCESS


def test_replies_have_the_requested_latency(serve: Serve, tmp_path: Path) -> None:
    with serve("--latency-ms", "20"):
        port = sdk.PortHandler(str(tmp_path / "arm"))
        assert port.openPort()
        begin = time.monotonic()
        assert sdk.PacketHandler(2.0).ping(port, 1)[1] == sdk.COMM_SUCCESS
        assert time.monotonic() - begin >= 0.020
        port.closePort()


def test_a_file_of_faults_happens_in_its_time(serve: Serve, tmp_path: Path) -> None:
    faults = tmp_path / "faults.toml"
    silent = '[[faults]]\nkind = "silent"\njoint = "joint1"\nat_packet = 2\nfor_packets = 1\n'
    text = f"schema = 1\n{silent}"
    faults.write_text(text + '[[faults]]\nkind = "overload"\nid = 2\n')
    with serve("--fault", str(faults)):
        link = tmp_path / "arm"
        success = sdk.COMM_SUCCESS
        timeout = sdk.COMM_RX_TIMEOUT
        assert [ping(link, 1)[1] for _ in range(3)] == [success, timeout, success]
        port = sdk.PortHandler(str(link))
        assert port.openPort()
        assert sdk.PacketHandler(2.0).read1ByteTxRx(port, 2, 70) == (32, success, 0x80)
        port.closePort()


def test_with_physics_an_arm_that_is_too_heavy_feels_it(serve: Serve, tmp_path: Path) -> None:
    with serve("--physics", "--arm", "puma560"):
        handler = sdk.PacketHandler(2.0)
        port = sdk.PortHandler(str(tmp_path / "arm"))
        assert port.openPort()
        assert handler.write1ByteTxRx(port, 2, 64, 1) == (sdk.COMM_SUCCESS, 0)
        wait_for(lambda: handler.read2ByteTxRx(port, 2, 126)[0])  # a real PUMA on servos of 4 N m
        port.closePort()


def test_the_baud_rate_matters_only_with_match_baud(serve: Serve, tmp_path: Path) -> None:
    with serve():
        assert ping(tmp_path / "arm", 1, baud=57_600)[1] == sdk.COMM_SUCCESS
    with serve("--match-baud"):
        assert ping(tmp_path / "arm", 1, baud=57_600)[1] == sdk.COMM_RX_TIMEOUT
        assert ping(tmp_path / "arm", 1, baud=1_000_000)[1] == sdk.COMM_SUCCESS


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--arm", "pmua560"], "puma560"),
        (["--arm", "nowhere/arm.toml"], "nowhere/arm.toml"),
        (["--fault", "stuck:joitn3"], "joint3"),
        (["--fault", "zero-offset:joint3"], "--fault"),
        (["--fault", "zero-offset:joint3=nan"], "--fault"),
        (["--fault", "zero-offset:joitn3=2"], "joint3"),
        (["--fault", "corrupt=2"], "--fault"),
        (["--fault", "drop=nan"], "--fault"),
        (["--latency-ms", "-1"], "--latency-ms"),
        (["--wire-baud", "-9600"], "--wire-baud"),
        (["--fault", "nowhere/faults.toml"], "nowhere/faults.toml"),
    ],
)
def test_wrong_input(arguments: list[str], named: str, robot_ik: Any, tmp_path: Path) -> None:
    run = robot_ik("sim-bus", "--link", tmp_path / "arm", *arguments)
    run.assert_one_screen_error()
    assert named in run.err
    assert list(tmp_path.iterdir()) == []  # no link was made


def test_an_arm_file_with_an_unknown_key(robot_ik: Any, tmp_path: Path) -> None:
    text = (catalogue()["puma560"] / "arm.toml").read_text()
    file = tmp_path / "arm.toml"
    file.write_text(text.replace("watchdog_ms", "watchdgo_ms"))
    run = robot_ik("sim-bus", "--arm", file)
    run.assert_one_screen_error()
    for part in (str(file), "watchdgo_ms", "watchdog_ms"):
        assert part in run.err


def test_a_file_in_the_place_of_the_link_is_kept(robot_ik: Any, tmp_path: Path) -> None:
    precious = tmp_path / "thesis.tex"
    precious.write_text("years of work")
    run = robot_ik("sim-bus", "--link", precious)
    run.assert_one_screen_error()
    assert precious.read_text() == "years of work" and list(tmp_path.iterdir()) == [precious]


def test_the_name_of_a_port_that_is_there_is_not_taken_over(
    robot_ik: Any, serve: Serve, tmp_path: Path
) -> None:
    with serve():
        before = os.readlink(tmp_path / "arm")
        run = robot_ik("sim-bus", "--link", tmp_path / "arm")
        run.assert_one_screen_error()
        assert before in run.err and os.readlink(tmp_path / "arm") == before
