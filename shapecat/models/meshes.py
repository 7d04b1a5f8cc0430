"""Views of scanned and CAD meshes that the simulator did not make: what a model is judged by."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from shapecat.errors import RecordingError
from shapecat.models.worlds import WorldView, simulate_mesh
from shapecat.simulation.mesh import Mesh
from shapecat.simulation.scans import upright_poses, uprighted

__all__ = ["mesh_views", "read_triangles"]

_TYPES = {"double": "<f8", "float": "<f4", "uchar": "u1", "uint": "<u4", "int": "<i4"}
_VIEWS = {"upright": 12, "lying": 8}
_NEVER_LIE = {"ball", "bowl", "plate"}


def mesh_views(folder: Path, *, seed: int) -> Iterator[WorldView]:
    """Yield 20 views of each mesh of ``<category>/*.ply``, alone on a table, some of them lying."""
    for number, path in enumerate(sorted(folder.glob("*/*.ply"))):
        label = path.parent.name
        rng = np.random.default_rng((seed, number))
        mesh = uprighted(read_triangles(path), label)
        rests = upright_poses(mesh, label)
        for manner, count in _VIEWS.items():
            wanted = "upright" if label in _NEVER_LIE else manner
            fitting = [rest for rest in rests if rest.manner == wanted] or list(rests)
            for _ in range(count // 2):
                rest = fitting[int(rng.integers(len(fitting)))]
                name = f"{label}/{path.stem}"
                yield from simulate_mesh(mesh, label, name, rest, cameras=2, rng=rng)


def read_triangles(path: Path) -> Mesh:
    """Read a binary PLY file of vertices and triangles.

    `shapecat.simulation.scans.load_mesh` reads more, but Open3D cannot be imported on machines
    without display libraries.

    Raises
    ------
    RecordingError : it is another kind of file.
    """
    content = path.read_bytes()
    try:
        end = content.index(b"end_header\n") + len(b"end_header\n")
        header = content[:end].decode("ascii")
        vertices, faces = (
            int(re.findall(rf"element {name} (\d+)", header)[0]) for name in ("vertex", "face")
        )
        before, after = header.split("element face")
        fields = re.findall(r"property (\w+) (\w+)\n", before)
        point = np.dtype([(name, _TYPES[kind]) for kind, name in fields])
        kinds = re.findall(r"property list (\w+) (\w+)", after)[0]
        face = np.dtype([("n", _TYPES[kinds[0]]), ("corners", _TYPES[kinds[1]], (3,))])
        points = np.frombuffer(content, point, vertices, end)
        corners = np.frombuffer(content, face, faces, end + vertices * point.itemsize)
    except (ValueError, KeyError, IndexError) as error:
        msg = f"{path}: not a binary PLY file of triangles: {error}"
        raise RecordingError(msg) from error
    if "binary_little_endian" not in header or np.any(corners["n"] != 3):
        msg = f"{path}: not binary, or there are faces that are no triangles"
        raise RecordingError(msg)
    return Mesh(np.stack([points[axis] for axis in "xyz"], axis=1), corners["corners"])
