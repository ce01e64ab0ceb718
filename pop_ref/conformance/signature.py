"""Verdicts on whole calls of a rasterizer: images, alphas and gradients of every frame are the oracle's."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pop_ref.conformance.assertions import assert_close
from pop_ref.conformance.calls import Call, Called, Frame, drawn_scene, oracle_frame, oracle_frame_vjp
from pop_ref.conformance.capabilities import GRADIENTS
from pop_ref.conformance.error_bounds import PixelErrorBounds, pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.scenes import Scene
from pop_ref.conformance.screen_error_bounds import ScreenErrorBounds
from pop_ref.covariance import covars_from_quats_scales_vjp
from pop_ref.depth import SMALLEST_OPACITY
from pop_ref.records import Render

OF_CAMERA = ("viewmats", "backgrounds")


class Expected:
    """What the oracle says of one frame of a call.

    Attributes:
        scene: what it draws.
        error_bounds: of the frame's channels, depth accumulated.
        render: the oracle's.
        v_image, v_T_final: cotangents, zero where a decision is near its threshold.
    """

    def __init__(self, call: Call, frame: Frame, dtype: Any, number: int) -> None:
        self.call, self.frame = call, frame
        self.scene = drawn_scene(call, frame)
        self.error_bounds = _frame_error_bounds(call, frame, self.scene, dtype)
        self.render: Render = oracle_frame(self.scene, frame.colors, call.render_mode)
        H, W, X = self.render.image.shape
        k = np.arange(H * W * X, dtype=np.float64).reshape(H, W, X)
        sure = self.error_bounds.smooth
        # dyadic, of either sign, nowhere zero, and others for every frame
        self.v_image = (np.mod(k * 5.0 + 3.0 + 7.0 * number, 16.0) - 7.5) / 8.0 * sure[..., None]
        if call.render_mode.endswith("ED"):
            # a pixel that shows almost nothing has an expected depth whose gradient is nearly all rounding
            self.v_image[..., -1] = np.round(64.0 * self.v_image[..., -1] * self._opacity**2) / 64.0
        self.v_T_final = (np.mod(np.arange(H * W).reshape(H, W) * 3.0 + number, 8.0) - 3.5) / 8.0 * sure

    @property
    def image_error_bounds(self) -> np.ndarray:
        """Return what one unit of the image is eps times of; an expected depth pays for its quotient. [H, W, X]"""
        found = self.error_bounds.image + self.error_bounds.absolute
        if self.call.render_mode.endswith("ED"):
            opacity, depth = self._opacity, np.abs(self.render.image[..., -1])
            found = found.copy()
            found[..., -1] = (found[..., -1] + depth * (self.error_bounds.T_final + 1.0)) / opacity + depth
        return found

    @property
    def _opacity(self) -> np.ndarray:
        return np.maximum(1.0 - self.render.T_final, SMALLEST_OPACITY)

    def gradients(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Return the oracle's gradients by the rasterizer's argument, and their error bounds."""
        colors, mode = self.frame.colors, self.call.render_mode
        g = oracle_frame_vjp(self.scene, colors, mode, self.v_image, self.v_T_final)
        found = {name: getattr(g, name) for name in ("means", "quats", "scales", "opacities", "means2d", "means2d_abs")}
        found |= {"viewmats": g.viewmat, "backgrounds": g.background}
        found["colors"] = g.sh if g.colors is None else g.colors
        v_image, v_T, e_cotangents = np.abs(self.v_image), np.abs(self.v_T_final), None
        if mode.endswith("ED"):
            v_image, v_T, e_cotangents = self._quotients_cotangents(v_image, v_T)
        plain = 0 if colors is None or not mode.startswith("RGB") else colors.shape[1]
        given = (v_image, v_T, plain, mode != "RGB", e_cotangents)
        bounds = gradient_error_bounds(self.scene, self.error_bounds, *given)
        bounds |= {"viewmats": bounds["viewmat"], "backgrounds": bounds["background"][: len(g.background)]}
        bounds["colors"] = bounds["sh"] if colors is None else bounds["colors"]
        for name in ("backgrounds", "colors"):
            # what the mode does not show has no gradient, and no error bound
            if bounds[name].size == 0 or not mode.startswith("RGB"):
                bounds[name] = np.zeros(found[name].shape)
        return found, bounds

    def _quotients_cotangents(
        self, v_image: np.ndarray, v_T: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Return the sizes of the cotangents of accumulated depth and transmittance, and the error bounds of both.

        Of E = D / A with A = 1 - T: dE/dD = 1 / A, which is off by as large a share as A is, and dE/dT = E / A.
        """
        depth, e_depth = np.abs(self.render.image[..., -1]), self.image_error_bounds[..., -1]
        v_depth = v_image[..., -1] / self._opacity
        e_v_depth = v_depth * ((self.error_bounds.T_final + 1.0) / self._opacity + 1.0)
        e_image = np.zeros_like(v_image)
        e_image[..., -1] = e_v_depth
        e_T = e_v_depth * depth + v_depth * (e_depth + depth)
        return np.concatenate((v_image[..., :-1], v_depth[..., None]), axis=2), v_T + v_depth * depth, (e_image, e_T)


def _frame_error_bounds(call: Call, frame: Frame, scene: Scene, dtype: Any) -> PixelErrorBounds:
    with_depth, colored = call.render_mode != "RGB", call.render_mode.startswith("RGB")

    def channels(s: ScreenErrorBounds) -> ScreenErrorBounds:
        plain = frame.colors
        colors, e_colors = (s.colors, s.e_colors) if plain is None else (plain, np.zeros_like(plain))
        values, errors = ([colors], [e_colors]) if colored else ([], [])
        if with_depth:
            values.append(s.depths[:, None])
            errors.append((s.e_depths + np.abs(s.depths))[:, None])
        return replace(s, colors=np.concatenate(values, axis=1), e_colors=np.concatenate(errors, axis=1))

    behind = np.append(scene.background if colored else [], [0.0] * with_depth)
    square = scene.profile.extent == "square"
    lists = oracle_frame(scene, frame.colors, call.render_mode).tile_lists if square else None
    return pixel_error_bounds(scene.with_overrides(background=behind), dtype, lists, channels)


def expectations(backend: Any, call: Call) -> list[list[Expected]]:
    """Return what the oracle says of every frame, in the precision of the backend."""
    number = iter(range(10_000))
    return [[Expected(call, frame, backend.dtype, next(number)) for frame in row] for row in call.frames]


def assert_call_is_the_oracles(backend: Any, call: Call) -> tuple[Called, list[list[Expected]]]:
    """Assert that what a rasterizer makes of a call is the oracle's, gradients too where it has them."""
    wanted = expectations(backend, call)
    assert all(np.min(e.render.T_final) < 1.0 for row in wanted for e in row), "nothing is blended in a frame"
    cotangents: tuple[Any, ...] = ()
    if backend.has(GRADIENTS):
        v_images = np.array([[e.v_image for e in row] for row in wanted])
        cotangents = (v_images, np.array([[-e.v_T_final for e in row] for row in wanted]))
    called = backend.call(call, *cotangents)
    for b, row in enumerate(wanted):
        for c, e in enumerate(row):
            sure, key = e.error_bounds.unambiguous, "agreement.image"
            size, image, alpha = e.image_error_bounds, called.images[b, c], called.alphas[b, c]
            assert image.shape == e.render.image.shape, f"images have shape {image.shape}, not {e.render.image.shape}"
            assert_close(key, image[sure], e.render.image[sure], size[sure], backend.dtype, True)
            transmittance = (e.error_bounds.T_final + 1.0)[sure]
            assert_close(
                "agreement.T_final", 1.0 - alpha[sure], e.render.T_final[sure], transmittance, backend.dtype, True
            )
    if cotangents:
        _assert_gradients(backend, call, called, wanted)
    return called, wanted


def _assert_gradients(backend: Any, call: Call, called: Called, wanted: list[list[Expected]]) -> None:
    found = {
        name: value if call.batched or name.startswith("means2d") else value[None]
        for name, value in called.gradients.items()
    }
    for b, row in enumerate(wanted):
        pulled = [e.gradients() for e in row]
        kinked = np.any([e.error_bounds.screen.kinked for e in row], axis=0)
        for name, value in found.items():
            own = name in OF_CAMERA or name.startswith("means2d") or (name == "colors" and call.camera_colors)
            if name == "covars":
                _assert_covariance_gradients(backend, call, value[b], b, pulled, ~kinked)
            elif name == "viewmats" and np.any(kinked):
                continue
            elif own:
                rows = slice(None) if name in OF_CAMERA else ~kinked
                for c, (expected, bounds) in enumerate(pulled):
                    bound = bounds["means2d" if name.startswith("means2d") else name]
                    _assert_gradient(backend, call, name, value[b, c], expected[name], bound, rows)
            else:
                _assert_gradient(backend, call, name, value[b], *_summed(pulled, name), ~kinked)


def _summed(pulled: list[Any], name: str) -> tuple[Any, Any]:
    """Return an argument's gradient and its error bound, summed over the cameras that share it."""
    return sum(expected[name] for expected, _ in pulled), sum(bounds[name] for _, bounds in pulled)


def _assert_gradient(
    backend: Any, call: Call, name: str, value: np.ndarray, expected: Any, bound: Any, rows: Any
) -> None:
    assert value.shape == expected.shape, f"v_{name} has shape {value.shape}, not {expected.shape}"
    key = {"viewmats": "viewmat", "backgrounds": "background"}.get(name, name)
    key = "sh" if name == "colors" and call.sh_degree is not None else key
    assert_close(f"agreement.v_{key}", value[rows], expected[rows], bound[rows], backend.dtype, True)


def _assert_covariance_gradients(
    backend: Any, call: Call, v_covars: np.ndarray, b: int, pulled: list[Any], rows: np.ndarray
) -> None:
    # through the oracle's covariances, so that it does not matter how a gradient is shared by the two triangles
    g = call.frames[b][0].scene.gaussians
    v = covars_from_quats_scales_vjp(g.quats, g.scales, 0.5 * (v_covars + np.swapaxes(v_covars, 1, 2)))
    for name, value in zip(("quats", "scales"), v, strict=True):
        _assert_gradient(backend, call, name, value, *_summed(pulled, name), rows)
