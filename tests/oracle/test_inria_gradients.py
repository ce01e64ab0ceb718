"""Inria's gradients against differences in 50 digits of a renderer that is written here once more.

Inria's backward pass leaves two derivatives out of the chain: where the frustum clamps a centre, the clamped coordinate
is a constant (B1), and a clamped alpha passes its gradient as if it were not clamped (B3). Both are put into the
function whose differences are taken: the clamped coordinate is frozen, and the clamp of alpha is a constant offset.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pop_ref import INRIA, Gaussians, render, render_vjp
from pop_ref.compositing import composite_pixel
from pop_ref.pixel import rows_from_splats
from pop_ref.tiles import listed_pixels
from tests.oracle.scenes import safe_gaussians, tilted_camera

mpmath = pytest.importorskip("mpmath")

VIEW = tilted_camera()
BACKGROUND = np.array([0.5, 0.25, 1.0])
NAMES = ("means", "quats", "scales", "opacities", "sh")
DIGITS = 50


def _rotation(q: Any) -> Any:
    w, x, y, z = (c / mpmath.sqrt(sum(c * c for c in q)) for c in q)
    return mpmath.matrix(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _color(sh: Any, mean: Any, eye: Any) -> list[Any]:
    d = [a - b for a, b in zip(mean, eye, strict=True)]
    x, y, z = (c / mpmath.sqrt(sum(c * c for c in d)) for c in d)
    low, high = 1 / mpmath.sqrt(4 * mpmath.pi), mpmath.sqrt(3 / (4 * mpmath.pi))
    basis = (low, -high * y, high * z, -high * x)
    sums = [sum(b * row[c] for b, row in zip(basis, sh, strict=True)) + mpmath.mpf("0.5") for c in range(3)]
    return [max(s, mpmath.mpf(0)) for s in sums]


class Inria:
    """The loss in mpmath, with the decisions of one scene and what its backward pass holds constant."""

    def __init__(self, gaussians: Gaussians, v_image: np.ndarray, v_T_final: np.ndarray) -> None:
        drawn = render(gaussians, VIEW, BACKGROUND, profile=INRIA)
        rows, size = rows_from_splats(drawn.splats), INRIA.tile_size
        self.blended = {
            (x, y): composite_pixel(ids, rows, x + 0.5, y + 0.5, BACKGROUND.tolist(), INRIA).ids
            for x, y, ids in listed_pixels(drawn.tile_lists, VIEW.width, VIEW.height, size)
        }
        self.v_image, self.v_T_final = v_image, v_T_final
        self.frozen: dict[Any, Any] = {}
        self.n_clamped_centres = self.n_clamped_alphas = 0
        R = VIEW.viewmat[:3, :3].astype(object)
        self.R = mpmath.matrix([[mpmath.mpf(e) for e in row] for row in R])
        self.t = [mpmath.mpf(e) for e in VIEW.viewmat[:3, 3]]
        self.eye = list(-(self.R.T * mpmath.matrix(self.t)))
        self.base = {name: getattr(gaussians, name) for name in NAMES}

    def _splat(self, i: int, mean: Any, quat: Any, scale: Any) -> tuple[Any, Any, Any]:
        p = [sum(self.R[a, b] * mean[b] for b in range(3)) + self.t[a] for a in range(3)]
        f = [mpmath.mpf(VIEW.K[a, a]) for a in (0, 1)]
        sizes, z = (VIEW.width, VIEW.height), p[2]
        centre = [f[a] * p[a] / z + mpmath.mpf(sizes[a]) / 2 for a in (0, 1)]
        side = []
        for a in (0, 1):
            limit = mpmath.mpf(str(1 + INRIA.frustum_margin)) * sizes[a] / (2 * f[a])
            if (i, a) not in self.frozen:
                clamped = max(-limit, min(limit, p[a] / z)) * z
                self.frozen[i, a] = None if clamped == p[a] or abs(p[a] / z) < limit else clamped
                self.n_clamped_centres += self.frozen[i, a] is not None
            side.append(p[a] if self.frozen[i, a] is None else self.frozen[i, a])
        J = mpmath.matrix([[f[0] / z, 0, -f[0] * side[0] / z**2], [0, f[1] / z, -f[1] * side[1] / z**2]])
        M = J * self.R * _rotation(quat) * mpmath.diag(list(scale))
        cov = M * M.T
        a, b, c = cov[0, 0] + mpmath.mpf(INRIA.eps2d), cov[0, 1], cov[1, 1] + mpmath.mpf(INRIA.eps2d)
        det = a * c - b * b
        return z, centre, (c / det, -b / det, a / det)

    def loss(self, values: dict[str, Any]) -> Any:
        n = len(values["means"])
        splats = [self._splat(i, values["means"][i], values["quats"][i], values["scales"][i]) for i in range(n)]
        colors = [_color(values["sh"][i], values["means"][i], self.eye) for i in range(n)]
        total = mpmath.mpf(0)
        for (x, y), ids in self.blended.items():
            T, pixel = mpmath.mpf(1), [mpmath.mpf(0)] * 3
            for i in ids:
                _, centre, (A, B, C) = splats[i]
                dx, dy = centre[0] - x - mpmath.mpf("0.5"), centre[1] - y - mpmath.mpf("0.5")
                raw = values["opacities"][i] * mpmath.exp(-(A * dx * dx + C * dy * dy) / 2 - B * dx * dy)
                key = (i, x, y)
                if key not in self.frozen:
                    self.frozen[key] = min(raw, mpmath.mpf(INRIA.alpha_ceiling)) - raw
                    self.n_clamped_alphas += self.frozen[key] != 0
                alpha = raw + self.frozen[key]
                pixel = [c + T * alpha * own for c, own in zip(pixel, colors[i], strict=True)]
                T = T * (1 - alpha)
            seen = [c + T * mpmath.mpf(b) for c, b in zip(pixel, BACKGROUND, strict=True)]
            total += sum(mpmath.mpf(v) * c for v, c in zip(self.v_image[y, x], seen, strict=True))
            total += mpmath.mpf(self.v_T_final[y, x]) * T
        return total

    def values(self) -> dict[str, Any]:
        return {name: np.vectorize(mpmath.mpf, otypes=[object])(value) for name, value in self.base.items()}

    def slope(self, name: str, index: tuple[int, ...]) -> Any:
        h, ends = mpmath.mpf(10) ** -16, []
        for sign in (1, -1):
            values = self.values()
            values[name][index] += sign * h
            ends.append(self.loss(values))
        return (ends[0] - ends[1]) / (2 * h)


def _scene() -> Gaussians:
    gaussians = safe_gaussians(VIEW, profile=INRIA)
    # opaque and large, so that a pixel lies where alpha is clamped
    opacities = np.where(np.arange(len(gaussians)) < 3, 1.0, gaussians.opacities)
    return replace(gaussians, opacities=opacities, scales=gaussians.scales * 3.0)


@pytest.mark.parametrize("name", NAMES)
def test_inrias_gradients_are_those_of_fifty_digits(name: str) -> None:
    gaussians, rng = _scene(), np.random.default_rng(3)
    v_image, v_T_final = rng.normal(size=(5, 6, 3)), rng.normal(size=(5, 6))
    stated = getattr(render_vjp(gaussians, VIEW, v_image, v_T_final, BACKGROUND, profile=INRIA), name)
    with mpmath.workdps(DIGITS):
        by_hand = Inria(gaussians, v_image, v_T_final)
        drawn = render(gaussians, VIEW, BACKGROUND, profile=INRIA)
        here = np.sum(v_image * drawn.image) + np.sum(v_T_final * drawn.T_final)
        assert abs(float(by_hand.loss(by_hand.values())) - here) < 1e-13 * np.sum(np.abs(v_image))
        assert by_hand.n_clamped_centres > 0, "no centre is clamped (B1)"
        assert by_hand.n_clamped_alphas > 0, "no alpha is clamped (B3)"
        measured = np.array([float(by_hand.slope(name, index)) for index in np.ndindex(*stated.shape)])
    assert np.any(measured != 0.0)
    np.testing.assert_allclose(stated.reshape(-1), measured, rtol=0.0, atol=1e-12 * np.max(np.abs(measured)))
