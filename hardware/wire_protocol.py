"""What a serial bus needs from a wire protocol: requests as bytes, status packets from bytes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple, Protocol

from robot_ik.hardware.registers import Register

BROADCAST_ID = 254
"""Every servo obeys a write to this id and none answers it (Protocol 1 and 2)."""


class StatusPacket(NamedTuple):
    """One status packet with a correct checksum.

    Attributes:
        id: Servo id.
        code: Why the servo refused the request; 0: it did not.
        alert: The servo reports a hardware error.  The data are good all the same.
        data: Bytes of the registers.
    """

    id: int
    code: int
    alert: bool
    data: bytes


class GroupRead(NamedTuple):
    """A request that several servos answer.

    Attributes:
        request: Bytes to send.
        reply_size: Bytes of all status packets together.
        fast: The servos answer together in one packet.
    """

    request: bytes
    reply_size: int
    fast: bool = False


class StatusParser(Protocol):
    """Finds status packets in a byte stream.

    Attributes:
        damaged: Number of packets found so far that had a wrong checksum or length.
    """

    damaged: int

    def feed(self, data: bytes, *, last: bool = False) -> list[StatusPacket]:
        """Return the packets that ``data`` completes.  ``last``: no more bytes will come."""
        ...


class WireProtocol(Protocol):
    """Requests and replies of one protocol.

    Attributes:
        name: For messages, e.g. ``"Protocol 2"``.
        ping_data_size: Bytes of data in the reply to a ping.
        model_number: Register to read after a ping; None: the reply contains the model number.
        shortest_status: Bytes of a status packet without data.
        error_reasons: ``StatusPacket.code`` -> text.
        damaged_request_code: Code of a servo that received a damaged request; None: it stays
            silent.
        uniform_group_reads: A group read asks every servo for the same address and size.
    """

    @property
    def name(self) -> str: ...

    @property
    def ping_data_size(self) -> int: ...

    @property
    def model_number(self) -> Register | None: ...

    @property
    def shortest_status(self) -> int: ...

    @property
    def error_reasons(self) -> Mapping[int, str]: ...

    @property
    def damaged_request_code(self) -> int | None: ...

    @property
    def uniform_group_reads(self) -> bool: ...

    def ping(self, id: int) -> bytes: ...

    def read(self, id: int, register: Register) -> bytes: ...

    def write(self, id: int, register: Register, value: int) -> bytes: ...

    def reboot(self, id: int) -> bytes: ...

    def sync_write(self, register: Register, values: Mapping[int, int]) -> bytes:
        """Return a write of one register of several servos.  No servo answers it."""
        ...

    def group_read(
        self, registers: Mapping[int, Register], fast_ids: Collection[int], /
    ) -> GroupRead:
        """Return a read of several servos (id -> register).

        Args:
            registers: In the order of the replies.
            fast_ids: Servos that may answer together in one packet.

        Raises:
            ValueError: This protocol cannot read these registers in one request.
        """
        ...

    def parser(self, read: GroupRead | None, sizes: tuple[tuple[int, int], ...], /) -> StatusParser:
        """Return a parser of status packets.

        Args:
            read: The group read whose replies come; None: the reply to one request.
            sizes: Id and bytes of data of every reply to the group read.
        """
        ...

    def take_at_once(
        self, data: bytes, read: GroupRead, sizes: tuple[tuple[int, int], ...]
    ) -> list[bytes] | None:
        """Return the data of every servo if ``data`` are all replies without any error; else None.

        This is the usual case and must be quick.
        """
        ...
