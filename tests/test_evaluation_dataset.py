"""Tests of point cloud files of data sets: every encoding, and hostile input."""

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shapecat.arrays import F4
from shapecat.errors import RecordingError
from shapecat.evaluation.clouds import read_pcd, read_ply
from shapecat.evaluation.dataset import estimate_eye, read_dataset, read_view

POINTS = np.array([[0.25, -1.5, 0.0], [np.nan] * 3, [1e-3, 2.0, 3.5]], np.float32)
HEADER = (
    "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x y z _\nSIZE 4 4 4 4 1\nTYPE U F F F U\n"
    "COUNT 1 1 1 1 4\nWIDTH 3\nHEIGHT 1\nVIEWPOINT 0.5 -0.25 1.25 1 0 0 0\nPOINTS 3\nDATA "
)


def pcd(encoding: str) -> bytes:
    """Return POINTS as a PCD file, with a colour before and padding after the coordinates."""
    head = f"{HEADER}{encoding}\n".encode()
    if encoding == "ascii":
        return head + b"".join(b"7 %g %g %g 0 0 0 0\n" % tuple(row) for row in POINTS)
    if encoding == "binary":
        return head + b"".join(struct.pack("<I3f4x", 7, *row) for row in POINTS)
    columns = struct.pack("<3I", 7, 7, 7) + POINTS.T.tobytes() + bytes(12)
    packed = b"".join(
        bytes([len(part) - 1]) + part for part in (columns[:32], columns[32:48])
    ) + bytes([0, 0, 7 << 5, 2, 0])  # then a zero, and 11 times the byte before
    return head + struct.pack("<II", len(packed), len(columns)) + packed


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_every_encoding_of_pcd_is_read(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "x.pcd"
    path.write_bytes(pcd(encoding))

    cloud = read_pcd(path)

    np.testing.assert_array_equal(cloud.points.astype(np.float32), POINTS)
    np.testing.assert_array_equal(cloud.viewpoint, [0.5, -0.25, 1.25])


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed"])
def test_any_kind_of_nan_is_read_without_a_warning(tmp_path: Path, encoding: str) -> None:
    """NumPy warns when it converts a signalling NaN."""
    path = tmp_path / "x.pcd"
    y = struct.pack("<f", POINTS[1, 1])
    path.write_bytes(pcd(encoding).replace(y, struct.pack("<I", 0x7FA00000)))

    expected = POINTS.copy()
    expected[1, 1] = np.nan
    np.testing.assert_array_equal(read_pcd(path).points.astype(np.float32), expected)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_fields_of_several_values_shift_later_fields(tmp_path: Path, encoding: str) -> None:
    """If a file has normals before x, coordinates would be read from the wrong columns."""
    head = (
        "FIELDS normal x i y z\nSIZE 4 4 1 8 4\nTYPE F F U F F\nCOUNT 3 1 3 1 1\n"
        f"WIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA {encoding}\n"
    ).encode()
    rows = [(0.1, 0.2, 0.3, 1.5, 7, 8, 9, 2.5, 3.5), (0.4, 0.5, 0.6, 4.5, 7, 8, 9, 5.5, 6.5)]
    if encoding == "ascii":
        body = b"".join(b"%g %g %g %g %d %d %d %g %g\n" % row for row in rows)
    elif encoding == "binary":
        body = b"".join(struct.pack("<4f3Bdf", *row) for row in rows)
    else:  # field after field, in pieces of at most 32 bytes that are not packed
        fields = (("<3f", 0, 3), ("<f", 3, 4), ("<3B", 4, 7), ("<d", 7, 8), ("<f", 8, 9))
        flat = b"".join(struct.pack(kind, *row[a:b]) for kind, a, b in fields for row in rows)
        parts = [flat[k : k + 32] for k in range(0, len(flat), 32)]
        packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
        body = struct.pack("<II", len(packed), len(flat)) + packed
    (tmp_path / "x.pcd").write_bytes(head + body)

    assert read_pcd(tmp_path / "x.pcd").points.tolist() == [[1.5, 2.5, 3.5], [4.5, 5.5, 6.5]]


def test_blank_lines_between_points_are_skipped(tmp_path: Path) -> None:
    """If blank lines counted as points, the last points would be missing."""
    path = tmp_path / "x.pcd"
    head, body = pcd("ascii").split(b"ascii\n")
    path.write_bytes(head + b"ascii\n" + body.replace(b"\n", b"\n\n"))

    np.testing.assert_array_equal(read_pcd(path).points.astype(np.float32), POINTS)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_every_encoding_of_ply_is_read(tmp_path: Path, kind: str) -> None:
    """Faces that follow the vertices must not be read as points."""
    head = (
        f"ply\nformat {kind} 1.0\ncomment VIEWPOINT 0.5 -0.25 1.25\nelement vertex 3\n"
        "property uchar red\nproperty float x\nproperty float y\nproperty double z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    order = ">" if "big" in kind else "<"
    body = b"".join(
        b"9 %g %g %g\n" % tuple(row) if kind == "ascii" else struct.pack(f"{order}Bffd", 9, *row)
        for row in POINTS
    )
    path = tmp_path / "x.ply"
    path.write_bytes(head + body + b"3 0 1 2\n")

    cloud = read_ply(path)

    np.testing.assert_array_equal(cloud.points.astype(np.float32), POINTS)
    np.testing.assert_array_equal(cloud.viewpoint, [0.5, -0.25, 1.25])


def test_files_of_open3d_are_read(tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    points = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    points[100:300] = points[0]  # something to compress
    cloud = open3d.t.geometry.PointCloud(points)
    for name, options in {
        "ascii.pcd": {"write_ascii": True},
        "binary.pcd": {},
        "packed.pcd": {"compressed": True},
        "ascii.ply": {"write_ascii": True},
        "binary.ply": {},
    }.items():
        path = tmp_path / name
        open3d.t.io.write_point_cloud(str(path), cloud, **options)
        read = read_pcd(path) if name.endswith("pcd") else read_ply(path)
        np.testing.assert_allclose(read.points, points, atol=1e-5, err_msg=name)


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_damaged_cloud_raises_or_is_read(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """The reader must not crash, or return more points than the file has bytes."""
    encoding = data.draw(st.sampled_from(["ascii", "binary", "binary_compressed"]))
    content = bytearray(pcd(encoding))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / "x.pcd"
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        assert len(read_pcd(path).points) <= len(content)
    except RecordingError as error:
        assert str(path) in str(error)  # noqa: PT017  either outcome is right


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"POINTS 3", b"POINTS 4000000000"),
        (b"POINTS 3", b"POINTS -1"),
        (b"TYPE U", b"TYPE a"),
        (b"COUNT 1 1 1 1 4", b"COUNT 1 1 1 1 99999999999"),
        (b"FIELDS rgb x y z _", b"FIELDS rgb x y w _"),
        (b"DATA binary", b"DATA zipped"),
        (b"SIZE 4 4", b"SIZE 3 4"),
    ],
)
def test_invalid_headers_are_rejected(tmp_path: Path, old: bytes, new: bytes) -> None:
    path = tmp_path / "x.pcd"
    for encoding in ("binary", "binary_compressed"):
        path.write_bytes(pcd(encoding).replace(old, new))
        with pytest.raises(RecordingError, match="not a complete PCD"):
            read_pcd(path)


def save(root: Path, points: F4, **more: F4) -> Path:
    path = root / "cup" / "mug" / "0.npz"
    path.parent.mkdir(parents=True)
    np.savez(path, allow_pickle=False, points=points, **more)
    return path


def test_points_without_all_coordinates_are_dropped(tmp_path: Path) -> None:
    """One NaN would spread over the whole descriptor."""
    rows = [[0.1, 0.2, 0.3], [np.nan, 0.2, 0.3], [0.4, 0.5, np.inf], [0.7, 0.8, 0.9]]
    view = read_view(save(tmp_path, np.array(rows, np.float32)))

    np.testing.assert_allclose(view.points, [rows[0], rows[3]], rtol=1e-6)


def test_view_keeps_viewpoint_and_drops_nan(tmp_path: Path) -> None:
    view = read_view(save(tmp_path, POINTS, viewpoint=np.array([0.1, 0.2, 0.9])))

    assert view.points.shape == (2, 3)
    assert view.eye.tolist() == [0.1, 0.2, 0.9]
    assert (view.category, view.instance) == ("cup", "mug")


@pytest.mark.parametrize("eye", [[0, 0, 1.25], [-0.5, 0, 0.75]])
def test_viewpoint_may_have_coordinates_of_zero(tmp_path: Path, eye: list[float]) -> None:
    """Only (0, 0, 0) stands for an unknown viewpoint: a camera may be right above the object."""
    view = read_view(save(tmp_path, POINTS, viewpoint=np.array(eye)))

    assert view.eye.tolist() == eye


def test_views_are_sorted_by_path(tmp_path: Path) -> None:
    """Models made from the same folder must not depend on the file system."""
    for name in ("b/2/1.pcd", "a/9/3.PCD", "a/10/0.pcd"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_bytes(pcd("binary"))
    (tmp_path / "a" / "9" / "notes.txt").write_text("x")
    dataset = read_dataset(tmp_path)

    assert [view.instance for view in dataset] == ["10", "9", "2"]
    assert len(dataset) == 3
    assert dataset.categories == ("a", "b")


@pytest.mark.parametrize("name", ["mug/0.PCD", "mug/red/left/0.PCD"])
@pytest.mark.parametrize("in_place", ["cup/a/0.pcd", "mug/a/0.pcd"])
def test_views_outside_folders_of_objects_are_refused(
    tmp_path: Path, name: str, in_place: str
) -> None:
    """Views in too few or too many folders were silently left out if others were in place."""
    for other in (in_place, name, ".mug/0.pcd", "mug/.checkpoints/0.pcd", "scan.ply"):
        (tmp_path / other).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / other).touch()
    refused = r"0\.PCD: expected a folder for each object, such as mug/object/0\.PCD"

    with pytest.raises(RecordingError, match=refused):
        read_dataset(tmp_path)

    (tmp_path / name).unlink()
    assert read_dataset(tmp_path).files == (tmp_path / in_place,)


def test_hidden_files_are_not_views(tmp_path: Path) -> None:
    """Notebooks and macOS leave hidden files, but the data set itself may be in a hidden folder."""
    root = tmp_path / ".cache" / "data"
    for name in ("cup/a/0.pcd", "cup/a/._0.pcd", "cup/.ipynb_checkpoints/0.pcd", ".Trash/b/0.pcd"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()

    assert read_dataset(root).files == (root / "cup" / "a" / "0.pcd",)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.full((5, 3), np.nan), "no points"),
        (np.zeros((0, 3)), "no points"),
        (np.full((5, 3), 500.0), "must be in metres"),
        (np.full((5, 3), -500.0), "is 500 m away; points must be in metres"),
        (np.eye(3) * 80.0, "extend over 80 m"),  # a cup in millimetres
        (np.zeros((5, 2)), "shape"),
        (np.zeros(5), "shape"),
    ],
)
def test_invalid_views_raise_with_path(tmp_path: Path, points: F4, reason: str) -> None:
    path = save(tmp_path, points)

    with pytest.raises(RecordingError, match=reason) as caught:
        read_view(path)
    assert str(path) in str(caught.value)


def test_pickled_points_are_not_loaded(tmp_path: Path) -> None:
    path = tmp_path / "cup" / "mug" / "0.npz"
    path.parent.mkdir(parents=True)
    np.savez(path, points=np.array([{}], object))

    with pytest.raises(RecordingError, match=r"not an \.npz file"):
        read_view(path)


def damaged_archives() -> dict[str, bytes]:
    """Return archives that NumPy and zipfile refuse, each with a different kind of error."""
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, points=np.random.default_rng(0).random((99, 3)))
    deflated = bytearray(stream.getvalue())
    deflated[60:64] = b"\xff" * 4  # the first bytes after the name
    found = {"damaged deflate": bytes(deflated)}
    for name, method in (("lzma", zipfile.ZIP_LZMA), ("bzip2", zipfile.ZIP_BZIP2)):
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", method) as archive:
            archive.writestr("points.npy", bytes(range(256)) * 20)
        content = bytearray(stream.getvalue())
        content[50:90] = b"\xff" * 40
        found[f"damaged {name}"] = bytes(content)
    stream = io.BytesIO()
    np.save(stream, np.zeros((5, 3)))
    found["one array"] = stream.getvalue()
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, points=np.zeros((999, 3)))
    found["damaged header"] = stream.getvalue().replace(b"}", b" ")
    stream = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)}
    with zipfile.ZipFile(stream, "w") as archive, archive.open("points.npy", "w") as member:
        np.lib.format.write_array_header_1_0(member, header)
    found["endless"] = stream.getvalue()
    unknown = bytearray(found["endless"])
    unknown[unknown.index(b"PK\x01\x02") + 10] = 99
    found["unknown compression"] = bytes(unknown)
    return found


@pytest.mark.parametrize("kind", damaged_archives())
def test_damaged_archives_raise_with_path(tmp_path: Path, kind: str) -> None:
    """NumPy, zipfile and the decompressors raise their own errors, which would be tracebacks."""
    path = tmp_path / "cup" / "mug" / "0.npz"
    path.parent.mkdir(parents=True)
    path.write_bytes(damaged_archives()[kind])

    with pytest.raises(RecordingError, match=r"not an \.npz file"):
        read_view(path)


def test_viewpoint_far_away_counts_as_unknown(tmp_path: Path) -> None:
    """Distances to such a viewpoint would be infinite."""
    points = np.random.default_rng(0).random((50, 3)).astype(np.float32)
    view = read_view(save(tmp_path, points, viewpoint=np.array([1e300, 0, 1])))

    assert view.eye.tolist() == estimate_eye(points).tolist()


@pytest.mark.parametrize("azimuth_deg", [0, 45, 130, 250])
def test_missing_viewpoint_is_estimated(azimuth_deg: float) -> None:
    """A cloud without VIEWPOINT would otherwise be described inside out."""
    azimuth = np.radians(azimuth_deg)
    eye = np.array([0.8 * np.cos(azimuth), 0.8 * np.sin(azimuth), 0.6])
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(0, 0.1, 4000)
    side = np.stack([0.04 * np.cos(angle), 0.04 * np.sin(angle), height], axis=1)
    radius = 0.04 * np.sqrt(rng.uniform(size=2000))
    top = np.stack([radius * np.cos(angle[:2000]), radius * np.sin(angle[:2000])], axis=1)
    points = np.concatenate([side[side[:, :2] @ eye[:2] > 0], np.insert(top, 2, 0.1, axis=1)])

    found = estimate_eye(points.astype(np.float32)) - points.mean(axis=0)

    direction = (eye - points.mean(axis=0)) / np.linalg.norm(eye - points.mean(axis=0))
    assert found @ direction > np.cos(np.radians(40))


def test_view_of_many_points_gets_a_viewpoint() -> None:
    """`numpy.unique` takes minutes for the cell numbers of such a cloud: their hashes collide."""
    rng = np.random.default_rng(1)
    points = rng.normal(0, 1, (400_000, 3)) * [0.05, 0.05, 0.0005]

    found = estimate_eye(points.astype(np.float32))

    np.testing.assert_allclose(np.linalg.norm(found), 1, atol=1e-3)
