"""`.splat` and KSPLAT, formats of web viewers: one is written and read, the other read alone. The frame is PLY's.

`.splat`, of antimatter15's viewer, has 32 bytes a Gaussian and no header, with colours of degree 0 only: centre 3
float32, scale 3 float32 (activated), RGBA 4 uint8, quaternion wxyz 4 uint8 as 128 + 128 q. Viewers that load while
drawing expect the largest and most opaque first.

KSPLAT, of GaussianSplats3D, has a header of 4096 bytes, one of 1024 bytes a section, and the sections. A section has
the lengths of the buckets that are not full, the centres of all buckets, and a row a Gaussian: centre, scale
(activated), quaternion wxyz, RGBA as bytes, colour coefficients. Level 0 stores float32. Levels 1 and 2 store centres
as 16 bits within the bucket and the others as half floats, level 2 the coefficients as bytes. Coefficients go by
degree, then by channel.

Source: https://github.com/antimatter15/splat; https://github.com/mkkellogg/GaussianSplats3D,
src/loaders/SplatBuffer.js.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from pop_fast.errors import PopError
from pop_fast.io.formats.cloud import COEFFICIENTS, SH_C0, Cloud, logits_of_bytes, to_bytes
from pop_fast.io.read_back import WRITE_AGAIN, check_memory

_SPLAT_ROW: Final = np.dtype([("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rot", "u1", 4)])


def largest_first(cloud: Cloud) -> np.ndarray:
    """Order Gaussians by volume times opacity, falling. int64 [N]"""
    return np.argsort(-np.exp(cloud.log_scales.astype(np.float64).sum(axis=1)) * cloud.opacities, kind="stable")


def encode_splat(cloud: Cloud) -> bytes:
    """Write `.splat`; the order of the Gaussians is kept."""
    rgba = np.concatenate([0.5 + SH_C0 * cloud.sh0.astype(np.float64), cloud.opacities[:, None]], axis=1)
    rows = np.zeros(len(cloud), _SPLAT_ROW)
    rows["xyz"] = cloud.means
    rows["scale"] = cloud.scales
    rows["rgba"] = to_bytes(255.0 * rgba)
    rows["rot"] = to_bytes(128.0 + 128.0 * cloud.quats.astype(np.float64))
    return rows.tobytes()


def decode_splat(data: bytes, path: Path) -> Cloud:
    """Read `.splat`."""
    if len(data) % _SPLAT_ROW.itemsize:
        raise PopError(f"{path}: has {len(data)} bytes, no multiple of {_SPLAT_ROW.itemsize}; {WRITE_AGAIN}")
    rows = np.frombuffer(data, _SPLAT_ROW)
    cloud = Cloud(
        means=rows["xyz"].copy(),
        log_scales=_logarithms(rows["scale"], _SMALLEST_FLOAT, path),
        quats=((rows["rot"] - 128.0) / 128.0).astype(np.float32),
        logits=logits_of_bytes(rows["rgba"][:, 3]),
        sh0=((rows["rgba"][:, :3] / 255.0 - 0.5) / SH_C0).astype(np.float32),
        rest=np.zeros((len(rows), 0, 3), np.float32),
    )
    return cloud.checked(path)


# what becomes 0 as a float
_SMALLEST_FLOAT: Final = 2.0**-150


def _logarithms(scales: np.ndarray, least: float, path: Path) -> np.ndarray:
    """Return logarithms of scales, where 0 stands for `least`; a PopError names one that is below. float32 [N, 3]"""
    bad = np.flatnonzero(~(scales >= 0.0).all(axis=1))
    if len(bad):
        raise PopError(f"{path}: scale of Gaussian {bad[0]} is {scales[bad[0]].tolist()}; it must be 0 or more")
    return np.log(np.maximum(scales.astype(np.float64), least)).astype(np.float32)


_HEADER_SIZE, _SECTION_SIZE, _BUCKET_SIZE = 4096, 1024, 12
# version, sections, Gaussians, level; range of the coefficients of level 2
_HEADER: Final = struct.Struct("<BB2xI4x4xIH2x12xff")
# rows that are used, rows; bucket capacity, buckets, their extent, bytes of a centre; range of a centre; full buckets,
# others; degree
_SECTION: Final = struct.Struct("<IIIIfH2xI4xIIH")
# kinds of centre, scale and rotation, coefficients; range of a centre where the section says none
_LEVELS: Final = (("<f4", "<f4", "<f4", 1), ("<u2", "<f2", "<f2", 32767), ("<u2", "<f2", "u1", 32767))
_COEFFICIENT_RANGE: Final = (-1.5, 1.5)
# what becomes 0 as a half float
_SMALLEST_SCALE: Final = 2.0**-25
# bytes of a Gaussian while it is decoded, at most
_IN_MEMORY: Final = 1500


@dataclass(frozen=True)
class _Section:
    """A section's header, its place, and the file's level."""

    used: int  # rows that hold a Gaussian
    rows: int  # that there is room for
    capacity: int  # Gaussians of a full bucket
    buckets: int  # their number
    extent: float  # of a bucket, world units
    bucket_bytes: int  # of a bucket's centre; 0 where there are none
    steps: int  # of a centre, from the bucket's to its border; 0 stands for the level's own
    full: int  # buckets with `capacity` Gaussians
    partial: int  # buckets with fewer
    degree: int  # of the colours
    at: int  # where the section begins
    level: int  # of the file

    @property
    def row(self) -> np.dtype:
        centre, other, coefficient, _ = _LEVELS[self.level]
        fields = [("centre", centre, 3), ("scale", other, 3), ("quat", other, 4), ("rgba", "u1", 4)]
        return np.dtype([*fields, ("sh", coefficient, 3 * COEFFICIENTS[self.degree])])

    @property
    def rows_at(self) -> int:
        return self.at + 4 * self.partial + self.bucket_bytes * self.buckets

    @property
    def end(self) -> int:
        return self.rows_at + self.row.itemsize * self.rows


def decode_ksplat(data: bytes, path: Path) -> Cloud:
    """Read KSPLAT."""
    if len(data) < _HEADER_SIZE:
        raise PopError(f"{path}: is cut off in its header; {WRITE_AGAIN}")
    major, minor, count, n, level, low, high = _HEADER.unpack_from(data)
    if major != 0 or minor < 1:
        raise PopError(f"{path}: version is {major}.{minor}; write it as version 0.1, which this program reads")
    if level >= len(_LEVELS):
        raise PopError(f"{path}: compressionLevel is {level}; it must be 0, 1 or 2: {WRITE_AGAIN}")
    sections = _sections(data, count, level, path)
    if sum(section.used for section in sections) != n:
        raise PopError(f"{path}: splatCount is {n}, and its sections hold other than that; {WRITE_AGAIN}")
    check_memory(path, n * _IN_MEMORY, len(data), f"its splatCount of {n}", WRITE_AGAIN)
    ends = (low or _COEFFICIENT_RANGE[0], high or _COEFFICIENT_RANGE[1])
    bands = COEFFICIENTS[max((section.degree for section in sections), default=0)]
    parts = [_rows(data, section, ends, bands, path) for section in sections]
    if not parts:
        raise PopError(f"{path}: has no section; {WRITE_AGAIN}")
    means, log_scales, quats, logits, sh0, rest = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Cloud(means, log_scales, quats, logits, sh0, rest).checked(path)


def _sections(data: bytes, count: int, level: int, path: Path) -> list[_Section]:
    """Return the headers of all sections, each of which the file has room for."""
    at, found = _HEADER_SIZE + count * _SECTION_SIZE, list[_Section]()
    if at > len(data):
        raise PopError(f"{path}: maxSectionCount is {count}, more than {len(data)} bytes can hold; {WRITE_AGAIN}")
    for number in range(count):
        fields = _SECTION.unpack_from(data, _HEADER_SIZE + number * _SECTION_SIZE)
        section, where = _Section(*fields, at=at, level=level), f"{path}: section {number}"
        if section.degree >= len(COEFFICIENTS):
            raise PopError(f"{where}: sphericalHarmonicsDegree is {section.degree}; it must be 0 to 3: {WRITE_AGAIN}")
        if section.used > section.rows:
            raise PopError(f"{where}: splatCount is {section.used}, over maxSplatCount {section.rows}; {WRITE_AGAIN}")
        if level and section.used and section.bucket_bytes != _BUCKET_SIZE:
            raise PopError(f"{where}: bucketStorageSizeBytes is {section.bucket_bytes}, not {_BUCKET_SIZE}")
        if section.end > len(data):
            raise PopError(f"{where}: its rows end at byte {section.end} of {len(data)}; {WRITE_AGAIN}")
        at = section.end
        found.append(section)
    return found


def _rows(data: bytes, section: _Section, ends: tuple[float, float], bands: int, path: Path) -> tuple[np.ndarray, ...]:
    """Return the columns of a `Cloud` of a section's Gaussians, with so many coefficients a channel."""
    n = section.used
    rows = np.frombuffer(data, section.row, n, section.rows_at)
    centres = rows["centre"].astype(np.float64)
    if section.level and n:
        steps = section.steps or _LEVELS[section.level][3]
        centres = (centres - steps) * (0.5 * section.extent / steps) + _bucket_centres(data, section, path)
    sh = rows["sh"].astype(np.float64)
    if section.level == 2:
        sh = ends[0] + sh / 255.0 * (ends[1] - ends[0])
    rest = np.zeros((n, bands, 3), np.float32)
    for first, after in pairwise(COEFFICIENTS[: section.degree + 1]):
        of_degree = sh[:, 3 * first : 3 * after].reshape(n, 3, after - first)
        rest[:, first:after] = of_degree.transpose(0, 2, 1)
    return (
        centres.astype(np.float32),
        _logarithms(rows["scale"], _SMALLEST_SCALE, path),
        rows["quat"].astype(np.float32),
        logits_of_bytes(rows["rgba"][:, 3]),
        ((rows["rgba"][:, :3] / 255.0 - 0.5) / SH_C0).astype(np.float32),
        rest,
    )


def _bucket_centres(data: bytes, section: _Section, path: Path) -> np.ndarray:
    """Return the centre of every Gaussian's bucket. float64 [used, 3]"""
    if section.full + section.partial > section.buckets:
        raise PopError(f"{path}: has {section.full} full and {section.partial} other buckets of {section.buckets}")
    lengths = np.frombuffer(data, "<u4", section.partial, section.at).astype(np.int64)
    lengths = np.concatenate([np.full(section.full, section.capacity, np.int64), lengths])
    which = np.searchsorted(np.cumsum(lengths), np.arange(section.used), side="right")
    if len(which) and which[-1] >= len(lengths):
        raise PopError(f"{path}: its buckets hold {lengths.sum()} of {section.used} Gaussians; {WRITE_AGAIN}")
    centres = np.frombuffer(data, "<f4", 3 * section.buckets, section.at + 4 * section.partial)
    return centres.reshape(-1, 3)[which].astype(np.float64)
