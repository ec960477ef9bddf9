"""``@kernel``: the one decorator for compiled code, with a cache that cannot go stale.

numba's own cache serves a compiled caller again although a callee or a constant in *another* file
has changed.  Here a module's cache folder is named after a hash of its source and of every source that it
imports, so an edit starts a fresh one for what it concerns, and for nothing else.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba import types
from numba.extending import intrinsic

from robot_ik.errors import ConfigError

# Made while numba is imported, from the environment: no type checker can see what is in it.
numba_config: Any = numba.core.config
if numba_config.DISABLE_JIT:
    raise ConfigError(
        "the kernels exist compiled only, and this switches the compiler off",
        file="environment", key="NUMBA_DISABLE_JIT", allowed="unset, or 0",
    )  # fmt: skip

logger = logging.getLogger("robot_ik.kernels")

F = TypeVar("F", bound=Callable[..., Any])

# Not nnan and ninf: comparisons with NaN and infinity must mean what they say.  Even so LLVM folds
# isfinite(x) of a number that it has just computed to True: test numbers with comparisons instead.
_FASTMATH = {"contract", "reassoc", "arcp", "nsz"}
_OPTIONS: dict[str, Any] = {
    "cache": True, "nogil": True, "error_model": "numpy", "fastmath": _FASTMATH, "no_cfunc_wrapper": True,
}  # fmt: skip


_PACKAGE = Path(__file__).resolve().parent.parent
# Rooms with compiled code: what compiled code of one file takes from another lies in them.
_ROOMS = ("kernels", "solvers", "camera")
# At the margin only: what is imported inside a function is no global of compiled code.
_IMPORT = re.compile(r"^(?:from|import) robot_ik\.([\w.]+)(?: import (\([^)]*\)|[^\n]*))?", re.MULTILINE)


def _file_of(module: str) -> Path | None:
    """The source of ``solvers.ccd``; None for what is not a module of a room with compiled code."""
    if module.split(".")[0] not in _ROOMS:
        return None
    path = _PACKAGE.joinpath(*module.split("."))
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


@functools.cache
def _imported(path: Path) -> tuple[bytes, tuple[Path, ...]]:
    """One source, and the sources that it imports."""
    text = path.read_bytes()
    found: list[Path | None] = []
    for module, names in _IMPORT.findall(text.decode()):
        found += [_file_of(module), *(_file_of(f"{module}.{name}") for name in re.findall(r"\w+", names))]
    return text, tuple(dict.fromkeys(other for other in found if other is not None))


def sources(module: str) -> list[Path]:
    """Every source that can change the compiled code of a module, its own among them, in a fixed order.

    Args:
        module: Its full name; for one outside ``robot_ik`` (a user's, a test's) every source of the kernels.
    """
    own = _file_of(module.removeprefix("robot_ik.")) if module.startswith("robot_ik.") else None
    todo = [own] if own else list((_PACKAGE / "kernels").glob("*.py"))
    known: set[Path] = set()
    while todo:
        source = todo.pop()
        if source not in known:
            known.add(source)
            todo += _imported(source)[1]
    return sorted(known)


def _user_cache() -> Path:
    if "XDG_CACHE_HOME" in os.environ:
        return Path(os.environ["XDG_CACHE_HOME"])
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", str(Path.home() / "AppData" / "Local")))
    return Path.home() / ".cache"


@functools.cache
def cache_folder(module: str = __name__) -> Path:
    """Where a module's compiled code is kept: the user's cache, or a temporary folder if need be."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
    for source in sources(module):
        digest.update(source.name.encode())
        digest.update(_imported(source)[0])
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
    numba_config.CACHE_DIR = str(cache_folder(function.__module__))
    try:
        compiled = numba.njit(**(_OPTIONS | options))(function)
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


def literal(function: F) -> F:
    """Like ``pure``, but sums are formed as they are written: where rounding errors shall cancel."""
    return _compile(function, _nrt=False, forceinline=True, no_cpython_wrapper=True, fastmath={"contract"})


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
    return any(cache_folder(function.__module__).rglob(f"*.{function.__name__}-*.nbi"))


_announced: set[str] = set()


def announce(function: Any, what: str) -> None:
    """Logs one line if calling ``function`` now means compiling it (some seconds, once per machine)."""
    name = function.__name__
    if name in _announced:
        return
    _announced.add(name)
    if not compiled(function):
        logger.info("compiling %s: up to a minute, once on this machine", what)


# ------------------------------------------------------------------------------------------
# ``keep_apart()``: keeps LLVM from copying a large function into all its callers.
#
# A limb's closed form calls one function from many places, several levels deep: copied, it compiles for a
# minute in place of seconds, and runs no faster.


@intrinsic
def noinline(_typing: Any) -> Any:
    """Marks the compiled function that calls it; does nothing when it runs."""

    def mark(_context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        builder.function.attributes.add("noinline")
        return _context.get_dummy_value()

    return types.none(), mark
