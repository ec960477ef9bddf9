"""``@kernel``: the decorator for compiled code, with a cache that is never out of date.

The cache folder of a module is named after a hash of its source and of all sources that it
imports. numba's cache would keep a compiled caller after a change of a callee in another file.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
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
from llvmlite import binding as llvm  # type: ignore[import-untyped]
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserWideCacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock

from robot_ik.errors import OptionError
from robot_ik.kernels.typing_memory import KernelCompiler

# numba creates it from the environment during the import, so type checkers know no attributes.
numba_config: Any = numba.core.config
if numba_config.DISABLE_JIT:
    raise OptionError(
        "NUMBA_DISABLE_JIT",
        "the kernels need the compiler, and this variable switches it off",
        "unset, or 0",
        owner="environment",
    )

logger = logging.getLogger("robot_ik.kernels")


class _ExitGuard(event.Listener):
    """Stops compilation in other threads at exit. LLVM crashes if a thread compiles at its end."""

    exiting = False

    def stop_compiling(self) -> None:
        """Make the compiling thread stop at its next function, and keep numba's lock."""
        self.exiting = True
        global_compiler_lock.acquire()

    def on_start(self, _event: Any) -> None:
        """Stop the thread if the process exits."""
        if self.exiting:
            raise SystemExit

    def on_end(self, _event: Any) -> None:
        """Do nothing."""


_exit_guard = _ExitGuard()
event.register("numba:compile", _exit_guard)
atexit.register(_exit_guard.stop_compiling)

F = TypeVar("F", bound=Callable[..., Any])

# Without nnan and ninf, because comparisons with NaN and infinity must be correct. LLVM still folds
# isfinite(x) of a computed number to True, so kernels test numbers with comparisons.
_FASTMATH = {"contract", "reassoc", "arcp", "nsz"}
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": _FASTMATH,
    "no_cfunc_wrapper": True,
}

_PACKAGE = Path(__file__).resolve().parent.parent
# Packages with compiled code.
_WITH_COMPILED_CODE = ("kernels", "solvers", "camera", "reachability")
# Imports at the start of a line only, because compiled code cannot import inside functions.
_IMPORT = re.compile(
    r"^(?:from|import) robot_ik\.([\w.]+)(?: import (\([^)]*\)|[^\n]*))?", re.MULTILINE
)


def _file_of(module: str) -> Path | None:
    """Return the source of a module such as ``solvers.ccd``; None if it does not exist."""
    path = _PACKAGE.joinpath(*module.split("."))
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


@functools.cache
def _imported(path: Path) -> tuple[bytes, tuple[Path, ...]]:
    """Return the bytes of a source, and the sources of compiled code that it imports."""
    text = path.read_bytes()
    files: list[Path | None] = []
    for module, names in _IMPORT.findall(text.decode()):
        if module.split(".")[0] in _WITH_COMPILED_CODE:
            files += [
                _file_of(module),
                *(_file_of(f"{module}.{name}") for name in re.findall(r"\w+", names)),
            ]
    return text, tuple(dict.fromkeys(file for file in files if file is not None))


def sources(module: str) -> list[Path]:
    """Return every source that can change the compiled code of a module, in a fixed order.

    For a module outside ``robot_ik`` it is every source of the kernels.
    """
    source = _file_of(module.removeprefix("robot_ik.")) if module.startswith("robot_ik.") else None
    todo = [source] if source else list((_PACKAGE / "kernels").glob("*.py"))
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
    """Return the folder of a module's compiled code: the user's cache, else a temporary folder."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
    for source in sources(module):
        digest.update(source.name.encode())
        digest.update(_imported(source)[0])
    name = Path("robot-ik") / "kernels" / digest.hexdigest()[:16]
    candidates = [
        Path(tempfile.gettempdir()) / f"robot-ik-{os.getuid() if hasattr(os, 'getuid') else 0}"
    ]
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


class _KernelLocator(UserWideCacheLocator):
    """Locates the compiled code of a function in ``cache_folder`` of its module."""

    def __init__(self, function: Any, file: str) -> None:
        self._py_file = file
        self._lineno = function.__code__.co_firstlineno
        folder = cache_folder(function.__module__)
        self._cache_path = str(folder / self.get_suitable_cache_subpath(file))


class _KernelCacheImpl(CompileResultCacheImpl):
    # numba's locators serve functions without a file, such as those of a notebook.
    _locator_classes = [_KernelLocator, *CompileResultCacheImpl._locator_classes]  # noqa: RUF012


class _KernelCache(FunctionCache):
    """The cache of an entry point."""

    _impl_class = _KernelCacheImpl


# Inner functions are kept as unoptimised LLVM code. An entry point links in all that it calls, and
# LLVM optimises and compiles it once. numba alone optimises each function together with all its
# callees, so a function six calls deep would be optimised six times, which doubled a first compile.


class _NoEnvironment:
    """The code generator of an inner library for numba. Inner functions have no environment."""

    @staticmethod
    def set_env(_name: str, _environment: Any) -> None:
        """Do nothing. An environment is for Python objects."""


class _InnerLibrary(JITCodeLibrary):
    """LLVM code of a function that only compiled code calls. It is linked into its callers."""

    codegen = _NoEnvironment

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, _name: str) -> int:
        # A call from Python then raises a TypeError and does not crash.
        return ctypes.cast(ctypes.pythonapi.PyErr_BadArgument, ctypes.c_void_p).value or 0

    def serialize_using_object_code(self) -> tuple[str, bytes]:
        return self.name, self._get_module_for_linking().as_bitcode()

    @classmethod
    def load(cls, codegen: Any, name: str, bitcode: bytes) -> _InnerLibrary:
        """Return the library of a result of ``serialize_using_object_code``."""
        library = cls(codegen, name)
        library._final_module = library._shared_module = llvm.parse_bitcode(bitcode)
        library._finalize_final_module()
        return library


class _InnerCompiler(KernelCompiler):
    def compile_extra(self, function: Any) -> Any:
        self.state.library = _InnerLibrary(self.state.targetctx.codegen(), function.__qualname__)
        return super().compile_extra(function)


class _InnerContext:
    """A target context that loads inner libraries from the cache."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def codegen(self) -> Any:
        return self

    def unserialize_library(self, state: tuple[str, bytes]) -> _InnerLibrary:
        return _InnerLibrary.load(self._context.codegen(), *state)


class _InnerCacheImpl(_KernelCacheImpl):
    def reduce(self, result: Any) -> Any:
        # Without the listing of types, which takes longest to write.
        return super().reduce(result._replace(type_annotation=""))

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        return CompileResult._rebuild(_InnerContext(target_context), *payload)


class _InnerCache(FunctionCache):
    """The cache of an inner function."""

    _impl_class = _InnerCacheImpl


def _decorate(function: F, cache: type[FunctionCache], **options: Any) -> F:
    dispatcher: Any = numba.njit(**(_OPTIONS | options))(function)
    # ``cache=True`` would set numba's cache, whose folder is an option of the process.
    dispatcher._cache = cache(function)
    decorated: F = dispatcher
    return decorated


def _decorate_inner(function: F, **options: Any) -> F:
    options |= {"pipeline_class": _InnerCompiler, "no_cpython_wrapper": True, "_nrt": False}
    return _decorate(function, _InnerCache, **options)


def kernel(function: F) -> F:
    """Decorate an entry point. It is compiled on its first call and cached between processes.

    It releases the GIL and may allocate memory. Loops call ``inlined`` functions.
    """
    return _decorate(function, _KernelCache, pipeline_class=KernelCompiler)


def inlined(function: F) -> F:
    """Decorate inner code, which is inlined, allocates nothing and counts no references.

    numba would count references of every array in a tuple or a call, and a solver step would take
    4 µs instead of 0.5 µs. Only compiled code may call such a function.
    """
    return _decorate_inner(function, forceinline=True)


def literal(function: F) -> F:
    """Decorate inlined code whose sums keep their order, so that rounding errors cancel."""
    return _decorate_inner(function, forceinline=True, fastmath={"contract"})


def outlined(function: F) -> F:
    """Decorate inner code that is not inlined by force: it is large or has several callers.

    The option is explicit, because a function that is compiled for an inlined one would inherit
    the force.
    """
    return _decorate_inner(function, forceinline=False)


def entry(function: Any, *arguments: Any) -> Callable[..., Any]:
    """Return the compiled code of an entry point for the types of the arguments.

    A call of it skips numba's inspection of the types, 0.1 µs for each argument.
    """
    types = tuple(numba.typeof(argument) for argument in arguments)
    try:
        function.compile(types)
    except RuntimeError as error:
        if "no compiled object yet" not in str(error):
            raise
        # A signal came while LLVM compiled, and ctypes dropped the exception of its handler.
        raise KeyboardInterrupt from error
    entry_point: Callable[..., Any] = function.overloads[types].entry_point
    return entry_point


def compiled(function: Any) -> bool:
    """Return whether an entry point has been compiled on this machine from these sources."""
    return any(cache_folder(function.__module__).rglob(f"*.{function.__name__}-*.nbi"))


_announced: set[tuple[str, str]] = set()


def announce(function: Any, what: str) -> None:
    """Log one line if a call of ``function`` would compile it, which takes some seconds."""
    key = function.__module__, function.__name__
    if key in _announced:
        return
    _announced.add(key)
    if not compiled(function):
        logger.info("compiling %s: up to a minute, once on this machine", what)
