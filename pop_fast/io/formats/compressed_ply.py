"""PlayCanvas's compressed PLY: 16 bytes a Gaussian, in chunks of 256 with their own ranges, and a byte a coefficient.

Elements: `chunk` (ranges of centres, log-scales and colours), `vertex` (four words: centre and scale with 11, 10 and 11
bits, rotation as the smallest three with 10 bits each, colour and opacity with 8 bits each), and `sh` (f_rest bytes,
channel-major as in PLY) where there are colours beyond degree 0. The frame is that of PLY.

Source: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply and the files themselves.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from pop_fast.errors import PopError
from pop_fast.io.formats.cloud import SH_C0, Cloud, drop_largest, logits_of_bytes, restore_largest, to_bytes
from pop_fast.io.ply import Frame, asks_for_antialiasing, header_bytes, header_of, read_header
from pop_fast.io.read_back import WRITE_AGAIN

_CHUNK: Final = 256
_RANGES: Final = tuple(
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"))
    for end in ("min", "max")
    for name in names
)
_COLOR_RANGES: Final = tuple(f"{end}_{name}" for end in ("min", "max") for name in "rgb")
_WORDS: Final = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_VECTOR_BITS: Final = (11, 10, 11)
# log-scales beyond this are cut off
_SCALE_LIMIT: Final = 20.0
# coefficients are bytes over [-4, 4]
_SH_STEPS: Final = 32.0


def is_compressed(path: Path) -> bool:
    """Tell whether a PLY file is of this kind, by its header."""
    columns = {element.name: {name for name, _ in element.columns} for element in read_header(path).elements}
    return "chunk" in columns and set(_WORDS) <= columns.get("vertex", set())


def chunked(cloud: Cloud) -> np.ndarray:
    """Order Gaussians so that those of a chunk are close together: halves along the widest axis. int64 [N]"""
    means = cloud.means
    waiting, done = [np.arange(len(means))], list[np.ndarray]()
    while waiting:
        rows = waiting.pop()
        if len(rows) <= _CHUNK:
            done.append(rows)
            continue
        values = means[rows, np.ptp(means[rows], axis=0).argmax()]
        # whole chunks before the cut, so that every chunk is one of these parts
        cut = _CHUNK * (-(-len(rows) // _CHUNK) // 2)
        order = np.argsort(values, kind="stable")
        waiting += [rows[order[cut:]], rows[order[:cut]]]
    return np.concatenate(done)


def encode(cloud: Cloud) -> bytes:
    """Write compressed PLY; the order of the Gaussians is kept, and should be that of `chunked`."""
    n = len(cloud)
    colors = 0.5 + SH_C0 * cloud.sh0.astype(np.float64)
    scales = np.clip(cloud.log_scales.astype(np.float64), -_SCALE_LIMIT, _SCALE_LIMIT)
    ranges, shares = zip(*(_in_chunks(values) for values in (cloud.means, scales, colors)), strict=True)
    chunks = np.concatenate(ranges, axis=1).astype("<f4")
    rgba = to_bytes(255.0 * np.concatenate([shares[2], cloud.opacities[:, None]], axis=1)).astype(np.uint32)
    color = rgba[:, 0] << 24 | rgba[:, 1] << 16 | rgba[:, 2] << 8 | rgba[:, 3]
    words = [_packed_vector(shares[0]), _packed_rotation(cloud.quats), _packed_vector(shares[1]), color]
    flat = cloud.rest.transpose(0, 2, 1).reshape(n, 3 * cloud.rest.shape[1]).astype(np.float64)
    rest = np.clip(np.floor(_SH_STEPS * flat + 128.0), 0, 255).astype(np.uint8)
    elements = [("chunk", len(chunks), "float", (*_RANGES, *_COLOR_RANGES)), ("vertex", n, "uint", _WORDS)]
    elements += [("sh", n, "uchar", [f"f_rest_{i}" for i in range(flat.shape[1])])] if flat.shape[1] else []
    header = header_bytes(cloud.antialiased, cloud.frame, *elements)
    return header + chunks.tobytes() + np.stack(words, axis=1).astype("<u4").tobytes() + rest.tobytes()


def _in_chunks(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return every chunk's lowest and highest values, [C, 6], and where between them each value lies. [N, 3]"""
    starts = np.arange(0, len(values), _CHUNK)
    if len(starts) == 0:
        return np.zeros((0, 6)), np.zeros((0, 3))
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    # as they are stored
    ranges = np.concatenate([low, high], axis=1).astype("<f4").astype(np.float64)
    of_row = ranges[np.arange(len(values)) // _CHUNK]
    width = of_row[:, 3:] - of_row[:, :3]
    shares = (values - of_row[:, :3]) / np.where(width > 0.0, width, 1.0)
    return ranges, np.clip(shares, 0.0, 1.0)


def _packed_vector(shares: np.ndarray) -> np.ndarray:
    x, y, z = (np.rint(shares[:, i] * (2**bits - 1)).astype(np.uint32) for i, bits in enumerate(_VECTOR_BITS))
    return x << 21 | y << 11 | z


def _packed_rotation(quats: np.ndarray) -> np.ndarray:
    largest, three = drop_largest(quats)
    parts = np.clip(np.rint(1023.0 * (0.5 + three / np.sqrt(2.0))), 0, 1023).astype(np.uint32)
    return largest.astype(np.uint32) << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]


def decode(data: bytes, path: Path) -> Cloud:
    """Read compressed PLY."""
    elements = _elements(data, path)
    if "chunk" not in elements or "vertex" not in elements:
        raise PopError(f"{path}: has no element 'chunk' or 'vertex': it is not a compressed PLY")
    chunks, words = elements["chunk"], elements["vertex"]
    n = len(words)
    if len(chunks) * _CHUNK < n:
        raise PopError(
            f"{path}: has {len(chunks)} chunks for {n} vertices; {-(-n // _CHUNK)} are needed: {WRITE_AGAIN}"
        )
    header = header_of(data, path)
    which = np.arange(n) // _CHUNK
    colors = _COLOR_RANGES if set(_COLOR_RANGES) & set(chunks.dtype.names or ()) else ()
    if not {*_RANGES, *colors} <= set(chunks.dtype.names or ()) or not set(_WORDS) <= set(words.dtype.names or ()):
        raise PopError(f"{path}: element 'chunk' or 'vertex' lacks a property of compressed PLY; {WRITE_AGAIN}")

    def spread(names: tuple[str, ...], shares: np.ndarray) -> np.ndarray:
        low, high = (np.stack([chunks[name] for name in part], axis=1)[which] for part in (names[:3], names[3:]))
        return low.astype(np.float64) + (high.astype(np.float64) - low) * shares

    packed = words["packed_color"].astype(np.uint32)
    rgba = (packed[:, None] >> np.array([24, 16, 8, 0], np.uint32)) & np.uint32(255)
    rgb = rgba[:, :3] / 255.0
    cloud = Cloud(
        means=spread(_RANGES[:6], _vector(words["packed_position"])).astype(np.float32),
        log_scales=spread(_RANGES[6:], _vector(words["packed_scale"])).astype(np.float32),
        quats=_quats(words["packed_rotation"]).astype(np.float32),
        logits=logits_of_bytes(rgba[:, 3]),
        sh0=(((spread(colors, rgb) if colors else rgb) - 0.5) / SH_C0).astype(np.float32),
        rest=_rest(elements.get("sh"), n, path),
        antialiased=asks_for_antialiasing(header),
        frame=Frame.of_comments(header.comments, path),
    )
    return cloud.checked(path)


def _vector(packed: np.ndarray) -> np.ndarray:
    packed = packed.astype(np.uint32)
    return np.stack([packed >> 21, (packed >> 11) & 1023, packed & 2047], axis=1) / np.array([2047.0, 1023.0, 2047.0])


def _quats(packed: np.ndarray) -> np.ndarray:
    packed = packed.astype(np.uint32)
    parts = (packed[:, None] >> np.array([20, 10, 0], np.uint32)) & np.uint32(1023)
    return restore_largest((packed >> 30).astype(np.int64), (parts / 1023.0 - 0.5) * np.sqrt(2.0))


def _rest(rows: np.ndarray | None, n: int, path: Path) -> np.ndarray:
    if rows is None:
        return np.zeros((n, 0, 3), np.float32)
    count = len(rows.dtype.names or ())
    if count not in (9, 24, 45) or set(rows.dtype.names or ()) != {f"f_rest_{i}" for i in range(count)}:
        raise PopError(f"{path}: element 'sh' has {count} properties; there must be f_rest_0 to 8, 23 or 44")
    if len(rows) != n:
        raise PopError(f"{path}: has {len(rows)} rows of 'sh' for {n} of 'vertex'; {WRITE_AGAIN}")
    stored = np.stack([rows[f"f_rest_{i}"] for i in range(count)], axis=1)
    values = (stored.astype(np.float64) - 127.5) / _SH_STEPS
    return values.reshape(n, 3, count // 3).transpose(0, 2, 1).astype(np.float32)


def _elements(data: bytes, path: Path) -> dict[str, np.ndarray]:
    """Return the rows of every element."""
    header = header_of(data, path)
    if not header.order or any(element.lists for element in header.elements):
        raise PopError(f"{path}: is a text file or has lists; compressed PLY is binary and has none: {WRITE_AGAIN}")
    found: dict[str, np.ndarray] = {}
    at = header.length
    for element in header.elements:
        kind = np.dtype([(name, header.order + column) for name, column in element.columns])
        if at + kind.itemsize * element.count > len(data):
            raise PopError(
                f"{path}: is cut off in element {element.name!r}, which has {element.count} rows; {WRITE_AGAIN}"
            )
        found[element.name] = np.frombuffer(data, kind, element.count, at)
        at += kind.itemsize * element.count
    return found
