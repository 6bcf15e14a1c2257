"""Arrays as short strings of bytes that a browser can read.

Positions are rounded to 16 bits of the domain's edge, a thousandth of a cell of the usual grid. Clay moves evenly, so that what is
kept of each frame is its difference from the continued motion of the two frames before. The differences are small: their low and
high bytes, each on their own, and particles in the order of a space-filling curve, leave little for zlib to write. A browser reads
zlib by itself (``DecompressionStream("deflate")``).
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

QUANTA = 65535
"""Steps that the edge of the domain is divided into."""

BITS = 16
LEVEL = 9
"""Effort of zlib, from 1 to 9."""

Numbers = NDArray[np.floating[Any]]


def quantise(positions: Numbers) -> NDArray[np.uint16]:
    """Round positions (..., 3) in the domain, length units, to whole steps; what lies outside is moved to the boundary."""
    return np.round(np.clip(positions, 0.0, 1.0) * QUANTA).astype(np.uint16)


def spatial_order(positions: Numbers) -> NDArray[np.int64]:
    """Indices (N,) that put particles (N, 3) along a space-filling curve (Morton's), so that neighbours stand together."""
    code = np.zeros(len(positions), dtype=np.uint64)
    whole = quantise(positions).astype(np.uint64)
    for axis in range(3):
        for bit in range(BITS):
            code |= ((whole[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def encode_frames(positions: Numbers) -> bytes:
    """Write positions (T, N, 3) at T times; `decode_frames` and the page's script read them."""
    whole = quantise(positions).astype(np.int64)
    change = np.diff(whole, axis=0, prepend=0)
    change[2:] -= change[1:-1].copy()
    # Neighbours in the first frame are near each other, too.
    change[0] = np.diff(whole[0], axis=0, prepend=0)
    even = (change << 1) ^ (change >> 63)
    by_axis = (even & 0xFFFFFF).astype(np.uint32).transpose(0, 2, 1)
    return zlib.compress(np.stack([(by_axis >> shift) & 0xFF for shift in (0, 8, 16)]).astype(np.uint8).tobytes(), LEVEL)


def decode_frames(data: bytes, *, particle_count: int) -> Numbers:
    """Read positions (T, N, 3), length units, that `encode_frames` wrote; they differ by half a step at most."""
    planes = np.frombuffer(zlib.decompress(data), dtype=np.uint8).reshape(3, -1, 3, particle_count).astype(np.int64)
    even = (planes[0] | (planes[1] << 8) | (planes[2] << 16)).transpose(0, 2, 1)
    change = (even >> 1) ^ -(even & 1)
    change[0] = np.cumsum(change[0], axis=0)
    change[1:] = np.cumsum(change[1:], axis=0)
    return np.cumsum(change, axis=0) / QUANTA


def encode_array(values: NDArray[Any]) -> bytes:
    """Write the numbers of an array one after the other, lowest byte first."""
    return zlib.compress(np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<")).tobytes(), LEVEL)


def encode_levels(values: Numbers) -> tuple[bytes, float, float]:
    """Write numbers (N,) in 256 levels between the least and the largest; give them, too. Numbers that are not finite are 0."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    share = np.nan_to_num((values - low) / max(high - low, 1e-12))
    return encode_array(np.round(255.0 * np.clip(share, 0.0, 1.0)).astype(np.uint8)), low, high
