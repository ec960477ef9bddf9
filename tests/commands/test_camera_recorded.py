"""A recording is no live camera: no arm moves, and nothing is sent to its servos."""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.geometry import Pose


@dataclass
class Wire:
    """A serial line without servos. It records the sent bytes."""

    port: str
    sent: bytearray = field(default_factory=bytearray)


@pytest.fixture
def wire() -> Iterator[Wire]:
    """Provide the line. A pty has no delay, so the bytes are complete after the command."""
    master, slave = os.openpty()
    tty.setraw(slave)
    found = Wire(os.ttyname(slave))

    def listen() -> None:
        while True:
            try:
                data = os.read(master, 4096)
            except OSError:
                return
            if not data:
                return
            found.sent.extend(data)

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()
    yield found
    os.close(slave)
    thread.join(2.0)
    os.close(master)


@pytest.fixture
def recordings(tmp_path: Path) -> dict[str, str]:
    """Return the same pictures as a photograph, a folder, a film, and the URL of a film."""
    picture = np.full((480, 640, 3), 90, np.uint8)
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number in range(4):
        cv2.imwrite(str(folder / f"{number}.png"), picture)
    film = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (640, 480))
    for _ in range(30):
        writer.write(picture)
    writer.release()
    return {
        "photograph": str(folder / "0.png"),
        "folder": str(folder),
        "film": str(film),
        "url": film.as_uri(),
        "computed": "synthetic:orbit",
    }


@pytest.mark.parametrize("kind", ["photograph", "folder", "film", "url", "computed"])
@pytest.mark.parametrize("command", ["handeye", "verify"])
def test_a_recording_is_refused_while_the_bus_stays_silent(
    robot_ik: Any, tmp_path: Path, wire: Wire, recordings: dict[str, str], command: str, kind: str
) -> None:
    lens = tmp_path / "camera.yaml"
    place = tmp_path / "place.toml"
    STANDARD_CAMERA.save(lens)
    CameraExtrinsics(
        Pose((0.5, 0.0, 0.8)),
        "world",
        1e-6 * np.eye(6),
        0.1,
        0.1,
        "2026-01-01",
        STANDARD_CAMERA.digest,
    ).save(place)
    rest = ["--extrinsics", place] if command == "verify" else []
    run = robot_ik(
        "camera",
        command,
        "--robot",
        "tabletop_puma",
        "--bus",
        wire.port,
        "--camera",
        recordings[kind],
        "--intrinsics",
        lens,
        "--board",
        "marker:7:50",
        "--out",
        tmp_path / "result.json",
        *rest,
    )
    run.assert_one_screen_error()
    assert (
        "recorded pictures do not show the motions of this arm" in run.err
        and "--samples" in run.err
    )
    assert bytes(wire.sent) == b""
    assert not (tmp_path / "result.json").exists()


def test_opening_an_arm_sends_bytes_on_the_wire(robot_ik: Any, wire: Wire) -> None:
    run = robot_ik("servo", "scan", "--bus", wire.port, "--baud", "1000000")
    assert run.code != 0 and bytes(wire.sent).startswith(b"\xff\xff\xfd\x00"), run
