"""Measure one control cycle of six servos: ours, and the group calls of the Dynamixel SDK.

    python docs/make/measure_servo_cycle.py             print the table
    python docs/make/measure_servo_cycle.py --write     and write it into docs/reference/hardware.md

The servos are a separate process behind a pty that takes no time for its bytes. It knows the
requests and has the replies ready, so the time is that of the client's software and of two process
switches. The process has its own core if there are two, because a process switch on one core is
faster and the system would choose by chance. Rounds of all contestants alternate. The p50 of the
quietest round counts, because other work on the machine disturbs all.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import statistics
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler
from rich.console import Console
from rich.progress import track

from robot_ik.hardware.dynamixel import DynamixelBus
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.late_replies import LENGTHS
from robot_ik.hardware.packets import read_request, write_request
from robot_ik.hardware.registers import Register
from robot_ik.hardware.virtual.protocol import build_fast_status, build_status

PAGE = Path(__file__).resolve().parents[1] / "reference" / "hardware.md"
IDS = tuple(range(1, 7))
TABLE = X_TABLES["XM430-W350"]
GOAL = TABLE["goal_position"]
PRESENT = TABLE["present_position"]
BLOCK = Register("torque, velocity and position", TABLE["indirect_data_1"].address, 7, signed=True)
RATES = (57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
BITS_PER_BYTE = 10
CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def serve(replies: dict[bytes, bytes], back: Connection, baud: int) -> None:
    """Answer bytes that end in a known request, after the time that the wire would take.

    Args:
        replies: Request -> reply.
        back: Pipe to which the name of the port is sent.
        baud: Bits/s of the wire; 0: without delay.
    """
    stay_on_core(1)
    master, slave = os.openpty()
    tty.setraw(slave)
    back.send(os.ttyname(slave))
    longest = max(map(len, replies))
    tail = b""
    asked = 0
    while True:
        data = os.read(master, 4096)
        arrived = time.perf_counter()
        asked += len(data)
        tail = (tail + data)[-longest:]
        for request, reply in replies.items():
            if tail.endswith(request):
                if baud:
                    wait_until(arrived + BITS_PER_BYTE * (asked + len(reply)) / baud)
                os.write(master, reply)
                tail = b""
                asked = 0
                break


def stay_on_core(number: int) -> None:
    """Bind this process to one of its cores, if the system supports it."""
    if CORES:
        os.sched_setaffinity(0, {CORES[number % len(CORES)]})


def wait_until(moment: float) -> None:
    """Sleep, and poll the clock for the last 0.2 ms, because a sleep may end late."""
    time.sleep(max(0.0, moment - time.perf_counter() - 2e-4))
    while time.perf_counter() < moment:
        pass


@contextmanager
def port(baud: int = 0) -> Iterator[str]:
    """Yield the name of a port with servos behind it."""
    own_end, servo_end = multiprocessing.Pipe()
    arguments = (canned(), servo_end, baud)
    servos = multiprocessing.get_context("fork").Process(target=serve, args=arguments, daemon=True)
    servos.start()
    try:
        yield own_end.recv()
    finally:
        servos.terminate()
        servos.join()


def canned() -> dict[bytes, bytes]:
    """Return a dictionary: each request of the contestants -> the reply of six servos."""
    replies = {}
    value = (2048).to_bytes(4, "little")
    for register, known in ((PRESENT, value), (BLOCK, b"\x01\x00\x00" + value)):
        for extra in range(LENGTHS):  # after a miss the bus asks for a byte more
            register = replace(register, size=len(known) + extra)
            asked = dict.fromkeys(IDS, register)
            data = known + bytes(extra)
            plain = b"".join(build_status(id, 0, data) for id in IDS)
            total = 8 + len(IDS) * (4 + register.size)
            replies[read_request(asked, fast=False)] = plain
            replies[read_request(asked, fast=True)] = build_fast_status(
                [(0, id, data) for id in IDS], total
            )
    return replies


def sdk_cycle(path: str, *, fast: bool) -> tuple[Callable[[int], None], Callable[[], None]]:
    """Return a cycle by the group calls of the SDK, and the function that closes its port."""
    handler = PortHandler(path)
    handler.openPort()
    handler.setBaudRate(1_000_000)
    packet = PacketHandler(2.0)
    write = GroupSyncWrite(handler, packet, GOAL.address, GOAL.size)
    read = GroupSyncRead(handler, packet, PRESENT.address, PRESENT.size)
    for id in IDS:
        write.addParam(id, [0, 0, 0, 0])
        read.addParam(id)

    def cycle(goal: int) -> None:
        data = list(goal.to_bytes(4, "little"))
        for id in IDS:
            write.changeParam(id, data)
        write.txPacket()
        result = read.fastSyncRead() if fast else read.txRxPacket()
        values = [read.getData(id, PRESENT.address, PRESENT.size) for id in IDS]
        assert result or values == [2048] * 6

    return cycle, handler.closePort


def our_cycle(
    path: str, register: Register, *, fast: bool, baud: int = 1_000_000
) -> tuple[Callable[[int], None], Callable[[], None]]:
    """Return a cycle by one exchange of our bus, and the function that closes its port."""
    bus = DynamixelBus(path, baud)
    bus.open()
    bus.use_fast_reads(IDS if fast else ())
    reads = dict.fromkeys(IDS, register)
    right = 2048 if register is PRESENT else 2048 << 24 | 1

    def cycle(goal: int) -> None:
        statuses = bus.exchange(GOAL, dict.fromkeys(IDS, goal), reads)
        assert all(status.data in (right, None) for status in statuses.values())

    return cycle, bus.close


CONTESTANTS: dict[str, Callable[[str], tuple[Callable[[int], None], Callable[[], None]]]] = {
    "Dynamixel SDK, group write and read": lambda path: sdk_cycle(path, fast=False),
    "Dynamixel SDK, group write and fast read": lambda path: sdk_cycle(path, fast=True),
    "`exchange`, position": lambda path: our_cycle(path, PRESENT, fast=False),
    "`exchange`, position, fast": lambda path: our_cycle(path, PRESENT, fast=True),
    "`exchange`, with torque and velocity, fast (what `Arm` does)": lambda path: our_cycle(
        path, BLOCK, fast=True
    ),
}


def spend(cycle: Callable[[int], None], cycles: int) -> list[float]:
    """Return the seconds of each cycle."""
    spent = []
    for k in range(cycles):
        begin = time.perf_counter()
        cycle(1000 + k)
        spent.append(time.perf_counter() - begin)
    return spent


def measure(rounds: int, cycles: int) -> dict[str, tuple[float, float]]:
    """Return contestant -> p50 of a cycle and CPU time of this process, µs, best round."""
    times: dict[str, list[float]] = {name: [] for name in CONTESTANTS}
    cpu: dict[str, list[float]] = {name: [] for name in CONTESTANTS}
    with port() as path:
        for number in track(range(rounds + 1), "measuring", transient=True):
            for name, make in CONTESTANTS.items():
                cycle, close = make(path)
                used = time.process_time()
                spent = spend(cycle, cycles)
                if number:  # the first round warms up
                    cpu[name].append((time.process_time() - used) / cycles)
                    times[name].append(statistics.median(spent))
                close()
    return {name: (1e6 * min(times[name]), 1e6 * min(cpu[name])) for name in times}


def measure_wire(baud: int, rounds: int) -> float:
    """Return the p50 of a cycle of ``Arm`` behind a wire with this baud rate, µs."""
    with port(baud) as path:
        cycle, close = our_cycle(path, BLOCK, fast=True, baud=baud)
        medians = [
            statistics.median(spend(cycle, max(20, baud // 10_000))) for _ in range(rounds + 1)
        ]
        close()
    return 1e6 * min(medians[1:])


def wire_us(baud: int, register: Register, *, fast: bool) -> float:
    """Return the time of a cycle's bytes on the wire, µs. It is the lower bound of a cycle."""
    asked = dict.fromkeys(IDS, register)
    sent = len(write_request(GOAL, dict.fromkeys(IDS, 0))) + len(read_request(asked, fast=fast))
    back = 8 + 6 * (4 + register.size) if fast else 6 * (11 + register.size)
    return 1e6 * BITS_PER_BYTE * (sent + back) / baud


def lines(times: dict[str, tuple[float, float]], wires: dict[int, float]) -> list[str]:
    """Return the lines of the section of the page."""
    python = f"{platform.python_implementation()} {platform.python_version()}"
    text = [
        f"| a cycle of six servos, {python}, quietest round | p50 µs | CPU µs |",
        "| --- | ---: | ---: |",
        *(f"| {name} | {p50:.0f} | {cpu:.0f} |" for name, (p50, cpu) in times.items()),
        "",
        "| wire, bit/s | SDK's bytes, µs | our bytes, µs | measured p50 µs | Hz | of the limit |",
        "| ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for baud, measured in wires.items():
        plain = wire_us(baud, PRESENT, fast=False)
        ours = wire_us(baud, BLOCK, fast=True)
        text.append(
            f"| {baud:_} | {plain:.0f} | {ours:.0f} | {measured:.0f} | {1e6 / measured:.0f} | "
            f"{100 * ours / measured:.0f} % |"
        )
    return text


def main() -> None:
    """Measure, and print the table or write it into the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=10, help="rounds of all contestants")
    parser.add_argument("--cycles", type=int, default=300, help="cycles in a round")
    parser.add_argument("--write", action="store_true", help="put the tables into the page")
    options = parser.parse_args()
    stay_on_core(0)
    times = measure(options.rounds, options.cycles)
    text = lines(times, {baud: measure_wire(baud, options.rounds) for baud in RATES})
    Console(width=140).print("\n".join(text), markup=False, highlight=False)
    if options.write:
        begin = "<!-- servo cycle -->"
        end = "<!-- end -->"
        page = PAGE.read_text(encoding="utf-8")
        head, rest = page.split(begin)
        tail = rest[rest.index(end) :]
        PAGE.write_text(f"{head}{begin}\n" + "\n".join(text) + f"\n{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
