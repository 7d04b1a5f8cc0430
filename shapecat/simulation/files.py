"""The files of a simulated recording: their names, and the file of pixel labels."""

import sqlite3
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from shapecat.arrays import U1
from shapecat.errors import OutputError, explained
from shapecat.simulation.containers import CONTAINERS
from shapecat.system.files import flush
from shapecat.types import Camera

__all__ = ["completed", "label_file", "require_replaceable", "written_paths"]


def written_paths(out: Path, format: str) -> list[Path]:  # noqa: A002  the word users know
    """Return the paths that `simulate` may write: recording, truth, labels, colour labels.

    The recording is ``out``, with the suffix of the format if it has none.
    """
    suffix = CONTAINERS[format].suffix
    out = out if out.suffix or not suffix else out.with_name(out.name + suffix)
    ends = ("truth.json", "labels.npz", "color_labels.npz")
    return [out, *(out.with_name(f"{out.stem}.{end}") for end in ends)]


@contextmanager
def completed(paths: Sequence[Path], *, obsolete: Sequence[Path]) -> Iterator[list[Path]]:
    """Provide hidden paths; if the block succeeds, move the files written there to ``paths``.

    The ``obsolete`` files, which an earlier recording may have left, are then deleted. The first
    path is that of the recording.

    Raises
    ------
    OutputError : the recording cannot be written, or its path is a folder with other files.
    """
    out = paths[0]
    try:
        require_replaceable(out)
        with explained(f"{out}: cannot write the recording", OutputError):
            out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=".simulated-") as hidden:
            hidden_paths = [Path(hidden) / path.name for path in paths]
            yield hidden_paths
            for file, path in zip(hidden_paths, paths, strict=True):
                _move(file, path)
            for path in obsolete:
                path.unlink(missing_ok=True)
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, "strerror", None) or error
        msg = f"{out}: cannot write the recording: {reason}"
        raise OutputError(msg) from error


def require_replaceable(path: Path) -> list[Path]:
    """Check that a recording may replace a path; return the files in it if it is a folder.

    Raises
    ------
    OutputError : the path is a folder that holds anything but a ROS 2 bag.
    """
    files = list(path.iterdir()) if path.is_dir() and not path.is_symlink() else []
    if any(file.name != "metadata.yaml" and file.suffix != ".db3" for file in files):
        msg = f"{path}: a folder that is not a recording; choose another name"
        raise OutputError(msg)
    return files


def _move(hidden_path: Path, path: Path) -> None:
    """Move a finished file or folder to its path; replace a file or ROS 2 bag that is there.

    Raises
    ------
    OutputError : as for `require_replaceable`.
    """
    for file in require_replaceable(path):
        file.unlink()
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    flush(hidden_path)
    hidden_path.replace(path)


@contextmanager
def label_file(path: Path, frames: int, camera: Camera) -> Iterator[Callable[[U1], None]]:
    """Open a compressed .npz file; provide a function that adds the pixel labels (h, w) of a frame.

    The function must be called once for each of the ``frames`` frames. The only array in the file
    is ``labels`` (frames, h, w), uint8; ``camera`` gives h and w.
    """
    # ZipInfo's fixed date makes equal labels give equal bytes.
    member = zipfile.ZipInfo("labels.npy")
    member.compress_type = zipfile.ZIP_DEFLATED
    shape = (frames, camera.height, camera.width)
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=4) as archive,
        archive.open(member, "w", force_zip64=True) as file,
    ):
        header = {"descr": "|u1", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)

        def add(labels: U1) -> None:
            file.write(np.ascontiguousarray(labels).tobytes())

        yield add
