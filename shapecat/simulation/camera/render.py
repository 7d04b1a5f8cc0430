"""A z-buffer rasterizer of triangles for a pinhole camera.

It uses plain double arithmetic in a fixed order, so that images are the same on every machine.
"""

import numpy as np

from shapecat.arrays import F4, F8, I4, Record, array
from shapecat.geometry import inverse
from shapecat.jit import kernel
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.types import Camera, Pose

__all__ = ["Geometry", "Image", "cropped", "geometry", "pixels_if_unoccluded", "render"]

NEAR_M = 0.02
"""Minimum depth: a triangle is skipped if no corner is farther away. If only some corners are, all
pixels of the image are tested, not only those around the triangle."""


class Geometry(Record):
    """The triangles of several meshes in one coordinate frame.

    Attributes
    ----------
    vertices : (n, 3) metres.
    triangles : (m, 3) indices into ``vertices``.
    mesh_ids : (m,) index of the mesh that each triangle belongs to.
    """

    vertices: F8 = array("n 3", "f8")
    triangles: I4 = array("m 3", "i4")
    mesh_ids: I4 = array("m", "i4")


class Image(Record):
    """A rendered image.

    Attributes
    ----------
    inverse : (h, w) inverse of the depth along the optical axis, 1/m; 0 without surface.
    mesh_ids : (h, w) index of the visible mesh, -1 without surface.
    cosine : (h, w) cosine of the angle of incidence, at least 0; 0 without surface.
    """

    inverse: F8 = array("h w", "f8")
    mesh_ids: I4 = array("h w", "i2")
    cosine: F4 = array("h w", "f4")

    @property
    def depth(self) -> F8:
        """(h, w) depth along the optical axis, metres; 0 without surface."""
        with np.errstate(divide="ignore"):
            return np.where(self.inverse > 0, 1.0 / self.inverse, 0.0)


def geometry(meshes: list[tuple[Mesh, Pose]]) -> Geometry:
    """Transform meshes into one frame, each by its pose ``frame_from_mesh``, and merge them."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh, _ in meshes)])
    vertices = np.zeros((int(starts[-1]), 3))
    for (mesh, pose), start in zip(meshes, starts[:-1], strict=True):
        _place(mesh.vertices, pose.rotation, pose.translation, vertices[start:])
    parts = [m.triangles + s for (m, _), s in zip(meshes, starts[:-1], strict=True)]
    counts = [len(mesh.triangles) for mesh, _ in meshes]
    triangles = np.concatenate(parts) if parts else np.zeros((0, 3), np.int32)
    return Geometry(vertices, triangles, np.repeat(np.arange(len(meshes)), counts))


def render(scene: Geometry, camera: Camera, frame_from_camera: Pose) -> Image:
    """Render triangles, which are visible from both sides, with a z-buffer.

    The inverse depth of a plane is linear in the image. A ray hits a triangle if it is on the same
    side of the three planes through the camera and the triangle's edges. Triangles need no
    clipping, and no gap opens between neighbours.

    Parameters
    ----------
    scene : triangles in any frame.
    frame_from_camera : pose of the optical frame in the frame of ``scene``.

    Notes
    -----
    Cost: O(triangles + their pixels). Of two surfaces at the same depth, the first is drawn.

    Source: Olano and Greer 1997.
    """
    shape = (camera.height, camera.width)
    local = np.zeros_like(scene.vertices)
    camera_from_frame = inverse(frame_from_camera)
    rotation = np.ascontiguousarray(camera_from_frame.rotation)
    _place(scene.vertices, rotation, camera_from_frame.translation, local)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    nearest, triangle_ids = np.zeros(shape), np.full(shape, -1, np.int32)
    normals = np.zeros((len(scene.triangles), 3))
    _rasterize(local, scene.triangles, intrinsics, nearest, triangle_ids, normals)
    mesh_ids, cosine = np.zeros(shape, np.int16), np.zeros(shape, np.float32)
    _shade(triangle_ids, normals, scene.mesh_ids, intrinsics, mesh_ids, cosine)
    return Image(nearest, mesh_ids, cosine)


def cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """Return the intrinsics of a crop, given its top left corner and its size in pixels."""
    return Camera(width, height, camera.fx, camera.fy, camera.cx - left, camera.cy - top)


def pixels_if_unoccluded(
    scene: Geometry, mesh_id: int, camera: Camera, frame_from_camera: Pose
) -> int:
    """Count the pixels that mesh ``mesh_id`` would have if nothing occluded it.

    Pixels up to one image width or height beyond the image border count, too. The result is 0 if a
    vertex has a depth of at most `NEAR_M`. ``scene`` and ``frame_from_camera`` are as for `render`.
    """
    triangles = scene.triangles[scene.mesh_ids == mesh_id]
    if len(triangles) == 0:
        return 0
    used, corners = np.unique(triangles, return_inverse=True)
    alone = Geometry(
        scene.vertices[used], corners.reshape(-1, 3), np.zeros(len(triangles), np.int32)
    )
    r, t = frame_from_camera.rotation, frame_from_camera.translation
    local = (alone.vertices - t) @ r
    if local[:, 2].min() <= NEAR_M:
        return 0
    u = camera.fx * local[:, 0] / local[:, 2] + camera.cx
    v = camera.fy * local[:, 1] / local[:, 2] + camera.cy
    w, h = camera.width, camera.height
    left, right = (int(np.clip(x, -w, 2 * w)) for x in (u.min() - 1, u.max() + 2))
    top, bottom = (int(np.clip(y, -h, 2 * h)) for y in (v.min() - 1, v.max() + 2))
    if right <= left or bottom <= top:
        return 0
    part = cropped(camera, left, top, right - left, bottom - top)
    return int((render(alone, part, frame_from_camera).mesh_ids >= 0).sum())


@kernel
def _place(points: F8, rotation: F8, translation: F8, out: F8) -> None:
    """Write points (n, 3), transformed by a rotation (3, 3) and a translation (3,), to ``out``."""
    for i in range(points.shape[0]):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        for k in range(3):
            turned = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z
            out[i, k] = turned + translation[k]


@kernel
def _rasterize(
    points: F8,
    triangles: I4,
    intrinsics: F8,
    nearest: F8,
    triangle_ids: I4,
    normals: F8,
) -> None:
    """Find the nearest triangle of each pixel, and the normal of each triangle.

    ``points`` (n, 3) are in the optical frame, metres; ``intrinsics`` are fx, fy, cx, cy in pixels.
    Where a pixel shows a triangle, write the inverse depth (1/m) into ``nearest`` (h, w), 0 on
    entry, and the triangle's index into ``triangle_ids`` (h, w). Write the unit normals of these
    triangles, pointing away from the camera, into ``normals`` (m, 3).
    """
    height, width = nearest.shape
    fx, fy, cx, cy = intrinsics
    edge = np.zeros((3, 3))
    slope = np.zeros(3)
    reciprocal = np.zeros(3)
    for m in range(triangles.shape[0]):
        a, b, c = triangles[m, 0], triangles[m, 1], triangles[m, 2]
        ax, ay, az = points[a, 0], points[a, 1], points[a, 2]
        bx, by, bz = points[b, 0], points[b, 1], points[b, 2]
        dx, dy, dz = points[c, 0], points[c, 1], points[c, 2]
        if az <= NEAR_M and bz <= NEAR_M and dz <= NEAR_M:
            continue
        top, bottom, left, right = 0, height - 1, 0, width - 1
        if az > NEAR_M and bz > NEAR_M and dz > NEAR_M:
            v0, v1, v2 = ay / az, by / bz, dy / dz
            top = max(top, int(np.ceil(fy * min(v0, v1, v2) + cy)))
            bottom = min(bottom, int(np.floor(fy * max(v0, v1, v2) + cy)))
            u0, u1, u2 = ax / az, bx / bz, dx / dz
            # One pixel more on each side: the spans below decide, in the same way for neighbours.
            left = max(left, int(np.floor(fx * min(u0, u1, u2) + cx)))
            right = min(right, int(np.ceil(fx * max(u0, u1, u2) + cx)))
            if top > bottom or left > right:
                continue
        # Normals of the planes through the camera and the edges.
        edge[0, 0], edge[0, 1], edge[0, 2] = by * dz - bz * dy, bz * dx - bx * dz, bx * dy - by * dx
        edge[1, 0], edge[1, 1], edge[1, 2] = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
        edge[2, 0], edge[2, 1], edge[2, 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        det = ax * edge[0, 0] + ay * edge[0, 1] + az * edge[0, 2]
        if abs(det) < 1e-18:
            continue  # edge-on
        sign = 1.0 if det > 0 else -1.0
        for k in range(3):
            edge[k, 0] *= sign
            edge[k, 1] *= sign
            edge[k, 2] *= sign
            slope[k] = edge[k, 0] / fx
            reciprocal[k] = 1.0 / slope[k] if slope[k] != 0 else 0.0
        nx = edge[0, 0] + edge[1, 0] + edge[2, 0]
        ny = edge[0, 1] + edge[1, 1] + edge[2, 1]
        nz = edge[0, 2] + edge[1, 2] + edge[2, 2]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        normals[m, 0], normals[m, 1], normals[m, 2] = nx / length, ny / length, nz / length
        scale = 1.0 / abs(det)
        per_pixel = nx / fx * scale
        for v in range(top, bottom + 1):
            y = (v - cy) / fy
            low, high = float(left), float(right)
            for k in range(3):
                start = edge[k, 1] * y + edge[k, 2] - slope[k] * cx
                if slope[k] > 0:
                    low = max(low, -start * reciprocal[k])
                elif slope[k] < 0:
                    high = min(high, -start * reciprocal[k])
                elif start < 0:
                    high = -1.0
            if not low <= high:
                continue
            constant = (ny * y + nz) * scale - per_pixel * cx
            for u in range(int(np.ceil(low)), int(np.floor(high)) + 1):
                inverse_depth = per_pixel * u + constant
                if inverse_depth > nearest[v, u]:
                    nearest[v, u] = inverse_depth
                    triangle_ids[v, u] = m


@kernel
def _shade(
    triangle_ids: I4, normals: F8, ids: I4, intrinsics: F8, mesh_ids: I4, cosine: F4
) -> None:
    """Write mesh ids (-1 for none) and cosines of the angles of incidence, both (h, w).

    ``triangle_ids`` (h, w) are from `_rasterize`, ``normals`` (m, 3) and mesh ids ``ids`` (m,)
    those of the triangles; ``intrinsics`` are fx, fy, cx, cy.
    """
    fx, fy, cx, cy = intrinsics
    for v in range(triangle_ids.shape[0]):
        y = (v - cy) / fy
        for u in range(triangle_ids.shape[1]):
            m = triangle_ids[v, u]
            mesh_ids[v, u] = -1
            if m >= 0:
                x = (u - cx) / fx
                facing = normals[m, 0] * x + normals[m, 1] * y + normals[m, 2]
                cosine[v, u] = facing / np.sqrt(x * x + y * y + 1.0)
                mesh_ids[v, u] = ids[m]
