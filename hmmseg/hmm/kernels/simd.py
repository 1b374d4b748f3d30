"""Eight numbers at a time: vectors of LLVM behind Python operators, made into functions for kernels.

Written out as vectors because what the compiler makes of plain loops over a handful of states is
slower than the recursion's own latency. LLVM lowers them to whatever the processor has.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.core import cgutils

WIDTH = 8  # numerics: numbers of a vector
intrinsic: Any = extending.intrinsic  # what it makes is called without its first argument
I32, I64, F32, F64 = ir.IntType(32), ir.IntType(64), ir.FloatType(), ir.DoubleType()
_REVERSED = list(range(WIDTH - 1, -1, -1))


class Vec:
    """WIDTH doubles or integers; operators build instructions."""

    def __init__(self, builder, value) -> None:
        self.builder, self.value = builder, value

    @property
    def _float(self) -> bool:
        return self.value.type.element == F64

    def _other(self, other):
        if isinstance(other, Vec):
            return other.value
        return ir.Constant(self.value.type, [other] * WIDTH)

    def _op(self, other, floating: str, integer: str) -> Vec:
        return Vec(
            self.builder,
            getattr(self.builder, floating if self._float else integer)(self.value, self._other(other)),
        )

    def __add__(self, other) -> Vec:
        return self._op(other, "fadd", "add")

    def __sub__(self, other) -> Vec:
        return self._op(other, "fsub", "sub")

    def __mul__(self, other) -> Vec:
        return self._op(other, "fmul", "mul")

    def __lshift__(self, other) -> Vec:
        return self._op(other, "shl", "shl")

    def __rshift__(self, other) -> Vec:
        return self._op(other, "lshr", "lshr")

    def __and__(self, other) -> Vec:
        return self._op(other, "and_", "and_")

    def __or__(self, other) -> Vec:
        return self._op(other, "or_", "or_")

    def __truediv__(self, other) -> Vec:
        return self._op(other, "fdiv", "sdiv")

    def __gt__(self, other) -> Vec:
        compare = self.builder.fcmp_ordered if self._float else self.builder.icmp_signed
        return Vec(self.builder, compare(">", self.value, self._other(other)))

    def where(self, yes: Vec, no) -> Vec:
        """Elementwise `yes` where this comparison holds, else `no`."""
        return Vec(self.builder, self.builder.select(self.value, yes.value, yes._other(no)))

    def maximum(self, other) -> Vec:
        """Elementwise maximum."""
        return (self > other).where(self, other)

    def times_plus(self, factor, summand) -> Vec:
        """self * factor + summand, in one instruction where there is one."""
        kind = self.value.type
        function = cgutils.get_or_insert_function(
            self.builder.module, ir.FunctionType(kind, [kind] * 3), f"llvm.fmuladd.v{WIDTH}f64"
        )
        numbers = [self.value, self._other(factor), self._other(summand)]
        return Vec(self.builder, self.builder.call(function, numbers))

    def bits(self) -> Vec:
        """The same bits as integers."""
        return Vec(self.builder, self.builder.bitcast(self.value, ir.VectorType(I64, WIDTH)))

    def floats(self) -> Vec:
        """The same bits as doubles."""
        return Vec(self.builder, self.builder.bitcast(self.value, ir.VectorType(F64, WIDTH)))

    def mask(self):
        """A comparison's results as one integer, the first element in its lowest bit."""
        bits = self.builder.bitcast(self.value, ir.IntType(WIDTH))
        return self.builder.zext(bits, I64)

    def shuffled(self, order: list[int], other: Vec | None = None) -> Vec:
        """Elements in another order; WIDTH and up are those of `other`."""
        second = ir.Constant(self.value.type, ir.Undefined) if other is None else other.value
        mask = ir.Constant(ir.VectorType(I32, WIDTH), order)
        return Vec(self.builder, self.builder.shuffle_vector(self.value, second, mask))

    def first(self):
        """The first element."""
        return self.builder.extract_element(self.value, ir.Constant(I32, 0))

    def reversed(self) -> Vec:
        """Elements from last to first."""
        return self.shuffled(_REVERSED)

    def shifted(self, left) -> Vec:
        """Each element moved one on; `left` (a scalar) becomes the first."""
        empty = ir.Constant(self.value.type, ir.Undefined)
        first = Vec(self.builder, self.builder.insert_element(empty, left, ir.Constant(I32, 0)))
        return self.shuffled([WIDTH, *range(WIDTH - 1)], first)


MAGIC = 6755399441055744.0  # numerics: 1.5 2^52: adding it rounds to an integer in the lowest bits
MAGIC_BITS = 0x4338000000000000  # numerics: the bits of MAGIC


class Lanes:
    """What a vector function works with: loads and stores."""

    def __init__(self, builder) -> None:
        self.builder = builder

    def load(self, pointer, back: bool = False) -> Vec:
        """Eight numbers from a pointer on; single precision is widened. `back`: last one first."""
        element = pointer.type.pointee
        align = 4 if element == F32 else 8
        where = self.builder.bitcast(pointer, ir.VectorType(element, WIDTH).as_pointer())
        value = self.builder.load(where, align=align)
        if element == F32:
            value = self.builder.fpext(value, ir.VectorType(F64, WIDTH))
        return Vec(self.builder, value).reversed() if back else Vec(self.builder, value)

    def store(self, vector: Vec, pointer, back: bool = False) -> None:
        """Eight numbers to a pointer; `back`: the last one first."""
        vector = vector.reversed() if back else vector
        where = self.builder.bitcast(pointer, vector.value.type.as_pointer())
        self.builder.store(vector.value, where, align=8)

    def same(self, scalar) -> Vec:
        """A scalar in all lanes."""
        kind = ir.VectorType(scalar.type, WIDTH)
        one = self.builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(I32, 0))
        return Vec(self.builder, one).shuffled([0] * WIDTH)


def vector_function(result) -> Any:
    """Decorator: a function of Lanes and LLVM values becomes callable from kernels.

    `result`: the numba type that it returns.
    """

    def decorate(build: Callable):
        def typed(typingctx, *arguments):
            def codegen(context, builder, signature, values):
                made = build(Lanes(builder), *values)
                return context.get_dummy_value() if made is None else made

            return result(*arguments), codegen

        lanes, *names = inspect.signature(build).parameters.values()
        typed.__signature__ = inspect.Signature([lanes, *names])  # numba asks for the names
        typed.__name__ = build.__name__
        typed.__doc__ = build.__doc__
        return intrinsic(typed)

    return decorate


@intrinsic
def at(typingctx, array, index):
    """Pointer to an element of a contiguous array; nothing is checked."""
    signature = types.CPointer(array.dtype)(array, index)

    def codegen(context, builder, signature, values):
        data = context.make_array(signature.args[0])(context, builder, values[0]).data
        return builder.gep(data, [values[1]])

    return signature, codegen


@intrinsic
def doubles_at(typingctx, address):
    """Pointer to doubles at an address."""

    def codegen(context, builder, signature, values):
        return builder.inttoptr(values[0], F64.as_pointer())

    return types.CPointer(types.float64)(types.int64), codegen


@intrinsic
def singles_at(typingctx, address):
    """Pointer to single-precision numbers at an address."""

    def codegen(context, builder, signature, values):
        return builder.inttoptr(values[0], F32.as_pointer())

    return types.CPointer(types.float32)(types.int64), codegen


@intrinsic
def ahead(typingctx, pointer, index):
    """Pointer so many elements on."""

    def codegen(context, builder, signature, values):
        return builder.gep(values[0], [values[1]])

    return pointer(pointer, index), codegen


@intrinsic
def value_at(typingctx, pointer):
    """Number at a pointer, as a double."""

    def codegen(context, builder, signature, values):
        value = builder.load(values[0])
        return builder.fpext(value, F64) if value.type == F32 else value

    return types.float64(pointer), codegen


@intrinsic
def bits_of(typingctx, number):
    """Bits of a double as an integer."""

    def codegen(context, builder, signature, values):
        return builder.bitcast(values[0], I64)

    return types.int64(types.float64), codegen


@intrinsic
def double_of(typingctx, bits):
    """The double that has these bits."""

    def codegen(context, builder, signature, values):
        return builder.bitcast(values[0], F64)

    return types.float64(types.int64), codegen
