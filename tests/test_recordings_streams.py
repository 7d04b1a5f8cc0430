"""Tests of the choice of depth and colour streams among the topics of a recording."""

from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from shapecat.errors import NoStreamError
from shapecat.recordings import (
    choose_streams,
    colour_streams,
    depth_streams,
    frames,
    open_recording,
    sensors,
    streams,
)
from shapecat.recordings.colour_streams import ColourStream, pair_colours
from shapecat.recordings.decoding.depth_image import DEPTH_ENCODINGS
from shapecat.recordings.overview import describe_recording
from shapecat.recordings.recording import Recording
from shapecat.recordings.sensors import Stream, by_sensor
from tests.colour_messages import gradient, packed, raw
from tests.depth_encodings import png
from tests.messages import (
    EPOCH,
    IMAGE,
    cloud,
    compressed,
    image,
    info,
    organized_points,
    wavy_depth,
    write,
)

Item = tuple[str, int, Any]


def depth_and_info(topic: str, info_topic: str, encoding: str = "16UC1") -> list[Item]:
    depth = wavy_depth().astype("<f4") if encoding == "32FC1" else wavy_depth()
    return [(info_topic, EPOCH, info(EPOCH)), (topic, EPOCH, image(EPOCH, depth, encoding))]


@pytest.mark.parametrize("lead", ["/", ""])
def test_calibration_is_found_beside_topic_without_slash(tmp_path: Path, lead: str) -> None:
    """Some recorders omit the leading slash; the depth would have no calibration."""
    items = depth_and_info(f"{lead}depth/image", f"{lead}depth/camera_info")
    items += [
        (f"{lead}rgb/camera_info", EPOCH, info(EPOCH)),
        (f"{lead}ir/image", EPOCH, image(EPOCH, wavy_depth())),
    ]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        found = [(s.topic, s.info_topic) for s in depth_streams(recording)]

    assert found == [(f"{lead}depth/image", f"{lead}depth/camera_info")]


def test_calibration_below_the_topic_of_its_images_is_found(tmp_path: Path) -> None:
    """AirSim and MultiSense publish CameraInfo there; their depth and colour had no calibration."""
    items = depth_in("/sim/front/DepthPlanar", "front")
    items[0] = ("/sim/front/DepthPlanar/camera_info", *items[0][1:])
    items += in_frame([("/sim/front/Scene/camera_info", EPOCH, info(EPOCH))], "front")
    items.append(("/sim/front/Scene", EPOCH, raw(EPOCH, gradient(), "rgb8", "front")))

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        (depth,) = choose_streams(recording)
        colour = pair_colours(recording, [depth]).get(depth.topic)
    assert depth.info_topic == "/sim/front/DepthPlanar/camera_info"
    assert colour is not None
    assert colour.info_topic == "/sim/front/Scene/camera_info"


@pytest.mark.parametrize("colour_info", ["camera_info", "color_camera_info"])
def test_calibration_named_after_its_images_is_found(tmp_path: Path, colour_info: str) -> None:
    """depth_image goes with depth_camera_info, but silently got colour intrinsics, or none."""
    items = depth_in("/head/depth_image", "optical")
    items[0] = ("/head/depth_camera_info", *items[0][1:])
    items += depth_in("/head/aligned_depth_to_color/image", "optical")[1:]
    items += in_frame([(f"/head/{colour_info}", EPOCH, info(EPOCH))], "optical")
    items.append(("/head/color_image", EPOCH, raw(EPOCH, gradient(), "rgb8", "optical")))

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        aligned, depth = depth_streams(recording)
        colour = pair_colours(recording, [depth]).get(depth.topic)
    assert depth.info_topic == "/head/depth_camera_info"
    assert aligned.info_topic == f"/head/{colour_info}"
    assert colour is not None
    assert colour.info_topic == f"/head/{colour_info}"


def test_calibration_of_the_same_frame_is_found(tmp_path: Path) -> None:
    """Depth aligned to colour has the calibration of the colour camera, not the depth camera's."""
    items = depth_and_info("/cam/aligned_depth_to_color/image_raw", "/cam/color/camera_info")
    items = [
        *in_frame(items, "color"),
        *in_frame([("/cam/depth/camera_info", EPOCH, info(EPOCH))], "depth"),
    ]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        assert choose_streams(recording)[0].info_topic == "/cam/color/camera_info"
        assert not recording.warnings


def test_calibrations_of_any_name_are_found_by_their_frames(tmp_path: Path) -> None:
    """Foxglove has no convention for the names of calibration topics."""
    items = depth_in("/cam/depth/image", "depth")
    items[0] = ("/cam/depth/intrinsics", *items[0][1:])
    items += in_frame([("/cam/color/intrinsics", EPOCH, info(EPOCH))], "color")
    items.append(("/cam/color/image", EPOCH, raw(EPOCH, gradient(), "rgb8", "color")))

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        (depth,) = choose_streams(recording)
        colour = pair_colours(recording, [depth]).get(depth.topic)
    assert colour is not None
    assert depth.info_topic == "/cam/depth/intrinsics"
    assert colour.info_topic == "/cam/color/intrinsics"


def test_only_calibration_of_another_frame_causes_warning(tmp_path: Path) -> None:
    """Objects get wrong sizes with the intrinsics of the colour camera."""
    depth, info_topic = "/cam/depth/image_raw", "/cam/color/camera_info"
    items = depth_and_info(depth, info_topic)
    in_frame(items[:1], "color")

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        assert choose_streams(recording)[0].info_topic == info_topic
        (warning,) = recording.warnings
    assert depth in warning
    assert "intrinsics of another camera?" in warning


def test_slash_before_a_frame_does_not_make_it_another(tmp_path: Path) -> None:
    """In ROS 1, drivers may name a frame /camera in one topic and camera in another."""
    items = depth_and_info("/cam/depth/image_raw", "/cam/depth/info")
    in_frame(items[:1], "camera")
    in_frame(items[1:], "/camera")

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        assert choose_streams(recording)[0].info_topic == "/cam/depth/info"
        assert not recording.warnings


@pytest.mark.parametrize("count", [2, 5])
def test_throttled_depth_is_not_preferred(tmp_path: Path, count: int) -> None:
    """Depth that is throttled for a network has few frames; the others were lost in silence."""
    topics = "/cam/depth/image_rect_raw", "/cam/aligned_depth_to_color/image_raw"
    items: list[Item] = []
    for topic, number in zip(topics, (count, 6), strict=True):
        pair = depth_and_info(topic, f"{topic.rpartition('/')[0]}/camera_info")
        items += [pair[0], *number * [pair[1]]]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        (chosen,) = choose_streams(recording)

    assert (chosen.topic, chosen.count) == ((topics[0], 5) if count == 5 else (topics[1], 6))


@pytest.mark.parametrize("other", ["aligned_depth_to_color/image_raw", "depth/color/points"])
def test_stream_with_calibration_of_another_camera_is_chosen_last(
    tmp_path: Path, other: str
) -> None:
    """If only colour has a calibration, depth aligned to colour, or a cloud, must be chosen."""
    items = depth_and_info("/cam/depth/image_rect_raw", "/cam/color/camera_info")
    in_frame(items[:1], "color")
    in_frame(items[1:], "depth")
    if other.endswith("points"):
        points = cloud(EPOCH, organized_points(wavy_depth()))
        items += in_frame([(f"/cam/{other}", EPOCH, points)], "depth")
    else:
        items += depth_in(f"/cam/{other}", "color")[1:]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        assert [stream.topic for stream in choose_streams(recording)] == [f"/cam/{other}"]
        assert not recording.warnings


def test_confidence_map_is_not_taken_for_depth(tmp_path: Path) -> None:
    """ZED cameras publish confidence as 32FC1, like depth; objects would be meaningless."""
    zed = "/zed/zed_node"
    confidence, depth = f"{zed}/confidence/confidence_map", f"{zed}/depth/depth_registered"
    items = [
        *depth_and_info(confidence, f"{zed}/depth/camera_info", "32FC1"),
        *depth_and_info(depth, f"{zed}/depth/camera_info", "32FC1"),
        *depth_and_info(f"{zed}/other/image", f"{zed}/depth/camera_info", "32FC1"),
    ]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        assert [stream.topic for stream in choose_streams(recording)] == [depth]
        assert [stream.topic for stream in choose_streams(recording, [confidence])] == [confidence]
        assert confidence not in {stream.topic for stream in depth_streams(recording)}


@pytest.mark.parametrize(
    "other", ["amplitude", "intensity/image_raw", "snr/image", "statemap", "texture"]
)
def test_other_measurements_are_not_taken_for_depth(tmp_path: Path, other: str) -> None:
    """Drivers of ifm, SICK, Zivid and Photoneo encode these like the depth of the same camera."""
    items = [*depth_in(f"/cam/{other}", "camera"), *depth_in("/cam/z", "camera")]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        assert [stream.topic for stream in choose_streams(recording)] == ["/cam/z"]


@pytest.mark.parametrize("others", [(), ("/cam/points/xyz",)])
def test_cloud_without_coordinates_is_chosen_last(tmp_path: Path, others: tuple[str, ...]) -> None:
    """Zivid's topic of normals, the first in the alphabet, was chosen: there were no frames."""
    normals = cloud(EPOCH, organized_points(wavy_depth()))
    for field in normals.fields:
        field.name = f"normal_{field.name}"
    items = [("/cam/normals/xyz", EPOCH, normals)]
    items += [(topic, EPOCH, cloud(EPOCH, organized_points(wavy_depth()))) for topic in others]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        (chosen,) = choose_streams(recording)
        assert chosen.topic == (*others, "/cam/normals/xyz")[0]
        assert [w for w in recording.warnings if "no fields x, y, z" in w] == recording.warnings
        assert bool(recording.warnings) == (not others)


@pytest.mark.parametrize(
    ("topic", "radial"), [("distance", True), ("distance_to_image_plane", False)]
)
def test_distances_along_rays_are_chosen_last(tmp_path: Path, topic: str, *, radial: bool) -> None:
    """Distances taken for depth bend planes; ifm also publishes a cloud, which is better."""
    items = depth_in(f"/cam/{topic}", "camera")
    points = ("/cam/points", EPOCH, cloud(EPOCH, organized_points(wavy_depth())))

    with open_recording(write(tmp_path / "a.mcap", [*items, points])) as recording:
        assert choose_streams(recording)[0].kind == ("points" if radial else "depth")
    with open_recording(write(tmp_path / "b.mcap", items)) as recording:
        assert choose_streams(recording)[0].topic == f"/cam/{topic}"
        assert radial == any("along the rays" in warning for warning in recording.warnings)


@pytest.mark.parametrize(
    "topic",
    [
        "/thermal_mast/camera/image_raw",
        "/thermal_mast/depth",
        "/oak/stereo/image_raw",
        "/oak/stereo/image_raw/compressedDepth",
        "/camera/aligned_depth_to_infra1/image_raw",
        "/ir_robot/camera/depth",
    ],
)
def test_depth_needs_no_particular_name(tmp_path: Path, topic: str) -> None:
    """Guards against losing depth because of the name of the robot or camera."""
    items = depth_and_info(topic, f"{topic.rpartition('/')[0]}/camera_info")
    if topic.endswith("compressedDepth"):
        items[1] = (topic, EPOCH, compressed(EPOCH, png(wavy_depth())))

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        assert [stream.topic for stream in choose_streams(recording)] == [topic]


@pytest.mark.parametrize(
    "topic",
    [
        "/kinect2/sd/image_ir_rect",
        "/kinect2/sd/image_ir_rect/compressedDepth",
        "/camera/left_ir/image_raw",
    ],
)
def test_infrared_image_is_not_taken_for_depth(tmp_path: Path, topic: str) -> None:
    """Infrared images may be encoded like depth, and would be preferred to the clouds."""
    points = cloud(EPOCH, organized_points(wavy_depth()))
    items = [*depth_in(topic, "camera"), (f"{topic.rpartition('/')[0]}/points", EPOCH, points)]
    if topic.endswith("compressedDepth"):
        items[1] = (topic, EPOCH, compressed(EPOCH, png(wavy_depth())))

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        assert [stream.kind for stream in choose_streams(recording)] == ["points"]


def test_blank_first_image_does_not_hide_its_topic(tmp_path: Path) -> None:
    """Some drivers publish an image without encoding or pixels when they start."""
    blank = image(EPOCH, np.zeros((0, 0), np.uint16), "", frame_id="")
    items = [
        ("/cam/depth/image", EPOCH, blank),
        *depth_and_info("/cam/depth/image", "/cam/depth/camera_info"),
        ("/cam/color/image", EPOCH, blank),
        ("/cam/color/image", EPOCH, raw(EPOCH, gradient(), "rgb8", "color")),
    ]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        (depth,) = choose_streams(recording)
        colour = pair_colours(recording, [depth]).get(depth.topic)
    assert (depth.topic, depth.frame_id) == ("/cam/depth/image", "camera")
    assert colour is not None
    assert (colour.topic, colour.frame_id) == ("/cam/color/image", "color")


@pytest.mark.parametrize("kind", [*(f"{e}; png compressed " for e in DEPTH_ENCODINGS), "png"])
def test_depth_compressed_as_png_is_not_colour(tmp_path: Path, kind: str) -> None:
    """As it has the frame id of depth, it would be preferred to the actual colour images."""
    body = png(wavy_depth())
    items = [
        *depth_and_info("/cam/depth/image", "/cam/depth/camera_info"),
        ("/cam/depth/image/compressed", EPOCH, packed(EPOCH, body, kind)),
        ("/cam/color/image", EPOCH, raw(EPOCH, gradient(), "rgb8", "color")),
    ]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        (colour,) = pair_colours(recording, choose_streams(recording)).values()
    assert colour is not None
    assert colour.topic == "/cam/color/image"


@pytest.mark.parametrize(
    ("topic", "kind", "known"),
    [
        ("/cam/depth/image/compressed", "16UC1; png compressed ", True),
        ("/cam/range/compressed", "16UC1; png compressed ", True),
        ("/cam/depth/image", "png", True),
        ("/cam/depth/image/compressedDepth", "16UC1; compressedDepth png", True),
        ("/cam/grey/compressed", "mono16; png compressed mono16", False),
        ("/cam/infra1/image/compressed", "16UC1; png compressed ", False),
        ("/cam/depth/image/compressed", "32FC1; png compressed ", False),
    ],
)
def test_depth_may_be_a_png_file(tmp_path: Path, topic: str, kind: str, *, known: bool) -> None:
    """`compressed_image_transport` writes 16-bit depth as PNG, without loss."""
    items = [
        ("/cam/camera_info", EPOCH, info(EPOCH)),
        (topic, EPOCH, packed(EPOCH, png(wavy_depth()), kind)),
    ]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        streams = depth_streams(recording)
        found = list(frames(recording, streams))

    assert len(found) == known
    for frame in found:
        assert frame.depth is not None
        np.testing.assert_array_equal(frame.depth, wavy_depth() / np.float32(1000))


def counting(monkeypatch: pytest.MonkeyPatch, module: Any, name: str) -> Counter[str]:
    """Return a counter whose entry ``name`` counts the calls of that function of ``module``."""
    calls = Counter[str]()
    function = getattr(module, name)

    def counted(*args: Any) -> Any:
        calls[name] += 1
        return function(*args)

    monkeypatch.setattr(module, name, counted)
    return calls


def test_streams_are_compared_in_pairs_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Comparing every colour with every pair of 200 depth streams took minutes."""
    count = 12
    streams = [
        Stream(f"/robot/cam{k}/depth/image", IMAGE, "depth", f"/info{k}", 1, f"depth{k}")
        for k in range(count)
    ]
    colours = tuple(
        ColourStream(f"/robot/cam{k}/color/image", IMAGE, "raw", None, 1, f"color{k}", "rgb8")
        for k in range(count)
    )
    monkeypatch.setattr(colour_streams, "colour_streams", lambda _: colours)
    monkeypatch.setattr(colour_streams, "depth_streams", lambda _: tuple(streams))
    compared = counting(monkeypatch, colour_streams, "_shared")
    parsed = counting(monkeypatch, sensors, "_split_topic")

    pairs = pair_colours(SimpleNamespace(topics=()), streams)  # type: ignore[arg-type]  # unread

    assert pairs == dict(zip([stream.topic for stream in streams], colours, strict=True))
    assert compared["_shared"] <= 3 * count**2
    assert parsed["_split_topic"] == count


def test_colour_belongs_to_sensor_with_most_topic_parts_in_common() -> None:
    """Otherwise masks would be drawn on the colour images of another sensor."""
    left, right, far = (
        Stream(topic, IMAGE, "depth", "/info", 1, topic)
        for topic in ("/r/left/depth/image", "/r/right/depth/image", "/q/depth/image")
    )
    one = ColourStream("/r/left/color/image", IMAGE, "raw", None, 1, "color", "rgb8")

    nearest = colour_streams._nearest_sensors(one, [[far], [right], [left]])

    assert [near.shared for near in nearest["depth"]] == [2, 1]
    assert [colour_streams._belongs(one, s, nearest) for s in (left, right, far)] == [
        True,
        False,
        False,
    ]


def test_calibrations_of_any_name_are_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading all calibrations again for each image topic took minutes for 200 cameras."""
    items: list[Item] = []
    for k in range(10):
        items += in_frame(depth_and_info(f"/images{k}", f"/calibration{k}"), f"camera{k}")
    path = write(tmp_path / "a.mcap", items)
    read = counting(monkeypatch, streams, "first_message")

    with open_recording(path) as recording:
        found = depth_streams(recording)

    assert [one.info_topic for one in found] == [f"/calibration{k}" for k in range(10)]
    assert read["first_message"] == 10


def in_frame(items: list[Item], frame_id: str) -> list[Item]:
    """Set the frame id of messages, in place, and return them."""
    for _, _, message in items:
        message.header.frame_id = frame_id
    return items


def depth_in(topic: str, frame_id: str) -> list[Item]:
    return in_frame(depth_and_info(topic, f"{topic.rpartition('/')[0]}/camera_info"), frame_id)


@pytest.mark.parametrize(
    "cameras",
    [
        [("/spot/depth/left/image", "left_fisheye"), ("/spot/depth/right/image", "right_fisheye")],
        [("/robot/depth_front/image", "front"), ("/robot/depth_rear/image", "rear")],
        [("/r1/camera/depth/image_raw", "optical"), ("/r2/camera/depth/image_raw", "optical")],
        [("/cam1/image_raw", "camera"), ("/cam2/image_raw", "camera")],
        [("/depth_left/image", "left"), ("/depth_right/image", "right")],
        [("/front/depth/image_raw", ""), ("/rear/depth/image_rect", "")],
    ],
)
def test_cameras_with_similar_topics_are_several_sensors(
    tmp_path: Path, cameras: list[tuple[str, str]]
) -> None:
    """All cameras but one would be left out without a warning."""
    items = [item for topic, frame_id in cameras for item in depth_in(topic, frame_id)]

    with (
        open_recording(write(tmp_path / "a.mcap", items)) as recording,
        pytest.raises(NoStreamError, match="several sensors"),
    ):
        choose_streams(recording)


def test_many_sensors_cost_a_few_messages_each_and_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Looking for the colour of each sensor on every topic would take minutes for 300 topics."""
    read = Counter[str]()
    messages = Recording.messages

    def counted(self: Recording, topics: Any = None, *window: Any) -> Any:
        read.update(topics)
        return messages(self, topics, *window)

    monkeypatch.setattr(Recording, "messages", counted)
    items: list[Item] = []
    for k in range(15):
        items += depth_in(f"/robot{k}/camera/depth/image_raw", f"camera{k}")
        items.append(
            (
                f"/robot{k}/camera/color/image_raw",
                EPOCH,
                raw(EPOCH, gradient(), "rgb8", f"color{k}"),
            )
        )
    path = write(tmp_path / "a.mcap", items)

    uses = {topic["name"]: topic["use"] for topic in describe_recording(path)["topics"]}

    for k in range(15):
        depth = f"/robot{k}/camera/depth/image_raw"
        assert uses[f"/robot{k}/camera/color/image_raw"] == f"colour of {depth}"
        assert read[depth] <= 4
    with (
        open_recording(path) as recording,
        pytest.raises(NoStreamError, match=r"several sensors: /robot0/.* and 3 more; choose"),
    ):
        choose_streams(recording)


def test_robots_of_one_kind_stay_apart_with_clouds(tmp_path: Path) -> None:
    """Both robots use the same frame ids; a cloud must not go to the other robot's sensor."""
    items: list[Item] = []
    for robot in ("/r1", "/r2"):
        points = cloud(EPOCH, organized_points(wavy_depth()))
        items += depth_in(f"{robot}/camera/depth/image_raw", "optical")
        items += in_frame([(f"{robot}/camera/depth/points", EPOCH, points)], "optical")

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        sensors = by_sensor(depth_streams(recording))

    assert [{stream.topic[:3] for stream in sensor} for sensor in sensors] == [{"/r1"}, {"/r2"}]


@pytest.mark.parametrize(
    ("cameras", "chosen"),
    [
        # The driver of the Azure Kinect has no namespace.
        (
            [("/depth/image_raw", "depth_link"), ("/depth_to_rgb/image_raw", "rgb_link")],
            "/depth/image_raw",
        ),
        # A copy with fewer images.
        (
            [("/cam/depth/image_raw", "camera"), ("/slow/cam/depth/image_raw", "camera")],
            "/cam/depth/image_raw",
        ),
        (
            [("/head/depth/image_raw", "optical"), ("/head/depth_downsample/image_raw", "optical")],
            "/head/depth/image_raw",
        ),
        # The driver of the Kinect v2 publishes several resolutions.
        (
            [("/kinect2/qhd/image_depth_rect", "rgb"), ("/kinect2/hd/image_depth_rect", "rgb")],
            "/kinect2/hd/image_depth_rect",
        ),
    ],
)
def test_topics_of_one_camera_are_one_sensor(
    tmp_path: Path, cameras: list[tuple[str, str]], chosen: str
) -> None:
    """Otherwise the user would have to choose a topic, although there is only one camera."""
    items = [item for topic, frame_id in cameras for item in depth_in(topic, frame_id)]

    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        assert [stream.topic for stream in choose_streams(recording)] == [chosen]
