"""Draw the subpackages and their imports: ``python -m tests.picture``.

A subpackage is drawn in the layer that `tests.test_architecture` assigns to it. Arrows lead to the
imported subpackages, except for imports that follow from others, those within a layer, and those of
the two lowest layers, which all subpackages use.
"""

from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path

from tests.test_architecture import FILES, LAYER, imported_subpackages, subpackage_of

__all__ = ["PICTURE", "draw"]

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "architecture.svg"
WIDTH, ROW, BOX_H, GAP = 1180, 70, 30, 8
LAYERS = {
    7: "interfaces",
    6: "many recordings",
    5: "pipeline",
    4: "results",
    3: "runs",
    2: "stages, inputs",
    1: "shared tools",
    0: "base",
}
CENTRES_X = {
    "api": 660,
    "batch": 740,
    "cli": 1100,
    "evaluation": 870,
    "models": 1000,
    "outputs": 740,
    "perception": 400,
    "pipeline": 740,
    "rehearsal": 570,
    "runs": 740,
}
"""Horizontal centres of boxes, so that no arrow runs behind a box; others are spaced evenly."""
FIRST = ("schemas", "colour", "depth_fusion")
LAST = ("tracking", "recordings", "simulation")
"""Boxes at the left and right end of their layers; the others are in alphabetical order."""
HIDDEN = {"__init__", "__main__", "py"}
_Position = tuple[float, float, float]
"""Left edge, top and width of a box."""


def imports() -> dict[str, set[str]]:
    """Return the imports of each subpackage."""
    found: dict[str, set[str]] = {}
    for path in FILES:
        name = subpackage_of(path)
        found.setdefault(name, set()).update(imported_subpackages(path) - {name})
    return {name: others - HIDDEN for name, others in found.items() if name not in HIDDEN}


def reduced(graph: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Return a graph without the edges that follow from others (transitive reduction)."""

    def below(name: str) -> set[str]:
        return set().union(*(graph.get(o, set()) | below(o) for o in graph.get(name, set())))

    reachable = {name: below(name) for name in graph}
    return {name: others - reachable[name] for name, others in graph.items()}


def box_positions(subpackages: set[str]) -> dict[str, _Position]:
    """Return left edge, top and width of the box of each subpackage."""
    found: dict[str, _Position] = {}
    for row, level in enumerate(LAYERS):
        names = sorted((name for name in subpackages if LAYER[name] == level), key=_rank)
        widths = [7.8 * len(name) + 12 for name in names]
        left = 120 + (WIDTH - 134 - sum(widths) - GAP * (len(names) - 1)) / 2
        for name, width in zip(names, widths, strict=True):
            middle = CENTRES_X.get(name, left + width / 2)
            found[name] = (middle - width / 2, 16 + row * ROW + (ROW - BOX_H) / 2 - 6, width)
            left += width + GAP
    return found


def _rank(name: str) -> tuple[int, str]:
    if name in FIRST:
        return FIRST.index(name) - len(FIRST), name
    return (LAST.index(name) + 1 if name in LAST else 0), name


_ARROW_HEAD = (
    '<marker id="a" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" '
    'orient="auto"><path d="M0 0 8 4 0 8z" fill="#789"/></marker>'
)


def draw() -> str:
    """Return the picture as SVG."""
    graph = imports()
    boxes = box_positions(set(graph) | {"schemas"})
    height = 16 + ROW * len(LAYERS)
    size = f'viewBox="0 0 {WIDTH} {height}" font-family="sans-serif" font-size="14"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size}>',
        _ARROW_HEAD,
        f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>',
        *_bands(),
        *_arrows(reduced(graph), boxes),
        *_boxes(boxes),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _bands() -> Iterator[str]:
    for row, name in enumerate(LAYERS.values()):
        top = 10 + row * ROW
        shape = f'x="6" y="{top}" width="{WIDTH - 12}" height="{ROW - 8}" rx="8"'
        yield f'<rect {shape} fill="#f2f5f8"/>'
        yield f'<text x="18" y="{top + ROW / 2}" font-size="13" fill="#567">{escape(name)}</text>'


def _arrows(graph: Mapping[str, set[str]], boxes: Mapping[str, _Position]) -> Iterator[str]:
    for name, other in sorted((n, o) for n, others in graph.items() for o in others):
        if LAYER[other] < 2 or LAYER[other] == LAYER[name]:
            continue
        (x1, y1, w1), (x2, y2, w2) = boxes[name], boxes[other]
        start, end = (x1 + w1 / 2, y1 + BOX_H), (x2 + w2 / 2, y2)
        bend = (end[1] - start[1]) / 2
        yield (
            f'<path d="M{start[0]:.0f} {start[1]:.0f}C{start[0]:.0f} {start[1] + bend:.0f} '
            f'{end[0]:.0f} {end[1] - bend:.0f} {end[0]:.0f} {end[1]:.0f}" fill="none" '
            'stroke="#789" marker-end="url(#a)"/>'
        )


def _boxes(boxes: Mapping[str, _Position]) -> Iterator[str]:
    for name, (x, y, width) in sorted(boxes.items()):
        yield (
            f'<rect x="{x:.0f}" y="{y:.0f}" width="{width:.0f}" height="{BOX_H}" rx="6" '
            'fill="#fff" stroke="#357"/>'
        )
        yield (
            f'<text x="{x + width / 2:.0f}" y="{y + 20:.0f}" text-anchor="middle">'
            f"{escape(name)}</text>"
        )


if __name__ == "__main__":
    PICTURE.write_text(draw(), "utf-8")
