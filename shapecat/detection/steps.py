"""The steps of the detection that go beyond the thesis; each can be left out."""

from typing import NamedTuple

__all__ = ["ALL_STEPS", "Steps"]


class Steps(NamedTuple):
    """Switches for the steps beyond the thesis, to measure the effect of each.

    With all of them off, objects are separated by plane, height and depth discontinuities alone.
    """

    low_profile: bool = True
    concavity: bool = True
    width_split: bool = True
    learned_merging: bool = True
    across_occlusion: bool = True
    contact_boundary: bool = True
    hole_filling: bool = True


ALL_STEPS = Steps()
