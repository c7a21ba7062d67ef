"""Asking for memory before it is needed: what a loop then reads is in the cache already."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

_READ, _KEEP, _DATA = 0, 3, 1


@intrinsic  # type: ignore[untyped-decorator]
def prefetch(_: Any, array: Any, row: Any) -> Any:
    """Fetch the line of the cache that holds the start of array[row]; never reads, never waits.
    For use inside kernels; ``row`` is not counted from the end."""

    def instruction(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        of_array = signature.args[0]
        data = context.make_array(of_array)(context, builder, values[0])
        first = context.get_constant(types.intp, 0)
        index = context.cast(builder, values[1], signature.args[1], types.intp)
        place = cgutils.get_item_pointer(
            context, builder, of_array, data, [index] + [first] * (of_array.ndim - 1)
        )
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        call = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        builder.call(
            call, [builder.bitcast(place, byte), number(_READ), number(_KEEP), number(_DATA)]
        )
        return context.get_dummy_value()

    return types.void(array, row), instruction
