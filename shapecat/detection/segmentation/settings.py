"""Tuned constants of segmentation, with their units and the reason for each."""

from typing import NamedTuple

__all__ = ["SEGMENTATION", "SegmentationSettings"]


class SegmentationSettings(NamedTuple):
    """Constants for fitting, linking and splitting surfaces."""

    gate: float = 0.008
    """Largest difference in inverse depth between a sample of a local plane and its centre, 1/m:
    two disparity steps of a Kinect."""
    gate_slope: float = 0.008
    """Increase of ``gate`` per cell from the centre, 1/m, since surfaces slant."""
    min_samples: int = 5
    """Minimum number of samples of a local plane: three define one, noise requires more."""
    min_spread: float = 0.2
    """Minimum determinant of the covariance of the samples' positions, cells to the fourth power:
    samples in a line define no plane."""
    bridged: int = 8
    """Narrower gaps, in cells, do not end a run of cells (see `normals`): bridging them is faster
    than starting a new run."""
    base: int = 3
    """Distance, in cells, from an edge to the surfaces that are compared on both sides of it: half
    a window of a local plane."""
    base_diagonal: int = 2
    """The distance ``base`` on a diagonal, in cells along each axis."""
    slope_cells: int = 2
    """Number of cells on each side of a step over which the slope there is measured."""
    step_share: float = 0.5
    """Minimum difference between the change across a step and the slope on each side of it, as a
    fraction of a discontinuity. On one of the sides, the minimum is a whole discontinuity."""
    edge_deg: int = 18
    """Minimum concave angle that may separate two objects; the inside of a 7 cm bowl turns by 16
    degrees over the same number of cells."""
    min_cells: int = 12
    """Minimum number of cells of a segment; smaller parts join a segment beside them, if any."""
    max_segments: int = 250
    """Maximum number of segments. Only the largest are kept, since the time grows with the square
    of their number."""
    bucket_deg: int = 4
    """Width of a range of angles, degrees. Cells in one range are flooded together, since the
    angles are not more precise."""
    side_step_m: float = 0.01
    """Minimum step of one side of the outline, metres; less is noise at 1.5 m."""
    both_steps_m: float = 0.02
    """Minimum sum of the steps of both sides, metres."""
    bands_beside: int = 5
    """Number of 5 mm bands on each side of a step. The nearest one is left out, as a step is not
    sharp; the others show the outline before and after it."""
    part_cells: int = 60
    """Minimum number of cells on either side of a split: fewer are a knob or a handle."""


SEGMENTATION = SegmentationSettings()
