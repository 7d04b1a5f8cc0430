"""Labelled object data sets: ``DATASET/<category>/<instance>/<view>.pcd`` (or .ply, .npz).

Each file holds one partial view, in metres, with z up and the supporting plane at z = 0. The
VIEWPOINT of a PCD file is the position of the sensor.
"""

import lzma
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shapecat.arrays import F4, F8, Record, array
from shapecat.errors import RecordingError
from shapecat.evaluation.clouds import CloudFile, read_pcd, read_ply

__all__ = ["DAMAGED", "Dataset", "View", "estimate_eye", "read_dataset", "read_view"]

_FARTHEST_M = 100.0
_LARGEST_M = 5.0
"""Maximum magnitude of a coordinate, and maximum extent of a view along an axis."""
DAMAGED = (
    OSError,
    ValueError,
    KeyError,
    EOFError,
    TypeError,  # the content of an .npy file
    MemoryError,  # a header that claims too many points
    RuntimeError,  # encrypted, or an unknown compression
    SyntaxError,  # this and the next: the header of an .npy file
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
)
"""Errors that NumPy raises for damaged .npz files."""


class View(Record):
    """One partial view of one object in a level frame: z is the height above the support.

    ``points`` (n, 3) metres, finite; ``eye`` (3,) position of the sensor, metres.
    """

    points: F4 = array("n 3", "f4")
    eye: F8 = array("3", "f8")
    category: str
    instance: str


@dataclass(frozen=True)
class Dataset:
    """The files of a data set; views are read on demand.

    ``without_views`` names the folders, beside those of the categories, in which there is no view.
    """

    files: tuple[Path, ...]
    without_views: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.files)

    def __iter__(self) -> Iterator[View]:
        """Read the views one by one, in the order of their paths."""
        return (read_view(path) for path in self.files)

    @property
    def categories(self) -> tuple[str, ...]:
        """The names of the category folders, sorted."""
        return tuple(sorted({path.parent.parent.name for path in self.files}))


def read_dataset(root: Path) -> Dataset:
    """Find the files of a data set; hidden files and folders are ignored.

    Raises
    ------
    RecordingError : the folder holds no views, or a view of a category is beside or below the
        folders of its objects, not in one.
    """
    files = tuple(_views_among(root, "*/*/*"))
    if not files:
        msg = (
            f"{root}: no views found; expected files such as "
            f"{root.resolve().name}/cup/red_mug/000.pcd (or .ply, .npz)"
        )
        raise RecordingError(msg)
    folders = sorted(
        path for path in root.iterdir() if path.is_dir() and not path.name.startswith(".")
    )
    for folder in folders:
        for path in _views_among(folder, "**/*"):
            if path.is_file() and path.parent.parent != folder:
                place = Path(folder.name, "object", path.name)
                msg = f"{path}: expected a folder for each object, such as {place}"
                raise RecordingError(msg)
    categories = {path.parent.parent.name for path in files}
    return Dataset(files, tuple(path.name for path in folders if path.name not in categories))


def _views_among(root: Path, pattern: str) -> list[Path]:
    """Return the sorted paths of the views below a folder that match a glob; omit hidden ones."""
    return sorted(
        path
        for path in root.glob(pattern)
        if path.suffix.lower() in _READERS
        and not any(part.startswith(".") for part in path.relative_to(root).parts)
    )


def read_view(path: Path) -> View:
    """Read one view; its folders name the category and the instance.

    If the file states no valid position of the sensor, `estimate_eye` estimates it.

    Raises
    ------
    RecordingError : the file is unreadable, or its points are not one object in metres.
    """
    points, stated_eye = _READERS[path.suffix.lower()](path)
    if points.ndim != 2 or points.shape[1] != 3:
        msg = f"{path}: points have shape {points.shape}, expected (n, 3)"
        raise RecordingError(msg)
    points = points[np.all(np.isfinite(points), axis=1)].astype(np.float32)
    if len(points) == 0:
        msg = f"{path}: no points could be read"
        raise RecordingError(msg)
    if np.abs(points).max() > _FARTHEST_M:
        msg = f"{path}: a point is {np.abs(points).max():.0f} m away; points must be in metres"
        raise RecordingError(msg)
    extent = np.ptp(points, axis=0).max()
    if extent > _LARGEST_M:
        msg = f"{path}: the points extend over {extent:.0f} m; they must show one object, in metres"
        raise RecordingError(msg)
    eye = _valid_eye(stated_eye)
    if eye is None:
        eye = estimate_eye(points)
    return View(points, eye, path.parent.parent.name, path.parent.name)


def _read_npz(path: Path) -> CloudFile:
    try:
        with np.load(path, allow_pickle=False) as content:
            points = np.asarray(content["points"], np.float64)
            eye = np.asarray(content["viewpoint"], np.float64) if "viewpoint" in content else None
    except DAMAGED as error:
        msg = f"{path}: not an .npz file with an array `points`: {error}"
        raise RecordingError(msg) from error
    return CloudFile(points, eye)


_READERS: dict[str, Callable[[Path], CloudFile]] = {
    ".npz": _read_npz,
    ".pcd": read_pcd,
    ".ply": read_ply,
}


def _valid_eye(eye: F8 | None) -> F8 | None:
    """Return a viewpoint (3,); None if it is invalid or the origin, which means unknown."""
    if eye is None or eye.shape != (3,) or not np.any(eye):
        return None
    return eye if np.all(np.abs(eye) <= _FARTHEST_M) else None


def estimate_eye(points: F4) -> F8:
    """Estimate the position of the sensor from a partial view, 1 m from the centre of the view.

    Seen from the sensor, no two points of a view have the same direction. Of 48 positions around
    the points, at 15 to 60 degrees of elevation, return the one from which the points cover the
    most cells of a grid; on ties, the first.

    Parameters
    ----------
    points : (n, 3) metres, z up.

    Returns
    -------
    The position (3,), metres.
    """
    centre = points.mean(axis=0, dtype=np.float64)
    azimuth, elevation = np.meshgrid(
        np.arange(12) * np.pi / 6, np.radians([15.0, 30.0, 45.0, 60.0]), indexing="ij"
    )
    directions = np.stack(
        [
            np.cos(azimuth) * np.cos(elevation),
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ],
        axis=-1,
    ).reshape(-1, 3)
    local = points - centre
    cell = max(float(np.sqrt(np.ptp(local, axis=0).max() ** 2 / max(len(points), 1))), 1e-4)
    covered = [_covered_cells(local, direction, cell) for direction in directions]
    return np.asarray(centre + directions[int(np.argmax(covered))])


def _covered_cells(points: F8, direction: F8, cell: float) -> int:
    """Return the number of cells that points (n, 3) cover, projected along a direction (3,).

    A cell is ``cell`` metres wide.
    """
    right = np.array([-direction[1], direction[0], 0.0])
    right /= np.linalg.norm(right)
    across = points @ np.stack([right, np.cross(direction, right)], axis=1)
    u, v = np.floor(across / cell).astype(np.int64).T
    cells = np.sort((u << 32) + v)  # np.unique hashes, and these numbers collide
    return 1 + int(np.count_nonzero(np.diff(cells)))
