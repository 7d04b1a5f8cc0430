"""The libraries that a piece of code loads, measured in a separate interpreter."""

import subprocess
import sys
from collections.abc import Set as AbstractSet


def loaded_by(code: str, libraries: AbstractSet[str]) -> set[str]:
    """Return which of ``libraries`` are loaded after running ``code``."""
    names = ",".join(sorted(libraries))
    report = f"import sys; print(*set({names!r}.split(',')) & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())
