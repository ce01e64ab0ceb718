"""Mistakes that everyone makes once: what they compute, and the sentence that helps; here those of splats and pixels.

A mistake is recognised by its numbers: it explains a wrong function if it gives what the function gave on every input
that was tried. The first that does is told. `mistakes_geometry` has those of what comes before, `mistakes_training` of
what comes after.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pop_ref.learn.mistakes_geometry import GEOMETRY, Known
from pop_ref.learn.mistakes_training import TRAINING
from pop_ref.learn.probes import Oracle
from pop_ref.learn.student import Call, same


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


def _lists(order: Callable[..., Any], by_column: bool = False) -> Callable[..., Any]:
    """Make `tile_lists` in another order of splats, or with the tiles of a column one after the other."""

    def made(
        o: Oracle, means2d: Any, radii: Any, depths: Any, width: int, height: int, size: int, *profile: Any
    ) -> Any:
        n_x, n_y = o["grid_size"](width, height, size)
        lists: list[list[int]] = [[] for _ in range(n_x * n_y)]
        rects = o["tile_rects"](means2d, radii, width, height, size, *profile).tolist()
        for i in sorted(range(len(depths)), key=lambda i: order(float(depths[i]), i)):
            for y in range(rects[i][1], rects[i][3]):
                for x in range(rects[i][0], rects[i][2]):
                    lists[x * n_y + y if by_column else y * n_x + x].append(i)
        return lists

    return made


def _reach(squared: bool, k: float = 0.0) -> Callable[..., Any]:
    """Make `radii_from_covars2d` without the 2 under its root, or with one reach for every opacity."""

    def made(o: Oracle, covars2d: Any, opacities: Any, *profile: Any) -> Any:
        taken = o["radii_from_covars2d"](covars2d, opacities, *profile) > 0
        with np.errstate(all="ignore"):
            reach = np.sqrt((2.0 if squared else 1.0) * np.log(255.0 * np.maximum(opacities, 1e-9)))
            reach = np.minimum(np.nan_to_num(reach), 3.33) if k == 0.0 else np.full(len(opacities), k)
            sides = reach[:, None] * np.sqrt(np.einsum("nii->ni", covars2d))
        return np.where(taken, np.ceil(sides), 0).astype(np.int64)

    return made


def _on_one_side(o: Oracle, covars2d: Any, v: Any) -> Any:
    """Make `conics_from_covars2d_vjp` with both Q on one side of V."""
    A, B, C = o["conics_from_covars2d"](covars2d).T
    Q = np.moveaxis(np.array([[A, B], [B, C]]), 2, 0)
    V = np.moveaxis(np.array([[v[:, 0], v[:, 1] / 2.0], [v[:, 1] / 2.0, v[:, 2]]]), 2, 0)
    return -V @ Q @ Q


def _opacity_left_in(o: Oracle, sigma: float, opacity: float, v_alpha: float, *profile: Any) -> Any:
    v_sigma, v_opacity = o["alpha_from_sigma_vjp"](sigma, opacity, v_alpha, *profile)
    return v_sigma, opacity * v_opacity


def _opacity_left_out(o: Oracle, sigma: float, opacity: float, v_alpha: float, *profile: Any) -> Any:
    v_sigma, v_opacity = o["alpha_from_sigma_vjp"](sigma, opacity, v_alpha, *profile)
    return v_sigma / opacity, v_opacity


def _conics(by: Callable[..., Any], sign: float = -1.0) -> Callable[..., Any]:
    """Make `conics_from_covars2d` that multiplies by something else than one over the determinant, or whose determinant
    has another sign in it."""

    def made(o: Oracle, covars2d: Any) -> Any:
        a, b, c = covars2d[:, 0, 0], covars2d[:, 0, 1], covars2d[:, 1, 1]
        det = a * c + sign * b * b
        return np.where(det > 0.0, np.stack([c, -b, a]) * by(det), 0.0).T

    return made


def _sigma(squares: float = 0.5, cross: float = 1.0, right: float = 0.0, down: float = 0.0) -> Callable[..., Any]:
    """Make `sigma_at_pixel` with other factors, or with the pixel's centre elsewhere."""

    def made(o: Oracle, mean2d: Any, conic: Any, px: float, py: float) -> float:
        (A, B, C), dx, dy = conic, mean2d[0] - px - right, mean2d[1] - py - down
        return squares * (A * dx * dx + C * dy * dy) + cross * B * dx * dy

    return made


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


_PIXELS: Final[dict[str, Known]] = {
    "low_pass": {
        "The blur is added to all four entries; a round blur has no entries off the diagonal.": (
            "covars2d + eps2d * np.eye(2).",
            lambda o, covars2d, eps2d: covars2d + eps2d,
        ),
        "eps2d is taken away from the diagonal; it is added, as blur makes a splat wider.": (
            "covars2d + eps2d times the unit matrix.",
            lambda o, covars2d, eps2d, *given: covars2d - eps2d * np.eye(2),
        ),
    },
    "conics_from_covars2d": {
        "You return the covariance; a conic is its inverse.": (
            "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
            lambda o, covars2d: np.where(
                np.linalg.det(covars2d)[:, None] > 0.0, covars2d.reshape(-1, 4)[:, [0, 1, 3]], 0.0
            ),
        ),
        "The off-diagonal of the inverse has the wrong sign.": (
            "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
            lambda o, covars2d: o["conics_from_covars2d"](covars2d) * np.array([1.0, -1.0, 1.0]),
        ),
        "The determinant has the wrong sign in it: it is a c - b b.": (
            "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
            _conics(lambda det: 1.0 / det, sign=1.0),
        ),
        "You do not divide by the determinant, as an inverse does.": (
            "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
            *(_conics(by) for by in (lambda det: det, lambda det: 1.0)),
        ),
    },
    "conics_from_covars2d_vjp": {
        "The off-diagonal counts twice: it stands once in the conic and twice in the matrix.": (
            "Give each of the matrix's two entries half of v_xy.",
            lambda o, covars2d, v: o["conics_from_covars2d_vjp"](covars2d, v * np.array([1.0, 2.0, 1.0])),
        ),
        "The products stand in another order: Q stands on either side of V.": (
            "The inverse's small change is -Q dX Q, so the cotangent is -Q V Q.",
            _on_one_side,
        ),
    },
    "radii_from_covars2d": {
        "A 2 is missing under the root: alpha is o exp(-d^2 / 2), so that it falls to 1/255 at d^2 = 2 ln(255 o).": (
            "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations.",
            _reach(squared=False),
        ),
        "Your reach is three standard deviations whatever the opacity; it ends where alpha falls to 1/255.": (
            "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations: a faint splat ends sooner.",
            _reach(squared=True, k=3.0),
        ),
        "Your reach is 3.33 standard deviations whatever the opacity; that is its upper bound only.": (
            "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations: a faint splat ends sooner.",
            _reach(squared=True, k=3.33),
        ),
        "You take variances for standard deviations: the covariance's diagonal holds squares.": (
            "The reach is k times the root of the diagonal's entry.",
            lambda o, covars2d, *given: (
                o["radii_from_covars2d"](covars2d * covars2d * np.eye(2), *given)
                * (o["radii_from_covars2d"](covars2d, *given) > 0)
            ),
        ),
        "Your reach is that of opacity 1 for every splat; a faint one ends sooner.": (
            "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations, with o the splat's own.",
            lambda o, covars2d, opacities, *given: (
                o["radii_from_covars2d"](covars2d, np.ones_like(opacities), *given)
                * (o["radii_from_covars2d"](covars2d, opacities, *given) > 0)
            ),
        ),
    },
    "on_screen": {
        "Width and height are exchanged: x is compared with the width, y with the height.": (
            "The columns of means2d are x and y.",
            lambda o, means2d, radii, width, height, *profile: o["on_screen"](means2d, radii, height, width, *profile),
        ),
    },
    "tile_rects": {
        "x and y are exchanged: columns stand for rows. A rectangle is (x0, y0, x1, y1).": (
            "tiles_x, tiles_y = grid_size(width, height, tile_size), x first.",
            lambda o, *given: o["tile_rects"](*given)[:, [1, 0, 3, 2]],
        ),
        "Your rectangle has one axis after the other, (x0, x1, y0, y1); it is (x0, y0, x1, y1).": (
            "First the corner with the smaller numbers, then the other.",
            lambda o, *given: o["tile_rects"](*given)[:, [0, 2, 1, 3]],
        ),
        "Your last two numbers are the number of tiles; what is asked for is one past the last tile.": (
            "(x0, y0, x1, y1), half open: x1 - x0 tiles lie between.",
            lambda o, *given: o["tile_rects"](*given) - np.pad(o["tile_rects"](*given)[:, :2], ((0, 0), (2, 0))),
        ),
    },
    "tile_lists": {
        "Your tiles are numbered down the columns: columns stand for rows. Tile (x, y) is number y * tiles_x + x.": (
            "Row-major order: all tiles of the first row, then the second.",
            _lists(lambda depth, i: (depth, i), by_column=True),
        ),
        "Your lists run from back to front; the nearest splat comes first.": (
            "Sort by (depth, index), the smaller depth first.",
            _lists(lambda depth, i: (-depth, i)),
            _lists(lambda depth, i: (-depth, -i)),
        ),
        "Your lists are not sorted by depth.": (
            "Go through the splats in the order of (depth, index).",
            _lists(lambda depth, i: i),
        ),
    },
    "sigma_at_pixel": {
        f"A half is missing before the two squares. {_HALF}": (
            "The cross term has no half, because B stands twice in the symmetric matrix Q and once in the conic.",
            _sigma(1.0, 1.0),
        ),
        f"A half is missing: your exponent is twice what it should be. {_HALF}": (
            "Halve the whole of A dx dx + 2 B dx dy + C dy dy.",
            _sigma(1.0, 2.0),
        ),
        "The cross term is halved once too often: B stands twice in the symmetric matrix Q, once in the conic.": (
            "Write Q = [[A, B], [B, C]] and multiply d^T Q d out before you halve it.",
            _sigma(0.5, 0.5),
        ),
        "Your pixel is half a pixel off: px and py are the pixel's centre already, its index + 0.5.": (
            "Use d = mean2d - (px, py) as they are given; add or take away no half.",
            *(
                _sigma(right=right, down=down)
                for right, down in ((0.5, 0.5), (-0.5, -0.5), (0.5, 0.0), (0.0, 0.5), (-0.5, 0.0), (0.0, -0.5))
            ),
        ),
        "The cross term is missing: a splat that is turned has B, too.": (
            "sigma = (A dx dx + C dy dy) / 2 + B dx dy.",
            _sigma(0.5, 0.0),
        ),
        "The pixel's x and y are exchanged: rows stand for columns.": (
            "px runs along the columns of an image, py along its rows: dx = mean2d[0] - px, dy = mean2d[1] - py.",
            lambda o, mean2d, conic, px, py: o["sigma_at_pixel"](mean2d, conic, py, px),
        ),
        "The conic is read in another order: it is (A, B, C), the cross term in the middle.": (
            "A, B, C = conic; sigma = (A dx dx + C dy dy) / 2 + B dx dy.",
            lambda o, mean2d, conic, px, py: o["sigma_at_pixel"](mean2d, (conic[0], conic[2], conic[1]), px, py),
        ),
    },
    "falloff": {
        "Your falloff grows with the distance: the exponent's sign is missing.": (
            "It is 1 at the centre and less everywhere else.",
            lambda o, sigma: float(np.exp(sigma)),
        ),
        "You take the first two terms of the exponential for the whole of it.": (
            "exp(-sigma), which never falls below 0.",
            lambda o, sigma: 1.0 - sigma,
        ),
    },
    "alpha_from_sigma": {
        "Your alpha has neither ceiling nor floor.": (
            "Take min(profile.alpha_ceiling, ...), and skip the splat where sigma < 0 or alpha < profile.alpha_floor.",
            lambda o, sigma, opacity, *profile: (opacity * o["falloff"](sigma), False),
        ),
        "The opacity is missing: alpha is the opacity times the falloff.": (
            "alpha = min(ceiling, opacity * falloff(sigma)).",
            lambda o, sigma, opacity, *profile: o["alpha_from_sigma"](sigma, 1.0, *profile),
        ),
    },
    "alpha_from_sigma_vjp": {
        "The opacity is left in its own derivative: of o exp(-sigma) by o it is exp(-sigma).": (
            "v_o = exp(-sigma) v_alpha; only v_sigma has the opacity in it.",
            _opacity_left_in,
        ),
        "The opacity is missing from the cotangent of sigma.": (
            "alpha = o exp(-sigma), so v_sigma = -alpha v_alpha.",
            _opacity_left_out,
        ),
    },
    "composite_pixel": {
        "The background is missing: what light is left behind the last splat shows it.": (
            "Add T_final times the background to the colour.",
            lambda o, ids, rows, px, py, background, *profile: o["composite_pixel"](
                ids, rows, px, py, [0.0] * len(background), *profile
            ),
        ),
        "Your weight is alpha alone: a splat gives its colour times alpha, times the light that is left, T.": (
            "weight = T * alpha, with T before this splat.",
            _pixel_by_alpha,
        ),
        "You walk from back to front; the list is in order, front first.": (
            "Go through ids as they come: T starts at 1 at the eye.",
            lambda o, ids, *given: o["composite_pixel"](list(reversed(ids)), *given),
        ),
        "You keep the share alpha of the light; a splat takes that share away, and 1 - alpha is left.": (
            "T starts at 1, and behind a splat it is T (1 - alpha).",
            _pixel_forward(dims="alpha"),
        ),
        "You take alpha from the light that is left; a splat takes the share alpha of what reaches it.": (
            "Behind a splat T is T (1 - alpha), which is T - T alpha.",
            _pixel_forward(dims="T - alpha"),
        ),
        "You blend the splat at which the pixel stops; the pixel ends before it.": (
            "Ask stops(T (1 - alpha)) before the splat's colour is added.",
            _pixel_forward(last=True),
        ),
        "You keep the light that is left behind each splat; the light before it is asked for.": (
            "Append T to the transmittances before T becomes T (1 - alpha).",
            _pixel_forward(after=True),
        ),
        "You paint each splat over those before it, as from back to front; the list is in order, front first.": (
            "color += T alpha c, with T the light that the splats before it have left.",
            _pixel_painted,
        ),
    },
    "composite_pixel_vjp": {
        "The tail is missing from dC/dalpha: more alpha shows more of a splat's own colour, and hides the colour of"
        " all that is behind it. Yours has the first part only.": (
            "C = T (alpha c + (1 - alpha) behind), so dC/dalpha = T (c - behind). Walk from the back: start with behind"
            " = background . v_color + v_T_final, and after each splat behind += alpha (color_dot_grad - behind).",
            _pixel_vjp(tail=False, background_seen=False),
        ),
        "The background is missing from the light behind the last splat.": (
            "Before the walk from back to front, behind is background . v_color + v_T_final.",
            _pixel_vjp(background_seen=False),
        ),
        "You walk from front to back; the way back begins with the last splat, since what is behind a splat must be"
        " known before the splat is reached.": (
            "Go through reversed(pixel.ids), with alphas and transmittances reversed alike.",
            _pixel_vjp(forwards=True),
        ),
        "You add a splat to what is behind it before its own cotangent is taken.": (
            "First v_alpha = T (color_dot_grad - behind), then behind += alpha (color_dot_grad - behind).",
            _pixel_vjp(early=True),
        ),
        "A splat hides what is behind it: the light behind must lose the share alpha before the splat's own is"
        " added.": (
            "behind += alpha (color_dot_grad - behind), the same as alpha color_dot_grad + (1 - alpha) behind.",
            _pixel_vjp(dims=False),
        ),
        "A splat counts whole in what is behind the next one; it counts by the share alpha that it covers.": (
            "behind = alpha color_dot_grad + (1 - alpha) behind.",
            _pixel_vjp(share=False),
        ),
        "The light that reaches the splat is missing from the cotangent of its colour.": (
            "v_colors += T alpha v_color, as C has T alpha c.",
            _pixel_vjp(color_lit=False),
        ),
        "The absolute value is missing in v_means2d_abs: pixels on two sides of a splat cancel.": (
            "Add |v_mean2d| of every pixel, entry by entry.",
            _pixel_vjp(absolute=False),
        ),
        "The light that reaches the splat is missing from v_alpha: what hardly any light reaches changes the pixel"
        " hardly.": (
            "v_alpha = T (color_dot_grad - behind), with T of pixel.transmittances.",
            _pixel_vjp(lit=False),
        ),
    },
    "dominant_id": {
        "The comparison is the wrong way round: the largest weight wins.": (
            "A later splat wins where weight > best_weight.",
            _dominant(lambda weight, best: weight < best),
        ),
        "You return the winner's place in the list; its id is asked for.": (
            "ids[place] is the id.",
            _dominant(lambda weight, best: weight > best, by_place=True),
        ),
    },
    "dominant_counts": {
        "Each Gaussian is counted once, however many pixels it dominates.": (
            "Add 1 to a Gaussian's count at every pixel that is its own.",
            lambda o, ids, n: np.minimum(o["dominant_counts"](ids, n), 1),
        ),
    },
}

MISTAKES: Final = tuple(
    Mistake(function, made, sentence, hint)
    for function, known in (GEOMETRY | _PIXELS | TRAINING).items()
    for sentence, (hint, *all_made) in known.items()
    for made in all_made
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
