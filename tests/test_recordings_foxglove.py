"""Tests of recordings with Foxglove messages in JSON and Protocol Buffers."""

import json
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from shapecat.outputs.annotation.annotated_mcap import write_annotated
from shapecat.outputs.annotation.encoders import MessageKind, encoders_of
from shapecat.recordings import choose_streams, frames, open_recording, read_transforms
from shapecat.recordings.decoding.decoders import LIBRARY_ERRORS
from shapecat.recordings.decoding.protobuf import message_decoder
from shapecat.recordings.messages import MessageError
from shapecat.recordings.transforms.window import TransformWindow
from shapecat.types import AnnotationFrame, Camera, Frame
from tests.depth_encodings import png
from tests.foxglove_messages import (
    content,
    descriptors,
    encode,
    write,
)
from tests.mcap_files import mcap_writer
from tests.messages import EPOCH, SECOND

CAMERA = Camera(4, 3, 60.0, 61.0, 1.5, 1.0)


def read(path: Path) -> list[Frame]:
    skipped: Counter[str] = Counter()
    with open_recording(path) as recording:
        result = list(frames(recording, choose_streams(recording), skipped=skipped))
    assert not skipped
    return result


both_encodings = pytest.mark.parametrize("encoding", ["json", "protobuf"])


@both_encodings
@pytest.mark.parametrize(
    ("angles", "position"),
    [
        ([0.7, -0.4, 2.3], [10.0, -3.0, 0.5]),
        ([0.0, 0.0, 0.0], [10.0, -3.0, 0.5]),
        ([0.7, -0.4, 2.3], [0.0, 0.0, 0.0]),
    ],
)
def test_pose_is_applied_to_point_cloud(
    tmp_path: Path, encoding: str, angles: list[float], position: list[float]
) -> None:
    """A pose that only shifts or only rotates must not be taken for the identity."""
    points = np.arange(12, dtype="<f4").reshape(4, 3) + 1
    fields = [{"name": name, "offset": 4 * k, "type": 7} for k, name in enumerate("xyz")]
    turn = Rotation.from_euler("zyx", angles)
    pose = {
        "position": dict(zip("xyz", position, strict=True)),
        "orientation": dict(zip("xyzw", turn.as_quat().tolist(), strict=True)),
    }
    values = {"pose": pose, "point_stride": 12, "fields": fields}
    values["data"] = content(points.tobytes(), encoding)

    (frame,) = read(write(tmp_path / "a.mcap", encoding, [("/p", "foxglove.PointCloud", values)]))

    assert (frame.stamp_ns, frame.frame_id) == (EPOCH, "camera")
    assert frame.points is not None
    np.testing.assert_allclose(frame.points, turn.apply(points) + position, atol=1e-5)


@both_encodings
@pytest.mark.parametrize(
    ("number", "kind"),
    list(enumerate(["<u1", "<i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<f8"], start=1)),
)
def test_coordinates_may_have_any_numeric_type(
    tmp_path: Path, encoding: str, number: int, kind: str
) -> None:
    """Foxglove's type numbers differ from those of ROS: -7 would become a large number."""
    extreme = np.iinfo(kind).max - 2 if "u" in kind else -7
    points = np.array([[extreme, 5, 9], [2, extreme, 7]]).astype(kind)
    size = points.itemsize
    fields = [{"name": name, "offset": size * k, "type": number} for k, name in enumerate("xyz")]
    values = {"point_stride": 3 * size, "fields": fields}
    values["data"] = content(points.tobytes(), encoding)

    (frame,) = read(write(tmp_path / "a.mcap", encoding, [("/p", "foxglove.PointCloud", values)]))

    np.testing.assert_array_equal(frame.points, points.astype(np.float32))


def test_foxglove_messages_in_ros_keep_nanoseconds(tmp_path: Path) -> None:
    """The field is nanosec in ROS, nsec in JSON; all frames within a second would share a stamp."""
    kind, stamp = "foxglove_msgs/msg/PointCloud", EPOCH + 123_456_789
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_CLOUD, kind))
    time, field = (
        store.types[name]
        for name in ("builtin_interfaces/msg/Time", "foxglove_msgs/msg/PackedElementField")
    )
    fields = [field(name, 4 * k, 7) for k, name in enumerate("xyz")]
    data = np.array([1, 2, 3], "<f4").view(np.uint8)
    message = store.types[kind](time(*divmod(stamp, SECOND)), "camera", 12, fields, data)
    path = tmp_path / "a.mcap"
    with mcap_writer(path) as writer:
        text = store.generate_msgdef(kind, ros_version=2)[0].encode()
        channel = writer.register_channel(
            "/p", "cdr", writer.register_schema(kind, "ros2msg", text)
        )
        writer.add_message(channel, EPOCH, bytes(store.serialize_cdr(message, kind)), EPOCH)

    (frame,) = read(path)

    assert frame.stamp_ns == stamp


_CLOUD = """builtin_interfaces/Time timestamp
string frame_id
uint32 point_stride
foxglove_msgs/PackedElementField[] fields
uint8[] data
================================================================================
MSG: foxglove_msgs/PackedElementField
string name
uint32 offset
uint8 type
"""


@both_encodings
@pytest.mark.parametrize("compressed", [False, True])
def test_depth_image_is_read(tmp_path: Path, encoding: str, *, compressed: bool) -> None:
    """Compressed depth was listed as a depth stream, but none of its images could be read."""
    depth = np.arange(12, dtype="<u2").reshape(3, 4) * 100
    k = [60.0, 0.0, 1.5, 0.0, 61.0, 1.0, 0.0, 0.0, 1.0]
    size = {"width": 4, "height": 3}
    info = {**size, "distortion_model": "", "D": [], "K": k, "R": [], "P": []}
    image = {**size, "encoding": "16UC1", "step": 8, "data": content(depth.tobytes(), encoding)}
    packed = {"format": "16UC1; compressedDepth", "data": content(bytes(12) + png(depth), encoding)}
    items = [
        ("/depth/calibration", "foxglove.CameraCalibration", info),
        ("/depth/image", "foxglove.RawImage", image),
    ]
    if compressed:
        items[1] = ("/depth/image", "foxglove.CompressedImage", packed)

    (frame,) = read(write(tmp_path / "a.mcap", encoding, items))

    assert frame.camera == CAMERA
    np.testing.assert_array_equal(frame.depth, depth / np.float32(1000))


def test_calibration_may_lack_the_fields_of_a_lens(tmp_path: Path) -> None:
    """Programs that write JSON may leave out what a pinhole camera does not need."""
    size = {"width": 4, "height": 3}
    pixels = content(np.full((3, 4), 700, "<u2").tobytes(), "json")
    k = [60.0, 0.0, 1.5, 0.0, 61.0, 1.0, 0.0, 0.0, 1.0]
    items = [
        ("/depth/calibration", "foxglove.CameraCalibration", size | {"K": k}),
        (
            "/depth/image",
            "foxglove.RawImage",
            size | {"encoding": "16UC1", "step": 8, "data": pixels},
        ),
    ]

    (frame,) = read(write(tmp_path / "a.mcap", "json", items))

    assert frame.camera == CAMERA


NO_TURN = {"rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


@pytest.mark.parametrize(
    ("encoding", "turn"), [("json", NO_TURN), ("protobuf", NO_TURN), ("protobuf", {})]
)
def test_transforms_are_read(
    tmp_path: Path, encoding: str, turn: dict[str, dict[str, float]]
) -> None:
    """Protobuf writers may leave out the rotation of a pure translation."""
    values = {
        "parent_frame_id": "map",
        "child_frame_id": "camera",
        "translation": {"x": 1.0, "y": 2.0, "z": 3.0},
        **turn,
    }
    path = write(tmp_path / "a.mcap", encoding, [("/tf", "foxglove.FrameTransform", values)])

    with open_recording(path) as recording:
        transforms = read_transforms(recording)

    # Foxglove has no static transforms: the last one stays valid.
    for stamp in (EPOCH, EPOCH + 60 * SECOND):
        pose = transforms.lookup("map", "camera", stamp)
        np.testing.assert_array_equal(pose.translation, [1, 2, 3])
        np.testing.assert_array_equal(pose.rotation, np.eye(3))


@pytest.mark.parametrize("beside_ros", [False, True])
def test_transform_long_before_first_frame_is_known(tmp_path: Path, *, beside_ros: bool) -> None:
    """Foxglove transforms may be rare; the last one before --start must be found.

    The recording may also hold ROS transforms, which do not hold for so long.
    """
    path = tmp_path / "a.mcap"
    with mcap_writer(path, "", chunk_size=100) as writer:
        kind = writer.register_schema("foxglove.FrameTransform", "jsonschema", b"{}")
        channel = writer.register_channel("/tf", "json", kind)
        for second, x in ((0, 1.0), (20, 2.0), (60, 2.0)):
            values = {
                "timestamp": {"sec": EPOCH // SECOND + second, "nsec": 0},
                "parent_frame_id": "map",
                "child_frame_id": "camera",
                "translation": {"x": x, "y": 0, "z": 0},
                "rotation": {"x": 0, "y": 0, "z": 0, "w": 1},
            }
            stamp = EPOCH + second * SECOND
            writer.add_message(channel, stamp, json.dumps(values).encode(), stamp)
            if beside_ros:
                kind = writer.register_schema("tf2_msgs/msg/TFMessage", "jsonschema", b"{}")
                other = writer.register_channel("/wheels", "json", kind)
                writer.add_message(other, stamp, b'{"transforms": []}', stamp)

    stamp = EPOCH + 45 * SECOND
    with open_recording(path) as recording:
        transforms = TransformWindow.of(recording).around(stamp, stamp)

    assert transforms.lookup("map", "camera", stamp).translation[0] == 2


def test_protobuf_scene_is_decoded_by_embedded_descriptors() -> None:
    """A viewer knows only the descriptors that the file embeds."""
    scene = {
        "deletions": [{"timestamp": {"seconds": 5}, "type": 1, "id": "a"}],
        "entities": [{"id": "track-3", "frame_locked": True, "metadata": [{"key": "k"}]}],
    }

    name = "foxglove.SceneUpdate"
    kind = MessageKind[None]("/scene", name, lambda *_: scene)
    ((channel, encode),) = encoders_of("protobuf", [kind])
    read_back = message_decoder(channel.schema, name)(encode(None))

    assert read_back.deletions[0].timestamp.seconds == 5
    assert (read_back.deletions[0].type, read_back.deletions[0].id) == (1, "a")
    entity = read_back.entities[0]
    assert (entity.id, entity.frame_locked, entity.metadata[0].key) == ("track-3", True, "k")
    assert entity.arrows == entity.models == []


def test_protobuf_source_gets_protobuf_annotations(tmp_path: Path) -> None:
    source, target = tmp_path / "a.mcap", tmp_path / "out.mcap"
    write(source, "protobuf", [("/p", "foxglove.PointCloud", {})])
    frame = AnnotationFrame("/p", 0, EPOCH, EPOCH, "camera", (), (7,))

    with open_recording(source) as recording:
        write_annotated(recording, target, [frame], run={})

    with open_recording(target) as recording:
        assert {topic.encoding for topic in recording.topics} == {"protobuf"}
        (message,) = recording.messages(["/shapecat/scene"])
        assert recording.decode(message).deletions[0].id == "track-7"


def test_protobuf_message_without_data_is_not_one_of_default_values(tmp_path: Path) -> None:
    """Damage that destroyed a message was reported as an image without an encoding."""
    path = tmp_path / "a.mcap"
    write(path, "protobuf", [("/p", "foxglove.RawImage", {})])

    with open_recording(path) as recording:
        (message,) = recording.messages()
        with pytest.raises(MessageError, match=r"/p: cannot decode foxglove.RawImage: it has no"):
            recording.decode(message._replace(data=b""))


@given(
    values=st.fixed_dictionaries(
        {
            "seconds": st.integers(-(2**63), 2**63 - 1),
            "nanos": st.integers(-(2**31), 2**31 - 1),
        }
    )
)
@settings(deadline=None, max_examples=50)
def test_protobuf_integers_are_decoded_exactly(values: dict[str, int]) -> None:
    name = "google.protobuf.Timestamp"
    data = encode(values, name)

    assert message_decoder(descriptors(), name)(data) == SimpleNamespace(**values)


@given(data=st.binary(max_size=60))
@settings(deadline=None, max_examples=100)
def test_random_bytes_raise_only_known_errors(data: bytes) -> None:
    decode = message_decoder(descriptors(), "foxglove.PointCloud")
    for run in (lambda: decode(data), lambda: message_decoder(data, "a.B")):
        try:
            run()
        except LIBRARY_ERRORS:
            continue


def test_descriptors_in_any_order_and_maps_are_decoded() -> None:
    """Some writers put a file before those it imports; a map is encoded as a list of messages."""
    inner = FileDescriptorProto(name="inner.proto", package="lab", syntax="proto3")
    inner.message_type.add(name="Size").field.add(name="height", number=1, type=5, label=1)
    outer = FileDescriptorProto(name="outer.proto", package="lab", syntax="proto3")
    outer.dependency.append("inner.proto")
    item = outer.message_type.add(name="Item")
    item.field.add(name="size", number=1, type=11, label=1, type_name=".lab.Size")
    item.field.add(name="parts", number=2, type=11, label=3, type_name=".lab.Item.PartsEntry")
    entry = item.nested_type.add(name="PartsEntry")
    entry.field.add(name="key", number=1, type=9, label=1)
    entry.field.add(name="value", number=2, type=5, label=1)
    entry.options.map_entry = True
    descriptors = FileDescriptorSet(file=[outer, inner]).SerializeToString()

    # Field 1 {height: 7}, field 2 {"lid": 3} in the wire format.
    read_back = message_decoder(descriptors, "lab.Item")(
        b"\x0a\x02\x08\x07\x12\x07\x0a\x03lid\x10\x03"
    )

    assert read_back.size.height == 7
    assert read_back.parts == {"lid": 3}
