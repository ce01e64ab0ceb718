"""Quaternions as three of their four components: the largest follows from the norm."""

from __future__ import annotations

import numpy as np


def drop_largest(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave out the component of the largest magnitude, after a change of sign that makes it positive.

    Args:
        quats: of norm 1. [N, 4]

    Returns:
        Which was left out, int64 [N], and the others in order, within sqrt(1/2) of 0. float64 [N, 3]
    """
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    signed = quats.astype(np.float64) * np.where(quats[rows, largest] < 0.0, -1.0, 1.0)[:, None]
    return largest, signed[others(largest)].reshape(len(quats), 3)


def restore_largest(largest: np.ndarray, three: np.ndarray) -> np.ndarray:
    """Invert `drop_largest`. float64 [N, 4]"""
    quats = np.empty((len(three), 4))
    quats[others(largest)] = three.reshape(-1)
    quats[np.arange(len(three)), largest] = np.sqrt(np.maximum(0.0, 1.0 - (three**2).sum(axis=1)))
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def others(largest: np.ndarray) -> np.ndarray:
    """Mark the components that are kept. bool [N, 4]"""
    return np.arange(4)[None, :] != largest[:, None]
