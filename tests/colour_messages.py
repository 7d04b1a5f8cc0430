"""Builders of colour image messages as drivers publish them."""

import io
from typing import Any

import numpy as np
from PIL import Image

from tests.messages import COMPRESSED, IMAGE, header, make


def jpeg(colours: Any, quality: int = 95) -> bytes:
    """Encode colours (h, w, 3) as JPEG."""
    file = io.BytesIO()
    Image.fromarray(colours).save(file, "jpeg", quality=quality, subsampling=0)
    return file.getvalue()


def png(colours: Any) -> bytes:
    """Encode colours (h, w, 3) as PNG."""
    file = io.BytesIO()
    Image.fromarray(colours).save(file, "png")
    return file.getvalue()


def raw(stamp: int, data: Any, encoding: str, frame_id: str = "camera") -> Any:
    """Make a raw image of ``data`` (h, w) or (h, w, channels), with rows padded by 5 bytes."""
    h, w = data.shape[:2]
    rows = np.ascontiguousarray(data).view(np.uint8).reshape(h, -1)
    rows = np.pad(rows, ((0, 0), (0, 5)))
    return make(IMAGE, header(stamp, frame_id), h, w, encoding, 0, rows.shape[1], rows.reshape(-1))


def packed(stamp: int, body: bytes, kind: str = "jpeg", frame_id: str = "camera") -> Any:
    """Make a compressed image of format ``kind`` from its encoded bytes."""
    return make(COMPRESSED, header(stamp, frame_id), kind, np.frombuffer(body, np.uint8))


def gradient(height: int = 48, width: int = 64, seed: int = 0) -> Any:
    """Make an RGB image of smooth gradients, which JPEG preserves; ``seed`` sets the blue."""
    v, u = np.mgrid[:height, :width]
    red, green, blue = 255 * u / width, 255 * v / height, 40 + 10 * seed + 0 * u
    return np.stack([red, green, blue], axis=-1).astype(np.uint8)
