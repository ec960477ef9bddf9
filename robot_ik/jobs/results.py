"""A job's results: their folder, one run's alone from before the work begins until it ends; plots."""

from __future__ import annotations

import contextlib
import datetime
import fnmatch
import importlib.util
import io
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robot_ik.errors import MissingExtraError
from robot_ik.files import claimed_folder, folder_for_results, json_text, plain, write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@contextlib.contextmanager
def results_folder(out: str | Path, job: str, own: Sequence[str], *, overwrite: bool) -> Iterator[Path]:
    """The folder for one run, as asked or ``runs/<time>-<job>``; taken back where it stays empty.

    Files of names like ``own`` may be replaced to ``overwrite``.  Those of before that the run does not write
    are removed when it has written others, so that two runs do not mix; what is not its own stays.

    Raises:
        OutputError: The folder holds something, another run writes to it, or it cannot be written to.
    """
    with contextlib.ExitStack() as stack:
        if not out:
            stack.enter_context(folder_for_results(Path("runs")))
            out, overwrite = stack.enter_context(_new_folder(job)), False
        folder = Path(out)
        held = stack.enter_context(claimed_folder(folder, "[!.]*", overwrite=overwrite))
        before = {path: _stamp(path) for path in held if any(fnmatch.fnmatch(path.name, p) for p in own)}
        yield folder
        written = [path for path in folder.iterdir() if _stamp(path) != before.get(path)]
        for path in before if written else ():
            if path.exists() and _stamp(path) == before[path]:
                path.unlink()


@contextlib.contextmanager
def _new_folder(job: str) -> Iterator[Path]:
    """A folder that no other run has, not even one that began in the same second."""
    name = f"{datetime.datetime.now():%Y%m%d-%H%M%S}-{job}"
    for k in itertools.count(1):
        folder = Path("runs") / (name if k == 1 else f"{name}-{k}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            break
    try:
        yield folder
    finally:
        with contextlib.suppress(OSError):  # it holds something
            folder.rmdir()


def _stamp(path: Path) -> tuple[int, int]:
    """Changes whenever a file is written whole: its inode and time."""
    found = path.stat()
    return found.st_ino, found.st_mtime_ns


def save_json(path: Path, values: Any) -> Path:
    """Writes what a job has found, whole or not at all; OutputError: it cannot be written."""
    write_atomically(path, json_text(plain(values)) + "\n")
    return path


def require_plots(purpose: str) -> None:
    """Raises ``MissingExtraError`` unless matplotlib is installed; asked before any long work."""
    if importlib.util.find_spec("matplotlib") is None:
        raise MissingExtraError("matplotlib", "plots", purpose)


def png_of(figure: Figure) -> bytes:
    """A figure of matplotlib as a PNG file."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
