"""Format counts, the same in every output; loads nothing, as the help of the command needs it."""

__all__ = ["plural"]


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, in the plural unless the count is 1.

    Examples
    --------
    >>> plural(1, "view"), plural(2000, "view"), plural(3, "process"), plural(0, "switch")
    ('1 view', '2,000 views', '3 processes', '0 switches')
    """
    ending = "" if count == 1 else "es" if noun.endswith(("s", "ch")) else "s"
    return f"{count:,} {noun}{ending}"
