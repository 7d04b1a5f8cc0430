"""Distractors: objects outside the seven categories, which a model must call *unknown*."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator

from shapecat.simulation.shapes.kitchen import KITCHEN
from shapecat.simulation.shapes.mesh import Mesh, scaled, standing
from shapecat.simulation.shapes.procedural import PROCEDURAL
from shapecat.simulation.shapes.randomness import log_uniform
from shapecat.simulation.shapes.tools import TOOLS
from shapecat.simulation.shapes.toys import TOYS

__all__ = ["DISTRACTORS", "KINDS", "make_distractor"]

DISTRACTORS: dict[str, Callable[[Generator], Mesh]] = {**KITCHEN, **TOOLS, **TOYS}
"""For each kind of object outside the categories, the function that makes a random one."""
KINDS = tuple(DISTRACTORS)
"""Names of the `DISTRACTORS`, from which `make_distractor` draws by default."""


def make_distractor(rng: Generator, kinds: Sequence[str] = KINDS) -> tuple[str, Mesh]:
    """Make a random object outside the categories; return its kind and mesh.

    Its kind is one of ``kinds``, which are names in `DISTRACTORS` or `PROCEDURAL`.

    Raises
    ------
    ValueError : the kind does not exist.
    """
    kind, makers = str(rng.choice(kinds)), {**DISTRACTORS, **PROCEDURAL}
    if kind not in makers:
        msg = f"no distractor {kind!r}; known: {', '.join(makers)}"
        raise ValueError(msg)
    mesh = makers[kind](rng)
    jitter = np.exp(rng.uniform(-0.12, 0.12, 3))
    return kind, standing(scaled(mesh, jitter * log_uniform(rng, 0.75, 1.35)))
