"""`rasterization()`: gsplat's drop-in, on CPUs and on the GPU, judged by the oracle."""

from __future__ import annotations

import math
from typing import Any, Literal

from torch import Tensor

from pop_fast.api.backend import Backend
from pop_fast.api.checks import (
    RASTERIZE_MODES,
    RENDER_MODES,
    Checks,
    check_choice,
    check_given,
    check_sizes,
    check_supported,
    resolved_profile,
)
from pop_fast.api.frame import BatchedScene, RasterizationCall
from pop_fast.api.meta import RenderMeta
from pop_fast.api.registry import fastest_backend, require_backend
from pop_fast.errors import PopError
from pop_fast.stages.splatting import ProjectionSettings
from pop_ref.constants import Profile


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = 16,
    backgrounds: Tensor | None = None,
    render_mode: Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"] = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: Literal["pinhole", "ortho", "fisheye", "ftheta"] = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    *,
    profile: str | Profile = "paper",
    dominance: bool = False,
    counts: bool = False,
    backend: str | Backend = "auto",
) -> tuple[Tensor, Tensor, RenderMeta]:
    """Render Gaussians into C images, with gsplat 1.5.3's signature, results and meta keys.

    Differentiable in means, quats, scales, opacities, colors, viewmats, covars and backgrounds; not in Ks.

    Args:
        means: centres, world units. [..., N, 3]
        quats: rotations wxyz, any norm > 0. [..., N, 4]
        scales: standard deviations, world units. [..., N, 3]
        opacities: in [0, 1]. [..., N]
        colors: any number of channels [..., (C,) N, D], or harmonics [..., (C,) N, K, 3] when `sh_degree` is given.
        viewmats: world -> camera, OpenCV. [..., C, 4, 4]
        Ks: intrinsics, px. [..., C, 3, 3]
        width: px.
        height: px.
        near_plane: world units; at gsplat's default the profile's own value is used.
        far_plane: world units; likewise.
        radius_clip: px; splats with both extents at most this are culled.
        eps2d: low-pass, px^2; at gsplat's default the profile's own value is used.
        sh_degree: bands to evaluate, or None when `colors` are colours.
        packed: whether meta holds rows of visible (camera, Gaussian) pairs only.
        tile_size: px, up to 4096, None for 16; the image does not depend on it, except in profile "inria".
        backgrounds: colours behind everything, without depth. [..., C, D]
        render_mode: colours, depth (D), expected depth (ED), or colours and then depth as the last channel.
        sparse_grad: only False.
        absgrad: also sum |dL/dmeans2d| over pixels into `meta["means2d"].absgrad`.
        rasterize_mode: "antialiased" scales opacities by the factor that keeps a blurred splat's energy.
        channel_chunk: accepted; all channels are blended in one go, whatever their number.
        distributed: only False.
        camera_model: only "pinhole".
        segmented: only False.
        covars: covariances instead of quats and scales. [..., N, 3, 3]
        with_ut: only False.
        with_eval3d: only False.
        radial_coeffs: only None.
        tangential_coeffs: only None.
        thin_prism_coeffs: only None.
        ftheta_coeffs: only None.
        rolling_shutter: only None, or gsplat's `RollingShutterType.GLOBAL`.
        viewmats_rs: only None.
        profile: constants and strictness: "paper", "gsplat_1_5", "gsplat_1_6", "inria", or a `Profile`.
        dominance: compute the dominance keys of meta in the same pass; else they cost one more when first read.
        counts: likewise for n_contrib and n_traversed.
        backend: a name that `pop_fast.api.registry` knows, or a backend. "fast" renders on the CPU, "compiled" too with
            kernels in C++ (`pop_fast.compiled`), "cuda" on the GPU that holds the tensors (`cuda_ext`), "ref" with the
            oracle, slowly. "auto" takes the fastest that is there: "cuda" for tensors on a GPU, else "compiled" where
            it is built, else "fast".

    Returns:
        Images [..., C, H, W, X], not clamped; alphas [..., C, H, W, 1]; meta with gsplat's keys and `dominant_ids`
        (-1 none), `dominant_weights`, `n_contrib` (blended), `n_traversed`, `final_T` [..., C, H, W], and
        `dominant_counts` [..., C, N].

    Raises:
        ValueError: an input's shape, type or value is wrong; the message names it and its index.
        NotImplementedError: an argument is not supported.
        PopError: the backend is unknown, cannot run here, or does not offer an argument; says why and what to do.
    """
    check_given(means=means, opacities=opacities, colors=colors, viewmats=viewmats, Ks=Ks)
    drawing = _backend_for(backend, means)
    given = {
        "sparse_grad": sparse_grad,
        "distributed": distributed,
        "camera_model": camera_model,
        "segmented": segmented,
        "with_ut": with_ut,
        "with_eval3d": with_eval3d,
        "radial_coeffs": radial_coeffs,
        "tangential_coeffs": tangential_coeffs,
        "thin_prism_coeffs": thin_prism_coeffs,
        "ftheta_coeffs": ftheta_coeffs,
        # gsplat's default is a member of an enumeration of its own, which need not be imported to be recognized
        "rolling_shutter": None if getattr(rolling_shutter, "name", None) == "GLOBAL" else rolling_shutter,
        "viewmats_rs": viewmats_rs,
        "covars": covars,
        "radius_clip": radius_clip,
    }
    check_supported(given, drawing)
    check_choice("render_mode", render_mode, RENDER_MODES)
    check_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    if not radius_clip >= 0.0:
        raise ValueError(f"radius_clip is {radius_clip}; it must be >= 0 px")
    chosen = resolved_profile(profile, near_plane, far_plane, eps2d)
    # what gsplat's main branch means by None
    tile_size = 16 if tile_size is None else tile_size
    check_sizes(width, height, tile_size)
    checks = Checks(drawing, means.dtype)
    batch = checks.gaussians(means, quats, scales, opacities, covars)
    n_cameras = checks.cameras(viewmats, Ks, width, height, tile_size, batch)
    per_camera = checks.colors(colors, sh_degree, batch, n_cameras, means.shape[-2])
    if backgrounds is not None:
        shape = (*batch, n_cameras, 3 if sh_degree is not None else colors.shape[-1])
        checks.finite("backgrounds", checks.tensor("backgrounds", backgrounds, shape))
    checks.values()
    n, n_scenes = means.shape[-2], math.prod(batch)
    n_images = n_scenes * n_cameras
    rows = {"quats": quats, "scales": scales} if covars is None else {}
    flat = {name: None if t is None else t.reshape(n_scenes, n, t.shape[-1]) for name, t in rows.items()}
    scene = BatchedScene(
        means=means.reshape(n_scenes, n, 3),
        quats=flat.get("quats"),
        scales=flat.get("scales"),
        covars=None if covars is None else covars.reshape(n_scenes, n, 3, 3),
        opacities=opacities.reshape(n_scenes, n),
        colors=colors.reshape(n_images if per_camera else n_scenes, *colors.shape[len(batch) + per_camera :]),
        per_camera=per_camera,
        viewmats=viewmats.reshape(n_images, 4, 4),
        Ks=Ks.reshape(n_images, 3, 3),
        n_cameras=n_cameras,
    )
    settings = ProjectionSettings(Ks, width, height, chosen, rasterize_mode == "antialiased", radius_clip)
    options = (tile_size, sh_degree, render_mode, packed, absgrad)
    frame = RasterizationCall(scene, (*batch, n_cameras), settings, *options, drawing.stages())
    return frame.render(backgrounds, dominance, counts)


def _backend_for(backend: str | Backend, means: Tensor) -> Backend:
    """Return the backend that was asked for, which can run here.

    Raises:
        PopError: it is unknown, or cannot; says why and what to do.
    """
    if backend == "auto":
        return fastest_backend(means.device.type)
    if isinstance(backend, str):
        return require_backend(backend)
    reason = backend.why_not()
    if reason is not None:
        raise PopError(f"backend {backend.name!r} cannot run: {reason}")
    return backend
