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

from pop_ref.conformance.changes import otherwise
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


def _reach(deviations: str) -> str:
    return f"«_reach(covars2d[i], opacity, profile)→{deviations} * np.sqrt(np.diag(covars2d[i]))»"


# a sum where the determinant has a difference
_SUM: Final = "covars2d[i, 0, 0] * covars2d[i, 1, 1] + covars2d[i, 0, 1] ** 2"
_HALF: Final = "The exponent of a Gaussian is half of d^T Q d: exp(-x^2 / 2) has a 2 under its square."


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
            "«_inverse(covars2d[i])→covars2d[i]»",
        ),
        "The off-diagonal of the inverse has the wrong sign.": (
            "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
            "inverse[0, 0], «→-»inverse[0, 1]",
        ),
        "The determinant has the wrong sign in it: it is a c - b b.": (
            "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
            f"if «_det(covars2d[i])→{_SUM}» > 0.0:\n"
            f"            inverse = _inverse(covars2d[i])«→ * _det(covars2d[i]) / ({_SUM})»",
        ),
        "You do not divide by the determinant, as an inverse does.": (
            "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
            "_inverse(covars2d[i])«→ * _det(covars2d[i]) ** 2»",
            "_inverse(covars2d[i])«→ * _det(covars2d[i])»",
        ),
    },
    "conics_from_covars2d_vjp": {
        "The off-diagonal counts twice: it stands once in the conic and twice in the matrix.": (
            "Give each of the matrix's two entries half of v_xy.",
            "[v_xx, v_xy« / 2.0→»], [v_xy« / 2.0→», v_yy]",
        ),
        "The products stand in another order: Q stands on either side of V.": (
            "The inverse's small change is -Q dX Q, so the cotangent is -Q V Q.",
            "-«Q @ V→V @ Q» @ Q",
        ),
    },
    "radii_from_covars2d": {
        "A 2 is missing under the root: alpha is o exp(-d^2 / 2), so that it falls to 1/255 at d^2 = 2 ln(255 o).": (
            "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations.",
            _reach("min(3.33, math.sqrt(math.log(255.0 * opacity)))"),
        ),
        "Your reach is three standard deviations whatever the opacity; it ends where alpha falls to 1/255.": (
            "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations: a faint splat ends sooner.",
            _reach("3.0"),
        ),
        "Your reach is 3.33 standard deviations whatever the opacity; that is its upper bound only.": (
            "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations: a faint splat ends sooner.",
            _reach("3.33"),
        ),
        "You take variances for standard deviations: the covariance's diagonal holds squares.": (
            "The reach is k times the root of the diagonal's entry.",
            "_reach(covars2d[i]«→ ** 2», opacity",
        ),
        "Your reach is that of opacity 1 for every splat; a faint one ends sooner.": (
            "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations, with o the splat's own.",
            "_reach(covars2d[i], «opacity→1.0», profile)",
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
            "lists[«y * tiles_x + x→x * tiles_y + y»]",
        ),
        "Your lists run from back to front; the nearest splat comes first.": (
            "Sort by (depth, index), the smaller depth first.",
            "(«→-»depth_of[i], i)",
            "(«→-»depth_of[i], «→-»i)",
        ),
        "Your lists are not sorted by depth.": (
            "Go through the splats in the order of (depth, index).",
            "lambda i: «(depth_of[i], i)→i»",
        ),
    },
    "sigma_at_pixel": {
        f"A half is missing before the two squares. {_HALF}": (
            "The cross term has no half, because B stands twice in the symmetric matrix Q and once in the conic.",
            "return «0.5 * →»(A * dx * dx + C * dy * dy)",
        ),
        f"A half is missing: your exponent is twice what it should be. {_HALF}": (
            "Halve the whole of A dx dx + 2 B dx dy + C dy dy.",
            "return «0.5 * →»(A * dx * dx + C * dy * dy) + «→2.0 * »B",
        ),
        "The cross term is halved once too often: B stands twice in the symmetric matrix Q, once in the conic.": (
            "Write Q = [[A, B], [B, C]] and multiply d^T Q d out before you halve it.",
            "dy * dy) + «→0.5 * »B * dx * dy",
        ),
        "Your pixel is half a pixel off: px and py are the pixel's centre already, its index + 0.5.": (
            "Use d = mean2d - (px, py) as they are given; add or take away no half.",
            *(
                f"mean2d[0] - px«→ - {right}»\n    dy = mean2d[1] - py«→ - {down}»"
                for right, down in ((0.5, 0.5), (-0.5, -0.5), (0.5, 0.0), (0.0, 0.5), (-0.5, 0.0), (0.0, -0.5))
            ),
        ),
        "The cross term is missing: a splat that is turned has B, too.": (
            "sigma = (A dx dx + C dy dy) / 2 + B dx dy.",
            "C * dy * dy)« + B * dx * dy→»",
        ),
        "The pixel's x and y are exchanged: rows stand for columns.": (
            "px runs along the columns of an image, py along its rows: dx = mean2d[0] - px, dy = mean2d[1] - py.",
            "mean2d[0] - «px→py»\n    dy = mean2d[1] - «py→px»",
        ),
        "The conic is read in another order: it is (A, B, C), the cross term in the middle.": (
            "A, B, C = conic; sigma = (A dx dx + C dy dy) / 2 + B dx dy.",
            "A, «B, C→C, B» = conic",
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
            "v_alpha), «→opacity * »falloff(sigma)",
        ),
        "The opacity is missing from the cotangent of sigma.": (
            "alpha = o exp(-sigma), so v_sigma = -alpha v_alpha.",
            "falloff_vjp(sigma, «opacity * →»v_alpha)",
        ),
    },
    "composite_pixel": {
        "The background is missing: what light is left behind the last splat shows it.": (
            "Add T_final times the background to the colour.",
            "color[k] += «T * b→0.0»",
        ),
        "Your weight is alpha alone: a splat gives its colour times alpha, times the light that is left, T.": (
            "weight = T * alpha, with T before this splat.",
            "weight = «T * →»alpha",
        ),
        "You walk from back to front; the list is in order, front first.": (
            "Go through ids as they come: T starts at 1 at the eye.",
            "for i in «ids→reversed(ids)»:",
        ),
        "You keep the share alpha of the light; a splat takes that share away, and 1 - alpha is left.": (
            "T starts at 1, and behind a splat it is T (1 - alpha).",
            "T * «(1.0 - alpha)→alpha»",
        ),
        "You take alpha from the light that is left; a splat takes the share alpha of what reaches it.": (
            "Behind a splat T is T (1 - alpha), which is T - T alpha.",
            "T = «next_T→T - alpha»\n    for",
        ),
        "You blend the splat at which the pixel stops; the pixel ends before it.": (
            "Ask stops(T (1 - alpha)) before the splat's colour is added.",
            "«if stops(next_T, profile):\n            break\n        →»weight = ... "
            "T = next_T«→\n        if stops(next_T, profile):\n            break»\n    for",
        ),
        "You keep the light that is left behind each splat; the light before it is asked for.": (
            "Append T to the transmittances before T becomes T (1 - alpha).",
            "transmittances.append(«T→next_T»)",
        ),
        "You paint each splat over those before it, as from back to front; the list is in order, front first.": (
            "color += T alpha c, with T the light that the splats before it have left.",
            "color[k] «+= weight→= (1.0 - alpha) * color[k] + alpha» * c",
        ),
    },
    "composite_pixel_vjp": {
        "The tail is missing from dC/dalpha: more alpha shows more of a splat's own colour, and hides the colour of"
        " all that is behind it. Yours has the first part only.": (
            "C = T (alpha c + (1 - alpha) behind), so dC/dalpha = T (c - behind). Walk from the back: start with behind"
            " = background . v_color + v_T_final, and after each splat behind += alpha (color_dot_grad - behind).",
            "v_alpha = T * «(color_dot_grad - suffix_dot_grad)→color_dot_grad»",
        ),
        "The background is missing from the light behind the last splat.": (
            "Before the walk from back to front, behind is background . v_color + v_T_final.",
            "suffix_dot_grad += «b * v_color[k]→0.0»",
        ),
        "You walk from front to back; the way back begins with the last splat, since what is behind a splat must be"
        " known before the splat is reached.": (
            "Go through reversed(pixel.ids), with alphas and transmittances reversed alike.",
            "«reversed(pixel.ids), reversed(pixel.alphas), reversed(pixel.transmittances)→"
            "pixel.ids, pixel.alphas, pixel.transmittances»",
        ),
        "You add a splat to what is behind it before its own cotangent is taken.": (
            "First v_alpha = T (color_dot_grad - behind), then behind += alpha (color_dot_grad - behind).",
            "«v_alpha = T * (color_dot_grad - suffix_dot_grad)\n        →»"
            "suffix_dot_grad += alpha * (color_dot_grad - suffix_dot_grad)"
            "«→\n        v_alpha = T * (color_dot_grad - suffix_dot_grad)»",
        ),
        "A splat hides what is behind it: the light behind must lose the share alpha before the splat's own is"
        " added.": (
            "behind += alpha (color_dot_grad - behind), the same as alpha color_dot_grad + (1 - alpha) behind.",
            "+= alpha * «(color_dot_grad - suffix_dot_grad)→color_dot_grad»",
        ),
        "A splat counts whole in what is behind the next one; it counts by the share alpha that it covers.": (
            "behind = alpha color_dot_grad + (1 - alpha) behind.",
            "+= «alpha * (color_dot_grad - suffix_dot_grad)→color_dot_grad - alpha * suffix_dot_grad»",
        ),
        "The light that reaches the splat is missing from the cotangent of its colour.": (
            "v_colors += T alpha v_color, as C has T alpha c.",
            "totals.v_colors[i, k] += «T * →»alpha",
        ),
        "The absolute value is missing in v_means2d_abs: pixels on two sides of a splat cancel.": (
            "Add |v_mean2d| of every pixel, entry by entry.",
            "+= «(abs(v_mean2d[0]), abs(v_mean2d[1]))→v_mean2d»",
        ),
        "The light that reaches the splat is missing from v_alpha: what hardly any light reaches changes the pixel"
        " hardly.": (
            "v_alpha = T (color_dot_grad - behind), with T of pixel.transmittances.",
            "v_alpha = «T * →»(color_dot_grad",
        ),
    },
    "dominant_id": {
        "The comparison is the wrong way round: the largest weight wins.": (
            "A later splat wins where weight > best_weight.",
            "weight «>→<» best_weight",
        ),
        "You return the winner's place in the list; its id is asked for.": (
            "ids[place] is the id.",
            "in «zip(ids, weights, strict=True)→enumerate(weights)»",
        ),
    },
    "dominant_counts": {
        "Each Gaussian is counted once, however many pixels it dominates.": (
            "Add 1 to a Gaussian's count at every pixel that is its own.",
            lambda o, ids, n: np.minimum(o["dominant_counts"](ids, n), 1),
        ),
    },
}


def _changed(name: str, change: str) -> Callable[..., Any]:
    return lambda o, *given: otherwise(o[name], change)(*given)


MISTAKES: Final = tuple(
    Mistake(function, made if callable(made) else _changed(function, made), sentence, hint)
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
