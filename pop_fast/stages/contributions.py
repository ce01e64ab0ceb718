"""What every Gaussian counts for in a view: sums over the pixels where it is blended, and which pixels are its own.

`contributions` adds up weights, pixels and distances (`pop_ref.contributions`); `sensitivities`, Speedy-Splat's score,
how much the pixels react to a Gaussian's value there (`pop_ref.sensitivity`); `fisher_blocks`, PUP-3DGS's score, how
sharply the view determines its place and size (`pop_ref.fisher`); `dominant_points` are Mini-Splatting's, where a
pixel's ray is closest to the Gaussian that it belongs to (`pop_ref.chord`).

All go through the (splat, pixel) pairs of a blend, a step of `Blender` at a time (`PairWalk`). A tile-list entry holds
one splat's pixels of one tile: a pass writes one row an entry, and the rows of a splat are added up in the order of the
lists, in float64.

Whether a Gaussian is densest ahead of the camera, t* >= 0, has the sign of -(a . b) with a = diag(1/s) R^T (o - mean)
and b = diag(1/s) R^T d. So a pair needs g . d <= 0 only, with g = R diag(1/s) a made once a Gaussian; t* is computed
for the winner of a pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pop_fast.stages.blend import Blender, acquired_buffers, release_buffer
from pop_fast.stages.covariance import rotmats_from_quats
from pop_fast.stages.projection import camera_center, intrinsics
from pop_fast.stages.splatting import ProjectionSettings, Splats, colors_of, colors_of_view, covariances, project
from pop_fast.stages.tile_groups import BLOCK, Entries, PackedLists, TileGroup, tile_groups
from pop_fast.stages.tiles import TileLists, check_grid
from pop_fast.stages.types import Camera, Gaussians
from pop_ref.constants import PAPER, Profile

# of splats, their lists, the size of the view, a profile and what a pass needs else: its sums for every splat
Sums = Callable[..., Tensor]


@dataclass(frozen=True)
class Contributions:
    """Sums over the pixels where a Gaussian is blended; see `pop_ref.contributions.Contributions`."""

    weight_sum: Tensor  # of T alpha. [N] float64
    n_pixels: Tensor  # how many these are. [N] int64
    map_sum: Tensor  # of a map's values, 0 without a map. [N] float64
    distance_sum: Tensor  # of the distances of the pixels' centres to the splat's, px. [N] float64


def _contribution_sums(
    splats: Splats, lists: TileLists, size: tuple[int, int], profile: Profile, pixel_map: Tensor | None
) -> Tensor:
    """Return weights, pixels, the map's values and distances, summed up for every splat. [N, 4] float64"""
    walk = PairWalk(splats, lists, *size, profile)
    rows = EntryRows(walk, 4)
    values = walk.tiles_of(splats.means2d.new_zeros((*size[::-1], 1)) if pixel_map is None else pixel_map[..., None])
    for pairs in walk.steps():
        dx, dy = walk.offsets(pairs)
        weight = pairs.weight.sum(2)
        blended = torch.gt(pairs.alpha, 0.0, out=pairs.scratch)
        of_map = torch.bmm(blended, values.index_select(0, pairs.tiles).transpose(1, 2))[:, :, 0]
        distance = torch.hypot(dx, dy).mul_(blended).sum(2)
        rows.put(pairs, [weight, blended.sum(2), of_map, distance])
    return rows.totals()


def contributions(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    pixel_map: Tensor | None = None,
    profile: Profile = PAPER,
    *,
    sums: Sums = _contribution_sums,
) -> Contributions:
    """See `pop_ref.contributions.contributions`.

    Optimizations: a group of tiles and a block of list entries at a time.

    Raises:
        ValueError: the map is not of the view's size, or the lists are not of that grid.
    """
    check_grid(lists, width, height, tile_size)
    if pixel_map is not None and pixel_map.shape != (height, width):
        raise ValueError(f"pixel_map has shape {list(pixel_map.shape)}; it must be [{height}, {width}]")
    given = None if pixel_map is None else pixel_map.to(splats.means2d.dtype)
    weight_sum, n_pixels, map_sum, distance_sum = sums(splats, lists, (width, height), profile, given).T
    return Contributions(weight_sum, n_pixels.to(torch.int64), map_sum, distance_sum)


def _sensitivity_sums(
    grey: Splats, lists: TileLists, size: tuple[int, int], profile: Profile, behind: Tensor
) -> Tensor:
    """Return the squares of T dC/dalpha of one channel, summed up for every splat. [N, 1] float64"""
    walk = PairWalk(grey, lists, *size, profile)
    rows = EntryRows(walk, 1)
    for pairs, color_dot_grad in walk.color_dot_grads(behind):
        # T = weight / alpha, and both are 0 where nothing is blended
        T = torch.div(pairs.weight, pairs.alpha.clamp_min_(torch.finfo(color_dot_grad.dtype).tiny), out=pairs.scratch)
        rows.put(pairs, [color_dot_grad[0].mul_(T).square_().sum(2)])
    return rows.totals()


def sensitivities(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    background: Tensor | None = None,
    profile: Profile = PAPER,
    *,
    sums: Sums = _sensitivity_sums,
) -> Tensor:
    """See `pop_ref.sensitivity.sensitivities`. [N] float64

    Optimizations: as the channels are added up before the square, one channel is blended, their sum; a group of tiles
    and a block of list entries at a time.
    """
    check_grid(lists, width, height, tile_size)
    grey = replace(splats, colors=colors_of(splats).sum(1, keepdim=True))
    behind = _background_or_black(background, colors_of(splats))
    found = sums(grey, lists, (width, height), profile, behind.sum(0, keepdim=True))
    return found[:, 0] * splats.opacities.double().square()


N_MOMENTS = 31
_UPPER = [(i, j) for i in range(5) for j in range(i, 5)]


def _moment_sums(splats: Splats, lists: TileLists, size: tuple[int, int], profile: Profile, behind: Tensor) -> Tensor:
    """Return the moments, summed up for every splat. [N, 31] float64"""
    walk = PairWalk(splats, lists, *size, profile)
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


def screen_moments(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    background: Tensor | None = None,
    profile: Profile = PAPER,
    *,
    sums: Sums = _moment_sums,
) -> Tensor:
    """See `pop_ref.fisher.screen_moments`. [N, 31] float64

    Optimizations: with G_c = alpha dC_c/dalpha and s = dsigma/d(mean2d, conic), q_c = -G_c s for all three channels, so
    that the fifteen second moments are those of s under one weight, sum_c G_c^2; they and the mixed ones are two matrix
    products an entry. A group of tiles and a block of list entries at a time.

    Raises:
        ValueError: there are not three channels, or the lists are not of that grid.
    """
    check_grid(lists, width, height, tile_size)
    if (channels := colors_of(splats).shape[1]) != 3:
        raise ValueError(f"the splats have {channels} colour channels; they must have 3")
    return sums(splats, lists, (width, height), profile, _background_or_black(background, colors_of(splats)))


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
    transpose, called once a row for all of them. `project`, `colors_of_view`, `covariances` may be a backend's own.
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


@dataclass(frozen=True)
class Pairs:
    """One step: n tiles, K list entries of each, all P pixels of a tile. What it holds is gone with the next step."""

    tiles: Tensor  # [n]
    rows: Tensor  # place of every entry in the packed lists. [n, K]
    ids: Tensor  # splat of every entry, the number of splats for padding. [n, K]
    coefficients: Tensor  # of the entries' exponents. [n K, 6]
    colors: Tensor  # of the entries. [n, K, D]
    alpha: Tensor  # 0 where an entry is not blended, and off the image. [n, K, P]
    weight: Tensor  # T alpha. [n, K, P]
    scratch: Tensor  # for whatever is computed from these. [n, K, P]


class PairWalk:
    """Goes through the pairs of a view of that width and height, px."""

    def __init__(self, splats: Splats, lists: TileLists, width: int, height: int, profile: Profile) -> None:
        colors = splats.means2d.new_empty((len(splats.means2d), 0)) if splats.colors is None else splats.colors
        self.lists, self.size, self.n_splats = lists, (height, width), len(splats.means2d)
        self.entries = Entries.of(splats.means2d, PackedLists.of(lists, self.n_splats))
        self.blender = Blender.of(self.entries, splats.conics, splats.opacities, colors, profile)
        self.groups = tile_groups(self.entries.lists)
        self._inside = self.tiles_of(colors.new_ones((*self.size, 1)))[:, 0]

    def steps(self, backwards: bool = False) -> Iterator[Pairs]:
        """Yield the steps: in every tile nearer entries come first, or farther ones, but the nearer within a step."""
        for group in self.groups:
            blend = self.blender.blend(group)
            with acquired_buffers(3, group.slab, self.blender.table.dtype) as scratch:
                for step in reversed(blend.steps) if backwards else blend.steps:
                    yield self._pairs(group, step.rows, step.blocks, self.blender.again(group, step, scratch))
                    release_buffer(step.transmittance)

    def color_dot_grads(self, background: Tensor) -> Iterator[tuple[Pairs, Tensor]]:
        """Yield the steps back to front, with how far every splat's colour exceeds the light from behind it.

        With B_m = background behind a pixel's last splat and B_{i-1} = alpha_i c_i + (1 - alpha_i) B_i, that is
        c_i - B_i = dC/dalpha_i / T_i.

        Args:
            background: colour behind everything. [D]

        Yields:
            Pairs, and the differences. [D, n, K, P]
        """
        n_tiles, n_pixels = self._inside.shape
        behind = background.to(self._inside.dtype)[:, None, None].expand(-1, n_tiles, n_pixels).clone()
        for pairs in self.steps(backwards=True):
            passing = behind.index_select(1, pairs.tiles)
            colors = pairs.colors.permute(2, 1, 0)[..., None]
            color_dot_grad = behind.new_empty((len(behind), *pairs.alpha.shape))
            for k in range(pairs.alpha.shape[1] - 1, -1, -1):
                torch.sub(colors[:, k], passing, out=color_dot_grad[:, :, k])
                passing.addcmul_(pairs.alpha[:, k], color_dot_grad[:, :, k])
            behind.index_copy_(1, pairs.tiles, passing)
            yield pairs, color_dot_grad

    def _pairs(self, group: TileGroup, chosen: Tensor | None, blocks: Tensor, made: list[Tensor]) -> Pairs:
        entries, alpha, weight, scratch = made
        tiles = (group.tiles if chosen is None else group.tiles[chosen])[: len(blocks)]
        inside = self._inside.index_select(0, tiles)[:, None]
        rows = (BLOCK * blocks[:, :, None] + torch.arange(BLOCK)).view(len(blocks), -1)
        coefficients = entries.view(-1, entries.shape[2])[:, :6]
        ids, colors = self.entries.lists.ids[rows], entries[:, :, 6:-1]
        return Pairs(tiles, rows, ids, coefficients, colors, alpha.mul_(inside), weight.mul_(inside), scratch)

    def offsets(self, pairs: Pairs) -> tuple[Tensor, Tensor]:
        """Return how far every splat's centre is from every pixel's, along x and y, px. [n, K, P] each"""
        basis = self.blender.basis
        u, v = (t[pairs.rows].to(basis.dtype)[:, :, None] for t in (self.entries.u, self.entries.v))
        return u - basis[1], v - basis[2]

    def tiles_of(self, image: Tensor) -> Tensor:
        """Cut an image [H, W, C] into tiles, zero off the image. [tiles, C, P]"""
        (height, width), lists, channels = self.size, self.lists, image.shape[2]
        size = lists.tile_size
        whole = image.new_zeros((lists.tiles_y * size, lists.tiles_x * size, channels))
        whole[:height, :width] = image
        grid = whole.view(lists.tiles_y, size, lists.tiles_x, size, channels).permute(0, 2, 4, 1, 3)
        return grid.reshape(lists.tiles_y * lists.tiles_x, channels, size * size)

    def image_of(self, tiles: Tensor) -> Tensor:
        """Put an image [H, W] together from its tiles [tiles, P]."""
        (height, width), lists = self.size, self.lists
        grid = tiles.view(lists.tiles_y, lists.tiles_x, lists.tile_size, lists.tile_size).transpose(1, 2)
        return grid.reshape(lists.tiles_y * lists.tile_size, -1)[:height, :width]


class EntryRows:
    """One row of sums an entry, added up for every splat."""

    def __init__(self, walk: PairWalk, columns: int) -> None:
        self._ids, self._n = walk.entries.lists.ids, walk.n_splats
        self._columns = walk.blender.table.new_zeros((columns, len(self._ids)))

    def put(self, pairs: Pairs, sums: list[Tensor]) -> None:
        """Write down what a step's entries sum up, [n, K] each."""
        rows = pairs.rows.reshape(-1)
        for column, values in zip(self._columns, sums, strict=True):
            column.index_copy_(0, rows, values.reshape(-1))

    def totals(self) -> Tensor:
        """Add up the rows of every splat. [N, columns] float64"""
        totals = torch.zeros((len(self._columns), self._n + 1), dtype=torch.float64)
        for total, column in zip(totals, self._columns, strict=True):
            total.scatter_add_(0, self._ids, column.double())
        return totals[:, :-1].T


def _background_or_black(background: Tensor | None, colors: Tensor) -> Tensor:
    """See `pop_ref.compositing.background_or_black`; in the precision of the colours. [D]"""
    behind = colors.new_zeros(colors.shape[1]) if background is None else background.to(colors.dtype)
    if behind.shape != colors.shape[1:]:
        raise ValueError(f"background has shape {list(behind.shape)}; it must be {list(colors.shape[1:])}, as a colour")
    return behind


@dataclass(frozen=True)
class DominantPoints:
    """See `pop_ref.chord.DominantPoints`."""

    points: Tensor  # on the rays, world units; 0 where no Gaussian competes. [H, W, 3]
    ids: Tensor  # the Gaussian of each pixel, -1 where none competes. [H, W] int64
    T_final: Tensor  # light that is left behind all that is blended. [H, W]


def chord_midpoint(mean: Tensor, quat: Tensor, scale: Tensor, origin: Tensor, direction: Tensor) -> Tensor:
    """See `pop_ref.chord.chord_midpoint`. Optimizations: any leading axes. [...]"""
    a = _whitened(quat, scale, origin - mean)
    b = _whitened(quat, scale, direction)
    return -(a * b).sum(-1) / (b * b).sum(-1)


def _whitened(quat: Tensor, scale: Tensor, vector: Tensor) -> Tensor:
    """Return diag(1/s) R^T v. [..., 3]"""
    R = rotmats_from_quats(quat.reshape(-1, 4)).reshape(*quat.shape[:-1], 3, 3)
    return (R * vector[..., :, None]).sum(-2) / scale


def _dominant_ids(
    splats: Splats, lists: TileLists, camera: Camera, profile: Profile, facing: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the splat with the largest weight of those that face each pixel's ray, -1 for none, and T_final. [H, W]"""
    walk = PairWalk(splats, lists, camera.width, camera.height, profile)
    facing = torch.cat((facing, facing.new_zeros((1, 3))))
    directions = walk.tiles_of(ray_directions(camera, profile).to(facing.dtype))
    best, T = directions.new_zeros(len(directions), directions.shape[2]), directions.new_ones(directions[:, 0].shape)
    ids = torch.full(best.shape, -1)
    for pairs in walk.steps():
        torch.bmm(facing[pairs.ids], directions.index_select(0, pairs.tiles), out=pairs.scratch)
        competing = pairs.scratch.le_(0.0).mul_(pairs.weight)
        largest, place = competing.max(1)
        before = best.index_select(0, pairs.tiles)
        # strictly larger: on equal weights the entry in front keeps the pixel (D8)
        wins = largest > before
        best.index_copy_(0, pairs.tiles, torch.where(wins, largest, before))
        winners = pairs.ids.gather(1, place)
        ids.index_copy_(0, pairs.tiles, torch.where(wins, winners, ids.index_select(0, pairs.tiles)))
        T.index_copy_(0, pairs.tiles, T.index_select(0, pairs.tiles) * (1.0 - pairs.alpha).prod(1))
    return walk.image_of(ids), walk.image_of(T)


def dominant_points(
    splats: Splats,
    lists: TileLists,
    gaussians: Gaussians,
    camera: Camera,
    tile_size: int,
    profile: Profile = PAPER,
    *,
    find: Callable[..., tuple[Tensor, Tensor]] = _dominant_ids,
) -> DominantPoints:
    """See `pop_ref.chord.dominant_points`. A Gaussian with a scale of 0 does not compete.

    Optimizations: see the module's text; a group of tiles and a block of list entries at a time.
    """
    check_grid(lists, camera.width, camera.height, tile_size)
    dtype = splats.means2d.dtype
    ids, T_final = find(splats, lists, camera, profile, towards_camera(gaussians, camera).to(dtype))
    return DominantPoints(points_on_rays(ids, gaussians, camera, profile).to(dtype), ids, T_final)


def towards_camera(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return g in the camera's axes: t* of a ray d has the sign of -(g . d), nan where a scale is 0. [N, 3] float64"""
    means, quats, scales = (t.double() for t in (gaussians.means, gaussians.quats, gaussians.scales))
    viewmat = camera.viewmat.double()
    a = _whitened(quats, scales, camera_center(viewmat) - means)
    g = (rotmats_from_quats(quats) * (a / scales)[:, None, :]).sum(2)
    flat = (scales == 0.0).any(1, keepdim=True)
    return (g @ viewmat[:3, :3].T).masked_fill(flat, torch.nan)


def ray_directions(camera: Camera, profile: Profile) -> Tensor:
    """Return where the rays through the pixels' centres point, in the camera's axes, z being 1. [H, W, 3] float64"""
    fx, fy, cx, cy = intrinsics(camera.K, camera.width, camera.height, profile)
    like = {"dtype": torch.float64, "device": camera.K.device}
    x = (torch.arange(camera.width, **like) + (0.5 - cx)) / fx
    y = (torch.arange(camera.height, **like) + (0.5 - cy)) / fy
    across, down = torch.meshgrid(x, y, indexing="xy")
    return torch.stack((across, down, torch.ones_like(down)), 2)


def points_on_rays(ids: Tensor, gaussians: Gaussians, camera: Camera, profile: Profile) -> Tensor:
    """Return the point at t* of each pixel's Gaussian, 0 where its id [H, W] is -1. [H, W, 3] float64"""
    viewmat = camera.viewmat.double()
    found = ids >= 0
    chosen = ids[found]
    directions = torch.nn.functional.normalize(ray_directions(camera, profile)[found], dim=1) @ viewmat[:3, :3]
    means, quats, scales = (t.double()[chosen] for t in (gaussians.means, gaussians.quats, gaussians.scales))
    origin = camera_center(viewmat)
    t = chord_midpoint(means, quats, scales, origin, directions)
    points = viewmat.new_zeros((*ids.shape, 3))
    points[found] = origin + t[:, None] * directions
    return points
