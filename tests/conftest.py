"""Shared fixtures: the installed command, real data if present, a simulated recording."""

import gc
import hashlib
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, wait
from copy import deepcopy
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from shapecat.executors.ordered_pool import OrderedPool
from shapecat.system.files import FSYNC, holding
from shapecat.system.garbage import collect_seldom
from tests.browser import Browser

LONGEST = (
    *("test_report_serve", "test_remote", "test_report", "test_batch", "test_odd", "test_stopping"),
    *("test_command_line", "test_second_look", "test_crash", "test_detection"),
    *("test_simulation_worlds", "test_evaluation", "test_exports_images", "test_pipeline"),
    *("test_review", "test_tracking", "test_resuming", "test_api", "test_labelling_loop"),
    *("test_executors", "test_architecture", "test_exports", "test_label_transfer"),
    *("test_colour_motion", "test_detection_stacks", "test_detection_shelf", "test_gravity"),
    *("test_jit", "test_exports_readback", "test_reuse", "test_tracking_scenes"),
    *("test_depth_fusion", "test_packaging", "test_rehearsal", "test_learning"),
)
"""Test files by duration, longest first."""
TOGETHER = {
    "test_report_serve": "test_report",  # a browser and pictures of a run
    "test_report_counts": "test_report",
    "test_simulation_camera": "test_simulation_worlds",  # Open3D, which takes seconds to load
    "test_evaluation_dataset": "test_simulation_worlds",
}
"""Test files that run in the process of another one, with which they share something costly."""
SHARED = Path(__file__).parents[2] / "shared" / "data"


def pytest_configure() -> None:
    """Obey interrupts even in a background job, skip fsync, and seldom collect garbage.

    Only `test_run_folder` and `tests.faults` need fsync. Collecting garbage would take a third of
    the time of importing all tests.
    """
    collect_seldom()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.setdefault(FSYNC, "0")


def pytest_unconfigure() -> None:
    """Exclude all objects from the garbage collections at the end, which would take seconds."""
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the longest files first, so that all workers end at about the same time.

    A worker runs whole files, because of their fixtures.
    """
    rank = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give each worker whole files, as ``--dist loadfile`` does, and those of `TOGETHER` as one."""
    if config.getvalue("dist") != "loadfile":
        return None

    def unit_of(test: str) -> str:
        file = test.partition("::")[0]
        name = Path(file).stem
        return file.replace(name, TOGETHER.get(name, name))

    scheduling: Any = import_module("xdist.scheduler").LoadFileScheduling(config, log)
    scheduling._split_scope = unit_of
    return scheduling


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Return the folder of real sensor data, which is not part of the repository."""
    if not SHARED.is_dir():
        pytest.skip("no real sensor data on this machine")
    return SHARED


@pytest.fixture(scope="session")
def shapecat() -> Callable[..., Result]:
    """Return a function that runs the command in this process, as if the machine had one core.

    With more cores, worker processes would start for each short recording, only to end before they
    have loaded.
    """
    command: Any = import_module("shapecat.cli.main").main

    def run(*arguments: object) -> Result:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("shapecat.executors.cores.usable_cores", lambda: 1)
            result = CliRunner().invoke(command, list(map(str, arguments)))
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return run


@pytest.fixture
def all_awake(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start all processes of a job before its first frame, so that they share its frames.

    Otherwise the first would process a short recording before the others have loaded.
    """
    begin = OrderedPool.start

    def begin_and_wait(self: OrderedPool[Any, Any]) -> None:
        begin(self)
        wait(self._warming_up)

    monkeypatch.setattr("shapecat.executors.ordered_pool._ITEMS_BEFORE_START", 0)
    monkeypatch.setattr(OrderedPool, "start", begin_and_wait)


class LateAnswer(Future[Any]):
    """An answer of another process that arrives only when the caller waits for it."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        super().__init__()
        self._call = deepcopy((function, arguments))  # as if it was pickled
        self.set_running_or_notify_cancel()

    def exception(self, timeout: float | None = None) -> BaseException | None:
        """Do the work, unless it is done."""
        if not self.done():
            function, arguments = self._call
            self.set_result(function(*arguments))
        return super().exception(timeout)


class LateExecutor(Executor):
    """Replaces `LocalExecutor`: starts at once, and runs calls in this process, on copies."""

    def __init__(self, _workers: int, **_options: int) -> None:
        self._awake = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **_options: Any) -> Future[Any]:
        """Return the answer to a call; the first call, which warms up a process, is not run."""
        answer = LateAnswer(fn, *args)
        if not self._awake:
            answer.set_result(None)
        self._awake = True
        return answer

    def terminate(self) -> None:
        """Discard unfinished calls, as killed processes do."""


@pytest.fixture
def late_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Send all frames, even the first one, to a `LateExecutor`, as if to a slow process."""
    monkeypatch.setattr("shapecat.executors.ordered_pool._ITEMS_BEFORE_START", 0)
    monkeypatch.setattr("shapecat.executors.ordered_pool.LocalExecutor", LateExecutor)


class Guesser:
    """Replaces the model in tests of other parts: guesses from the descriptor."""

    categories = ("cup", "can", "box", "bottle", "bowl", "plate", "ball")
    model_id = "guesser"

    def require_descriptor(self, names: Any) -> None:
        """Accept any descriptor."""

    def predict(self, descriptors: Any) -> Any:
        """Return deterministic posteriors and constant novelty."""
        x = np.nan_to_num(np.asarray(descriptors, np.float64))
        logits = x @ np.random.default_rng(0).normal(0, 0.3, (x.shape[1], len(self.categories)))
        logits -= logits.max(axis=1, keepdims=True)
        share = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
        return SimpleNamespace(posteriors=share.astype(np.float32), novelty=0.5 + 0 * share[:, 0])


@pytest.fixture(scope="session")
def guessed_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Process a short simulated recording, with guessed categories. Tests change only copies."""
    return guess_once("guessed", tmp_path_factory, frames=8, rrd=False)


def guess_once(
    name: str, factory: pytest.TempPathFactory, *, rrd: bool = True, **scene: Any
) -> Path:
    """Simulate a recording and process it with a `Guesser`, once for all test processes.

    ``name`` is that of the parent folder, ``scene`` are arguments of `simulate`. Return the run.
    """
    import shapecat.pipeline
    from shapecat.runs.jobs import Job
    from shapecat.simulation import simulate

    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    folder.mkdir(exist_ok=True)
    run = folder / "out" / "table"
    with holding(folder), pytest.MonkeyPatch.context() as patch:
        if not run.exists():
            source = simulate(folder / "table.mcap", seed=7, **scene)
            patch.setattr(shapecat.pipeline, "load_model", lambda _path: Guesser())
            shapecat.pipeline.process(Job(source=source, folder=run, rrd=rrd))
    return run


@pytest.fixture
def run(guessed_run: Path, tmp_path: Path) -> Path:
    """Return a copy of `guessed_run` that a test may change."""
    folder = tmp_path / "out" / "table"
    shutil.copytree(guessed_run, folder)
    return folder


@pytest.fixture(scope="session")
def drawn(guessed_run: Path) -> Any:
    """Return the `RunReport` of `guessed_run`, whose pictures are drawn once for all tests.

    The page shows the labels in its ``folder``; `replace` that to show the labels of a copy.
    """
    from shapecat.outputs.report.writing import read_report

    return read_report(guessed_run)


@pytest.fixture(scope="module")
def snapped_once() -> Iterator[None]:
    """Snap the same masks to the same image only once, for all exports of a test file."""
    from shapecat.colour.snapping import snapped

    cache: dict[str, Any] = {}

    def look_up(masks: Any, pixels: Any, scale: float) -> Any:
        digest = hashlib.sha256(repr((pixels.shape, scale)).encode())
        for part in (pixels, *(part for mask in masks for part in (mask.box, mask.pixels))):
            digest.update(np.ascontiguousarray(part).tobytes())
        key = digest.hexdigest()
        if key not in cache:
            cache[key] = snapped(masks, pixels, scale)
        return cache[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("shapecat.outputs.exports.dataset_frames.snapped", look_up)
        yield


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the pictures out of reports: they take half a second per run."""
    from shapecat.outputs.report.pictures import Pictures

    monkeypatch.setattr(
        "shapecat.outputs.report.writing.take_pictures", lambda *_: Pictures({}, ())
    )


@pytest.fixture(scope="session")
def reported_run(guessed_run: Path, drawn: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of `guessed_run` with its report. Tests change only copies of it."""
    from shapecat.outputs.report.writing import Reports

    folder = tmp_path_factory.mktemp("reported") / "out" / "table"
    shutil.copytree(guessed_run, folder)
    Reports([replace(drawn, folder=folder)]).write()
    return folder


@pytest.fixture(scope="module")
def undisturbed(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Process a test file's recording without interruption; return the parent folder of the run."""
    from shapecat.pipeline import process
    from shapecat.runs.jobs import Job

    out = tmp_path_factory.mktemp("undisturbed")
    process(Job(recording, out / "table", rrd=False))
    return out


@pytest.fixture(scope="session")
def coloured_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Process four simulated frames with a colour camera; the categories are guesses.

    Tests change only copies of the run.
    """
    return guess_once("coloured", tmp_path_factory, frames=4, color=True)


@pytest.fixture(scope="module")
def few_trees() -> Iterator[None]:
    """Grow a tenth of the trees of the baseline forests, whose accuracy does not matter here."""
    from sklearn.ensemble import RandomForestClassifier

    def grow(trees: int, **options: Any) -> Any:
        return RandomForestClassifier(trees // 10, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("shapecat.evaluation.baseline_classifiers.RandomForestClassifier", grow)
        yield


@pytest.fixture(scope="session")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Start a headless Chromium; skip the test if there is none."""
    opened = Browser(tmp_path_factory.mktemp("browser"))
    yield opened
    opened.close()


@pytest.fixture
def browser(chromium: Browser) -> Browser:
    """Open an empty tab, without the tabs and console messages of other tests."""
    chromium.reset()
    return chromium
