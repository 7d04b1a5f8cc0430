"""Shape-checked, read-only arrays for the records."""

import reprlib
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, TypeAlias, dataclass_transform

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

__all__ = [
    "F4",
    "F8",
    "I4",
    "U1",
    "U2",
    "U4",
    "Bool",
    "Record",
    "Records",
    "Row",
    "array",
    "freeze",
]

F4: TypeAlias = NDArray[np.floating[Any]]
F8: TypeAlias = NDArray[np.floating[Any]]
I4: TypeAlias = NDArray[np.integer[Any]]
U1: TypeAlias = NDArray[np.integer[Any]]
U2: TypeAlias = NDArray[np.integer[Any]]
U4: TypeAlias = NDArray[np.integer[Any]]
Bool: TypeAlias = NDArray[np.bool_]
Records: TypeAlias = NDArray[np.void]
"""An array of a structured type, whose elements kernels read and write by the names of fields."""
Row: TypeAlias = Any
"""One element of a `Records` array."""
# mypy only tells floats, integers and Booleans apart; records enforce the exact type with `freeze`.


def freeze(
    value: ArrayLike, shape: str, dtype: DTypeLike, sizes: dict[str, int] | None = None
) -> NDArray[Any]:
    """Return ``value`` as a read-only array of the stated shape and type.

    Parameters
    ----------
    value : anything ``numpy.asarray`` converts.
    shape : axes separated by spaces. A number is a fixed size; a name is any size, but every axis
        of that name has the same size. ``""`` is a scalar.
    dtype : numpy type of the result.
    sizes : the sizes of the named axes so far; new names are added.

    Returns
    -------
    ``value`` if it is read-only and of this type, a read-only view if only the type fits, otherwise
    a read-only copy.

    Raises
    ------
    ValueError : the shape does not fit.

    Examples
    --------
    >>> freeze([[0, 0, 1]], "n 3", "f4").flags.writeable
    False
    >>> freeze([1, 2], "3", "f4")
    Traceback (most recent call last):
    ...
    ValueError: expected shape (3), got (2,)
    """
    return _freeze(value, _axes(shape), np.dtype(dtype), {} if sizes is None else sizes)


Axes = tuple[int | str, ...]
"""A parsed shape: sizes and names of axes."""


def _axes(shape: str) -> Axes:
    return tuple(int(axis) if axis.isdigit() else axis for axis in shape.split())


def _freeze(
    value: ArrayLike, axes: Axes, dtype: np.dtype[Any], sizes: dict[str, int]
) -> NDArray[Any]:
    """Do the work of `freeze` with parsed arguments, for speed."""
    result = np.asarray(value, dtype)
    # A shape without named axes is compared directly.
    if result.shape != axes and not _agree(axes, result.shape, sizes):
        given = f" with {sizes}" if sizes else ""
        names = ", ".join(map(str, axes))
        msg = f"expected shape ({names}){given}, got {result.shape}"
        raise ValueError(msg)
    if result.flags.writeable:
        result = result.view()
        result.setflags(write=False)
    return result


def _agree(axes: Axes, shape: tuple[int, ...], sizes: dict[str, int]) -> bool:
    """Return whether a shape fits ``axes``; add the sizes of new names to ``sizes``."""
    if len(axes) != len(shape):
        return False
    for axis, size in zip(axes, shape, strict=True):
        if size != (sizes.setdefault(axis, size) if isinstance(axis, str) else axis):
            return False
    return True


def array(shape: str, dtype: str, **options: Any) -> Any:
    """Declare an array field of a `Record`, with its shape (as in `freeze`) and its type.

    ``options`` are those of `dataclasses.field`.
    """
    return field(metadata={"shape": shape, "dtype": dtype}, **options)


class _ShortRepr(reprlib.Repr):
    """A ``repr`` that fits a console: type and shape of arrays, first elements of collections."""

    def __init__(self) -> None:
        super().__init__()
        self.maxother = 200

    def repr_ndarray(self, value: NDArray[Any], _level: int) -> str:
        """Return type and shape, even of an array in a collection."""
        return f"{value.dtype} {value.shape}"


_short_repr = _ShortRepr()


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(array, field))
class Record:
    """Base class of the records: a frozen dataclass that checks and freezes its array fields.

    Within a record, axes of the same name have the same size: a field ``array("n 3", "f4")`` has
    as many rows as a field ``array("n", "u4")`` has elements. Fields that are ``None`` are not
    checked.
    """

    _arrays: ClassVar[tuple[tuple[str, Axes, np.dtype[Any]], ...]] = ()

    def __init_subclass__(cls) -> None:
        """Make the subclass a frozen dataclass."""
        made = dataclass(frozen=True, eq=False, repr=False)(cls)
        cls._arrays = tuple(
            (item.name, _axes(item.metadata["shape"]), np.dtype(item.metadata["dtype"]))
            for item in fields(made)  # type: ignore[arg-type]  # every subclass is a dataclass
            if "shape" in item.metadata
        )

    def __post_init__(self) -> None:
        """Check the array fields and make them read-only."""
        sizes: dict[str, int] = {}
        for name, axes, dtype in self._arrays:
            value = getattr(self, name)
            if value is None:
                continue
            try:
                frozen = _freeze(value, axes, dtype, sizes)
            except ValueError as error:
                msg = f"{type(self).__name__}.{name}: {error}"
                raise ValueError(msg) from None
            if frozen is not value:
                object.__setattr__(self, name, frozen)

    def __repr__(self) -> str:
        values = (f"{name}={_short_repr.repr(value)}" for name, value in vars(self).items())
        return f"{type(self).__name__}({', '.join(values)})"

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickled record, and make its arrays read-only again."""
        self.__dict__.update(state)
        for name, *_ in self._arrays:
            if (value := state.get(name)) is not None:
                value.setflags(write=False)
