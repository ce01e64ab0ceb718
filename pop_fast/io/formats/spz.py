"""Niantic's SPZ, versions 2 to 4: fixed-point columns, 20 to 65 bytes a Gaussian before they are compressed.

The columns are centres (24-bit fixed point), opacities, colours, log-scales, rotations (version 2: xyz as bytes; later:
the smallest three components with 10 bits each), colour coefficients. Versions 2 and 3 are one gzip stream: a header of
16 bytes, the columns, extensions. Version 4 is not compressed as a whole: a header of 32 bytes, extensions, a table of
two 64-bit sizes a stream (compressed, plain), and a Zstandard stream for each column that is not empty. An extension
is a 32-bit type, a 32-bit length and so many bytes. The frame has y up, half a turn about x from that of PLY, where no
extension says another one.

Source: the format's own description and its list of extensions, https://github.com/nianticlabs/spz.
"""

from __future__ import annotations

import gzip
import json
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Final

import numpy as np

from pop_fast.errors import PopError
from pop_fast.io.formats.cloud import COEFFICIENTS, Cloud, drop_largest, logits_of_bytes, restore_largest, to_bytes
from pop_fast.io.ply import KEY, Frame
from pop_fast.io.read_back import WRITE_AGAIN, check_memory

MAGIC: Final = 0x5053474E
# magic, version, count, degree, fractional bits, flags, and a zero byte or the number of streams
_HEADER: Final = struct.Struct("<IIIBBBB")
# what version 4 has after it: where the table begins, and zeros
_TABLE_AT: Final = struct.Struct("<I12x")
_SIZES: Final = struct.Struct("<QQ")
_EXTENSION: Final = struct.Struct("<II")
_ANTIALIASED, _EXTENDED, _LEVELS_OF_DETAIL = 1, 2, 128
# of Adobe's extension, the number of a frame: which axis half a turn leads about from there to that of PLY
_COORDINATES: Final = 0xADBE0003
_AXES: Final = {0: "x", 1: "y", 4: "x", 6: "", 7: "z"}
# our own extension, JSON that says which world the splat is in: "PO" is the vendor, 1 the extension
_FRAME: Final = 0x504F0001
# bytes of all extensions
_LONGEST: Final = 2**20
# of Zstandard
_LEVEL: Final = 12
_WIDEST_WINDOW: Final = 2**27
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
SH_STEP: Final = 2.5
_WIDEST_STEP: Final = 64
# what deflate can expand a byte to, at most; Zstandard can do more, and splats come nowhere near
_EXPANSION: Final = 1032
# bytes of a Gaussian while it is decoded, at most
_IN_MEMORY: Final = 700


def encode(cloud: Cloud, version: int = 3, sh_step: float = SH_STEP) -> bytes:
    """Write SPZ; the order of the Gaussians is kept.

    Compression makes the less of the bytes the rounder their numbers are: centres are rounded to an eighth of the
    Gaussian's smallest scale, and the colours of Gaussians that are hardly seen more than those of the others.

    Args:
        cloud: what to write.
        version: 2, 3 or 4; 2 has other rotations, and 4 is compressed otherwise.
        sh_step: what the coefficients of a Gaussian of typical visibility are multiples of, in 1/128; 1 to 64.

    Raises:
        PopError: a centre is too far from the origin for 24 bits, or version 4's package is not installed.
    """
    turned = cloud.turned("x")
    bits = _fraction_bits(turned.means)
    world = b"" if cloud.frame is None else json.dumps({KEY: cloud.frame.entry()}).encode()
    extensions = _EXTENSION.pack(_FRAME, len(world)) + world if world else b""
    flags = (_ANTIALIASED if cloud.antialiased else 0) | (_EXTENDED if extensions else 0)
    columns = [
        _centres(turned, bits).astype("<i4").reshape(-1, 1).view(np.uint8).reshape(-1, 4)[:, :3].tobytes(),
        to_bytes(255.0 * cloud.opacities).tobytes(),
        to_bytes(_COLOR * cloud.sh0.astype(np.float64) + 127.5).tobytes(),
        to_bytes(16.0 * (cloud.log_scales.astype(np.float64) + 10.0)).tobytes(),
        _rotations(turned.quats, version).tobytes(),
        _coefficients(turned.rest, cloud.visibility, sh_step).tobytes(),
    ]
    fields = (MAGIC, version, len(cloud), cloud.degree, bits, flags)
    if version < 4:
        return gzip.compress(_HEADER.pack(*fields, 0) + b"".join(columns) + extensions, 9, mtime=0)
    zstandard = _zstandard()
    streams = [(zstandard.ZstdCompressor(_LEVEL).compress(column), len(column)) for column in columns if column]
    head = _HEADER.pack(*fields, len(streams)) + _TABLE_AT.pack(_HEADER.size + _TABLE_AT.size + len(extensions))
    table = b"".join(_SIZES.pack(len(stream), size) for stream, size in streams)
    return head + extensions + table + b"".join(stream for stream, _ in streams)


def _zstandard() -> ModuleType:
    """Return the package, which only version 4 needs; a PopError says that it is not installed."""
    try:
        import zstandard
    except ImportError as error:
        raise PopError(f"SPZ version 4 needs the package zstandard ({error}); pip install zstandard") from error
    return zstandard


def _fraction_bits(means: np.ndarray) -> int:
    """Choose as many fractional bits as the farthest centre leaves."""
    far = float(np.abs(means).max(initial=0.0))
    bits = min(_MOST_FRACTION_BITS, int(np.floor(np.log2(_LARGEST / max(far, 1e-6)))))
    if bits < 0:
        raise PopError(f"a centre is {far:.3g} from the origin; SPZ holds up to {_LARGEST}: crop, or choose SOG or PLY")
    return bits


def _centres(cloud: Cloud, bits: int) -> np.ndarray:
    """Return fixed-point centres, rounded to powers of two that are small for the Gaussians. float64 [N, 3]"""
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


@dataclass(frozen=True)
class _Head:
    """What a header promises: of `bits` of a centre's fraction, and in version 4 so many streams."""

    version: int
    n: int
    degree: int
    bits: int
    flags: int
    streams: int

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes a Gaussian of every column."""
        return 9, 1, 3, 3, 3 if self.version == 2 else 4, 3 * COEFFICIENTS[self.degree]


def decode(data: bytes, path: Path) -> Cloud:
    """Read SPZ."""
    unpack = _of_streams if data[:4] == struct.pack("<I", MAGIC) else _of_gzip
    head, columns, extensions = unpack(data, path)
    n = head.n
    arrays = [np.frombuffer(part, np.uint8).reshape(n, w) for part, w in zip(columns, head.widths, strict=True)]
    centres, opacities, colors, scales, rotations, rest = arrays
    fixed = centres.reshape(n, 3, 3).astype(np.int32) @ np.array([1, 2**8, 2**16], np.int32)
    fixed -= (fixed >= 2**23).astype(np.int32) << 24
    axis, frame = _said(extensions, path)
    cloud = Cloud(
        means=(fixed / 2.0**head.bits).astype(np.float32),
        log_scales=(scales / 16.0 - 10.0).astype(np.float32),
        quats=_quats(rotations, head.version).astype(np.float32),
        logits=logits_of_bytes(opacities[:, 0]),
        sh0=((colors - 127.5) / _COLOR).astype(np.float32),
        rest=((rest.reshape(n, rest.shape[1] // 3, 3) - 128.0) / 128.0).astype(np.float32),
        antialiased=bool(head.flags & _ANTIALIASED),
        frame=frame,
    )
    return (cloud.turned(axis) if axis else cloud).checked(path)


def _quats(stored: np.ndarray, version: int) -> np.ndarray:
    if version == 2:
        xyz = stored / 127.5 - 1.0
        w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1, keepdims=True)))
        return np.concatenate([w, xyz], axis=1)
    word = np.ascontiguousarray(stored).view("<u4")[:, 0]
    parts = (word[:, None] >> np.array([20, 10, 0], np.uint32)) & np.uint32(1023)
    three = (parts & 511) / (511.0 * np.sqrt(2.0)) * np.where(parts & 512, -1.0, 1.0)
    return restore_largest((word >> 30).astype(np.int64), three)[:, [3, 0, 1, 2]]


def _of_gzip(data: bytes, path: Path) -> tuple[_Head, list[bytes], bytes]:
    """Return the header of versions 2 and 3, whose promises hold, the columns and the extensions."""
    stream = zlib.decompressobj(31)
    try:
        first = stream.decompress(data, _HEADER.size)
        if len(first) < _HEADER.size:
            raise PopError(f"{path}: is cut off in its header; {WRITE_AGAIN}")
        head = _checked_head(first, (2, 3), len(data), path)
        size = head.n * sum(head.widths)
        body = stream.decompress(stream.unconsumed_tail, size + _LONGEST)
    except zlib.error as error:
        raise PopError(f"{path}: its gzip stream is damaged ({error}); {WRITE_AGAIN}") from error
    if len(body) < size:
        raise PopError(f"{path}: ends after {len(body)} of {size} bytes of its columns; {WRITE_AGAIN}")
    if not stream.eof:
        # its checksum and perhaps extensions, which say the frame, are behind the end of the file
        raise PopError(f"{path}: its gzip stream is cut off behind its columns; {WRITE_AGAIN}")
    columns, at = list[bytes](), 0
    for width in head.widths:
        columns.append(body[at : at + head.n * width])
        at += head.n * width
    return head, columns, body[at:] if head.flags & _EXTENDED else b""


def _of_streams(data: bytes, path: Path) -> tuple[_Head, list[bytes], bytes]:
    """Return the header of version 4, whose promises hold, the columns and the extensions."""
    begin = _HEADER.size + _TABLE_AT.size
    if len(data) < begin:
        raise PopError(f"{path}: is cut off in its header; {WRITE_AGAIN}")
    head = _checked_head(data[: _HEADER.size], (4,), len(data), path)
    (table,) = _TABLE_AT.unpack_from(data, _HEADER.size)
    plain = [head.n * width for width in head.widths]
    if head.streams != sum(size > 0 for size in plain):
        raise PopError(f"{path}: numStreams is {head.streams}; its degree and count make {sum(s > 0 for s in plain)}")
    at = table + _SIZES.size * head.streams
    if table < begin or at > len(data):
        raise PopError(f"{path}: tocByteOffset is {table}, which leaves no room for the table; {WRITE_AGAIN}")
    sizes = iter(_SIZES.iter_unpack(data[table:at]))
    columns: list[bytes] = []
    for number, size in enumerate(plain):
        packed, stated = next(sizes) if size else (0, 0)
        if stated != size:
            raise PopError(f"{path}: stream {number} is to hold {stated} bytes, not {size}; {WRITE_AGAIN}")
        if at + packed > len(data):
            raise PopError(f"{path}: is cut off in stream {number}; {WRITE_AGAIN}")
        columns.append(_inflated(data[at : at + packed], size, number, path) if size else b"")
        at += packed
    extensions = data[begin:table] if head.flags & _EXTENDED else b""
    return head, columns, extensions


def _checked_head(first: bytes, versions: Sequence[int], length: int, path: Path) -> _Head:
    """Return a header that a file of this length can keep."""
    magic, *fields = _HEADER.unpack(first)
    head = _Head(*fields)
    if magic != MAGIC:
        raise PopError(f"{path}: begins with {magic:#x}, not {MAGIC:#x}: it is not an SPZ file")
    if head.version not in versions:
        raise PopError(f"{path}: version is {head.version}; write it as version 2, 3 or 4, which this program reads")
    if head.degree > 3:
        raise PopError(f"{path}: shDegree is {head.degree}; it must be 0 to 3: write it with fewer degrees")
    if head.bits > 24:
        raise PopError(f"{path}: fractionalBits is {head.bits}; it must be 0 to 24: {WRITE_AGAIN}")
    if head.flags & _LEVELS_OF_DETAIL:
        raise PopError(f"{path}: holds levels of detail (flag 0x80), not one splat; write it without them")
    if head.n * sum(head.widths) > _EXPANSION * length:
        raise PopError(f"{path}: numPoints is {head.n}, more than {length} bytes can hold; {WRITE_AGAIN}")
    check_memory(path, head.n * _IN_MEMORY, length, f"its numPoints of {head.n}", WRITE_AGAIN)
    return head


def _inflated(stream: bytes, size: int, number: int, path: Path) -> bytes:
    """Return what a Zstandard stream holds, which must be so many bytes; no more are made of it."""
    zstandard = _zstandard()
    try:
        with zstandard.ZstdDecompressor(max_window_size=_WIDEST_WINDOW).stream_reader(stream) as reader:
            column = reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise PopError(f"{path}: stream {number} is damaged ({error}); {WRITE_AGAIN}") from error
    if len(column) != size:
        raise PopError(f"{path}: stream {number} holds other than its {size} bytes; {WRITE_AGAIN}")
    return column


def _said(extensions: bytes, path: Path) -> tuple[str, Frame | None]:
    """Return what extensions say: the axis of the half turn to the frame of PLY, "" for none, and the world.

    Those of other programs are skipped, as the format has it.
    """
    axis, frame, at = "x", None, 0
    while at + _EXTENSION.size <= len(extensions):
        kind, length = _EXTENSION.unpack_from(extensions, at)
        at += _EXTENSION.size
        payload = extensions[at : at + length]
        if len(payload) < length:
            raise PopError(f"{path}: extension {kind:#x} of {length} bytes is cut off; {WRITE_AGAIN}")
        at += length
        if kind == _COORDINATES:
            number = int.from_bytes(payload[:4], "little")
            if number not in _AXES:
                raise PopError(f"{path}: its coordinates are of kind {number}; write it with those of PLY or SPZ")
            axis = _AXES[number]
        if kind == _FRAME:
            try:
                frame = Frame.of_entry(json.loads(payload), path)
            except (ValueError, RecursionError) as error:
                if isinstance(error, PopError):
                    raise
                raise PopError(f"{path}: extension {kind:#x} is damaged ({error}); export the splat again") from error
    return axis, frame
