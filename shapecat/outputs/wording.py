"""Format captions, confidences, times and names, the same in every output."""

import re
import unicodedata
from collections.abc import Sequence
from itertools import chain, count

from shapecat.types import UNKNOWN

__all__ = ["caption", "confidence_text", "different_names", "safe_name", "time_span"]

_SAFE = re.compile(r"[\w .+&'()-]")
_LONGEST_BYTES = 120
"""Longest safe name, bytes; file systems allow 255, but callers add prefixes and suffixes."""


def caption(track: int, category: str, confidence: float) -> str:
    """Return the text beside an object: track, category and confidence.

    The text of an unknown object omits the confidence, which is that of the most probable category
    but would be read as the certainty that the object is unknown.

    Examples
    --------
    >>> caption(6, "cup", 0.999), caption(7, "unknown", 0.44)
    ('#6 cup 0.99', '#7 unknown')
    """
    if category == UNKNOWN:
        return f"#{track} {category}"
    return f"#{track} {category} {confidence_text(confidence)}"


def confidence_text(confidence: float) -> str:
    """Return a confidence with two decimals; ``1.00`` only if it rounds to 1.000.

    A confidence that was first rounded to three decimals, as in tracks.csv, gives the same text.

    Examples
    --------
    >>> confidence_text(0.4954), confidence_text(0.495), confidence_text(0.999), confidence_text(1)
    ('0.50', '0.50', '0.99', '1.00')
    """
    thousandths = round(1000 * confidence)
    hundredths = (thousandths + 5) // 10
    return f"{min(hundredths, 99 + thousandths // 1000) / 100:.2f}"


def time_span(first_s: float, last_s: float) -> str:
    """Return a range of times in seconds, or one time if both round to the same.

    Examples
    --------
    >>> time_span(34.0, 34.01), time_span(0, 2)
    ('34.0 s', '0.0–2.0 s')
    """
    first, last = f"{first_s:.1f}", f"{last_s:.1f}"
    return f"{last} s" if first == last else f"{first}–{last} s"


def safe_name(text: str, longest: int = _LONGEST_BYTES) -> str:
    """Return a text as a name for a file or folder: no separators, not hidden, not too long.

    Letters of all scripts stay, with their accents and vowel signs. The name is cut after
    ``longest`` bytes.

    Examples
    --------
    >>> safe_name("../wine glass")
    '_wine glass'
    """
    safe = (c if _SAFE.match(c) or unicodedata.category(c)[0] == "M" else "_" for c in text)
    return "".join(safe).strip(". ").encode()[:longest].decode(errors="ignore") or "_"


def different_names(texts: Sequence[str]) -> list[str]:
    """Return a `safe_name` for each text; ``-2``, ``-3``, ... tell repeated names apart.

    Examples
    --------
    >>> different_names(["/left/depth", "/left_depth"])
    ['_left_depth', '_left_depth-2']
    """
    names_so_far: list[str] = []
    for name in map(safe_name, texts):
        numbered = (f"{name}-{k}" for k in count(2))
        names_so_far.append(next(n for n in chain([name], numbered) if n not in names_so_far))
    return names_so_far
