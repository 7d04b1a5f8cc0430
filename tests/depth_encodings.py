"""Encoders of compressed depth images, independent of the decoders under test."""

import struct
import zlib
from typing import Any

import numpy as np


def png(values: Any) -> bytes:
    """Encode values (h, w) as a 16-bit grey PNG that uses every row filter in turn."""
    rows = values.astype(">u2").view(np.uint8).astype(int)
    left, up = np.zeros_like(rows), np.zeros_like(rows)
    left[:, 2:], up[1:] = rows[:, :-2], rows[:-1]
    corner = np.zeros_like(rows)
    corner[1:, 2:] = rows[:-1, :-2]
    p = left + up - corner
    dl, du, dc = abs(p - left), abs(p - up), abs(p - corner)
    nearest = np.where((dl <= du) & (dl <= dc), left, np.where(du <= dc, up, corner))
    predictions = [np.zeros_like(rows), left, up, (left + up) // 2, nearest]
    data = b"".join(
        bytes([y % 5]) + ((rows[y] - predictions[y % 5][y]) % 256).astype(np.uint8).tobytes()
        for y in range(len(rows))
    )
    head = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], 16, 0, 0, 0, 0)
    packed = zlib.compress(data)
    half = len(packed) // 2
    chunks = [(b"IHDR", head), (b"IDAT", packed[:half]), (b"IDAT", packed[half:]), (b"IEND", b"")]
    body = b"".join(
        struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body


def rvl(values: Any) -> bytes:
    """Encode values (h, w) in RVL, as described in its paper."""
    nibbles: list[int] = []

    def put(number: int) -> None:
        while True:
            part, number = number & 7, number >> 3
            nibbles.append(part | (8 if number else 0))
            if not number:
                return

    flat, at, previous = values.ravel().tolist(), 0, 0
    while at < len(flat):
        zeros = at
        while at < len(flat) and flat[at] == 0:
            at += 1
        put(at - zeros)
        begin = at
        while at < len(flat) and flat[at] != 0:
            at += 1
        put(at - begin)
        for value in flat[begin:at]:
            delta = value - previous
            put((delta << 1) ^ (delta >> 63))
            previous = value
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        sum(nibble << (28 - 4 * k) for k, nibble in enumerate(nibbles[start : start + 8]))
        for start in range(0, len(nibbles), 8)
    ]
    size = struct.pack("<II", values.shape[1], values.shape[0])
    return size + np.array(words, "<u4").tobytes()
