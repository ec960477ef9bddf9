"""Outputs for pictures: a film, a single picture, or a folder of pictures.

A file appears under its name when it is complete. An interrupted run leaves a playable film of the
pictures so far.
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
from robot_ik.ports import Image
from robot_ik.signals import deferred_signals
from robot_ik.workcell.results import claimed, claimed_folder

FILMS = (".mp4", ".mkv", ".mov", ".gif")
"""Suffixes of films."""

PICTURES = (".png", ".jpg", ".jpeg")
"""Suffixes of single pictures."""

_CRF = "20"
"""Constant rate factor of H.264. At 18 there is hardly any visible loss; larger is coarser."""

_TICKS = 90_000
"""Time stamps per second. 90 kHz is the usual clock of video."""

_NUMBERED = "[0-9]" * 6 + ".png"
"""Pattern of the file names in a folder of pictures."""


class PictureSink(ABC):
    """An output that takes pictures one by one until it is closed."""

    @abstractmethod
    def write(self, image: Image, time: float) -> None:
        """Add a BGR picture (height, width, 3) taken at ``time``, seconds."""

    @abstractmethod
    def close(self) -> Path | None:
        """Complete the output.

        Returns:
            The file or folder. None if no picture was written.
        """


class Film(PictureSink):
    """A film in H.264, or a GIF. Each picture is shown at the time it was taken.

    Each picture of a GIF has its own palette of 256 colours.

    Args:
        path: The film. Its suffix selects the format.
        rate_hz: Nominal number of pictures per second.
    """

    def __init__(self, path: Path, rate_hz: float) -> None:
        self._path = path
        self._part = path.with_name(f".{path.stem}.part{path.suffix}")
        self._rate = rate_hz
        self._container: Any = None
        self._stream: Any = None
        self._palettes: Any = None
        # Time stamps in ticks: of the first picture, and of the last one relative to the first.
        self._first = 0
        self._last = -1
        self._written = False

    def write(self, image: Image, time: float) -> None:
        import av

        # A signal in the middle of a picture would damage the pictures after it.
        with deferred_signals():
            if self._container is None:
                self._open(image)
                self._first = round(time * _TICKS)
                self._last = -1
            frame = av.VideoFrame.from_ndarray(_cropped_to_even(image), format="bgr24")
            # The encoder rejects two pictures with the same time stamp.
            self._last = max(round(time * _TICKS) - self._first, self._last + 1)
            frame.pts = self._last
            frame.time_base = Fraction(1, _TICKS)
            self._encode(frame)

    def _encode(self, frame: Any) -> None:
        """Add a frame to the file. None: write the frames that the encoder still holds."""
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

        is_gif = self._path.suffix.lower() == ".gif"
        codec = "gif" if is_gif else "libx264"
        rate = Fraction(self._rate).limit_denominator(1000)
        try:
            self._container = av.open(str(self._part), "w")
            self._stream = self._container.add_stream(codec, rate=rate)
        except (OSError, ValueError) as error:
            raise OutputError(
                f"cannot write {self._path}: {error}", hint="give another name or folder"
            ) from error
        height, width = _cropped_to_even(image).shape[:2]
        self._stream.width = width
        self._stream.height = height
        self._stream.pix_fmt = "pal8" if is_gif else "yuv420p"
        self._stream.options = {} if is_gif else {"crf": _CRF, "preset": "veryfast"}
        self._palettes = _palette_filter(width, height) if is_gif else None
        self._stream.codec_context.time_base = Fraction(1, _TICKS)

    def close(self) -> Path | None:
        if self._container is not None:
            self._encode(None)
            self._container.close()
            self._container = None
            os.replace(self._part, self._path)
            self._written = True
        return self._path if self._written else None


def _palette_filter(width: int, height: int) -> Any:
    """Return a filter graph that reduces each BGR picture to its own best 256 colours."""
    import av

    graph = av.filter.Graph()
    pictures = graph.add_buffer(
        width=width, height=height, format=av.VideoFormat("bgr24"), time_base=Fraction(1, _TICKS)
    )
    split = graph.add("split")
    make_palette = graph.add("palettegen", "stats_mode=single")
    apply_palette = graph.add("paletteuse", "new=1:dither=none")
    pictures.link_to(split)
    split.link_to(make_palette, 0, 0)
    split.link_to(apply_palette, 1, 0)
    make_palette.link_to(apply_palette, 0, 1)
    apply_palette.link_to(graph.add("buffersink"))
    graph.configure()
    return graph


class Pictures(PictureSink):
    """A folder of numbered PNG files.

    Args:
        folder: The folder.
        older: Files of an earlier run. They are removed before the first picture is written.
    """

    def __init__(self, folder: Path, older: Sequence[Path]) -> None:
        self._folder = folder
        self._older = older
        self._count = 0

    def write(self, image: Image, _time: float) -> None:
        if not self._count:
            for path in self._older:
                path.unlink(missing_ok=True)
        write_image(self._folder / f"{self._count:06d}.png", image)
        self._count += 1

    def close(self) -> Path | None:
        return self._folder if self._count else None


class LastPicture(PictureSink):
    """A single picture file, which holds the last picture."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._image: Image | None = None

    def write(self, image: Image, _time: float) -> None:
        self._image = image

    def close(self) -> Path | None:
        if self._image is None:
            return None
        write_image(self._path, self._image)
        return self._path


def films_can_be_written() -> bool:
    """Return whether the extra ``video`` is installed."""
    return importlib.util.find_spec("av") is not None


def require_films(purpose: str = "writing a film") -> None:
    """Check that films can be written.

    Args:
        purpose: Use of the extra, for the message.

    Raises:
        MissingExtraError: The extra ``video`` is not installed.
    """
    if not films_can_be_written():
        raise MissingExtraError("av", "video", purpose)


@contextlib.contextmanager
def open_sink(out: Path, rate_hz: float, *, overwrite: bool = False) -> Iterator[PictureSink]:
    """Open the output that fits the name: a film, a picture, or without a suffix a folder.

    The pictures written so far are kept even if the block ends with an error.

    Args:
        out: The file or folder.
        rate_hz: Nominal number of pictures per second of a film.
        overwrite: Whether existing results may be replaced.

    Yields:
        The output. It is closed after the block.

    Raises:
        MissingExtraError: ``out`` is a film, but the extra ``video`` is not installed.
        OutputError: The suffix is not supported, the output exists and ``overwrite`` is False, or
            it cannot be written.
    """
    suffix = out.suffix.lower()
    if suffix in FILMS:
        require_films()
    if suffix not in (*FILMS, *PICTURES):
        if suffix and not out.is_dir():
            raise OutputError(
                f"cannot write {out}: neither films nor pictures of this kind are made",
                hint=f"films: {', '.join(FILMS)}; pictures: {', '.join(PICTURES)}; "
                "a folder has no suffix",
            )
        folder = claimed_folder(out, _NUMBERED, overwrite=overwrite)
        with folder as older, contextlib.closing(Pictures(out, older)) as pictures:
            yield pictures
        return
    file: PictureSink = Film(out, rate_hz) if suffix in FILMS else LastPicture(out)
    with claimed(out, overwrite=overwrite), contextlib.closing(file) as sink:
        yield sink


def _cropped_to_even(image: Image) -> Image:
    """Return the picture with even width and height, which H.264 in yuv420p needs."""
    height, width = image.shape[:2]
    return np.ascontiguousarray(image[: height - height % 2, : width - width % 2])
