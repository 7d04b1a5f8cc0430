"""The layout of the descriptor: its blocks, and the names of its features."""

from collections.abc import Iterator

import numpy as np

from shapecat.description.context import CONTEXT_NAMES
from shapecat.description.outline import OUTLINE_NAMES
from shapecat.description.profile import PROFILE_NAMES
from shapecat.description.revolution import REVOLUTION_NAMES
from shapecat.description.solids import SOLID_NAMES

__all__ = [
    "BANDS",
    "BLOCKS",
    "CURVED_BINS",
    "DESCRIPTOR_NAMES",
    "DISTANCE_BINS",
    "MEAN_BINS",
    "RINGS",
    "SHAPE_BINS",
    "UP_BINS",
]

RINGS, BANDS = 3, 4
"""Numbers of intervals of the mean geodesic distance to the other neurons, and of the height."""
DISTANCE_BINS = 12
SHAPE_BINS, CURVED_BINS, MEAN_BINS = 8, 6, 6
"""Numbers of bins for the shape index, the curvedness and the mean curvature."""
UP_BINS = 8
"""Number of bins for the normals' z."""


def _bins(name: str, count: int) -> Iterator[str]:
    """Yield the names of ``count`` bins."""
    return (f"{name}_{k}" for k in range(count))


def _parts(kind: str, parts: int, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of a block: all ``names`` for each of the rings or bands (``kind``)."""
    return tuple(f"{kind}{part}_{name}" for part in range(parts) for name in names)


_CURVATURE_NAMES = (
    *_bins("shape", SHAPE_BINS),
    *_bins("curvedness", CURVED_BINS),
    *_bins("mean", MEAN_BINS),
)
_DISTANCE_NAMES = tuple(_bins("bin", DISTANCE_BINS))
_BLOCK_NAMES: dict[str, tuple[str, ...]] = {
    "context": CONTEXT_NAMES,
    "curvature": _CURVATURE_NAMES,
    "up": tuple(_bins("bin", UP_BINS)),
    "ring_geodesic": _parts("ring", RINGS, _DISTANCE_NAMES),
    "ring_euclid": _parts("ring", RINGS, _DISTANCE_NAMES),
    "ring_curvature": _parts("ring", RINGS, ("share", *_CURVATURE_NAMES)),
    "band_geodesic": _parts("band", BANDS, _DISTANCE_NAMES),
    "band_euclid": _parts("band", BANDS, _DISTANCE_NAMES),
    "band_curvature": _parts("band", BANDS, ("share", *_CURVATURE_NAMES)),
    "profile": PROFILE_NAMES,
    "revolution": REVOLUTION_NAMES,
    "solids": SOLID_NAMES,
    "outline": OUTLINE_NAMES,
    # Metres; ``low`` is the height of the bottom above the support, ``wide`` the largest width,
    # ``across`` and ``along`` are relative to the line of sight, ``spacing`` is between neurons.
    "metric": ("height", "low", "wide", "across", "along", "spacing"),
    "view": ("elevation", "distance"),  # of the sensor from the object: sine, metres
}


def _slices() -> dict[str, slice]:
    """Return the slice of each block in the descriptor, by name."""
    ends = np.cumsum([len(names) for names in _BLOCK_NAMES.values()]).tolist()
    return {
        block: slice(end - len(names), end)
        for (block, names), end in zip(_BLOCK_NAMES.items(), ends, strict=True)
    }


BLOCKS: dict[str, slice] = _slices()
"""The slice of each block in the descriptor. Only ``metric`` and ``view`` depend on the scale."""

DESCRIPTOR_NAMES: tuple[str, ...] = tuple(
    f"{block}.{name}" for block, names in _BLOCK_NAMES.items() for name in names
)
"""The name of each feature, ``block.name``."""
