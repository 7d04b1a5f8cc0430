"""Report of an evaluation: an HTML page with pictures, or Markdown with picture files."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from shapecat.errors import OutputError, explained
from shapecat.evaluation.markup import figure_text, html_table
from shapecat.evaluation.metrics import Bin
from shapecat.evaluation.report import (
    Ranges,
    Report,
    Rows,
    breakdown_table,
    comparison_tables,
)
from shapecat.system.files import replacing

__all__ = [
    "accuracy_svg",
    "calibration_svg",
    "confusion_svg",
    "format_markdown",
    "format_page",
    "write_page",
]

_CELL = 46
_MARGIN = 74
_LETTER = 7
"""Sizes in the confusion matrix, pixels: of a cell, the least margin, and the width of a letter."""
_INK = (31, 78, 121)
"""Colour of the pictures, RGB."""
_STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:52em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse;margin:1em 0}td,th{padding:.15em .8em;text-align:right}"
    "td:first-child,th:first-child{text-align:left}tr+tr{border-top:1px solid #ddd}"
    "svg{max-width:100%}"
)


def write_page(path: Path, report: Report, *, title: str) -> None:
    """Write an evaluation as an HTML page, or as Markdown if the path ends in ``.md``.

    The pictures of ``NAME.md`` are ``NAME_confusion.svg``, ``NAME_calibration.svg``, and one for
    each breakdown, such as ``NAME_distance.svg``.

    Raises
    ------
    OutputError : a file cannot be written.
    """
    files = {path: format_page(report, title=title)}
    if path.suffix.lower() == ".md":
        drawn = {
            "confusion": confusion_svg(report.categories, report.confusion),
            "calibration": calibration_svg(report.calibration),
            **{name: accuracy_svg(rows) for name, rows in report.breakdowns},
        }
        pictures = {name: f"{path.stem}_{name}.svg" for name in drawn}
        files = {
            path: format_markdown(report, title=title, pictures=pictures),
            **{path.with_name(pictures[name]): picture for name, picture in drawn.items()},
        }
    with explained(f"{path}: cannot write the report", OutputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        for place, content in files.items():
            with replacing(place) as hidden:
                hidden.write_text(content, "utf-8")


_CALIBRATION = (
    "Accuracy by confidence. On the diagonal, 80 % of the views with a confidence of 0.8 are "
    "right. The area of a dot shows its number of views."
)
_BARS = "The thicker a bar, the more views."


def format_page(report: Report, *, title: str) -> str:
    """Return an evaluation as an HTML page."""
    parts = [
        f"<h1>{escape(title)}</h1>",
        html_table((), _figures(report)),
        "<h2>Confusion</h2><p>Rows: true category; columns: predicted category.</p>",
        confusion_svg(report.categories, report.confusion),
        f"<h2>Calibration</h2><p>{_CALIBRATION}</p>",
        calibration_svg(report.calibration),
    ]
    for name, rows in report.breakdowns:
        parts += [f"<h2>Accuracy by {name}</h2><p>{_BARS}</p>", accuracy_svg(rows)]
        parts.append(html_table(*breakdown_table(name, rows)))
    parts += [
        f"<h2>{name}</h2>" + html_table(head, rows)
        for name, head, rows in comparison_tables(report)
    ]
    return (
        '<!DOCTYPE html><html lang="en"><meta charset="utf-8">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style><body>"
        + "\n".join(parts)
        + "</body></html>\n"
    )


def format_markdown(report: Report, *, title: str, pictures: Mapping[str, str]) -> str:
    """Return an evaluation as Markdown; ``pictures`` maps the name of each picture to its file."""
    pictures = {name: quote(file) for name, file in pictures.items()}
    parts = [
        f"# {_plain(title)}",
        _markdown(("", ""), _figures(report)),
        "## Confusion\n\nRows: true category; columns: predicted category.",
        f"![Confusion]({pictures['confusion']})",
        f"## Calibration\n\n{_CALIBRATION}",
        f"![Calibration]({pictures['calibration']})",
    ]
    for name, rows in report.breakdowns:
        picture = f"![Accuracy by {name}]({pictures[name]})"
        table = _markdown(*breakdown_table(name, rows))
        parts += [f"## Accuracy by {name}\n\n{_BARS}", picture, table]
    parts += [
        f"## {name}\n\n" + _markdown(head, rows) for name, head, rows in comparison_tables(report)
    ]
    return "\n\n".join(parts) + "\n"


def _figures(report: Report) -> Rows:
    novelty = report.novelty or {}
    return [
        ("views", str(report.n)),
        ("accuracy", figure_text(report.accuracy)),
        ("balanced accuracy", figure_text(report.balanced_accuracy)),
        ("calibration error", figure_text(report.ece)),
        ("known shapes rejected", figure_text(report.rejected_known)),
        ("unknown shapes rejected", figure_text(novelty.get("rejected"))),
        ("novelty AUROC", figure_text(novelty.get("auroc"))),
        ("model", report.model),
        *((f"recall of {name}", figure_text(value)) for name, value in report.recall.items()),
    ]


def confusion_svg(categories: Sequence[str], table: Sequence[Sequence[int]]) -> str:
    """Return a confusion matrix ``table`` (c, c) as SVG.

    The shade of a cell shows its count as a fraction of its row.
    """
    margin = max(_MARGIN, 16 + _LETTER * max(map(len, categories), default=0))
    size = margin + _CELL * len(categories)
    parts: list[str] = []
    for i, (name, row) in enumerate(zip(categories, table, strict=True)):
        middle, end = margin + _CELL * (i + 0.5), margin - 8
        turn = f'dy="4" transform="rotate(-90 {middle} {end})"'
        parts.extend(
            (
                f'<text x="{end}" y="{middle + 4}" text-anchor="end">{escape(name)}</text>',
                f'<text x="{middle}" y="{end}" {turn}>{escape(name)}</text>',
            )
        )
        total = max(sum(row), 1)
        for j, count in enumerate(row):
            x, y, share = margin + _CELL * j, margin + _CELL * i, count / total
            ink = "white" if share > 0.5 else "black"
            parts.append(
                f'<rect x="{x}" y="{y}" width="{_CELL}" height="{_CELL}" fill="{_shade(share)}"/>'
            )
            if count:
                parts.append(
                    f'<text x="{x + _CELL / 2}" y="{y + _CELL / 2 + 4}" text-anchor="middle" '
                    f'fill="{ink}">{count}</text>'
                )
    return _svg(size, size, parts)


def calibration_svg(curve: Sequence[Bin]) -> str:
    """Return a calibration curve as SVG; the area of a dot shows its number of views."""
    size = 290
    low, top, side = 46.0, 18.0, size - 66.0  # room for the largest dot in a corner
    high, bottom = low + side, top + side
    centred = 'text-anchor="middle"'
    parts = [
        f'<rect x="{low}" y="{top}" width="{side}" height="{side}" fill="none" stroke="#999"/>',
        f'<line x1="{low}" y1="{bottom}" x2="{high}" y2="{top}" stroke="#bbb"/>',
        f'<text x="{low + side / 2}" y="{size - 10}" {centred}>confidence</text>',
        f'<text transform="translate(12 {top + side / 2}) rotate(-90)" {centred}>accuracy</text>',
    ]
    for share in (0.0, 0.5, 1.0):
        x, y = low + side * share, bottom - side * share
        parts += [
            f'<text x="{x}" y="{bottom + 15}" {centred} fill="#777">{share:g}</text>',
            f'<text x="{low - 5}" y="{y + 4}" text-anchor="end" fill="#777">{share:g}</text>',
        ]
    total = max(sum(item.views for item in curve), 1)
    parts += [
        f'<circle cx="{low + side * item.confidence:.1f}" '
        f'cy="{top + side * (1 - item.accuracy):.1f}" '
        f'r="{2 + 14 * (item.views / total) ** 0.5:.1f}" fill="rgb{_INK}" fill-opacity="0.7"/>'
        for item in curve
    ]
    return _svg(size, size, parts)


def accuracy_svg(ranges: Ranges) -> str:
    """Return accuracies as bars in SVG; a bar's thickness shows its number of views.

    ``ranges`` are tuples of name, number of views and accuracy.
    """
    width, low, step = 480, 96, 34  # room for the longest label
    side = width - low - 56
    most = max((count for _, count, _ in ranges), default=1)
    parts: list[str] = []
    for k, (label, count, value) in enumerate(ranges):
        middle, thick = step * (k + 0.5), 4 + 22 * count / most
        text, end = middle + 4, low + side + 8
        bar = f'y="{middle - thick / 2:.1f}" width="{side * value:.1f}" height="{thick:.1f}"'
        parts.extend(
            (
                f'<text x="{low - 8}" y="{text}" text-anchor="end">{escape(label)}</text>',
                f'<rect x="{low}" {bar} fill="rgb{_INK}" fill-opacity="0.7"/>',
                f'<text x="{end}" y="{text}">{value:.3f}</text>',
            )
        )
    height = step * len(ranges)
    parts.append(
        f'<rect x="{low}" y="0" width="{side}" height="{height}" fill="none" stroke="#999"/>'
    )
    return _svg(width, height, parts)


def _svg(width: float, height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" font-family="system-ui,sans-serif" font-size="12">'
        + "".join(parts)
        + "</svg>"
    )


def _shade(share: float) -> str:
    """Return a CSS colour between white, for 0, and the colour of the ink, for 1."""
    return "rgb" + str(tuple(round(255 + (ink - 255) * share) for ink in _INK))


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(_plain, line)) + " |" for line in lines)


def _plain(text: str) -> str:
    """Return text for one line of Markdown: HTML characters and ``|`` are escaped."""
    return escape(text).replace("|", "\\|").replace("\n", " ")
