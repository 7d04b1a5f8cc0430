"""``report.html`` of each run, and ``index.html`` over many."""

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from urllib.parse import quote

from shapecat.arrays import F8
from shapecat.outputs.report.cards import Card, is_unsure
from shapecat.outputs.report.choosing import choose_frames
from shapecat.outputs.report.page import Listed, index_page, run_page
from shapecat.outputs.report.pictures import Pictures, take_pictures
from shapecat.outputs.report.tracks import Timeline, read_stage_seconds, read_timelines
from shapecat.outputs.rereading import find_runs, read_finished
from shapecat.runs.track_table import TrackTable, read_track_table
from shapecat.system.files import replacing

__all__ = ["INDEX", "PAGE", "Reports", "RunReport", "read_report", "read_reports", "write_reports"]

Observer = Callable[[str, int, int | None], None]

PAGE, INDEX = "report.html", "index.html"
_FACES = 6


def _ignore(_phase: str, _done: int, _total: int | None) -> None:
    """Observe nothing."""


@dataclass(frozen=True)
class RunReport:
    """What a page tells of a run, but for the labels: those are read when it is written.

    ``index`` links to the page over many runs.
    """

    folder: Path
    timelines: Mapping[int, Timeline]
    pictures: Pictures
    stages: Mapping[str, F8]
    index: str | None = None

    def page(self, *, served: bool = False) -> str:
        """Return the page with the labels on disk.

        Parameters
        ----------
        served : its corrections go to a server, not to a table to download.

        Raises
        ------
        OutputError : the tracks.csv of the run cannot be understood.
        """
        table, reason = self._table, self.pictures.reason
        notes = [f"surfaces are drawn from their meshes, without points: {reason}"]
        return run_page(
            read_finished(self.folder),
            table,
            self._cards(table),
            self.pictures.frames,
            self.stages,
            notes=notes if reason else [],
            index=self.index,
            served=served,
        )

    def listed(self, link: str) -> Listed:
        """Return how an index lists the run."""
        finished, cards = read_finished(self.folder), self._cards(self._table)
        return Listed(
            link=link,
            name=finished.name,
            run=finished.run,
            categories=Counter(label.category for label in finished.labels.values()),
            unsure=sum(card.row.label == "" and is_unsure(card.row) for card in cards),
            checked=sum(card.row.label != "" for card in cards),
            faces=_faces(cards),
        )

    @property
    def _table(self) -> TrackTable:
        return read_track_table(self.folder / "tracks.csv")

    def _cards(self, table: TrackTable) -> list[Card]:
        return [
            Card(row, self.timelines[row.track], self.pictures.tracks.get(row.track))
            for row in table.rows
            if row.track in self.timelines
        ]


@dataclass(frozen=True)
class Reports:
    """The reports of some runs, and whether an index lists them in the folder above all."""

    runs: Sequence[RunReport]
    indexed: bool = False

    @cached_property
    def above(self) -> Path:
        """The folder that holds all of the runs."""
        return _above([report.folder for report in self.runs])

    def link(self, report: RunReport) -> str:
        """Return the address of a page, relative to the folder above all."""
        return _link(self.above, report.folder / PAGE)

    def index(self) -> str:
        """Return the page that lists the runs, with the labels on disk."""
        listed = [report.listed(self.link(report)) for report in self.runs]
        return index_page(self.above.name, listed)

    def write(self) -> list[Path]:
        """Write all pages, the index last, and return them.

        Raises
        ------
        OutputError : a page cannot be written, or a tracks.csv cannot be understood.
        """
        pages = {report.folder / PAGE: report.page() for report in self.runs}
        if self.indexed:
            pages[self.above / INDEX] = self.index()
        for page, text in pages.items():
            with replacing(page) as path:
                path.write_text(text, "utf-8")
        return list(pages)


def read_reports(folders: Sequence[Path], observe: Observer = _ignore) -> Reports:
    """Read what the reports of runs show.

    Parameters
    ----------
    folders : runs, or folders of runs; an index lists them unless it is one run.

    Raises
    ------
    OutputError : a folder holds no run, or the tables of one cannot be understood.
    """
    runs = find_runs(folders)
    indexed = len(runs) > 1 or any(folder not in runs for folder in folders)
    index = _above(runs) / INDEX
    reports = []
    for done, run in enumerate(runs, start=1):
        reports.append(read_report(run, index=_link(run, index) if indexed else None))
        observe("report", done, len(runs))
    return Reports(reports, indexed)


def write_reports(folders: Sequence[Path], observe: Observer = _ignore) -> list[Path]:
    """Write report.html into each run, and an index.html above them; return the pages."""
    return read_reports(folders, observe).write()


def read_report(folder: Path, *, index: str | None = None) -> RunReport:
    """Read what the report of one run shows.

    Pictures come from the recording; where that is gone, surfaces are drawn from their meshes.

    Raises
    ------
    OutputError : not a finished run, or a tracks.csv that cannot be understood.
    """
    finished = read_finished(folder)
    rows = read_track_table(folder / "tracks.csv").rows
    timelines = read_timelines(folder)
    pictures = take_pictures(finished, rows, choose_frames(folder, timelines))
    return RunReport(folder, timelines, pictures, read_stage_seconds(folder), index)


def _above(runs: Sequence[Path]) -> Path:
    return Path(os.path.commonpath([run.resolve().parent for run in runs]))


def _link(start: Path, target: Path) -> str:
    return quote(Path(os.path.relpath(target.resolve(), start.resolve())).as_posix())


def _faces(cards: Sequence[Card]) -> tuple[str, ...]:
    """Return a picture of the surest track of each category, then of others."""
    sure = sorted(cards, key=lambda card: -card.row.confidence)
    first = {card.row.category: card for card in reversed(sure)}
    chosen = [*first.values(), *(card for card in sure if card not in first.values())]
    return tuple(card.pictures.surfaces[0].image for card in chosen[:_FACES] if card.pictures)
