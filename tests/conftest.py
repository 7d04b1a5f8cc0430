"""What tests share: the command as installed, real data when present, a simulated recording."""

from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

SHARED = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Return the folder of real sensor data, which is not part of the repository."""
    if not SHARED.is_dir():
        pytest.skip("no real sensor data on this machine")
    return SHARED


@pytest.fixture(scope="session")
def shapecat() -> Callable[..., Result]:
    """Run the command through its entry point, as a user would."""
    (script,) = entry_points(group="console_scripts", name="shapecat")
    command: Any = script.load()

    def run(*arguments: object) -> Result:
        result = CliRunner().invoke(command, list(map(str, arguments)))
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return run
