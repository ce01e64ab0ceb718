"""Mistakes that everyone makes once: what they compute, and the sentence that helps.

A mistake is recognised by its numbers: it explains a wrong function if it gives what the function gave, on every input
of a broken law on which the function was wrong. The first that does is told.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pop_ref.optimizer import BETAS, EPS

Oracle = dict[str, Callable[..., Any]]


@dataclass(frozen=True)
class Mistake:
    """A mistake in one function.

    Attributes:
        function: which.
        made: given the oracle's functions by name and the arguments, what the mistake computes.
        sentence: what is wrong.
        hint: where to look.
    """

    function: str
    made: Callable[..., Any]
    sentence: str
    hint: str


def _scalar_sigma(o: Oracle, squares: float, cross: float, mean2d: Any, conic: Any, px: float, py: float) -> float:
    (A, B, C), dx, dy = conic, mean2d[0] - px, mean2d[1] - py
    return squares * (A * dx * dx + C * dy * dy) + cross * B * dx * dy


def _pixel_vjp(tail: bool) -> Callable[..., Any]:
    """Make `composite_pixel_vjp` without what is behind a splat, or with the splats behind it but no background."""

    def made(o: Oracle, pixel: Any, rows: Any, px: float, py: float, background: Any, v_color: Any, v_T_final: float,
             totals: Any, *profile: Any) -> None:  # fmt: skip
        behind = 0.0
        totals.v_background[:] += pixel.T_final * np.array(v_color)
        for i, alpha, T in zip(
            reversed(pixel.ids), reversed(pixel.alphas), reversed(pixel.transmittances), strict=True
        ):
            color_dot_grad = float(np.dot(rows.colors[i], v_color))
            totals.v_colors[i] += T * alpha * np.array(v_color)
            v_alpha = T * (color_dot_grad - behind)
            behind += alpha * (color_dot_grad - behind) if tail else 0.0
            sigma = o["sigma_at_pixel"](rows.means2d[i], rows.conics[i], px, py)
            v_sigma, v_opacity = o["alpha_from_sigma_vjp"](sigma, rows.opacities[i], v_alpha, *profile)
            v_mean2d, v_conic = o["sigma_at_pixel_vjp"](rows.means2d[i], rows.conics[i], px, py, v_sigma)
            totals.v_opacities[i] += v_opacity
            totals.v_means2d[i] += v_mean2d
            totals.v_means2d_abs[i] += np.abs(v_mean2d)
            totals.v_conics[i] += v_conic

    return made


def _turned(name: str) -> Callable[..., Any]:
    return lambda o, *given: np.swapaxes(o[name](*given), 1, 2)


def _with_transposed_camera(name: str) -> Callable[..., Any]:
    def made(o: Oracle, values: Any, viewmat: Any) -> Any:
        back = viewmat.copy()
        back[:3, :3] = viewmat[:3, :3].T
        return o[name](values, back)

    return made


def _transposed_covars(o: Oracle, quats: Any, scales: Any) -> Any:
    inverse = quats * np.array([1.0, -1.0, -1.0, -1.0])
    return o["covars_from_quats_scales"](inverse, scales)


def _without_length(o: Oracle, quats: Any) -> Any:
    w, x, y, z = quats.T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _positive_first_harmonics(o: Oracle, dirs: Any, degree: int) -> Any:
    signs = np.ones((degree + 1) ** 2)
    signs[1:4:2] = -1.0
    return signs * o["sh_basis"](dirs, degree)


def _colors(half: float, unit: bool) -> Callable[..., Any]:
    """Make `colors_from_sh` without the half, or with directions as they are given."""

    def made(o: Oracle, sh: Any, dirs: Any, degree: int) -> Any:
        basis = o["sh_basis"](dirs / np.linalg.norm(dirs, axis=1, keepdims=True) if unit else dirs, degree)
        sums = [row @ each[: basis.shape[1]] for row, each in zip(basis, sh, strict=True)]
        return np.maximum(np.array(sums) + half, 0.0)

    return made


def _adam_from_zero(o: Oracle, params: Any, grads: Any, m: Any, v: Any, step: Any, lr: Any,
                    betas: Any = BETAS, eps: float = EPS) -> Any:  # fmt: skip
    """Make `adam_step` without the divisions by 1 - beta^t."""
    params, m, v = dict(params), dict(m), dict(v)
    for name, g in grads.items():
        m[name] = betas[0] * m[name] + (1.0 - betas[0]) * g
        v[name] = betas[1] * v[name] + (1.0 - betas[1]) * g * g
        params[name] = params[name] - lr[name] * m[name] / (np.sqrt(v[name]) + eps)
    return params, m, v


def _pixel(o: Oracle, ids: Any, rows: Any, px: float, py: float, background: Any, *profile: Any) -> Any:
    return o["composite_pixel"](ids, rows, px, py, [0.0] * len(background), *profile)


_TRANSPOSED: Final = (
    "It turns the world into the Gaussian's own frame, and what is wanted turns the Gaussian's axes into the world."
)
_HALF: Final = "The exponent of a Gaussian is half of d^T Q d: exp(-x^2 / 2) has a 2 under its square."

MISTAKES: Final = (
    Mistake(
        "rotmats_from_quats",
        _turned("rotmats_from_quats"),
        f"Your rotation is transposed. {_TRANSPOSED}",
        "Turn (1, 0, 0) by a quarter about z, q = (1, 0, 0, 1): it must land on (0, 1, 0), so the first column of R is"
        " (0, 1, 0). Exchange the signs of the terms with w.",
    ),
    Mistake(
        "rotmats_from_quats",
        lambda o, quats: o["rotmats_from_quats"](quats[:, [3, 0, 1, 2]]),
        "Your quaternion is read as (x, y, z, w); here the real part comes first, (w, x, y, z).",
        "The identity is (1, 0, 0, 0).",
    ),
    Mistake(
        "rotmats_from_quats",
        _without_length,
        "Your quaternion is used as it is given; it must be divided by its length first, since only then is it a"
        " rotation.",
        "Training moves its four numbers freely, so that its length is anything; unit_quats_from_quats divides.",
    ),
    Mistake(
        "covars_from_quats_scales",
        _transposed_covars,
        f"Your rotation is transposed: the covariance is R^T S S R and not R S S R^T. {_TRANSPOSED}",
        "With M = R diag(s) the covariance is M M^T. M^T M is another matrix.",
    ),
    Mistake(
        "covars_from_quats_scales",
        lambda o, quats, scales: o["covars_from_quats_scales"](quats, np.sqrt(scales)),
        "Your scales enter once; a covariance holds squares, because scales are standard deviations.",
        "With M = R diag(s) the covariance is M M^T, in which every scale stands twice.",
    ),
    Mistake(
        "sh_basis",
        _positive_first_harmonics,
        "Two of your harmonics of degree 1 have the wrong sign: they are (-y, z, -x) times a constant.",
        "The signs are a convention, and every file of splats follows it.",
    ),
    Mistake(
        "colors_from_sh",
        _colors(half=0.0, unit=True),
        "The half is missing: a Gaussian whose coefficients are 0 is grey, not black.",
        "c = max(sum_k Y_k h_k + 0.5, 0).",
    ),
    Mistake(
        "colors_from_sh",
        _colors(half=0.5, unit=False),
        "Your direction is used as it is given; the harmonics ask for one of length 1.",
        "Divide each direction by its length before sh_basis.",
    ),
    Mistake(
        "sigma_at_pixel",
        lambda o, *given: _scalar_sigma(o, 1.0, 1.0, *given),
        f"A half is missing before the two squares. {_HALF}",
        "The cross term has no half, because B stands twice in the symmetric matrix Q and once in the conic.",
    ),
    Mistake(
        "sigma_at_pixel",
        lambda o, *given: _scalar_sigma(o, 1.0, 2.0, *given),
        f"A half is missing: your exponent is twice what it should be. {_HALF}",
        "Halve the whole of A dx dx + 2 B dx dy + C dy dy.",
    ),
    Mistake(
        "sigma_at_pixel",
        lambda o, *given: _scalar_sigma(o, 0.5, 0.5, *given),
        "The cross term is halved once too often: B stands twice in the symmetric matrix Q, once in the conic.",
        "Write Q = [[A, B], [B, C]] and multiply d^T Q d out before you halve it.",
    ),
    Mistake(
        "falloff",
        lambda o, sigma: float(np.exp(sigma)),
        "Your falloff grows with the distance: the exponent's sign is missing.",
        "It is 1 at the centre and less everywhere else.",
    ),
    Mistake(
        "alpha_from_sigma",
        lambda o, sigma, opacity, *profile: (opacity * o["falloff"](sigma), False),
        "Your alpha has neither ceiling nor floor.",
        "Take min(profile.alpha_ceiling, ...), and skip the splat where sigma < 0 or alpha < profile.alpha_floor.",
    ),
    Mistake(
        "composite_pixel",
        _pixel,
        "The background is missing: what light is left behind the last splat shows it.",
        "Add T_final times the background to the colour.",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(tail=False),
        "The tail is missing from dC/dalpha: more alpha shows more of a splat's own colour, and hides the colour of all"
        " that is behind it. Yours has the first part only.",
        "C = T (alpha c + (1 - alpha) behind), so dC/dalpha = T (c - behind). Walk from the back: start with behind ="
        " background . v_color + v_T_final, and after each splat behind += alpha (color_dot_grad - behind).",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(tail=True),
        "The background is missing from the light behind the last splat.",
        "Before the walk from back to front, behind is background . v_color + v_T_final.",
    ),
    Mistake(
        "means_cam_from_means",
        _with_transposed_camera("means_cam_from_means"),
        "Your camera's rotation is transposed.",
        "viewmat takes the world into the camera: p = R mean + t, without a transpose.",
    ),
    Mistake(
        "covars_cam_from_covars",
        _with_transposed_camera("covars_cam_from_covars"),
        "Your camera's rotation is transposed.",
        "A linear map A turns a covariance S into A S A^T; here A is R = viewmat[:3, :3].",
    ),
    Mistake(
        "camera_center",
        lambda o, viewmat: -viewmat[:3, 3],
        "Your centre is -t, which is in the camera's frame; it is asked for in the world's.",
        "The centre is the point that viewmat takes to 0: solve R c + t = 0.",
    ),
    Mistake(
        "project_means",
        lambda o, means_cam, K, width, height, *profile: (
            o["project_means"](means_cam, K, width, height, *profile) - K[:2, 2]
        ),
        "The principal point is missing: you measure from the optical axis, pixels are counted from the corner.",
        "Add (cx, cy) = (K[0, 2], K[1, 2]).",
    ),
    Mistake(
        "conics_from_covars2d",
        lambda o, covars2d: covars2d.reshape(-1, 4)[:, [0, 1, 3]],
        "You return the covariance; a conic is its inverse.",
        "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
    ),
    Mistake(
        "conics_from_covars2d",
        lambda o, covars2d: o["conics_from_covars2d"](covars2d) * np.array([1.0, -1.0, 1.0]),
        "The off-diagonal of the inverse has the wrong sign.",
        "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
    ),
    Mistake(
        "conics_from_covars2d_vjp",
        lambda o, covars2d, v: o["conics_from_covars2d_vjp"](covars2d, v * np.array([1.0, 2.0, 1.0])),
        "The off-diagonal counts twice: it stands once in the conic and twice in the matrix.",
        "Give each of the matrix's two entries half of v_xy.",
    ),
    Mistake(
        "opacities_from_logits_vjp",
        lambda o, logits, v: v.copy(),
        "The sigmoid's slope is missing.",
        "o = 1 / (1 + exp(-x)) has the derivative o (1 - o).",
    ),
    Mistake(
        "adam_step",
        _adam_from_zero,
        "The two running means are not corrected: both start at 0, so that the first steps have the wrong length.",
        "Divide m by 1 - beta1^t and v by 1 - beta2^t before the quotient; keep m and v themselves as they are.",
    ),
    Mistake(
        "prune_rows",
        lambda o, rows, mask: o["prune_rows"](rows, ~mask),
        "You keep the rows that are to be removed: the mask selects what goes.",
        "rows[~mask] are the survivors, in every parameter and both moments.",
    ),
    Mistake(
        "l2_vjp",
        lambda o, *given: 0.5 * o["l2_vjp"](*given),
        "A two is missing: the derivative of a square is twice its base.",
        "l2 is a mean of squares, without a half in front.",
    ),
)


def explained_by(calls: list[Any], oracle: Oracle) -> Mistake | None:
    """Find the mistake that gives what a function gave, on every call on which it was wrong.

    Args:
        calls: wrong calls of one function, see `student.Call`.
        oracle: the oracle's functions by name.
    """
    for mistake in MISTAKES:
        if calls and mistake.function == calls[0].function and all(_explains(mistake, c, oracle) for c in calls):
            return mistake
    return None


def _explains(mistake: Mistake, call: Any, oracle: Oracle) -> bool:
    given = copy.deepcopy(call.given)
    try:
        made = mistake.made(oracle, *given, *call.named.values())
    except Exception:
        # a mistake that does not fit these arguments explains nothing
        return False
    changed = tuple(a for b, a in zip(call.given, given, strict=True) if repr(b) != repr(a))
    return same((made, changed), call.found)


def numbers(value: Any) -> np.ndarray:
    """Flatten whatever a function returns into one row of numbers.

    Example:
        >>> numbers((0.5, [np.eye(2)], None))
        array([0.5, 1. , 0. , 0. , 1. ])
    """
    if value is None:
        return np.zeros(0)
    if isinstance(value, dict):
        value = tuple(value.values())
    elif hasattr(value, "__dataclass_fields__"):
        value = tuple(getattr(value, name) for name in value.__dataclass_fields__)
    if isinstance(value, tuple | list):
        return np.concatenate([np.zeros(0), *map(numbers, value)])
    return np.asarray(value, dtype=np.float64).ravel()


def same(one: Any, other: Any) -> bool:
    """Tell whether two results are one but for rounding."""
    a, b = numbers(one), numbers(other)
    if a.shape != b.shape:
        return False
    return bool(np.allclose(a, b, rtol=1e-9, atol=1e-12, equal_nan=True))
