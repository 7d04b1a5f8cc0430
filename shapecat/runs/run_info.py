"""The contents of run.json, which describes a run; `schemas/run.json` documents each entry."""

import json
import sys
from contextlib import suppress
from functools import cache
from types import UnionType
from typing import (
    Any,
    NotRequired,
    TypedDict,
    cast,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from shapecat.errors import OutputError

__all__ = [
    "Counts",
    "InputInfo",
    "ModelInfo",
    "Options",
    "OriginInfo",
    "OutputsInfo",
    "RunIdentity",
    "RunInfo",
    "SettingsInfo",
    "parse_identity",
    "parse_run",
    "wrong_entry",
]


class InputInfo(TypedDict):
    """The recording: path or URL, size, digest, and the name, size and times of each file."""

    path: str
    bytes: int
    digest: str
    files: list[list[Any]]


class Options(TypedDict):
    """The options of `shapecat process` that affect the results."""

    topics: list[str]
    up: str
    fixed_frame: str | None
    start_s: float | None
    end_s: float | None
    every: int
    color: str | None
    mcap: bool
    rrd: bool


class OutputsInfo(TypedDict):
    """The settings of the outputs, which `annotate` reads again; see `OutputSettings`."""

    boxes: str
    markers: bool
    cloud_points: int


class SettingsInfo(TypedDict):
    """The settings of the run, by group; see `Settings`."""

    seed: int
    reuse_frames: NotRequired[int]
    detection: dict[str, Any]
    surface: dict[str, Any]
    tracking: dict[str, Any]
    outputs: OutputsInfo


class ModelInfo(TypedDict):
    """The model: its id, and its categories in the order of every posterior."""

    id: str
    categories: list[str]


class Counts(TypedDict):
    """Numbers of frames, detections and tracks.

    ``skipped`` counts frames by reason, ``tracks`` counts tracks by category; ``resumed`` and
    ``revised`` count frames; ``color`` counts frames with a colour image.
    """

    frames: int
    skipped: dict[str, int]
    detections: int
    resumed: NotRequired[int]
    revised: NotRequired[int]
    tracks: NotRequired[dict[str, int]]
    color: NotRequired[int]


class OriginInfo(TypedDict):
    """`Job.input_key` and `Job.work_key` of a run whose results are at a URL."""

    input: str
    work: str


class RunIdentity(TypedDict):
    """The entries of run.json that every version of shapecat writes.

    ``id`` is random and belongs to one folder; ``work`` identifies the recording and how it was
    processed.
    """

    id: str
    work: str
    input: InputInfo
    versions: dict[str, str]
    model: ModelInfo
    fixed_frame: str | None


class RunInfo(RunIdentity):
    """The contents of run.json; ``seconds`` has the duration of each finished phase.

    ``damaged`` is present if damage was found while reading the frames: see `Recording.damaged`.
    """

    settings: SettingsInfo
    options: Options
    up: dict[str, Any]
    counts: Counts
    seconds: dict[str, float]
    warnings: list[str]
    color: dict[str, str]
    damaged: NotRequired[bool]
    boxes: NotRequired[str]
    origin: NotRequired[OriginInfo]
    corrections: NotRequired[dict[str, Any]]


_hints_of = cache(get_type_hints)
"""Returns the type of each entry of a class, by name, without `NotRequired`."""


def wrong_entry(content: Any, kind: Any = RunInfo, name: str = "") -> str | None:
    """Return the name of the first missing or mistyped entry of a run.json; None if all are fine.

    Parameters
    ----------
    content : the decoded JSON, or a part of it.
    kind : the type that ``content`` must have.
    name : the name of ``content``, such as ``options.up``; empty for the whole run.json.
    """
    origin, parts = get_origin(kind), get_args(kind)
    if origin is UnionType:
        fits = any(wrong_entry(content, part) is None for part in parts)
    elif kind is float:
        fits = type(content) in {int, float} and abs(content) <= sys.float_info.max
    else:
        fits = kind is Any or type(content) is (dict if is_typeddict(kind) else origin or kind)
    if not fits:
        return name
    within: list[tuple[str, Any, Any]] = []
    if is_typeddict(kind):
        hints = _hints_of(kind)
        expected = [key for key in hints if key in content or key in kind.__required_keys__]
        within = [
            (f"{name}.{key}".strip("."), content.get(key, ...), hints[key]) for key in expected
        ]
    elif origin is dict:
        within = [(f"{name}.{key}", value, parts[1]) for key, value in content.items()]
    elif origin is list:
        within = [(name, item, parts[0]) for item in content]
    errors = (wrong_entry(value, part, place) for place, value, part in within)
    return next((wrong for wrong in errors if wrong is not None), None)


def parse_run(content: bytes, folder: str) -> RunInfo:
    """Return the content of a run.json; ``folder`` is its folder or URL, for error messages.

    Raises
    ------
    OutputError : it is damaged, or has missing or wrong entries.
    """
    run: Any = parse_identity(content, folder)
    if (wrong := wrong_entry(run)) is not None:
        msg = (
            f"{folder}/run.json: not a description of a run: {wrong} is missing or wrong; if "
            "another version made it, process the recording again with --overwrite, which keeps "
            "labels"
        )
        raise OutputError(msg)
    return cast("RunInfo", run)


def parse_identity(content: bytes, folder: str) -> RunIdentity:
    """Return the content of a run.json; check only the entries that every version writes.

    ``folder`` is its folder or URL, for error messages.

    Raises
    ------
    OutputError : it is damaged, or an entry that every version writes is missing or wrong.
    """
    run: Any = None
    with suppress(ValueError, RecursionError):
        run = json.loads(content)
    wrong = wrong_entry(run, RunIdentity)
    if wrong is not None:
        detail = f": {wrong} is missing or wrong" if wrong else ""
        msg = f"{folder}/run.json: not a description of a run{detail}"
        raise OutputError(msg)
    return cast("RunIdentity", run)
