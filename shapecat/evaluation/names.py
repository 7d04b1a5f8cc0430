"""Rules for the names of category folders, which a model learns and its runs use as labels."""

import unicodedata
from collections.abc import Iterable
from pathlib import Path

from shapecat.errors import RecordingError
from shapecat.runs.labels.meaning import NAME_RULE, is_category_name
from shapecat.types import UNKNOWN

__all__ = ["require_category_names"]


def require_category_names(root: Path, names: Iterable[str], known: Iterable[str] = ()) -> None:
    """Check that the category folders of a data set have valid names.

    Parameters
    ----------
    root : folder of the data set, which error messages name.
    names : names of its category folders.
    known : categories that the model knows already.

    Raises
    ------
    RecordingError : a name cannot be a label, or differs only in case from another one.
    """
    known = (UNKNOWN, *known)
    spelled = {name.lower(): name for name in known}
    for name in sorted(set(names) - set(known)):
        plain = " ".join(unicodedata.normalize("NFC", name).split())
        if plain != name:
            # Labels have single spaces and composed accents.
            problem = f"expected {plain!r} instead of {name!a}"
        elif name.lower() in spelled:
            problem = f"the model calls it {spelled[name.lower()]}"
            if spelled[name.lower()] not in known:
                problem = f"there is also a folder {spelled[name.lower()]}"
        elif not is_category_name(name):
            problem = f"reserved, or not {NAME_RULE}"
        else:
            spelled[name.lower()] = name
            continue
        msg = f"{root / name}: {problem}; rename the folder"
        raise RecordingError(msg)
