"""What makes numba compile faster, with the same machine code.

Three quarters of a first compile are numba's own Python.  Much of that is spent on finding again what it
found for the operation before: which of thirty implementations an addition of two numbers takes.
``jit`` calls ``tune()`` when something is about to be compiled.  It reaches into numba, whose versions
pyproject.toml bounds, and so concerns all that the process compiles from then on.
"""

from __future__ import annotations

import functools
import gc
import threading
from typing import Any

from numba.core import ir, types
from numba.core.base import BaseContext
from numba.core.codegen import CPUCodeLibrary
from numba.core.targetconfig import ConfigStack, TargetConfig
from numba.core.types.functions import BaseFunction

# As numba has them.
find_call_type, variables_of = BaseFunction.get_call_type, ir.Inst._rec_list_vars


@functools.cache
def tune() -> None:
    """Applies all that this module has, once."""
    _remember_call_types()
    _compare_options_quickly()
    _list_variables_quickly()
    _optimize_definitions_only()
    _remember_plain_arrays()


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
    """Lets an instruction list its variables without a call for each of its texts and places."""
    leaves = {str, int, bool, float, type(None), ir.Loc}

    def list_variables(self: Any, value: Any) -> list[Any]:
        if isinstance(value, dict):
            value = value.values()
        elif not isinstance(value, (list, tuple)):
            return variables_of(self, value)
        found: list[Any] = []
        for item in value:
            if type(item) is ir.Var:
                found.append(item)
            elif type(item) not in leaves:
                found += list_variables(self, item)
        return found

    setattr(ir.Inst, "_rec_list_vars", list_variables)  # noqa: B010 (mypy: a class's method)


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
