"""Where the pictures of jobs go: a film, one picture, or a folder of pictures.

They appear when complete; a run that is interrupted leaves what it has, playable.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from robot_ik.camera.image import write_image
from robot_ik.errors import MissingExtraError, OutputError
from robot_ik.jobs.results import claimed, claimed_folder
from robot_ik.ports import Image
from robot_ik.signals import deferred_signals

FILMS = (".mp4", ".mkv", ".mov", ".gif")
PICTURES = (".png", ".jpg", ".jpeg")
# Quality of H.264: 18 is nearly free of visible loss.
_CRF = "20"
_TICKS = 90_000
# Names of a folder's pictures.
_NUMBERED = "[0-9]" * 6 + ".png"


class PictureSink(ABC):
    """Takes pictures one by one, and is closed at the end."""

    @abstractmethod
    def write(self, image: Image, time: float) -> None:
        """Adds a picture (height, width, 3) taken at ``time``, seconds."""

    @abstractmethod
    def close(self) -> Path | None:
        """Ends the file; gives what was written, None for nothing."""


class Film(PictureSink):
    """A film, H.264, or a GIF, each picture in 256 colours of its own; shown at the time it was taken."""

    def __init__(self, path: Path, rate_hz: float) -> None:
        self._path = path
        self._part = path.with_name(f".{path.stem}.part{path.suffix}")
        self._rate = rate_hz
        self._container: Any = None
        self._stream: Any = None
        self._palettes: Any = None
        self._first = self._last = 0
        self._written = False

    def write(self, image: Image, time: float) -> None:
        import av

        with deferred_signals():  # half a picture would spoil those after it
            if self._container is None:
                self._open(image)
                self._first, self._last = round(time * _TICKS), -1
            frame = av.VideoFrame.from_ndarray(_even(image), format="bgr24")
            # two pictures of one time would be refused
            self._last = max(round(time * _TICKS) - self._first, self._last + 1)
            frame.pts = self._last
            frame.time_base = Fraction(1, _TICKS)
            self._encode(frame)

    def _encode(self, frame: Any) -> None:
        """Adds one to the file; None: what is left is written."""
        import av

        if self._palettes is None:
            self._container.mux(self._stream.encode(frame))
            return
        self._palettes.push(frame)
        with contextlib.suppress(av.BlockingIOError, av.EOFError):
            while True:
                self._container.mux(self._stream.encode(self._palettes.pull()))
        if frame is None:
            self._container.mux(self._stream.encode(None))

    def _open(self, image: Image) -> None:
        import av

        gif = self._path.suffix.lower() == ".gif"
        try:
            self._container = av.open(str(self._part), "w")
            self._stream = self._container.add_stream(
                "gif" if gif else "libx264", rate=Fraction(self._rate).limit_denominator(1000)
            )
        except (OSError, ValueError) as error:
            raise OutputError(
                f"cannot write {self._path}: {error}", hint="give another name or folder"
            ) from error
        height, width = _even(image).shape[:2]
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "pal8" if gif else "yuv420p"
        self._palettes = _palettes(width, height) if gif else None
        self._stream.options = {} if gif else {"crf": _CRF, "preset": "veryfast"}
        self._stream.codec_context.time_base = Fraction(1, _TICKS)

    def close(self) -> Path | None:
        if self._container is not None:
            self._encode(None)
            self._container.close()
            self._container = None
            os.replace(self._part, self._path)
            self._written = True
        return self._path if self._written else None


def _palettes(width: int, height: int) -> Any:
    """What gives each BGR picture the 256 colours that suit it best."""
    import av

    graph = av.filter.Graph()
    pictures = graph.add_buffer(
        width=width, height=height, format=av.VideoFormat("bgr24"), time_base=Fraction(1, _TICKS)
    )
    split, chosen = graph.add("split"), graph.add("palettegen", "stats_mode=single")
    used = graph.add("paletteuse", "new=1:dither=none")
    pictures.link_to(split)
    split.link_to(chosen, 0, 0)
    split.link_to(used, 1, 0)
    chosen.link_to(used, 0, 1)
    used.link_to(graph.add("buffersink"))
    graph.configure()
    return graph


class Pictures(PictureSink):
    """A folder of numbered PNG files, which take the place of ``older`` ones."""

    def __init__(self, folder: Path, older: Sequence[Path]) -> None:
        self._folder, self._older, self._count = folder, older, 0

    def write(self, image: Image, time: float) -> None:
        if not self._count:
            for path in self._older:
                path.unlink(missing_ok=True)
        write_image(self._folder / f"{self._count:06d}.png", image)
        self._count += 1

    def close(self) -> Path | None:
        return self._folder if self._count else None


class LastPicture(PictureSink):
    """One file that holds the last picture."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._image: Image | None = None

    def write(self, image: Image, time: float) -> None:
        self._image = image

    def close(self) -> Path | None:
        if self._image is None:
            return None
        write_image(self._path, self._image)
        return self._path


def films_can_be_written() -> bool:
    """Whether the extra ``video`` is installed."""
    return importlib.util.find_spec("av") is not None


def require_films(purpose: str = "writing a film") -> None:
    """Raises ``MissingExtraError`` where no film can be written."""
    if not films_can_be_written():
        raise MissingExtraError("av", "video", purpose)


@contextlib.contextmanager
def open_sink(out: Path, rate_hz: float, *, overwrite: bool = False) -> Iterator[PictureSink]:
    """What the name asks for: a film of ``rate_hz``, a picture or, without a suffix, a folder.

    It keeps what it got however the block ends.

    Raises:
        MissingExtraError: A film without the extra ``video``.
        OutputError: Nothing of this kind is written, it is there already and not to be overwritten, or it
            cannot be written.
    """
    kind = out.suffix.lower()
    if kind in FILMS:
        require_films()
    if kind not in (*FILMS, *PICTURES):
        if kind and not out.is_dir():
            raise OutputError(
                f"cannot write {out}: neither films nor pictures of this kind are made",
                hint=f"films: {', '.join(FILMS)}; pictures: {', '.join(PICTURES)}; a folder has no suffix",
            )
        folder = claimed_folder(out, _NUMBERED, overwrite=overwrite)
        with folder as older, contextlib.closing(Pictures(out, older)) as pictures:
            yield pictures
        return
    kept: PictureSink = Film(out, rate_hz) if kind in FILMS else LastPicture(out)
    with claimed(out, overwrite=overwrite), contextlib.closing(kept) as sink:
        yield sink


def _even(image: Image) -> Image:
    """H.264 with colours at half the resolution wants even sides."""
    height, width = image.shape[:2]
    return np.ascontiguousarray(image[: height - height % 2, : width - width % 2])
