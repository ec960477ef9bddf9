"""``@kernel``: the one decorator for compiled code, with a cache that cannot go stale.

numba's own cache serves a compiled caller again although a callee or a constant in *another* file
has changed.  Here the cache folder is named after a hash of every compiled source (``kernels/`` and
``solvers/``), so any edit starts a fresh one.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

# Made while numba is imported, from the environment: no type checker can see what is in it.
numba_config: Any = numba.core.config

logger = logging.getLogger("robot_ik.kernels")

F = TypeVar("F", bound=Callable[..., Any])

# Not nnan and ninf: comparisons with NaN and infinity must mean what they say.  Even so LLVM folds
# isfinite(x) of a number that it has just computed to True: test numbers with comparisons instead.
_FASTMATH = {"contract", "reassoc", "arcp", "nsz"}
_OPTIONS: dict[str, Any] = {
    "cache": True, "nogil": True, "error_model": "numpy", "fastmath": _FASTMATH, "no_cfunc_wrapper": True,
}  # fmt: skip


def _sources() -> list[Path]:
    package = Path(__file__).resolve().parent.parent
    return sorted([*(package / "kernels").rglob("*.py"), *(package / "solvers").rglob("*.py")])


def _user_cache() -> Path:
    if "XDG_CACHE_HOME" in os.environ:
        return Path(os.environ["XDG_CACHE_HOME"])
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", str(Path.home() / "AppData" / "Local")))
    return Path.home() / ".cache"


@functools.cache
def cache_folder() -> Path:
    """Where compiled kernels are kept: the user's cache, or a temporary folder when that is not writable."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
    for source in _sources():
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    name = Path("robot-ik") / "kernels" / digest.hexdigest()[:16]
    candidates = [Path(tempfile.gettempdir()) / f"robot-ik-{os.getuid() if hasattr(os, 'getuid') else 0}"]
    with contextlib.suppress(RuntimeError):  # no home folder at all
        candidates.insert(0, _user_cache())
    for base in candidates:
        folder = base / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return Path(tempfile.mkdtemp(prefix="robot-ik-"))


def _compile(function: F, **options: Any) -> F:
    previous = numba_config.CACHE_DIR
    numba_config.CACHE_DIR = str(cache_folder())
    try:
        compiled = numba.njit(**_OPTIONS, **options)(function)
    finally:
        numba_config.CACHE_DIR = previous
    return compiled


def kernel(function: F) -> F:
    """An entry point: compiled on its first call, cached between processes, the GIL released while it runs.

    Entry points may take structrefs and allocate; what loops calls ``pure`` functions.
    """
    return _compile(function)


def pure(function: F) -> F:
    """Inner code: arrays in, arrays changed, nothing allocated, so nothing is reference-counted.

    Without this, numba counts references at every array that passes through a tuple or a call: a solver
    step then costs 4 µs instead of 0.5.  Such a function may be called from compiled code only.
    """
    return _compile(function, _nrt=False, forceinline=True, no_cpython_wrapper=True)


def outlined(function: F) -> F:
    """Like ``pure`` but compiled on its own: what is large or called twice, so that it is optimised once."""
    return _compile(function, _nrt=False)


def entry(function: Any, *arguments: Any) -> Callable[..., Any]:
    """The compiled code of an entry point, which takes arguments of the types of these and asks no more.

    numba's own call looks at the type of each argument first, which costs a tenth of a microsecond.
    """
    types = tuple(numba.typeof(argument) for argument in arguments)
    function.compile(types)
    found: Callable[..., Any] = function.overloads[types].entry_point
    return found


def compiled(function: Any) -> bool:
    """Whether an entry point has been compiled on this machine, from these sources."""
    return any(cache_folder().rglob(f"*.{function.__name__}-*.nbi"))


_announced: set[str] = set()


def announce(function: Any, what: str) -> None:
    """Logs one line if calling ``function`` now means compiling it (some seconds, once per machine)."""
    name = function.__name__
    if name in _announced:
        return
    _announced.add(name)
    if not compiled(function):
        logger.info("compiling %s: some seconds, once on this machine", what)
