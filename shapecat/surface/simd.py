"""The two inner loops of a neural gas, written as instructions on vectors of 16 numbers.

Numba's loop vectoriser checks for overlapping arrays and handles remainders on each call, which
costs more than the work itself in loops of five iterations. Written as vector instructions of LLVM,
they are two to four times faster. LLVM splits the vectors on machines with narrower ones.
"""

# ruff: noqa: ARG001  # numba calls an intrinsic with the types of all its arguments

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]  # it has no types
from numba import types
from numba.extending import intrinsic

__all__ = ["LANES", "adapt", "three_nearest", "two_nearest"]

LANES = 16
"""Arrays of neurons are padded to a multiple of this."""

_I32, _I64 = ir.IntType(32), ir.IntType(64)
_INTS = ir.VectorType(_I32, LANES)
_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_LARGEST = 0x7FFFFFFF
_Value = Any
"""An LLVM value."""


class _Vectors:
    """Vector instructions, emitted by an LLVM builder."""

    def __init__(self, context: Any, builder: Any) -> None:
        self._context = context
        self.build = builder

    def array(self, kind: Any, value: _Value) -> _Value:
        """Return the address of the first element of an array of the numba type ``kind``."""
        return self._context.make_array(kind)(self._context, self.build, value).data

    def splat(self, value: _Value, kind: Any) -> _Value:
        """Return a vector of the LLVM type ``kind`` whose elements are all ``value``."""
        blank = ir.Constant(kind, ir.Undefined)
        first = self.build.insert_element(blank, value, _I32(0))
        return self.build.shuffle_vector(first, blank, ir.Constant(_INTS, [0] * LANES))

    def load(self, address: _Value, index: _Value, kind: Any) -> _Value:
        """Return the vector of the LLVM type ``kind`` that begins at an index of an array."""
        place = self.build.bitcast(self.build.gep(address, [index]), kind.as_pointer())
        return self.build.load(place, align=4)

    def store(self, value: _Value, address: _Value, index: _Value) -> None:
        """Store a vector in an array, beginning at an index."""
        place = self.build.bitcast(self.build.gep(address, [index]), value.type.as_pointer())
        self.build.store(value, place, align=4)

    def least(self, a: _Value, b: _Value) -> _Value:
        return self.build.select(self.build.icmp_signed("<", a, b), a, b)

    def most(self, a: _Value, b: _Value) -> _Value:
        return self.build.select(self.build.icmp_signed(">", a, b), a, b)

    def multiply_add(self, a: _Value, b: _Value, c: _Value) -> _Value:
        """Return a * b + c, fused where the machine supports it."""
        return self._call(f"llvm.fmuladd.v{LANES}f32", _FLOATS, a, b, c)

    def reduce_least(self, a: _Value) -> _Value:
        return self._call(f"llvm.vector.reduce.smin.v{LANES}i32", _I32, a)

    def reduce_most(self, a: _Value) -> _Value:
        return self._call(f"llvm.vector.reduce.smax.v{LANES}i32", _I32, a)

    def variable(self, value: _Value) -> _Value:
        with self.build.goto_entry_block():  # not in a loop, where it would use up the stack
            place = self.build.alloca(value.type)
        self.build.store(value, place)
        return place

    @contextmanager
    def blocks(self, count: _Value) -> Iterator[tuple[_Value, _Value]]:
        """Emit a loop over blocks of `LANES` elements, whose body the caller emits.

        Yields the index of the first element of a block, and the vector of all its indices.
        """
        build = self.build
        first, lane = self.variable(_I64(0)), self.variable(ir.Constant(_INTS, [*range(LANES)]))
        test, body, end = (build.append_basic_block(name) for name in ("test", "body", "end"))
        build.branch(test)
        build.position_at_end(test)
        build.cbranch(build.icmp_signed("<", build.load(first), count), body, end)
        build.position_at_end(body)
        i, index = build.load(first), build.load(lane)
        yield i, index
        build.store(build.add(i, _I64(LANES)), first)
        build.store(build.add(index, _constant(LANES)), lane)
        build.branch(test)
        build.position_at_end(end)

    def _call(self, name: str, result: Any, *values: _Value) -> _Value:
        """Call an LLVM function, declared if need be, with a result of the type ``result``."""
        module = self.build.module
        function = module.globals.get(name)
        if function is None:
            kind = ir.FunctionType(result, [value.type for value in values])
            function = ir.Function(module, kind, name)
        return self.build.call(function, values)


def _constant(value: int) -> _Value:
    return ir.Constant(_INTS, [value] * LANES)


def _nearest(count: int) -> Callable[..., Any]:
    """Return an intrinsic of numba that finds the ``count`` neurons nearest to a point."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> _Value:
        """Emit the instructions of ``search``, below, for ``args``; return its result."""
        v, build = _Vectors(context, builder), builder
        arrays = [v.array(signature.args[k], args[k]) for k in range(3)]
        padded, place, mask = args[3], [v.splat(value, _FLOATS) for value in args[4:7]], args[7]
        keep = build.not_(v.splat(mask, _INTS))
        # In each lane the smallest keys so far, in order.
        best = [v.variable(_constant(_LARGEST)) for _ in range(count)]
        with v.blocks(padded) as (i, index):
            squared = ir.Constant(_FLOATS, [0.0] * LANES)
            for array, value in zip(arrays, place, strict=True):
                step = build.fsub(v.load(array, i, _FLOATS), value)
                squared = v.multiply_add(step, step, squared)
            key = build.or_(build.and_(build.bitcast(squared, _INTS), keep), index)
            for slot in best:
                old = build.load(slot)
                build.store(v.least(old, key), slot)
                key = v.most(old, key)
        lists = [build.load(slot) for slot in best]
        winners = []
        for _ in range(count):
            minimum = v.reduce_least(lists[0])
            winners.append(build.zext(build.and_(minimum, mask), _I64))
            # The lane with the minimum moves its list up.
            had = build.icmp_signed("==", lists[0], v.splat(minimum, _INTS))
            after = [*lists[1:], _constant(_LARGEST)]
            lists = [build.select(had, b, a) for a, b in zip(lists, after, strict=True)]
        return context.make_tuple(builder, signature.return_type, winners)

    def search(
        _typing: Any, x: Any, y: Any, z: Any, padded: Any, sx: Any, sy: Any, sz: Any, mask: Any
    ) -> Any:
        real, integer = types.float32, types.int64
        result = types.UniTuple(integer, count)
        return result(x, y, z, integer, real, real, real, types.int32), emit

    search.__doc__ = f"""Return the {count} neurons nearest to a point, nearest first.

    The search minimises keys: squared distances whose lowest bits are replaced by the index.
    Positive floats and their bits as integers have the same order. Distances that differ by less
    than the replaced bits, 1 part in 2**16 for 128 neurons, count as equal; then the lower index is
    first.

    Parameters
    ----------
    x, y, z : float32 arrays of positions, far away where there is no neuron.
    padded : number of elements to search, a multiple of `LANES`.
    sx, sy, sz : the point.
    mask : 2**k - 1, at least the largest index.
    """
    return intrinsic(search)  # type: ignore[no-any-return]  # numba has no types


two_nearest = _nearest(2)
three_nearest = _nearest(3)


@intrinsic
def adapt(
    _typing: Any,
    x: Any,
    y: Any,
    z: Any,
    padded: Any,
    sx: Any,
    sy: Any,
    sz: Any,
    edge_birth: Any,
    row: Any,
    absent: Any,
    wins: Any,
    winner: Any,
    rate_winner: Any,
    rate_neighbour: Any,
) -> Any:
    """Move the winner and its neighbours towards a point; return the largest ``wins - edge_birth``.

    Parameters
    ----------
    x, y, z, padded, sx, sy, sz : as in `two_nearest`.
    edge_birth, row : the int32 array of `Gas`, and the index where the row of the winner begins.
    absent : ``edge_birth`` is at least this where there is no edge.
    wins : the int32 array of `Gas`.
    winner : index of the winner.
    rate_winner, rate_neighbour : fraction of the distance to move.
    """
    real, integer = types.float32, types.int64
    places = (x, y, z, integer, real, real, real)
    return types.int32(
        *places, edge_birth, integer, types.int32, wins, integer, real, real
    ), _emit_adapt


def _emit_adapt(context: Any, builder: Any, signature: Any, args: Any) -> _Value:
    """Emit the instructions of `adapt` for the arguments ``args``; return its result."""
    v, build = _Vectors(context, builder), builder
    arrays = [v.array(signature.args[k], args[k]) for k in range(3)]
    padded, place = args[3], [v.splat(value, _FLOATS) for value in args[4:7]]
    edge_birth = build.gep(v.array(signature.args[7], args[7]), [args[8]])
    absent, wins = v.splat(args[9], _INTS), v.array(signature.args[10], args[10])
    winner = v.splat(build.trunc(args[11], _I32), _INTS)
    rate_winner, rate_neighbour = v.splat(args[12], _FLOATS), v.splat(args[13], _FLOATS)
    oldest = v.variable(_constant(-_LARGEST))
    with v.blocks(padded) as (i, index):
        edge = v.load(edge_birth, i, _INTS)
        linked = build.icmp_signed("<", edge, absent)
        rate = build.select(linked, rate_neighbour, ir.Constant(_FLOATS, [0.0] * LANES))
        rate = build.select(build.icmp_signed("==", index, winner), rate_winner, rate)
        for array, value in zip(arrays, place, strict=True):
            old = v.load(array, i, _FLOATS)
            v.store(v.multiply_add(rate, build.fsub(value, old), old), array, i)
        age = build.sub(v.load(wins, i, _INTS), edge)
        build.store(v.most(build.load(oldest), age), oldest)
    return v.reduce_most(build.load(oldest))
