"""Triangles of a graph."""

import numpy as np

from shapecat.arrays import I4, U2
from shapecat.jit import kernel

__all__ = ["triangles_of"]


@kernel
def triangles_of(edges: U2, nodes: int) -> U2:
    """Return the triangles i < j < k of a graph, (t, 3), in lexicographic order.

    Parameters
    ----------
    edges : (m, 2) pairs i < j of nodes, each once, in lexicographic order.
    nodes : the number of nodes.

    Raises
    ------
    ValueError : an edge leads to a node that does not exist.
    """
    begin = np.zeros(nodes + 1, np.int32)
    for edge in range(len(edges)):
        if max(edges[edge, 0], edges[edge, 1]) >= nodes:
            raise ValueError("an edge leads to a node that does not exist")  # noqa: EM101, TRY003  compiled
        begin[edges[edge, 0] + 1] += 1
    for node in range(nodes):
        begin[node + 1] += begin[node]
    result = np.zeros((_walk(edges, begin, np.zeros((0, 3), np.uint16)), 3), np.uint16)
    _walk(edges, begin, result)
    return result


@kernel(inner=True)
def _walk(edges: U2, begin: I4, result: U2) -> int:
    """Write the triangles to ``result`` (m, 3) while there is room; return their total number.

    ``edges`` are as in `triangles_of`; ``begin[i]`` is the row of the first edge with first node i.
    """
    n = 0
    for edge in range(len(edges)):
        i, j = edges[edge, 0], edges[edge, 1]
        a, b = edge + 1, begin[j]  # the neighbours of i after j, and those of j
        while a < begin[i + 1] and b < begin[j + 1]:
            u, v = edges[a, 1], edges[b, 1]
            if u == v:
                if n < len(result):
                    result[n, 0], result[n, 1], result[n, 2] = i, j, u
                n += 1
            a += u <= v
            b += v <= u
    return n
