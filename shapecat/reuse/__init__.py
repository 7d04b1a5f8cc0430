"""Reuse of the descriptions of objects that look the same as in an earlier frame."""

from shapecat.reuse.still import shows_the_same
from shapecat.reuse.views import KeyView, find_repeats, reused, view_object

__all__ = ["KeyView", "find_repeats", "reused", "shows_the_same", "view_object"]
