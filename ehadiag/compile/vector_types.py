"""The data types of `ehadiag.compile.vector` for numba; loaded only where something is compiled."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import (
    lower_builtin,
    models,
    register_model,
    type_callable,
)
from numba.np.arrayobj import make_array, populate_array

from ehadiag.compile.vector import (
    BYTES_PER_NUMBER,
    VECTOR_MATH_FLAGS,
    VECTOR_WIDTH,
    absolute,
    any_lane,
    array_at,
    copy_sign,
    first_lane,
    lane_sqrt,
    last_lane,
    load,
    maximum,
    minimum,
    shifted_lanes,
    store,
    where,
)


class _VectorType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"Lanes({VECTOR_WIDTH})")


class _MaskType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"LaneMask({VECTOR_WIDTH})")


_VECTOR, _MASK = _VectorType(), _MaskType()
_IS_WIDE = VECTOR_WIDTH > 1
_DOUBLES = ir.VectorType(ir.DoubleType(), VECTOR_WIDTH) if _IS_WIDE else ir.DoubleType()


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _DOUBLES)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        bit = ir.IntType(1)
        super().__init__(manager, kind, ir.VectorType(bit, VECTOR_WIDTH) if _IS_WIDE else bit)


def _wide(builder: Any, value: Any) -> Any:
    """A number as a vector."""
    if value.type == _DOUBLES:
        return value
    one = builder.insert_element(
        ir.Constant(_DOUBLES, ir.Undefined), value, ir.Constant(ir.IntType(32), 0)
    )
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), VECTOR_WIDTH), [0] * VECTOR_WIDTH)
    return builder.shuffle_vector(one, ir.Constant(_DOUBLES, ir.Undefined), zeros)


def _numeric(*kinds: Any) -> bool:
    return all(kind is _VECTOR or isinstance(kind, types.Float) for kind in kinds)


def _binary(function: Any, result: Any, emit: Callable[[Any, Any, Any], Any]) -> None:
    """Let kernels apply a function to two vectors, or to a vector and a number."""

    @type_callable(function)
    def _typed(_context: Any) -> Any:
        def typer(a: Any, b: Any) -> Any:
            return result if _VECTOR in (a, b) and _numeric(a, b) else None

        return typer

    def lowered(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return emit(builder, _wide(builder, arguments[0]), _wide(builder, arguments[1]))

    for kinds in ((_VECTOR, _VECTOR), (_VECTOR, types.Float), (types.Float, _VECTOR)):
        lower_builtin(function, *kinds)(lowered)


def _lesser(builder: Any, sign: str, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(sign, a, b, flags=VECTOR_MATH_FLAGS), a, b)


def _of_numbers(function: Any, emit: Callable[..., Any], count: int) -> None:
    """Let kernels apply a function of vectors to plain numbers too."""

    @type_callable(function)
    def _typed(_context: Any) -> Any:
        def typer_of_two(a: Any, b: Any) -> Any:
            return types.float64 if a == b == types.float64 else None

        def typer_of_one(a: Any) -> Any:
            return types.float64 if a == types.float64 else None

        return typer_of_one if count == 1 else typer_of_two

    @lower_builtin(function, *[types.float64] * count)
    def _lowered(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return emit(builder, *arguments)


_binary(operator.add, _VECTOR, lambda b, x, y: b.fadd(x, y, flags=VECTOR_MATH_FLAGS))
_binary(operator.sub, _VECTOR, lambda b, x, y: b.fsub(x, y, flags=VECTOR_MATH_FLAGS))
_binary(operator.mul, _VECTOR, lambda b, x, y: b.fmul(x, y, flags=VECTOR_MATH_FLAGS))
_binary(operator.truediv, _VECTOR, lambda b, x, y: b.fdiv(x, y, flags=VECTOR_MATH_FLAGS))
_binary(minimum, _VECTOR, lambda b, x, y: _lesser(b, "<", x, y))
_binary(maximum, _VECTOR, lambda b, x, y: _lesser(b, ">", x, y))
_of_numbers(minimum, lambda b, x, y: _lesser(b, "<", x, y), 2)
_of_numbers(maximum, lambda b, x, y: _lesser(b, ">", x, y), 2)
_binary(operator.lt, _MASK, lambda b, x, y: b.fcmp_ordered("<", x, y, flags=VECTOR_MATH_FLAGS))
_binary(operator.gt, _MASK, lambda b, x, y: b.fcmp_ordered(">", x, y, flags=VECTOR_MATH_FLAGS))
_binary(operator.le, _MASK, lambda b, x, y: b.fcmp_ordered("<=", x, y, flags=VECTOR_MATH_FLAGS))
_binary(operator.ge, _MASK, lambda b, x, y: b.fcmp_ordered(">=", x, y, flags=VECTOR_MATH_FLAGS))
_binary(operator.eq, _MASK, lambda b, x, y: b.fcmp_ordered("==", x, y, flags=VECTOR_MATH_FLAGS))
_binary(operator.ne, _MASK, lambda b, x, y: b.fcmp_unordered("!=", x, y, flags=VECTOR_MATH_FLAGS))


def _logic(function: Any, emit: Callable[[Any, Any, Any], Any]) -> None:
    @type_callable(function)
    def _typed(_context: Any) -> Any:
        def typer(a: Any, b: Any) -> Any:
            return _MASK if a is _MASK and b is _MASK else None

        return typer

    @lower_builtin(function, _MASK, _MASK)
    def _lowered(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return emit(builder, *arguments)


_logic(operator.and_, lambda b, x, y: b.and_(x, y))
_logic(operator.or_, lambda b, x, y: b.or_(x, y))


@type_callable(operator.invert)
def _typed_invert(_context: Any) -> Any:
    return lambda a: _MASK if a is _MASK else None


@lower_builtin(operator.invert, _MASK)
def _invert(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    return builder.not_(arguments[0])


@type_callable(operator.neg)
def _typed_neg(_context: Any) -> Any:
    return lambda a: _VECTOR if a is _VECTOR else None


@lower_builtin(operator.neg, _VECTOR)
def _neg(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    return builder.fneg(arguments[0], flags=VECTOR_MATH_FLAGS)


_KIND = f"v{VECTOR_WIDTH}f64" if _IS_WIDE else "f64"
"""LLVM's name of a vector."""


def _of_each(function: Any, name: str) -> None:
    """Let kernels apply a function of the processor to a vector or a number."""

    @type_callable(function)
    def _typed_of_each(_context: Any) -> Any:
        return lambda a: _VECTOR if a is _VECTOR else None

    @lower_builtin(function, _VECTOR)
    def _lowered_of_each(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return _intrinsic(builder, f"llvm.{name}.{_KIND}", arguments[0])

    _of_numbers(function, lambda b, x: _intrinsic(b, f"llvm.{name}.f64", x), 1)


def _intrinsic(builder: Any, name: str, *values: Any) -> Any:
    kind = ir.FunctionType(values[0].type, [value.type for value in values])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)


_of_each(absolute, "fabs")
_of_each(lane_sqrt, "sqrt")
_binary(copy_sign, _VECTOR, lambda b, x, y: _intrinsic(b, f"llvm.copysign.{_KIND}", x, y))
_of_numbers(copy_sign, lambda b, x, y: _intrinsic(b, "llvm.copysign.f64", x, y), 2)


@type_callable(where)
def _typed_where(_context: Any) -> Any:
    return lambda mask, yes, no: _VECTOR if mask is _MASK and _numeric(yes, no) else None


def _where(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    mask, yes, no = arguments
    return builder.select(mask, _wide(builder, yes), _wide(builder, no))


for _kinds in (
    (_VECTOR, _VECTOR),
    (_VECTOR, types.Float),
    (types.Float, _VECTOR),
    (types.Float, types.Float),
):
    lower_builtin(where, _MASK, *_kinds)(_where)


@type_callable(any_lane)
def _typed_anywhere(_context: Any) -> Any:
    return lambda mask: types.boolean if mask is _MASK else None


@lower_builtin(any_lane, _MASK)
def _anywhere(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    packed = builder.bitcast(arguments[0], ir.IntType(VECTOR_WIDTH))
    return builder.icmp_unsigned("!=", packed, ir.Constant(ir.IntType(VECTOR_WIDTH), 0))


@type_callable(first_lane)
def _typed_first_place(_context: Any) -> Any:
    return lambda mask: types.int64 if mask is _MASK else None


@lower_builtin(first_lane, _MASK)
def _first_place(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    whole = ir.IntType(64)
    lanes = builder.zext(builder.bitcast(arguments[0], ir.IntType(VECTOR_WIDTH)), whole)
    beyond = builder.or_(lanes, ir.Constant(whole, 1 << VECTOR_WIDTH))
    return builder.cttz(beyond, ir.Constant(ir.IntType(1), 1))


@type_callable(shifted_lanes)
def _typed_behind(_context: Any) -> Any:
    return lambda first, vector: _VECTOR if vector is _VECTOR and _numeric(first) else None


@lower_builtin(shifted_lanes, types.Float, _VECTOR)
def _behind(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    if not _IS_WIDE:
        return arguments[0]
    places = ir.Constant(
        ir.VectorType(ir.IntType(32), VECTOR_WIDTH), [0, *range(VECTOR_WIDTH, 2 * VECTOR_WIDTH - 1)]
    )
    return builder.shuffle_vector(_wide(builder, arguments[0]), arguments[1], places)


@type_callable(last_lane)
def _typed_last(_context: Any) -> Any:
    return lambda vector: types.float64 if vector is _VECTOR else None


@lower_builtin(last_lane, _VECTOR)
def _last(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    if not _IS_WIDE:
        return arguments[0]
    return builder.extract_element(arguments[0], ir.Constant(ir.IntType(32), VECTOR_WIDTH - 1))


def _pointer(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    data = make_array(signature.args[0])(context, builder, arguments[0]).data
    place = builder.gep(data, [arguments[1]], inbounds=True)
    return builder.bitcast(place, _DOUBLES.as_pointer())


@type_callable(load)
def _typed_load(_context: Any) -> Any:
    return lambda _array, _start: _VECTOR


@lower_builtin(load, types.Array, types.Integer)
def _load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.load(_pointer(context, builder, signature, arguments), align=8)


@type_callable(store)
def _typed_store(_context: Any) -> Any:
    return lambda _array, _start, _value: types.none


def _store(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    builder.store(
        _wide(builder, arguments[2]), _pointer(context, builder, signature, arguments), align=8
    )
    return context.get_dummy_value()


lower_builtin(store, types.Array, types.Integer, _VECTOR)(_store)
lower_builtin(store, types.Array, types.Integer, types.Float)(_store)


@type_callable(array_at)
def _typed_array_at(_context: Any) -> Any:
    return lambda _address, shape: types.Array(types.float64, len(shape), "C")


@lower_builtin(array_at, types.Integer, types.BaseTuple)
def _array_at(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    kind = signature.return_type
    array = make_array(kind)(context, builder)
    shape = cgutils.unpack_tuple(builder, arguments[1], kind.ndim)
    stride = context.get_constant(types.intp, BYTES_PER_NUMBER)
    strides: list[Any] = []
    for size in reversed(shape):
        strides.insert(0, stride)
        stride = builder.mul(stride, size)
    populate_array(
        array,
        data=builder.inttoptr(arguments[0], ir.DoubleType().as_pointer()),
        shape=shape,
        strides=strides,
        itemsize=context.get_constant(types.intp, BYTES_PER_NUMBER),
        meminfo=None,
    )
    return array._getvalue()
