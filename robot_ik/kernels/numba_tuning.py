"""What makes numba compile faster, with the same machine code (the camera's aside: a level of LLVM less).

Three quarters of a first compile are numba's own Python.  Much of that is spent on finding again what it
found before: which of thirty implementations an addition of two numbers takes, where each variable lives.
``jit`` calls ``tune()`` when something is about to be compiled.  It reaches into numba, whose versions
pyproject.toml bounds, and so concerns all that the process compiles from then on.
"""

from __future__ import annotations

import functools
import gc
import threading
import types as python_types
from typing import Any

from llvmlite import binding as llvm  # type: ignore[import-untyped]
from numba.core import base, config, ir, types
from numba.core.base import BaseContext
from numba.core.codegen import CPUCodeLibrary
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.core.targetconfig import ConfigStack, TargetConfig
from numba.core.transforms import canonicalize_cfg
from numba.core.types.functions import BaseFunction

# As numba has them.
find_call_type, variables_of = BaseFunction.get_call_type, ir.Inst._rec_list_vars
run_post_processor = PostProcessor.run


@functools.cache
def tune() -> None:
    """Applies all that this module has, once."""
    _remember_call_types()
    _compare_options_quickly()
    _list_variables_quickly()
    _analyse_lifetimes_when_asked()
    _optimize_definitions_only()
    _remember_plain_arrays()
    _refresh_when_something_is_new()
    _remember_small_results()
    _leave_out_lock_events()


def _remember_call_types() -> None:
    """Lets a builtin's signature for numbers and arrays be found once, not at each operation.

    numba asks the builtin's templates one after the other, and writes an explanation for each that does not
    fit: a quarter of a first compile.
    """
    tables: dict[Any, dict[Any, Any]] = {}
    current: tuple[Any, dict[Any, Any]] = (tables, {})

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        nonlocal current
        options, known = ConfigStack.top_or_none(), current[1]
        if options is not current[0]:  # a table for all options that are equal
            known = tables.setdefault(options and options.copy(), {})
            current = options, known
        key = self, context, tuple(args)
        signature = None if kws else known.get(key)
        if signature is None:
            signature = find_call_type(self, context, args, kws)
            if not kws and all(map(_is_plain, args)):
                known[key] = signature
        return signature

    setattr(BaseFunction, "get_call_type", get_call_type)  # noqa: B010 (mypy: a class's method)


_PLAIN = (types.Number, types.Boolean, types.Array, types.SliceType, types.NoneType)


def _is_plain(kind: Any) -> bool:
    """Whether a type has all that a signature depends on: functions and lists have not."""
    if isinstance(kind, types.UniTuple | types.Tuple):
        return all(map(_is_plain, kind.types))
    return isinstance(kind, _PLAIN)


def _compare_options_quickly() -> None:
    """Lets equal options of the compiler be equal without a comparison of each.

    numba compares them at every operation whose type it infers, and makes two tables of forty options for
    that: a tenth of a first compile.  Its own hash of options is one number for all of a kind, too.
    """
    compare = TargetConfig.__eq__

    def equal(self: Any, other: Any) -> Any:
        return self is other or self._values == getattr(other, "_values", None) or compare(self, other)

    setattr(TargetConfig, "__eq__", equal)  # noqa: B010 (mypy: a class's method)
    setattr(TargetConfig, "__hash__", lambda self: hash(type(self)))  # noqa: B010


def _list_variables_quickly() -> None:
    """Lets an instruction list its variables without a call for each of its texts, places and functions."""
    leaves = {
        str, int, bool, float, type(None), ir.Loc, ir.Const, ir.Global, ir.FreeVar, ir.Arg,
        python_types.BuiltinFunctionType, python_types.FunctionType,
    }  # fmt: skip

    def collect(values: Any, found: list[Any]) -> None:
        for item in values:
            kind = type(item)
            if kind is ir.Var:
                found.append(item)
            elif kind is ir.Expr:
                collect(item._kws.values(), found)
            elif kind is tuple or kind is list:
                collect(item, found)
            elif kind not in leaves:
                found += variables_of(instruction, item)

    def list_variables(self: Any, value: Any) -> list[Any]:
        found: list[Any] = []
        collect(value.values() if type(value) is dict else (value,), found)
        return found

    instruction = ir.Inst()
    setattr(ir.Inst, "_rec_list_vars", list_variables)  # noqa: B010 (mypy: a class's method)


def _analyse_lifetimes_when_asked() -> None:
    """Lets it be found out where variables live where that is asked for, not after each pass."""
    entry_variables = ir.FunctionIR.get_block_entry_vars

    def run_lazily(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        function = self.func_ir
        if emit_dels or function.is_generator:
            run_post_processor(self, emit_dels, extend_lifetimes)
            return
        function.blocks = canonicalize_cfg(function.blocks)
        function.variable_lifetime, function.generator_info = VariableLifetime(function.blocks), None
        function.block_entry_vars.clear()

    def get_block_entry_vars(self: Any, block: Any) -> Any:
        if block not in self.block_entry_vars:  # of Python's object mode alone
            run_post_processor(PostProcessor(self))
        return entry_variables(self, block)

    setattr(PostProcessor, "run", run_lazily)  # noqa: B010
    setattr(ir.FunctionIR, "get_block_entry_vars", get_block_entry_vars)  # noqa: B010


def _optimize_definitions_only() -> None:
    """Lets one pass manager optimise a module's functions, not one each, and leaves out mere declarations."""

    def optimize_functions(self: Any, module: Any) -> None:
        module.data_layout = self._codegen._data_layout
        passes, builder = self._codegen._function_pass_manager()
        for function in module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    setattr(CPUCodeLibrary, "_optimize_functions", optimize_functions)  # noqa: B010


def _remember_plain_arrays() -> None:
    """Lets it be known of a type of array that it has no own view as an array, not asked at each use."""
    find, plain = BaseContext.get_function, set()

    def get_function(self: Any, function: Any, signature: Any, _firstcall: bool = True) -> Any:
        if function != "__array__":
            return find(self, function, signature, _firstcall)
        if signature.args in plain:
            raise NotImplementedError("an array is its own view")
        try:
            return find(self, function, signature, _firstcall)
        except NotImplementedError:
            plain.add(signature.args)
            raise

    setattr(BaseContext, "get_function", get_function)  # noqa: B010


def _refresh_when_something_is_new() -> None:
    """Lets a context look for new implementations only after one was registered."""
    refresh = BaseContext.refresh
    seen: dict[Any, int] = {}
    lists = "functions", "getattrs", "setattrs", "casts", "constants", "attributes", "globals"

    def registered(self: Any) -> int:
        """How many there are, in all registries that the context knows."""
        registries = [*self._registries, *self.typing_context._registries]
        return sum(len(getattr(registry, name, ())) for registry in registries for name in lists)

    def refresh_if_new(self: Any) -> None:
        if seen.get(self) != registered(self):
            refresh(self)
            seen[self] = registered(self)

    setattr(BaseContext, "refresh", refresh_if_new)  # noqa: B010


def _remember_small_results() -> None:
    """Lets a type's size and a function's parameters be found once: numba parses a module, a signature."""
    setattr(base, "_has_loc", functools.cache(base._has_loc))  # noqa: B010
    find_size = BaseContext.get_abi_sizeof
    sizes: dict[Any, int] = {}

    def get_abi_sizeof(self: Any, kind: Any) -> Any:
        key = self, str(kind)
        if "%" in key[1]:  # a type with a name, which says nothing of its size
            return find_size(self, kind)
        if key not in sizes:
            sizes[key] = find_size(self, kind)
        return sizes[key]

    setattr(BaseContext, "get_abi_sizeof", get_abi_sizeof)  # noqa: B010


def _leave_out_lock_events() -> None:
    """Lets calls of LLVM be no events of numba, of which its own timers alone would know."""
    for acquired, released in list(llvm.ffi.lib._lock._cblist):
        if "_initialize_llvm_lock_event" in acquired.__qualname__:
            llvm.ffi.unregister_lock_callback(acquired, released)


class _GarbageCollection:
    """Rests while something is compiled: a tenth of the time, for what nothing is freed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth = 0
        self._was_enabled = False

    def pause(self) -> None:
        with self._lock:
            if self._depth == 0:
                self._was_enabled = gc.isenabled()
                gc.disable()
            self._depth += 1

    def resume(self) -> None:
        with self._lock:
            self._depth -= 1
            if self._depth == 0 and self._was_enabled:
                if gc.get_freeze_count() == 0:
                    # What is new becomes old at once: the next collection need not go through all of it.
                    gc.freeze()
                    gc.unfreeze()
                gc.enable()


garbage_collection = _GarbageCollection()


class _Optimization:
    """LLVM's level of optimisation: 2 for what the camera measures by, which is as fast, elsewhere numba's 3.

    Drawing stays at 3: it resolves samples into pixels a fifth faster by it.
    numba has one level for all that it compiles; its lock is held between ``begin`` and ``end``.
    """

    def __init__(self) -> None:
        self._outer: list[Any] = []

    def begin(self, module: str) -> None:
        """Sets the level for a function of a module, until ``end``."""
        self._outer.append(_config.OPT)
        level = self._outer[0]
        measures = module.startswith("robot_ik.camera.") and not module.startswith("robot_ik.camera.drawing.")
        _config.OPT = type(level)(min(level, 2)) if measures else level

    def end(self) -> None:
        _config.OPT = self._outer.pop()


_config: Any = config
optimization = _Optimization()
