"""Verdicts on whole calls of a rasterizer: of every frame images, alphas and gradients are the oracle's, and gsplat's
`meta` says of the splats, of their order and of the tiles what the oracle does."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from pop_ref.conformance.assertions import assert_close, assert_close_along_rigid_motions, assert_same_bits
from pop_ref.conformance.calls import (
    Call,
    Called,
    Frame,
    drawn_scene,
    oracle_frame,
    oracle_frame_vjp,
    packed_index,
    unpacked,
)
from pop_ref.conformance.capabilities import GRADIENTS
from pop_ref.conformance.error_bounds import PixelErrorBounds, ScreenErrorBounds, pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.scenes import Scene
from pop_ref.conformance.views import clear_of_extents
from pop_ref.covariance import covars_from_quats_scales_vjp
from pop_ref.depth import SMALLEST_OPACITY
from pop_ref.records import Render

OF_CAMERA = ("viewmats", "backgrounds")


class Expected:
    """What the oracle says of one frame of a call.

    Attributes:
        scene: what it draws.
        dtype: the precision that is judged.
        error_bounds: of the frame's channels, depth accumulated.
        render: the oracle's.
        v_image, v_T_final: cotangents, zero where a decision is near its threshold.
    """

    def __init__(self, call: Call, frame: Frame, dtype: Any, number: int) -> None:
        self.call, self.frame, self.dtype = call, frame, dtype
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

    @functools.cached_property
    def clear(self) -> np.ndarray:
        """Tell whose culls, extents and tiles rounding does not decide. [N]"""
        return clear_of_extents(self.scene, self.dtype)

    @functools.cached_property
    def gradients(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Give the oracle's gradients by the rasterizer's argument, and their error bounds."""
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


# calls whose answers are kept: some more than laws of the signature make; whoever is judged next is asked the same
_KEPT: Final = 256
_answers: dict[tuple[str, str], list[list[Expected]]] = {}


def expectations(backend: Any, call: Call) -> list[list[Expected]]:
    """Return what the oracle says of every frame, in the precision of the backend; a call of old is not drawn again."""
    # printed, a call is code that makes it again, to the last bit
    key = repr(call), np.dtype(backend.dtype).name
    if key not in _answers:
        number = iter(range(10_000))
        found = [[Expected(call, frame, backend.dtype, next(number)) for frame in row] for row in call.frames]
        if len(_answers) == _KEPT:
            del _answers[next(iter(_answers))]
        _answers[key] = found
    return _answers[key]


@dataclass(frozen=True)
class Made:
    """A call, what a rasterizer made of it, and what the oracle says of every frame."""

    call: Call
    called: Called
    wanted: list[list[Expected]]

    def each(self) -> Iterator[tuple[int, int, Expected]]:
        """Yield batch entry, camera and what the oracle says."""
        for b, row in enumerate(self.wanted):
            for c, e in enumerate(row):
                yield b, c, e


def made(backend: Any, call: Call) -> Made:
    """Have a call drawn, and pulled back where the rasterizer has gradients."""
    wanted = expectations(backend, call)
    return Made(call, _called(backend, call, wanted), wanted)


def _called(backend: Any, call: Call, wanted: list[list[Expected]]) -> Called:
    cotangents: tuple[Any, ...] = ()
    if backend.has(GRADIENTS):
        v_images = np.array([[e.v_image for e in row] for row in wanted])
        cotangents = (v_images, np.array([[-e.v_T_final for e in row] for row in wanted]))
    return backend.call(call, *cotangents)


def assert_call_is_the_oracles(backend: Any, call: Call) -> Made:
    """Assert that what a rasterizer makes of a call is the oracle's, gradients too where it has them."""
    of = made(backend, call)
    assert all(np.min(e.render.T_final) < 1.0 for _, _, e in of.each()), "nothing is blended in a frame"
    assert_images(backend, of)
    assert_gradients(backend, of)
    return of


def in_frame(of: Made, b: int, c: int) -> str:
    """Name a frame of a call, as briefly as the call allows."""
    words = [f"batch entry {b}"] * bool(of.call.batch) + [f"camera {c}"] * (len(of.call.frames[0]) > 1)
    return "".join(f"{word}, " for word in words)


def assert_images(backend: Any, of: Made) -> None:
    """Assert that the images and alphas of every frame are the oracle's where no decision is near its threshold."""
    for b, c, e in of.each():
        where, sure, dtype = in_frame(of, b, c), e.error_bounds.unambiguous, backend.dtype
        image, alpha = of.called.images[b, c], of.called.alphas[b, c]
        assert image.shape == e.render.image.shape, f"images have shape {image.shape}, not {e.render.image.shape}"

        def pixel(index: tuple[int, ...], where: str = where) -> str:
            y, x, *channel = index
            return f"{where}pixel ({x}, {y})" + "".join(f", channel {k}" for k in channel)

        bounds = e.error_bounds.T_final + 1.0
        # first, because what is wrong in an alpha is wrong in its image
        given = (1.0 - alpha, e.render.T_final, bounds, dtype, True, sure, pixel)
        assert_close("agreement.T_final", *given)
        assert_close("agreement.image", image, e.render.image, e.image_error_bounds, dtype, True, sure, pixel)


def assert_gradients(backend: Any, of: Made) -> None:
    """Assert that the gradients of every argument are the oracle's; of none, where the rasterizer has no gradients."""
    for name, given in of.called.gradients.items():
        value = given if name.startswith("means2d") else of.call.by_entry(given)
        for b, row in enumerate(of.wanted):
            pulled = [e.gradients for e in row]
            kinked = np.any([e.error_bounds.screen.kinked for e in row], axis=0)
            if name == "viewmats" and np.any(kinked):
                continue
            if name == "covars":
                _assert_covariance_gradients(backend, of, value[b], b, pulled, ~kinked)
            elif name in OF_CAMERA or name.startswith("means2d") or (name == "colors" and of.call.camera_colors):
                rows = None if name in OF_CAMERA else ~kinked
                for c, (expected, bounds) in enumerate(pulled):
                    bound = bounds["means2d" if name.startswith("means2d") else name]
                    given = (value[b, c], expected[name], bound)
                    if name == "viewmats":
                        viewmat, where = of.call.frames[b][c].scene.camera.viewmat, in_frame(of, b, c)
                        assert_close_along_rigid_motions("agreement.v_viewmat", viewmat, *given, backend.dtype, where)
                    else:
                        _assert_gradient(backend, of, name, *given, rows, in_frame(of, b, c))
            else:
                entry = f"batch entry {b}, " * bool(of.call.batch)
                _assert_gradient(backend, of, name, value[b], *_summed(pulled, name), ~kinked, entry)


def _summed(pulled: list[Any], name: str) -> tuple[Any, Any]:
    """Return an argument's gradient and its error bound, summed over the cameras that share it."""
    return sum(expected[name] for expected, _ in pulled), sum(bounds[name] for _, bounds in pulled)


def _assert_gradient(
    backend: Any, of: Made, name: str, value: np.ndarray, expected: Any, bound: Any, rows: Any, where: str
) -> None:
    assert value.shape == expected.shape, f"v_{name} has shape {value.shape}, not {expected.shape}"
    key = {"viewmats": "viewmat", "backgrounds": "background"}.get(name, name)
    key = "sh" if name == "colors" and of.call.sh_degree is not None else key

    def entry(index: tuple[int, ...]) -> str:
        if rows is None:
            return f"{where}entry {list(index)}"
        return f"{where}Gaussian {index[0]}" + (f", entry {list(index[1:])}" if len(index) > 1 else "")

    assert_close(f"agreement.v_{key}", value, expected, bound, backend.dtype, True, rows, entry)


def _assert_covariance_gradients(
    backend: Any, of: Made, v_covars: np.ndarray, b: int, pulled: list[Any], rows: np.ndarray
) -> None:
    # through the oracle's covariances, so that it does not matter how a gradient is shared by the two triangles
    g = of.call.frames[b][0].scene.gaussians
    v = covars_from_quats_scales_vjp(g.quats, g.scales, 0.5 * (v_covars + np.swapaxes(v_covars, 1, 2)))
    entry = f"batch entry {b}, " * bool(of.call.batch) + "through covars, "
    for name, value in zip(("quats", "scales"), v, strict=True):
        _assert_gradient(backend, of, name, value, *_summed(pulled, name), rows, entry)


def assert_arguments_unchanged(backend: Any, of: Made) -> None:
    """Assert that every argument is what it was before the call, as far as a program shows that."""
    assert not of.called.changed, f"the call has changed its arguments {', '.join(of.called.changed)}"


def assert_shapes_and_types(backend: Any, of: Made) -> None:
    """Assert that what comes back has the shapes and types that gsplat documents."""
    assert not of.called.strange, "; ".join(of.called.strange)


def assert_images_without_gradients(backend: Any, of: Made) -> None:
    """Assert that the images are the oracle's, too, where the call is made anew and nothing requires a gradient."""
    if backend.has(GRADIENTS):
        assert_images(backend, replace(of, called=backend.call(of.call)))


def assert_gradients_without_that_of_means(backend: Any, of: Made) -> None:
    """Assert that the gradients of the other arguments are the oracle's, too, where the means require none."""
    if backend.has(GRADIENTS) and backend.has("differentiate"):
        assert_gradients(backend, replace(of, called=_called(backend, replace(of.call, frozen=("means",)), of.wanted)))


ROWS = ("means2d", "depths", "conics", "opacities")


def assert_sizes(of: Made) -> None:
    """Assert that what meta says of pictures, tiles and counts is what was asked."""
    call, meta, size = of.call, of.called.meta, of.call.tile_size
    width, height = call.first.scene.camera.width, call.first.scene.camera.height
    wanted = {"width": width, "height": height, "tile_size": size}
    wanted |= {"tile_width": -(-width // size), "tile_height": -(-height // size)}
    wanted |= {"n_cameras": len(call.frames[0]), "n_batches": len(call.frames)}
    for name, value in wanted.items():
        if name in meta:
            assert int(meta[name]) == value, f"meta[{name!r}] is {int(meta[name])}; it must be {value}"


def assert_rows(backend: Any, of: Made) -> None:
    """Assert that the rows of meta are the oracle's splats, and that packed rows are the visible ones.

    Packed rows that do not tell whose they are have nothing to be compared with.
    """
    call, meta = of.call, of.called.meta
    given = {name: unpacked(call, meta[name], meta) for name in (*ROWS, "radii") if name in meta}
    rows = {name: value for name, value in given.items() if value is not None}
    index = packed_index(call, meta) if call.packed else None
    present = np.zeros(call.shape, dtype=np.int64)
    if index is not None:
        np.add.at(present, index, 1)
    for b, c, e in of.each():
        s, clear, visible = e.error_bounds.screen, e.clear, e.render.splats.visible
        frame = in_frame(of, b, c)

        def gaussian(at: tuple[int, ...], what: str = "", frame: str = frame) -> str:
            return f"{what}{frame}Gaussian {at[0]}" + "".join(f", entry {k}" for k in at[1:])

        if index is not None:
            assert_same_bits("packed rows of it", present[b, c], visible.astype(np.int64), clear, gaussian)
        if "radii" in rows:
            assert_same_bits("meta radii", rows["radii"][b, c], e.render.splats.radii, clear, gaussian)
        units = {"means2d": s.e_means2d, "depths": s.e_depths, "conics": s.e_conics, "opacities": s.e_opacities}
        # what is culled holds no number
        drawn, splats = clear & visible, e.render.splats
        for name in (name for name in ROWS if name in rows):
            size = units[name] + np.abs(getattr(splats, name))
            place = functools.partial(gaussian, what=f"{name} of ")
            values = (rows[name][b, c], getattr(splats, name), size)
            assert_close("meta.rows", *values, backend.dtype, True, drawn, place)


def assert_dominance(backend: Any, of: Made) -> None:
    """Assert that what meta tells of the dominant Gaussians, the blended splats and what is left is every frame's own.

    The counts of a frame are those of its ids, also where rounding decides who dominates.
    """
    call, meta = of.call, of.called.meta
    B, C, N = call.shape
    ids = ("dominant_ids", "dominant_weights", "n_contrib", "final_T")
    told = {name: meta[name].reshape(B, C, *meta[name].shape[-2:]) for name in ids if name in meta}
    for b, c, e in of.each():
        bounds, frame = e.error_bounds, in_frame(of, b, c)

        def pixel(at: tuple[int, ...], frame: str = frame) -> str:
            return f"{frame}pixel ({at[1]}, {at[0]})"

        for name, wanted, sure in (("dominant_ids", e.render.dominant_ids, bounds.decided),
                                   ("n_contrib", e.render.n_blended, bounds.unambiguous)):  # fmt: skip
            if name in told:
                assert_same_bits(f"meta {name}", told[name][b, c], wanted, sure, pixel)
        for name, key, wanted, size in (
            ("dominant_weights", "agreement.weight", e.render.dominant_weights, bounds.dominant_weight + 1.0),
            ("final_T", "agreement.T_final", e.render.T_final, bounds.T_final + 1.0),
        ):
            if name in told:
                assert_close(key, told[name][b, c], wanted, size, backend.dtype, True, bounds.unambiguous, pixel)
        if "dominant_ids" in told and "dominant_counts" in meta:
            own = told["dominant_ids"][b, c]
            counts = np.bincount(own[own >= 0], minlength=N)
            given = meta["dominant_counts"].reshape(B, C, N)[b, c]
            assert_same_bits(f"meta dominant_counts beside dominant_ids, {frame}Gaussian", given, counts)


def lacks_for_tiles(of: Made) -> list[str]:
    """Return what meta would have to tell for its tile lists to be judged, and does not."""
    lacks = [name for name in ("flatten_ids", "isect_offsets") if name not in of.called.meta]
    if of.call.packed and packed_index(of.call, of.called.meta) is None:
        lacks.append("camera_ids")
    return lacks


def assert_tiles_where_told(backend: Any, of: Made) -> None:
    """Assert what meta says of sizes, and its tile lists and their keys as far as it tells them."""
    assert_sizes(of)
    sized = backend.takes("tile_size") or backend.own_tile_size is not None
    if sized and not lacks_for_tiles(of):
        assert_tiles(backend, of)
        if "isect_ids" in of.called.meta and "depths" in of.called.meta:
            assert_keys(of.called.meta, sum(1 for _ in of.each()), of.call.n_tiles)


def assert_tiles(backend: Any, of: Made) -> None:
    """Assert that tile lists run front to back, and hold every Gaussian that is blended and none that the oracle culls.

    A list may be tighter than the oracle's, which is of whole extents; what rounding culls is left out.
    """
    call, meta, every = of.call, of.called.meta, list(of.each())
    B, C, n = call.shape
    camera, size = call.first.scene.camera, call.tile_size
    flat, offsets = meta["flatten_ids"], meta["isect_offsets"]
    tiles = (-(-camera.height // size), -(-camera.width // size))
    assert offsets.shape[-2:] == tiles, f"meta['isect_offsets'] has shape {offsets.shape}; it must end in {tiles}"
    starts = np.append(offsets.reshape(-1), len(flat))
    assert starts[0] == 0, f"meta['isect_offsets'] begins with {starts[0]}"
    assert np.all(np.diff(starts) >= 0), "meta['isect_offsets'] falls"
    n_lists = len(every) * tiles[0] * tiles[1]
    assert len(starts) == n_lists + 1, f"meta['isect_offsets'] has {len(starts) - 1} tiles; there are {n_lists}"
    owner = np.ravel_multi_index(_index(call, meta, flat), (B, C, n))
    clear = [e.clear for _, _, e in every]
    lists = [owner[a:z] for a, z in itertools.pairwise(starts)]
    for number, listed in enumerate(lists):
        image, tile = divmod(number, tiles[0] * tiles[1])
        b, c, e = every[image]
        assert np.all(listed // n == image), f"{in_frame(of, b, c)}tile {tile}: it lists Gaussians of another frame"
        _assert_list(e, clear[image], tile, listed % n, tiles[1], in_frame(of, b, c))
    if "tiles_per_gauss" in meta:
        counts = np.bincount(flat, minlength=meta["tiles_per_gauss"].size)
        assert_same_bits("meta tiles_per_gauss", meta["tiles_per_gauss"].reshape(-1), counts)
    if "isect_ids" in meta:
        keys = meta["isect_ids"]
        assert len(keys) == len(flat), f"{len(keys)} isect_ids for {len(flat)} flatten_ids"
        assert np.all(np.diff(keys) >= 0), "meta['isect_ids'] are not sorted"


def assert_keys(meta: dict[str, Any], n_images: int, n_tiles: int) -> None:
    """Assert that an intersection's key holds, from the high bits down, its image, its tile and its float32 depth.

    The tile takes as many bits as the number of tiles has, the depth the low 32, so that keys sort front to back.
    """
    keys, flat = np.asarray(meta["isect_ids"], dtype=np.int64), np.asarray(meta["flatten_ids"])
    counts = np.diff(np.append(np.asarray(meta["isect_offsets"]).reshape(-1), len(flat)))
    lists = np.repeat(np.arange(n_images * n_tiles), counts)
    bits = n_tiles.bit_length()
    assert_same_bits("images in meta isect_ids", keys >> (32 + bits), lists // n_tiles)
    assert_same_bits("tiles in meta isect_ids", (keys >> 32) & ((1 << bits) - 1), lists % n_tiles)
    depths = np.asarray(meta["depths"]).reshape(-1)[flat].astype(np.float32)
    assert_same_bits("depths in meta isect_ids", keys & 0xFFFFFFFF, depths.view(np.int32).astype(np.int64))


def _index(call: Call, meta: dict[str, Any], flat: np.ndarray) -> tuple[np.ndarray, ...]:
    index = packed_index(call, meta) if call.packed else None
    return np.unravel_index(flat, call.shape) if index is None else tuple(each[flat] for each in index)


def _assert_list(e: Expected, clear: np.ndarray, tile: int, listed: np.ndarray, tiles_x: int, frame: str) -> None:
    size, (y, x) = e.scene.side, divmod(tile, tiles_x)
    window = (slice(y * size, (y + 1) * size), slice(x * size, (x + 1) * size))
    sure = e.error_bounds.unambiguous[window]
    shown = [layer.id for layer in e.error_bounds.layers if np.any(layer.blended[window] & sure)]
    lost = [i for i in shown if i not in listed]
    assert not lost, f"{frame}tile {tile} does not list Gaussians {lost}, which are blended in it"
    allowed, listed = e.render.tile_lists[tile], listed[clear[listed]]
    strangers = [int(i) for i in listed if i not in allowed]
    assert not strangers, f"{frame}tile {tile} lists Gaussians {strangers}, which do not reach it"
    order = [i for i in allowed if i in set(listed.tolist())]
    assert listed.tolist() == order, f"{frame}tile {tile} lists {listed.tolist()}; from front to back they are {order}"
