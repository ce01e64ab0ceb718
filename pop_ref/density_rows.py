"""Row operations of density control: clone, split, prune, reset, with Adam's moments carried along.

Gaussians in training: a dictionary of arrays that share their first axis; Adam's moments m and v have its keys and
shapes.
Every operation is one gather of surviving rows followed by appended rows, the same for each key: a row stays one row.

    clone   all rows, then copies of the selected ones in their order
    split   the rows that were not selected, then all first children, then all second children
    prune   the rows that were not selected

Survivors keep their order and their bits, in parameters and moments; appended rows start with zero moments. Adam's step
counter belongs to the tensor, not to the row, and is not touched.

Labels decided here: A26 (the opacity of split children).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pop_ref._shapes import Bool, Float64
from pop_ref.activations import scales_from_log_scales
from pop_ref.covariance import rotmats_from_quats
from pop_ref.settings import POP, SPLIT_CHILDREN, SPLIT_SHRINK


@dataclass(frozen=True)
class Rows:
    """Raw parameters and Adam's moments, one row a Gaussian.

    Attributes:
        params: arrays whose first axis has one entry a Gaussian; density control reads "means" [N, 3], "scales"
            (log) [N, 3], "quats" [N, 4] and "opacities" (logit) [N], and carries every other key along.
        m: Adam's first moments, keys and shapes as `params`.
        v: Adam's second moments, keys and shapes as `params`.
    """

    params: Mapping[str, np.ndarray]
    m: Mapping[str, np.ndarray]
    v: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        lengths = {name: len(array) for name, array in self.params.items()}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"params have lengths {lengths}; there must be at least one key, and one common length")
        for field, moments in (("m", self.m), ("v", self.v)):
            for name, array in self.params.items():
                if name not in moments or moments[name].shape != array.shape:
                    raise ValueError(f"{field}[{name!r}] must have the shape of params[{name!r}], {list(array.shape)}")

    def __len__(self) -> int:
        return len(next(iter(self.params.values())))


def rows_from_params(params: Mapping[str, np.ndarray]) -> Rows:
    """Start from Gaussians: these parameters, and zero moments.

    Source: Kingma and Ba 2015, algorithm 1 (m_0 = v_0 = 0).
    Departs: nothing.

    Args:
        params: raw parameters, one row a Gaussian.

    Returns:
        The Gaussians.

    Raises:
        ValueError: the arrays differ in length.

    Example:
        >>> rows_from_params({"means": np.ones((2, 3))}).m["means"].tolist()
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    zeros = {name: np.zeros_like(array) for name, array in params.items()}
    return Rows(dict(params), zeros, {name: array.copy() for name, array in zeros.items()})


def clone_rows(rows: Rows, mask: Bool[np.ndarray, " N"]) -> Rows:
    """Append exact copies of the selected rows; the sources keep their moments.

    Source: Kerbl et al. 2023, section 5.2 (clone).
    Departs: Kerbl et al. move the copy along the gradient; every code appends it in place, and so does this.

    Args:
        rows: the Gaussians.
        mask: True where a row is cloned.

    Returns:
        All rows, then the copies in the order of their sources.

    Example:
        >>> rows = rows_from_params({"means": np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])})
        >>> clone_rows(rows, np.array([True, False])).params["means"][:, 0].tolist()
        [1.0, 2.0, 1.0]
    """
    copies = {name: array[mask] for name, array in rows.params.items()}
    return _keep_and_append(rows, np.ones(len(rows), dtype=bool), copies)


def split_rows(
    rows: Rows,
    mask: Bool[np.ndarray, " N"],
    normals: Float64[np.ndarray, "2 n_split 3"],
    revised_opacity: bool = False,
) -> Rows:
    """Replace each selected row by two smaller ones drawn from it.

    `mean' = mean + R(q) (s eps)` and `log s' = log(s / 1.6)` on every axis; the other parameters are copied. Children
    keep the parent's opacity (A26), unless `revised_opacity` gives each `1 - sqrt(1 - o)`, so that two on top of each
    other are as opaque as the parent.

    Source: Kerbl et al. 2023, section 5.2 (split, factor 1.6).
    Departs: nothing; the draws are an argument so that the operation is pure.

    Args:
        rows: the Gaussians.
        mask: True where a row is split.
        normals: eps, standard normal draws: first and second child of each selected row, in row order.
        revised_opacity: gsplat's option of that name.

    Returns:
        The rows that were not selected, then the first children, then the second.

    Raises:
        ValueError: `normals` does not hold two draws for each selected row.

    Example:
        >>> rows = rows_from_params({"means": np.zeros((1, 3)), "scales": np.zeros((1, 3)),
        ...                          "quats": np.array([[1.0, 0.0, 0.0, 0.0]]), "opacities": np.zeros(1)})
        >>> split_rows(rows, np.array([True]), np.array([[[1.0, 0.0, 0.0]], [[-0.5, 0.0, 0.0]]])).params["means"][:, 0]
        array([ 1. , -0.5])
    """
    n_split = int(np.sum(mask))
    if normals.shape != (SPLIT_CHILDREN, n_split, 3):
        raise ValueError(f"normals is {list(normals.shape)}; it must be [2, {n_split}, 3], two draws a selected row")
    parents = {name: array[mask] for name, array in rows.params.items()}
    scales = scales_from_log_scales(parents["scales"])
    rotmats = rotmats_from_quats(parents["quats"])
    children = {name: np.concatenate([array] * SPLIT_CHILDREN) for name, array in parents.items()}
    for child in range(SPLIT_CHILDREN):
        for i in range(n_split):
            children["means"][child * n_split + i] += rotmats[i] @ (scales[i] * normals[child, i])
    children["scales"] = np.concatenate([np.log(scales / SPLIT_SHRINK)] * SPLIT_CHILDREN)
    if revised_opacity:
        # log sqrt(1 - o), written so that neither o = 0 nor o = 1 is rounded to on the way
        log_left = -0.5 * np.logaddexp(0.0, children["opacities"])
        children["opacities"] = np.log(-np.expm1(log_left)) - log_left
    return _keep_and_append(rows, ~mask, children)


def prune_rows(rows: Rows, mask: Bool[np.ndarray, " N"]) -> Rows:
    """Remove the selected rows.

    Source: Kerbl et al. 2023, section 5.2.
    Departs: nothing.

    Args:
        rows: the Gaussians.
        mask: True where a row is removed.

    Returns:
        The rows that are left, in order.

    Example:
        >>> rows = rows_from_params({"means": np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])})
        >>> prune_rows(rows, np.array([True, False])).params["means"][:, 0].tolist()
        [2.0]
    """
    return _keep_and_append(rows, ~mask, {name: array[:0] for name, array in rows.params.items()})


def reset_opacities(rows: Rows, ceiling: float = POP.reset_opa) -> Rows:
    """Lower every opacity to at most `ceiling` and forget the opacities' moments: `o <- min(o, ceiling)`.

    Source: POP paper section 3.1 (the reset that POP does without); the ceiling 0.01 is Inria's and gsplat's.
    Departs: the paper writes o -> 0; every code takes the minimum with 0.01.

    Args:
        rows: the Gaussians.
        ceiling: the largest opacity afterwards, in (0, 1).

    Returns:
        The Gaussians with new opacities; their m and v are 0, all other values keep their bits.

    Example:
        >>> rows = reset_opacities(rows_from_params({"opacities": np.array([0.0, -9.0])}), 0.25)
        >>> rows.params["opacities"].round(3).tolist()
        [-1.099, -9.0]
    """
    logit = np.log(ceiling / (1.0 - ceiling))
    zeros = np.zeros(len(rows))
    return Rows(
        {**rows.params, "opacities": np.minimum(rows.params["opacities"], logit)},
        {**rows.m, "opacities": zeros},
        {**rows.v, "opacities": zeros.copy()},
    )


def _keep_and_append(rows: Rows, keep: np.ndarray, new: Mapping[str, np.ndarray]) -> Rows:
    """Gather the kept rows of every array, then append the new rows with zero moments."""
    params = {name: np.concatenate([array[keep], new[name]]) for name, array in rows.params.items()}
    m = {name: np.concatenate([array[keep], np.zeros_like(new[name])]) for name, array in rows.m.items()}
    v = {name: np.concatenate([array[keep], np.zeros_like(new[name])]) for name, array in rows.v.items()}
    return Rows(params, m, v)
