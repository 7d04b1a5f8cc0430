"""Options that several commands share, each as one decorator."""

from pathlib import Path

import click

EXISTING = click.Path(exists=True, path_type=Path)
ANY_PATH = click.Path(path_type=Path)

json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
config_option = click.option(
    "--config", type=ANY_PATH, help="Settings in TOML; unknown names are refused."
)
set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="NAME=VALUE",
    help="Change one setting, for example detection.max_range_m=1.5. Repeatable.",
)
model_option = click.option(
    "--model", type=ANY_PATH, help="Model file; the default model is shipped with the package."
)
seed_option = click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
