"""Array access that lets LLVM vectorise gathers inside Numba loops.

Numba cannot declare two arrays disjoint, so a store in a loop forbids LLVM to vectorise the loads around it.
``load`` tags what it reads with an alias scope and ``store`` declares that it never writes that scope; an array
that a loop both reads and writes is read with ``reload``. No bounds check, no negative indices.
"""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

KERNEL = {"nogil": True, "fastmath": True, "boundscheck": False, "error_model": "numpy", "cache": True}
PARALLEL_KERNEL = {"parallel": True, **KERNEL}


def _scope(builder):
    module = builder.module
    domain = module.add_metadata([ir.MetaDataString(module, "biresnerf_domain")])
    scope = module.add_metadata([ir.MetaDataString(module, "biresnerf_read_only"), domain])
    return module.add_metadata([scope])


def _pointer(context, builder, array_type, array, index_type, index):
    data = context.make_array(array_type)(context, builder, array).data
    if index.type.width < 64:
        extend = builder.sext if index_type.signed else builder.zext
        index = extend(index, ir.IntType(64))
    return builder.gep(data, [index], inbounds=True)


def _flat(array) -> bool:
    return isinstance(array, types.Array) and array.ndim == 1 and array.layout == "C"


def _make_load(tag: str):
    @intrinsic
    def load_element(typing_context, array, index):
        if not _flat(array):
            return None

        def codegen(context, builder, signature, arguments):
            (array_type, index_type), (data, i) = signature.args, arguments
            value = builder.load(_pointer(context, builder, array_type, data, index_type, i))
            value.set_metadata(tag, _scope(builder))
            return value

        return array.dtype(array, index), codegen

    return load_element


load = _make_load("alias.scope")  # an element of a flat array that the enclosing loop only reads
reload = _make_load("noalias")  # an element of a flat array that the enclosing loop also writes


@intrinsic
def store(typing_context, array, index, value):
    """Write an element of a flat array that the enclosing loop never reads with ``load``."""
    if not _flat(array):
        return None

    def codegen(context, builder, signature, arguments):
        pointer = _pointer(context, builder, signature.args[0], arguments[0], signature.args[1], arguments[1])
        converted = context.cast(builder, arguments[2], signature.args[2], signature.args[0].dtype)
        builder.store(converted, pointer).set_metadata("noalias", _scope(builder))
        return context.get_dummy_value()

    return types.void(array, index, value), codegen


@intrinsic
def float_from_bits(typing_context, bits):
    """The float32 with the given uint32 pattern."""

    def codegen(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.uint32), codegen


@intrinsic
def next_task(typing_context, counter):
    """Take the next number from the int64 counter [1] that workers share."""

    def codegen(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(types.Array(types.int64, 1, "C")), codegen
