"""What every Gaussian counts for in a view: sums over the pixels where it is blended.

`contributions` adds up weights, pixels and distances (`pop_ref.contributions`); `sensitivities`, Speedy-Splat's score,
how much the pixels react to a Gaussian's value there (`pop_ref.sensitivity`); `fisher_blocks`, PUP-3DGS's score, how
sharply the view determines its place and size (`pop_ref.fisher`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pop_fast.stages.blend.pairs import EntryRows, Pairs, PairWalk, background_or_black, check_grid
from pop_fast.stages.splatting import ProjectionSettings, Splats, colors_of, colors_of_view, covariances, project
from pop_fast.stages.tiles import TileLists
from pop_fast.stages.types import Camera, Gaussians
from pop_ref.constants import PAPER, Profile


@dataclass(frozen=True)
class Contributions:
    """Sums over the pixels where a Gaussian is blended; see `pop_ref.contributions.Contributions`.

    Attributes:
        weight_sum: of T alpha. [N] float64
        n_pixels: how many these are. [N] int64
        map_sum: of a map's values, 0 without a map. [N] float64
        distance_sum: of the distances of the pixels' centres to the splat's, px. [N] float64
    """

    weight_sum: Tensor
    n_pixels: Tensor
    map_sum: Tensor
    distance_sum: Tensor


def contributions(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    pixel_map: Tensor | None = None,
    profile: Profile = PAPER,
) -> Contributions:
    """See `pop_ref.contributions.contributions`.

    Optimizations: a group of tiles and a block of list entries at a time (`pairs`).
    """
    check_grid(lists, width, height, tile_size)
    walk = PairWalk(splats, lists, width, height, profile)
    rows = EntryRows(walk, 4)
    given = checked_map(pixel_map, width, height, splats.means2d.dtype)
    values = walk.tiles_of(splats.means2d.new_zeros((height, width, 1)) if given is None else given[..., None])
    for pairs in walk.front_to_back():
        dx, dy = walk.offsets(pairs)
        weight = pairs.weight.sum(2)
        blended = torch.gt(pairs.alpha, 0.0, out=pairs.scratch)
        of_map = torch.bmm(blended, values.index_select(0, pairs.tiles).transpose(1, 2))[:, :, 0]
        distance = torch.hypot(dx, dy).mul_(blended).sum(2)
        rows.put(pairs, [weight, blended.sum(2), of_map, distance])
    weight_sum, n_pixels, map_sum, distance_sum = rows.totals().T
    return Contributions(weight_sum, n_pixels.to(torch.int64), map_sum, distance_sum)


def checked_map(pixel_map: Tensor | None, width: int, height: int, dtype: torch.dtype) -> Tensor | None:
    """Return a map in a precision.

    Raises:
        ValueError: it is not of the view's size.
    """
    if pixel_map is not None and pixel_map.shape != (height, width):
        raise ValueError(f"pixel_map has shape {list(pixel_map.shape)}; it must be [{height}, {width}]")
    return None if pixel_map is None else pixel_map.to(dtype)


def sensitivities(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    background: Tensor | None = None,
    profile: Profile = PAPER,
) -> Tensor:
    """See `pop_ref.sensitivity.sensitivities`. [N] float64

    Optimizations: as the channels are added up before the square, one channel is blended, their sum; a group of tiles
    and a block of list entries at a time (`pairs`).
    """
    check_grid(lists, width, height, tile_size)
    grey = replace(splats, colors=colors_of(splats).sum(1, keepdim=True))
    walk = PairWalk(grey, lists, width, height, profile)
    rows = EntryRows(walk, 1)
    behind = background_or_black(background, colors_of(splats))
    for pairs, color_dot_grad in walk.color_dot_grads(behind.sum(0, keepdim=True)):
        # T = weight / alpha, and both are 0 where nothing is blended
        T = torch.div(pairs.weight, pairs.alpha.clamp_min_(torch.finfo(color_dot_grad.dtype).tiny), out=pairs.scratch)
        rows.put(pairs, [color_dot_grad[0].mul_(T).square_().sum(2)])
    return rows.totals()[:, 0] * splats.opacities.double().square()


N_MOMENTS = 31
_UPPER = [(i, j) for i in range(5) for j in range(i, 5)]


def screen_moments(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    background: Tensor | None = None,
    profile: Profile = PAPER,
) -> Tensor:
    """See `pop_ref.fisher.screen_moments`. [N, 31] float64

    Optimizations: with G_c = alpha dC_c/dalpha and s = dsigma/d(mean2d, conic), q_c = -G_c s for all three channels, so
    that the fifteen second moments are those of s under one weight, sum_c G_c^2; they and the mixed ones are two matrix
    products an entry. A group of tiles and a block of list entries at a time (`pairs`).

    Raises:
        ValueError: there are not three channels, or the lists are not of that grid.
    """
    check_grid(lists, width, height, tile_size)
    behind = background_or_black(background, three_channels(splats))
    walk = PairWalk(splats, lists, width, height, profile)
    rows = EntryRows(walk, N_MOMENTS)
    for pairs, color_dot_grad in walk.color_dot_grads(behind):
        slopes = _slopes(walk, pairs, splats.conics)
        through = pairs.scratch.copy_(pairs.weight)
        walk.blender.pass_ceiling(pairs.coefficients, pairs.alpha, through)
        G = color_dot_grad.mul_(through)
        seconds = _products(slopes * G.square().sum(0)[:, :, None], slopes)
        mixed = _products(slopes, G.mul_(pairs.weight).permute(1, 2, 0, 3))
        upper = [seconds[..., i, j] for i, j in _UPPER]
        of_colors = [-mixed[..., i, c] for c in range(3) for i in range(5)]
        rows.put(pairs, [*upper, *of_colors, pairs.weight.square().sum(2)])
    return rows.totals()


def three_channels(splats: Splats) -> Tensor:
    """Return the colours of splats. [N, 3]

    Raises:
        ValueError: there are not three channels.
    """
    colors = colors_of(splats)
    if colors.shape[1] != 3:
        raise ValueError(f"the splats have {colors.shape[1]} colour channels; they must have 3")
    return colors


def _slopes(walk: PairWalk, pairs: Pairs, conics: Tensor) -> Tensor:
    """Return dsigma/d(mean2d, conic) of every pair. [n, K, 5, P]"""
    dx, dy = walk.offsets(pairs)
    padded = torch.cat((conics, conics.new_zeros((1, 3))))
    a, b, c = padded[pairs.ids].unsqueeze(3).unbind(2)
    return torch.stack((a * dx + b * dy, b * dx + c * dy, 0.5 * dx * dx, dx * dy, 0.5 * dy * dy), 2)


def _products(left: Tensor, right: Tensor) -> Tensor:
    """Return left @ right^T of every entry: [n, K, A, P] and [n, K, B, P] make [n, K, A, B]."""
    return torch.matmul(left, right.transpose(2, 3))


def fisher_blocks(
    gaussians: Gaussians,
    camera: Camera,
    moments: Tensor,
    sh_degree: int | None = None,
    profile: Profile = PAPER,
    *,
    project: Callable[..., Splats] = project,
    colors_of_view: Callable[..., Tensor] = colors_of_view,
    covariances: Callable[..., Tensor] = covariances,
) -> Tensor:
    """See `pop_ref.fisher.fisher_blocks`. [N, 6, 6] float64, whatever the precision of what is given

    Optimizations: only Gaussians that have moments; the Jacobian of their (mean2d, conic, colour) is the stages' own
    transpose, called once a row for all of them.

    Args:
        gaussians: activated.
        camera: the view.
        moments: of `screen_moments`. [N, 31]
        sh_degree: bands to use, default all.
        profile: of the projection.
        project: the stage, as `pop_fast.stages.splatting.project`.
        colors_of_view: as `pop_fast.stages.splatting.colors_of_view`.
        covariances: as `pop_fast.stages.splatting.covariances`.
    """
    blocks = torch.zeros((len(moments), 6, 6), dtype=torch.float64)
    rows = (moments != 0.0).any(1).nonzero().squeeze(1)
    degree = round(gaussians.sh.shape[1] ** 0.5) - 1 if sh_degree is None else sh_degree
    chosen = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    means, quats, scales, opacities, sh = (t.detach().index_select(0, rows).double() for t in chosen)
    viewmat, K = camera.viewmat.double(), camera.K.double()
    with torch.enable_grad():
        means.requires_grad_()
        scales.requires_grad_()
        view = ProjectionSettings(K, camera.width, camera.height, profile)
        splats = project(means, covariances(quats, scales), opacities, viewmat, view)
        visible = (splats.radii > 0).all(1).nonzero().squeeze(1)
        colors = colors_of_view(sh, means, viewmat, degree, visible).unbind(1)
        of_screen = (*splats.means2d.unbind(1), *splats.conics.unbind(1))
    to_screen = torch.stack([_row(value, means, scales) for value in of_screen], 1)
    to_colors = torch.stack([_row(value, means, None) for value in colors], 1)
    return blocks.index_copy_(0, rows, _sandwich(to_screen, to_colors, moments[rows].double()))


def _row(values: Tensor, means: Tensor, scales: Tensor | None) -> Tensor:
    """Return the derivatives of one number of every Gaussian by its mean and log-scales. [N, 6]"""
    leaves = [means] if scales is None else [means, scales]
    found = torch.autograd.grad(values, leaves, torch.ones_like(values), retain_graph=True)
    return torch.cat((found[0], torch.zeros_like(means) if scales is None else found[1] * scales.detach()), 1)


def _sandwich(to_screen: Tensor, to_colors: Tensor, moments: Tensor) -> Tensor:
    """Turn moments into blocks: with rows J [N, 5, 6] and j_c [N, 3, 6], sum_c (q_c J + w j_c)(q_c J + w j_c)^T."""
    seconds = moments.new_zeros((len(moments), 5, 5))
    for (i, j), column in zip(_UPPER, moments[:, :15].unbind(1), strict=True):
        seconds[:, i, j] = seconds[:, j, i] = column
    mixed = moments[:, 15:30].view(-1, 3, 5)
    by_geometry = to_screen.transpose(1, 2) @ seconds @ to_screen
    crossed = (mixed @ to_screen).transpose(1, 2) @ to_colors
    by_color = to_colors.transpose(1, 2) @ to_colors * moments[:, 30, None, None]
    blocks = by_geometry + crossed + crossed.transpose(1, 2) + by_color
    # the products round differently on either side of the diagonal
    return 0.5 * (blocks + blocks.transpose(1, 2))


def log_det_scores(blocks: Tensor) -> Tensor:
    """See `pop_ref.fisher.log_det_scores`. [N] float64 Optimizations: one batched decomposition of those that have a
    positive diagonal.
    """
    blocks = blocks.double()
    scores = torch.full((len(blocks),), -torch.inf, dtype=torch.float64, device=blocks.device)
    diagonals = blocks.diagonal(dim1=1, dim2=2)
    rows = (diagonals > 0.0).all(1).nonzero().squeeze(1)
    D = diagonals[rows].sqrt()
    values = torch.linalg.svdvals(blocks[rows] / D[:, None, :] / D[:, :, None])
    full = values[:, -1] > 6.0 * torch.finfo(torch.float64).eps * values[:, 0]
    found = values[full].log().sum(1) + 2.0 * D[full].log().sum(1)
    return scores.index_copy_(0, rows[full], found)
