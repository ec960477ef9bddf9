"""What can be wrong with a virtual bus, as data: for tests, demonstrations and ``sim-bus``."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields

from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.control_table import TICKS_PER_TURN

TICKS_PER_DEGREE = TICKS_PER_TURN / 360.0


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
    echo: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("corrupt", "truncate", "drop", "garbage"):
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
    """

    def __init__(self, faults: Faults) -> None:
        self._faults = faults
        self._dice = random.Random(faults.seed)

    def spoil(self, packet: bytes) -> bytes:
        """What of a status packet arrives at the host."""
        faults, dice = self._faults, self._dice
        if self._happens(faults.drop):
            return b""
        if self._happens(faults.corrupt):
            bit = dice.randrange(8 * len(packet))
            spoiled = bytearray(packet)
            spoiled[bit // 8] ^= 1 << bit % 8
            packet = bytes(spoiled)
        if self._happens(faults.truncate):
            packet = packet[: dice.randrange(1, len(packet))]
        if self._happens(faults.garbage):
            packet = dice.randbytes(dice.randrange(1, 9)) + packet
        return packet

    def _happens(self, probability: float) -> bool:
        return probability > 0.0 and self._dice.random() < probability
