"""A numba type for SIMD vectors: one variable holds a number for each of WIDTH candidates.

numba leaves it to the compiler to find vector instructions in loops, and it finds them now and
then. Here a vector is a type: arithmetic on it is vector instructions, of whatever width the
processor has. Without the compiler the functions below work on numpy's arrays.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import (
    lower_builtin,
    models,
    register_model,
    type_callable,
)
from numba.np.arrayobj import make_array
from numpy.typing import NDArray

__all__ = [
    "WIDTH",
    "Mask",
    "Vector",
    "anywhere",
    "behind",
    "first_place",
    "least",
    "load",
    "magnitude",
    "most",
    "packed",
    "root",
    "store",
    "store_where",
    "where",
    "with_sign",
]

WIDTH = 8
Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

FLAGS = ("contract", "nnan", "nsz")
"""Products and sums may fuse; no NaN enters the model."""

F = TypeVar("F", bound=Callable[..., Any])


def packed(function: F) -> F:
    """Compile as a part of the kernels that call it, for vectors or for numbers.

    Nothing is allocated in it, so that no references to arrays need be counted.
    """
    return numba.njit(
        nogil=True, error_model="numpy", forceinline=True, fastmath=set(FLAGS), _nrt=False
    )(function)


def load(array: NDArray[np.float64], start: int) -> Vector:
    """WIDTH numbers of a flat array from `start`."""
    return array[start : start + WIDTH].copy()


def store(array: NDArray[np.float64], start: int, value: Any) -> None:
    """Write WIDTH numbers to a flat array from `start`."""
    array[start : start + WIDTH] = value


def where(mask: Mask, yes: Any, no: Any) -> Vector:
    """Choose lane by lane."""
    return np.where(mask, yes, no)


def least(a: Any, b: Any) -> Vector:
    """Lesser of two, lane by lane."""
    return np.minimum(a, b)


def most(a: Any, b: Any) -> Vector:
    """Greater of two, lane by lane."""
    return np.maximum(a, b)


def magnitude(a: Any) -> Vector:
    """Absolute value, lane by lane."""
    return np.abs(a)


def root(a: Any) -> Vector:
    """Square root, lane by lane."""
    return np.sqrt(a)


def with_sign(size: Any, sign: Any) -> Vector:
    """Numbers of one vector with the signs of another, lane by lane."""
    return np.copysign(size, sign)


def anywhere(mask: Mask) -> bool:
    """Whether the mask is true in any lane."""
    return bool(np.any(mask))


def first_place(mask: Mask) -> int:
    """First lane in which the mask is true, WIDTH if it is in none."""
    return int(np.argmax(mask)) if np.any(mask) else WIDTH


def behind(first: float, vector: Vector) -> Vector:
    """Put every number one lane further on, `first` into the first lane; the last is lost."""
    return np.concatenate([[first], vector[:-1]])


class _VectorType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"Lanes({WIDTH})")


class _MaskType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"LaneMask({WIDTH})")


_VECTOR, _MASK = _VectorType(), _MaskType()
_DOUBLES = ir.VectorType(ir.DoubleType(), WIDTH)
_BITS = ir.VectorType(ir.IntType(1), WIDTH)


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _DOUBLES)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BITS)


def _wide(builder: Any, value: Any) -> Any:
    """A number as a vector."""
    if value.type == _DOUBLES:
        return value
    one = builder.insert_element(
        ir.Constant(_DOUBLES, ir.Undefined), value, ir.Constant(ir.IntType(32), 0)
    )
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
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
    return builder.select(builder.fcmp_ordered(sign, a, b, flags=FLAGS), a, b)


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


_binary(operator.add, _VECTOR, lambda b, x, y: b.fadd(x, y, flags=FLAGS))
_binary(operator.sub, _VECTOR, lambda b, x, y: b.fsub(x, y, flags=FLAGS))
_binary(operator.mul, _VECTOR, lambda b, x, y: b.fmul(x, y, flags=FLAGS))
_binary(operator.truediv, _VECTOR, lambda b, x, y: b.fdiv(x, y, flags=FLAGS))
_binary(least, _VECTOR, lambda b, x, y: _lesser(b, "<", x, y))
_binary(most, _VECTOR, lambda b, x, y: _lesser(b, ">", x, y))
_of_numbers(least, lambda b, x, y: _lesser(b, "<", x, y), 2)
_of_numbers(most, lambda b, x, y: _lesser(b, ">", x, y), 2)
_binary(operator.lt, _MASK, lambda b, x, y: b.fcmp_ordered("<", x, y, flags=FLAGS))
_binary(operator.gt, _MASK, lambda b, x, y: b.fcmp_ordered(">", x, y, flags=FLAGS))
_binary(operator.le, _MASK, lambda b, x, y: b.fcmp_ordered("<=", x, y, flags=FLAGS))
_binary(operator.ge, _MASK, lambda b, x, y: b.fcmp_ordered(">=", x, y, flags=FLAGS))
_binary(operator.eq, _MASK, lambda b, x, y: b.fcmp_ordered("==", x, y, flags=FLAGS))
_binary(operator.ne, _MASK, lambda b, x, y: b.fcmp_unordered("!=", x, y, flags=FLAGS))


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
    return builder.fneg(arguments[0], flags=FLAGS)


def _of_each(function: Any, name: str) -> None:
    """Let kernels apply a function of the processor to a vector or a number."""

    @type_callable(function)
    def _typed_of_each(_context: Any) -> Any:
        return lambda a: _VECTOR if a is _VECTOR else None

    @lower_builtin(function, _VECTOR)
    def _lowered_of_each(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return _intrinsic(builder, f"llvm.{name}.v{WIDTH}f64", arguments[0])

    _of_numbers(function, lambda b, x: _intrinsic(b, f"llvm.{name}.f64", x), 1)


def _intrinsic(builder: Any, name: str, *values: Any) -> Any:
    kind = ir.FunctionType(values[0].type, [value.type for value in values])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)


_of_each(magnitude, "fabs")
_of_each(root, "sqrt")
_binary(with_sign, _VECTOR, lambda b, x, y: _intrinsic(b, f"llvm.copysign.v{WIDTH}f64", x, y))
_of_numbers(with_sign, lambda b, x, y: _intrinsic(b, "llvm.copysign.f64", x, y), 2)


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


@type_callable(anywhere)
def _typed_anywhere(_context: Any) -> Any:
    return lambda mask: types.boolean if mask is _MASK else None


@lower_builtin(anywhere, _MASK)
def _anywhere(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    packed = builder.bitcast(arguments[0], ir.IntType(WIDTH))
    return builder.icmp_unsigned("!=", packed, ir.Constant(ir.IntType(WIDTH), 0))


@type_callable(first_place)
def _typed_first_place(_context: Any) -> Any:
    return lambda mask: types.int64 if mask is _MASK else None


@lower_builtin(first_place, _MASK)
def _first_place(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    whole = ir.IntType(64)
    lanes = builder.zext(builder.bitcast(arguments[0], ir.IntType(WIDTH)), whole)
    beyond = builder.or_(lanes, ir.Constant(whole, 1 << WIDTH))
    return builder.cttz(beyond, ir.Constant(ir.IntType(1), 1))


@type_callable(behind)
def _typed_behind(_context: Any) -> Any:
    return lambda first, vector: _VECTOR if vector is _VECTOR and _numeric(first) else None


@lower_builtin(behind, types.Float, _VECTOR)
def _behind(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
    places = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0, *range(WIDTH, 2 * WIDTH - 1)])
    return builder.shuffle_vector(_wide(builder, arguments[0]), arguments[1], places)


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


@packed
def store_where(array: NDArray[np.float64], start: int, mask: Mask, value: Any) -> None:
    """Write those of WIDTH numbers that a mask chooses to a flat array from `start`."""
    store(array, start, where(mask, value, load(array, start)))
