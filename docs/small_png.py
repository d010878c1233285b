"""A screen's picture in 256 colours, which is a quarter of the bytes and looks the same."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]
SIGNATURE = b"\x89PNG\r\n\x1a\n"


def smaller(png: bytes) -> bytes:
    """The picture (8-bit RGB or RGBA, not interlaced) with a palette of its most frequent colours."""
    pixels = _pixels(png)[:, :, :3]
    flat = pixels.reshape(-1, 3).astype(np.int32)
    codes = (flat[:, 0] << 16) | (flat[:, 1] << 8) | flat[:, 2]
    found, back, counts = np.unique(codes, return_inverse=True, return_counts=True)
    kept = found[np.argsort(-counts)[:256]]
    palette = np.stack([kept >> 16, (kept >> 8) & 255, kept & 255], axis=1)
    every = np.stack([found >> 16, (found >> 8) & 255, found & 255], axis=1)
    nearest = np.array([np.abs(palette - colour).sum(axis=1).argmin() for colour in every], np.uint8)
    height, width = pixels.shape[:2]
    rows = nearest[back].reshape(height, width)
    raw = b"".join(b"\x00" + row.tobytes() for row in rows)
    head = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    parts = ((b"IHDR", head), (b"PLTE", palette.astype(np.uint8).tobytes()), (b"IDAT", zlib.compress(raw, 9)))
    return SIGNATURE + b"".join(_chunk(*part) for part in (*parts, (b"IEND", b"")))


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _pixels(png: bytes) -> Bytes:
    """(height, width, channels), the row filters of PNG (ISO/IEC 15948, 9.2) undone."""
    width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", png[16:29])
    if png[:8] != SIGNATURE or depth != 8 or colour not in (2, 6) or interlaced:
        raise ValueError("only 8-bit RGB and RGBA pictures, not interlaced")
    at, data = 8, b""
    while at < len(png):
        (length,) = struct.unpack(">I", png[at : at + 4])
        if png[at + 4 : at + 8] == b"IDAT":
            data += png[at + 8 : at + 8 + length]
        at += length + 12
    channels = 3 if colour == 2 else 4
    lines = np.frombuffer(zlib.decompress(data), np.uint8).reshape(height, 1 + width * channels)
    pixels: Bytes = np.zeros((height, width, channels), np.uint8)
    above = np.zeros((width, channels), np.uint8)
    for row, line in enumerate(lines):
        above = pixels[row] = _unfiltered(int(line[0]), line[1:].reshape(width, channels), above)
    return pixels


def _unfiltered(kind: int, line: Bytes, above: Bytes) -> Bytes:
    if kind == 0:
        return line
    if kind == 1:
        return np.cumsum(line, axis=0, dtype=np.uint8)
    if kind == 2:
        return line + above
    out = [[0] * line.shape[1]]
    corner = [0] * line.shape[1]
    for now, up in zip(line.tolist(), above.tolist(), strict=True):
        left = out[-1]
        if kind == 3:
            out.append([(n + (a + b) // 2) & 255 for n, a, b in zip(now, left, up, strict=True)])
        else:
            out.append([(n + _paeth(a, b, c)) & 255 for n, a, b, c in zip(now, left, up, corner, strict=True)])
        corner = up
    return np.array(out[1:], np.uint8)


def _paeth(left: int, up: int, corner: int) -> int:
    guess = left + up - corner
    return min((left, up, corner), key=lambda each: abs(guess - each))
