"""The polarized opacity prior: what is important in a view, and the pull of opacities to 1 or to 0.

With M the importance mask and N_imp = Σ M,

    L_POP = 1 / N_imp Σ M (1 - o) + 1 / (N - N_imp) Σ (1 - M) o

so an important opacity feels -1 / N_imp and any other +1 / (N - N_imp): no gradient runs through the mask, and none
depends on o itself. Through the sigmoid the pull on a logit is that times o (1 - o).

A rival of the prior is `opacity_entropy`, which pulls every opacity to the pole that it is nearer to.

Labels decided here: A1 (whose dominant counts), A7 (an empty term is 0), A12 (over which Gaussians the sums run).
"""

from __future__ import annotations

import numpy as np

from pop_ref._shapes import Bool, Float64, Int64
from pop_ref.activations import opacities_from_logits


def importance_mask(dominant_counts: Int64[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """Mark the Gaussians that dominate at least one pixel: `M = dominant_counts > 0`.

    Source: POP paper eq. 7.
    Departs: nothing. The counts are those of the current view (A1); the alternative passes the counts summed over the
        densification window, which `density.Statistics.dominant_sum` keeps.

    Args:
        dominant_counts: pixels that each Gaussian dominates, of the forward pass that made the training image.

    Returns:
        True where a Gaussian is important.

    Example:
        >>> importance_mask(np.array([3, 0, 1])).tolist()
        [True, False, True]
    """
    return dominant_counts > 0


def pop_loss(
    opacities: Float64[np.ndarray, " N"],
    mask: Bool[np.ndarray, " N"],
    visible: Bool[np.ndarray, " N"] | None = None,
) -> float:
    """Measure how far opacities are from polarised: important ones from 1, the others from 0.

    `mean of (1 - o) where mask, plus mean of o where not mask`; a mean over nothing is 0 (A7).

    Source: POP paper eq. 8.
    Departs: nothing. The sums run over all N Gaussians as the equation says, also those outside the view (A12); with
        `visible` both are restricted to what the view shows.

    Args:
        opacities: activated, in [0, 1].
        mask: True where a Gaussian is important.
        visible: None for all Gaussians (the default reading), or True where one takes part.

    Returns:
        The loss, in [0, 2]; exactly 0 when every opacity is at its pole.

    Example:
        >>> pop_loss(np.array([0.75, 0.5, 0.25]), np.array([True, False, False]))
        0.625
    """
    important, other = _sides(mask, visible)
    toward_one = np.sum(1.0 - opacities[important]) / max(int(np.sum(important)), 1)
    toward_zero = np.sum(opacities[other]) / max(int(np.sum(other)), 1)
    return float(toward_one + toward_zero)


def pop_loss_vjp(
    opacities: Float64[np.ndarray, " N"],
    mask: Bool[np.ndarray, " N"],
    v_loss: float,
    visible: Bool[np.ndarray, " N"] | None = None,
) -> Float64[np.ndarray, " N"]:
    """Pull a cotangent of `pop_loss` back to the opacities: `-v / N_imp` where mask, `+v / (N - N_imp)` elsewhere.

    The mask is a constant: no gradient goes through it.

    Source: derivative of POP paper eq. 8.
    Departs: nothing.

    Args:
        opacities: activated, in [0, 1]; the result does not depend on their values.
        mask: True where a Gaussian is important.
        v_loss: cotangent of the loss.
        visible: as in `pop_loss`; a Gaussian that takes no part gets exactly 0.

    Returns:
        Cotangent of `opacities`.

    Example:
        >>> pop_loss_vjp(np.array([0.75, 0.5, 0.25]), np.array([True, False, False]), 1.0).tolist()
        [-1.0, 0.5, 0.5]
    """
    important, other = _sides(mask, visible)
    v_opacities = np.zeros(len(opacities))
    v_opacities[important] = -v_loss / max(int(np.sum(important)), 1)
    v_opacities[other] = v_loss / max(int(np.sum(other)), 1)
    return v_opacities


def opacity_entropy(logits: Float64[np.ndarray, " N"]) -> float:
    """Average the binary entropy of opacities: `mean_i(-o ln o - (1 - o) ln(1 - o))`, which is 0 at both poles.

    Source: the opacity regularizer of volume and splat models that polarises without a mask, as in Guedon and Lepetit
        2024 (SuGaR); the POP paper, section 2, sets itself apart from it.
    Departs: written by the logit x, of which the two logarithms are -softplus(-x) and -softplus(x), so that no opacity
        is too near a pole.

    Args:
        logits: of the opacities.

    Returns:
        The mean, in nats; 0 for no Gaussians.

    Example:
        >>> round(opacity_entropy(np.array([0.0])), 12), opacity_entropy(np.array([800.0]))
        (0.69314718056, 0.0)
    """
    o, rest = opacities_from_logits(logits), opacities_from_logits(-logits)
    entropies = o * np.logaddexp(0.0, -logits) + rest * np.logaddexp(0.0, logits)
    return float(np.sum(entropies) / max(len(logits), 1))


def opacity_entropy_vjp(logits: Float64[np.ndarray, " N"], v_loss: float) -> Float64[np.ndarray, " N"]:
    """Pull a cotangent of `opacity_entropy` back to the logits: `-v x o (1 - o) / N`.

    An opacity over one half rises, another falls, wherever the Gaussian is.

    Source: derivative of `opacity_entropy`.
    Departs: nothing.

    Args:
        logits: of the opacities.
        v_loss: cotangent of the mean.

    Returns:
        Cotangent of `logits`.

    Example:
        >>> opacity_entropy_vjp(np.array([0.0, 800.0]), 1.0).tolist()
        [-0.0, -0.0]
    """
    o, rest = opacities_from_logits(logits), opacities_from_logits(-logits)
    return -v_loss * logits * o * rest / max(len(logits), 1)


def _sides(mask: np.ndarray, visible: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    taking_part = np.ones(len(mask), dtype=bool) if visible is None else visible
    return mask & taking_part, ~mask & taking_part
