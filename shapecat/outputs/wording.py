"""Numbers and times in words, the same in every output."""

__all__ = ["caption", "confidence_text", "plural", "time_span"]


def caption(track: int, category: str, confidence: float) -> str:
    """Return what is written beside an object.

    Examples
    --------
    >>> caption(6, "cup", 0.999)
    '#6 cup 0.99'
    """
    return f"#{track} {category} {confidence_text(confidence)}"


def confidence_text(confidence: float) -> str:
    """Return a confidence with two digits, the same for one that tracks.csv has rounded to three.

    Only what is certain to three digits is shown as certain.

    Examples
    --------
    >>> confidence_text(0.4954), confidence_text(0.495), confidence_text(0.999), confidence_text(1)
    ('0.50', '0.50', '0.99', '1.00')
    """
    thousandths = round(1000 * confidence)
    hundredths = (thousandths + 5) // 10
    return f"{min(hundredths, 99 + thousandths // 1000) / 100:.2f}"


def plural(count: int, noun: str) -> str:
    """Return a number of things.

    Examples
    --------
    >>> plural(1, "view"), plural(2, "view")
    ('1 view', '2 views')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def time_span(first_s: float, last_s: float) -> str:
    """Return from when to when; one time if they look the same.

    Examples
    --------
    >>> time_span(34.0, 34.01), time_span(0, 2)
    ('34.0 s', '0.0–2.0 s')
    """
    first, last = f"{first_s:.1f}", f"{last_s:.1f}"
    return f"{last} s" if first == last else f"{first}–{last} s"
