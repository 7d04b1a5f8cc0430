"""One colour per category, the same in every output."""

import colorsys
import hashlib

__all__ = ["CATEGORY_COLOURS", "colour_of"]

CATEGORY_COLOURS: dict[str, tuple[int, int, int]] = {
    "cup": (239, 83, 80),
    "can": (102, 187, 106),
    "box": (66, 141, 245),
    "bottle": (144, 152, 168),
    "bowl": (255, 213, 79),
    "plate": (77, 208, 225),
    "ball": (224, 98, 224),
    "unknown": (236, 236, 236),
}
"""The colours of the thesis (red, green, blue, gray, yellow, cyan, magenta), in tones that can be
told apart on dark ground."""


def colour_of(category: str) -> tuple[int, int, int]:
    """Return red, green, blue (0 to 255); a category unknown here gets a stable colour of its own.

    Examples
    --------
    >>> colour_of("cup")
    (239, 83, 80)
    >>> colour_of("teapot") == colour_of("teapot") != colour_of("vase")
    True
    """
    if category in CATEGORY_COLOURS:
        return CATEGORY_COLOURS[category]
    hue = int.from_bytes(hashlib.sha256(category.encode()).digest()[:4], "big") / 2**32
    red, green, blue = colorsys.hls_to_rgb(hue, 0.66, 0.6)
    return round(255 * red), round(255 * green), round(255 * blue)
