"""HTML for the card of a track and for a frame of the strip."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import files
from string import Template
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8, I4, Bool
from shapecat.outputs.colours import hex_colour
from shapecat.outputs.counts import plural
from shapecat.outputs.report.pictures import StripFrame, TrackPictures
from shapecat.outputs.report.surfaces import SIDE, SurfaceDrawing
from shapecat.outputs.report.tracks import Timeline
from shapecat.outputs.wording import confidence_text, time_span
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.runs.labels.track_table import TrackRow
from shapecat.types import UNKNOWN

__all__ = ["Card", "TrackCounts", "asset", "card_html", "count_cards", "frame_html", "template"]

_LINES = 3  # categories in a timeline
_MOST_STEPS = 80  # points of each line in a timeline
_DIGITS = 9  # the last digit key
_ROOMY = 4  # largest number of boxes whose full labels fit in a frame of the strip


@dataclass(frozen=True)
class Card:
    """The content of a track's card; ``pictures`` is None if there are none."""

    row: TrackRow
    timeline: Timeline
    pictures: TrackPictures | None


@cache
def asset(name: str) -> str:
    """Return the text of a file that is part of the page."""
    return (files("shapecat.outputs.report") / name).read_text("utf-8")


def template(name: str) -> Template:
    """Return a file that is part of the page, as a template to fill in."""
    return Template(asset(name))


class TrackCounts(NamedTuple):
    """Counts of the tracks of a run by their final labels; `cards.js` counts in the same way.

    ``categories`` counts merged tracks as one and omits deleted ones. ``unsure`` is the number of
    uncertain tracks without a label, ``checked`` that of tracks with a label, both before merging.
    """

    categories: Counter[str]
    unsure: int
    checked: int


def count_cards(cards: Sequence[Card], labels: Mapping[int, TrackLabel]) -> TrackCounts:
    """Count the tracks of the cards; ``labels`` are their final labels."""
    objects = {labels[card.row.track] for card in cards if card.row.track in labels}
    return TrackCounts(
        Counter(label.category for label in objects),
        unsure=sum(card.row.label == "" and _is_unsure(card.row) for card in cards),
        checked=sum(card.row.label != "" for card in cards),
    )


def _is_unsure(row: TrackRow) -> bool:
    """Return whether a track should be checked first: its category is unknown or uncertain."""
    return row.category == UNKNOWN or row.confidence < 0.8


def card_html(card: Card, categories: Sequence[str], names: Sequence[str], end: float) -> str:
    """Return the card of a track.

    Parameters
    ----------
    categories : the categories of the model, in the order of the posterior.
    names : all categories, unknown first; the digit keys 0 to 9 assign the first ten.
    end : time at the end of the last track, seconds since the first frame.
    """
    row, line = card.row, card.timeline
    return template("card.html").substitute(
        track=row.track,
        category=escape(row.category),
        guess=_guess(row),
        value=f"{row.confidence:.4g}",
        unsure="1" if _is_unsure(row) else "",
        first=f"{line.seconds[0] if len(line.seconds) else 0.0:.4g}",
        colour=hex_colour(row.category),
        confidence=confidence_text(row.confidence),
        pictures=_pictures(card),
        line=_time_line(line, categories, end),
        bars=_bars(line, categories, row, names),
        facts=escape(" · ".join(_facts(card))),
    )


def _guess(row: TrackRow) -> str:
    """Return HTML with the most likely category of an unknown object; empty for other objects."""
    guess = row.cells.get("guess", "")
    if row.category != UNKNOWN or not guess:
        return ""
    return f'<span class="guess">perhaps {escape(guess)}</span>'


def _pictures(card: Card) -> str:
    if card.pictures is None:
        return ""
    sides = "".join(map(_side, card.pictures.surfaces))
    crop = card.pictures.crop
    if crop is None:
        return sides
    name = f"#{card.row.track} in a frame"
    return (
        f'<button type="button" class="crop" title="{name}"><img alt="{name}" '
        f'src="{crop.image}"><svg viewBox="0 0 {crop.width} {crop.height}" aria-hidden="true">'
        f'<path d="{crop.outline}"/></svg></button>{sides}'
    )


def _side(picture: SurfaceDrawing) -> str:
    return (
        f'<div class="side" title="{picture.title}"><img alt="surface {picture.title}" '
        f'src="{picture.image}"><svg viewBox="0 0 {SIDE} {SIDE}" aria-hidden="true">'
        f'<path d="{picture.edges}"/><path class="nodes" d="{picture.neurons}"/></svg></div>'
    )


def _facts(card: Card) -> list[str]:
    line, cells = card.timeline, card.row.cells
    view_seconds = line.seconds[line.seen]
    facts = [plural(len(view_seconds), "view")]
    if len(view_seconds):
        facts.append(time_span(float(view_seconds[0]), float(view_seconds[-1])))
    if card.pictures:
        facts.append(" × ".join(f"{100 * side:.0f}" for side in card.pictures.size) + " cm")
    if cells.get("novelty"):
        facts.append(f"novelty {cells['novelty']}")
    return facts


def _bars(line: Timeline, categories: Sequence[str], row: TrackRow, names: Sequence[str]) -> str:
    """Return a button for each category, the most likely first, with a bar for its posterior.

    ``categories`` and ``names`` are as in `card_html`. A category of the track that is not in
    ``categories``, except unknown, has the last button.
    """
    shares = dict(zip(categories, line.fused.tolist(), strict=False))
    order = sorted(shares, key=lambda name: -shares[name])
    if row.category not in shares and row.category != UNKNOWN:
        order.append(row.category)
    return "".join(_bar(name, shares.get(name, 0), _digit(name, names)) for name in order)


def _digit(name: str, names: Sequence[str]) -> str:
    place = names.index(name) if name in names else _DIGITS + 1
    return str(place) if place <= _DIGITS else ""


def _bar(name: str, share: float, digit: str) -> str:
    key = f"<kbd>{digit}</kbd>" if digit else "<span></span>"
    style = f"--c:{hex_colour(name)};--w:{share:.1%}"
    return (
        f'<li><button type="button" tabindex="-1" data-label="{escape(name)}" style="{style}">'
        f"{key}<span>{escape(name)}</span><i></i><span>{confidence_text(share)}</span>"
        "</button></li>"
    )


def _time_line(line: Timeline, categories: Sequence[str], end: float) -> str:
    """Return an SVG plot of the `_LINES` highest causal posteriors above the times of detection.

    It is empty if ``end`` is 0, as for a single frame.
    """
    if end <= 0:
        return ""
    chosen = _few(len(line.seconds))
    if len(chosen) == 1:
        chosen = chosen.repeat(2)  # a line with one point is not drawn
    x = np.round(300 * line.seconds[chosen] / end, 1)
    best = np.argsort(-line.causal.max(axis=0, initial=0), kind="stable")[:_LINES]
    lines = []
    for k in best[::-1].tolist():
        if k >= len(categories) or not len(x):
            continue
        y = np.round(33 - 31 * line.causal[chosen, k], 1)
        dots = " ".join(f"{a:g},{b:g}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
        lines.append(f'<polyline points="{dots}" stroke="{hex_colour(categories[k])}"/>')
    bars = "".join(
        f'<rect class="seen" x="{a:.1f}" y="38" width="{max(b - a, 1.5):.1f}" height="3" rx="1"/>'
        for a, b in _spans(line.seconds, line.seen, 300 / end)
    )
    return (
        '<svg class="line" viewBox="0 0 300 44" preserveAspectRatio="none" role="img" '
        'aria-label="posterior over time"><title>posterior over time; the bar below shows when '
        "the object was seen"
        f'</title><path class="grid" d="M0 2H300M0 33H300"/>{"".join(lines)}{bars}</svg>'
    )


def _few(count: int) -> I4:
    """Return at most `_MOST_STEPS` of ``count`` indices, evenly spaced from first to last."""
    return np.unique(np.linspace(0, count - 1, min(count, _MOST_STEPS)).round().astype(int))


def _spans(seconds: F8, visible: Bool, scale: float) -> list[tuple[float, float]]:
    """Return start and end, multiplied by ``scale``, of each interval of unbroken detection.

    ``seconds`` and ``visible`` are ``seconds`` and ``seen`` of a `Timeline`.
    """
    changes = np.diff(visible.astype(int), prepend=0, append=0)
    starts, ends = np.flatnonzero(changes == 1), np.flatnonzero(changes == -1) - 1
    return [(seconds[a] * scale, seconds[b] * scale) for a, b in zip(starts, ends, strict=True)]


def frame_html(frame: StripFrame, categories: Mapping[int, str], *, several: bool) -> str:
    """Return a frame of the strip with the boxes and labels of its tracks.

    Parameters
    ----------
    categories : the category of each track to show.
    several : whether the run has several topics, so that the caption names the topic.
    """
    name = f"{frame.seconds:.2f} s" + (f" {frame.topic}" if several else "")
    name += ", shaded depth" if frame.shaded else ""
    boxes = "".join(
        _box(frame, track, box, categories[track])
        for track, box in frame.boxes.items()
        if track in categories
    )
    kind = "frame" if len(frame.boxes) <= _ROOMY else "frame crowded"
    style = f"--ratio:{frame.width / frame.height:.4f}"
    return (
        f'<button type="button" class="{kind}" style="{style}" data-name="{escape(name)}" '
        f'aria-label="Frame at {escape(name)}"><span class="shot"><img alt="" src="{frame.image}">'
        f'{boxes}</span><span class="caption">{escape(name)}</span></button>'
    )


def _box(
    frame: StripFrame, track: int, box: tuple[float, float, float, float], category: str
) -> str:
    left, width = (100 * side / frame.width for side in box[::2])
    top, height = (100 * side / frame.height for side in box[1::2])
    style = f"left:{left:.1f}%;top:{top:.1f}%;width:{width:.1f}%;height:{height:.1f}%"
    return (
        f'<span class="box" data-track="{track}" style="{style};--c:{hex_colour(category)}">'
        f"<b>#{track}<i> {escape(category)}</i></b></span>"
    )
