"""The content of run.json of synthetic runs."""

from typing import Any

from shapecat.config import Settings

__all__ = ["run_info"]


def run_info(**entries: Any) -> Any:
    """Return a complete run.json; ``entries`` replace its own, or are merged into its dicts."""
    complete: dict[str, Any] = {
        "id": "0123456789abcdef",
        "work": "",
        "input": {"path": "/recordings/lab.mcap", "bytes": 0, "digest": "", "files": []},
        "versions": {},
        "settings": Settings().as_dict(),
        "options": {
            "topics": ["/depth"],
            "up": "auto",
            "fixed_frame": None,
            "start_s": None,
            "end_s": None,
            "every": 1,
            "color": None,
            "mcap": True,
            "rrd": True,
        },
        "model": {"id": "", "categories": []},
        "fixed_frame": None,
        "up": {},
        "counts": {"frames": 0, "skipped": {}, "detections": 0},
        "seconds": {},
        "warnings": [],
        "color": {},
    }
    for name, value in entries.items():
        default = complete.get(name)
        complete[name] = default | value if isinstance(default, dict) else value
    return complete
