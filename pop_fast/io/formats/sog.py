"""PlayCanvas's SOG, version 2: lossless WebP images of bytes and meta.json, in one ZIP file or as files of a folder.

An image pixel is a Gaussian: centres with 16 bits in a logarithmic space, scales and colours as indices of 256 numbers,
rotations as the smallest three components with 8 bits each, and the colours beyond degree 0 as an index of a palette of
at most 65,536 rows. The frame is that of PLY, as PlayCanvas's own programs write it.

Source: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import torch
from torch import Tensor

from pop_fast.errors import PopError
from pop_fast.io.formats.cloud import COEFFICIENTS, Cloud, drop_largest, logits_of_bytes, restore_largest, to_bytes
from pop_fast.io.image_header import size_of
from pop_fast.io.ply import KEY, Frame
from pop_fast.io.read_back import WRITE_AGAIN, check_members, check_memory

_CODES: Final = 256
_ROUNDS: Final = 8
# rows that a palette is fitted to, at most
_SAMPLE: Final = 2**18
# distances held at once
_BLOCK: Final = 2**23


def codebook(values: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Choose 256 numbers near which values lie: Lloyd's algorithm in one dimension, from between quantiles and a grid.

    `weights` say how much the square of each one's error counts, all the same where absent. Rising. float32 [256]
    """
    if len(values) == 0:
        return np.zeros(_CODES, np.float32)
    order = np.argsort(values, kind="stable")
    order = order[np.linspace(0, len(order) - 1, min(len(order), _SAMPLE)).round().astype(np.int64)]
    sample = values[order].astype(np.float64)
    mass = np.ones(len(sample)) if weights is None else weights[order] / max(float(weights.max()), 1e-300) + 1e-9
    below = np.cumsum(mass) - 0.5 * mass
    # between the two: of quantiles alone, few would be far out, and of a grid alone, few where most values are
    shares = np.linspace(0.0, 1.0, _CODES)
    quantiles = np.interp(below[0] + shares * (below[-1] - below[0]), below, sample)
    codes = 0.5 * (quantiles + sample[0] + shares * (sample[-1] - sample[0]))
    for _ in range(6 * _ROUNDS):
        which = nearest(codes, sample)
        counts = np.bincount(which, mass, _CODES)
        sums = np.bincount(which, mass * sample, _CODES)
        codes = np.sort(np.where(counts > 0.0, sums / np.maximum(counts, 1e-300), codes))
    # six digits, which are written as a few characters
    return np.array([float(f"{code:.6g}") for code in codes], np.float32)


def nearest(codes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the index of the nearest of rising codes. int64, of the shape of `values`"""
    codes = codes.astype(np.float64)
    return np.searchsorted(0.5 * (codes[1:] + codes[:-1]), values)


def row_palette(rows: np.ndarray, weights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose rows that stand for many: k-means in two levels, groups first and then shares of the palette in each.

    Args:
        rows: [N, D]
        weights: how much each counts, over 0. [N]
        count: palette rows, at most.

    Returns:
        The palette, float32 [C, D], and every row's index in it. int64 [N]
    """
    all_rows = torch.from_numpy(np.ascontiguousarray(rows, np.float32))
    all_weights = torch.from_numpy(np.ascontiguousarray(weights, np.float32))
    if len(all_rows) <= count:
        return rows.astype(np.float32), np.arange(len(rows))
    groups = max(1, round(count**0.5))
    centres = _k_means(all_rows, all_weights, groups)
    group = _closest(all_rows, centres)
    # a group gets its share of the palette by what it weighs times how far it is spread
    error = all_weights * ((all_rows - centres[group]) ** 2).sum(1)
    shares = torch.zeros(len(centres)).index_add(0, group, error)
    sizes = torch.bincount(group, minlength=len(centres))
    quota = (shares / shares.sum().clamp(min=1e-30) * (count - len(centres))).floor().long() + 1
    labels = torch.zeros(len(all_rows), dtype=torch.int64)
    palette: list[Tensor] = []
    used = 0
    for index in range(len(centres)):
        members = (group == index).nonzero().squeeze(1)
        if len(members) == 0:
            continue
        found = _k_means(all_rows[members], all_weights[members], int(min(quota[index], sizes[index])))
        labels[members] = used + _closest(all_rows[members], found)
        palette.append(found)
        used += len(found)
    return torch.cat(palette).numpy(), labels.numpy()


def _k_means(rows: Tensor, weights: Tensor, count: int) -> Tensor:
    """Return `count` centres, from rows at even distances in the order of the projection on the widest direction."""
    if len(rows) > _SAMPLE:
        keep = torch.linspace(0, len(rows) - 1, _SAMPLE).round().long()
        rows, weights = rows[keep], weights[keep]
    widest = rows[:, rows.var(0, correction=0).argmax()]
    order = widest.argsort(stable=True)
    centres = rows[order[((torch.arange(count) + 0.5) / count * len(rows)).long()]].clone()
    for _ in range(_ROUNDS if count > 1 else 1):
        which = _closest(rows, centres)
        mass = torch.zeros(count).index_add(0, which, weights)
        sums = torch.zeros_like(centres).index_add(0, which, rows * weights[:, None])
        centres = torch.where(mass[:, None] > 0, sums / mass.clamp(min=1e-30)[:, None], centres)
    return centres


def _closest(rows: Tensor, centres: Tensor) -> Tensor:
    half = 0.5 * (centres**2).sum(1)
    block = max(1, _BLOCK // max(len(centres), 1))
    return torch.cat([(half - part @ centres.T).argmin(1) for part in rows.split(block)])


META: Final = "meta.json"
_FIRST_ROTATION: Final = 252
# palette rows in a row of the image of the palette
_ROW: Final = 64
_LARGEST_PALETTE: Final = 65536
# Gaussians for a row of the palette
_SHARED_BY: Final = 2
_LOSSLESS: Final = (cv2.IMWRITE_WEBP_QUALITY, 101)
_LARGEST_META: Final = 2**20
# bytes of a Gaussian while it is decoded, at most
_IN_MEMORY: Final = 700


def encode(cloud: Cloud, shared_by: int = _SHARED_BY) -> bytes:
    """Write SOG, a row of the palette of colours for `shared_by` Gaussians, which should be ordered by place."""
    n = len(cloud)
    width = max(1, math.isqrt(max(n - 1, 0)) + 1)
    height = max(1, -(-n // width))
    images: dict[str, np.ndarray] = {}

    def picture(name: str, channels: np.ndarray, columns: int = width, rows: int = height) -> str:
        pixels = np.zeros((columns * rows, channels.shape[1]), np.uint8)
        pixels[: len(channels)] = channels
        images[name] = pixels.reshape(rows, columns, -1)
        return name

    means = np.sign(cloud.means) * np.log1p(np.abs(cloud.means.astype(np.float64)))
    low, high = (means.min(axis=0), means.max(axis=0)) if n else (np.zeros(3), np.zeros(3))
    fixed = np.rint((means - low) / np.where(high > low, high - low, 1.0) * 65535.0).astype(np.uint16)
    largest, three = drop_largest(cloud.quats)
    rotations = to_bytes(255.0 * (three / math.sqrt(2.0) + 0.5))
    # what is large and opaque is few among the scales, and most of the picture
    scales = codebook(cloud.log_scales.ravel(), np.repeat(cloud.visibility**2, 3))
    colors = codebook(cloud.sh0.ravel())
    rgba = np.concatenate([nearest(colors, cloud.sh0), np.rint(255.0 * cloud.opacities)[:, None]], axis=1)
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "pop-splatting", **({} if cloud.frame is None else {KEY: cloud.frame.entry()})},
        "count": n,
        "antialias": cloud.antialiased,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": [picture("means_l.webp", fixed & 255), picture("means_u.webp", fixed >> 8)],
        },
        "scales": {
            "codebook": _numbers(scales),
            "files": [picture("scales.webp", nearest(scales, cloud.log_scales))],
        },
        "quats": {
            "files": [picture("quats.webp", np.concatenate([rotations, largest[:, None] + _FIRST_ROTATION], axis=1))]
        },
        "sh0": {"codebook": _numbers(colors), "files": [picture("sh0.webp", rgba)]},
    }
    if cloud.degree and n:
        palette, labels = _palette(cloud, shared_by)
        codes = codebook(palette.ravel())
        rows = -(-len(palette) // _ROW)
        indices = nearest(codes, palette).reshape(-1, 3)
        centroids = picture("shN_centroids.webp", indices, _ROW * cloud.rest.shape[1], rows)
        pairs = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
        meta["shN"] = {
            "count": len(palette),
            "bands": cloud.degree,
            "codebook": _numbers(codes),
            "files": [centroids, picture("shN_labels.webp", pairs)],
        }
    return _zipped(meta, images)


def _numbers(codes: np.ndarray) -> list[float]:
    return [float(f"{code:.6g}") for code in codes]


def _palette(cloud: Cloud, shared_by: int) -> tuple[np.ndarray, np.ndarray]:
    rows = cloud.rest.reshape(len(cloud), -1)
    count = min(_LARGEST_PALETTE, max(_ROW, len(rows) // shared_by))
    seen = cloud.visibility
    return row_palette(rows, seen / max(float(seen.mean()), 1e-30) + 1e-6, count)


def _zipped(meta: Mapping[str, Any], images: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        # a fixed time, so that the same splat gives the same bytes
        archive.writestr(zipfile.ZipInfo(META), json.dumps(meta))
        for name, pixels in images.items():
            order = [2, 1, 0, 3][: pixels.shape[2]]
            _, data = cv2.imencode(".webp", np.ascontiguousarray(pixels[..., order]), _LOSSLESS)
            archive.writestr(zipfile.ZipInfo(name), data.tobytes())
    return buffer.getvalue()


def decode(data: bytes, path: Path) -> Cloud:
    """Read SOG, as one file."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            check_members(path, archive, len(data), WRITE_AGAIN)
            return _read(lambda name: _unzipped(archive, name, path), len(data), path)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        raise PopError(f"{path}: is not a readable ZIP file ({error}); {WRITE_AGAIN}") from error


def decode_folder(path: Path) -> Cloud:
    """Read SOG whose images lie as files in the folder of its meta.json; see `decode`."""
    try:
        held = sum(image.stat().st_size for image in path.parent.glob("*.webp"))
    except OSError as error:
        raise PopError(f"{path}: could not be read: {error.strerror}; check its permissions") from error
    return _read(lambda name: _file(path.parent, name, path), held, path)


def _unzipped(archive: zipfile.ZipFile, name: str, path: Path) -> bytes:
    size = archive.getinfo(name).file_size
    if name == META and size > _LARGEST_META:
        raise PopError(f"{path}: {META} has {size} bytes; {WRITE_AGAIN}")
    try:
        return archive.read(name)
    # a damaged member ends in errors of as many kinds as there are compressions
    except Exception as error:
        raise PopError(f"{path}: {name} in it is damaged ({error}); {WRITE_AGAIN}") from error


def _file(folder: Path, name: str, path: Path) -> bytes:
    if Path(name).name != name:
        raise PopError(f"{path}: names the file {name!r}, which is not in its folder; put it there, and name it so")
    try:
        size = (folder / name).stat().st_size
        if name == META and size > _LARGEST_META:
            raise PopError(f"{path}: has {size} bytes; {WRITE_AGAIN}")
        return (folder / name).read_bytes()
    except FileNotFoundError:
        raise PopError(f"{folder / name}: is absent, and {path.name} names it; copy it next to {path.name}") from None
    except OSError as error:
        raise PopError(f"{folder / name}: could not be read: {error.strerror}; check its permissions") from error


def _read(read: Callable[[str], bytes], held: int, path: Path) -> Cloud:
    """Read the parts, each by its name; together they have so many bytes."""
    try:
        return _decoded(read, held, path)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError, RecursionError) as error:
        if isinstance(error, PopError):
            raise
        raise PopError(f"{path}: {META} is not that of SOG version 2 ({error!r}); {WRITE_AGAIN}") from error


def _decoded(read: Callable[[str], bytes], held: int, path: Path) -> Cloud:
    meta = json.loads(read(META))
    if meta.get("version") != 2:
        raise PopError(
            f"{path}: {META}.version is {meta.get('version')}; write it as version 2, which this program reads"
        )
    n = meta["count"]
    if not isinstance(n, int) or n < 0:
        raise PopError(f"{path}: {META}.count is {n}; it must be a number of Gaussians: {WRITE_AGAIN}")
    check_memory(path, n * _IN_MEMORY, held, f"{META}.count of {n}", WRITE_AGAIN)

    def pixels(entry: str, index: int, least: int = n) -> np.ndarray:
        name = str(meta[entry]["files"][index])
        return _pixels(read(name), name, least, path)[:least]

    low, high = (np.array(meta["means"][end], np.float64).reshape(3) for end in ("mins", "maxs"))
    fixed = pixels("means", 0)[:, :3] + 256.0 * pixels("means", 1)[:, :3]
    means = low + fixed / 65535.0 * (high - low)
    rotations, colors = pixels("quats", 0), pixels("sh0", 0)
    modes = rotations[:, 3].astype(np.int64) - _FIRST_ROTATION
    if n and modes.min() < 0:
        row = int(modes.argmin())
        raise PopError(f"{path}: quats of Gaussian {row} has the mode {rotations[row, 3]}; it must be 252 to 255")
    three = (rotations[:, :3] / 255.0 - 0.5) * math.sqrt(2.0)
    cloud = Cloud(
        means=(np.sign(means) * np.expm1(np.abs(means))).astype(np.float32),
        log_scales=_codes(meta, "scales")[pixels("scales", 0)[:, :3]],
        quats=restore_largest(modes, three).astype(np.float32),
        logits=logits_of_bytes(colors[:, 3]),
        sh0=_codes(meta, "sh0")[colors[:, :3]],
        rest=_rest(meta, pixels, path) if "shN" in meta else np.zeros((n, 0, 3), np.float32),
        antialiased=bool(meta.get("antialias", False)),
        frame=Frame.of_entry(meta.get("asset"), path),
    )
    return cloud.checked(path)


def _codes(meta: Mapping[str, Any], entry: str) -> np.ndarray:
    return np.array(meta[entry]["codebook"], np.float32).reshape(256)


def _rest(meta: Mapping[str, Any], pixels: Any, path: Path) -> np.ndarray:
    count, bands = meta["shN"]["count"], meta["shN"]["bands"]
    if bands not in (1, 2, 3) or not 0 < count <= _LARGEST_PALETTE:
        raise PopError(f"{path}: {META}.shN has {count} rows of {bands} bands; 1 to 65536 of 1 to 3 are allowed")
    each = COEFFICIENTS[bands]
    palette = _codes(meta, "shN")[pixels("shN", 0, count * each)[:, :3]].reshape(count, each, 3)
    labels = pixels("shN", 1)[:, :2].astype(np.int64) @ np.array([1, 256])
    if len(labels) and labels.max() >= count:
        raise PopError(f"{path}: shN_labels names row {labels.max()} of a palette of {count}; {WRITE_AGAIN}")
    return palette[labels]


def _pixels(data: bytes, name: str, least: int, path: Path) -> np.ndarray:
    """Return an image's pixels in reading order, with four channels. uint8 [M, 4]"""
    sound = len(data) >= 32 and data[:4] == b"RIFF" and (data[12:16] != b"VP8L" or data[20] == 0x2F)
    width, height = (size_of(data) if sound else None) or (0, 0)
    if width * height < least:
        raise PopError(f"{path}: {name} is {width}x{height} pixels; {least} are needed: {WRITE_AGAIN}")
    if width * height > 4 * least + 2**16:
        raise PopError(f"{path}: {name} is {width}x{height} pixels for {least} values; {WRITE_AGAIN}")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.dtype != np.uint8 or image.shape[0] * image.shape[1] < least:
        raise PopError(f"{path}: {name} cannot be decoded as an image of colours; {WRITE_AGAIN}")
    flat = image[..., [2, 1, 0]].reshape(-1, 3)
    # where all are opaque, there may be no fourth channel
    fourth = image[..., 3].reshape(-1, 1) if image.shape[2] == 4 else np.full((len(flat), 1), 255, np.uint8)
    return np.concatenate([flat, fourth], axis=1)
