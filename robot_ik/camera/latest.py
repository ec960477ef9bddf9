"""Any source as a live one: ``newest()`` never makes a control loop wait for a picture."""

from __future__ import annotations

import threading

from robot_ik.camera.sources import ClosingSource, Frame, FrameSource
from robot_ik.ports import Clock, RealClock


class LatestFrame(ClosingSource):
    """Reads a source on a thread (real time) or when a picture is due (virtual time), and keeps the newest.

    Args:
        source: What to read; closed together with this.
        clock: The run's clock.
        rate_hz: On a virtual clock a picture is taken this often; on the real one as fast as they come.
    """

    live = True

    def __init__(self, source: FrameSource, clock: Clock, rate_hz: float = 15.0) -> None:
        self._source, self._clock, self._period = source, clock, 1.0 / rate_hz
        self._due = -float("inf")
        self._lock = threading.Lock()
        self._latest: Frame | None = None
        self._failure: Exception | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        if isinstance(clock, RealClock):
            self._thread = threading.Thread(target=self._run, daemon=True, name="latest frame")
            self._thread.start()

    def newest(self) -> Frame | None:
        """The newest picture, or None before the first; raises what the source raised."""
        if self._thread is None and self._clock.now() >= self._due:
            self._due = self._clock.now() + self._period
            return self._source.read()
        with self._lock:
            if self._failure is not None:
                raise self._failure
            return self._latest

    def read(self) -> Frame:
        """The source's next picture."""
        return self._source.read()

    def close(self) -> None:
        """Stops the thread and closes the source."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
        self._source.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                frame = self._source.read()
            except Exception as error:  # handed to whoever asks next
                with self._lock:
                    self._failure = error
                return
            with self._lock:
                self._latest = frame
