"""Detection on simulated scenes compared with the truth: objects, planes, support relations.

    python -m benchmarks.simulated shelf empty --first 0 --count 24

One Kinect frame of each scene. Only objects with at least `SEEN_PIXELS` depth pixels are expected
to be found; detections of other objects are ignored.
"""

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple, get_args

import click
import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks.measure import markdown
from benchmarks.scenes import SEEN_PIXELS, Array, detected, simulated_frame
from shapecat.config import DetectionSettings
from shapecat.geometry import inverse
from shapecat.simulation import KINECT
from shapecat.simulation.scenes.kinds import SceneKind
from shapecat.simulation.scenes.worlds import World
from shapecat.types import Frame, Scene

HIT_IOU = 0.5
"""Minimum IoU of the masks of a candidate and the object that it matches."""
SEEN_PLANE_PIXELS = 3000
"""Planes with fewer depth pixels on their upper face are not expected to be found."""
SAME_HEIGHT_M = 0.03
"""Maximum difference of the heights of a found plane and the true one."""
FACE_M = 0.004
"""Points nearer than this to the height of a support, metres, count as its upper face."""
COLUMNS = (
    "objects", "recall", "precision", "planes, scenes", "relations", "empty scenes with objects"
)  # fmt: skip


class View(NamedTuple):
    """A scene, a frame of it, the frame's pixel labels (h * w,), and the detected scene."""

    world: World
    frame: Frame
    labels: Array
    found: Scene


@click.command(help=__doc__)
@click.argument("kinds", nargs=-1, required=True, type=click.Choice(get_args(SceneKind)))
@click.option("--first", default=0, show_default=True, help="Seed of the first scene.")
@click.option("--count", default=24, show_default=True, help="Scenes of each kind.")
def main(*, kinds: tuple[SceneKind, ...], first: int, count: int) -> None:
    """Score scenes of each kind and print a table."""
    rows = [(kind, *_figures(score(kind, first, count))) for kind in kinds]
    title = f"Detection, simulated scenes {first} to {first + count - 1}"
    print(markdown(title, ("scenes", *COLUMNS), rows))


def score(kind: SceneKind, first: int, count: int) -> Counter[str]:
    """Return the counts over ``count`` scenes of a kind, the first with the seed ``first``."""
    total: Counter[str] = Counter()
    for view in _views(kind, first, count):
        matches = _matches(view, total)
        _score_planes(view, total)
        _score_relations(view, matches, total)
        total["scenes"] += 1
        total["empty scenes with objects"] += not view.world.objects and bool(view.found.candidates)
    return total


def _figures(c: Counter[str]) -> Iterator[str]:
    yield str(c["objects"])
    for part, whole in (("hits", "objects"), ("hits", "detections")):
        yield f"{c[part] / c[whole]:.3f}" if c["objects"] and c[whole] else "-"
    yield f"{c['scenes with all planes']} of {c['scenes']}"
    yield f"{c['right relations'] / c['relations']:.3f}" if c["relations"] else "-"
    yield str(c["empty scenes with objects"])


def _views(kind: SceneKind, first: int, count: int) -> Iterator[View]:
    for seed in range(first, first + count):
        world, frame, labels = simulated_frame(kind, seed, KINECT)
        yield View(world, frame, labels, detected(frame))


def _matches(view: View, total: Counter[str]) -> dict[int, int]:
    """Match candidates and objects one to one; count objects, hits and detections in ``total``.

    Returns the index of the candidate that found each object, by the object's label.
    """
    labels, candidates = view.labels, view.found.candidates
    seen = np.bincount(labels, minlength=256)
    listed = [t.label for t in view.world.objects if seen[t.label] >= SEEN_PIXELS]
    small = [t.label for t in view.world.objects if 0 < seen[t.label] < SEEN_PIXELS]
    # Pixels without a label mix two surfaces.
    inside = np.array([np.bincount(labels[c.indices], minlength=256) for c in candidates])
    inside = inside.reshape(-1, 256)
    inside[:, 0] = 0
    common, sizes = inside[:, listed], inside.sum(axis=1)
    iou = common / np.maximum(sizes[:, None] + seen[listed] - common, 1)
    rows, columns = linear_sum_assignment(-iou)
    matches = {
        listed[k]: int(c) for c, k in zip(rows, columns, strict=True) if iou[c, k] >= HIT_IOU
    }
    ignored = inside[:, small].max(axis=1, initial=0) > sizes / 2
    ignored[list(matches.values())] = False
    total["objects"] += len(listed)
    total["hits"] += len(matches)
    total["detections"] += int(np.count_nonzero(~ignored))
    return matches


def _heights(view: View) -> Array:
    """Return the heights of the found planes in the world, metres."""
    camera = view.world.path[0].translation[2]
    return np.array([plane.offset + camera for plane in view.found.planes])


def _score_planes(view: View, total: Counter[str]) -> None:
    """Count the scene if all clearly visible planes were found, and no false ones."""
    up = inverse(view.world.path[0]).rotation[:, 2]
    points = view.frame.xyz()
    height = points @ up + view.world.path[0].translation[2]
    near = points[:, 2] <= DetectionSettings().max_range_m
    found = _heights(view)
    horizontal = [s for s in view.world.supports if s.holds_objects]
    for support in horizontal:
        face = near & (view.labels == support.label) & (abs(height - support.height) < FACE_M)
        missed = not (abs(found - support.height) < SAME_HEIGHT_M).any()
        if missed and np.count_nonzero(face) >= SEEN_PLANE_PIXELS:
            return
    true = np.array([s.height for s in horizontal])
    if all((abs(true - h) < SAME_HEIGHT_M).any() for h in found):
        total["scenes with all planes"] += 1


def _score_relations(view: View, matches: dict[int, int], total: Counter[str]) -> None:
    """Count the support relations of found objects, and the right ones.

    Objects on an object that was not found are left out; ``matches`` are from `_matches`.
    """
    heights = {s.name: s.height for s in view.world.supports if s.holds_objects}
    found = _heights(view)
    for item in view.world.objects:
        if item.label not in matches:
            continue
        candidate = view.found.candidates[matches[item.label]]
        if item.on_support is not None:
            height = np.inf if candidate.plane is None else found[candidate.plane]
            apart = abs(height - heights[item.on_support])
            right = candidate.on_candidate is None and bool(apart < SAME_HEIGHT_M)
        elif item.on_track is not None:
            below = view.world.objects[item.on_track].label
            if below not in matches:
                continue
            right = candidate.on_candidate == matches[below]
        total["relations"] += 1
        total["right relations"] += right


if __name__ == "__main__":
    main()
