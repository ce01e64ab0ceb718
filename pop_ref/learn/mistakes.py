"""Mistakes that everyone makes once: what they compute, and the sentence that helps.

A mistake is recognised by its numbers: it explains a wrong function if it gives what the function gave on every input
that was tried. The first that does is told.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from pop_ref.learn.mistakes_geometry import GEOMETRY, Mistake, Oracle
from pop_ref.learn.student import Call, same
from pop_ref.optimizer import BETAS, EPS


def _sigma(squares: float = 0.5, cross: float = 1.0, right: float = 0.0, down: float = 0.0) -> Callable[..., Any]:
    """Make `sigma_at_pixel` with other factors, or with the pixel's centre elsewhere."""

    def made(o: Oracle, mean2d: Any, conic: Any, px: float, py: float) -> float:
        (A, B, C), dx, dy = conic, mean2d[0] - px - right, mean2d[1] - py - down
        return squares * (A * dx * dx + C * dy * dy) + cross * B * dx * dy

    return made


def _shifted(right: float, down: float) -> Mistake:
    return Mistake(
        "sigma_at_pixel",
        _sigma(right=right, down=down),
        "Your pixel is half a pixel off: px and py are the pixel's centre already, its index + 0.5.",
        "Use d = mean2d - (px, py) as they are given; add or take away no half.",
    )


def _pixel_vjp(tail: bool, background_seen: bool = False, dims: bool = True) -> Callable[..., Any]:
    """Make `composite_pixel_vjp` without what is behind a splat, without the background, or with splats that do not dim
    what is behind them."""

    def made(o: Oracle, pixel: Any, rows: Any, px: float, py: float, background: Any, v_color: Any, v_T_final: float,
             totals: Any, *profile: Any) -> None:  # fmt: skip
        behind = v_T_final if tail else 0.0
        behind += float(np.dot(background, v_color)) if background_seen else 0.0
        totals.v_background[:] += pixel.T_final * np.array(v_color)
        for i, alpha, T in zip(
            reversed(pixel.ids), reversed(pixel.alphas), reversed(pixel.transmittances), strict=True
        ):
            color_dot_grad = float(np.dot(rows.colors[i], v_color))
            totals.v_colors[i] += T * alpha * np.array(v_color)
            v_alpha = T * (color_dot_grad - behind)
            behind += alpha * (color_dot_grad - (behind if dims else 0.0)) if tail else 0.0
            sigma = o["sigma_at_pixel"](rows.means2d[i], rows.conics[i], px, py)
            v_sigma, v_opacity = o["alpha_from_sigma_vjp"](sigma, rows.opacities[i], v_alpha, *profile)
            v_mean2d, v_conic = o["sigma_at_pixel_vjp"](rows.means2d[i], rows.conics[i], px, py, v_sigma)
            totals.v_opacities[i] += v_opacity
            totals.v_means2d[i] += v_mean2d
            totals.v_means2d_abs[i] += np.abs(v_mean2d)
            totals.v_conics[i] += v_conic

    return made


def _adam(first: bool = True, second: bool = True, sign: float = -1.0) -> Callable[..., Any]:
    """Make `adam_step` without the division by 1 - beta1^t or by 1 - beta2^t, or uphill."""

    def made(o: Oracle, params: Any, grads: Any, m: Any, v: Any, step: Any, lr: Any,
             betas: Any = BETAS, eps: float = EPS) -> Any:  # fmt: skip
        params, m, v = dict(params), dict(m), dict(v)
        for name, g in grads.items():
            t = step if isinstance(step, int) else step[name]
            m[name] = betas[0] * m[name] + (1.0 - betas[0]) * g
            v[name] = betas[1] * v[name] + (1.0 - betas[1]) * g * g
            mean = m[name] / (1.0 - betas[0] ** t if first else 1.0)
            size = np.sqrt(v[name] / (1.0 - betas[1] ** t if second else 1.0)) + eps
            params[name] = params[name] + sign * lr[name] * mean / size
        return params, m, v

    return made


def _pixel_by_alpha(o: Oracle, ids: Any, rows: Any, px: float, py: float, background: Any, *profile: Any) -> Any:
    """Make `composite_pixel` with alpha for a weight."""
    pixel = o["composite_pixel"](ids, rows, px, py, background, *profile)
    color = [pixel.T_final * b for b in background]
    for i, alpha in zip(pixel.ids, pixel.alphas, strict=True):
        color = [sum_ + alpha * c for sum_, c in zip(color, rows.colors[i], strict=True)]
    return pixel._replace(color=color)


def _split_beside(o: Oracle, rows: Any, mask: Any, normals: Any, *revised: Any) -> Any:
    """Make `split_rows` that keeps the parents."""
    kept = o["split_rows"](rows, mask, normals, *revised)
    n = int(np.sum(~mask))

    def both(old: Any, new: Any) -> Any:
        return {name: np.concatenate([old[name], new[name][n:]]) for name in old}

    return type(kept)(both(rows.params, kept.params), both(rows.m, kept.m), both(rows.v, kept.v))


def _split_otherwise(name: str, change: Callable[[Any], Any], to: str) -> Callable[..., Any]:
    """Make `split_rows` that reads a parameter changed, and takes another parameter of the children from that."""

    def made(o: Oracle, rows: Any, mask: Any, normals: Any, *revised: Any) -> Any:
        changed = type(rows)({**rows.params, name: change(rows.params[name])}, rows.m, rows.v)
        split, other = (o["split_rows"](each, mask, normals, *revised) for each in (rows, changed))
        n = int(np.sum(~mask))
        taken = np.concatenate([split.params[to][:n], other.params[to][n:]])
        return type(split)({**split.params, to: taken}, split.m, split.v)

    return made


def _unturned(o: Oracle, rows: Any, mask: Any, normals: Any, *revised: Any) -> Any:
    """Make `split_rows` that draws children along the world's axes."""
    upright = {**rows.params, "quats": np.tile([1.0, 0.0, 0.0, 0.0], (len(mask), 1))}
    split = o["split_rows"](type(rows)(upright, rows.m, rows.v), mask, normals, *revised)
    quats = o["split_rows"](rows, mask, normals, *revised).params["quats"]
    return type(split)({**split.params, "quats": quats}, split.m, split.v)


def _pixel(o: Oracle, ids: Any, rows: Any, px: float, py: float, background: Any, *profile: Any) -> Any:
    return o["composite_pixel"](ids, rows, px, py, [0.0] * len(background), *profile)


def _clone_with_moments(o: Oracle, rows: Any, mask: Any) -> Any:
    """Make `clone_rows` whose copies have the moments of their sources."""
    both = ({name: np.concatenate([x, x[mask]]) for name, x in each.items()} for each in (rows.m, rows.v))
    return type(rows)(o["clone_rows"](rows, mask).params, *both)


def _over_all(o: Oracle, opacities: Any, mask: Any, v_loss: float, visible: Any = None) -> Any:
    """Make `pop_loss_vjp` whose sides are both divided by the number of all Gaussians."""
    part = np.ones(len(mask), dtype=bool) if visible is None else visible
    return v_loss * np.where(part, np.where(mask, -1.0, 1.0), 0.0) / len(mask)


_HALF: Final = "The exponent of a Gaussian is half of d^T Q d: exp(-x^2 / 2) has a 2 under its square."

MISTAKES: Final = (
    *GEOMETRY,
    Mistake(
        "sigma_at_pixel",
        _sigma(1.0, 1.0),
        f"A half is missing before the two squares. {_HALF}",
        "The cross term has no half, because B stands twice in the symmetric matrix Q and once in the conic.",
    ),
    Mistake(
        "sigma_at_pixel",
        _sigma(1.0, 2.0),
        f"A half is missing: your exponent is twice what it should be. {_HALF}",
        "Halve the whole of A dx dx + 2 B dx dy + C dy dy.",
    ),
    Mistake(
        "sigma_at_pixel",
        _sigma(0.5, 0.5),
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
        "adam_step",
        _adam(first=False, second=False),
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
    _shifted(0.5, 0.5),
    _shifted(-0.5, -0.5),
    _shifted(0.5, 0.0),
    _shifted(0.0, 0.5),
    _shifted(-0.5, 0.0),
    _shifted(0.0, -0.5),
    Mistake(
        "sigma_at_pixel",
        _sigma(0.5, 0.0),
        "The cross term is missing: a splat that is turned has B, too.",
        "sigma = (A dx dx + C dy dy) / 2 + B dx dy.",
    ),
    Mistake(
        "sigma_at_pixel",
        lambda o, mean2d, conic, px, py: o["sigma_at_pixel"](mean2d, conic, py, px),
        "The pixel's x and y are exchanged: rows stand for columns.",
        "px runs along the columns of an image, py along its rows: dx = mean2d[0] - px, dy = mean2d[1] - py.",
    ),
    Mistake(
        "alpha_from_sigma",
        lambda o, sigma, opacity, *profile: o["alpha_from_sigma"](sigma, 1.0, *profile),
        "The opacity is missing: alpha is the opacity times the falloff.",
        "alpha = min(ceiling, opacity * falloff(sigma)).",
    ),
    Mistake(
        "composite_pixel",
        _pixel_by_alpha,
        "Your weight is alpha alone: a splat gives its colour times alpha, times the light that is left, T.",
        "weight = T * alpha, with T before this splat.",
    ),
    Mistake(
        "composite_pixel",
        lambda o, ids, *given: o["composite_pixel"](list(reversed(ids)), *given),
        "You walk from back to front; the list is in order, front first.",
        "Go through ids as they come: T starts at 1 at the eye.",
    ),
    Mistake(
        "adam_step",
        _adam(sign=1.0),
        "You go up the loss: the gradient points to where the loss rises, so a step is taken against it.",
        "x - lr m / sqrt(v), with a minus.",
    ),
    Mistake(
        "adam_step",
        _adam(first=False),
        "The running mean m is not divided by 1 - beta1^t: it starts at 0, so that the first steps are too short.",
        "Divide for the quotient only; what is kept and returned is m itself.",
    ),
    Mistake(
        "adam_step",
        _adam(second=False),
        "The running mean v is not divided by 1 - beta2^t: it starts at 0, so that the first steps are too long.",
        "Divide for the quotient only; what is kept and returned is v itself.",
    ),
    Mistake(
        "split_rows",
        _split_beside,
        "The parents stay; a split puts two children in the place of one parent.",
        "Keep the rows that were not selected, rows[~mask], and append both kinds of children.",
    ),
    Mistake(
        "split_rows",
        _unturned,
        "The draws are not turned: the children must lie along the parent's own axes.",
        "mean + R(q) (s * eps): scale each draw first, then turn it.",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(tail=True, background_seen=True, dims=False),
        "A splat hides what is behind it: the light behind must lose the share alpha before the splat's own is added.",
        "behind += alpha (color_dot_grad - behind), the same as alpha color_dot_grad + (1 - alpha) behind.",
    ),
    Mistake(
        "pop_loss_vjp",
        _over_all,
        "Both sides are divided by the number of all Gaussians: the important have a mean of their own, and so have the"
        " others.",
        "Divide the first sum by N_imp and the second by N - N_imp.",
    ),
    Mistake(
        "clone_rows",
        _clone_with_moments,
        "The copies have Adam's moments of their sources: newcomers start with moments of 0.",
        "Append copies to the parameters, and zeros to m and v.",
    ),
    Mistake(
        "split_rows",
        _split_otherwise("scales", lambda x: x + np.log(1.6) - 1.6, "scales"),
        "You subtract 1.6 from the logarithms of the widths: to divide a width by 1.6, subtract log 1.6.",
        "params['scales'] holds logarithms.",
    ),
    Mistake(
        "split_rows",
        _split_otherwise("scales", np.zeros_like, "means"),
        "The draws are not scaled: a child lies as far from its parent's centre as the parent is wide.",
        "mean + R(q) (s * eps): scale each draw first, then turn it.",
    ),
    Mistake(
        "grow_masks",
        lambda o, window, scales, *given: o["grow_masks"](
            window, np.repeat(scales.mean(axis=1, keepdims=True), 3, axis=1), *given
        ),
        "You compare the mean of the three widths: a Gaussian is small if its largest one is.",
        "scales.max(axis=1).",
    ),
    Mistake(
        "params_vjp",
        lambda o, params, gradients, v_opacities: o["params_vjp"](params, gradients, np.zeros_like(v_opacities)),
        "The prior's pull is missing: v_opacities is added to the gradient of the render's opacities.",
        "gradients.opacities + v_opacities, then back through the sigmoid.",
    ),
)


def explained_by(calls: Sequence[Call], oracle: Oracle) -> Mistake | None:
    """Find the mistake that gives what a function gave, on every call, also on those that came out right.

    Args:
        calls: of one function.
        oracle: the oracle's functions by name.
    """
    for mistake in MISTAKES:
        if calls and mistake.function == calls[0].function and all(_explains(mistake, c, oracle) for c in calls):
            return mistake
    return None


def _explains(mistake: Mistake, call: Call, oracle: Oracle) -> bool:
    given = copy.deepcopy(call.given)
    try:
        made = mistake.made(oracle, *given, *call.named.values())
    except Exception:
        # a mistake that does not fit these arguments explains nothing
        return False
    changed = tuple(a for b, a in zip(call.given, given, strict=True) if repr(b) != repr(a))
    return same((made, changed), call.found)
