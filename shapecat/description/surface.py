"""The surface of an object as the blocks of the descriptor read it."""

from typing import NamedTuple

from shapecat.arrays import F4, F8, I4

__all__ = ["Surface"]


class Surface(NamedTuple):
    """The points and neurons of an object, and quantities derived from them.

    Positions are relative to ``center``, and lengths are in units of ``unit``, except those for
    which metres are given.

    Attributes
    ----------
    points : (3, n) sorted by their nearest neuron.
    starts : (k + 1,) index at which the points of each neuron begin.
    nearest : (n,) the neuron of each point.
    neurons : (3, k) positions.
    euclidean, geodesic : (k, k) distances between neurons, straight and along edges.
    weight : (k,) each neuron's fraction of the points.
    spacing : mean distance from a neuron to the nearest other one.
    eye : (3,) position of the sensor.
    eye_distance_m : distance of the sensor from ``center``, metres.
    center : (3,) mean of the neurons, metres.
    unit : mean distance between neurons, metres.
    """

    points: F4
    starts: I4
    nearest: I4
    neurons: F4
    euclidean: F4
    geodesic: F4
    weight: F4
    spacing: float
    eye: F4
    eye_distance_m: float
    center: F8
    unit: float
