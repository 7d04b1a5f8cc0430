"""Tests of rooms, and of the benchmark that counts detections on their background."""

import numpy as np
import pytest

from benchmarks.rooms import count
from shapecat.simulation import make_scene
from shapecat.simulation.scenes.worlds import FIRST_OBJECT_LABEL
from shapecat.simulation.shapes.distractors import make_distractor
from shapecat.simulation.shapes.procedural import PROCEDURAL

FIRST = FIRST_OBJECT_LABEL


def test_rooms_contain_objects_and_background() -> None:
    """Otherwise the benchmark counts nothing."""
    rooms = [make_scene("room", np.random.default_rng(seed), frames=1) for seed in (0, 3)]
    assert sum(any(s.name.startswith("robot") for s in room.supports) for room in rooms) > 1
    assert sum(any(s.name.startswith("room_") for s in room.supports) for room in rooms) > 1
    for room in rooms:
        assert len(room.objects) >= 3
        assert len({s.name for s in room.supports}) == len(room.supports)
        assert all(1 <= s.label <= 9 for s in room.supports)


def test_detections_on_background_and_fragments_are_counted() -> None:
    labels = np.repeat([2, 6, FIRST, FIRST + 1], 1000)
    arm, most, rest = np.arange(1200, 1700), np.arange(2000, 2800), np.arange(2800, 3000)
    blend = np.concatenate([np.arange(3000, 3400), np.arange(0, 700)])  # mostly table
    counts = count([arm, most, rest, blend], labels)
    assert (counts.detections, counts.elsewhere, counts.pieces) == (4, 2, 1)
    assert (counts.objects, counts.found) == (2, 1)
    total = counts + count([most], labels)
    assert total.row("all")[3:] == (3, 1, "0.500", "1.50")


def test_fragment_is_counted_even_if_another_object_is_missed() -> None:
    """Matching one to one pairs the fragment with the missed object, which it does not touch."""
    labels = np.repeat([0, FIRST, FIRST + 1], 1000)
    counts = count([np.arange(1000, 1800), np.arange(1800, 2000)], labels)
    assert (counts.pieces, counts.found) == (1, 1)


@pytest.mark.parametrize("kind", PROCEDURAL)
def test_procedural_families_give_distinct_objects_of_table_size(kind: str) -> None:
    """These objects train *unknown*, so they must fit on a table, and no two may be equal."""
    found = [make_distractor(np.random.default_rng(seed), [kind])[1] for seed in range(30)]
    for mesh in found:
        assert 0.02 < mesh.extents.max() < 0.6
        assert abs(mesh.vertices[:, 2].min()) < 1e-6
    assert len({mesh.extents.tobytes() for mesh in found}) == len(found)
