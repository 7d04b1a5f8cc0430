"""The report of a run as one HTML page that works from a file; and the index over many."""

import hashlib
import json
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

from shapecat.arrays import F8, Bool
from shapecat.outputs.colours import colour_of
from shapecat.outputs.report_drawing import SIDE, Picture
from shapecat.outputs.report_tracks import Course
from shapecat.outputs.rereading import FinishedRun
from shapecat.runs.track_table import TrackRow, TrackTable

__all__ = ["Card", "Listed", "index_page", "is_unsure", "run_page"]

_LINES = 3  # categories in a time line
_MOST_STEPS = 80


@dataclass(frozen=True)
class Card:
    """A track as the gallery shows it; ``size`` (3,) of its box in metres, if it is known."""

    row: TrackRow
    course: Course
    pictures: tuple[Picture, ...]
    size: tuple[float, float, float] | None


@dataclass(frozen=True)
class Listed:
    """A run as the index lists it; ``link`` to its report, ``faces`` some of its pictures."""

    link: str
    name: str
    run: Mapping[str, Any]
    categories: Counter[str]
    unsure: int
    checked: int
    faces: tuple[str, ...]


def run_page(
    finished: FinishedRun,
    table: TrackTable,
    cards: Sequence[Card],
    stages: Mapping[str, F8],
    *,
    notes: Sequence[str] = (),
    index: str | None = None,
) -> str:
    """Return the page of a run.

    Parameters
    ----------
    cards : the tracks, in the order of ``table``.
    stages : seconds of each frame by stage.
    notes : warnings beside those of the run.
    index : link to the index over many runs.
    """
    run = finished.run
    counts = Counter(card.row.category for card in cards)
    names = ("unknown", *finished.categories)
    end = max(
        (float(card.course.seconds[-1]) for card in cards if len(card.course.seconds)), default=0
    )
    return _template("report_page.html").substitute(
        title=escape(finished.name),
        style=_text("report.css"),
        script=_text("report.js"),
        back=f'<a href="{escape(index)}">all runs</a> ·' if index else "",
        subtitle=escape(_subtitle(run)),
        tiles=_tiles(_run_tiles(run, len(cards), sum(is_unsure(c.row) for c in cards), end)),
        warnings=_warnings([*run["warnings"], *notes]),
        chips="".join(_chip(name, counts[name]) for name in _ordered(counts, names)),
        cards="".join(_card(card, run["model"]["categories"], end) for card in cards),
        command=escape(
            f"shapecat annotate {shlex.quote(str(finished.folder))} --labels tracks.csv"
        ),
        timings=_timings(run["seconds"], stages),
        facts=_facts(run),
        names="".join(f'<option value="{escape(name)}">' for name in names),
        data=_data(finished, table),
    )


def index_page(title: str, runs: Sequence[Listed]) -> str:
    """Return the page that lists many runs."""
    total = sum((item.categories for item in runs), Counter[str]())
    tiles = {
        "recordings": len(runs),
        "frames": sum(int(item.run["counts"]["frames"]) for item in runs),
        "tracks": total.total(),
        "worth a look": sum(item.unsure for item in runs),
        "looked at": sum(item.checked for item in runs),
    }
    return _template("report_index.html").substitute(
        title=escape(title),
        style=_text("report.css"),
        subtitle=escape(", ".join(f"{n} {name}" for name, n in total.most_common())),
        tiles=_tiles(tiles),
        runs="".join(map(_listed, runs)),
    )


@cache
def _text(name: str) -> str:
    return (files("shapecat.outputs") / name).read_text("utf-8")


def _template(name: str) -> Template:
    return Template(_text(name))


def _css(category: str) -> str:
    return "#" + "".join(f"{part:02x}" for part in colour_of(category))


def _ordered(counts: Mapping[str, int], names: Sequence[str]) -> list[str]:
    return [name for name in names if name in counts] + sorted(set(counts) - set(names))


def is_unsure(row: TrackRow) -> bool:
    """Return whether a track is worth a look before others."""
    return row.category == "unknown" or row.confidence < 0.8


def _subtitle(run: Mapping[str, Any]) -> str:
    topics = ", ".join(run["options"]["topics"])
    return f"{run['input']['path']} · {run['input']['bytes'] / 1e6:.1f} MB · {topics}"


def _run_tiles(run: Mapping[str, Any], tracks: int, unsure: int, end: float) -> dict[str, Any]:
    return {
        "frames": run["counts"]["frames"],
        "length": f"{end:.1f} s",
        "detections": run["counts"]["detections"],
        "tracks": tracks,
        "worth a look": unsure,
    }


def _tiles(values: Mapping[str, Any]) -> str:
    return "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(str(value))}</dd></div>"
        for name, value in values.items()
    )


def _warnings(texts: Sequence[str]) -> str:
    items = "".join(f"<li>⚠ {escape(text)}</li>" for text in texts)
    return f'<ul class="warnings">{items}</ul>' if items else ""


def _chip(name: str, count: int) -> str:
    return (
        f'<button type="button" class="chip" data-category="{escape(name)}" aria-pressed="true" '
        f'style="--c:{_css(name)}"><span class="dot"></span>{escape(name)} <b>{count}</b></button>'
    )


def _card(card: Card, categories: Sequence[str], end: float) -> str:
    row, course = card.row, card.course
    first = float(course.seconds[0]) if len(course.seconds) else 0.0
    return _template("report_card.html").substitute(
        track=row.track,
        category=escape(row.category),
        guess=_guess(row),
        confidence=f"{row.confidence:.4g}",
        first=f"{first:.4g}",
        colour=_css(row.category),
        percent=f"{row.confidence:.0%}",
        sides="".join(map(_side, card.pictures)),
        line=_time_line(course, categories, end),
        bars=_bars(course, categories, row),
        facts=escape(" · ".join(_track_facts(card))),
    )


def _guess(row: TrackRow) -> str:
    """Return what an unknown object might be; nothing for the others."""
    guess = row.cells.get("guess", "")
    if row.category != "unknown" or not guess:
        return ""
    return f'<span class="guess">perhaps {escape(guess)}</span>'


def _side(picture: Picture) -> str:
    return (
        f'<div class="side" title="{picture.title}"><img alt="{picture.title}" '
        f'src="{picture.image}"><svg viewBox="0 0 {SIDE} {SIDE}"><path d="{picture.edges}"/>'
        f'<path class="nodes" d="{picture.neurons}"/></svg></div>'
    )


def _track_facts(card: Card) -> list[str]:
    course, cells = card.course, card.row.cells
    seen = course.seconds[course.seen]
    facts = [f"{int(course.seen.sum())} views"]
    if len(seen):
        facts.append(f"{seen[0]:.1f}–{seen[-1]:.1f} s")
    if card.size:
        facts.append("×".join(f"{100 * side:.0f}" for side in card.size) + " cm")
    if cells.get("novelty"):
        facts.append(f"novelty {cells['novelty']}")
    return facts


def _bars(course: Course, categories: Sequence[str], row: TrackRow) -> str:
    """Return the posterior of all views, the likeliest category first; each bar is a button."""
    last = course.causal[-1] if len(course.causal) else np.zeros(len(categories))
    shares = dict(zip(categories, last.tolist(), strict=False))
    order = sorted(shares, key=lambda name: -shares[name])
    if row.category not in shares and row.category != "unknown":
        order.append(row.category)
    return "".join(
        f'<li><button type="button" data-label="{escape(name)}" '
        f'style="--c:{_css(name)};--w:{shares.get(name, 0):.0%}"><span>{escape(name)}</span><i></i>'
        f"<span>{shares.get(name, 0):.0%}</span></button></li>"
        for name in order
    )


def _time_line(course: Course, categories: Sequence[str], end: float) -> str:
    """Return the causal posterior over the time of the run, and below it when it was seen."""
    chosen = _few(len(course.seconds))
    x = np.round(300 * course.seconds[chosen] / (end or 1), 1)
    best = np.argsort(-course.causal.max(axis=0, initial=0), kind="stable")[:_LINES]
    lines = []
    for k in best[::-1].tolist():
        if k >= len(categories) or not len(x):
            continue
        y = np.round(33 - 31 * course.causal[chosen, k], 1)
        dots = " ".join(f"{a:g},{b:g}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
        lines.append(f'<polyline points="{dots}" stroke="{_css(categories[k])}"/>')
    seen = "".join(
        f'<rect class="seen" x="{a:.1f}" y="38" width="{max(b - a, 1.5):.1f}" height="3" rx="1"/>'
        for a, b in _spans(course.seconds, course.seen, 300 / (end or 1))
    )
    return (
        '<svg class="line" viewBox="0 0 300 44" preserveAspectRatio="none" role="img" '
        'aria-label="posterior over time"><path class="grid" d="M0 2H300M0 33H300"/>'
        f"{''.join(lines)}{seen}</svg>"
    )


def _few(count: int) -> F8:
    """Return at most `_MOST_STEPS` places of a row, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, _MOST_STEPS)).round().astype(int))


def _spans(seconds: F8, seen: Bool, scale: float) -> list[tuple[float, float]]:
    """Return from where to where the track was seen without a gap."""
    spans: list[tuple[float, float]] = []
    before = False
    for at, here in zip((seconds * scale).tolist(), seen.tolist(), strict=True):
        if here and before:
            spans[-1] = (spans[-1][0], at)
        elif here:
            spans.append((at, at))
        before = here
    return spans


def _timings(phases: Mapping[str, float], stages: Mapping[str, F8]) -> str:
    rows = [("stage, per frame", "median", "95 %", "")]
    for name, values in stages.items():
        middle, high = np.percentile(values, [50, 95]) * 1000 if len(values) else (0.0, 0.0)
        rows.append((name, f"{middle:.1f}", f"{high:.1f}", "ms"))
    rows.append(("phase", "in all", "", ""))
    rows += [(name, f"{seconds:.1f}", "", "s") for name, seconds in phases.items()]
    lines = []
    for cells in rows:
        kind = "th" if not cells[3] else "td"
        lines.append(
            "<tr>" + "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in cells) + "</tr>"
        )
    return f"<table>{''.join(lines)}</table>"


def _facts(run: Mapping[str, Any]) -> str:
    skipped = ", ".join(f"{n} {reason}" for reason, n in run["counts"]["skipped"].items())
    up = run["up"] or {}
    facts = {
        "model": run["model"]["id"],
        "categories": ", ".join(run["model"]["categories"]),
        "fixed frame": run["fixed_frame"] or "none: tracks are in the sensor frame",
        "up": str(up.get("source", "")),
        "skipped frames": skipped or "none",
        "shapecat": run["versions"]["shapecat"],
        "python": run["versions"].get("python", ""),
        "input digest": run["input"]["digest"],
    }
    return "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(str(value))}</dd>" for name, value in facts.items()
    )


def _data(finished: FinishedRun, table: TrackTable) -> str:
    """Return what the script needs; nothing in it can end the script element."""
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
        "categories": ["unknown", *finished.categories],
    }
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    text = json.dumps(content | {"key": key}, ensure_ascii=False, separators=(",", ":"))
    return re.sub(r"[<>&\u2028\u2029]", lambda found: f"\\u{ord(found[0]):04x}", text)


def _listed(item: Listed) -> str:
    share = "".join(
        f'<span style="--c:{_css(name)};--n:{count}" title="{count} {escape(name)}"></span>'
        for name, count in item.categories.most_common()
    )
    words = ", ".join(f"{count} {name}" for name, count in item.categories.most_common())
    warnings = len(item.run["warnings"])
    seconds = item.run["seconds"].get("total", 0.0)
    notes = [f"{item.run['counts']['frames']} frames", f"{seconds:.1f} s of work"]
    notes += [f"{item.unsure} worth a look"] if item.unsure else []
    notes += [f"{item.checked} looked at"] if item.checked else []
    faces = "".join(f'<img alt="" src="{face}">' for face in item.faces)
    warn = f' · <span class="warn">⚠ {warnings}</span>' if warnings else ""
    return (
        f'<a class="run" href="{escape(item.link)}"><div><h3>{escape(item.name)}</h3>'
        f'<p class="muted">{escape(" · ".join(notes))}{warn}</p></div>'
        f'<div><div class="share">{share}</div><p class="muted">{escape(words) or "no tracks"}</p>'
        f'</div><div class="faces">{faces}</div></a>'
    )
