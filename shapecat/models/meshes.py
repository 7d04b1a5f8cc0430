"""Views of scanned and CAD meshes that the simulator did not make: what a model is judged by."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from shapecat.models.worlds import WorldView, simulate_mesh
from shapecat.simulation.scans import load_mesh, upright_poses, uprighted

__all__ = ["mesh_views"]

_VIEWS = {"upright": 12, "lying": 8}
_NEVER_LIE = {"ball", "bowl", "plate"}


def mesh_views(folder: Path, *, seed: int) -> Iterator[WorldView]:
    """Yield 20 views of each mesh of ``<category>/*.ply``, alone on a table, some of them lying.

    Raises
    ------
    RecordingError : one of the files is not a mesh.
    """
    for number, path in enumerate(sorted(folder.glob("*/*.ply"))):
        label = path.parent.name
        rng = np.random.default_rng((seed, number))
        mesh = uprighted(load_mesh(path), label)
        rests = upright_poses(mesh, label)
        for manner, count in _VIEWS.items():
            wanted = "upright" if label in _NEVER_LIE else manner
            fitting = [rest for rest in rests if rest.manner == wanted] or list(rests)
            for _ in range(count // 2):
                rest = fitting[int(rng.integers(len(fitting)))]
                name = f"{label}/{path.stem}"
                yield from simulate_mesh(mesh, label, name, rest, cameras=2, rng=rng)
