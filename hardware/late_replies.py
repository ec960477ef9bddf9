"""Requests to which a late reply may still come.

A status packet names its servo but not the request that it answers.  While a reply to an earlier
request may still come, no read of that servo has the same number of bytes.  A control cycle reads a
few bytes more, so a late reply is recognised by its length.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache

from robot_ik.hardware.registers import Register

LATEST_REPLY = 0.16
"""s after a request was given up in which a reply to it may still come.

A busy computer and a USB adapter together delay a reply by some tens of ms.  150 ms cover that, and
the rest is for the bytes themselves.
"""

LENGTHS = 8
"""Number of reply lengths that a control cycle chooses from.

At 100 Hz and one lost packet in ten, a servo has two unanswered requests within ``LATEST_REPLY``.
It has eight once in a thousand cycles.  That cycle does not read this servo.
"""

SHORTENED = (0, 1)
"""Bytes of data that a late reply may lack although its checksum is right."""


@lru_cache(maxsize=1024)
def _widened(register: Register, extra: int) -> Register:
    return replace(register, size=register.size + extra)


class UnansweredRequests(dict[tuple[int, int], float]):
    """Requests to which a reply may still come.  Usually empty.

    Maps (servo id, bytes of data in the reply) to the time in s after which no reply comes.
    """

    @property
    def ids(self) -> frozenset[int]:
        """Servos from which a late reply may come."""
        return frozenset(id for id, _ in self)

    def add(self, keys: Iterable[tuple[int, int]], now: float) -> None:
        """Add requests that were given up, or that were sent twice and answered once."""
        self.update(dict.fromkeys(keys, now + LATEST_REPLY))

    def forget(self, now: float) -> None:
        """Remove the requests to which no reply comes any more."""
        for key in [key for key, until in self.items() if until <= now]:
            del self[key]

    def end(self, keys: Iterable[tuple[int, int]]) -> float:
        """Return the time in s until which a reply to one of ``keys`` may come, 0 if none may."""
        return max((self.get(key, 0.0) for key in keys), default=0.0)

    def widen(self, registers: Mapping[int, Register], *, uniform: bool) -> dict[int, Register]:
        """Return registers (id -> register), widened so that no late reply has the same length.

        A servo with late replies of every length is left out.

        Args:
            registers: Servo id -> register.
            uniform: All servos must be read at one address and length.
        """
        if not uniform:
            return {
                id: _widened(register, extra) if extra else register
                for id, register in registers.items()
                if (extra := next(self._free_lengths(id, register), None)) is not None
            }
        free = {id: set(self._free_lengths(id, register)) for id, register in registers.items()}
        extra = max(range(LENGTHS), key=lambda extra: sum(extra in row for row in free.values()))
        return {
            id: _widened(register, extra) if extra else register
            for id, register in registers.items()
            if extra in free[id]
        }

    def _free_lengths(self, id: int, register: Register) -> Iterator[int]:
        """Yield the numbers of extra bytes that no late reply of this servo has."""
        for extra in range(LENGTHS):
            if all((id, register.size + extra + lost) not in self for lost in SHORTENED):
                yield extra
