"""The steps of the detection beyond the thesis, each of which can be left out."""

from typing import NamedTuple

__all__ = ["ALL_STEPS", "Steps"]


class Steps(NamedTuple):
    """Which of the steps beyond the thesis are taken, to measure what each is worth.

    Without any of them what remains is the plane, the height above it, and depth discontinuities.
    """

    low_profile: bool = True
    concavity: bool = True
    width_split: bool = True
    learned_merging: bool = True
    across_occlusion: bool = True
    contact_boundary: bool = True
    hole_filling: bool = True


ALL_STEPS = Steps()
