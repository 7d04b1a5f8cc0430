"""Tuned constants of this stage, with their units and the reason for each."""

from typing import NamedTuple

__all__ = ["SEGMENTATION", "SegmentationSettings"]


class SegmentationSettings(NamedTuple):
    """How surfaces are fitted, linked and parted."""

    gate: float = 0.008
    """A sample of a local plane lies this near to its centre in inverse depth, 1/m: two steps of a
    Kinect."""
    gate_slope: float = 0.008
    """So much more per cell from the centre, 1/m: surfaces slant."""
    fewest_samples: int = 5
    """Samples of a local plane: three define one, noise takes more."""
    least_spread: float = 0.2
    """Determinant of their places, cells to the fourth: samples in a line define no plane."""
    bridged: int = 8
    """Cells of others that a run of cells goes on across: a new run costs more."""
    base: int = 3
    """Cells between an edge and the surfaces that are compared: half a window of a local plane."""
    base_diagonal: int = 2
    """The same along each axis on diagonals, about as far."""
    step_reach: int = 2
    """Cells beside a step over which slopes are measured: nearer is the step itself."""
    sure: float = 0.5
    """How well one of two slopes that differ must explain a step, as a share of a discontinuity."""
    edge_deg: int = 18
    """Concave angle that may part two objects; a bowl of 7 cm turns 16 degrees over the same
    cells."""
    least_cells: int = 12
    """Smaller parts are scraps, that belong to what is around them."""
    most_segments: int = 250
    """Bounds the time, which grows with the square of their number."""
    bucket_deg: int = 4
    """Angles that differ less are flooded in one go: they are no more exact."""
    side_step_m: float = 0.01
    """How far one side of the outline steps aside at least, metres; less is noise at 1.5 m."""
    both_steps_m: float = 0.02
    """How far both sides do together, metres."""
    bands_beside: int = 5
    """Bands of height below and above a step, of 5 mm: the nearest is left out, for a step is not
    sharp; the others tell where the outline was and is."""
    part_cells: int = 60
    """Cells on either side of a split: less is a knob or a handle."""
    shadow_cells: int = 6
    """Cells without a sample beside what hides something, on a Kinect."""


SEGMENTATION = SegmentationSettings()
