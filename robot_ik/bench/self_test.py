"""How well drawings lie on pictures, against ``cv2.projectPoints`` and exact truth: ``ar --self-test``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from robot_ik.bench.camera import accuracy
from robot_ik.bench.camera.accuracy import Misses
from robot_ik.camera.drawing.gl import make_artist

# RMS and worst allowed, pixels: spheres without and with lens distortion, a robot on a board.
_IDENTITY, _BENT, _OVERLAY = (0.05, 0.15), (0.08, 0.20), (0.30, 1.0)
_DISTANCES = (0.7, 1.0)


@dataclass(frozen=True)
class SelfTestRow:
    """One figure of the self-test; no limits: it is reported, not judged."""

    what: str
    misses: Misses
    limits: tuple[float, float] | None

    @property
    def good(self) -> bool:
        """Whether both figures are within their limits."""
        if self.limits is None:
            return True
        return self.misses.rms <= self.limits[0] and self.misses.worst <= self.limits[1]


class SelfTest:
    """All figures, one after the other.

    Attributes:
        notice: One line where OpenGL is missing, known once its rows are done; empty: it is there.
    """

    def __init__(self) -> None:
        self.notice = ""

    def rows(self, progress: Callable[[str, float], None]) -> Iterator[SelfTestRow]:
        """Figure by figure.

        Args:
            progress: Called with what is measured, and the share that is done.
        """
        yield from self._spheres(progress)
        for k, distance in enumerate(_DISTANCES):
            progress("board", (6 + k) / 9)
            misses = accuracy.overlay_error(distance)
            yield SelfTestRow(f"robot on a 2 x 2 board at {distance:g} m", misses, _OVERLAY)
        progress("delay", 8 / 9)
        for name, misses in accuracy.latency_errors().items():
            yield SelfTestRow(f"66 ms behind a moving hand: {name}", misses, None)

    def _spheres(self, progress: Callable[[str, float], None]) -> Iterator[SelfTestRow]:
        for k, name in enumerate(("painter", "ray", "gl")):
            artist, missing = make_artist(name)
            self.notice = missing or self.notice
            for lens, limits, text in (
                (accuracy.STRAIGHT, _IDENTITY, "no distortion"),
                (accuracy.BENT, _BENT, "distortion"),
            ):
                progress(name, 2 * k / 9)
                if not missing:
                    misses = accuracy.projection_identity(artist, lens)
                    yield SelfTestRow(f"{name}: spheres, {text}", misses, limits)
            getattr(artist, "close", lambda: None)()
