"""Tests of settings: files, overrides and errors."""

import dataclasses
import json
import math
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from shapecat.config import Settings, load_settings, with_overrides, with_settings
from shapecat.errors import ConfigError


def test_command_line_overrides_file_and_file_overrides_defaults(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text("seed = 3\n[tracking]\ngate_m = 1\nfusion = 'vote'\n")

    settings = load_settings(path, ["tracking.gate_m=0.5"])

    assert settings.seed == 3
    assert settings.tracking.gate_m == 0.5
    assert settings.tracking.fusion == "vote"
    assert settings.surface == Settings().surface


@pytest.mark.parametrize(
    ("text", "overrides"),
    [
        ("seed = " + "[" * 50_000, []),
        (f"seed{'.a' * 4_000} = 1", []),
        ("", ["seed=" + "[" * 100_000]),
        ("", [f"seed{'.a' * 30_000}=1"]),
    ],
)
def test_deeply_nested_settings_are_refused(
    tmp_path: Path, text: str, overrides: list[str]
) -> None:
    """TOML and JSON allow any nesting, and Python has an error of its own for it."""
    (tmp_path / "s.toml").write_text(text)

    # From Python 3.13 on, there is no such error for a dictionary.
    with pytest.raises(ConfigError, match=r"nested too deeply|got \{'a': .*\.\.\.") as caught:
        load_settings(tmp_path / "s.toml", overrides)
    assert len(str(caught.value)) < 200


def test_numbers_of_numpy_are_settings() -> None:
    """A number computed from an image would be refused: float64 "must be a number"."""
    given = {
        "max_range_m": np.float64(1.5),
        "max_size_m": np.float32(0.5),
        "min_points": np.int64(9),
    }

    settings = with_settings(Settings(), {"seed": np.uint8(3), "detection": given})

    assert json.dumps(settings.as_dict()) == json.dumps(
        with_settings(
            Settings(),
            {"seed": 3, "detection": {"max_range_m": 1.5, "max_size_m": 0.5, "min_points": 9}},
        ).as_dict()
    )
    with pytest.raises(ConfigError, match="min_points must be an integer"):
        with_settings(Settings(), {"detection": {"min_points": np.float64(9)}})


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("tracking.gat_m=1", "did you mean tracking.gate_m"),
        ("nonsense=1", "known: seed"),
        ("tracking.gate_m=wide", "must be a number"),
        ("tracking.gate_m=-1", "must not be negative"),
        ("tracking.gate_m=NaN", "must be finite"),
        (f"tracking.gate_m=1{400 * '0'}", "tracking.gate_m is too large"),
        (f"tracking.gate_m=-1{400 * '0'}", "tracking.gate_m is too large"),
        (f"detection.min_points=1{400 * '0'}", "detection.min_points is too large"),
        (f"seed=1{5000 * '0'}", "must be an integer"),
        ("tracking.gate_m=true", "must be a number"),
        ("outputs.markers=False", "must be true or false, got 'False'"),
        ("tracking.fusion=median", "must be one of mean"),
        ("tracking=1", "group of settings"),
        ("max_range_m=4", "unknown setting max_range_m; did you mean detection.max_range_m?"),
        ("surface.neurons=513", "surface.neurons must be from 20 to 512, got 513"),
        ("surface.voxel_m=0", "surface.voxel_m must be from 0.0001 to 0.02, got 0.0"),
        ("surface.voxel_m=0.5", "to 0.02, got 0.5"),  # all objects would be unknown
        ("surface.neurons=3", "from 20 to 512, got 3"),  # all objects would be unknown
        ("detection.max_height_m=0.02", "from 0.025 to 10.0, got 0.02"),  # no object would be found
        ("tracking.gate_m=120", "from 0.001 to 10.0, got 120"),  # millimetres
        ("surface.signals=6", "must be at least 100, got 6"),  # all objects would be unknown
        ("surface.smooth_radius_m=1.0", "to 0.1, got 1.0"),
        ("surface.smooth_radius_m=1e-9", "if not 0, must be from 0.0001"),
        ("tracking.gate_m", "expected name=value"),
        ("=1", "--set =1: expected name=value"),
    ],
)
def test_error_names_invalid_setting(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        with_overrides(Settings(), [override])


def test_smoothing_within_voxels_is_refused() -> None:
    """Hardly any voxel has neighbours that near: without points, all objects are unknown."""
    with pytest.raises(ConfigError, match=r"at least 1\.5 times surface\.voxel_m, got 0\.003"):
        with_overrides(Settings(), ["surface.smooth_radius_m=0.003"])


def test_smoothing_radius_of_one_and_a_half_voxels_is_accepted() -> None:
    """Quotients of decimal fractions round to just below 1.5, as 0.018 / 0.012 does."""
    for tenths in range(1, 201):
        voxel_m, just, below = (round(tenths * k * 1e-4, 7) for k in (1, 1.5, 1.49))
        given = {"voxel_m": voxel_m, "smooth_radius_m": just}
        assert with_settings(Settings(), {"surface": given}).surface.smooth_radius_m == just
        with pytest.raises(ConfigError):
            with_settings(Settings(), {"surface": {**given, "smooth_radius_m": below}})


def test_settings_that_fit_together_may_be_given_in_any_order() -> None:
    overrides = ["surface.smooth_radius_m=0.0045", "surface.voxel_m=0.003"]  # just in the range

    settings = with_overrides(Settings(), overrides)

    assert settings == with_overrides(Settings(), overrides[::-1])
    assert (settings.surface.smooth_radius_m, settings.surface.voxel_m) == (0.0045, 0.003)


def test_last_of_several_values_of_setting_counts() -> None:
    """Scripts pass their defaults first, and then what their user gave."""
    overrides = ["tracking.gate_m=0.2", "seed=1", "tracking.fusion=vote", "tracking.gate_m=0.3"]

    settings = with_overrides(Settings(), overrides)

    assert (settings.tracking.gate_m, settings.tracking.fusion) == (0.3, "vote")


def test_file_may_begin_with_byte_order_mark(tmp_path: Path) -> None:
    """Editors on Windows write a byte order mark."""
    path = tmp_path / "s.toml"
    path.write_bytes(b"\xef\xbb\xbfseed = 3\r\n")

    assert load_settings(path).seed == 3


@pytest.mark.parametrize("content", [b"a = ", b"\xff\xfe", b"seed = 1" + 5000 * b"0", None])
def test_unreadable_file_is_config_error(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "s.toml"
    if content is not None:
        path.write_bytes(content)

    with pytest.raises(ConfigError, match=r"s\.toml"):
        load_settings(path)


def test_settings_outside_schema_are_refused() -> None:
    """`detection.max_size_m=0`, meant as no limit, would reject every object without a word."""
    schema = json.loads(files("shapecat.schemas").joinpath("run.json").read_text("utf-8"))
    accepted = []
    for group, part in schema["$defs"]["settings"]["properties"].items():
        for name, field in part.get("properties", {"": part}).items():
            whole, setting = field.get("type") == "integer", ".".join(filter(None, (group, name)))
            outside = [
                field[key] + side if whole else math.nextafter(field[key], side * math.inf)
                for key, side in (("minimum", -1), ("maximum", 1))
                if key in field
            ]
            for value in outside:
                with suppress(ConfigError):
                    with_overrides(Settings(), [f"{setting}={value}"])
                    accepted.append(f"{setting}={value}")

    assert accepted == []


def test_limits_of_schema_are_accepted() -> None:
    """The schema documents the limits; other programs check settings by it."""
    schema = json.loads(files("shapecat.schemas").joinpath("run.json").read_text("utf-8"))
    for group, part in schema["$defs"]["settings"]["properties"].items():
        for name, field in part.get("properties", {"": part}).items():
            if field.get("type") in {"integer", "number"}:
                setting = ".".join(filter(None, (group, name)))
                for value in (field["minimum"], field.get("maximum", 10**12)):
                    with_overrides(Settings(), [f"{setting}={value}"])


def test_as_dict_has_every_field() -> None:
    """The stored settings must be enough to repeat a run."""
    settings = changed(Settings())

    assert with_settings(Settings(), settings.as_dict()) == settings


def changed(settings: Any) -> Any:
    """Return settings that all differ from their defaults."""
    values: dict[str, Any] = {}
    for name, kind in get_type_hints(type(settings)).items():
        value = getattr(settings, name)
        if dataclasses.is_dataclass(value):
            values[name] = changed(value)
        elif get_origin(kind) is Literal:
            values[name] = next(choice for choice in get_args(kind) if choice != value)
        elif kind is bool:
            values[name] = not value
        else:
            others = (value + 1,) if kind is int else (2 * value, 0.1, 1.0)
            values[name] = next(other for other in others if accepts(settings, name, other))
    return dataclasses.replace(settings, **values)


def accepts(settings: Any, name: str, value: float) -> bool:
    """Return whether one setting may be changed to another value without changing others."""
    with suppress(ConfigError):
        return bool(dataclasses.replace(settings, **{name: value}) != settings)
    return False
