"""Point cloud files, PCD and PLY: the points and the position of the sensor.

Open3D reads both formats, but ignores the VIEWPOINT of PCD files and cannot be imported on a
machine without display libraries. Data sets must be readable there too.
"""

import itertools
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8, U1
from shapecat.errors import RecordingError, explained
from shapecat.jit import kernel

__all__ = ["CloudFile", "read_pcd", "read_ply"]

_LARGEST_FILE = 1 << 30
_LARGEST_HEADER = 1 << 16
"""Maximum sizes of a file and of its header, bytes."""
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


class CloudFile(NamedTuple):
    """The content of a point cloud file.

    ``points`` (n, 3) are as stored, including NaN; ``viewpoint`` (3,) is the position of the
    sensor, None if the file does not state it.
    """

    points: F8
    viewpoint: F8 | None


class _Layout(NamedTuple):
    """How a file stores points: type of a point, number of points, encoding, offset of the body."""

    point: np.dtype
    number: int
    encoding: str
    start: int


def read_pcd(path: Path) -> CloudFile:
    """Read a PCD file, version 0.7 or older: ascii, binary or binary_compressed.

    Raises
    ------
    RecordingError : the file cannot be read, is larger than 1 GB, or is not a complete PCD file
        with x, y and z.
    """
    content = _content(path)
    try:
        header, layout = _pcd_header(content)
        body = content[layout.start :]
        if layout.encoding == "binary_compressed":
            points = _unpack_pcd(body, layout)
        else:
            points = _xyz(body, layout)
        words = header.get("VIEWPOINT", [])[:3]
        viewpoint = np.array([float(word) for word in words]) if len(words) == 3 else None
    except (ValueError, KeyError, IndexError, OverflowError, TypeError) as error:
        msg = f"{path}: not a complete PCD file with x, y and z: {error}"
        raise RecordingError(msg) from error
    return CloudFile(points, viewpoint)


def read_ply(path: Path) -> CloudFile:
    """Read the vertices of a PLY file: ascii, or binary of either byte order.

    A header line ``comment VIEWPOINT x y z`` gives the position of the sensor.

    Raises
    ------
    RecordingError : the file cannot be read, is larger than 1 GB, or is not a complete PLY file
        whose first element is the vertices.
    """
    content = _content(path)
    try:
        viewpoint, layout = _ply_header(content)
        points = _xyz(content[layout.start :], layout)
    except (ValueError, KeyError, IndexError, OverflowError, TypeError) as error:
        msg = f"{path}: not a complete PLY file that begins with vertices: {error}"
        raise RecordingError(msg) from error
    return CloudFile(points, viewpoint)


def _content(path: Path) -> bytes:
    with explained(f"{path}: cannot be read", RecordingError):
        if path.stat().st_size > _LARGEST_FILE:
            msg = f"{path}: larger than {_LARGEST_FILE >> 30} GB, not a view of one object"
            raise RecordingError(msg)
        return path.read_bytes()


def _pcd_header(content: bytes) -> tuple[dict[str, list[str]], _Layout]:
    """Return the words of each header line by its keyword, and the layout of the body.

    If the content is invalid, this, `_ply_header` and `_unpack_pcd` raise an error that `read_pcd`
    catches.
    """
    found = re.search(rb"^DATA +(\w+)\s*?\n", content[:_LARGEST_HEADER], re.MULTILINE)
    if not found:
        msg = "it has no line DATA"
        raise ValueError(msg)
    lines = content[: found.end()].decode("ascii", "replace").splitlines()
    header = {words[0]: words[1:] for line in lines if (words := line.split())}
    sizes = [int(word) for word in header["SIZE"]]
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(sizes))]
    names = [
        name if name in {"x", "y", "z"} else f"{name}.{k}"
        for k, name in enumerate(header["FIELDS"])
    ]
    fields = [
        (name, f"<{kind.lower()}{size}", (count,))
        if count != 1
        else (name, f"<{kind.lower()}{size}")
        for name, kind, size, count in zip(names, header["TYPE"], sizes, counts, strict=True)
    ]
    if not {*header["TYPE"]} <= {*"IUFiuf"}:
        msg = f"its types are {' '.join(header['TYPE'])}, not I, U or F"
        raise ValueError(msg)
    points = header.get("POINTS") or [str(int(header["WIDTH"][0]) * int(header["HEIGHT"][0]))]
    layout = _Layout(np.dtype(fields), int(points[0]), found[1].decode(), found.end())
    return header, layout


def _ply_header(content: bytes) -> tuple[F8 | None, _Layout]:
    """Return the position in the comment VIEWPOINT (None without it), and the body's layout."""
    end = re.search(rb"^end_header\r?\n", content[:_LARGEST_HEADER], re.MULTILINE)
    if not content.startswith(b"ply") or not end:
        msg = "it has no header"
        raise ValueError(msg)
    lines = [
        line.split() for line in content[: end.start()].decode("ascii", "replace").splitlines()
    ]
    encoding = next(words[1] for words in [*lines, ["format", "none"]] if words[:1] == ["format"])
    order = ">" if encoding == "binary_big_endian" else "<"
    elements = [k for k, words in enumerate(lines) if words[:1] == ["element"]]
    first, last = elements[0], [*elements, len(lines)][1]
    if lines[first][1] != "vertex":
        msg = f"it begins with {lines[first][1]}"
        raise ValueError(msg)
    fields = [
        (words[2], order + _PLY_TYPES[words[1]])
        for words in lines[first + 1 : last]
        if words[0] == "property"
    ]
    said = [words[2:5] for words in lines if words[:2] == ["comment", "VIEWPOINT"]]
    viewpoint = np.array([float(word) for word in said[0]]) if said else None
    encoding = "ascii" if encoding == "ascii" else "binary"
    return viewpoint, _Layout(np.dtype(fields), int(lines[first][2]), encoding, end.end())


def _xyz(body: bytes, layout: _Layout) -> F8:
    """Return the points (n, 3) of an uncompressed body.

    Memory is bounded by the size of the body, whatever number of points the header announces.

    Raises
    ------
    ValueError, KeyError, IndexError : the body has fewer points or other text, the points lack x, y
        or z, or the encoding or the number is invalid.
    """
    if layout.encoding == "ascii":
        columns = _ascii_columns(layout.point)
        lines = body.decode("ascii", "replace").splitlines()
        filled = (line.split() for line in lines if line.strip())
        words = list(itertools.islice(filled, layout.number))
        if len(words) != layout.number:
            msg = f"{layout.number} points announced, {len(words)} found"
            raise ValueError(msg)
        points = [[float(row[column]) for column in columns] for row in words]
        return np.array(points, np.float64).reshape(-1, 3)
    if layout.encoding != "binary" or layout.number < 0:
        msg = f"unknown encoding {layout.encoding}, or a negative number of points"
        raise ValueError(msg)
    rows = np.frombuffer(body, layout.point, count=layout.number)
    with np.errstate(invalid="ignore"):  # signalling NaN
        return np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _ascii_columns(point: np.dtype) -> list[int]:
    """Return the positions of x, y and z among the words of a line."""
    widths = [int(np.prod(point[name].shape, dtype=int)) for name in point.names or ()]
    starts = dict(zip(point.names or (), np.cumsum([0, *widths]).tolist(), strict=False))
    return [starts[axis] for axis in "xyz"]


def _unpack_pcd(body: bytes, layout: _Layout) -> F8:
    """Return the points (n, 3) of a compressed body, which stores one field after the other."""
    packed, size = np.frombuffer(body, "<u4", count=2).tolist()
    if size != layout.number * layout.point.itemsize or packed > len(body) - 8:
        msg = "the compressed data is not as long as the header says"
        raise ValueError(msg)
    if size > packed * 300:  # LZF packs 264 bytes into 3 at best
        msg = "the header claims an impossible length of the data"
        raise ValueError(msg)
    flat = np.zeros(size, np.uint8)
    if _unpack_lzf(np.frombuffer(body, np.uint8, packed, 8), flat) != size:
        msg = "the compressed data is damaged"
        raise ValueError(msg)
    columns = {}
    start = 0
    for name in layout.point.names or ():
        end = start + layout.number * layout.point[name].itemsize
        if name in {"x", "y", "z"}:
            with np.errstate(invalid="ignore"):  # signalling NaN
                columns[name] = flat[start:end].view(layout.point[name]).astype(np.float64)
        start = end
    return np.stack([columns[axis] for axis in "xyz"], axis=1)


@kernel
def _unpack_lzf(packed: U1, flat: U1) -> int:
    """Unpack LZF (Lehmann 2000) into ``flat``; return the number of bytes, -1 if damaged.

    ``packed`` (n,) and ``flat`` (m,) are bytes.
    """
    i = np.int64(0)
    out = np.int64(0)
    while i < packed.size:
        control = np.int64(packed[i])
        i += 1
        if control < 32:  # copy the next 1 to 32 bytes
            length = control + 1
            if i + length > packed.size or out + length > flat.size:
                return -1
            for k in range(length):
                flat[out + k] = packed[i + k]
            i += length
        else:  # repeat what was written before
            length = control >> 5
            if length == 7:
                if i >= packed.size:
                    return -1
                length += np.int64(packed[i])
                i += 1
            if i >= packed.size:
                return -1
            source = out - ((control & 31) << 8) - np.int64(packed[i]) - 1
            i += 1
            length += 2
            if source < 0 or out + length > flat.size:
                return -1
            for k in range(length):
                flat[out + k] = flat[source + k]
        out += length
    return int(out)
