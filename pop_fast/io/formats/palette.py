"""Palettes: 256 numbers, or some thousands of rows, that stand for many. Deterministic."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from torch import Tensor

_CODES: Final = 256
_ROUNDS: Final = 8
# rows that a palette is fitted to, at most
_SAMPLE: Final = 2**18
# distances held at once
_BLOCK: Final = 2**23


def codebook(values: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Choose 256 numbers near which values lie: Lloyd's algorithm in one dimension, from between quantiles and a grid.

    Args:
        values: [M]
        weights: how much the square of each one's error counts, 0 or more; all the same where absent. [M]

    Returns:
        Rising. float32 [256]
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
        The palette, float32 [C, D] with C of `count` or less, and every row's index in it. int64 [N]
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
