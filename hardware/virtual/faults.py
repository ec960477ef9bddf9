"""What can be wrong with a virtual bus, as data; ``fault_kinds`` has what can happen on the way."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields

from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.control_table import TICKS_PER_TURN
from robot_ik.hardware.virtual.protocol2 import BROADCAST, Parser, build_status

TICKS_PER_DEGREE = TICKS_PER_TURN / 360.0
RATES = (
    "corrupt",
    "truncate",
    "drop",
    "garbage",
    "short",
    "error",
    "duplicate",
    "wrong_id",
    "reorder",
    "late",
)
"""Fields of ``Faults`` that are probabilities per status packet."""


@dataclass(frozen=True)
class Faults:
    """Faults of servos, by id, and of the wire, by probability per status packet.

    Attributes:
        zero_offset_deg: Servo id -> degrees by which its shaft is ahead of what its registers say.
        stuck: Ids whose shaft does not move.
        silent: Ids that neither hear nor answer.
        overload: Ids that shut down with an overload when the faults are set.
        corrupt: One bit of the packet flips.
        truncate: The packet breaks off.
        drop: The packet is lost.
        garbage: One to eight random bytes come before the packet.
        short: The packet has fewer data than asked for, and a right checksum.
        error: The packet has an error number and no data.
        duplicate: The packet comes twice.
        wrong_id: A packet of a servo that nobody asked comes first.
        reorder: The packet comes after the next one.
        late: The packet comes before the answers to the next request.
        echo: The adapter returns what was sent.
        seed: Of the wire's dice; equal seeds and equal traffic give equal faults.
    """

    zero_offset_deg: Mapping[int, float] = field(default_factory=dict)
    stuck: frozenset[int] = frozenset()
    silent: frozenset[int] = frozenset()
    overload: frozenset[int] = frozenset()
    corrupt: float = 0.0
    truncate: float = 0.0
    drop: float = 0.0
    garbage: float = 0.0
    short: float = 0.0
    error: float = 0.0
    duplicate: float = 0.0
    wrong_id: float = 0.0
    reorder: float = 0.0
    late: float = 0.0
    echo: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name in RATES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is a probability, 0..1, not {getattr(self, name)}")

    @classmethod
    def for_joints(
        cls,
        config: ArmConfig,
        *,
        zero_offset_deg: Mapping[str, float] | None = None,
        stuck: Iterable[str] = (),
        silent: Iterable[str] = (),
        overload: Iterable[str] = (),
        **wire: float,
    ) -> Faults:
        """The same by joint name; offsets are degrees of the joint, in its own direction.

        Args:
            config: The arm.
            zero_offset_deg: Joint name -> degrees.
            stuck: Joint names.
            silent: Joint names.
            overload: Joint names.
            **wire: Fields of ``Faults`` that concern the wire.

        Raises:
            UnknownJointError: The arm has no such joint.
        """
        offsets = {}
        for name, degrees in (zero_offset_deg or {}).items():
            joint = config.joint(name)
            offsets[joint.id] = degrees * joint.direction * joint.ratio
        known = {f.name for f in fields(cls)}
        if unknown := set(wire) - known:
            raise TypeError(f"no such faults: {sorted(unknown)}; there are: {sorted(known)}")

        def ids(names: Iterable[str]) -> frozenset[int]:
            return frozenset(config.joint(name).id for name in names)

        return cls(offsets, ids(stuck), ids(silent), ids(overload), **wire)  # type: ignore[arg-type]

    def servo_ids(self) -> frozenset[int]:
        """Every id that a fault names."""
        return frozenset(self.zero_offset_deg) | self.stuck | self.silent | self.overload


class Wire:
    """Applies the faults of the wire to status packets.

    Args:
        faults: Which, how often, and the seed.
        taken: Ids on the wire: a stranger has none of them, for nobody could tell its answer from theirs.

    Attributes:
        faults: The ones in force.
    """

    def __init__(self, faults: Faults, taken: Iterable[int] = ()) -> None:
        self._strangers = sorted(set(range(253)).difference(taken)) or [BROADCAST]
        self.change(faults)
        self._dice = random.Random(faults.seed)
        self._late: list[bytes] = []

    def change(self, faults: Faults) -> None:
        """Other faults from here on; the dice go on."""
        self.faults = faults
        self._clean = not any(getattr(faults, rate) for rate in RATES)

    def carry(self, packets: list[bytes]) -> list[bytes]:
        """What of the answers to one request arrives at the host, in the order in which it does."""
        if self._clean and not self._late:
            return packets
        arriving, self._late = self._late, []
        behind: bytes | None = None
        for packet in packets:
            if self._happens(self.faults.late):
                self._late.append(packet)
                continue
            spoiled = self._spoil(packet)
            if behind is None and self._happens(self.faults.reorder):
                behind = spoiled
                continue
            arriving.append(spoiled)
            if behind is not None:
                arriving.append(behind)
                behind = None
        return arriving if behind is None else [*arriving, behind]

    def _spoil(self, packet: bytes) -> bytes:
        """One packet, as it arrives."""
        faults, dice = self.faults, self._dice
        if self._happens(faults.drop):
            return b""
        id = packet[4]
        whole = id != BROADCAST  # the torso of a fast read is no status of its own
        if whole and self._happens(faults.short):
            packet = _shortened(packet)
        if whole and self._happens(faults.error):
            packet = build_status(id, dice.randrange(1, 8))
        if self._happens(faults.corrupt):
            bit = dice.randrange(8 * len(packet))
            spoiled = bytearray(packet)
            spoiled[bit // 8] ^= 1 << bit % 8
            packet = bytes(spoiled)
        if self._happens(faults.truncate):
            packet = packet[: dice.randrange(1, len(packet))]
        if self._happens(faults.duplicate):
            packet += packet
        if self._happens(faults.wrong_id):
            packet = build_status(dice.choice(self._strangers), 0, dice.randbytes(4)) + packet
        if self._happens(faults.garbage):
            packet = dice.randbytes(dice.randrange(1, 9)) + packet
        return packet

    def _happens(self, probability: float) -> bool:
        return probability > 0.0 and self._dice.random() < probability


def _shortened(packet: bytes) -> bytes:
    """The same status with one byte of data less; one without data, or no status at all, stays."""
    answers = Parser().feed(packet, 0.0)
    if not answers or not answers[0].is_status:  # servos that talk over each other
        return packet
    answer = answers[0]
    return build_status(answer.id, answer.params[0], answer.data[:-1])
