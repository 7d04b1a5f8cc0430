"""Errors for the user. Each message names the problem, the place, and what to try."""

__all__ = [
    "ConfigError",
    "ModelError",
    "NoStreamError",
    "OutputError",
    "RecordingError",
    "ShapecatError",
]


class ShapecatError(Exception):
    """A known problem: shown as one line, without a traceback."""

    exit_code = 1


class RecordingError(ShapecatError):
    """A recording that cannot be read: missing, damaged, or not a recording."""

    exit_code = 3


class NoStreamError(ShapecatError):
    """A recording that is readable but holds no usable cloud stream or frame."""

    exit_code = 4


class ConfigError(ShapecatError):
    """A setting that does not exist or has an impossible value."""

    exit_code = 2


class ModelError(ShapecatError):
    """A model file that is missing, damaged, or made by something else."""

    exit_code = 2


class OutputError(ShapecatError):
    """A result that cannot be written: a full disk or a folder without permission."""
