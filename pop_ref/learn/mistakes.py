"""Mistakes that everyone makes once: what they compute, and the sentence that helps.

A mistake is recognised by its numbers: it explains a wrong function if it gives what the function gave on every input
that was tried. The first that does is told.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from pop_ref.learn.mistakes_backward import BACKWARD
from pop_ref.learn.mistakes_geometry import GEOMETRY, Mistake, Oracle
from pop_ref.learn.mistakes_training import TRAINING
from pop_ref.learn.student import Call, same


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


def _pixel_vjp(
    tail: bool = True, background_seen: bool = True, dims: bool = True, forwards: bool = False, early: bool = False,
    lit: bool = True, share: bool = True, color_lit: bool = True, absolute: bool = True,
) -> Callable[..., Any]:  # fmt: skip
    """Make `composite_pixel_vjp` without what is behind a splat, without the background, with splats that do not dim
    what is behind them, from front to back, with what is behind a splat updated before it is read, without the light
    that reaches a splat, with splats behind that count whole and not by their alpha, without that light in the colours'
    cotangent, or with signs in the sum of absolute values."""

    def made(o: Oracle, pixel: Any, rows: Any, px: float, py: float, background: Any, v_color: Any, v_T_final: float,
             totals: Any, *profile: Any) -> None:  # fmt: skip
        behind = v_T_final if tail else 0.0
        behind += float(np.dot(background, v_color)) if background_seen else 0.0
        totals.v_background[:] += pixel.T_final * np.array(v_color)
        blended = list(zip(pixel.ids, pixel.alphas, pixel.transmittances, strict=True))
        for i, alpha, T in blended if forwards else reversed(blended):
            color_dot_grad = float(np.dot(rows.colors[i], v_color))
            totals.v_colors[i] += (T if color_lit else 1.0) * alpha * np.array(v_color)
            before = behind
            own = color_dot_grad * (alpha if share else 1.0)
            behind += own - (alpha * behind if dims else 0.0) if tail else 0.0
            v_alpha = (T if lit else 1.0) * (color_dot_grad - (behind if early else before))
            sigma = o["sigma_at_pixel"](rows.means2d[i], rows.conics[i], px, py)
            v_sigma, v_opacity = o["alpha_from_sigma_vjp"](sigma, rows.opacities[i], v_alpha, *profile)
            v_mean2d, v_conic = o["sigma_at_pixel_vjp"](rows.means2d[i], rows.conics[i], px, py, v_sigma)
            totals.v_opacities[i] += v_opacity
            totals.v_means2d[i] += v_mean2d
            totals.v_means2d_abs[i] += np.abs(v_mean2d) if absolute else v_mean2d
            totals.v_conics[i] += v_conic

    return made


def _pixel_by_alpha(o: Oracle, ids: Any, rows: Any, px: float, py: float, background: Any, *profile: Any) -> Any:
    """Make `composite_pixel` with alpha for a weight."""
    pixel = o["composite_pixel"](ids, rows, px, py, background, *profile)
    color = [pixel.T_final * b for b in background]
    for i, alpha in zip(pixel.ids, pixel.alphas, strict=True):
        color = [sum_ + alpha * c for sum_, c in zip(color, rows.colors[i], strict=True)]
    return pixel._replace(color=color)


def _pixel_painted(o: Oracle, ids: Any, rows: Any, px: float, py: float, background: Any, *profile: Any) -> Any:
    """Make `composite_pixel` with the painter's rule from the front."""
    pixel, color = o["composite_pixel"](ids, rows, px, py, background, *profile), np.zeros(len(background))
    for i, alpha in zip(pixel.ids, pixel.alphas, strict=True):
        color = (1.0 - alpha) * color + alpha * np.array(rows.colors[i])
    return pixel._replace(color=(color + pixel.T_final * np.array(background)).tolist())


def _pixel_forward(dims: str = "1 - alpha", last: bool = False, after: bool = False) -> Callable[..., Any]:
    """Make `composite_pixel` that dims otherwise, blends the splat at which it stops, or keeps T behind each splat."""

    def made(o: Oracle, ids: Any, rows: Any, px: float, py: float, background: Any, *profile: Any) -> Any:
        color, T, kept, n = np.zeros(len(background)), 1.0, list[tuple[int, float, float]](), 0
        for i in ids:
            n += 1
            sigma = o["sigma_at_pixel"](rows.means2d[i], rows.conics[i], px, py)
            alpha, skipped = o["alpha_from_sigma"](sigma, rows.opacities[i], *profile)
            if skipped:
                continue
            next_T = {"alpha": T * alpha, "T - alpha": T - alpha}.get(dims, T * (1.0 - alpha))
            ends = o["stops"](T * (1.0 - alpha) if dims == "T - alpha" else next_T, *profile)
            if ends and not last:
                break
            color += T * alpha * np.array(rows.colors[i])
            kept.append((i, alpha, next_T if after else T))
            T = next_T
            if ends:
                break
        color += T * np.array(background)
        blended, alphas, transmittances = (list(each) for each in zip(*kept, strict=True)) if kept else ([], [], [])
        return (color.tolist(), T, blended, alphas, transmittances, n)

    return made


def _pixel(o: Oracle, ids: Any, rows: Any, px: float, py: float, background: Any, *profile: Any) -> Any:
    return o["composite_pixel"](ids, rows, px, py, [0.0] * len(background), *profile)


_HALF: Final = "The exponent of a Gaussian is half of d^T Q d: exp(-x^2 / 2) has a 2 under its square."


def _dominant(better: Callable[[float, float], bool], by_place: bool = False) -> Callable[..., Any]:
    """Make `dominant_id` by another comparison, or with the winner's place in the list for its id."""

    def made(o: Oracle, ids: Any, weights: Any) -> int:
        best, best_weight = -1, 0.0
        for place, (i, weight) in enumerate(zip(ids, weights, strict=True)):
            if better(weight, best_weight):
                best, best_weight = place if by_place else i, weight
        return best

    return made


MISTAKES: Final = (
    *GEOMETRY,
    *BACKWARD,
    *TRAINING,
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
        _pixel_vjp(tail=False, background_seen=False),
        "The tail is missing from dC/dalpha: more alpha shows more of a splat's own colour, and hides the colour of all"
        " that is behind it. Yours has the first part only.",
        "C = T (alpha c + (1 - alpha) behind), so dC/dalpha = T (c - behind). Walk from the back: start with behind ="
        " background . v_color + v_T_final, and after each splat behind += alpha (color_dot_grad - behind).",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(background_seen=False),
        "The background is missing from the light behind the last splat.",
        "Before the walk from back to front, behind is background . v_color + v_T_final.",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(forwards=True),
        "You walk from front to back; the way back begins with the last splat, since what is behind a splat must be"
        " known before the splat is reached.",
        "Go through reversed(pixel.ids), with alphas and transmittances reversed alike.",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(early=True),
        "You add a splat to what is behind it before its own cotangent is taken.",
        "First v_alpha = T (color_dot_grad - behind), then behind += alpha (color_dot_grad - behind).",
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
        "composite_pixel",
        _pixel_forward(dims="alpha"),
        "You keep the share alpha of the light; a splat takes that share away, and 1 - alpha is left.",
        "T starts at 1, and behind a splat it is T (1 - alpha).",
    ),
    Mistake(
        "composite_pixel",
        _pixel_forward(dims="T - alpha"),
        "You take alpha from the light that is left; a splat takes the share alpha of what reaches it.",
        "Behind a splat T is T (1 - alpha), which is T - T alpha.",
    ),
    Mistake(
        "composite_pixel",
        _pixel_forward(last=True),
        "You blend the splat at which the pixel stops; the pixel ends before it.",
        "Ask stops(T (1 - alpha)) before the splat's colour is added.",
    ),
    Mistake(
        "composite_pixel",
        _pixel_forward(after=True),
        "You keep the light that is left behind each splat; the light before it is asked for.",
        "Append T to the transmittances before T becomes T (1 - alpha).",
    ),
    Mistake(
        "sigma_at_pixel",
        lambda o, mean2d, conic, px, py: o["sigma_at_pixel"](mean2d, (conic[0], conic[2], conic[1]), px, py),
        "The conic is read in another order: it is (A, B, C), the cross term in the middle.",
        "A, B, C = conic; sigma = (A dx dx + C dy dy) / 2 + B dx dy.",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(dims=False),
        "A splat hides what is behind it: the light behind must lose the share alpha before the splat's own is added.",
        "behind += alpha (color_dot_grad - behind), the same as alpha color_dot_grad + (1 - alpha) behind.",
    ),
    Mistake(
        "composite_pixel",
        _pixel_painted,
        "You paint each splat over those before it, as from back to front; the list is in order, front first.",
        "color += T alpha c, with T the light that the splats before it have left.",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(share=False),
        "A splat counts whole in what is behind the next one; it counts by the share alpha that it covers.",
        "behind = alpha color_dot_grad + (1 - alpha) behind.",
    ),
    Mistake(
        "falloff",
        lambda o, sigma: 1.0 - sigma,
        "You take the first two terms of the exponential for the whole of it.",
        "exp(-sigma), which never falls below 0.",
    ),
    Mistake(
        "dominant_id",
        _dominant(lambda weight, best: weight < best),
        "The comparison is the wrong way round: the largest weight wins.",
        "A later splat wins where weight > best_weight.",
    ),
    Mistake(
        "dominant_id",
        _dominant(lambda weight, best: weight > best, by_place=True),
        "You return the winner's place in the list; its id is asked for.",
        "ids[place] is the id.",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(color_lit=False),
        "The light that reaches the splat is missing from the cotangent of its colour.",
        "v_colors += T alpha v_color, as C has T alpha c.",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(absolute=False),
        "The absolute value is missing in v_means2d_abs: pixels on two sides of a splat cancel.",
        "Add |v_mean2d| of every pixel, entry by entry.",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(lit=False),
        "The light that reaches the splat is missing from v_alpha: what hardly any light reaches changes the pixel"
        " hardly.",
        "v_alpha = T (color_dot_grad - behind), with T of pixel.transmittances.",
    ),
)


def explained_by(calls: Sequence[Call], oracle: Oracle) -> Mistake | None:
    """Find the mistake that gives what a function gave, on every call, also on those that came out right.

    Args:
        calls: of one function.
        oracle: the oracle's functions by name.
    """
    # where a ValueError is asked for, a mistake computes nothing
    calls = [call for call in calls if not call.raises]
    for mistake in MISTAKES:
        if calls and mistake.function == calls[0].function and all(_explains(mistake, c, oracle) for c in calls):
            return mistake
    return None


def _explains(mistake: Mistake, call: Call, oracle: Oracle) -> bool:
    given = copy.deepcopy(call.given)
    try:
        with np.errstate(all="ignore"):
            made = mistake.made(oracle, *given, *call.named.values())
    except Exception:
        # a mistake that does not fit these arguments explains nothing
        return False
    changed = tuple(a for b, a in zip(call.given, given, strict=True) if repr(b) != repr(a))
    return same((made, changed), call.found)
