"""What a photograph adds to a scene: its exposure, and how a comparison leaves exposure out; and random backgrounds.

Cameras choose exposure and white balance anew for every photograph. An image's own affine map of colours, learned with
the scene, takes that up: `y = A c + b` with the 3x4 matrix [A | b]. A held-out photograph has no such map, so it is
compared twice, plainly and after the render's channels have been fitted to the photograph's.

A background of another colour at every step keeps Gaussians from leaving holes that happen to show the right colour.

Exposures and corrections of cameras are learned with the scene, by an Adam of their own whose rates fall.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pop_ref._shapes import Float64
from pop_ref.optimizer import MAX_STEPS, adam_step
from pop_ref.refinement import without_common_motion
from pop_ref.settings import APPEARANCE_RATES, AppearanceRates

# SplitMix64: the odd number nearest to 2^64 over the golden ratio, and the multipliers of its finalizer
_GOLDEN = 0x9E3779B97F4A7C15
_MIX = (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
_WORD = 2**64 - 1
# a channel that varies less, or a fit that is flatter, says nothing about exposure
_LEAST = 1e-8


def expose(image: Float64[np.ndarray, "H W 3"], exposure: Float64[np.ndarray, "3 4"]) -> Float64[np.ndarray, "H W 3"]:
    """Map every pixel's colour: `y = A c + b`, exposure = [A | b].

    Source: Kerbl et al., gaussian-splatting since October 2024 (`exposure`); gsplat's bilateral grids with one cell.
    Departs: nothing; Inria multiplies rows by its matrix, so that its A is the transpose of this one.

    Args:
        image: a render, not clamped.
        exposure: of the photograph that it is compared with; [I | 0] changes nothing.

    Returns:
        The render in the colours of the photograph, not clamped.

    Example:
        >>> brighter = np.array([[2.0, 0.0, 0.0, 0.25], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
        >>> expose(np.array([[[0.25, 0.5, 1.0]]]), brighter)
        array([[[0.75, 0.5 , 1.  ]]])
    """
    exposed = np.zeros(image.shape)
    for y, x in np.ndindex(image.shape[:2]):
        exposed[y, x] = exposure[:, :3] @ image[y, x] + exposure[:, 3]
    return exposed


def expose_vjp(
    image: Float64[np.ndarray, "H W 3"],
    exposure: Float64[np.ndarray, "3 4"],
    v_exposed: Float64[np.ndarray, "H W 3"],
) -> tuple[Float64[np.ndarray, "H W 3"], Float64[np.ndarray, "3 4"]]:
    """Pull a cotangent of exposed colours back: `v_c = A^T v_y`, `v_A = sum v_y c^T`, `v_b = sum v_y` over pixels.

    Source: transpose of `expose`.
    Departs: nothing.

    Args:
        image: a render, not clamped.
        exposure: of the photograph.
        v_exposed: cotangent of the exposed image.

    Returns:
        Cotangents of the render and of the exposure.

    Example:
        >>> v_image, v_exposure = expose_vjp(np.full((1, 1, 3), 0.5), np.eye(3, 4), np.array([[[1.0, 2.0, 0.0]]]))
        >>> v_exposure
        array([[0.5, 0.5, 0.5, 1. ],
               [1. , 1. , 1. , 2. ],
               [0. , 0. , 0. , 0. ]])
    """
    v_image, v_exposure = np.zeros(image.shape), np.zeros((3, 4))
    for y, x in np.ndindex(image.shape[:2]):
        v_image[y, x] = exposure[:, :3].T @ v_exposed[y, x]
        v_exposure[:, :3] += np.outer(v_exposed[y, x], image[y, x])
        v_exposure[:, 3] += v_exposed[y, x]
    return v_image, v_exposure


def centred_exposures(exposures: Float64[np.ndarray, "V 3 4"]) -> Float64[np.ndarray, "V 3 4"]:
    """Shift the exposures of all photographs alike, so that their mean is [I | 0].

    A scene that is twice as bright and exposures that halve it make the same images: nothing in the loss says which
    colours are the scene's. So that held-out views can be compared plainly, the scene's are those of the mean exposure.

    Source: none; without it the colours drift.
    Departs: Inria and gsplat let them.

    Args:
        exposures: of the photographs that are trained on.

    Returns:
        The same less what their mean exceeds [I | 0] by.

    Example:
        >>> exposures = np.stack([np.eye(3, 4), 3.0 * np.eye(3, 4)])
        >>> centred_exposures(exposures)[:, 0, 0]
        array([0., 2.])
    """
    return exposures - (np.mean(exposures, axis=0) - np.eye(3, 4))


def appearance_rates(
    step: int, max_steps: int = MAX_STEPS, rates: AppearanceRates = APPEARANCE_RATES
) -> dict[str, float]:
    """Decay the rates of exposures and of cameras log-linearly: `rate decay^(step / max_steps)`.

    Source: Kerbl et al., gaussian-splatting since October 2024 (`exposure_scheduler_args`); gsplat's trainer, whose
        `pose_opt` decays by 0.01.
    Departs: Inria's exposures start after a delay, which by its defaults has no length.

    Args:
        step: from 0.
        max_steps: length of the training.
        rates: at the start, and their decays.

    Returns:
        Rates of `exposures` and `cameras` at the step.

    Example:
        >>> {name: f"{rate:.0e}" for name, rate in appearance_rates(15_000).items()}
        {'exposures': '3e-03', 'cameras': '1e-06'}
    """
    share = step / max_steps
    return {
        "exposures": rates.exposures * rates.exposures_decay**share,
        "cameras": rates.cameras * rates.cameras_decay**share,
    }


def appearance_steps(
    grads: Sequence[Mapping[str, Float64[np.ndarray, "V ..."]]],
    viewmats: Float64[np.ndarray, "V 4 4"],
    max_steps: int = MAX_STEPS,
    rates: AppearanceRates = APPEARANCE_RATES,
) -> dict[str, Float64[np.ndarray, "V ..."]]:
    """Learn exposures from [I | 0] and corrections of cameras from 0, by the gradients of a training's first steps.

    After each of Adam's updates what the loss says nothing of is taken out again: the mean of the exposures, and the
    motion that all cameras share.

    Source: gsplat's trainer and Inria's, which have an Adam for each.
    Departs: both let exposures and cameras drift together.

    Args:
        grads: of each step, the gradients of what is learned: `exposures` [V, 3, 4], `cameras` [V, 6], or one of them.
        viewmats: world -> camera, of the photographs before they are corrected.
        max_steps: length of the training.
        rates: at the start, and their decays.

    Returns:
        What is learned after the last of the steps, by the same names.

    Example:
        >>> opposite = np.ones((2, 3, 4)) * np.array([1.0, -1.0])[:, None, None]
        >>> appearance_steps([{"exposures": opposite}], np.stack([np.eye(4)] * 2))["exposures"][:, 0, 0].round(9)
        array([0.99, 1.01])
    """
    n = len(viewmats)
    starts = {"exposures": np.tile(np.eye(3, 4), (n, 1, 1)), "cameras": np.zeros((n, 6))}
    moved = {name: starts[name] for name in grads[0]} if grads else {}
    m, v = ({name: np.zeros_like(array) for name, array in moved.items()} for _ in range(2))
    for step, given in enumerate(grads):
        moved, m, v = adam_step(moved, given, m, v, step + 1, appearance_rates(step, max_steps, rates))
        if "exposures" in moved:
            moved["exposures"] = centred_exposures(moved["exposures"])
        if "cameras" in moved:
            moved["cameras"] = without_common_motion(moved["cameras"], viewmats)
    return moved


def color_correct(image: Float64[np.ndarray, "P 3"], target: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, "P 3"]:
    """Fit each channel of a render to its photograph's, for measurements: `(c - b) / a` with `a t + b` nearest to c.

    The line is fitted by least squares over all pixels, from photograph t to render c, and then inverted; the result is
    clamped to [0, 1]. A channel of the photograph that hardly varies, or a flat line, has the slope 1. What a render
    gets wrong flattens the line, so that a poor one can be further from its photograph when it has been corrected.

    Source: gsplat's trainer, metric cc_psnr with `color_correct_method` "affine", after Mildenhall et al., multinerf.
    Departs: nothing.

    Args:
        image: pixels of a render, clamped to [0, 1].
        target: pixels of the photograph, in [0, 1].

    Returns:
        The corrected pixels of the render, in [0, 1].

    Example:
        >>> target = np.array([[0.0, 0.25, 0.5], [1.0, 0.75, 0.5]])
        >>> color_correct(0.5 * target + 0.25, target)[:, :2]
        array([[0.  , 0.25],
               [1.  , 0.75]])
    """
    corrected = np.zeros(image.shape)
    for channel in range(3):
        c, t = image[:, channel], target[:, channel]
        variance = max(float(np.mean(t * t) - np.mean(t) ** 2), _LEAST)
        slope = float(np.mean(t * c) - np.mean(t) * np.mean(c)) / variance
        offset = float(np.mean(c)) - slope * float(np.mean(t))
        corrected[:, channel] = np.clip((c - offset) / (slope if abs(slope) >= _LEAST else 1.0), 0.0, 1.0)
    return corrected


def background_at(step: int, seed: int) -> Float64[np.ndarray, "3"]:
    """Draw the background of a training step, each channel uniform in [0, 1): three numbers of a stream.

    The stream is SplitMix64 from the state mix(seed). Any step's colour is found without those before it, so a run that
    continues after an interruption needs nothing but its seed.

    Source: gsplat's trainer (`random_bkgd`) draws uniformly; Steele, Lea and Flood 2014 for the stream.
    Departs: gsplat draws from torch's global generator.

    Args:
        step: from 0.
        seed: of the training.

    Returns:
        The colour, to be laid behind everything: a render gains T_final times it.

    Example:
        >>> background_at(0, 42).round(4)
        array([0.5961, 0.1604, 0.1664])
        >>> bool(np.array_equal(background_at(7, 42), background_at(7, 43)))
        False
    """
    start = _mixed(seed)
    words = [_mixed((start + (3 * step + channel + 1) * _GOLDEN) & _WORD) for channel in range(3)]
    return np.array([(word >> 11) * 2.0**-53 for word in words])


def over_background(
    photo: Float64[np.ndarray, "H W 3"],
    alpha: Float64[np.ndarray, "H W"],
    was: Float64[np.ndarray, "3"],
    now: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "H W 3"]:
    """Lay a photograph with transparency over another background: `I + (1 - alpha) (now - was)`.

    Where a render's background changes from step to step, so must that of the photographs that it is compared with.

    Source: Porter and Duff 1984, the operator "over": I = alpha c + (1 - alpha) was.
    Departs: nothing; the colour c is not asked for, which is unknown where alpha is 0.

    Args:
        photo: laid over `was`.
        alpha: its opacity, in [0, 1].
        was: the background that it lies over.
        now: the one that it is to lie over.

    Returns:
        alpha c + (1 - alpha) now.

    Example:
        >>> over_background(np.full((1, 1, 3), 0.5), np.array([[0.75]]), np.zeros(3), np.array([1.0, 0.5, 0.0]))
        array([[[0.75 , 0.625, 0.5  ]]])
    """
    return photo + (1.0 - alpha)[:, :, None] * (now - was)


def _mixed(word: int) -> int:
    word &= _WORD
    word = ((word ^ (word >> 30)) * _MIX[0]) & _WORD
    word = ((word ^ (word >> 27)) * _MIX[1]) & _WORD
    return word ^ (word >> 31)
