"""Niantic's SPZ, versions 2 and 3: a gzip stream of fixed-point columns, 20 to 65 bytes a Gaussian before gzip.

A header of 16 bytes, then by column: centres (24-bit fixed point), opacities, colours, log-scales, rotations
(version 2: xyz as bytes; version 3: the smallest three components with 10 bits each), colour coefficients. The frame
has y up: half a turn about x from that of PLY.

Source: the format's own description, https://github.com/nianticlabs/spz.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import Final

import numpy as np

from pop_fast.errors import PopError
from pop_fast.io.budget import check_memory
from pop_fast.io.formats.cloud import COEFFICIENTS, Cloud, logits_of_bytes, to_bytes
from pop_fast.io.formats.smallest_three import drop_largest, restore_largest

MAGIC: Final = 0x5053474E
_HEADER: Final = struct.Struct("<IIIBBBB")
_ANTIALIASED: Final = 1
# a centre's largest fixed-point number
_LARGEST: Final = 2**23 - 1
# of a centre; the fewest are those of large Gaussians, if it is not too far for as many
_MOST_FRACTION_BITS: Final = 20
_LEAST_FRACTION_BITS: Final = 5
# colours are bytes over a range wider than [0, 1]
_COLOR: Final = 0.15 * 255.0
# of a Gaussian's smallest scale, what its centre is a multiple of at most
_CENTRE_STEP: Final = 1.0 / 8.0
# steps of the coefficients of a Gaussian of typical visibility, and the widest, of 128 in [0, 1]
_SH_STEP: Final = 2.5
_WIDEST_STEP: Final = 64
# what deflate can expand a byte to, at most
_EXPANSION: Final = 1032
# bytes of a Gaussian while it is decoded, at most
_IN_MEMORY: Final = 700
_WRITE_AGAIN: Final = "copy or write the file again"


def encode(cloud: Cloud, version: int = 3, sh_step: float = _SH_STEP) -> bytes:
    """Write SPZ; the order of the Gaussians is kept.

    gzip makes the less of the bytes the rounder their numbers are: centres are rounded to an eighth of the Gaussian's
    smallest scale, and the colours of Gaussians that are hardly seen more than those of the others.

    Args:
        cloud: what to write.
        version: 2 or 3, which differ in the rotations.
        sh_step: what the coefficients of a Gaussian of typical visibility are multiples of, in 1/128; 1 to 64.

    Returns:
        The file's bytes.

    Raises:
        PopError: a centre is too far from the origin for 24 bits.
    """
    turned = cloud.turned("x")
    bits = _fraction_bits(turned.means)
    flags = _ANTIALIASED if cloud.antialiased else 0
    header = _HEADER.pack(MAGIC, version, len(cloud), cloud.degree, bits, flags, 0)
    columns = [
        _centres(turned, bits).astype("<i4").reshape(-1, 1).view(np.uint8).reshape(-1, 4)[:, :3],
        to_bytes(255.0 * cloud.opacities),
        to_bytes(_COLOR * cloud.sh0.astype(np.float64) + 127.5),
        to_bytes(16.0 * (cloud.log_scales.astype(np.float64) + 10.0)),
        _rotations(turned.quats, version),
        _coefficients(turned.rest, cloud.visibility, sh_step),
    ]
    return gzip.compress(header + b"".join(column.tobytes() for column in columns), 9, mtime=0)


def _fraction_bits(means: np.ndarray) -> int:
    """Choose as many fractional bits as the farthest centre leaves."""
    far = float(np.abs(means).max(initial=0.0))
    bits = min(_MOST_FRACTION_BITS, int(np.floor(np.log2(_LARGEST / max(far, 1e-6)))))
    if bits < 0:
        raise PopError(f"a centre is {far:.3g} from the origin; SPZ holds up to {_LARGEST}: crop, or choose SOG or PLY")
    return bits


def _centres(cloud: Cloud, bits: int) -> np.ndarray:
    """Return fixed-point centres, rounded to powers of two that are small beside the Gaussians. float64 [N, 3]"""
    smallest = cloud.log_scales.min(axis=1, keepdims=True).astype(np.float64) / np.log(2.0)
    step = 2.0 ** np.clip(np.floor(smallest + np.log2(_CENTRE_STEP)), -bits, max(-bits, -_LEAST_FRACTION_BITS))
    return np.clip(np.rint(cloud.means / step) * step * 2.0**bits, -_LARGEST, _LARGEST)


def _rotations(quats: np.ndarray, version: int) -> np.ndarray:
    xyzw = quats[:, [1, 2, 3, 0]]
    if version == 2:
        return to_bytes(127.5 + 127.5 * xyzw[:, :3].astype(np.float64) * np.where(xyzw[:, 3:] < 0.0, -1.0, 1.0))
    largest, three = drop_largest(xyzw)
    magnitudes = np.clip(np.rint(511.0 * np.sqrt(2.0) * np.abs(three)), 0, 511).astype(np.uint32)
    parts = magnitudes | (three < 0.0).astype(np.uint32) << 9
    word = largest.astype(np.uint32) << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
    return word.astype("<u4")


def _coefficients(rest: np.ndarray, visibility: np.ndarray, step: float) -> np.ndarray:
    """Round colour coefficients, those of degrees 2 and 3 a little more; 0 stays 0."""
    of_row = step * np.sqrt(_typical(visibility) / np.maximum(visibility, 1e-30))
    of_degree = np.where(np.arange(rest.shape[1]) < 3, 1.0, 1.25)
    steps = np.clip(np.rint(of_row[:, None] * of_degree), 1, _WIDEST_STEP)[..., None]
    return to_bytes(np.rint(128.0 * rest.astype(np.float64) / steps) * steps + 128.0)


def _typical(visibility: np.ndarray) -> float:
    """Return the visibility under which a fifth of all of it lies: that of what is seen, however many hardly are."""
    rising = np.sort(visibility)
    sums = np.cumsum(rising)
    return float(rising[np.searchsorted(sums, 0.2 * sums[-1])]) if len(rising) else 1.0


def decode(data: bytes, path: Path) -> Cloud:
    """Read SPZ.

    Args:
        data: the file's bytes.
        path: its name, for errors.

    Raises:
        PopError: it is damaged, cut off, or of another version; names the field.
    """
    raw, (version, n, degree, bits, flags) = _unpacked(data, path)
    sizes = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * COEFFICIENTS[degree])
    at, columns = _HEADER.size, []
    for size in sizes:
        columns.append(np.frombuffer(raw, np.uint8, n * size, at).reshape(n, size))
        at += n * size
    centres, opacities, colors, scales, rotations, rest = columns
    fixed = centres.reshape(n, 3, 3).astype(np.int32) @ np.array([1, 2**8, 2**16], np.int32)
    fixed -= (fixed >= 2**23).astype(np.int32) << 24
    cloud = Cloud(
        means=(fixed / 2.0**bits).astype(np.float32),
        log_scales=(scales / 16.0 - 10.0).astype(np.float32),
        quats=_quats(rotations, version).astype(np.float32),
        logits=logits_of_bytes(opacities[:, 0]),
        sh0=((colors - 127.5) / _COLOR).astype(np.float32),
        rest=((rest.reshape(n, rest.shape[1] // 3, 3) - 128.0) / 128.0).astype(np.float32),
        antialiased=bool(flags & _ANTIALIASED),
    )
    return cloud.turned("x").checked(path)


def _quats(stored: np.ndarray, version: int) -> np.ndarray:
    if version == 2:
        xyz = stored / 127.5 - 1.0
        w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1, keepdims=True)))
        return np.concatenate([w, xyz], axis=1)
    word = np.ascontiguousarray(stored).view("<u4")[:, 0]
    parts = (word[:, None] >> np.array([20, 10, 0], np.uint32)) & np.uint32(1023)
    three = (parts & 511) / (511.0 * np.sqrt(2.0)) * np.where(parts & 512, -1.0, 1.0)
    return restore_largest((word >> 30).astype(np.int64), three)[:, [3, 0, 1, 2]]


def _unpacked(data: bytes, path: Path) -> tuple[bytes, tuple[int, int, int, int, int]]:
    """Return the columns with their header, whose promises hold, and its version, count, degree, bits and flags."""
    if data[:4] == struct.pack("<I", MAGIC):
        raise PopError(f"{path}: is SPZ of version 4 or later; write it as version 3, which this program reads")
    stream = zlib.decompressobj(31)
    try:
        head = stream.decompress(data, _HEADER.size)
        if len(head) < _HEADER.size:
            raise PopError(f"{path}: is cut off in its header; {_WRITE_AGAIN}")
        magic, version, n, degree, bits, flags, _ = _HEADER.unpack(head)
        if magic != MAGIC:
            raise PopError(f"{path}: begins with {magic:#x}, not {MAGIC:#x}: it is no SPZ file")
        if version not in (2, 3):
            raise PopError(f"{path}: version is {version}; write it as version 2 or 3, which this program reads")
        if degree > 3:
            raise PopError(f"{path}: shDegree is {degree}; it must be 0 to 3: write it with fewer degrees")
        if bits > 24:
            raise PopError(f"{path}: fractionalBits is {bits}; it must be 0 to 24: {_WRITE_AGAIN}")
        size = n * (19 + (version == 3) + 3 * COEFFICIENTS[degree])
        if size > _EXPANSION * len(data):
            raise PopError(f"{path}: numPoints is {n}, more than {len(data)} bytes can hold; {_WRITE_AGAIN}")
        check_memory(path, n * _IN_MEMORY, len(data), f"its numPoints of {n}", _WRITE_AGAIN)
        body = stream.decompress(stream.unconsumed_tail, size + 1)
    except zlib.error as error:
        raise PopError(f"{path}: its gzip stream is damaged ({error}); {_WRITE_AGAIN}") from error
    if len(body) < size:
        raise PopError(f"{path}: ends after {len(body)} of {size} bytes of its columns; {_WRITE_AGAIN}")
    return head + body, (version, n, degree, bits, flags)
