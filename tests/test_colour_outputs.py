"""Tests of colour in a run: masks, review, and annotated recording."""

import json
import shutil
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import Result

import shapecat.pipeline
from shapecat.cameras.colour import ColourImage, ColourView
from shapecat.colour.image_masks import box_of, mask_of
from shapecat.colour.masks import Mask
from shapecat.colour.rle import rle_counts, rle_mask, rle_text
from shapecat.config import Settings
from shapecat.errors import NoStreamError
from shapecat.outputs.annotation import image_annotations
from shapecat.outputs.annotation.image_annotations import (
    read_image_frames,
)
from shapecat.outputs.colouring import Coloured, with_colour
from shapecat.outputs.review.scenes import ReviewFrame
from shapecat.outputs.review.writing import write_review
from shapecat.perception import Perceiver
from shapecat.pipeline import annotate_again, process
from shapecat.recordings import FrameRange, open_recording
from shapecat.runs.finished import open_source, read_finished
from shapecat.runs.jobs import Job
from shapecat.types import ImageMasks, LabelledFrame
from tests.colour_messages import gradient, png, raw
from tests.conftest import Guesser
from tests.mcap_files import read_ros
from tests.messages import EPOCH, SECOND, write
from tests.test_exports import relabel
from tests.test_recordings_colour import MS, depth_items
from tests.test_review import TOPIC, labelled_object, rows, scene, stamp
from tests.track_tables import read_masks

IMAGES = "/camera/color/image_raw/compressed"
FRAMES = 4
UP = np.array([0.0, -1.0, 0.0])


@pytest.fixture
def run(coloured_run: Path) -> Path:
    """Return `coloured_run` itself: tests that change it make a copy."""
    return coloured_run


def test_masks_of_run_match_simulated_truth(run: Path) -> None:
    """All steps from recording to table are tested, on each object of more than 2000 pixels."""
    source = run.parents[1] / "table.mcap"
    truth = np.load(source.with_suffix(".color_labels.npz"))["labels"]
    found = list(read_masks(run))
    assert [frame for (_, frame), _ in found] == list(range(FRAMES))
    best = []
    for (_, frame), masks in found:
        labels = truth[frame]
        assert (masks.height, masks.width) == labels.shape
        own = [mask_of(masks, [number]).full(*labels.shape) for number in masks.counts]
        for label in np.unique(labels[labels >= 20]):
            visible = labels == label
            if visible.sum() > 2000:
                best.append(max(float((visible & m).sum() / (visible | m).sum()) for m in own))
    assert len(best) > 4 * FRAMES
    assert np.median(best) > 0.85


def test_stored_boxes_match_masks(run: Path) -> None:
    """Annotations use the boxes, exports the masks: the two must agree."""
    _, masks = next(iter(read_masks(run)))
    for number, box in masks.boxes.items():
        assert mask_of(masks, [number]).box == box
    numbers = list(masks.boxes)[:2]
    assert box_of(masks, numbers) == mask_of(masks, numbers).box
    assert box_of(masks, [999]) is None
    assert mask_of(masks, [999]).area == 0


def test_review_has_original_images(run: Path) -> None:
    """Images compressed twice are blurred. Every frame whose scene is drawn has its own image."""
    entity = "/images//camera/depth/image_raw"
    source = run.parents[1] / "table.mcap"
    images = [bytes(message.data) for _, message in read_ros(source, IMAGES)]
    stored = {r["frame"]: bytes(bytearray(r["EncodedImage:blob"][0])) for r in _rows(run, entity)}
    assert stored == {frame: images[frame] for frame in stored}
    drawn = _rows(run, "/world/seen//camera/depth/image_raw/scene")
    assert list(stored) == [row["frame"] for row in drawn]
    assert 0 in stored


@pytest.mark.parametrize("wanted", [(1,), (0, 3), (2, 3), (0, 1, 2, 3)])
def test_selected_frames_keep_their_own_image(run: Path, wanted: Sequence[int]) -> None:
    """Images between the wanted frames are skipped; none may replace another."""
    finished = read_finished(run)
    of_frame = {frame: masks for (_, frame), masks in read_masks(run)}
    frames = (frame for frame in finished.frames() if frame.index in wanted)
    with open_source(finished.info) as source:
        for labelled, frame, coloured in with_colour(frames, source, finished.info):
            assert frame.index == labelled.index
            assert coloured is not None
            assert coloured.view.image.stamp_ns == of_frame[frame.index].stamp_ns
            assert [mask.box for mask in coloured.masks] == [
                box_of(of_frame[frame.index], item.detections) or (0, 0, 0, 0)
                for item in labelled.objects
            ]
            assert len(coloured.masks) > 3


def test_frames_keep_their_image_if_the_clock_was_set_back(tmp_path: Path) -> None:
    """Found by stamp alone, the image of a mask might be from before the clock was set back."""
    logged = [EPOCH + k * 100 * MS for k in range(20)]
    stamps = [time - (k > 9) * SECOND for k, time in enumerate(logged)]
    items: list[tuple[str, int, Any]] = []
    labelled = []
    for k, (time, at) in enumerate(zip(logged, stamps, strict=True)):
        items += [(topic, time, message) for topic, _, message in depth_items(at)]
        items.append(("/cam/color/image_raw", time + MS, raw(at, gradient(), "rgb8")))
        masks = ImageMasks("/cam/color/image_raw", at, time + MS, "camera", 64, 48, {}, {})
        one = LabelledFrame("/cam/depth/image_raw", k, at, time, "camera", None, (), (), (), {}, UP)
        labelled.append(replace(one, masks=masks))
    options = {"topics": ["/cam/depth/image_raw"], "color": None, "every": 1}
    run: Any = {"options": options | {"start_s": None, "end_s": None}, "color": {}}
    wanted = [labelled[k] for k in (2, 3, 6, 12, 13, 14, 17)]
    with open_recording(write(tmp_path / "a.mcap", items)) as source:
        found = list(with_colour(wanted, source, run))

    assert [labelled.index for labelled, _, _ in found] == [2, 3, 6, 12, 13, 14, 17]
    images = [None if one is None else one.view.image.log_time_ns for _, _, one in found]
    assert images == [labelled.log_time_ns + MS for labelled in wanted]


def _rows(run: Path, entity: str) -> list[dict[str, Any]]:
    return [row for row in rows(run / "review.rrd", entity) if len(row) > 2]


def test_mask_of_merged_tracks_covers_all_parts(run: Path) -> None:
    """Exports, review and report would show half of an object that a person put together."""
    finished = read_finished(run)
    first = next(iter(finished.frames()))
    masks = first.masks
    assert masks is not None
    one, other = [item for item in first.objects if item.detections[0] in masks.boxes][:2]
    whole = replace(one, detections=(*one.detections, *other.detections))
    with open_source(finished.info) as source:
        ((_, _, coloured),) = with_colour([replace(first, objects=(whole,))], source, finished.info)

    assert coloured is not None
    shape = masks.height, masks.width
    parts = [mask_of(masks, item.detections).full(*shape) for item in (one, other)]
    np.testing.assert_array_equal(coloured.masks[0].full(*shape), parts[0] | parts[1])


def test_image_annotations_have_stamp_and_frame_of_image(run: Path) -> None:
    """Foxglove draws only annotations with exactly the timestamp of the image."""
    images = read_ros(run / "annotated.mcap", IMAGES)
    found = read_ros(run / "annotated.mcap", "/shapecat/detections_2d")
    drawn = read_ros(run / "annotated.mcap", "/shapecat/image_annotations")
    assert len(images) == len(found) == len(drawn) == FRAMES
    for (_, masks), (time, image), (time_2d, array), (_, drawing) in zip(
        read_masks(run), images, found, drawn, strict=True
    ):
        assert time == time_2d
        assert array.header.stamp.sec == image.header.stamp.sec
        assert array.header.stamp.nanosec == image.header.stamp.nanosec
        assert array.header.frame_id == image.header.frame_id == "camera_color_optical_frame"
        assert len(array.detections) == len(drawing.points) == len(drawing.texts) > 3
        boxes = set(masks.boxes.values())
        for one, points, text in zip(array.detections, drawing.points, drawing.texts, strict=True):
            left = one.bbox.center.position.x - one.bbox.size_x / 2
            top = one.bbox.center.position.y - one.bbox.size_y / 2
            assert (left, top, one.bbox.size_x, one.bbox.size_y) in boxes
            assert (points.points[0].x, points.points[0].y) == (left, top)
            assert (points.points[2].x, points.points[2].y) == (
                left + one.bbox.size_x,
                top + one.bbox.size_y,
            )
            assert points.type == 2
            assert text.text.split()[:2] == [f"#{one.id}", one.results[0].hypothesis.class_id]


def test_colours_of_unorganized_cloud_are_not_annotated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Colours of such a cloud are a single row, which no viewer shows as an image."""
    masks = [
        (("/d", k), ImageMasks("/colour", 7 + k, 7, "camera", 64, height, {}, {}))
        for k, height in enumerate((1, 48))
    ]
    monkeypatch.setattr(image_annotations, "read_nearest_masks", lambda *_: iter(masks))
    tracks: Any = SimpleNamespace(objects=lambda _: {})

    assert [frame.stamp_ns for frame in read_image_frames(Path(), tracks)] == [8]


def test_corrections_change_image_annotations(run: Path, tmp_path: Path) -> None:
    """A deleted track must vanish from the images, although masks are not computed again."""
    folder = tmp_path / "table"
    shutil.copytree(run, folder)
    relabel(folder, {1: "delete", 2: "wine glass"})
    before = (folder / "masks.parquet").stat().st_mtime_ns
    shapecat.pipeline.annotate_again(folder, None)

    arrays = [m for _, m in read_ros(folder / "annotated.mcap", "/shapecat/detections_2d")]
    shown = [(d.id, d.results[0].hypothesis.class_id) for a in arrays for d in a.detections]
    assert ("2", "wine glass") in shown
    assert "1" not in {track for track, _ in shown}
    assert (folder / "masks.parquet").stat().st_mtime_ns == before


def test_colour_can_be_disabled_and_wrong_topic_is_refused(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shapecat: Callable[..., Result]
) -> None:
    """A topic without images must be refused before the work begins, not after."""
    monkeypatch.setattr("shapecat.pipeline.load_model", lambda _path: Guesser())
    source = run.parents[1] / "table.mcap"
    process(
        Job(
            source=source,
            folder=tmp_path / "a",
            color="",
            rrd=False,
            frame_range=FrameRange(end_s=0.04),
        )
    )
    assert not (tmp_path / "a" / "masks.parquet").exists()
    assert not read_ros(tmp_path / "a" / "annotated.mcap", "/shapecat/detections_2d")
    with pytest.raises(NoStreamError, match="/tf holds no colour images; colour images: /camera"):
        process(Job(source=source, folder=tmp_path / "b", color="/tf"))
    result = shapecat("process", source, "--out", tmp_path, "--color", "/x", "--no-color")
    assert result.exit_code == 2
    assert "contradict" in result.stderr


def test_masks_do_not_depend_on_processes_or_interruptions(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any process may compute masks, and segments store them with the other tables."""
    sent = []

    def in_other_process(*parts: Any) -> Callable[[Any], Any]:
        def perceive(views: Any) -> Any:
            perceiver, received = deepcopy((Perceiver(*parts), views))  # only what is sent
            sent.append(received)
            return deepcopy(perceiver(received))

        return perceive

    source, single = run.parents[1] / "table.mcap", Settings(reuse_frames=1)

    def job(name: str) -> Job:
        return Job(source=source, folder=tmp_path / name, settings=single, rrd=False, mcap=False)

    def interrupt(phase: str, done: int, _total: int | None) -> None:
        if phase == "perceive" and done == 3:
            raise KeyboardInterrupt

    process(job("one"))
    with monkeypatch.context() as patched:
        patched.setattr("shapecat.runs.perceive.phases.Perceiver", in_other_process)
        process(job("sent"))
    assert len(sent) == FRAMES
    with pytest.raises(KeyboardInterrupt):
        process(job("resumed"), interrupt)
    assert process(job("resumed")).counts["resumed"] == 3
    masks = {name: pq.read_table(tmp_path / name / "masks.parquet") for name in ("one", "sent")}
    assert masks["one"].equals(masks["sent"])
    assert masks["one"].equals(pq.read_table(tmp_path / "resumed" / "masks.parquet"))
    assert masks["one"].num_rows == FRAMES


def test_run_json_names_colour_topic(run: Path) -> None:
    about = json.loads((run / "run.json").read_text())
    assert about["color"] == {"/camera/depth/image_raw": IMAGES}
    assert about["counts"]["color"] == FRAMES
    assert pq.read_table(run / "masks.parquet").num_rows == FRAMES


def test_run_lengths_match_coco_and_decode_to_mask() -> None:
    """Training code reads masks column by column; a row-wise mask would be noise."""
    rng = np.random.default_rng(5)
    for height, width in ((7, 9), (1, 6), (6, 1), (40, 31)):
        for share in (0.0, 0.3, 0.8, 1.0):
            full = rng.random((height, width)) < share
            inside = np.argwhere(full)
            if len(inside):
                (top, left), (bottom, right) = inside.min(axis=0), inside.max(axis=0) + 1
                mask = Mask(int(left), int(top), full[top:bottom, left:right])
            else:
                mask = Mask(0, 0, np.zeros((0, 0), bool))
            counts = rle_counts(mask, height, width)
            flat = full.T.ravel()
            runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[-1], flat, [-1]]))))
            expected = runs if len(flat) and not flat[0] else np.concatenate([[0], runs])
            np.testing.assert_array_equal(counts, expected)
            back = rle_mask(counts, height, width)
            np.testing.assert_array_equal(back.full(height, width), full)
            assert back.box == mask.box
    with pytest.raises(ValueError, match="run lengths of 5 pixels"):
        rle_mask(np.array([5]), 2, 3)
    # Of a 3 x 4 image; from the fourth on, a run is a difference from the run two before it.
    assert rle_text(np.array([3, 2, 1, 1, 5])) == "321O4"


def test_review_omits_only_damaged_image(tmp_path: Path) -> None:
    """An image may state the right size and be damaged; its frame is shown without colour."""
    whole = png(gradient())
    half, views = len(whole) // 2, []
    for k, data in enumerate((whole[:half] + bytes(20) + whole[half + 20 :], whole)):
        image = ColourImage("/color", stamp(k), stamp(k), "optical", "png", 64, 48, 0, data)
        views.append(Coloured(ColourView(image), (Mask(3, 4, np.ones((5, 6), bool)),)))
    scenes = [ReviewFrame(*scene(k, [labelled_object(1)]), view) for k, view in enumerate(views)]
    path = tmp_path / "review.rrd"
    run: Any = {
        "warnings": [],
        "options": {"topics": [TOPIC]},
        "settings": {"outputs": {"cloud_points": 1000}},
        "model": {"categories": ["cup", "can"]},
        "fixed_frame": None,
    }
    write_review(path, scenes, name="lab", run=run, labels={})

    entity = f"/images/{TOPIC}"
    images = [row for row in rows(path, entity) if row.get("EncodedImage:blob")]
    assert [row["frame"] for row in images] == [1]
    (box,) = (row for row in rows(path, f"{entity}/boxes") if row.get("Boxes2D:centers"))
    assert np.allclose(box["Boxes2D:centers"], [[6, 6.5]])
    assert np.allclose(box["Boxes2D:half_sizes"], [[3, 2.5]])
    texts = [row["TextLog:text"][0] for row in rows(path, "/log")]
    assert any(text.startswith("/color: png image is damaged") for text in texts)
    assert rows(path, f"/world/{TOPIC}/scene")


def test_annotate_again_writes_both_outputs(
    coloured_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a review or an annotated recording would keep its old labels."""
    folder, written = tmp_path / "table", []
    shutil.copytree(coloured_run, folder)
    writers = ["annotation.annotated_mcap.write_annotated", "review.writing.write_review"]
    for name in writers:
        monkeypatch.setattr(f"shapecat.outputs.{name}", lambda *_, n=name, **__: written.append(n))
    annotate_again(folder, None)

    assert sorted(written) == writers
