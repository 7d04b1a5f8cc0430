"""Over-segmentation: surfaces are split at depth discontinuities and concave edges."""
