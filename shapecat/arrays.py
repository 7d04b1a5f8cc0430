"""Shape-checked, read-only arrays for the records."""

from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, TypeAlias, dataclass_transform

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

__all__ = ["F4", "F8", "I4", "U1", "U2", "U4", "Bool", "Record", "array", "freeze"]

F4: TypeAlias = NDArray[Any]
F8: TypeAlias = NDArray[Any]
I4: TypeAlias = NDArray[Any]
U1: TypeAlias = NDArray[Any]
U2: TypeAlias = NDArray[Any]
U4: TypeAlias = NDArray[Any]
Bool: TypeAlias = NDArray[Any]
# The aliases name the element type for the reader; `freeze` enforces it when a record is made.


def freeze(
    value: ArrayLike, shape: str, dtype: DTypeLike, sizes: dict[str, int] | None = None
) -> NDArray[Any]:
    """Return ``value`` as a read-only array of the stated shape and type.

    Parameters
    ----------
    value : anything numpy can read without loss of kind.
    shape : axes separated by blanks: a number is that size, a name is any size, the same
        name always the same size. ``""`` is a scalar.
    dtype : numpy type of the result.
    sizes : sizes of named axes met so far; new names are added to it.

    Returns
    -------
    A read-only view where the type fits already, otherwise a read-only copy.

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


def _axes(shape: str) -> Axes:
    return tuple(int(axis) if axis.isdigit() else axis for axis in shape.split())


def _freeze(
    value: ArrayLike, axes: Axes, dtype: np.dtype[Any], sizes: dict[str, int]
) -> NDArray[Any]:
    """Do the work of `freeze`: records are made by the thousand."""
    result = np.asarray(value, dtype)
    # A shape of numbers alone is compared at once.
    if result.shape != axes and not _agree(axes, result.shape, sizes):
        known = f" with {sizes}" if sizes else ""
        names = ", ".join(map(str, axes))
        msg = f"expected shape ({names}){known}, got {result.shape}"
        raise ValueError(msg)
    if result.flags.writeable:
        result = result.view()
        result.setflags(write=False)
    return result


def _agree(axes: Axes, shape: tuple[int, ...], sizes: dict[str, int]) -> bool:
    """Whether a shape is as stated; ``sizes`` of names met for the first time are added."""
    if len(axes) != len(shape):
        return False
    for axis, size in zip(axes, shape, strict=True):
        if size != (sizes.setdefault(axis, size) if isinstance(axis, str) else axis):
            return False
    return True


def array(shape: str, dtype: str, **options: Any) -> Any:
    """Declare an array field of a `Record`: its shape as in `freeze`, and its type."""
    return field(metadata={"shape": shape, "dtype": dtype}, **options)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(array, field))
class Record:
    """Base of the frozen records: array fields are checked, frozen, and tied in their sizes.

    Every subclass is a frozen dataclass. A field declared by ``array("n 3", "f4")`` has as many
    rows as every other field of the same record that names an axis ``n``. A field whose value is
    ``None`` is left alone.
    """

    _arrays: ClassVar[tuple[tuple[str, Axes, np.dtype[Any]], ...]] = ()

    def __init_subclass__(cls) -> None:
        """Make the subclass a frozen dataclass."""
        made = dataclass(frozen=True, eq=False)(cls)
        cls._arrays = tuple(
            (item.name, _axes(item.metadata["shape"]), np.dtype(item.metadata["dtype"]))
            for item in fields(made)  # type: ignore[arg-type]  # every subclass is a dataclass
            if "shape" in item.metadata
        )

    def __post_init__(self) -> None:
        """Freeze the array fields."""
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
