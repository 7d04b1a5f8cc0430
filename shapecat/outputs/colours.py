"""The colours of the categories, the same in every output."""

import colorsys
import zlib

from shapecat.types import UNKNOWN

__all__ = ["CATEGORY_COLOURS", "colour_of", "hex_colour"]

CATEGORY_COLOURS: dict[str, tuple[int, int, int]] = {
    "cup": (229, 72, 77),
    "can": (70, 167, 88),
    "box": (62, 130, 246),
    "bottle": (172, 116, 66),
    "bowl": (240, 185, 40),
    "plate": (35, 190, 205),
    "ball": (214, 80, 190),
    UNKNOWN: (226, 226, 220),
}
"""Red, green, blue from 0 to 255, legible on light and dark backgrounds; only unknown is grey."""


def colour_of(category: str) -> tuple[int, int, int]:
    """Return the colour of a category; an unlisted one gets a colour computed from its name.

    Examples
    --------
    >>> colour_of("cup")
    (229, 72, 77)
    >>> colour_of("teapot") == colour_of("teapot")
    True
    """
    if category in CATEGORY_COLOURS:
        return CATEGORY_COLOURS[category]
    hue = zlib.crc32(category.encode()) / 2**32
    red, green, blue = (round(255 * part) for part in colorsys.hls_to_rgb(hue, 0.6, 0.6))
    return red, green, blue


def hex_colour(category: str) -> str:
    """Return the colour of a category as ``#rrggbb``.

    Examples
    --------
    >>> hex_colour("cup")
    '#e5484d'
    """
    return "#{:02x}{:02x}{:02x}".format(*colour_of(category))
