"""Over-segmentation: split surfaces at depth discontinuities and concave edges."""
