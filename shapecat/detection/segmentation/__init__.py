"""Over-segmentation: surfaces are parted at depth discontinuities and concave edges."""
