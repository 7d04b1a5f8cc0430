"""Similarity of simulated and real sensors: roughness of planes, width of edges and steps, holes.

    python -m benchmarks.sensors --real FOLDER --real FOLDER --picture sensors.png

The table has one line for each simulated sensor, on piles, and one for each folder of real
recordings. The picture shows a frame of each as shaded surfaces, which show noise, edges and holes
best.
"""

from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from benchmarks.measure import markdown
from benchmarks.scenes import Array, simulated_frame
from shapecat import open_recording
from shapecat.simulation import make_scene, render_frame
from shapecat.simulation.camera.presets import PRESETS
from shapecat.types import Frame

WINDOWS = {"roughness": 16, "warp": 96}
"""Width of the windows, pixels of an image 640 pixels wide: the small one shows noise, the large
one the warping of planes."""
QUIETEST = 0.25
"""The noise of planes is this quantile over all windows; noisier windows contain objects."""
JUMP_M, EDGE_PX = 0.06, 12
"""Edges are depth steps of at least this height within this number of pixels."""
STEPS, STEP_PX = (0.03, 0.07), 12
"""Least and largest height of a small step of the inverse depth, 1/m, and its maximum width,
pixels."""
STRAIGHT = 0.0006
"""Maximum change of the slope of the inverse depth on each side of a small step, 1/m per pixel."""
HEAD = (
    *("sensor", "frames", "distance, m", "roughness, 1/m", "warp, 1/m"),
    *("edge, px", "step, px", "holes"),
)


class Figures(NamedTuple):
    """Measurements of one frame.

    Attributes
    ----------
    distance : median depth, metres.
    roughness, warp : standard deviation from planes in small and large windows, 1/m.
    edge, step : width of edges and of small steps, pixels of an image 640 pixels wide.
    holes : fraction of pixels without depth inside the area with depth.
    """

    distance: float
    roughness: float
    warp: float
    edge: float
    step: float
    holes: float


def measure_frame(depth: Array) -> Figures:
    """Measure a depth image (h, w), metres, 0 without depth."""
    scale = depth.shape[1] / 640
    inverse = np.divide(1.0, depth, where=depth > 0, out=np.zeros(depth.shape))
    errors = [_roughness(inverse, max(round(w * scale), 6)) for w in WINDOWS.values()]
    edge = _edge_width(depth, max(round(EDGE_PX * scale), 4)) / scale
    across = max(round(STEP_PX * scale), 4)
    step = np.concatenate([_step_widths(image, across) for image in (inverse, inverse.T)]) / scale
    seen = depth > 0
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    inside = seen[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    distance, holes = float(np.median(depth[seen])), float(1 - inside.mean())
    middle = float(np.median(step)) if step.size else float("nan")
    return Figures(distance, errors[0], errors[1], edge, middle, holes)


def _roughness(inverse: Array, width: int) -> float:
    """Return the noise of planes: a quantile, over windows, of the deviation from a plane, 1/m.

    It is the `QUIETEST` quantile of the standard deviations of inverse depth from the plane fitted
    to each window, ``width`` pixels wide; NaN if no window has depth in more than 99 % of its
    pixels. ``inverse`` (h, w) is 0 where there is no depth.
    """
    v, u = np.mgrid[:width, :width].reshape(2, -1) - width / 2
    design = np.column_stack([u, v, np.ones(width * width)])
    project = np.linalg.pinv(design)
    found = []
    for top in range(0, inverse.shape[0] - width, width):
        for left in range(0, inverse.shape[1] - width, width):
            part = inverse[top : top + width, left : left + width].ravel()
            if (part > 0).mean() > 0.99:
                part = np.where(part > 0, part, np.median(part))
                found.append(float((part - design @ (project @ part)).std()))
    return float(np.quantile(found, QUIETEST)) if found else float("nan")


def _edge_width(depth: Array, width: int) -> float:
    """Return the mean number of pixels between the two sides of a depth step along rows.

    ``depth`` (h, w) is in metres; a step is within ``width`` pixels. Without one, return NaN.
    """
    near, far = depth[:, : -width - 1], depth[:, width + 1 :]
    step = (near > 0) & (far > 0) & (np.abs(far - near) > JUMP_M)
    between = np.zeros(step.shape, np.int64)
    for k in range(1, width + 1):
        middle = depth[:, k : k + near.shape[1]]
        off = np.minimum(np.abs(middle - near), np.abs(middle - far)) > JUMP_M / 4
        between += off & (middle > 0)
    return float(between[step].mean()) if step.any() else float("nan")


def _step_widths(inverse: Array, width: int) -> Array:
    """Return the widths (n,) of small steps along rows, from 10 to 90 % of each, pixels.

    A step is between two straight pieces of surface, each ``width`` pixels long, ``width`` pixels
    apart; it has no holes. ``inverse`` (h, w) is the inverse depth, 1/m, 0 without depth.
    """
    n, half = inverse.shape[1] - 3 * width, width // 2
    at = [inverse[:, k : k + n] for k in (0, half, width, 2 * width, 2 * width + half, 3 * width)]
    slopes = [(b - a) / half for a, b in pairwise(at)]
    step = at[3] - at[2] - (slopes[1] + slopes[3]) / 2 * width
    holds = np.min(at, axis=0) > 0
    for a, b in ((0, 1), (3, 4)):
        holds &= np.abs(slopes[a] - slopes[b]) < STRAIGHT
    rows, columns = np.nonzero(holds & (np.abs(step) > STEPS[0]) & (np.abs(step) < STEPS[1]))
    k = np.arange(width + 1)
    part = inverse[rows[:, None], columns[:, None] + width + k]
    left, right = (slopes[i][rows, columns][:, None] for i in (1, 3))
    low, high = part[:, :1] + left * k, part[:, -1:] - right * (width - k)
    share = np.divide(part - low, high - low, where=high != low, out=np.zeros(part.shape))
    widths = ((share > 0.1) & (share < 0.9)).sum(axis=1)
    return np.asarray(widths[(part > 0).all(axis=1)])


def _frames(folder: Path) -> Iterator[Frame]:
    """Yield the depth images of the recordings in a folder."""
    for path in sorted(folder.rglob("*.mcap")):
        with open_recording(path) as recording:
            yield from (frame for frame in recording.frames() if frame.depth is not None)


def _shaded(depth: Array, focal: float) -> Array:
    """Return the brightness (h, w) of a depth image lit from the side, NaN around missing depth.

    ``depth`` (h, w) is in metres, ``focal`` the focal length in pixels.
    """
    depth = np.where(depth > 0, depth, np.nan)
    down, right = np.gradient(depth)
    slopes = [np.arctan(step * focal / depth + tilt) for step, tilt in ((right, 0.5), (down, -0.6))]
    return np.asarray(0.6 * np.cos(slopes[0]) + 0.4 * np.cos(slopes[1]))


def draw(path: Path, seed: int, real: tuple[Path, ...]) -> None:
    """Draw one pile seen by each sensor, and the first frame of each real folder."""
    import matplotlib as mpl  # noqa: PLC0415  only for the picture

    mpl.use("agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415  after the backend is chosen

    world = make_scene("pile", np.random.default_rng(seed), frames=1)
    taken = [
        (name, render_frame(world, 0, rng=np.random.default_rng(seed), sensor=sensor)[0])
        for name, sensor in PRESETS.items()
    ]
    taken += [(folder.name, next(_frames(folder))) for folder in real]
    figure, axes = plt.subplots(-(-len(taken) // 5), 5, figsize=(15, 2.6 * -(-len(taken) // 5)))
    colours = mpl.colormaps["gray"].with_extremes(bad="lightskyblue")
    for axis in axes.flat:
        axis.axis("off")
        axis.set_anchor("N")
    for (name, frame), axis in zip(taken, axes.flat, strict=False):
        camera = frame.camera
        shade = _shaded(np.asarray(frame.depth, np.float64), camera.fx if camera else 525.0)
        axis.imshow(shade, cmap=colours, vmin=0.2, vmax=1.0)
        axis.set_title(name, fontsize=13)
    figure.tight_layout()
    figure.savefig(path, dpi=70)


def _row(name: str, frames: Iterable[Frame]) -> tuple[Any, ...]:
    figures = [measure_frame(np.asarray(frame.depth, np.float64)) for frame in frames]
    middle = np.nanmedian(figures, axis=0)
    return (name, len(figures), *(f"{value:.2g}" for value in middle))


@click.command()
@click.option("--first", default=3000, show_default=True, help="Seed of the first scene.")
@click.option("--count", default=10, show_default=True, help="Scenes per sensor.")
@click.option(
    "--real",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Folder of real recordings. Repeatable.",
)
@click.option("--picture", type=click.Path(path_type=Path), help="Picture of a frame of each.")
def main(first: int, count: int, real: tuple[Path, ...], picture: Path | None) -> None:
    """Measure simulated and real depth images, and print a table."""
    if picture is not None:
        draw(picture, first, real)
    seeds = range(first, first + count)
    rows = [
        _row(name, (simulated_frame("pile", seed, sensor)[1] for seed in seeds))
        for name, sensor in PRESETS.items()
    ]
    rows += [_row(folder.name, _frames(folder)) for folder in real]
    click.echo(markdown("Depth images, medians over frames", HEAD, rows))


if __name__ == "__main__":
    main()
