"""Random objects of the seven categories."""

from numpy.random import Generator

from shapecat.simulation.shapes.balls import make_ball
from shapecat.simulation.shapes.closed_shapes import make_bottle, make_box, make_can
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.simulation.shapes.open_shapes import make_bowl, make_cup, make_plate

__all__ = ["make_object"]

_MAKERS = {
    "cup": make_cup,
    "can": make_can,
    "box": make_box,
    "bottle": make_bottle,
    "bowl": make_bowl,
    "plate": make_plate,
    "ball": make_ball,
}


def make_object(category: str, rng: Generator) -> Mesh:
    """Make a random object of one of `shapecat.types.CATEGORIES`; it stands on z = 0.

    The shapes obey the definitions of the categories: cups, bowls and plates differ in their ratio
    of depth to diameter, and bottles have a narrow neck.

    Raises
    ------
    ValueError : the category does not exist.
    """
    if category not in _MAKERS:
        msg = f"no shapes for category {category!r}; known: {', '.join(_MAKERS)}"
        raise ValueError(msg)
    return _MAKERS[category](rng)
