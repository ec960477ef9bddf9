"""Picture sources on real files, a real local web server and a camera that is made to misbehave."""

from __future__ import annotations

import functools
import http.server
import os
import tempfile
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from robot_ik.camera.image import natural_sort, read_image
from robot_ik.camera.patterns import ChessboardPattern
from robot_ik.camera.sources import (
    FolderSource,
    Frame,
    FrameSource,
    ImageSource,
    VideoSource,
    open_source,
)
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import PatternTarget, marker
from robot_ik.camera.tracker import Tracker
from robot_ik.errors import CameraError, CameraNotFoundError, FrameSizeError, FrameTimeoutError
from robot_ik.workcell.pictures import MarkerFinder


def picture(value: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    return np.full((size[1], size[0], 3), value, np.uint8)


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """Twelve pictures, each a little brighter, at 10 Hz."""
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    assert writer.isOpened()
    for i in range(12):
        writer.write(picture(20 * i))
    writer.release()
    return path


def test_a_photograph_is_not_live_and_always_the_same(tmp_path: Path) -> None:
    path = tmp_path / "photo ü.png"
    path.write_bytes(cv2.imencode(".png", picture(7))[1].tobytes())
    with open_source(str(path)) as source:
        assert isinstance(source, FrameSource)
        assert not source.live
        first = source.read()
        second = source.read()
    assert first is second
    assert (first.image == 7).all()
    assert first.size == (64, 48)


def test_grey_transparent_and_deep_pictures_become_bgr(tmp_path: Path) -> None:
    for name, image in {
        "grey.png": np.full((4, 6), 9, np.uint8),
        "alpha.png": np.full((4, 6, 4), 9, np.uint8),
        "deep.png": np.full((4, 6, 3), 9 * 257, np.uint16),
    }.items():
        cv2.imwrite(str(tmp_path / name), image)
        read = read_image(tmp_path / name)
        assert (read.shape, read.dtype) == ((4, 6, 3), np.uint8)
        assert (read == 9).all()


def test_the_orientation_mark_of_a_photograph_is_ignored(tmp_path: Path) -> None:
    data = cv2.imencode(".jpg", picture(100))[1].tobytes()
    # Smallest EXIF block that says "turn by 90 degrees" (tag 0x0112, value 6), after the start
    # marker.
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00"
    tiff = b"MM\x00*\x00\x00\x00\x08" + b"\x00\x01" + entry + b"\x00" * 4
    body = b"Exif\x00\x00" + tiff
    path = tmp_path / "turned.jpg"
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:])
    assert cv2.imread(str(path)).shape == (64, 48, 3), "the mark is there: OpenCV turns the picture"
    assert read_image(path).shape == (48, 64, 3)


def test_a_folder_is_read_in_natural_order(tmp_path: Path) -> None:
    for number in (10, 9, 1, 2):
        cv2.imwrite(str(tmp_path / f"frame{number}.png"), picture(number))
    (tmp_path / "notes.txt").write_text("not a picture")
    with open_source(str(tmp_path)) as source:
        assert isinstance(source, FolderSource)
        frames = list(source)
        with pytest.raises(FrameTimeoutError, match="all 4 pictures"):
            source.read()
        assert not source.live
    assert [int(f.image[0, 0, 0]) for f in frames] == [1, 2, 9, 10]
    assert [f.sequence for f in frames] == [0, 1, 2, 3]
    assert np.diff([f.time for f in frames]) == pytest.approx(1 / 30)


def test_natural_order_mixes_words_and_numbers() -> None:
    names = ["b", "a10", "10", "a9", "a", "9", "a9b", "A8"]
    ordered = [p.name for p in natural_sort(Path(n) for n in names)]
    assert ordered == ["9", "10", "a", "A8", "a9", "a9b", "a10", "b"]


def test_a_film_gives_every_picture_with_its_time(film: Path) -> None:
    with open_source(str(film)) as source:
        assert isinstance(source, VideoSource)
        assert not source.live
        frames = list(source)
        with pytest.raises(FrameTimeoutError, match="ended after 12 pictures"):
            source.read()
    assert [round(int(f.image[20, 20, 0]) / 20) for f in frames] == list(range(12))
    assert np.diff([f.time for f in frames]) == pytest.approx(0.1)


def test_a_synthetic_camera_keeps_its_truth_separate() -> None:
    with open_source("synthetic:orbit?frames=3&seed=4&noise=2") as source:
        first = source.read()
        (pose,) = first.truth["pose_camera_marker"].values()  # type: ignore[index]
        seen = marker(7, 0.05).find(first.without_truth(), STANDARD_CAMERA)
        assert seen is not None
        assert max(seen.pose.distance(pose)) < 5e-3
        assert len(list(source)) == 2
        with pytest.raises(FrameTimeoutError, match="3 pictures have been read"):
            source.read()
    again = open_source("synthetic:orbit?frames=3&seed=4&noise=2").read()
    assert (again.image == first.image).all(), "the same seed gives the same picture"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("synthetic:orbti", "unknown synthetic scene 'orbti'"),
        ("synthetic:orbit?nose=3", "unknown option of a synthetic source 'nose'"),
        ("synthetic:orbit?noise=loud", "noise='loud' of a synthetic source must be a number"),
        ("synthetic:orbit?frames=-1", "must be from 0 to"),
    ],
)
def test_synthetic_sources_that_do_not_exist_are_reported(text: str, message: str) -> None:
    with pytest.raises(CameraNotFoundError, match=message):
        open_source(text)


def test_a_file_without_a_picture_is_reported(tmp_path: Path) -> None:
    tracker = Tracker(STANDARD_CAMERA, [marker(7, 0.05)])
    board = ChessboardPattern(9, 6, 0.025)
    for frame, named in ((picture(1), "ndarray"), (None, "None"), ("photo.png", "str")):
        for look in (tracker.observe, MarkerFinder("DICT_5X5_50").observe):
            with pytest.raises(
                CameraError, match=rf"expected a Frame, got {named}(.|\n)*open_source"
            ):
                look(frame)  # type: ignore[arg-type]
        with pytest.raises(CameraError, match=f"expected a Frame, got {named}"):
            PatternTarget(board).find(frame, STANDARD_CAMERA)  # type: ignore[arg-type]
    for image, named in (("photo.png", "str"), (None, "NoneType"), (picture(1) / 2.0, "float64")):
        with pytest.raises(CameraError, match=f"uint8, got .*{named}"):
            board.find(image)  # type: ignore[arg-type]
    for lens in (tmp_path / "camera.yaml", None):
        with pytest.raises(CameraError, match="poses need the camera's intrinsics"):
            marker(7, 0.05).find(Frame(picture(1), 0.0, 0), lens)  # type: ignore[arg-type]


def test_another_size_than_asked_is_reported(tmp_path: Path, film: Path) -> None:
    cv2.imwrite(str(tmp_path / "photo.png"), picture(1))
    for name in ("photo.png", "clip.avi", "."):
        with pytest.raises(FrameSizeError, match="64x48 px, not 640x480"):
            open_source(str(tmp_path / name), size=(640, 480))
        open_source(str(tmp_path / name), size=(64, 48)).close()


def test_truth_can_be_removed() -> None:
    frame = Frame(picture(3), 1.5, 4, truth={"q": 1})
    bare = frame.without_truth()
    assert bare.truth is None
    assert (bare.time, bare.sequence) == (1.5, 4)
    assert bare.image is frame.image


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cut.png", "not a picture"),
        ("damaged.png", "not a picture"),
        ("nothing.jpg", "no camera, file or folder"),
        ("empty", "contains no pictures"),
        ("words.txt", "not a picture"),
        ("broken.mp4", "not a film"),
        ("97", "there is no camera 97"),
        (97, "there is no camera 97"),
        (Path("nothing.jpg"), "no camera, file or folder"),
        ("/dev/video97", "there is no camera /dev/video97"),
        ("http://127.0.0.1:9/stream", "cannot open camera http"),
    ],
)
def test_a_source_that_does_not_open_is_reported(
    tmp_path: Path,
    text: str | int | Path,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "words.txt").write_text("hello")
    (tmp_path / "broken.mp4").write_bytes(b"\x00" * 100)
    png = cv2.imencode(".png", picture(1))[1].tobytes()
    (tmp_path / "cut.png").write_bytes(png[:-12])
    (tmp_path / "damaged.png").write_bytes(png[:50] + b"\xff" + png[51:])
    cv2.imwrite(str(tmp_path / "right.png"), picture(1))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CameraNotFoundError, match=message) as caught:
        open_source(text)
    assert caught.value.hint
    if text == "nothing.jpg":
        assert "right.png" in str(caught.value)
    assert capfd.readouterr().err == "", "OpenCV must be quiet"


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Check that the terminal shows nothing."""


def test_a_film_on_a_server_is_opened_and_is_not_live(film: Path) -> None:
    handler = functools.partial(QuietHandler, directory=str(film.parent))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            with open_source(
                f"http://127.0.0.1:{server.server_port}/clip.avi", size=(64, 48)
            ) as source:
                assert not source.live
                assert source.read().size == (64, 48)
                # A file on a server ends; a stream that ends is reported.
                with pytest.raises(FrameTimeoutError, match="stopped delivering"):
                    for _ in range(20):
                        source.read()
        finally:
            server.shutdown()


def test_an_image_source_counts_as_exhausted_once_given(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), picture(1))
    assert len(list(ImageSource(tmp_path / "a.png"))) == 1


def test_every_source_must_state_whether_it_is_live() -> None:
    class Silent(FrameSource):
        def read(self) -> Frame:
            return Frame(picture(0), 0.0, 0)

    with pytest.raises(TypeError, match="live"):
        Silent()  # type: ignore[abstract]


def test_a_file_in_memory_and_a_file_url_are_recordings(film: Path) -> None:
    with open_source(film.as_uri()) as source:
        assert isinstance(source, VideoSource) and not source.live
    shared = Path("/dev/shm")
    if not os.access(shared, os.W_OK):
        pytest.skip("no /dev/shm here")
    with tempfile.NamedTemporaryFile(dir=shared, suffix=".avi") as file:
        file.write(film.read_bytes())
        file.flush()
        with open_source(file.name) as source:
            assert isinstance(source, VideoSource) and not source.live
