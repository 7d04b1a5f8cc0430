"""Tests that the documentation matches commands, settings and links."""

import ast
import re
from collections.abc import Callable
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import Result

from shapecat import config
from shapecat.config import Settings, with_overrides
from shapecat.errors import ConfigError
from shapecat.outputs.exports import formats
from shapecat.runs.tables.schemas import TABLES

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def commands() -> dict[str, click.Command]:
    group: Any = import_module("shapecat.cli.main").main
    found: dict[str, click.Command] = group.commands
    return found


@pytest.mark.parametrize("name", sorted(commands()))
def test_help_of_every_command_has_an_example(shapecat: Callable[..., Result], name: str) -> None:
    result = shapecat(name, "--help")

    assert result.exit_code == 0
    assert re.search(rf"^ *shapecat {name} \S", result.stdout, re.MULTILINE), "no example"
    for parameter in commands()[name].params:
        if isinstance(parameter, click.Option):
            assert parameter.help or parameter.name in {"seed", "scene", "sensor"}, parameter.name


@pytest.mark.parametrize("name", ["", *sorted(commands())])
def test_help_fits_terminal_of_80_columns(
    shapecat: Callable[..., Result], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A terminal breaks longer lines of examples and of lists of choices in mid-word."""
    monkeypatch.setenv("COLUMNS", "80")
    lines = shapecat(*name.split(), "--help").stdout.splitlines()

    assert [line for line in lines if len(line) > 80] == []


def test_root_help_truncates_no_description(shapecat: Callable[..., Result]) -> None:
    """Click ends descriptions that are too long with dots."""
    assert "..." not in shapecat("--help").stdout.partition("Commands:")[2]


@pytest.mark.parametrize(
    ("command", "option"), [("simulate", "scene"), ("simulate", "sensor"), ("export", "kind")]
)
def test_help_explains_each_choice(
    shapecat: Callable[..., Result], command: str, option: str
) -> None:
    choice = next(p.type for p in commands()[command].params if p.name == option)
    assert isinstance(choice, click.Choice)
    lines = shapecat(command, "--help").stdout.splitlines()

    assert [c for c in choice.choices if not any(x.startswith(f"  {c}  ") for x in lines)] == []


@pytest.mark.parametrize(
    ("command", "option", "registry"),
    [
        ("simulate", "scene", ("shapecat.simulation.scenes.kinds", "SCENES")),
        ("simulate", "sensor", ("shapecat.simulation.camera.presets", "PRESETS")),
        ("export", "kind", ("shapecat.outputs.exports.formats", "FORMATS")),
        ("export", "kind", ("shapecat.outputs.exports.formats", "DATASETS")),
    ],
)
def test_command_offers_what_the_library_has(
    command: str, option: str, registry: tuple[str, str]
) -> None:
    """Commands repeat the names, so that ``--help`` loads nothing heavy."""
    choice = next(p.type for p in commands()[command].params if p.name == option)
    assert isinstance(choice, click.Choice)

    names = set(getattr(import_module(registry[0]), registry[1])) - {"empty"}  # a scene of tests
    assert names <= set(choice.choices)


def test_command_knows_the_formats_with_boxes() -> None:
    """A format missing here would be exported with visible boxes, although help says full."""
    command = import_module("shapecat.cli.export")
    assert set(command._BOX_FORMATS) == set(formats.BOX_FORMATS)


def documented_commands() -> list[tuple[str, str]]:
    return [
        (page.name, line.split("#")[0].strip())
        for page in PAGES
        for block in re.findall(r"```.*?```", page.read_text("utf-8"), re.DOTALL)
        for line in block.splitlines()
        if re.match(r"^ *shapecat [a-z]", line)
    ]


@pytest.mark.parametrize(("page", "line"), documented_commands())
def test_documented_commands_and_options_exist(page: str, line: str) -> None:
    words = [word for word in line.split() if word not in {"\\", "…", "..."}]
    command = commands()[words[1]]
    known = {name for parameter in command.params for name in parameter.opts}
    options = {word.split("=")[0] for word in words[2:] if word.startswith("--")}

    assert options <= known, f"{page}: {line}"


def documented_settings() -> dict[str, list[str]]:
    """Return default, range and meaning of each setting in the reference, by name."""
    page = (ROOT / "docs" / "reference.md").read_text("utf-8")
    table = page.partition("## Settings")[2].partition("###")[0]
    rows = [line[2:-2].split(" | ") for line in table.splitlines() if line.startswith("| `")]
    return {name.strip("`"): [default.strip("`"), *others] for name, default, *others in rows}


def setting_rows() -> list[tuple[str, str, str]]:
    """Return name, default and meaning of each setting, from the source."""
    defaults = Settings().as_dict()
    rows = [("seed", str(defaults["seed"]), "fixes every random choice")]
    source = ast.parse(Path(config.__file__).read_text("utf-8"))
    classes = {node.name: node for node in source.body if isinstance(node, ast.ClassDef)}
    for group, values in defaults.items():
        if not isinstance(values, dict):
            continue
        body = classes[f"{group.capitalize().removesuffix('s')}Settings"].body
        for line, text in pairwise(body):
            if isinstance(line, ast.AnnAssign) and isinstance(text, ast.Expr):
                name, meaning = (
                    ast.unparse(line.target),
                    " ".join(ast.literal_eval(text.value).split()),
                )
                default = str(values[name]).replace("False", "false")  # as in TOML
                rows.append((f"{group}.{name}", default, meaning))
    return rows


def test_reference_lists_every_setting_with_default() -> None:
    found = documented_settings()
    expected = setting_rows()
    count = 1 + sum(
        len(group) for group in Settings().as_dict().values() if isinstance(group, dict)
    )
    assert len(expected) == count, "a setting without a docstring"
    assert {name for name, *_ in expected} <= found.keys(), "docs/reference.md lacks settings"
    for name, default, meaning in expected:
        assert [found[name][0], found[name][2]] == [default, meaning]


@pytest.mark.parametrize(("name", "row"), documented_settings().items())
def test_reference_lists_range_of_every_setting(name: str, row: list[str]) -> None:
    """The ends of a range, or all choices, are allowed; what is beyond the ends is not."""
    default, limits, _ = row
    choices = re.findall("`([^`]+)`", limits)
    ends = [float(number) for number in re.findall(r"[0-9.]+", limits)]
    number = float if "." in default else int
    for value in [default, *choices, *map(number, ends)]:
        with_overrides(Settings(), [f"{name}={value}"])
    assert choices or ends
    steps = {ends[0]: -1, **({ends[-1]: 1} if len(ends) > 1 else {})} if ends else {}
    for value in ["some", *(number(end + step) for end, step in steps.items())]:
        with pytest.raises(ConfigError):
            with_overrides(Settings(), [f"{name}={value}"])


def test_reference_lists_phases_of_progress() -> None:
    phases = ", ".join(f"`{name}`" for name in import_module("shapecat.cli.progress")._SHARES)

    assert f"`phase` ({phases})" in (ROOT / "docs" / "reference.md").read_text("utf-8")


@pytest.mark.parametrize("name", sorted(TABLES))
def test_tables_page_describes_every_column(name: str) -> None:
    page = (ROOT / "docs" / "tables.md").read_text("utf-8")
    section = page.partition(f"## {name}.parquet")[2].partition("\n## ")[0]

    assert [column for column in TABLES[name].names if f"`{column}`" not in section] == []


def test_links_between_pages_resolve() -> None:
    for page in [*PAGES, ROOT / "ARCHITECTURE.md", ROOT / "CONTRIBUTING.md"]:
        for target in re.findall(r"\]\((?!http)([^)#]+)\)", page.read_text("utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_documented_make_targets_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]:
        for target in re.findall(r"`make ([a-z-]+)`", page.read_text("utf-8")):
            assert target in targets, f"{page.name}: make {target}"
