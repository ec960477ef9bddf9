"""``robot-ik ar --self-test``: drawings against ``cv2.projectPoints`` and exact truth, on the terminal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from robot_ik.cli import console

if TYPE_CHECKING:
    from robot_ik.camera.ar.registration import Misses

# RMS and worst allowed, pixels: spheres without and with lens distortion, a robot on a board.
_IDENTITY, _BENT, _OVERLAY = (0.05, 0.15), (0.08, 0.20), (0.30, 1.0)
_DISTANCES = (0.7, 1.0)


@dataclass(frozen=True)
class Row:
    """One figure of the self-test; no limits: it is told, not judged."""

    what: str
    misses: Misses
    limits: tuple[float, float] | None

    @property
    def good(self) -> bool:
        """Whether both figures are within their limits."""
        if self.limits is None:
            return True
        return self.misses.rms <= self.limits[0] and self.misses.worst <= self.limits[1]


def run_self_test(*, json: bool = False) -> int:
    """Measures and prints; 0 when all is within its limits, else 1."""
    rows, notice = measure()
    good = all(row.good for row in rows)
    if json:
        console.print_json(
            {
                "good": good,
                "notice": notice,
                "rows": [
                    {
                        "what": row.what,
                        "rms_px": row.misses.rms,
                        "worst_px": row.misses.worst,
                        "limits_px": None if row.limits is None else list(row.limits),
                        "good": row.good,
                    }
                    for row in rows
                ],
            }
        )
    else:
        table = console.table("registration, px", "RMS", "allowed", "worst", "allowed", "")
        for row in rows:
            rms, worst = ("", "") if row.limits is None else (f"{v:.2f}" for v in row.limits)
            verdict = "" if row.limits is None else "good" if row.good else "NOT GOOD"
            table.add_row(row.what, f"{row.misses.rms:.3f}", rms, f"{row.misses.worst:.3f}", worst, verdict)
        console.out().print(table)
    if notice:
        console.say(notice, style="yellow")
    return console.DONE if good else console.NOT_ACHIEVED


def measure() -> tuple[list[Row], str]:
    """All figures, and one line where OpenGL is missing."""
    from robot_ik.camera.ar import registration
    from robot_ik.camera.ar.gl_draw import make_artist

    rows, notice = [], ""
    with console.progress() as bar:
        task = bar.add_task("measuring", total=9, note="")
        for name in ("painter", "ray", "gl"):
            artist, missing = make_artist(name)
            notice = missing or notice
            for lens, limits, words in (
                (registration.STRAIGHT, _IDENTITY, "no distortion"),
                (registration.BENT, _BENT, "distortion"),
            ):
                bar.update(task, advance=1, note=name)
                if not missing:
                    misses = registration.projection_identity(artist, lens)
                    rows.append(Row(f"{name}: spheres, {words}", misses, limits))
            getattr(artist, "close", lambda: None)()
        for distance in _DISTANCES:
            bar.update(task, advance=1, note="board")
            misses = registration.overlay_error(distance)
            rows.append(Row(f"robot on a 2 x 2 board at {distance:g} m", misses, _OVERLAY))
        bar.update(task, advance=1, note="delay")
        for name, misses in registration.remedy_errors().items():
            rows.append(Row(f"66 ms behind a moving hand: {name}", misses, None))
    return rows, notice
