"""The report of a run as one HTML page that needs no other file, and the index of several runs."""

import hashlib
import json
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from shapecat.arrays import F8
from shapecat.outputs.colours import hex_colour
from shapecat.outputs.counts import by_count, count_words, plural, size_words
from shapecat.outputs.report.cards import (
    Card,
    TrackCounts,
    asset,
    card_html,
    count_cards,
    frame_html,
    template,
)
from shapecat.outputs.report.pictures import StripFrame
from shapecat.runs.finished import FinishedRun
from shapecat.runs.labels.track_table import TrackTable
from shapecat.types import CATEGORIES, UNKNOWN

__all__ = ["Listed", "index_page", "run_page"]

_SCRIPTS = ("labels.js", "meaning.js", "saving.js", "cards.js", "frames.js", "keys.js")


@dataclass(frozen=True)
class Listed:
    """A run in the index.

    ``link`` is the address of its page, ``info`` the content of its run.json, and ``warnings`` the
    number of warnings on its page; ``faces`` are pictures of some of its tracks as data URIs.
    """

    link: str
    name: str
    info: Mapping[str, Any]
    tally: TrackCounts
    warnings: int
    faces: tuple[str, ...]


def run_page(
    finished: FinishedRun,
    cards: Sequence[Card],
    frames: Sequence[StripFrame],
    stages: Mapping[str, F8],
    *,
    length_s: float,
    notes: Sequence[str] = (),
    index: str | None = None,
    served: bool = False,
) -> str:
    """Return the page of a run.

    Parameters
    ----------
    cards : the tracks, in the order of the table.
    frames : the frames of the strip.
    stages : (n,) seconds of each stage in the frames in which it ran.
    length_s : time from the first to the last frame, seconds.
    notes : warnings to show after those of the run.
    index : link to the index of several runs; None if there is none.
    served : whether corrections are sent to a server; if not, the page offers a table to download.
    """
    run = finished.info
    tally = count_cards(cards, finished.labels)
    names = (UNKNOWN, *finished.categories)
    end = max((float(c.timeline.seconds[-1]) for c in cards if len(c.timeline.seconds)), default=0)
    connect = "'self'" if served else "'none'"
    return template("page.html").substitute(
        title=escape(finished.name),
        head=_head(finished.name, f"; script-src 'unsafe-inline'; connect-src {connect}"),
        script="\n".join(map(asset, _SCRIPTS)),
        back=f'<a href="{escape(index)}">all runs</a> ·' if index else "",
        subtitle=escape(_subtitle(run)),
        tiles=_tiles(
            {
                "frames": run["counts"]["frames"],
                "length": f"{length_s:.1f} s",
                "detections": run["counts"]["detections"],
                "tracks": tally.categories.total(),
                "uncertain": tally.unsure,
            }
        ),
        warnings=_warnings([*run["warnings"], *notes]),
        strip=_strip(frames, cards),
        chips=_chips(finished, cards, tally),
        cards="".join(card_html(card, run["model"]["categories"], names, end) for card in cards),
        empty="No track fits this filter." if cards else "No objects were found.",
        next=_next_step(finished, served=served),
        timings=_timings(run["seconds"], stages),
        facts=_facts(run),
        glossary=asset("glossary.html"),
        names="".join(f'<option value="{escape(name)}">' for name in names),
        data=_data(names, run, finished.table, served=served),
    )


def index_page(title: str, runs: Sequence[Listed], notes: Sequence[str] = ()) -> str:
    """Return the page that lists several runs, with warnings above them."""
    total = sum((item.tally.categories for item in runs), Counter[str]())
    tiles = {
        "recordings": len(runs),
        "frames": sum(int(item.info["counts"]["frames"]) for item in runs),
        "tracks": total.total(),
        "uncertain": sum(item.tally.unsure for item in runs),
        "checked": sum(item.tally.checked for item in runs),
    }
    return template("index.html").substitute(
        head=_head(title),
        title=escape(title),
        subtitle=escape(count_words(total, "no tracks")),
        tiles=_tiles(tiles),
        warnings=_warnings(notes),
        runs="".join(map(_listed, runs)),
    )


def _head(title: str, scripts: str = "") -> str:
    """Return the head of a page; ``scripts`` are added to its content security policy."""
    filled = template("head.html").substitute(
        title=escape(title), style=asset("report.css"), scripts=scripts
    )
    return filled.rstrip("\n")


def _subtitle(run: Mapping[str, Any]) -> str:
    topics = ", ".join(run["options"]["topics"])
    return f"{run['input']['path']} · {size_words(run['input']['bytes'])} · {topics}"


def _tiles(values: Mapping[str, Any]) -> str:
    return "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(str(value))}</dd></div>"
        for name, value in values.items()
    )


def _warnings(texts: Sequence[str]) -> str:
    items = "".join(f"<li>⚠ {escape(text)}</li>" for text in texts)
    return f'<ul class="warnings">{items}</ul>' if items else ""


def _strip(frames: Sequence[StripFrame], cards: Sequence[Card]) -> str:
    """Return the strip of frames; empty if there are none."""
    if not frames:
        return ""
    categories = {card.row.track: card.row.category for card in cards}
    several = len({frame.topic for frame in frames}) > 1
    items = "".join(frame_html(frame, categories, several=several) for frame in frames)
    return f'<section class="strip" id="strip" aria-label="Frames">{items}</section>'


def _chips(finished: FinishedRun, cards: Sequence[Card], tally: TrackCounts) -> str:
    """Return a filter for each category that a track has, in the order of the run's categories."""
    deleted = {card.row.category for card in cards if card.row.track not in finished.labels}
    filters = tally.categories.keys() | deleted  # a deleted track keeps its filter
    names = (UNKNOWN, *finished.categories)
    ordered = [name for name in names if name in filters] + sorted(filters - set(names))
    return "".join(_chip(name, tally.categories[name]) for name in ordered)


def _chip(name: str, count: int) -> str:
    return (
        f'<button type="button" class="chip" data-category="{escape(name)}" aria-pressed="true" '
        f'style="--c:{hex_colour(name)}"><span class="dot"></span>{escape(name)} <b>{count}</b>'
        "</button>"
    )


def _next_step(finished: FinishedRun, *, served: bool) -> str:
    """Return instructions for writing the corrections to the other outputs."""
    annotate = f"shapecat annotate {shlex.quote(str(finished.folder))}"
    if served:
        text, command = "Corrections are already in tracks.csv.", annotate
    else:
        text = "Download the table first."
        command = f"{annotate} --labels ~/Downloads/tracks-….csv"
    return (
        f"{text} To write the corrections to annotated.mcap, review.rrd and later exports, run "
        f'<code id="command" data-annotate="{escape(annotate)}">{escape(command)}</code>'
    )


def _timings(phases: Mapping[str, float], stages: Mapping[str, F8]) -> str:
    lines = [_line("th", "stage, per frame", "median, ms", "95th percentile, ms")]
    for name, values in stages.items():
        middle, high = np.percentile(values, [50, 95]) * 1000 if len(values) else (0.0, 0.0)
        lines.append(_line("td", name, f"{middle:.1f}", f"{high:.1f}"))
    lines.append(_line("th", "phase", "total, s", ""))
    last = sorted(phases.items(), key=lambda phase: phase[0] == "total")
    lines += [_line("td", name, f"{seconds:.1f}", "") for name, seconds in last]
    return f"<table>{''.join(lines)}</table>"


def _line(kind: str, *cells: str) -> str:
    return "<tr>" + "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in cells) + "</tr>"


def _facts(run: Mapping[str, Any]) -> str:
    skipped = ", ".join(f"{n} {reason}" for reason, n in run["counts"]["skipped"].items())
    up = run["up"] or {}
    colours = dict.fromkeys(filter(None, run["color"].values()))
    facts = {
        "model": run["model"]["id"],
        "categories": ", ".join(run["model"]["categories"]),
        "fixed frame": run["fixed_frame"] or "none: tracks are in the sensor frame",
        "up": str(up.get("source", "")),
        "colour images": ", ".join(colours) or "none",
        "skipped frames": skipped or "none",
        "shapecat": run["versions"]["shapecat"],
        "python": run["versions"].get("python", ""),
        "input digest": run["input"]["digest"],
    }
    return "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(str(value))}</dd>" for name, value in facts.items()
    )


def _data(names: Sequence[str], run: Mapping[str, Any], table: TrackTable, *, served: bool) -> str:
    """Return the data for the script as JSON, escaped so that it cannot end the script element."""
    rows = [
        {
            "track": str(row.track),
            "category": row.category,
            "label": row.label,
            "cells": [row.cells.get(name, "") for name in table.columns],
        }
        for row in table.rows
    ]
    content = {
        "columns": table.columns,
        "rows": rows,
        "categories": names,
        "known": [UNKNOWN, *CATEGORIES, *run["model"]["categories"]],
        "oneFrame": run["fixed_frame"] is not None,
        "colours": {name: hex_colour(name) for name in names},
        "served": served,
        "key": _key(run, table),
    }
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
    return re.sub(r"[<>&\u2028\u2029]", lambda match: f"\\u{ord(match[0]):04x}", text)


def _key(run: Mapping[str, Any], table: TrackTable) -> str:
    """Return the name under which a browser stores corrections; all pages of a run share it."""
    tracks = sorted(row.track for row in table.rows)
    return hashlib.sha256(json.dumps([run.get("work", ""), tracks]).encode()).hexdigest()[:16]


def _listed(item: Listed) -> str:
    share = "".join(
        f'<span style="--c:{hex_colour(name)};--n:{count}" title="{escape(name)} {count}"></span>'
        for name, count in by_count(item.tally.categories)
    )
    words = count_words(item.tally.categories, "no tracks")
    seconds = item.info["seconds"].get("total", 0.0)
    notes = [plural(item.info["counts"]["frames"], "frame"), f"processed in {seconds:.1f} s"]
    notes += [f"{item.tally.unsure} uncertain"] if item.tally.unsure else []
    notes += [f"{item.tally.checked} checked"] if item.tally.checked else []
    faces = "".join(f'<img alt="" src="{face}">' for face in item.faces)
    warnings = plural(item.warnings, "warning")
    warn = f' · <span class="warn">⚠ {warnings}</span>' if item.warnings else ""
    return (
        f'<a class="run" href="{escape(item.link)}"><div><h3>{escape(item.name)}</h3>'
        f'<p class="muted">{escape(" · ".join(notes))}{warn}</p></div>'
        f'<div><div class="share">{share}</div><p class="muted">{escape(words)}</p>'
        f'</div><div class="faces">{faces}</div></a>'
    )
