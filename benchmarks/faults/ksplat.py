"""KSPLAT, written by its description: the program only reads it.

Source: https://github.com/mkkellogg/GaussianSplats3D, src/loaders/SplatBuffer.js.
"""

from __future__ import annotations

import math
import struct

import numpy as np
import torch


def ksplat_of(params: dict[str, torch.Tensor], level: int, degree: int = 2, full: int = 1) -> bytes:
    """Write KSPLAT by its description: two sections, the first with one Gaussian a bucket, the second with the rest.

    Args:
        params: raw parameters of two Gaussians or more.
        level: of compression, 0 to 2.
        degree: of the colours.
        full: buckets of the first section that are called full; the other one has its length written.
    """
    n = len(params["means"])
    parts = [range(2), range(2, n)]
    capacity = [1, n]
    sections = [
        _ksplat_section(params, list(rows), level, degree, capacity[k], full if k == 0 else 0)
        for k, rows in enumerate(parts)
    ]
    header = struct.pack("<BBHIIIIHH3fff", 0, 1, 0, 2, 2, n, n, level, 0, 0.0, 0.0, 0.0, -2.0, 2.0)
    heads = b"".join(head.ljust(1024, b"\0") for head, _ in sections)
    return header.ljust(4096, b"\0") + heads + b"".join(body for _, body in sections)


def _ksplat_section(
    params: dict[str, torch.Tensor], rows: list[int], level: int, degree: int, capacity: int, full: int
) -> tuple[bytes, bytes]:
    """Return the header and the body of a section, whose Gaussians fill buckets of a capacity one after the other."""
    extent, steps = 5.0, 32767
    raw = {name: value[rows].double().numpy() for name, value in params.items()}
    buckets = [list(range(k, min(k + capacity, len(rows)))) for k in range(0, len(rows), capacity)] if level else []
    full = full if level else 0
    body = b"".join(struct.pack("<I", len(bucket)) for bucket in buckets[full:])
    # a bucket's centre is off its Gaussians, within half of the extent
    centres = [raw["means"][bucket].mean(axis=0) + 0.25 for bucket in buckets]
    body += b"".join(struct.pack("<3f", *centre) for centre in centres)
    for k in range(len(rows)):
        centre = raw["means"][k]
        if level:
            centre = np.rint((centre - centres[k // capacity]) / (0.5 * extent) * steps) + steps
        quat = raw["quats"][k] / np.linalg.norm(raw["quats"][k])
        body += centre.astype("<u2" if level else "<f4").tobytes()
        body += np.concatenate([np.exp(raw["scales"][k]), quat]).astype("<f2" if level else "<f4").tobytes()
        rgba = [*(0.5 + 0.28209479177387814 * raw["sh0"][k, 0]), 1.0 / (1.0 + math.exp(-raw["opacities"][k]))]
        body += np.clip(np.rint(255.0 * np.array(rgba)), 0, 255).astype(np.uint8).tobytes()
        bands = [raw["shN"][k, d * d - 1 : (d + 1) ** 2 - 1].T.ravel() for d in range(1, degree + 1)]
        rest = np.concatenate([np.zeros(0), *bands])
        stored = np.rint((rest + 2.0) / 4.0 * 255.0).clip(0, 255).astype(np.uint8) if level == 2 else rest
        body += stored.astype(("<f4", "<f2", "u1")[level]).tobytes()
    n, partial = len(rows), len(buckets) - full
    fields = (n, n, capacity, len(buckets), extent, 12) if level else (n, n, 0, 0, 0.0, 0)
    return struct.pack("<IIIIfHHIIIIH", *fields, 0, steps if level else 0, len(body), full, partial, degree), body
