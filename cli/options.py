"""Options that several commands share, each as one decorator."""

import logging
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click


class _NonEmptyPath(click.Path):
    """A path that is not empty: an unset shell variable must not mean the current folder.

    ``~`` is the home folder even if the shell does not expand it, as in ``--out=~/results``.
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("the path is empty", param, ctx)
        of_home = isinstance(value, str) and value.partition("/")[0] == "~"
        if of_home:
            value = os.path.expanduser(value)  # noqa: PTH111  Path's raises without a home
        return super().convert(value, param, ctx)


class _LocalPath(_NonEmptyPath):
    """A path on this machine. URLs are refused: they would lose a slash and name a local folder."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        from shapecat.batch.storage import is_url

        if isinstance(value, str) and is_url(value):
            text = f"{value} is a URL; only RECORDING and --out of `process` may be URLs"
            self.fail(text, param, ctx)
        return super().convert(value, param, ctx)


ANY_PATH = _LocalPath(path_type=Path)
PATH_OR_URL = _NonEmptyPath(path_type=str, readable=False)


class _Seconds(click.FloatRange):
    """Seconds after the start of a recording: finite and not negative."""

    name = "seconds"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        seconds: float = super().convert(value, param, ctx)
        if not math.isfinite(seconds):
            self.fail(f"{value} is not a number of seconds", param, ctx)
        return seconds


SECONDS = _Seconds(min=0)

json_option = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
array_option = click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print a JSON array with an entry per recording; those that fail are left out.",
)
config_option = click.option(
    "--config", type=ANY_PATH, help="TOML file with settings; docs/reference.md lists them."
)
set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="NAME=VALUE",
    help="Change a setting, for example detection.max_range_m=1.5. Repeatable.",
)


def none_if_default(_ctx: click.Context, _param: click.Parameter, path: Path | None) -> Path | None:
    """Return None, which means shapecat's own model, for the name ``default``."""
    return None if path == Path("default") else path


model_option = click.option(
    "--model",
    type=ANY_PATH,
    callback=none_if_default,
    help="Model file; without it, or with `default`, the model that comes with shapecat is used.",
)


def _be_verbose(_ctx: click.Context, _param: click.Parameter, value: bool) -> None:  # noqa: FBT001  click's signature
    if value:
        logging.getLogger("shapecat").setLevel(logging.INFO)


verbose_option = click.option(
    "-v",
    "--verbose",
    is_flag=True,
    expose_value=False,
    callback=_be_verbose,
    help="Log each step to stderr.",
)
recording_option = click.option(
    "--recording", type=ANY_PATH, help="Path of the recording, if it was moved."
)


def choice_option(
    name: str, choices: Sequence[str], text: str, *, metavar: str | None = None
) -> Any:
    """Return an option with one of several values, by default the first.

    ``text`` is its help; ``metavar`` replaces a list of choices that is too long for a line.
    """
    return click.option(
        name,
        type=click.Choice(choices),
        default=choices[0],
        show_default=True,
        metavar=metavar,
        help=text,
    )


def boxes_option(where: str) -> Any:
    """Return the option ``--boxes``; ``where`` is its help, with ``{}`` for the values' meaning."""
    about = "boxes enclose whole objects (full) or their visible parts"
    return click.option("--boxes", type=click.Choice(["full", "visible"]), help=where.format(about))


seed_option = click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    metavar="N",
    help="Seed of the random generator.",
)
