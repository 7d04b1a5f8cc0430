"""Write ``report.html`` of each run, and ``index.html`` of several."""

import errno
import json
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from urllib.parse import quote, unquote

from shapecat.arrays import F8
from shapecat.errors import OutputError, explained, listed
from shapecat.outputs.colours import colour_of
from shapecat.outputs.counts import plural
from shapecat.outputs.report.cards import Card, count_cards
from shapecat.outputs.report.choosing import choose_frames
from shapecat.outputs.report.page import Listed, index_page, run_page
from shapecat.outputs.report.pictures import Pictures, take_pictures
from shapecat.outputs.report.surfaces import recoloured
from shapecat.outputs.report.tracks import Timeline, read_length, read_stage_seconds, read_timelines
from shapecat.runs.finished import find_runs, read_finished
from shapecat.runs.folder import require_work
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.runs.labels.track_table import TrackTable
from shapecat.system.files import replacing
from shapecat.system.progress import Observer, ignore, observed

__all__ = ["INDEX", "PAGE", "Reports", "RunReport", "read_report", "read_reports"]

PAGE, INDEX = "report.html", "index.html"
_MANIFEST = "manifest.jsonl"
"""The file in which a batch records the state of each recording."""
_MARK = b'<p class="kicker">shapecat report</p>'
"""Text that marks an index.html as made by shapecat, in any version."""
_FACES = 6
_REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS)


@dataclass(frozen=True)
class RunReport:
    """The content of a run's page, except the labels, which are read when the page is made.

    Attributes
    ----------
    work : the id ``work`` in run.json, which shows whether the run has been replaced.
    stages : (n,) seconds of each stage in the frames in which it ran.
    length_s : time from the first to the last frame, seconds.
    index : link to the index of several runs; None if there is none.
    """

    folder: Path
    work: str
    timelines: Mapping[int, Timeline]
    pictures: Pictures
    stages: Mapping[str, F8]
    length_s: float
    index: str | None = None

    def page(self, *, served: bool = False) -> str:
        """Return the page with the current labels in tracks.csv.

        Parameters
        ----------
        served : whether corrections are sent to a server; if not, the page offers a table to
            download.

        Raises
        ------
        OutputError : the tracks.csv of the run is invalid, or the run has been replaced.
        """
        require_work(self.folder, self.work)
        finished = read_finished(self.folder)
        return run_page(
            finished,
            self._cards(finished.table),
            self.pictures.frames,
            self.stages,
            length_s=self.length_s,
            notes=self._notes,
            index=self.index,
            served=served,
        )

    def listed(self, link: str) -> Listed:
        """Return the entry of the run in an index; ``link`` is the address of its page.

        Raises
        ------
        OutputError : the tracks.csv of the run is invalid, or the run is gone.
        """
        finished = read_finished(self.folder)
        cards = self._cards(finished.table)
        return Listed(
            link=link,
            name=finished.name,
            info=finished.info,
            tally=count_cards(cards, finished.labels),
            warnings=len(finished.info["warnings"]) + len(self._notes),
            faces=_faces(cards, finished.labels),
        )

    @property
    def _notes(self) -> list[str]:
        """Warnings about the page, in addition to those of the run."""
        reason = self.pictures.reason
        return [f"surfaces are drawn from their meshes, without points: {reason}"] if reason else []

    def _cards(self, table: TrackTable) -> list[Card]:
        return [
            Card(row, self.timelines[row.track], self.pictures.tracks.get(row.track))
            for row in table.rows
            if row.track in self.timelines
        ]


@dataclass(frozen=True)
class Reports:
    """The reports of runs; ``indexed`` says whether there is an index in their common folder.

    ``failed`` holds the error of each run that could not be read.
    """

    runs: Sequence[RunReport]
    indexed: bool = False
    failed: Mapping[Path, OutputError] = field(default_factory=dict)

    @cached_property
    def above(self) -> Path:
        """The deepest folder that contains all runs, relative if the first run is."""
        folders = [*(report.folder for report in self.runs), *self.failed]
        above, first = _above(folders), folders[0]
        return above if first.is_absolute() else Path(os.path.relpath(above))

    def link(self, report: RunReport) -> str:
        """Return the address of a page, relative to the common folder."""
        return _link(self.above, _place(report.folder) / PAGE)

    def index(self) -> str:
        """Return the page that lists the runs, with their current labels.

        A run that is gone or has an invalid table is left out; its own page says why. Runs of the
        same name are listed with their folders. A warning names the recordings that failed.
        """
        cards = []
        for report in self.runs:
            with suppress(OutputError):
                cards.append(report.listed(self.link(report)))
        count = Counter(card.name for card in cards)
        names = (str(Path(unquote(c.link)).parent) if count[c.name] > 1 else c.name for c in cards)
        entries = [replace(card, name=name) for card, name in zip(cards, names, strict=True)]
        failed = _failed_recordings(self.above / _MANIFEST) - {r.folder.name for r in self.runs}
        note = f"{plural(len(failed), 'recording')} failed: {listed(sorted(failed))} ({_MANIFEST})"
        return index_page(self.above.resolve().name, entries, [note] if failed else [])

    def write(self) -> list[Path]:
        """Write all pages, the index last, and return their paths.

        Raises
        ------
        OutputError : the existing index is not from shapecat (then nothing is written); or a page
            cannot be written, a tracks.csv is invalid, or a run has been replaced (then the other
            pages are written).
        """
        pages: dict[Path, Callable[[], str]] = {r.folder / PAGE: r.page for r in self.runs}
        if self.indexed and self.runs:
            _require_ours(self.above / INDEX)
            pages[self.above / INDEX] = self.index
        failures = []
        for page, make in pages.items():
            try:
                text = make()
                with replacing(page) as path:
                    path.write_text(text, "utf-8")
            except OutputError as error:
                refused = isinstance(error.__cause__, OSError) and error.__cause__.errno in _REFUSED
                hint = "; copy the folder to a place where you may write" if refused else ""
                failures.append(OutputError(f"{error}{hint}"))
        if failures:
            raise failures[0]
        return list(pages)


def read_reports(folders: Sequence[Path], observe: Observer = ignore) -> Reports:
    """Read the content of the report page of each run, and of their index.

    Runs that cannot be read are listed in ``failed`` of the result.

    Parameters
    ----------
    folders : runs, or folders of runs. There is no index if the only folder is a run.
    observe : called with the phase, the number of runs read, and the total.

    Raises
    ------
    OutputError : a folder holds no run.
    """
    runs = find_runs(folders)
    indexed = len(runs) > 1 or any(folder not in runs for folder in folders)
    index = _above(runs) / INDEX
    reports, failed = [], {}
    for run in observed(runs, "report", len(runs), observe):
        try:
            reports.append(read_report(run, index=_link(_place(run), index) if indexed else None))
        except OutputError as error:
            failed[run] = error
    return Reports(reports, indexed, failed)


def read_report(folder: Path, *, index: str | None = None) -> RunReport:
    """Read the content of the report of one run.

    Pictures come from the recording. If it cannot be read, surfaces are drawn from their meshes.
    ``index`` is the link from the page to the index of several runs; None if there is none.

    Raises
    ------
    OutputError : the folder is not a finished run, or its tracks.csv is invalid.
    """
    finished = read_finished(folder)
    timelines = read_timelines(folder)
    pictures = take_pictures(finished, choose_frames(folder, timelines))
    work, stages = finished.info["work"], read_stage_seconds(folder)
    return RunReport(folder, work, timelines, pictures, stages, read_length(folder), index)


def _failed_recordings(manifest: Path) -> set[str]:
    """Return the folder names of recordings that failed in a batch; empty without a manifest."""
    states: dict[str, str] = {}
    with suppress(OSError), manifest.open("rb") as lines:
        for line in lines:
            with suppress(ValueError, TypeError, KeyError, RecursionError):  # truncated by a crash
                entry = json.loads(line)
                states[str(entry["folder"])] = entry["state"]
    return {folder for folder, state in states.items() if state == "failed"}


def _require_ours(index: Path) -> None:
    with explained(f"{index}: cannot be written", OutputError):
        if not index.exists() or _MARK in index.read_bytes():
            return
    msg = f"{index}: shapecat did not make this; move it away, or name only one run"
    raise OutputError(msg)


def _above(runs: Sequence[Path]) -> Path:
    return Path(os.path.commonpath([_place(run).parent for run in runs]))


def _place(run: Path) -> Path:
    """Return the absolute path of a run folder, without resolving it if it is a link."""
    absolute = Path(os.path.abspath(run))  # noqa: PTH100  `resolve` would follow the link
    return absolute.parent.resolve() / absolute.name


def _link(start: Path, target: Path) -> str:
    return quote(Path(os.path.relpath(target, start)).as_posix())


def _faces(cards: Sequence[Card], labels: Mapping[int, TrackLabel]) -> tuple[str, ...]:
    """Return up to `_FACES` pictures: the most certain object of each category, then others.

    Pictures are data URIs, ``labels`` the final labels. Of merged tracks, the one that keeps its
    number is preferred.
    """
    pictures: dict[TrackLabel, str] = {}
    shown = [card for card in cards if card.pictures and card.row.track in labels]
    for card in sorted(shown, key=lambda card: card.row.track != labels[card.row.track].track):
        if card.pictures:
            pictures.setdefault(labels[card.row.track], card.pictures.surfaces[0].image)
    first: dict[str, str] = {}
    repeated = []
    for label, drawn in sorted(pictures.items(), key=lambda face: -face[0].confidence):
        image = recoloured(drawn, colour_of(label.category))
        if first.setdefault(label.category, image) is not image:
            repeated.append(image)
    return (*first.values(), *repeated)[:_FACES]
