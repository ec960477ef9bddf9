"""``@kernel``: the one decorator for compiled code, with a cache that cannot go stale.

A module's cache folder is named after a hash of its source and of every source that it imports: numba's own
cache serves a compiled caller again although a callee in *another* file has changed.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import hashlib
import importlib
import importlib.util
import logging
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numba
from llvmlite import binding as llvm  # type: ignore[import-untyped]
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock

from robot_ik.errors import OptionError
from robot_ik.kernels.typing_memory import KernelCompiler

# Made while numba is imported, from the environment: no type checker can see what is in it.
numba_config: Any = numba.core.config
if numba_config.DISABLE_JIT:
    raise OptionError(
        "NUMBA_DISABLE_JIT",
        "the kernels exist in compiled form only, and this variable switches the compiler off",
        "unset, or 0",
        owner="environment",
    )

logger = logging.getLogger("robot_ik.kernels")


# Import numba's arrays without SciPy's BLAS, which is a fifth of a program's start (0.15 s): numba
# imports it only to see that it is installed. The function is back in its place afterwards.
if "numba.np.arraymath" not in sys.modules and importlib.util.find_spec("scipy") is not None:
    _linalg: Any = importlib.import_module("numba.np.linalg")
    _ensure_blas = _linalg.ensure_blas
    _linalg.ensure_blas = lambda: None
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        _linalg.ensure_blas = _ensure_blas


class _ExitGuard(event.Listener):
    """Stops a thread that compiles when the process exits: LLVM crashes if it ends under a thread."""

    exiting = False

    def stop_compiling(self) -> None:
        """Make the compiling thread stop at its next function, and take numba's lock for good."""
        self.exiting = True
        global_compiler_lock.acquire()

    def on_start(self, event: Any) -> None:
        """Stop here if the process exits."""
        if self.exiting:
            raise SystemExit

    def on_end(self, event: Any) -> None:
        """Do nothing."""


_exit_guard = _ExitGuard()
event.register("numba:compile", _exit_guard)
atexit.register(_exit_guard.stop_compiling)

F = TypeVar("F", bound=Callable[..., Any])

# Not nnan and ninf: comparisons with NaN and infinity must mean what they say.  Even so LLVM folds
# isfinite(x) of a number that it has just computed to True: test numbers with comparisons instead.
_FASTMATH = {"contract", "reassoc", "arcp", "nsz"}
_OPTIONS: dict[str, Any] = {
    "cache": True, "nogil": True, "error_model": "numpy", "fastmath": _FASTMATH, "no_cfunc_wrapper": True,
}  # fmt: skip

_PACKAGE = Path(__file__).resolve().parent.parent
# What compiled code of one file takes from another lies in these.
_WITH_COMPILED_CODE = ("kernels", "solvers", "camera")
# At the margin only: what is imported inside a function is no global of compiled code.
_IMPORT = re.compile(r"^(?:from|import) robot_ik\.([\w.]+)(?: import (\([^)]*\)|[^\n]*))?", re.MULTILINE)


def _file_of(module: str) -> Path | None:
    """The source of ``solvers.ccd``; None for what is no module."""
    path = _PACKAGE.joinpath(*module.split("."))
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


@functools.cache
def _imported(path: Path) -> tuple[bytes, tuple[Path, ...]]:
    """One source, and the sources of compiled code that it imports."""
    text = path.read_bytes()
    found: list[Path | None] = []
    for module, names in _IMPORT.findall(text.decode()):
        if module.split(".")[0] in _WITH_COMPILED_CODE:
            found += [
                _file_of(module),
                *(_file_of(f"{module}.{name}") for name in re.findall(r"\w+", names)),
            ]
    return text, tuple(dict.fromkeys(other for other in found if other is not None))


def sources(module: str) -> list[Path]:
    """Every source that can change the compiled code of a module, its own among them, in a fixed order.

    Of a module outside ``robot_ik`` (a user's, a test's) every source of the kernels.
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
    usual = {"darwin": "Library/Caches", "win32": "AppData/Local"}.get(sys.platform, ".cache")
    windows = os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else None
    return Path(os.environ.get("XDG_CACHE_HOME") or windows or Path.home() / usual)


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


# Inner functions are kept as unoptimised LLVM code; an entry point links in all that it calls, optimises
# it and makes machine code of it, once.  numba by itself does so for every function together with all that
# lies below it: a function six calls deep would be optimised six times, which doubled a first compile.


class _NoEnvironment:
    """What numba sees as an inner library's code generator: it has no machine code that could hold one."""

    @staticmethod
    def set_env(name: str, environment: Any) -> None:
        """Does nothing: an environment is for Python objects, and inner functions have none."""


class _InnerLibrary(JITCodeLibrary):
    """LLVM code of a function that compiled code alone calls, to be linked into its callers."""

    codegen = _NoEnvironment

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        # Where Python would enter: a TypeError in place of a crash.
        return ctypes.cast(ctypes.pythonapi.PyErr_BadArgument, ctypes.c_void_p).value or 0

    def serialize_using_object_code(self) -> tuple[str, bytes]:
        return self.name, self._get_module_for_linking().as_bitcode()

    @classmethod
    def load(cls, codegen: Any, name: str, bitcode: bytes) -> _InnerLibrary:
        """From what ``serialize_using_object_code`` gave."""
        library = cls(codegen, name)
        library._final_module = library._shared_module = llvm.parse_bitcode(bitcode)
        library._finalize_final_module()
        return library


class _InnerCompiler(KernelCompiler):
    def compile_extra(self, function: Any) -> Any:
        self.state.library = _InnerLibrary(self.state.targetctx.codegen(), function.__qualname__)
        return super().compile_extra(function)


class _InnerContext:
    """A target context that makes inner libraries of what the cache holds."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def codegen(self) -> Any:
        return self

    def unserialize_library(self, state: tuple[str, bytes]) -> _InnerLibrary:
        return _InnerLibrary.load(self._context.codegen(), *state)


class _InnerCacheImpl(CompileResultCacheImpl):
    def reduce(self, result: Any) -> Any:
        # Without the listing of its types, which takes longer to write than all else.
        return super().reduce(result._replace(type_annotation=""))

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        return CompileResult._rebuild(_InnerContext(target_context), *payload)


class _InnerCache(FunctionCache):
    _impl_class = _InnerCacheImpl


@contextlib.contextmanager
def _cache_of(function: Any) -> Iterator[None]:
    """What is compiled inside is cached in the folder of the function's module."""
    previous, numba_config.CACHE_DIR = (
        numba_config.CACHE_DIR,
        str(cache_folder(function.__module__)),
    )
    try:
        yield
    finally:
        numba_config.CACHE_DIR = previous


def _compile_inner(function: F, **options: Any) -> F:
    options |= {
        "cache": False,
        "pipeline_class": _InnerCompiler,
        "no_cpython_wrapper": True,
        "_nrt": False,
    }
    with _cache_of(function):
        compiled: Any = numba.njit(**(_OPTIONS | options))(function)
        compiled._cache = _InnerCache(function)
    inner: F = compiled
    return inner


def kernel(function: F) -> F:
    """An entry point: compiled on its first call, cached between processes, the GIL released while it runs.

    Entry points may allocate; what loops calls ``inlined`` functions.
    """
    with _cache_of(function):
        compiled: F = numba.njit(**_OPTIONS, pipeline_class=KernelCompiler)(function)
    return compiled


def inlined(function: F) -> F:
    """Inner code: arrays in, arrays changed, nothing allocated, so nothing is reference-counted.

    Without this, numba counts references at every array that passes through a tuple or a call: a solver
    step then costs 4 µs instead of 0.5.  Such a function may be called from compiled code only.
    """
    return _compile_inner(function, forceinline=True)


def literal(function: F) -> F:
    """Like ``inlined``, but sums are formed as they are written: where rounding errors shall cancel."""
    return _compile_inner(function, forceinline=True, fastmath={"contract"})


def outlined(function: F) -> F:
    """Like ``inlined`` but never forced into its callers: what is large or called from several places.

    Stated explicitly, as a function first compiled for a forced one would inherit the force.
    """
    return _compile_inner(function, forceinline=False)


def entry(function: Any, *arguments: Any) -> Callable[..., Any]:
    """The compiled code of an entry point for such types: without numba's inspection of them, 0.1 µs each."""
    types = tuple(numba.typeof(argument) for argument in arguments)
    try:
        function.compile(types)
    except RuntimeError as error:
        if "no compiled object yet" not in str(error):
            raise
        # A signal came while LLVM made machine code: ctypes dropped what its handler raised.
        raise KeyboardInterrupt from error
    found: Callable[..., Any] = function.overloads[types].entry_point
    return found


def compiled(function: Any) -> bool:
    """Whether an entry point has been compiled on this machine, from these sources."""
    return any(cache_folder(function.__module__).rglob(f"*.{function.__name__}-*.nbi"))


_announced: set[tuple[str, str]] = set()


def announce(function: Any, what: str) -> None:
    """Logs one line if calling ``function`` now means compiling it (some seconds, once per machine)."""
    key = function.__module__, function.__name__
    if key in _announced:
        return
    _announced.add(key)
    if not compiled(function):
        logger.info("compiling %s: up to a minute, once on this machine", what)
