"""The renderer: the stages in order, and the whole of it transposed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pop_ref._shapes import Float64
from pop_ref.compositing import composite, composite_vjp
from pop_ref.constants import PAPER, Profile
from pop_ref.splatting import project, project_vjp
from pop_ref.tiles import tile_lists
from pop_ref.types import Camera, Gaussians, Render


@dataclass(frozen=True)
class RenderGradients:
    """Cotangents of everything a render depends on.

    Attributes:
        means: of the centres. [N, 3]
        quats: of the quaternions as given, not normalised. [N, 4]
        scales: of the activated standard deviations. [N, 3]
        opacities: of the activated opacities. [N]
        sh: of the coefficients. [N, n_sh, 3]
        viewmat: of the view matrix, its entries taken as independent; last row zero. [4, 4]
        background: of the background colour. [3]
        means2d: of the screen centres, per px; density control reads it. [N, 2]
        means2d_abs: the same with absolute values summed over pixels (AbsGS). [N, 2]
    """

    means: Float64[np.ndarray, "N 3"]
    quats: Float64[np.ndarray, "N 4"]
    scales: Float64[np.ndarray, "N 3"]
    opacities: Float64[np.ndarray, " N"]
    sh: Float64[np.ndarray, "N n_sh 3"]
    viewmat: Float64[np.ndarray, "4 4"]
    background: Float64[np.ndarray, "3"]
    means2d: Float64[np.ndarray, "N 2"]
    means2d_abs: Float64[np.ndarray, "N 2"]


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Float64[np.ndarray, "3"] | None = None,
    sh_degree: int | None = None,
    profile: Profile = PAPER,
    tile_size: int | None = None,
    antialiased: bool = False,
) -> Render:
    """Render Gaussians: project them, list them per tile front to back, blend every pixel.

    Source: POP paper, section 3.1; Kerbl et al. 2023 (3DGS), sections 4 and 6.
    Departs: the decisions D1-D8 and kinks B1-B3 of the profile.

    Args:
        gaussians: activated.
        camera: the view.
        background: colour behind everything, default black.
        sh_degree: bands to use, default all.
        profile: every constant.
        tile_size: px, default the profile's. In profile `inria` it changes the image (D3), in the others it does not.
        antialiased: multiply opacities by the factor that keeps a blurred splat's energy.

    Returns:
        The image and everything that was decided on the way.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> K = np.array([[8.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]])
        >>> render(g, Camera(np.eye(4), K, 1, 1), background=np.ones(3)).image[0, 0]
        array([0.75, 0.75, 0.75])
    """
    profile, size = _with_tile_size(profile, tile_size)
    width, height = camera.width, camera.height
    splats = project(gaussians, camera, sh_degree, profile, antialiased)
    lists = tile_lists(splats.means2d, splats.radii, splats.depths, width, height, size, profile)
    return composite(splats, lists, width, height, size, background, profile)


def render_vjp(
    gaussians: Gaussians,
    camera: Camera,
    v_image: Float64[np.ndarray, "H W 3"],
    v_T_final: Float64[np.ndarray, "H W"] | None = None,
    background: Float64[np.ndarray, "3"] | None = None,
    sh_degree: int | None = None,
    profile: Profile = PAPER,
    tile_size: int | None = None,
    antialiased: bool = False,
) -> RenderGradients:
    """Pull cotangents of the image and of the remaining transmittance back to everything a render depends on.

    The render is repeated from its arguments; all decisions D1-D8 are held as they fall there.

    Source: transpose of `render`; POP paper, eq. 10 for the chain through the screen centres.
    Departs: the kinks' one-sided derivatives, as the stages say (B1, B2, B3).

    Args:
        gaussians: activated.
        camera: the view.
        v_image: cotangent of the image.
        v_T_final: cotangent of the remaining transmittance, default zero.
        background: as in `render`.
        sh_degree: as in `render`.
        profile: as in `render`.
        tile_size: as in `render`.
        antialiased: as in `render`.

    Returns:
        The cotangents.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> K = np.array([[8.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]])
        >>> render_vjp(g, Camera(np.eye(4), K, 1, 1), np.ones((1, 1, 3)), background=np.ones(3)).opacities
        array([-1.5])
    """
    profile, size = _with_tile_size(profile, tile_size)
    width, height = camera.width, camera.height
    splats = project(gaussians, camera, sh_degree, profile, antialiased)
    lists = tile_lists(splats.means2d, splats.radii, splats.depths, width, height, size, profile)
    v = composite_vjp(splats, lists, width, height, size, v_image, v_T_final, background, profile)
    of = project_vjp(
        gaussians,
        camera,
        v.v_means2d,
        v.v_conics,
        v.v_opacities,
        v.v_colors,
        sh_degree=sh_degree,
        profile=profile,
        antialiased=antialiased,
    )
    return RenderGradients(
        means=of.means,
        quats=of.quats,
        scales=of.scales,
        opacities=of.opacities,
        sh=of.sh,
        viewmat=of.viewmat,
        background=v.v_background,
        means2d=v.v_means2d,
        means2d_abs=v.v_means2d_abs,
    )


def _with_tile_size(profile: Profile, tile_size: int | None) -> tuple[Profile, int]:
    # the square extent's cull reads the grid from the profile
    size = profile.tile_size if tile_size is None else tile_size
    return replace(profile, tile_size=size), size
