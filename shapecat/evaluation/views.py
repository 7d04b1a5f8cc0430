"""From labelled views to descriptors, as in a run but without detection."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4
from shapecat.config import Settings
from shapecat.description import DESCRIPTOR_NAMES, describe
from shapecat.evaluation.dataset import View
from shapecat.evaluation.shape_functions import shape_functions
from shapecat.surface import reconstruct, thin

__all__ = ["DescribedViews", "describe_view", "describe_views"]

_NOT_ASKED = np.zeros(0)
"""Value of a column that was not requested."""
_NEAR_SUPPORT_M = 0.05
"""Maximum distance from z = 0 of the lowest visible point of an object that stands at z = 0."""


class DescribedViews(NamedTuple):
    """Described views, and the quantities by which a report breaks them down.

    Attributes
    ----------
    descriptors : (n, d).
    labels, instances : (n,) names of the categories, and of the instances as category/instance.
    points : (n,) number of voxels.
    distances : (n,) distance from the sensor, metres.
    skipped : number of views with too few points for a surface, which are left out.
    elevations : (n,) elevation of the sensor as seen from the object, degrees; may be empty.
    functions : (n, f) shape distributions from `shapecat.evaluation.shape_functions`; may
        be empty.
    off_support : categories of which most views, even skipped ones, have their lowest point farther
        than `_NEAR_SUPPORT_M` from z = 0. Their points are probably in another frame.
    """

    descriptors: F4
    labels: np.ndarray
    instances: np.ndarray
    points: np.ndarray
    distances: np.ndarray
    skipped: int = 0
    elevations: np.ndarray = _NOT_ASKED
    functions: F4 = _NOT_ASKED
    off_support: tuple[str, ...] = ()

    def where(self, chosen: np.ndarray) -> "DescribedViews":
        """Return the views that a mask (n,) or indices select."""
        columns = {
            name: value[chosen]
            for name, value in self._asdict().items()
            if name not in {"skipped", "off_support"} and len(value) == len(self.labels)
        }
        return self._replace(**columns)


class DescribedView(NamedTuple):
    """The descriptor (d,) of a view, and its number of voxels."""

    descriptor: F4
    points: int


def describe_view(
    view: View, *, settings: Settings, rng: np.random.Generator
) -> DescribedView | None:
    """Describe a view; return None if it has too few points for a surface."""
    cloud = thin(view.points, settings=settings.surface)
    gas = reconstruct(cloud, settings=settings.surface, rng=rng)
    if gas is None:
        return None
    return DescribedView(describe(cloud, gas, view.eye), len(cloud))


def describe_views(
    views: Iterable[View],
    *,
    settings: Settings,
    with_functions: bool = False,
) -> DescribedViews:
    """Describe each view; the random generator of view k, from 1, has the seed (settings.seed, k).

    Parameters
    ----------
    with_functions : whether to compute shape distributions too.
    """
    described_views: list[tuple[DescribedView, str, str, float, float]] = []
    functions: list[F4] = []
    near_support: dict[str, list[bool]] = {}
    count = 0
    for count, view in enumerate(views, start=1):
        lowest = abs(float(view.points[:, 2].min()))
        near_support.setdefault(view.category, []).append(lowest <= _NEAR_SUPPORT_M)
        described = describe_view(
            view, settings=settings, rng=np.random.default_rng((settings.seed, count))
        )
        if described is not None:
            x, y, z = (view.eye - view.points.mean(axis=0)).tolist()
            distance, elevation = math.hypot(x, y, z), math.degrees(math.atan2(z, math.hypot(x, y)))
            name = f"{view.category}/{view.instance}"
            described_views.append((described, view.category, name, distance, elevation))
            if with_functions:
                rng = np.random.default_rng((settings.seed, count, 1))
                functions.append(shape_functions(view.points, rng))
    return DescribedViews(
        descriptors=np.array([item[0].descriptor for item in described_views], np.float32).reshape(
            len(described_views), len(DESCRIPTOR_NAMES)
        ),
        labels=np.array([item[1] for item in described_views], str),
        instances=np.array([item[2] for item in described_views], str),
        points=np.array([item[0].points for item in described_views], np.int64),
        distances=np.array([item[3] for item in described_views]),
        skipped=count - len(described_views),
        elevations=np.array([item[4] for item in described_views]),
        functions=np.array(functions, np.float32) if with_functions else _NOT_ASKED,
        off_support=tuple(name for name, near in near_support.items() if 2 * sum(near) < len(near)),
    )
