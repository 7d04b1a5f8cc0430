"""Model files: plain arrays and a JSON header in one .npz. Loading a model executes no code."""

import io
import json
import math
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np

from shapecat.arrays import Record
from shapecat.errors import ModelError, OutputError, explained
from shapecat.learning.categorizer import Categorizer, parts_of
from shapecat.system.files import replacing, require_writable

_Record = TypeVar("_Record", bound=Record)
__all__ = ["load_model", "require_model_path", "save_model"]

_FORMAT = "shapecat-model"
_VERSION = 3
_LARGEST_FILE = 64 << 20
_LARGEST_CONTENT = 128 << 20
"""Maximum sizes of a file, and of all its unpacked members together, bytes."""
_HEADER = "header.json"


def save_model(path: Path, categorizer: Categorizer) -> None:
    """Write a model; equal models give equal bytes.

    Raises
    ------
    OutputError : the file cannot be written, or is neither empty nor a model, or the model is
        larger than `load_model` reads.
    """
    require_model_path(path)
    parts = parts_of(categorizer)
    header = {name: value for name, value in parts.items() if not isinstance(value, np.ndarray)}
    text = json.dumps({"format": _FORMAT, "version": _VERSION, **header}, sort_keys=True, indent=1)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        _write_member(archive, _HEADER, text.encode())
        for name in sorted(parts.keys() - header.keys()):
            content = io.BytesIO()
            little = parts[name].astype(parts[name].dtype.newbyteorder("<"), copy=False)
            np.lib.format.write_array(content, np.ascontiguousarray(little), allow_pickle=False)
            _write_member(archive, f"{name}.npy", content.getvalue())
        unpacked = sum(item.file_size for item in archive.infolist())
    if buffer.tell() > _LARGEST_FILE or unpacked > _LARGEST_CONTENT:
        msg = (
            f"{path}: the model is too large ({buffer.tell() >> 20} MB, unpacked "
            f"{unpacked >> 20} MB); learn fewer categories"
        )
        raise OutputError(msg)
    with replacing(path) as hidden:
        hidden.write_bytes(buffer.getvalue())


def require_model_path(path: Path, *, overwrite: bool = True) -> None:
    """Check that a model can be written to a path, and replaces at most a model or an empty file.

    Raises
    ------
    OutputError : the model cannot be written, or the file is neither empty nor a model, or it is a
        model and ``overwrite`` is false.
    """
    require_writable(path)
    with explained(f"{path}: cannot be read", OutputError):
        if not path.exists() or not path.stat().st_size:
            return
        is_model = _is_model(path)
    if is_model and overwrite:
        return
    msg = f"{path}: exists and is not a model; choose another --out, or move it away"
    if is_model:
        msg = f"{path}: exists already; choose another --out, or --overwrite it"
    raise OutputError(msg)


def _is_model(path: Path) -> bool:
    if zipfile.is_zipfile(path):
        with suppress(zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
            return _HEADER in archive.namelist()
    return False


def _write_member(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    member = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    member.compress_type = zipfile.ZIP_DEFLATED
    # Level 9 would take six times as long, for files 0.3 % smaller.
    archive.writestr(member, content, compresslevel=6)


def load_model(path: Path | None = None) -> Categorizer:
    """Read a model; without a path, read the default model that comes with the package.

    No file can run code, or crash or hang the reader: sizes are limited, and every index is
    checked.

    Raises
    ------
    ModelError : the file does not exist, is damaged, is not a model, or has another format version.
    """
    return _read(path, str(path)) if path is not None else _default_model()


@cache
def _default_model() -> Categorizer:
    """Read the default model once, for all recordings of a batch."""
    return _read(files("shapecat.models") / "default.npz", "the default model")


def _read(source: Traversable, name: str) -> Categorizer:
    with explained(f"{name}: cannot read the model", ModelError):
        content = source.read_bytes()
    try:
        return _parse(content)
    except (_NotAModelError, ValueError, TypeError, OverflowError, RecursionError) as error:
        reason = str(error).strip("'\"").partition("\n")[0]
        msg = (
            f"{name}: not a usable model file: {reason}; make one with `shapecat learn` or `train`"
        )
        raise ModelError(msg) from error


class _NotAModelError(Exception):
    """The content of a file is not a model, is damaged, or is of another version."""


def _parse(content: bytes) -> Categorizer:
    members = _read_members(content)
    if _HEADER not in members:
        msg = f"it has no {_HEADER}"
        raise _NotAModelError(msg)
    header = json.loads(members.pop(_HEADER))
    if not isinstance(header, dict) or header.pop("format", None) != _FORMAT:
        msg = f"its header does not say {_FORMAT}"
        raise _NotAModelError(msg)
    version = header.pop("version", None)
    if version != _VERSION:
        msg = f"it has version {version}, this shapecat reads version {_VERSION}"
        raise _NotAModelError(msg)
    parts = {name.removesuffix(".npy"): _parse_array(data) for name, data in members.items()}
    return _assemble(Categorizer, header | parts, "")


def _read_members(content: bytes) -> dict[str, bytes]:
    """Unpack the members of an archive by name, without trusting the sizes that it states.

    Raises
    ------
    _NotAModelError : the archive is damaged or too large.
    """
    if len(content) > _LARGEST_FILE:
        msg = f"it is larger than {_LARGEST_FILE >> 20} MB"
        raise _NotAModelError(msg)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return _unpack(archive)
    except (zipfile.BadZipFile, EOFError, OSError, RuntimeError, zlib.error) as error:
        # RuntimeError: encrypted, or an unknown compression.
        msg = f"it is not an intact .npz archive ({error})"
        raise _NotAModelError(msg) from error


def _unpack(archive: zipfile.ZipFile) -> dict[str, bytes]:
    members, left = {}, _LARGEST_CONTENT
    for item in archive.infolist():
        if item.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            msg = f"{item.filename} has an unknown compression"
            raise _NotAModelError(msg)
        with archive.open(item) as stream:
            data = stream.read(left + 1)
        left -= len(data)
        if left < 0:
            msg = f"it unpacks to more than {_LARGEST_CONTENT >> 20} MB"
            raise _NotAModelError(msg)
        members[item.filename] = data
    return members


def _parse_array(data: bytes) -> np.ndarray:
    """Read an array in .npy format; allocate no more memory than the data need.

    Raises
    ------
    _NotAModelError, ValueError : the data are damaged.
    """
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        msg = "an array has an unknown version"
        raise _NotAModelError(msg)
    try:
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    except (SyntaxError, tokenize.TokenError) as error:
        msg = "the header of an array is damaged"
        raise _NotAModelError(msg) from error
    body = data[stream.tell() :]
    if fortran or dtype.kind not in "fiu" or math.prod(shape) * dtype.itemsize != len(body):
        msg = "the size of an array differs from its header"
        raise _NotAModelError(msg)
    return np.frombuffer(body, dtype).reshape(shape)


def _assemble(kind: type[_Record], parts: Mapping[str, Any], prefix: str) -> _Record:
    """Build a record from its fields by dotted name, each beginning with ``prefix``.

    This is the inverse of `parts_of`. Parts that the record does not have are ignored.
    """
    values: dict[str, Any] = {}
    hints = get_type_hints(kind)
    for item in fields(kind):  # type: ignore[arg-type]  # every Record is a dataclass
        key, hint = f"{prefix}{item.name}", hints[item.name]
        if isinstance(hint, type) and issubclass(hint, Record):
            values[item.name] = _assemble(hint, parts, f"{key}.")
        elif key not in parts:
            msg = f"it has no {key}"
            raise _NotAModelError(msg)
        else:
            values[item.name] = _checked(key, parts[key], hint, item.metadata.get("dtype"))
    return kind(**values)


def _checked(key: str, value: Any, hint: Any, dtype: str | None) -> Any:
    """Return a value from a model file in the type of its field.

    The type is ``hint``, or an array of ``dtype`` if that is not None. A list may stand for a
    tuple, and an integer for a float; otherwise raise `_NotAModelError`, which names ``key``.
    """
    if dtype is not None:
        good = isinstance(value, np.ndarray) and value.dtype == np.dtype(f"<{dtype}")
    elif hint == tuple[str, ...]:
        good = isinstance(value, list) and all(isinstance(item, str) for item in value)
        value = tuple(value) if good else value
    elif hint is float:
        good = isinstance(value, int | float) and not isinstance(value, bool)
        value = float(value) if good else value
    else:
        good = isinstance(value, dict)
    if not good:
        msg = f"{key} has the wrong type"
        raise _NotAModelError(msg)
    return value
