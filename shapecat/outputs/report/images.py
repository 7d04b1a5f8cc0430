"""Pictures of frames, from the colour image or the shaded depth image, and crops of objects."""

import base64
import io
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image
from scipy import ndimage

from shapecat.arrays import F4, F8, U1, U4, Bool, Record, array, freeze
from shapecat.colour.masks import Mask, dense_masks
from shapecat.colour.outline import outlines
from shapecat.detection.output.settings import OUTPUT
from shapecat.detection.virtual_camera import top_view, virtual_image
from shapecat.geometry import gravity_rotation
from shapecat.outputs.colouring import Coloured
from shapecat.recordings.decoding.colour_image import pixels_of
from shapecat.recordings.messages import MessageError
from shapecat.types import Camera, Frame, LabelledFrame

__all__ = ["Crop", "FramePicture", "crop_of", "encode", "prepare_picture", "worth_of"]

_CROP_PX = 256
"""Longest side of the picture of an object."""

_FRAME_PX = 960
"""Longest side of the picture of a frame."""
_MARGIN = 1.5
"""Side of a crop, relative to the longer side of the object's box."""
_LEAST_PX = 24
"""Shortest side of a crop in the frame, unless the frame is smaller."""
_GOOD_PX = 160
"""Square root of the mask area above which a larger object scores no higher."""
_GOOD_DETAIL = 12.0
"""Standard deviation of the Laplacian at which sharpness is 0.5, grey levels."""
_NEARER = 0.015
"""A pixel occludes its neighbour if it is nearer by this many metres plus this share of depth."""
_FAR_M = 6.0
"""Range of the virtual camera that shows a cloud."""
_SAME_SURFACE = 0.02
"""Neighbours whose inverse depths differ by less than this fraction are on the same surface."""
_NEAR_TONE, _FAR_TONE = np.array([[255, 238, 205], [92, 112, 168]], np.float32)
_BLANK = 24
"""Grey level of pixels without depth."""
_LIGHT = np.array([-0.45, -0.65, -0.62], np.float32)
"""Direction to the light in the optical frame: above, left and towards the camera."""


Window = tuple[int, int, int, int]
"""Left, top, right and bottom, pixels; the last two are exclusive."""


class FramePicture(Record):
    """A frame prepared for pictures.

    Attributes
    ----------
    masks : the mask of each object of the frame, in order.
    hidden : (n,) fraction of each object's outline along which something nearer occludes it.
    image_frame : the frame as a depth image; a cloud is projected into a virtual camera.
    colour : (h, w, 3) red, green, blue; None if the depth image is shown.
    """

    masks: tuple[Mask, ...]
    hidden: F8 = array("n", "f8")
    image_frame: Frame
    colour: U1 | None = array("h w 3", "u1", default=None)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the picture."""
        height, width, *_ = np.asarray(
            self.image_frame.depth if self.colour is None else self.colour
        ).shape
        return height, width

    def pixels(self, window: Window | None = None) -> U1:
        """Return a part of the picture, (h, w, 3) red, green, blue; by default all of it."""
        left, top, right, bottom = window or (0, 0, *self.shape[::-1])
        if self.colour is not None:
            return np.ascontiguousarray(self.colour[top:bottom, left:right])
        return _shaded(self.image_frame, (left, top, right, bottom))


class Crop(NamedTuple):
    """A picture of an object: data URI, size in pixels, and the outline as SVG path data."""

    image: str
    width: int
    height: int
    outline: str


def prepare_picture(
    labelled: LabelledFrame, frame: Frame, coloured: Coloured | None
) -> FramePicture | None:
    """Return a frame prepared for pictures; None for a cloud that no virtual camera can show.

    If the colour image is damaged, the depth image is shown.
    """
    organized = _organized(labelled, frame)
    if organized is None:
        return None
    image_frame, objects = organized
    hidden = np.array([_hidden_share(image_frame.depth, pixels) for pixels in objects])
    if coloured is not None and frame.organized and coloured.view.image.height > 1:
        try:
            return FramePicture(coloured.masks, hidden, image_frame, pixels_of(coloured.view.image))
        except MessageError:
            pass  # damaged image: show depth instead
    return FramePicture(dense_masks(image_frame, objects), hidden, image_frame)


def _organized(labelled: LabelledFrame, frame: Frame) -> tuple[Frame, list[U4]] | None:
    """Return a frame as a depth image, and its objects as flat indices of pixels.

    Return None for a cloud that no virtual camera can show.
    """
    indices = [item.indices for item in labelled.objects]
    if frame.depth is not None:
        return frame, indices
    points = frame.xyz()
    turn = _upright(points, labelled.up)
    points = freeze(points @ turn.T, "n 3", "f4")  # kernels are compiled for read-only points
    view = virtual_image(points, range_m=_FAR_M)
    if view is None or view.crowded > OUTPUT.crowded:
        up, rng = np.array([0.0, -1.0, 0.0]), np.random.default_rng(0)
        view = top_view(points, up, range_m=_FAR_M, rng=rng) or view
    if view is None:
        return None
    inverse = view.grid.inverse_depth
    depth = np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    camera = Camera(depth.shape[1], depth.shape[0], *view.grid.intrinsics)
    cells = [np.unique(view.cell[pixels]) for pixels in indices]
    organized_frame = Frame(
        frame.topic, frame.index, frame.stamp_ns, frame.log_time_ns, frame.frame_id, depth, camera
    )
    return organized_frame, [cell[cell >= 0].astype(np.uint32) for cell in cells]


def _upright(points: F4, up: F4) -> F8:
    """Return the rotation (3, 3) from the sensor to a level optical frame that faces a cloud."""
    level = gravity_rotation(up)
    x, y, _ = np.nan_to_num(np.nanmean(points @ level.T, axis=0)) if len(points) else (1.0, 0, 0)
    norm = np.hypot(x, y)
    x, y = (x / norm, y / norm) if norm > 1e-6 else (1.0, 0.0)
    return np.asarray(np.array([[y, -x, 0], [0, 0, -1], [x, y, 0]]) @ level)


def _hidden_share(depth: F4 | None, pixels: U4) -> float:
    """Return the fraction of an object's outline along which the pixels outside are nearer.

    ``depth`` is (h, w) in metres, ``pixels`` (n,) are flat indices of the object.
    """
    if depth is None or not pixels.size:
        return 0.0
    v, u = np.divmod(np.asarray(pixels, np.int64), depth.shape[1])
    inside = np.zeros((int(np.ptp(v)) + 3, int(np.ptp(u)) + 3), bool)
    inside[v - v.min() + 1, u - u.min() + 1] = True
    padded = np.pad(depth, 1)
    window = padded[v.min() : v.max() + 3, u.min() : u.max() + 3]
    outline = hidden = 0
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        outside = inside & ~np.roll(inside, step, axis)
        beyond = np.roll(window, step, axis)[outside]
        outline += int(np.count_nonzero(outside))
        limit = window[outside] * (1 - _NEARER) - _NEARER
        hidden += int(np.count_nonzero((beyond > 0) & (beyond < limit)))
    return hidden / max(outline, 1)


def _shaded(frame: Frame, window: Window) -> U1:
    """Return a part of a depth image as a shaded relief (h, w, 3), lit from above left.

    The inverse depth of a plane is linear in the image, so that its slopes give the normals.
    """
    left, top, right, bottom = window
    depth, camera = np.asarray(frame.depth)[top:bottom, left:right], frame.camera
    valid = depth > 0
    if camera is None or not valid.any():
        return np.full((*depth.shape, 3), _BLANK, np.uint8)
    inverse = _smooth(np.divide(1, depth, out=np.zeros_like(depth), where=valid))
    along, across = (_slope(inverse, axis) for axis in (0, 1))
    v, u = np.indices(depth.shape, np.float32)
    towards = inverse - across * (u + left - camera.cx) - along * (v + top - camera.cy)
    normal = -np.stack([across * camera.fx, along * camera.fy, towards], axis=-1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    light = 0.3 + 0.7 * np.clip(normal @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    nearest, farthest = np.percentile(depth[valid], [2, 98])
    share = np.clip((depth - nearest) / max(farthest - nearest, 0.05), 0, 1)[..., None]
    tone = light[..., None] * (_NEAR_TONE * (1 - share) + _FAR_TONE * share)
    return np.where(valid[..., None], tone, _BLANK).astype(np.uint8)


def _smooth(inverse: F4, passes: int = 6) -> F4:
    """Average inverse depths (h, w) with their neighbours on the same surface."""
    behind, ahead = slice(None, -1), slice(1, None)
    for _ in range(passes):
        total, weight, limit = inverse.copy(), np.ones_like(inverse), _SAME_SURFACE * inverse
        for before, after in (((behind,), (ahead,)), ((..., behind), (..., ahead))):
            apart = np.abs(inverse[after] - inverse[before])
            for at, beside in ((before, after), (after, before)):
                same_surface = apart < limit[at]
                total[at] += same_surface * inverse[beside]
                weight[at] += same_surface
        inverse = total / weight
    return inverse


def _slope(inverse: F4, axis: int) -> F4:
    """Return the smaller one-sided difference (h, w) along an axis, which keeps edges sharp."""
    step = np.diff(inverse, axis=axis)
    ends = [(1, 0) if k == axis else (0, 0) for k in (0, 1)]
    before = np.pad(step, ends, mode="edge")
    after = np.pad(step, [pair[::-1] for pair in ends], mode="edge")
    return np.where(np.abs(before) < np.abs(after), before, after)


def encode(pixels: U1, *, quality: int = 72) -> tuple[str, int, int]:
    """Return a picture as a data URI, shrunk to `_FRAME_PX` if larger, and its width and height.

    ``pixels`` is (h, w, 3) or, with opacity, (h, w, 4); ``quality`` is that of WebP, 0 to 100.
    """
    image = Image.fromarray(np.ascontiguousarray(pixels))
    image.thumbnail((_FRAME_PX, _FRAME_PX))
    file = io.BytesIO()
    image.save(file, "webp", quality=quality, method=4)
    text = base64.b64encode(file.getvalue()).decode("ascii")
    return f"data:image/webp;base64,{text}", image.width, image.height


def _window(image: FramePicture, mask: Mask) -> Window:
    """Return left, top, right and bottom of a square around an object, within the image."""
    height, width = image.shape
    x, y, w, h = mask.box
    side = round(max(_MARGIN * max(w, h), _LEAST_PX))
    left = round(min(max(x + (w - side) / 2, 0), max(width - side, 0)))
    top = round(min(max(y + (h - side) / 2, 0), max(height - side, 0)))
    return left, top, min(left + side, width), min(top + side, height)


def _cut(frame_image: FramePicture, window: Window) -> Image.Image:
    image = Image.fromarray(frame_image.pixels(window))
    scale = _CROP_PX / max(image.size)
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return image.resize(size, Image.Resampling.BICUBIC if scale > 1 else Image.Resampling.BOX)


def worth_of(image: FramePicture, number: int) -> float:
    """Return a score, from 0 to 1, for the view of an object in a frame.

    The score is the product of four factors: the size (square root of the mask area, saturating at
    160 pixels); the fraction of the outline off the image border, squared; the unoccluded fraction
    of the outline, squared; and the sharpness (below 1; 0.5 without a colour image). An object
    without visible pixels scores 0.

    Parameters
    ----------
    number : index of the object in the frame, from 0.
    """
    mask = image.masks[number]
    if not mask.pixels.size:
        return 0.0
    size = min(1.0, float(np.sqrt(mask.area)) / _GOOD_PX)
    free = 1 - _border_share(mask, *image.shape)
    detail = _GOOD_DETAIL if image.colour is None else _detail(image, mask)
    sharp = detail / (detail + _GOOD_DETAIL)
    return size * free**2 * (1 - float(image.hidden[number])) ** 2 * sharp


def _border_share(mask: Mask, height: int, width: int) -> float:
    """Return the fraction of the outline of a mask that lies on the border of the image."""
    inside = np.pad(mask.pixels, 1)
    outline = sum(
        int(np.count_nonzero(inside & ~np.roll(inside, step, axis)))
        for axis in (0, 1)
        for step in (1, -1)
    )
    left, top, w, h = mask.box
    sides = (
        (left <= 0, mask.pixels[:, 0]),
        (top <= 0, mask.pixels[0]),
        (left + w >= width, mask.pixels[:, -1]),
        (top + h >= height, mask.pixels[-1]),
    )
    return sum(int(side.sum()) for touches, side in sides if touches) / max(outline, 1)


def _detail(image: FramePicture, mask: Mask) -> float:
    """Return the standard deviation of the Laplacian inside an object, in its crop, grey levels."""
    window = _window(image, mask)
    grey = np.asarray(_cut(image, window).convert("L"), np.float32)
    inside = _inside(mask.full(*image.shape), window, grey.shape)
    return float(ndimage.laplace(grey)[inside].std()) if inside.any() else 0.0


def _inside(mask: Bool, window: Window, shape: Sequence[int]) -> Bool:
    """Return a mask, cut to a window and resized to ``shape``, without the rim of the object.

    The rim is removed because the edge of an object adds contrast.
    """
    left, top, right, bottom = window
    mask_image = Image.fromarray(mask[top:bottom, left:right])
    small = mask_image.resize((shape[1], shape[0]), Image.Resampling.NEAREST)
    return np.asarray(ndimage.binary_erosion(np.asarray(small), iterations=3))


def crop_of(image: FramePicture, number: int) -> Crop:
    """Return the picture of an object in a frame; ``number`` is its index in ``image.masks``."""
    mask = image.masks[number]
    window = _window(image, mask)
    uri, width, height = encode(np.asarray(_cut(image, window)), quality=82)
    scale = np.array([width / (window[2] - window[0]), height / (window[3] - window[1])])
    rings = [(ring - window[:2]) * scale for ring in outlines(mask)]
    return Crop(uri, width, height, "".join(map(_path, rings)))


def _path(ring: F8) -> str:
    corners = " ".join(f"{x:.0f} {y:.0f}" for x, y in ring.tolist())
    return f"M{corners}Z"
