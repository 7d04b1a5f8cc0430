"""Outputs of a comparison: metrics, a page with pictures, and a table of all objects."""

import json
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import pyarrow as pa

from shapecat.errors import OutputError, explained
from shapecat.evaluation.comparison.comparing import Comparison
from shapecat.evaluation.comparison.matching import Difference
from shapecat.evaluation.comparison.pictures import COLOURS, Caption, DifferenceImage, words_of
from shapecat.evaluation.markup import figure_text, html_table
from shapecat.outputs.counts import plural
from shapecat.outputs.wording import confidence_text
from shapecat.runs.tables.schemas import FRAME_COLUMNS
from shapecat.runs.tables.writing import write_table
from shapecat.system.files import complete_folder, partial_path, require_utf8
from shapecat.types import UNKNOWN

__all__ = [
    "OBJECTS",
    "figure_rows",
    "format_page",
    "place_captions",
    "prepare_new",
    "write_comparison",
]

_MOST_ROWS = 500
"""Maximum number of differences that the page lists."""
_LETTERS = 43
"""Width of a picture divided by the height of its letters."""
_LETTER_WIDTH, _LINE = 0.62, 1.15
"""Mean width of a letter, and distance between lines, relative to the height of a letter."""

OBJECTS = pa.schema(
    [
        *FRAME_COLUMNS,
        ("difference", pa.string()),
        ("true_track", pa.int64()),
        ("true_category", pa.string()),
        ("track", pa.int64()),
        ("category", pa.string()),
        ("confidence", pa.float32()),
        ("f", pa.float32()),
        ("iou", pa.float32()),
        ("box_iou", pa.float32()),
    ]
)
"""One row per true object, with the detection matched to it, and one per unmatched detection."""


def prepare_new(folder: Path) -> None:
    """Check that a folder is new or empty, and create its parent, before the work begins.

    Raises
    ------
    OutputError : the folder is not empty, has no valid name, or cannot be created.
    """
    partial_path(folder)  # raises if it has no name
    require_utf8(folder)
    with explained(f"{folder}: cannot be written", OutputError):
        taken = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
        folder.parent.mkdir(parents=True, exist_ok=True)
    if taken:
        msg = f"{folder}: exists already; choose another --out, or move it away"
        raise OutputError(msg)


def write_comparison(folder: Path, found: Comparison) -> None:
    """Write comparison.html, objects.parquet and comparison.json into a new folder.

    Raises
    ------
    OutputError : the folder is not empty, or cannot be written.
    """
    prepare_new(folder)
    columns = zip(*found.rows, strict=True) if found.rows else ([] for _ in Difference._fields)
    table = dict(zip(Difference._fields, map(list, columns), strict=True))
    failing = explained(f"{folder}: cannot be written", OutputError)
    with failing, complete_folder(folder) as hidden:
        write_table(hidden / "objects.parquet", table, OBJECTS)
        (hidden / "comparison.html").write_text(format_page(found), "utf-8")
        text = json.dumps(found.as_dict(), indent=1, ensure_ascii=False)
        (hidden / "comparison.json").write_text(text + "\n", "utf-8")


_Row = tuple[str, str, str]


def figure_rows(found: Comparison) -> list[_Row]:
    """Return name, value and explanation of each metric; undefined ones are left out, or ``–``."""
    figures, rows = found.figures, list[_Row]()
    frames, objects, category = (figures[n] for n in ("frames", "objects", "category"))
    detections = plural(objects["detections"], "detection")
    aside = [
        f"{frames[name]} only in the {words}"
        for name, words in (("only_in_run", "run"), ("only_in_reference", "reference"))
        if frames[name]
    ]
    rows.append(("frames", str(frames["compared"]), ", ".join(aside) or "the same in both"))
    rows.append(
        (
            "objects found",
            _percent(objects["share_found"]),
            f"{objects['found']} of {objects['true']}; {detections}",
        )
    )
    if overlap := figures["overlap"]:
        pair = f"precision {overlap['precision']:.3f}, recall {overlap['recall']:.3f} of pixels"
        rows.append(("overlap F", f"{overlap['f']:.3f}", pair))
    if category["n"]:
        rows += _category_rows(category)
    if figures["box_iou"]["n"]:
        boxes = figures["box_iou"]
        rows.append(
            ("box IoU", f"{boxes['mean']:.3f}", f"mean of {plural(boxes['n'], 'pair')}, in 3D")
        )
    if tracking := figures["tracking"]:
        rows += _tracking_rows(tracking)
    return rows


def _category_rows(category: dict[str, Any]) -> list[_Row]:
    most_frequent = ", ".join(
        f"{k['true']} as {k['label']} {k['n']}×" for k in category["taken_for"][:3]
    )
    return [
        (
            "category right",
            _percent(category["accuracy"]),
            f"of {plural(category['n'], 'matched object')}"
            + (f"; {most_frequent}" if most_frequent else ""),
        ),
        ("  single views", _percent(category["view_accuracy"]), "before fusion over the track"),
        ("calibration error", f"{category['ece']:.3f}", "ECE of single views; 0 is perfect"),
    ]


def _tracking_rows(tracking: dict[str, Any]) -> list[_Row]:
    nouns = {"misses": "miss", "false_positives": "false positive", "switches": "identity switch"}
    errors = ", ".join(plural(tracking[name], noun) for name, noun in nouns.items())
    parts = (
        f"detection {figure_text(tracking['detection_accuracy'])}, "
        f"association {figure_text(tracking['association_accuracy'])}"
    )
    return [
        ("IDF1", figure_text(tracking["idf1"]), "consistency of identities over time"),
        ("MOTA", figure_text(tracking["mota"]), errors),
        ("HOTA", figure_text(tracking["hota"]), parts),
    ]


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f} %"


def format_page(found: Comparison) -> str:
    """Return a comparison as an HTML page with embedded pictures."""
    differing = [row for row in found.rows if row.difference]
    several = len({row.topic for row in found.rows}) > 1
    rows = [_cells(row, with_topic=several) for row in differing[:_MOST_ROWS]]
    return _PAGE.substitute(
        title=escape(f"{Path(found.run).name} compared with {Path(found.reference).name}"),
        subtitle=escape(f"{found.run} · {found.reference} ({found.kind})"),
        notes="".join(f'<p class="note">{escape(note)}</p>' for note in found.notes),
        figures=html_table((), figure_rows(found)),
        legend="".join(
            f'<span><i style="background:rgb{colour}"></i>{name}</span>'
            for name, colour in zip(
                (
                    "both",
                    "missed: only in the reference",
                    "surplus (false positive): only in the run, or on another object",
                    "wrong category",
                ),
                COLOURS.values(),
                strict=True,
            )
        ),
        pictures="".join(map(_picture, found.pictures)) or "<p>No frame differs.</p>"
        if not differing or found.pictures
        else "<p>No pictures: the frames are not images.</p>",
        count=_count(differing),
        rows=html_table(_HEAD, rows) if rows else "",
    )


_HEAD = ("frame", "difference", "true", "found", "track", "confidence", "overlap F", "box IoU")


def _confidence(row: Difference) -> str:
    """Return the confidence as text; empty for an unknown object, and without a detection."""
    if row.confidence is None or row.category == UNKNOWN:
        return ""
    return confidence_text(row.confidence)


def _count(rows: Sequence[Difference]) -> str:
    more = f"; the first {_MOST_ROWS} are listed" if len(rows) > _MOST_ROWS else ""
    return f"{plural(len(rows), 'difference')}{more}"


def _cells(row: Difference, *, with_topic: bool) -> tuple[str, ...]:
    return (
        f"{row.topic} {row.frame}" if with_topic else str(row.frame),
        words_of(row),
        row.true_category or "",
        row.category or "",
        "" if row.track is None else f"#{row.track}",
        _confidence(row),
        "" if row.f is None else f"{row.f:.2f}",
        "" if row.box_iou is None else f"{row.box_iou:.2f}",
    )


def _picture(picture: DifferenceImage) -> str:
    letter = picture.width / _LETTERS
    texts = "".join(
        f'<text x="{x:.0f}" y="{y:.0f}">{escape(text)}</text>'
        for x, y, text in place_captions(picture.captions, letter, picture.width)
    )
    listed = "; ".join(words_of(row) for row in picture.rows)
    width, height = picture.width, picture.height
    return (
        f'<figure><svg viewBox="0 0 {width} {height}" style="font-size:{letter:.1f}px" role="img" '
        f'aria-label="{escape(listed)}"><image href="{picture.image}" width="{width}" '
        f'height="{height}"/>{texts}</svg><figcaption><b>{escape(picture.topic)} '
        f"frame {picture.frame}</b>: {escape(listed)}</figcaption></figure>"
    )


def place_captions(
    captions: Iterable[Caption], letter: float, width: int
) -> list[tuple[float, float, str]]:
    """Return middle x, baseline y and text of each caption; overlapping ones are moved down.

    Parameters
    ----------
    letter : height of the letters, pixels.
    width : width of the picture, pixels.
    """
    placed: list[tuple[float, float, str]] = []
    for caption in sorted(captions, key=lambda caption: caption.y):
        side = _LETTER_WIDTH * letter * len(caption.text) / 2
        x, y = min(max(caption.x, side), width - side), max(caption.y, letter)
        for x1, y1, text in sorted(placed, key=lambda place: place[1]):
            apart = _LETTER_WIDTH * letter * len(text) / 2 + side
            if abs(x - x1) < apart and abs(y - y1) < _LINE * letter:
                y = y1 + _LINE * letter
        placed.append((x, y, caption.text))
    return placed


_PAGE = Template(
    """<!DOCTYPE html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>$title</title><style>
body{font:15px/1.5 system-ui,sans-serif;max-width:70em;margin:2em auto;padding:0 1em;color:#222}
h1{margin-bottom:0}.sub,.note{color:#666}.note{border-left:3px solid #e65100;padding-left:.6em}
table{border-collapse:collapse;margin:1em 0}td,th{padding:.2em 1em .2em 0;text-align:left}
tr+tr{border-top:1px solid #ddd}td:first-child{white-space:pre}
td:nth-child(2){font-variant-numeric:tabular-nums}
.pictures{display:grid;grid-template-columns:repeat(auto-fill,minmax(26em,1fr));gap:1.2em}
figure{margin:0}figure svg{width:100%;border-radius:4px;display:block}
figcaption{font-size:13px;color:#444}
text{font:600 1em system-ui,sans-serif;fill:#fff;stroke:#000;stroke-width:.2em;paint-order:stroke;
text-anchor:middle}
.legend span{margin-right:1.5em}.legend i{display:inline-block;width:.9em;height:.9em;
border-radius:2px;margin-right:.4em;vertical-align:-1px}
</style><body><h1>$title</h1><p class="sub">$subtitle</p>$notes
$figures<h2>Frames that differ most</h2>
<p>The frame with the most differences in each twelfth of the run.</p>
<p class="legend">$legend</p><div class="pictures">$pictures</div>
<h2>Frame by frame</h2><p>$count. All objects are in objects.parquet.</p>$rows</body></html>
"""
)
