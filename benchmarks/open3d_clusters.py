"""Segmentation of a table with Open3D, for comparison."""

from typing import Any

import numpy as np

from benchmarks.scenes import Array


def cluster_above_plane(cloud: Any, up: Array) -> tuple[Array, Array]:
    """Find the largest horizontal plane (RANSAC); cluster the points above it (DBSCAN).

    Parameters
    ----------
    cloud : an Open3D point cloud, whose points are about a centimetre apart.
    up : (3,) up direction in the frame of the cloud, which is the sensor frame.

    Returns
    -------
    The indices (k,) of the points 1 to 60 cm above the plane, and the cluster (k,) of each, -1 for
    noise; none without a plane.
    """
    import open3d as o3d  # noqa: PLC0415  heavy; may lack its system libraries

    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(20))
    o3d.utility.random.seed(0)
    level = np.flatnonzero(np.abs(np.asarray(cloud.normals) @ up) > 0.95)
    if level.size < 3:
        return level[:0], level[:0]
    (a, b, c, d), _ = cloud.select_by_index(level.tolist()).segment_plane(0.01, 3, 200)
    height = np.sign(d) * (np.asarray(cloud.points) @ [a, b, c] + d)
    above = np.flatnonzero((height > 0.01) & (height < 0.6))
    return above, np.asarray(cloud.select_by_index(above.tolist()).cluster_dbscan(0.02, 10))
