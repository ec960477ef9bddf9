"""``Bundle``: many arrays handed to compiled code under their names, as one table of addresses.

    LAYOUT = Layout("Tree", kind="ints", constant="table")
    table = LAYOUT.pack(arrays)            # Python: one row (address, rows, columns) for each array
    open_layout = LAYOUT.open              # a global of its own: compiled code sees no Layout
    tree = open_layout(table)              # compiled: tree.kind, tree.constant are the arrays

A table keeps the arrays alive that it points to; a bare address does not keep its table, so its holder holds
the table beside it.  Why not a tuple or a structref: ``docs/architecture.md``.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import intrinsic, models, register_model
from numba.np.arrayobj import make_array, populate_array
from numpy.typing import NDArray

# What a field of a layout may be: C-contiguous, in numba's and in NumPy's terms; then, of a ``named_row``.
_ARRAY_OF: dict[str, tuple[Any, Any]] = {
    "ints": (types.Array(types.int64, 1, "C"), np.int64),
    "floats": (types.Array(types.float64, 1, "C"), np.float64),
    "table": (types.Array(types.float64, 2, "C"), np.float64),
    "int_table": (types.Array(types.int64, 2, "C"), np.int64),
}
_NUMBER_OF = {"float": types.float64, "int": types.int64, "bool": types.boolean}
_COLUMNS = 3  # address, rows, columns
_WORD = ir.IntType(64)


class _Owner:
    """The memory of a table, and what it points to.  NumPy takes it for the table's base and keeps it."""

    __slots__ = ("__array_interface__", "arrays", "memory")

    def __init__(self, memory: NDArray[np.int64], arrays: tuple[NDArray[Any], ...]) -> None:
        self.memory, self.arrays = memory, arrays
        self.__array_interface__ = memory.__array_interface__


class BundleType(types.Type):
    """numba's type of an open bundle, or of an open row of numbers; equal fields in equal order are equal."""

    def __init__(self, title: str, fields: tuple[tuple[str, str], ...]) -> None:
        self.places = {name: (place, kind) for place, (name, kind) in enumerate(fields)}
        super().__init__(name=f"Bundle({title}: {' '.join(f'{n}={k}' for n, k in fields)})")


@register_model(BundleType)
class _BundleModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _WORD.as_pointer())


@infer_getattr
class _Fields(AttributeTemplate):
    key = BundleType

    def generic_resolve(self, bundle: BundleType, name: str) -> Any:  # type: ignore[override]
        if name not in bundle.places:
            return None
        kind = bundle.places[name][1]
        return _NUMBER_OF[kind] if kind in _NUMBER_OF else _ARRAY_OF[kind][0]


@lower_getattr_generic(BundleType)  # type: ignore[untyped-decorator]
def _lower_field(context: Any, builder: Any, bundle: BundleType, pointer: Any, name: str) -> Any:
    place, kind = bundle.places[name]

    def loaded(pointer: Any, column: int) -> Any:
        value = builder.load(builder.gep(pointer, [ir.Constant(_WORD, column)]))
        # Tables do not change while a kernel runs: lets LLVM read them once.
        value.set_metadata("invariant.load", builder.module.add_metadata([]))
        return value

    if kind in _NUMBER_OF:
        number = loaded(builder.bitcast(pointer, ir.DoubleType().as_pointer()), place)
        if kind == "bool":
            return builder.fcmp_unordered("!=", number, ir.Constant(ir.DoubleType(), 0.0))
        return builder.fptosi(number, _WORD) if kind == "int" else number
    array_type, itemsize = _ARRAY_OF[kind][0], ir.Constant(_WORD, 8)
    address, *shape = (loaded(pointer, place * _COLUMNS + column) for column in range(1 + array_type.ndim))
    strides = [builder.mul(shape[1], itemsize), itemsize] if array_type.ndim == 2 else [itemsize]
    array = make_array(array_type)(context, builder)
    populate_array(
        array, data=builder.inttoptr(address, array.data.type), shape=shape, strides=strides,
        itemsize=itemsize, meminfo=None,
    )  # fmt: skip
    return array._getvalue()


def named_row(title: str, fields: tuple[tuple[str, str], ...]) -> Callable[[Any], Any]:
    """What opens, in compiled code, an array (n,) of floats as named numbers: "float", "int" or "bool"."""
    return _opener(BundleType(title, fields))


def address_of(table: NDArray[Any]) -> Any:
    """The address of a packed table, which its user must hold too: quicker to pass; or another array."""
    base: Any = table.base
    return table.ctypes.data if isinstance(base, _Owner) else table


class Layout:
    """Names and kinds of the arrays of one bundle; ``open`` is called in compiled code only.

    What follows a kind is the shape that ``zeros`` makes: "table g 12" has 12 numbers for each of g.
    """

    def __init__(self, title: str, **fields: str) -> None:
        self.title = title
        self.fields = {name: text.split()[0] for name, text in fields.items()}
        self._shapes = {name: text.split()[1:] for name, text in fields.items() if " " in text}
        self.open = _opener(BundleType(title, tuple(self.fields.items())))

    def zeros(self, sizes: Mapping[str, int]) -> dict[str, NDArray[Any]]:
        """New arrays for the fields that have a shape, from what its letters stand for."""
        return {
            name: np.zeros(
                [int(part) if part.isdigit() else sizes[part] for part in shape],
                dtype=_ARRAY_OF[self.fields[name]][1],
            )
            for name, shape in self._shapes.items()
        }

    def pack(self, arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
        """The table of addresses (fields, 3) of ``arrays``; it, but no copy of it, keeps them alive.

        Raises:
            TypeError: An array has the wrong type or number of dimensions, or is not C-contiguous.
        """
        table = np.ones((len(self.fields), _COLUMNS), dtype=np.int64)
        for row, (name, kind) in enumerate(self.fields.items()):
            array = arrays[name]
            array_type, dtype = _ARRAY_OF[kind]
            fits = array.dtype == dtype and array.ndim == array_type.ndim and array.flags.c_contiguous
            if not fits:
                raise TypeError(f"{self.title}.{name} must be {array_type}, not {array.dtype} {array.shape}")
            table[row, 0] = array.__array_interface__["data"][0]
            table[row, 1 : 1 + array.ndim] = array.shape
        return np.asarray(_Owner(table, tuple(arrays[name] for name in self.fields)))


def _opener(kind: BundleType) -> Callable[[Any], Any]:
    @intrinsic
    def open_bundle(_typing: Any, table: Any) -> Any:
        """Of an array, or of the address of one (``table.ctypes.data``)."""

        def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            if isinstance(signature.args[0], types.Integer):
                return builder.inttoptr(arguments[0], _WORD.as_pointer())
            data = make_array(signature.args[0])(context, builder, value=arguments[0]).data
            return builder.bitcast(data, _WORD.as_pointer())

        return kind(table), build

    return open_bundle  # type: ignore[return-value]
