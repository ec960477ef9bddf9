"""Results of a job: files and folders reserved for one run before its work begins, and plots."""

from __future__ import annotations

import contextlib
import datetime
import errno
import fnmatch
import importlib.util
import io
import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robot_ik.errors import MissingExtraError, OutputError
from robot_ik.files import json_text, make_folder, plain, unwritable, write_atomically

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@contextlib.contextmanager
def folder_for_results(path: Path) -> Iterator[Path]:
    """Make a writable folder, and remove it afterwards if it is empty.

    Raises:
        OutputError: The folder cannot be made, or no file can be written to it.
    """
    new_folders = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        yield make_folder(path)
    finally:
        for folder in new_folders:  # the innermost first; a folder that is not empty stays
            with contextlib.suppress(OSError):
                folder.rmdir()


@contextlib.contextmanager
def claimed(*paths: Path | None, overwrite: bool = False) -> Iterator[None]:
    """Reserve the names of result files for one run, from before its work until its end.

    Args:
        paths: The files, which ``write_atomically`` writes later. Their folders are made. None
            stands for a file that is not requested.
        overwrite: Whether existing files may be replaced.

    Raises:
        OutputError: A file exists, its name is a folder, another run has reserved it, or it cannot
            be written.
    """
    with contextlib.ExitStack() as stack:
        for path in filter(None, paths):
            if path.is_dir():
                raise unwritable(path, IsADirectoryError(errno.EISDIR, "it is a folder"))
            if os.path.lexists(path) and not overwrite:
                raise _existing(path, "it exists")
            stack.enter_context(folder_for_results(path.parent))
            lock = path.with_name(f".{path.name}.lock")
            try:
                handle = os.open(lock, os.O_CREAT | os.O_RDWR, 0o644)
            except OSError as error:
                raise unwritable(path, error) from error
            stack.enter_context(_locked(handle, path))
            stack.callback(lock.unlink, missing_ok=True)
        yield


@contextlib.contextmanager
def claimed_folder(path: Path, pattern: str, *, overwrite: bool = False) -> Iterator[list[Path]]:
    """Reserve a folder for the results of one run. Remove it afterwards if it is empty.

    Args:
        path: The folder. It is made if it does not exist.
        pattern: Pattern of the names of results.
        overwrite: Whether existing results may be replaced.

    Yields:
        The existing results, to be removed when the first new result is written.

    Raises:
        OutputError: The folder holds results, another run has reserved it, or it cannot be written.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(folder_for_results(path))
        handle = None if os.name == "nt" else os.open(path, os.O_RDONLY)
        stack.enter_context(_locked(handle, path))
        results = sorted(path.glob(pattern))
        if results and not overwrite:
            others = ", …" if len(results) > 1 else ""
            raise _existing(path, f"it holds {results[0].name}{others}")
        yield results


@contextlib.contextmanager
def _locked(handle: int | None, path: Path) -> Iterator[None]:
    """Lock an open file, and close it at the end. The lock ends with the process at the latest."""
    if handle is None:
        yield
        return
    try:
        if fcntl is not None:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                hint = "give another name"
                raise OutputError(f"another run is writing to {path}", hint=hint) from error
            except OSError:  # a file system without locks
                pass
        yield
    finally:
        os.close(handle)


def _existing(path: Path, reason: str) -> OutputError:
    return OutputError(
        f"{path} was not changed: {reason}",
        hint="choose another name, or give --overwrite",
    )


@contextlib.contextmanager
def results_folder(
    out: str | Path, job: str, own: Sequence[str], *, overwrite: bool
) -> Iterator[Path]:
    """Reserve the folder ``out``, or ``runs/<time>-<job>`` if it is empty text, for one run.

    Former results that the run does not write are removed after it has written others, so that the
    folder never mixes the results of two runs. Other files stay.

    Args:
        out: The folder.
        job: Name of the job.
        own: Patterns of the names of results.
        overwrite: Whether existing results may be replaced.

    Raises:
        OutputError: The folder is not empty, another run has reserved it, or it cannot be written.
    """
    with contextlib.ExitStack() as stack:
        if not out:
            stack.enter_context(folder_for_results(Path("runs")))
            out = stack.enter_context(_new_folder(job))
            overwrite = False
        folder = Path(out)
        existing = stack.enter_context(claimed_folder(folder, "[!.]*", overwrite=overwrite))
        former = {
            path: _stamp(path)
            for path in existing
            if any(fnmatch.fnmatch(path.name, pattern) for pattern in own)
        }
        yield folder
        written = [path for path in folder.iterdir() if _stamp(path) != former.get(path)]
        for path in former if written else ():
            if path.exists() and _stamp(path) == former[path]:
                path.unlink()


@contextlib.contextmanager
def _new_folder(job: str) -> Iterator[Path]:
    """Make a folder of a new name, even if another run began in the same second."""
    name = f"{datetime.datetime.now():%Y%m%d-%H%M%S}-{job}"
    for k in itertools.count(1):
        folder = Path("runs") / (name if k == 1 else f"{name}-{k}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            break
    try:
        yield folder
    finally:
        with contextlib.suppress(OSError):  # it is not empty
            folder.rmdir()


def _stamp(path: Path) -> tuple[int, int]:
    """Return inode and time of a file, which change with every atomic write."""
    status = path.stat()
    return status.st_ino, status.st_mtime_ns


def save_json(path: Path, values: Any) -> Path:
    """Write the values of a job as JSON, atomically. Raise ``OutputError`` if that fails."""
    write_atomically(path, json_text(plain(values)) + "\n")
    return path


def require_plots(purpose: str) -> None:
    """Raise ``MissingExtraError`` unless matplotlib is installed. Called before long work."""
    if importlib.util.find_spec("matplotlib") is None:
        raise MissingExtraError("matplotlib", "plots", purpose)


def png_of(figure: Figure) -> bytes:
    """Return a figure of matplotlib as a PNG file."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
