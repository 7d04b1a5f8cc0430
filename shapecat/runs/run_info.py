"""The contents of run.json, which describes a run; `schemas/run.json` documents each entry."""

from typing import Any, NotRequired, TypedDict, TypeGuard

__all__ = [
    "Counts",
    "InputInfo",
    "ModelInfo",
    "Options",
    "OriginInfo",
    "RunInfo",
    "is_run_info",
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
    color: NotRequired[str | None]
    mcap: bool
    rrd: bool


class ModelInfo(TypedDict):
    """The model: its id, and its categories in the order of every posterior."""

    id: str
    categories: list[str]


class Counts(TypedDict, total=False):
    """Numbers of frames, detections and tracks.

    ``skipped`` is by reason, ``tracks`` by category; ``resumed`` and ``revised`` count frames;
    ``color`` counts frames with a colour image.
    """

    frames: int
    skipped: dict[str, int]
    detections: int
    resumed: int
    revised: int
    tracks: dict[str, int]
    color: int


class OriginInfo(TypedDict):
    """Keys of the recording and of the work in a run folder at a URL; see `Ticket`."""

    input: str
    work: str


class RunInfo(TypedDict):
    """The contents of run.json.

    ``id`` is random and belongs to one folder; ``work`` identifies the recording and how it was
    processed. ``seconds`` has the duration of each finished phase.
    """

    id: str
    work: str
    input: InputInfo
    versions: dict[str, str]
    settings: dict[str, Any]
    options: Options
    model: ModelInfo
    fixed_frame: str | None
    up: dict[str, Any]
    counts: Counts
    seconds: dict[str, float]
    warnings: list[str]
    color: NotRequired[dict[str, str]]
    boxes: NotRequired[str]
    origin: NotRequired[OriginInfo]
    corrections: NotRequired[dict[str, Any]]


_PARTS: dict[str, Any] = {"input": InputInfo, "options": Options, "model": ModelInfo}


def is_run_info(content: Any) -> TypeGuard[RunInfo]:
    """Return whether the content of a file has the entries that every run.json has."""
    return (
        isinstance(content, dict)
        and content.keys() >= RunInfo.__required_keys__
        and all(isinstance(content[name], dict) for name in ("settings", "counts", "seconds"))
        and all(
            isinstance(content[name], dict) and content[name].keys() >= part.__required_keys__
            for name, part in _PARTS.items()
        )
        and isinstance(content["model"]["categories"], list)
        and all(isinstance(name, str) for name in content["model"]["categories"])
    )
