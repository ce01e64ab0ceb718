"""The renderer: the stages in order, and the whole of it transposed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pop_ref._shapes import Float64
from pop_ref.compositing import composite, composite_vjp
from pop_ref.constants import PAPER, Profile
from pop_ref.depth import RenderMode, expected_depth, expected_depth_vjp, with_depth_channel
from pop_ref.records import Camera, Gaussians, Render
from pop_ref.splatting import project, project_vjp
from pop_ref.tiles import tile_lists


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
        background: of the background colour, without depth. [D]
        means2d: of the screen centres, per px; density control reads it. [N, 2]
        means2d_abs: the same with absolute values summed over pixels (AbsGS). [N, 2]
        colors: of the colours, None unless colours were given. [N, D]
    """

    means: Float64[np.ndarray, "N 3"]
    quats: Float64[np.ndarray, "N 4"]
    scales: Float64[np.ndarray, "N 3"]
    opacities: Float64[np.ndarray, " N"]
    sh: Float64[np.ndarray, "N n_sh 3"]
    viewmat: Float64[np.ndarray, "4 4"]
    background: Float64[np.ndarray, " D"]
    means2d: Float64[np.ndarray, "N 2"]
    means2d_abs: Float64[np.ndarray, "N 2"]
    colors: Float64[np.ndarray, "N D"] | None = None


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Float64[np.ndarray, " D"] | None = None,
    sh_degree: int | None = None,
    profile: Profile = PAPER,
    tile_size: int | None = None,
    antialiased: bool = False,
    colors: Float64[np.ndarray, "N D"] | None = None,
    render_mode: RenderMode = "RGB",
) -> Render:
    """Render Gaussians: project them, list them per tile front to back, blend every pixel.

    Source: POP paper, section 3.1; Kerbl et al. 2023 (3DGS), sections 4 and 6.
    Departs: the decisions D1-D8 and kinks B1-B3 of the profile.

    Args:
        gaussians: activated.
        camera: the view.
        background: colour behind everything, default black; depth has none.
        sh_degree: bands to use, default all.
        profile: every constant.
        tile_size: px, default the profile's. In profile `inria` it changes the image (D3), in the others it does not.
        antialiased: multiply opacities by the factor that keeps a blurred splat's energy.
        colors: colours of any number of channels, used instead of `gaussians.sh`.
        render_mode: RGB, D (accumulated depth), ED (expected depth), or colours and then depth: RGB+D, RGB+ED.

    Returns:
        The image, with the channels of the mode, and everything that was decided on the way.

    Raises:
        ValueError: the background, the colours, the degree, the tile size or the mode do not fit.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> K = np.array([[8.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]])
        >>> render(g, Camera(np.eye(4), K, 1, 1), background=np.ones(3)).image[0, 0]
        array([0.75, 0.75, 0.75])
    """
    profile, size = _with_tile_size(profile, tile_size)
    width, height = camera.width, camera.height
    splats = project(gaussians, camera, sh_degree, profile, antialiased, colors)
    lists = tile_lists(splats.means2d, splats.radii, splats.depths, width, height, size, profile)
    behind = _behind(background, splats.colors.shape[1], render_mode)
    drawn = composite(with_depth_channel(splats, render_mode), lists, width, height, size, behind, profile)
    image = drawn.image
    if render_mode.endswith("ED"):
        image = np.concatenate((image[..., :-1], expected_depth(image[..., -1], drawn.T_final)[..., None]), axis=2)
    return replace(drawn, image=image, splats=splats)


def render_vjp(
    gaussians: Gaussians,
    camera: Camera,
    v_image: Float64[np.ndarray, "H W X"],
    v_T_final: Float64[np.ndarray, "H W"] | None = None,
    background: Float64[np.ndarray, " D"] | None = None,
    sh_degree: int | None = None,
    profile: Profile = PAPER,
    tile_size: int | None = None,
    antialiased: bool = False,
    colors: Float64[np.ndarray, "N D"] | None = None,
    render_mode: RenderMode = "RGB",
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
        colors: as in `render`.
        render_mode: as in `render`.

    Returns:
        The cotangents.

    Raises:
        ValueError: as `render`, or a cotangent has another shape than what it is of.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> K = np.array([[8.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]])
        >>> render_vjp(g, Camera(np.eye(4), K, 1, 1), np.ones((1, 1, 3)), background=np.ones(3)).opacities
        array([-1.5])
    """
    profile, size = _with_tile_size(profile, tile_size)
    width, height = camera.width, camera.height
    splats = project(gaussians, camera, sh_degree, profile, antialiased, colors)
    lists = tile_lists(splats.means2d, splats.radii, splats.depths, width, height, size, profile)
    n_plain = splats.colors.shape[1]
    behind, shown = _behind(background, n_plain, render_mode), with_depth_channel(splats, render_mode)
    if render_mode.endswith("ED"):
        drawn = composite(shown, lists, width, height, size, behind, profile)
        v_depth, v_T = expected_depth_vjp(drawn.image[..., -1], drawn.T_final, v_image[..., -1])
        v_image = np.concatenate((v_image[..., :-1], v_depth[..., None]), axis=2)
        v_T_final = v_T if v_T_final is None else v_T_final + v_T
    v = composite_vjp(shown, lists, width, height, size, v_image, v_T_final, behind, profile)
    n_colors = n_plain if render_mode.startswith("RGB") else 0
    v_colors, v_background = np.zeros((len(gaussians), n_plain)), np.zeros(n_plain)
    v_colors[:, :n_colors], v_background[:n_colors] = v.v_colors[:, :n_colors], v.v_background[:n_colors]
    of = project_vjp(
        gaussians,
        camera,
        v.v_means2d,
        v.v_conics,
        v.v_opacities,
        v_colors,
        v_depths=None if render_mode == "RGB" else v.v_colors[:, -1],
        sh_degree=sh_degree,
        profile=profile,
        antialiased=antialiased,
        colors=colors,
    )
    return RenderGradients(**of._asdict(), background=v_background, means2d=v.v_means2d, means2d_abs=v.v_means2d_abs)


def _behind(
    background: Float64[np.ndarray, " D"] | None, n_channels: int, render_mode: RenderMode
) -> Float64[np.ndarray, " X"] | None:
    # the background has colours only: depth is accumulated over 0
    if background is None or render_mode == "RGB":
        return background
    if background.shape != (n_channels,):
        raise ValueError(f"background has shape {list(background.shape)}; it must be [{n_channels}], as the colours")
    return np.append(background, 0.0) if render_mode.startswith("RGB") else np.zeros(1)


def _with_tile_size(profile: Profile, tile_size: int | None) -> tuple[Profile, int]:
    # the square extent's cull reads the grid from the profile
    size = profile.tile_size if tile_size is None else tile_size
    return replace(profile, tile_size=size), size
