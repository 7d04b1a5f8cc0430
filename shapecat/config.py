"""The settings: one frozen tree with defaults, read from TOML, stored in every output."""

import dataclasses
import difflib
import json
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral, Real
from pathlib import Path
from reprlib import repr as shown
from typing import Any, Literal, get_args, get_origin, get_type_hints

from shapecat.errors import ConfigError, explained

__all__ = [
    "DetectionSettings",
    "OutputSettings",
    "Settings",
    "SurfaceSettings",
    "TrackingSettings",
    "load_settings",
    "with_overrides",
    "with_settings",
]


@dataclass(frozen=True)
class DetectionSettings:
    """Planes and object candidates (thesis ch. 4). Lengths in metres."""

    max_range_m: float = 3.0
    """Points at a larger depth than this, along the optical axis, are ignored (thesis 4.2). For an
    unorganized cloud, the optical axis is the line from the origin of its frame to the centre of
    the cloud."""
    fuse_frames: int = 1
    """Number of consecutive depth images that are fused before detection, including the current one
    (thesis 4.2); 1 turns fusion off."""
    max_height_m: float = 0.6
    """Points higher than this above a plane do not belong to an object on it. An object must end at
    least 2 cm below this limit; a taller one may continue above it and is dropped."""
    max_size_m: float = 0.6
    """Segments larger than this are treated as walls or furniture."""
    min_points: int = 60
    """Candidates with fewer points than this, at full resolution, are dropped."""

    def __post_init__(self) -> None:
        """Reject numbers that are out of range."""
        _check_range("detection.max_range_m", self.max_range_m, 0.01, 1000.0)
        _check_range("detection.fuse_frames", self.fuse_frames, 1, 30)
        _check_range("detection.max_height_m", self.max_height_m, 0.025, 10.0)  # rejects mm
        _check_range("detection.max_size_m", self.max_size_m, 0.001, 10.0)
        _check_least("detection.min_points", self.min_points, 1)


@dataclass(frozen=True)
class SurfaceSettings:
    """Growing Neural Gas (thesis ch. 5). Every model is trained with the defaults."""

    method: Literal["fritzke", "thesis"] = "fritzke"
    """Insertion of neurons: `fritzke` at a fixed interval of signals (thesis, Algorithm 3),
    `thesis` where the accumulated error is large (Algorithm 4)."""
    neurons: int = 80
    """Number of neurons at the end of growth; fewer on small clouds, up to twice as many with
    method `thesis`."""
    signals: int = 6000
    """Total number of signals: points presented in random order to adapt the neurons; method
    `thesis` decides itself."""
    component_share: float = 0.35
    """Separate parts of the graph with a smaller fraction of the points than this are dropped."""
    voxel_m: float = 0.005
    """Edge of the voxels in which the points of an object are averaged before the neural gas learns
    them."""
    smooth_radius_m: float = 0.0
    """Radius of moving least squares smoothing, applied to the voxel centroids, for example 0.015
    (thesis 4.2), at least 1.5 times `surface.voxel_m`; 0 turns it off."""

    def __post_init__(self) -> None:
        """Reject numbers and lengths that are out of range."""
        # Fewer neurons or larger voxels make most objects unknown. More neurons make distances
        # too coarse, since the index of a neuron replaces their lowest bits.
        _check_range("surface.neurons", self.neurons, 20, 512)
        _check_least("surface.signals", self.signals, 100)
        _check_range("surface.component_share", self.component_share, 0.0, 1.0)
        _check_range("surface.voxel_m", self.voxel_m, 0.0001, 0.02)
        if self.smooth_radius_m != 0:
            _check_range("surface.smooth_radius_m, if not 0,", self.smooth_radius_m, 0.0001, 0.1)
            # A fit needs neighbours, which are about one voxel apart.
            if self.smooth_radius_m / self.voxel_m < 1.5 - 1e-9:
                msg = (
                    "surface.smooth_radius_m, if not 0, must be at least 1.5 times "
                    f"surface.voxel_m, got {self.smooth_radius_m} and {self.voxel_m}"
                )
                raise ConfigError(msg)


@dataclass(frozen=True)
class TrackingSettings:
    """Nearest-centroid tracker and fusion (thesis 7.5.2)."""

    association: Literal["hungarian", "greedy"] = "hungarian"
    """Assignment of detections to tracks: `hungarian` minimises the total cost (distance and
    change of size and category), `greedy` takes the pair with the lowest cost first."""
    gate_m: float = 0.12
    """Largest distance between a track and the box centre of its next detection; smaller for
    small objects."""
    min_hits: int = 3
    """Number of detections that confirm a track; fewer are enough if there are fewer frames within
    half a second of its first detection."""
    max_missed_s: float = 5.0
    """A track ends after this long without a detection; new tracks end sooner. An object that later
    reappears in the same place gets its old track."""
    fusion: Literal["mean", "product", "vote"] = "product"
    """Fusion of the posteriors of all views: `product`, `mean` or `vote`. The product is
    tempered by the number of views, so that more views alone do not raise the confidence."""

    def __post_init__(self) -> None:
        """Reject numbers that are out of range."""
        _check_range("tracking.gate_m", self.gate_m, 0.001, 10.0)
        _check_least("tracking.min_hits", self.min_hits, 1)


@dataclass(frozen=True)
class OutputSettings:
    """Contents of annotated.mcap and review.rrd."""

    boxes: Literal["full", "visible"] = "full"
    """Boxes in annotated.mcap: `full` encloses the whole object, `visible` its visible part."""
    markers: bool = False
    """Also write visualization_msgs/MarkerArray for RViz."""
    cloud_points: int = 30_000
    """Approximate number of points per cloud in review.rrd; 0 keeps all."""


@dataclass(frozen=True)
class Settings:
    """All settings. ``seed`` fixes every random choice."""

    seed: int = 0
    reuse_frames: int = 16
    """Frames per block. Within a block, an object that looks the same as in an earlier frame keeps
    its description from that frame; 1 describes every object in every frame."""
    detection: DetectionSettings = field(default_factory=DetectionSettings)
    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    outputs: OutputSettings = field(default_factory=OutputSettings)

    def __post_init__(self) -> None:
        """Reject a ``reuse_frames`` that is out of range."""
        _check_range("reuse_frames", self.reuse_frames, 1, 64)

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as nested dictionaries, as stored in the outputs."""
        return dataclasses.asdict(self)


def load_settings(path: Path | None = None, overrides: Sequence[str] = ()) -> Settings:
    """Read settings from a TOML file, then apply ``a.b=value`` overrides.

    Raises
    ------
    ConfigError : the file cannot be read, a setting does not exist (the message suggests the
        nearest name), or a value has the wrong type or is out of range.
    """
    try:
        tree = {} if path is None else _read_toml(path)
        return with_overrides(with_settings(Settings(), tree), overrides)
    except RecursionError as error:
        msg = "the settings are nested too deeply"
        raise ConfigError(msg) from error


def _read_toml(path: Path) -> Mapping[str, Any]:
    try:
        with explained(f"{path}: cannot be read", ConfigError):
            return tomllib.loads(path.read_text("utf-8-sig"))
    except ValueError as error:
        msg = f"{path}: not a readable TOML file: {error}"
        raise ConfigError(msg) from error


def with_settings(settings: Settings, tree: Mapping[str, Any]) -> Settings:
    """Return settings with some values replaced.

    Parameters
    ----------
    tree : the new values, for example ``{"seed": 3, "detection": {"max_range_m": 1.5}}``.

    Raises
    ------
    ConfigError : a setting does not exist, or a value has the wrong type or is out of range.
    """
    changed: Settings = _replace(settings, tree, "")
    return changed


def with_overrides(settings: Settings, overrides: Sequence[str]) -> Settings:
    """Return settings with overrides such as ``detection.max_range_m=1.5`` applied together.

    If a setting is overridden several times, the last value counts.

    Raises
    ------
    ConfigError : an override is not ``name=value``, a setting does not exist, or a value has the
        wrong type or is out of range.

    Examples
    --------
    >>> with_overrides(Settings(), ["tracking.gate_m=0.2"]).tracking.gate_m
    0.2
    """
    changes: dict[str, Any] = {}
    for text in overrides:
        name, equals, value = text.partition("=")
        if not (name.strip() and equals):
            msg = f"--set {text}: expected name=value, for example tracking.gate_m=0.2"
            raise ConfigError(msg)
        tree: Any = _parse_value(value)
        for part in reversed(name.strip().split(".")):
            tree = {part: tree}
        _merge(changes, tree)
    return with_settings(settings, changes)


def _merge(tree: dict[str, Any], more: Mapping[str, Any]) -> None:
    """Add the values of ``more`` to a nested tree, in place; they replace earlier ones."""
    for key, value in more.items():
        if isinstance(value, Mapping) and isinstance(tree.get(key), dict):
            _merge(tree[key], value)
        else:
            tree[key] = value


def _check_least(name: str, value: float, least: float) -> None:
    if value < least:
        msg = f"{name} must be at least {least}, got {value}"
        raise ConfigError(msg)


def _check_range(name: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        msg = f"{name} must be from {least} to {most}, got {value}"
        raise ConfigError(msg)


def _parse_value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text.strip()


def _replace(group: Any, tree: Mapping[str, Any], prefix: str) -> Any:
    """Return a group of settings with some values replaced.

    ``prefix`` precedes their names in messages, such as ``detection.``.
    """
    hints = get_type_hints(type(group))
    changes = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if key not in hints:
            near = [f"{part}.{key}" for part in hints if hasattr(getattr(group, part), key)]
            near = near or difflib.get_close_matches(key, hints, 1)
            hint = f"; did you mean {prefix}{near[0]}?" if near else f"; known: {', '.join(hints)}"
            msg = f"unknown setting {name}{hint}"
            raise ConfigError(msg)
        current = getattr(group, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                first = dataclasses.fields(current)[0].name
                msg = f"{name} is a group of settings, such as {name}.{first}; got {shown(value)}"
                raise ConfigError(msg)
            changes[key] = _replace(current, value, f"{name}.")
        else:
            changes[key] = _checked(name, value, hints[key])
    return dataclasses.replace(group, **changes)


_KINDS = {bool: "true or false", int: "an integer", float: "a number"}


def _checked(name: str, value: Any, kind: Any) -> Any:
    """Return a value converted to the type of a setting; raise ConfigError if it does not fit."""
    if get_origin(kind) is Literal:
        if value not in get_args(kind):
            allowed = ", ".join(map(str, get_args(kind)))
            msg = f"{name} must be one of {allowed}, got {shown(value)}"
            raise ConfigError(msg)
        return value
    if not isinstance(value, bool) and isinstance(value, Real):  # also NumPy scalars
        value = int(value) if isinstance(value, Integral) else float(value)
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        msg = f"{name} is too large"
        raise ConfigError(msg)
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        msg = f"{name} must be {_KINDS[kind]}, got {shown(value)}"
        raise ConfigError(msg)
    if isinstance(value, float) and not abs(value) < float("inf"):
        msg = f"{name} must be finite, got {value!r}"
        raise ConfigError(msg)
    if not isinstance(value, bool | str) and value < 0:
        msg = f"{name} must not be negative, got {value!r}"
        raise ConfigError(msg)
    return value
