"""Distractors: objects outside the seven categories, which a model must call *unknown*."""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from shapecat.simulation.shapes.kitchen import KITCHEN
from shapecat.simulation.shapes.mesh import Mesh, scaled, standing
from shapecat.simulation.shapes.procedural import PROCEDURAL
from shapecat.simulation.shapes.randomness import log_uniform
from shapecat.simulation.shapes.tools import TOOLS
from shapecat.simulation.shapes.toys import TOYS

__all__ = ["DISTRACTORS", "make_distractor"]

DISTRACTORS: dict[str, Callable[[Generator], Mesh]] = {**KITCHEN, **TOOLS, **TOYS}
"""For each kind of object outside the categories, the function that makes a random one."""


def make_distractor(rng: Generator, kind: str | None = None) -> tuple[str, Mesh]:
    """Make a random object outside the categories; return its kind and mesh.

    Parameters
    ----------
    kind : one of `DISTRACTORS` or `PROCEDURAL`; by default a random one of `DISTRACTORS`.

    Raises
    ------
    ValueError : the kind does not exist.
    """
    chosen = str(rng.choice(list(DISTRACTORS))) if kind is None else kind
    makers = {**DISTRACTORS, **PROCEDURAL}
    if chosen not in makers:
        msg = f"no distractor {chosen!r}; known: {', '.join(makers)}"
        raise ValueError(msg)
    mesh = makers[chosen](rng)
    jitter = np.exp(rng.uniform(-0.12, 0.12, 3))
    return chosen, standing(scaled(mesh, jitter * log_uniform(rng, 0.75, 1.35)))
