"""Fewer Gaussians in a file: which to leave out, by opacity, by place, by what they contribute, or down to a size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final, Literal

import torch
from torch import Tensor

from pop_fast.density.passes import Passes
from pop_fast.errors import PopError
from pop_fast.stages.covariance import opacities_from_logits
from pop_fast.stages.density import least_mass

Score = Literal["contributions", "dominance", "sensitivity", "visibility"]
# encodings that a search for a size makes, at most
_TRIES: Final = 12
# a file this close under its size is close enough
_CLOSE: Final = 0.98


def opaque_enough(params: Mapping[str, Tensor], min_opacity: float) -> Tensor:
    """Tell which Gaussians have an opacity of at least `min_opacity`; PopError outside [0, 1]. [N] bool"""
    if not 0.0 <= min_opacity <= 1.0:
        raise PopError(f"--min-opacity {min_opacity:g} must be in [0, 1]")
    return opacities_from_logits(params["opacities"]) >= min_opacity


def inside(means: Tensor, box: Sequence[float]) -> Tensor:
    """Tell which centres lie in a box, its faces included. [N] bool

    Args:
        means: in the frame of the box. [N, 3]
        box: xmin, ymin, zmin, xmax, ymax, zmax.

    Raises:
        PopError: a lower bound is over its upper bound, or not a number.
    """
    low, high = torch.tensor(box[:3], dtype=torch.float64), torch.tensor(box[3:], dtype=torch.float64)
    if not bool((low <= high).all()):
        raise PopError(
            f"--crop {' '.join(f'{value:g}' for value in box)}: every lower bound must be under its upper one"
        )
    return ((means >= low) & (means <= high)).all(1)


def visibility(params: Mapping[str, Tensor]) -> Tensor:
    """Guess how much each Gaussian is seen, without a view: opacity times the root of its largest cross-section. [N]"""
    log_scales = params["scales"].double().sort(1).values
    return opacities_from_logits(params["opacities"].double()) * torch.exp(0.5 * (log_scales[:, 1] + log_scales[:, 2]))


def view_scores(score: Score, passes: Passes, params: Mapping[str, Tensor], sh_degree: int) -> Tensor:
    """Sum a score of every Gaussian over views.

    Args:
        score: "contributions" adds the blending weights over all pixels, "dominance" counts the pixels where it has the
            largest, "sensitivity" is Speedy-Splat's; "visibility" needs no view.

    Returns:
        Not negative. [N] float64
    """
    if score == "visibility":
        return visibility(params)
    total = torch.zeros(len(params["means"]), dtype=torch.float64)
    for index in range(passes.n_views):
        if score == "sensitivity":
            total += passes.sensitivities(params, index, sh_degree).cpu()
            continue
        found = passes.contributions(params, index, sh_degree)
        total += (found.weight_sum if score == "contributions" else found.dominant_counts).cpu().double()
    return total


def all_but_the_least(scores: Tensor, share: float) -> Tensor:
    """Tell which Gaussians stay when those with the least score go that make up a share of all of it. [N] bool

    Those with a score of 0 go in any case.

    Raises:
        PopError: the share is outside [0, 1).
    """
    if not 0.0 <= share < 1.0:
        raise PopError(f"--final-prune {share:g} must be in [0, 1)")
    unseen = scores <= 0.0
    return ~unseen if share == 0.0 or not bool(scores.any()) else ~(unseen | least_mass(scores, share))


def best(scores: Tensor, count: int) -> Tensor:
    """Tell which are the `count` Gaussians with the highest scores, of equals the first ones. [N] bool"""
    kept = torch.zeros(len(scores), dtype=torch.bool)
    kept[scores.argsort(descending=True, stable=True)[:count]] = True
    return kept


def best_within(scores: Tensor, most: int, size_of: Callable[[Tensor], int]) -> Tensor:
    """Tell which Gaussians with the highest scores make a file of at most `most` bytes. [N] bool

    The number is found by false position and then by halves, with at most a dozen encodings.

    Args:
        scores: [N]
        size_of: the bytes of a file with the Gaussians that are marked. [N] bool -> int

    Raises:
        PopError: a file without any Gaussian is larger.
    """
    n = len(scores)
    everything = torch.ones(n, dtype=torch.bool)
    size = size_of(everything)
    if size <= most:
        return everything
    empty = size_of(~everything)
    if empty > most:
        raise PopError(
            f"--target-mb: a file without any Gaussian has {empty:,} bytes already, over {most:,}; ask for more"
        )
    low, low_size, high, high_size = 0, empty, n, size
    for attempt in range(_TRIES):
        if high - low <= 1 or low_size >= _CLOSE * most:
            break
        share = (0.995 * most - low_size) / (high_size - low_size) if attempt % 3 < 2 else 0.5
        count = min(max(low + int(share * (high - low)), low + 1), high - 1)
        found = size_of(best(scores, count))
        if found <= most:
            low, low_size = count, found
        else:
            high, high_size = count, found
    return best(scores, low)
