"""``keep_apart()``: keeps LLVM from copying a large function into all its callers.

A limb's closed form calls one function from many places, several levels deep: copied, it compiles for a
minute in place of seconds, and runs no faster.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import intrinsic


@intrinsic
def keep_apart(_typing: Any) -> Any:
    """Marks the compiled function that calls it; does nothing when it runs."""

    def mark(_context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        builder.function.attributes.add("noinline")
        return _context.get_dummy_value()

    return types.none(), mark
