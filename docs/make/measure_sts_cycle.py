"""Measure one control cycle of six Feetech STS3215: goals out and measurements back.

    python docs/make/measure_sts_cycle.py            print the table
    python docs/make/measure_sts_cycle.py --write    and put it into docs/reference/feetech_sts.md

The servos are another process behind a pty. It knows the requests and has the replies ready. So the
time is that of the driver's software and of two process switches. The last column adds the time
of the bytes on a wire of 1 Mbit/s. The p50 of the quietest round counts for each row.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from measure_servo_cycle import serve, spend, stay_on_core
from rich.console import Console

from robot_ik.hardware.families.feetech_sts import FAMILY
from robot_ik.hardware.families.feetech_sts_table import STS3215
from robot_ik.hardware.late_replies import LENGTHS
from robot_ik.hardware.registers import Register
from robot_ik.hardware.serial_bus import SerialBus
from robot_ik.hardware.virtual.protocol1 import build_status

PAGE = Path(__file__).resolve().parents[1] / "reference" / "feetech_sts.md"
BEGIN = "<!-- sts cycle -->"
END = "<!-- end -->"

IDS = tuple(range(1, 7))
BAUD = 1_000_000
BITS_PER_BYTE = 10
GOAL = STS3215["goal_position"]
POSITION = 2048
RATES = (100, 200)
"""Control cycles per second that must fit."""

BLOCKS = {
    "position": STS3215["present_position"],
    "position to status": STS3215.block("present_position", "hardware_error_status"),
    "torque to current (what `Arm` reads)": FAMILY.plain_block(STS3215).register,
}
"""Row of the table -> block that a cycle reads from every servo."""


def memory_of(register: Register) -> bytes:
    """Return bytes that the servos answer: position 2048 and zeros."""
    data = bytearray(register.size)
    at = STS3215["present_position"].address - register.address
    data[at : at + 2] = STS3215["present_position"].encode(POSITION)
    return bytes(data)


def canned(register: Register) -> dict[bytes, bytes]:
    """Return every request of a cycle and the reply of six servos."""
    replies = {}
    for extra in range(LENGTHS):  # after a missing reply the bus asks for more bytes
        wider = replace(register, size=register.size + extra)
        request = FAMILY.protocol.group_read(dict.fromkeys(IDS, wider), ()).request
        data = memory_of(register) + bytes(extra)
        replies[request] = b"".join(build_status(id, 0, data) for id in IDS)
    return replies


@contextmanager
def port(register: Register, baud: int) -> Iterator[str]:
    """Start servos behind a pty, and yield the name of the port.

    Args:
        register: Register or block that is read.
        baud: bit/s of the wire; 0: the bytes take no time.
    """
    own_end, servo_end = multiprocessing.Pipe()
    context = multiprocessing.get_context("fork")
    servos = context.Process(target=serve, args=(canned(register), servo_end, baud), daemon=True)
    servos.start()
    try:
        yield own_end.recv()
    finally:
        servos.terminate()
        servos.join()


def measure(register: Register, baud: int, rounds: int, cycles: int) -> float:
    """Return the p50 of a cycle in the quietest round, s."""
    reads = dict.fromkeys(IDS, register)
    right = register.decode(memory_of(register))
    medians = []
    with port(register, baud) as path:
        bus = SerialBus(path, BAUD, FAMILY.protocol)
        bus.open()

        def cycle(goal: int) -> None:
            statuses = bus.exchange(GOAL, dict.fromkeys(IDS, goal), reads)
            assert all(status.data in (right, None) for status in statuses.values())

        for number in range(rounds + 1):
            spent = sorted(spend(cycle, cycles))
            if number:  # the first round warms up
                medians.append(spent[len(spent) // 2])
        bus.close()
    return min(medians)


def wire_time(register: Register) -> float:
    """Return the time of a cycle's bytes on the wire, s."""
    protocol = FAMILY.protocol
    read = protocol.group_read(dict.fromkeys(IDS, register), ())
    sent = len(protocol.sync_write(GOAL, dict.fromkeys(IDS, 0))) + len(read.request)
    return BITS_PER_BYTE * (sent + read.reply_size) / BAUD


def table(rounds: int, cycles: int) -> list[str]:
    """Return the lines of the table."""
    lines = [
        "| read per servo | software, µs | wire alone, ms | both at 1 Mbit/s, ms |",
        "|---|---:|---:|---:|",
    ]
    for name, register in BLOCKS.items():
        software = 1e6 * measure(register, 0, rounds, cycles)
        wire = 1e3 * wire_time(register)
        both = 1e3 * measure(register, BAUD, rounds, max(20, cycles // 4))
        lines.append(
            f"| {name}, {register.size} bytes | {software:.0f} | {wire:.2f} | {both:.2f} |"
        )
    shares = [f"{100.0 * rate * both / 1000.0:.0f} % at {rate} Hz" for rate in RATES]
    lines += ["", f"Share of the control period that the whole block takes: {', '.join(shares)}."]
    return lines


def main() -> None:
    """Measure, and print the table or write it into the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=10, help="rounds of every row")
    parser.add_argument("--cycles", type=int, default=300, help="cycles in a round")
    parser.add_argument("--write", action="store_true", help="put the table into the page")
    options = parser.parse_args()
    stay_on_core(0)
    lines = table(options.rounds, options.cycles)
    Console(width=120).print("\n".join(lines), markup=False, highlight=False)
    if options.write:
        head, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
        tail = rest[rest.index(END) :]
        PAGE.write_text(f"{head}{BEGIN}\n" + "\n".join(lines) + f"\n{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
