"""Format counts, the same in every output; loads nothing heavy, since ``--help`` uses it."""

from collections.abc import Mapping

__all__ = ["by_count", "count_words", "plural", "size_words"]


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, in the plural unless the count is 1.

    Examples
    --------
    >>> plural(1, "view"), plural(2000, "view"), plural(3, "process"), plural(0, "switch")
    ('1 view', '2,000 views', '3 processes', '0 switches')
    """
    ending = "" if count == 1 else "es" if noun.endswith(("s", "ch")) else "s"
    return f"{count:,} {noun}{ending}"


def by_count(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    """Return names and counts, sorted by descending count, then by name.

    Examples
    --------
    >>> by_count({"plate": 1, "cup": 3, "can": 1})
    [('cup', 3), ('can', 1), ('plate', 1)]
    """
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))


def count_words(counts: Mapping[str, int], none: str = "none") -> str:
    """Return counts as text, largest first; without counts, return the text ``none``.

    Examples
    --------
    >>> count_words({"can": 2, "cup": 3}), count_words({})
    ('cup 3, can 2', 'none')
    """
    return ", ".join(f"{name} {count}" for name, count in by_count(counts)) or none


def size_words(count: int) -> str:
    """Return a number of bytes as text.

    Examples
    --------
    >>> size_words(640), size_words(98_760_000), size_words(5_000_000_000)
    ('0.6 kB', '98.8 MB', '5,000.0 MB')
    """
    return f"{count / 1e3:.1f} kB" if count < 100_000 else f"{count / 1e6:,.1f} MB"
