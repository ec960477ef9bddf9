"""Requests to stop an arm, from this program and from others.

A request waits until the arm carries it out, also one that comes before ``connect``, in a fault or
during ``enable``.  Requests of other programs come through the stop file.  The heartbeat looks for
them beside the control cycle, so that the cycle never waits for a file.
"""

from __future__ import annotations

import threading
from collections import deque

from robot_ik.errors import StopRequestedError
from robot_ik.hardware.stop_file import StopFile


class StopRequests:
    """Requests that wait for one arm, and the request that was carried out last.

    Args:
        arm_name: Name by which other programs find the arm.

    Attributes:
        policy: How the arm was left by the request that was carried out last: ``hold`` or
            ``torque_off``.  None: no request was carried out since the last ``connect``.
        unraised: Error of a request that the heartbeat carried out and no call has raised yet.
    """

    def __init__(self, arm_name: str) -> None:
        self.policy: str | None = None
        self.unraised: StopRequestedError | None = None
        self._file = StopFile(arm_name)
        self._waiting: deque[str] = deque()
        self._lock = threading.Lock()
        self._in_progress = False  # a request was taken and is not acknowledged yet

    def open(self, port: str) -> None:
        """Let other programs find the arm.  May be called again.

        Args:
            port: Port of the arm.
        """
        self._file.open(port)

    def close(self) -> None:
        """Let no other program find the arm any more.  May be called any number of times."""
        self._file.close()

    def add(self, policy: str) -> None:
        """Add a request.  Safe to call from any thread.

        Args:
            policy: ``torque_off``; every other value is ``hold``.
        """
        self._waiting.append("torque_off" if policy == "torque_off" else "hold")

    def pending(self, *, look_into_file: bool = False) -> bool:
        """Return whether a request waits to be carried out.

        Args:
            look_into_file: Look for requests of other programs here as well.
        """
        if look_into_file:
            self.look_into_file()
        return bool(self._waiting)

    def look_into_file(self) -> None:
        """Take over a request of another program, once: not while it is being carried out."""
        with self._lock:
            if self._waiting or self._in_progress:
                return
            policy = self._file.requested()
            if policy is not None:
                self.add(policy)

    def take(self) -> str:
        """Return the policy of the last request and begin to carry it out.

        Call it only if a request is pending.
        """
        with self._lock:
            self._in_progress = True
            while self._waiting:
                self.policy = self._waiting.popleft()
        return self.policy or "hold"

    def acknowledge(self, *, ok: bool, text: str) -> None:
        """Report how the arm was left to the program that requested the stop.

        Args:
            ok: Every servo confirmed it.
            text: How the arm was left.
        """
        with self._lock:
            self._file.acknowledge(ok=ok, text=text)
            self._in_progress = False

    def forget(self) -> None:
        """Forget the request that was carried out last.  Requests that wait stay."""
        self.policy = None
        self.unraised = None
