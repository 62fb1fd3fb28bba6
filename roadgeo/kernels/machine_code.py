"""From kernels to machine code that needs no numba to run: compiled by numba, called through a plain interface.

Each kernel gets an entry `int32 roadgeo_NAME(int64 *arguments, int64 *results)`. Arrays are passed as the addresses of
numpy's objects; allocations of a kernel are counted by the few lines below instead of numba's runtime.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

import llvmlite.ir as ir
import numba
import numpy as np
from numba import types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.np.arrayobj import populate_array

from roadgeo.kernels.arrays import ArrayKind, Kind, TupleKind

__all__ = ["CannotKeep", "compile_kernels"]

_I32, _I64 = ir.IntType(32), ir.IntType(64)
_POINTER = ir.IntType(8).as_pointer()
#: Offsets in numpy's array objects of the addresses of their data and of their shape (`PyArrayObject_fields`), bytes.
_DATA, _SHAPE = 16, 32
#: Functions of C's library, which is in every process; with an f behind for float32.
_C = {"malloc", "free", "memset", "memcpy", "memmove"}
_MATH = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "exp", "log", "log10", "pow", "fmod", "sqrt", "hypot")
_IN_EVERY_PROCESS = _C | {*_MATH, *(f"{name}f" for name in _MATH)}


class Compilable(Protocol):
    """A function to be compiled (see `compilation.Kernel`)."""

    name: str
    arguments: tuple[Kind, ...] | None
    result: Kind

    @property
    def part(self) -> Any:
        """Functions that numba compiles."""


class CannotKeep(Exception):  # noqa: N818
    """Machine code that would not run without numba."""


def compile_kernels(kernels: Sequence[Compilable], llvm: Any, machine: Any, progress: Callable[[int], None]) -> bytes:
    """Compile kernels into one object file; `progress` is called with the number done.

    Raises
    ------
    CannotKeep
        The code needs something that is not in every process, or numpy's arrays look otherwise than expected.
    """
    if not _arrays_look_as_expected():
        raise CannotKeep("numpy's arrays")
    whole = llvm.parse_assembly(str(_runtime()))
    progress(0)
    for n, kernel in enumerate(kernels, 1):
        argument_types = tuple(map(_numba_type, kernel.arguments or ()))
        kernel.part.compile(argument_types)
        made = kernel.part.overloads[argument_types]
        if made.signature.return_type != _numba_type(kernel.result):
            raise TypeError(f"kernel {kernel.name} returns {made.signature.return_type}, not what it is annotated with")
        whole.link_in(llvm.parse_assembly(made.library.get_llvm_str()))
        whole.link_in(llvm.parse_assembly(str(_entry(kernel, made.fndesc))))
        progress(n)
    needed = {f.name for f in whole.functions if f.is_declaration and not f.name.startswith("llvm.")}
    if not needed <= _IN_EVERY_PROCESS:
        raise CannotKeep(", ".join(sorted(needed - _IN_EVERY_PROCESS)))
    whole.verify()
    return bytes(machine.emit_object(whole))


def _arrays_look_as_expected() -> bool:
    sample = np.zeros((3, 5))
    data = ctypes.c_uint64.from_address(id(sample) + _DATA).value
    shape = ctypes.c_uint64.from_address(id(sample) + _SHAPE).value
    return data == sample.ctypes.data and list((ctypes.c_int64 * 2).from_address(shape)) == [3, 5]


def _numba_type(kind: Kind) -> Any:
    if isinstance(kind, ArrayKind):
        return types.Array(numba.from_dtype(kind.dtype), kind.ndim, "C", readonly=not kind.written)
    if isinstance(kind, TupleKind):
        members = [_numba_type(member) for member in kind.members]
        if kind.named is None:
            return types.BaseTuple.from_types(members)
        return types.BaseTuple.from_types(members, kind.named)
    return {float: types.float64, int: types.int64, bool: types.boolean, None: types.none}[kind]


def _entry(kernel: Compilable, made: Any) -> ir.Module:
    """Write the entry that calls a compiled kernel."""
    context = cpu_target.target_context
    module = context.create_module(f"roadgeo.{kernel.name}")
    kernel_type = context.call_conv.get_function_type(made.restype, made.argtypes)
    callee = ir.Function(module, kernel_type, made.llvm_func_name)
    slots = _I64.as_pointer()
    entry = ir.Function(module, ir.FunctionType(_I32, [slots, slots]), f"roadgeo_{kernel.name}")
    builder = ir.IRBuilder(entry.append_basic_block())
    given, answer = entry.args
    numbers = (builder.load(builder.gep(given, [_I64(n)])) for n in range(1 << 20))
    values = [_argument(context, builder, kind, numbers) for kind in kernel.arguments or ()]
    status, value = context.call_conv.call_function(builder, callee, made.restype, made.argtypes, values)
    with builder.if_then(status.is_error):
        builder.ret(_I32(1))
    for n, number in enumerate(_results(context, builder, kernel.result, value)):
        builder.store(number, builder.gep(answer, [_I64(n)]))
    builder.ret(_I32(0))
    return module


def _at(builder: ir.IRBuilder, address: Any, offset: int) -> Any:
    """Read the number at an address."""
    return builder.load(builder.inttoptr(builder.add(address, _I64(offset)), _I64.as_pointer()))


def _argument(context: Any, builder: ir.IRBuilder, kind: Kind, numbers: Iterator[Any]) -> Any:
    """Make a kernel's argument of the numbers passed."""
    if isinstance(kind, TupleKind):
        members = [_argument(context, builder, member, numbers) for member in kind.members]
        return context.make_tuple(builder, _numba_type(kind), members)
    number = next(numbers)
    if kind is float:
        return builder.bitcast(number, ir.DoubleType())
    if kind is bool:
        return builder.trunc(number, ir.IntType(1))
    if not isinstance(kind, ArrayKind):
        return number
    array = context.make_array(_numba_type(kind))(context, builder)
    where = _at(builder, number, _SHAPE)
    shape = [_at(builder, where, 8 * k) for k in range(kind.ndim)]
    strides: list[Any] = []
    stride = _I64(kind.dtype.itemsize)
    for length in reversed(shape):
        strides.insert(0, stride)
        stride = builder.mul(stride, length)
    populate_array(
        array,
        data=builder.inttoptr(_at(builder, number, _DATA), array.data.type),
        shape=shape,
        strides=strides,
        itemsize=_I64(kind.dtype.itemsize),
        meminfo=None,
    )
    return array._getvalue()


def _results(context: Any, builder: ir.IRBuilder, kind: Kind, value: Any) -> Iterator[Any]:
    """Yield the numbers that make a kernel's result."""
    if isinstance(kind, TupleKind):
        for member, part in zip(kind.members, cgutils.unpack_tuple(builder, value, len(kind.members)), strict=True):
            yield from _results(context, builder, member, part)
    elif isinstance(kind, ArrayKind):
        array = context.make_array(_numba_type(kind))(context, builder, value)
        yield builder.ptrtoint(array.meminfo, _I64)
        yield builder.ptrtoint(array.data, _I64)
        yield from cgutils.unpack_tuple(builder, array.shape, kind.ndim)
    elif kind is float:
        yield builder.bitcast(value, _I64)
    elif kind is bool:
        yield builder.zext(value, _I64)
    elif kind is int:
        yield value


def _runtime() -> ir.Module:
    """Write numba's functions that compiled kernels call: counted blocks of memory (`MemInfo`), and reshaping.

    A block begins with its count of references, two fields unused here, the address of its data and their size.
    """
    module = cpu_target.target_context.create_module("roadgeo.runtime")
    malloc = ir.Function(module, ir.FunctionType(_POINTER, [_I64]), "malloc")
    free = ir.Function(module, ir.FunctionType(ir.VoidType(), [_POINTER]), "free")
    for name in ("NRT_MemInfo_alloc_aligned", "NRT_MemInfo_alloc_safe_aligned"):
        _write_allocation(module, name, malloc)
    builder, (size,) = _begin(module, "NRT_Allocate", _POINTER, [_I64])
    builder.ret(builder.call(malloc, [size]))
    for name in ("NRT_Free", "NRT_MemInfo_call_dtor"):
        builder, (block,) = _begin(module, name, ir.VoidType(), [_POINTER])
        builder.call(free, [block])
        builder.ret_void()
    builder, (owner,) = _begin(module, "roadgeo_release", ir.VoidType(), [_I64])
    with builder.if_then(builder.icmp_unsigned("!=", owner, _I64(0))):
        block = builder.inttoptr(owner, _I64.as_pointer())
        left = builder.sub(builder.load(block), _I64(1))
        builder.store(left, block)
        with builder.if_then(builder.icmp_unsigned("==", left, _I64(0))):
            builder.call(free, [builder.bitcast(block, _POINTER)])
    builder.ret_void()
    _write_reshape(module)
    return module


def _begin(module: ir.Module, name: str, result: Any, arguments: list[Any]) -> tuple[ir.IRBuilder, Any]:
    """Begin a function: return a builder of its body, and its arguments."""
    function = ir.Function(module, ir.FunctionType(result, arguments), name)
    return ir.IRBuilder(function.append_basic_block()), function.args


def _write_allocation(module: ir.Module, name: str, malloc: ir.Function) -> None:
    head = 64  # bytes, more than the fields take
    builder, (size, align) = _begin(module, name, _POINTER, [_I64, _I32])
    align = builder.zext(align, _I64)
    block = builder.call(malloc, [builder.add(builder.add(size, align), _I64(head))])
    with builder.if_then(builder.icmp_unsigned("==", block, ir.Constant(_POINTER, None))):
        builder.ret(block)  # no memory left: the kernel fails
    start = builder.add(builder.ptrtoint(block, _I64), builder.add(align, _I64(head - 1)))
    data = builder.and_(start, builder.neg(align))
    fields = builder.bitcast(block, _I64.as_pointer())
    for n, value in enumerate([_I64(1), _I64(0), _I64(0), data, size, _I64(0)]):
        builder.store(value, builder.gep(fields, [_I64(n)]))
    builder.ret(block)


def _write_reshape(module: ir.Module) -> None:
    """Write the strides of an array's new shape; numba reshapes contiguous arrays only."""
    lengths = _I64.as_pointer()
    builder, given = _begin(
        module, "numba_attempt_nocopy_reshape", _I32, [_I64, lengths, lengths, _I64, lengths, lengths, _I64, _I32]
    )
    _, _, _, ndim, shape, strides, itemsize, _ = given
    stride = cgutils.alloca_once_value(builder, itemsize)
    with cgutils.for_range(builder, ndim) as loop:
        n = builder.sub(builder.sub(ndim, loop.index), _I64(1))
        builder.store(builder.load(stride), builder.gep(strides, [n]))
        builder.store(builder.mul(builder.load(stride), builder.load(builder.gep(shape, [n]))), stride)
    builder.ret(_I32(1))
