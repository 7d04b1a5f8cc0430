"""Descriptions used again: an object that looks as in an earlier frame is not described anew."""

from shapecat.reuse.still import shows_the_same
from shapecat.reuse.views import (
    KeyView,
    Sight,
    find_key_views,
    looks_the_same,
    reused,
    update,
)

__all__ = [
    "KeyView",
    "Sight",
    "find_key_views",
    "looks_the_same",
    "reused",
    "shows_the_same",
    "update",
]
