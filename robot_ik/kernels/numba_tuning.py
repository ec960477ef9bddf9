"""What makes numba compile faster, with the same machine code.

Three quarters of a first compile are numba's own Python.  Much of that is spent on finding again what it
found before: which of thirty implementations an addition of two numbers takes, where each variable lives.
``jit`` calls ``tune()`` when something is about to be compiled.  It reaches into numba, whose versions
pyproject.toml bounds, and so concerns all that the process compiles from then on.
"""

from __future__ import annotations

import functools
from typing import Any

from numba.core import ir, types
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.core.targetconfig import ConfigStack, TargetConfig
from numba.core.transforms import canonicalize_cfg
from numba.core.types.functions import BaseFunction

# As numba has them.
find_call_type = BaseFunction.get_call_type
run_post_processor = PostProcessor.run


@functools.cache
def tune() -> None:
    """Applies all that this module has, once."""
    _remember_call_types()
    _compare_options_quickly()
    _analyse_lifetimes_when_asked()


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
