"""How far one pixel's decisions are from flipping: floor (D5), ceiling (D6), stop (D7), dominance (D8).

The errors of `magnitudes` are carried on through exponent, alpha and transmittance, as plain floats because this is
the innermost loop.
"""

from __future__ import annotations

from collections.abc import Sequence

from pop_ref.alpha import falloff, sigma_at_pixel
from pop_ref.constants import Profile
from pop_ref.magnitudes import Magnitudes, Rounded, constant, distance, in_float32
from pop_ref.pixel import stops

PixelMargins = dict[str, list[tuple[tuple[int, ...], float]]]


def pixel_margins(
    ids: Sequence[int], magnitudes: Sequence[Magnitudes | None], px: float, py: float, profile: Profile
) -> PixelMargins:
    """Measure D5 to D8 at one pixel, over the list entries visited until it stops.

    Source: Higham 2002, section 3.3, applied to `pixel.composite_pixel`.
    Departs: nothing.

    Args:
        ids: the tile's list, front to back.
        magnitudes: of every Gaussian; those in the list are not None.
        px: the pixel's centre along x, its index + 0.5.
        py: the same along y.
        profile: floor, ceiling and stop.

    Returns:
        For each decision the splats it is about and its distance in units of eps: D5, D6, D7 of each entry that gets
        that far, D8 of the winner against each rival.

    Example:
        >>> from pop_ref.constants import PAPER
        >>> one, half = Rounded(1.0), Rounded(0.5)
        >>> m = Magnitudes(one, (half, half), (one, one), (one, Rounded(0.0), one), one, (one, Rounded(0.0), one), half)
        >>> found = pixel_margins([0, 1], [m, m], 0.5, 0.5, PAPER)
        >>> found["D8"]
        [((0, 1), inf)]
    """
    floor, ceiling = constant(profile.alpha_floor), constant(profile.alpha_ceiling)
    stop = constant(profile.transmittance_stop)
    found: PixelMargins = {"D5": [], "D6": [], "D7": [], "D8": []}
    left = Rounded(1.0)
    weights: list[tuple[int, Rounded]] = []
    for i in ids:
        m = magnitudes[i]
        assert m is not None
        sigma = _sigma(m, px, py)
        if sigma.value < 0.0:
            found["D5"].append(((i,), distance(sigma, Rounded(0.0))))
            continue
        raw = _raw_alpha(sigma, m.opacity)
        found["D5"].append(((i,), distance(raw, floor)))
        if raw.value < floor.value:
            continue
        # sigma < 0 is only possible if rounding makes the conic indefinite
        definite = m.conic[0] * m.conic[2] - m.conic[1] * m.conic[1]
        sign = max(distance(sigma, Rounded(0.0)), distance(definite, Rounded(0.0)))
        found["D5"].append(((i,), sign))
        found["D6"].append(((i,), distance(raw, ceiling)))
        alpha = raw if raw.value <= ceiling.value else ceiling
        next_left = left * (Rounded(1.0) - alpha)
        found["D7"].append(((i,), distance(next_left, stop)))
        if stops(next_left.value, profile):
            break
        weights.append((i, left * alpha))
        left = next_left
    found["D8"] = _dominance(weights)
    return found


def _dominance(weights: Sequence[tuple[int, Rounded]]) -> list[tuple[tuple[int, ...], float]]:
    if not weights:
        return []
    winner, best = max(weights, key=lambda pair: pair[1].value)
    return [((winner, i), distance(best, weight)) for i, weight in weights if i != winner]


def _sigma(m: Magnitudes, px: float, py: float) -> Rounded:
    A, B, C = m.conic
    u, v = m.mean2d
    value = sigma_at_pixel((u.value, v.value), (A.value, B.value, C.value), px, py)
    dx, dy = u.value - px, v.value - py
    inherited = 0.5 * (A.error * dx * dx + C.error * dy * dy) + B.error * abs(dx * dy)
    inherited += abs(A.value * dx + B.value * dy) * u.error + abs(B.value * dx + C.value * dy) * v.error
    if inherited == 0.0 and in_float32(value):
        return Rounded(value)
    terms = 0.5 * (A.value * dx * dx + C.value * dy * dy) + abs(B.value * dx * dy)
    # each term is a product of four rounded factors, then summed
    return Rounded(value, inherited + 5.0 * terms)


def _raw_alpha(sigma: Rounded, opacity: Rounded) -> Rounded:
    G = falloff(sigma.value)
    if sigma.value == 0.0 and sigma.error == 0.0:
        return opacity
    # exp turns an absolute error into a relative one and adds about an eps; the product adds another
    return Rounded(opacity.value * G, G * opacity.error + opacity.value * G * (sigma.error + 2.0))
