# minutes: 30

# %% [markdown]
# # 4b. Which splats a pixel looks at: tiles, sorting, keys
#
# Chapter 4 blended a list of splats in the order of their depth. At the end of this chapter you know where that list
# comes from: how a screen is cut into tiles, how a splat finds its tiles, and how one sort of whole numbers puts all
# lists of all tiles in order.
#
# ## Too many pairs
#
# A photograph has a million pixels and a scene a million Gaussians. To ask for each pair whether the splat reaches the
# pixel would be $10^{12}$ questions; to sort a million splats for every pixel would be worse. 3DGS (section 6) shares
# the work: it cuts the screen into *tiles*, squares of 16 by 16 pixels. Splats are assigned to tiles, not pixels; all
# 256 pixels of a tile walk through the same list; and that list is sorted once.
#
# The price is that a pixel also meets splats of its tile that do not reach it. They are skipped there, by the floor of
# 1/255, so **the picture does not depend on the tiles**: they are a way to find it sooner.

# %%
from itertools import pairwise

import numpy as np

from pop_ref.constants import PAPER
from pop_ref.footprint import conics_from_covars2d, radii_from_covars2d
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render
from pop_ref.tiles import grid_size, tile_lists, tile_rects
from pop_ref.walkthrough.bugs import caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, INK, SECOND, axes, show_image

K = np.array([[60.0, 0.0, 40.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]])
camera = Camera(np.eye(4), K, 80, 48)
rng = np.random.default_rng(8)
scene = Gaussians(
    means=rng.uniform([-2.4, -1.4, 3.0], [2.4, 1.4, 6.0], (150, 3)),
    quats=rng.normal(size=(150, 4)),
    scales=rng.uniform(0.04, 0.3, (150, 3)),
    opacities=rng.uniform(0.2, 0.95, 150),
    sh=rng.normal(size=(150, 1, 3)),
)
views = {size: render(scene, camera, np.ones(3), tile_size=size) for size in (4, 8, 16, 32, 80)}
for view in views.values():
    assert np.allclose(view.image, views[16].image, rtol=0, atol=1e-14)
print("tiles of 16 px:", grid_size(80, 48, 16))
print("entries in all lists:", sum(map(len, views[16].tile_lists)))

# %% [markdown]
# ## From a splat to its tiles
#
# Chapter 1 gave each splat an *extent*: a rectangle, `radii` to either side of its centre, outside of which its alpha
# is under the floor (decision D2). The tiles that the rectangle overlaps get the splat (decision D3). Along each axis
# that is a division, rounded down for the first tile and up for the one past the last:
#
# {{source: pop_ref.tiles.tile_span}}
#
# The other branch, "square", is that of the first 3DGS program, which draws a square of three standard deviations.

# %%
covar2d = np.array([[[90.0, 60.0], [60.0, 55.0]]])
centre, radii = np.array([[43.0, 25.0]]), radii_from_covars2d(covar2d, np.array([0.9]))
x0, y0, x1, y1 = tile_rects(centre, radii, 80, 48, 16)[0].tolist()
print(f"radii {radii[0]}; tiles {x0} to {x1 - 1} across and {y0} to {y1 - 1} down")


def reaches(tile_x: int, tile_y: int) -> bool:
    """Tell whether some pixel of a tile is over the floor."""
    px, py = np.meshgrid(16 * tile_x + np.arange(16) + 0.5, 16 * tile_y + np.arange(16) + 0.5)
    A, B, C = conics_from_covars2d(covar2d)[0]
    dx, dy = centre[0, 0] - px, centre[0, 1] - py
    alpha = 0.9 * np.exp(-(0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy))
    return bool((alpha >= PAPER.alpha_floor).any())


touched = {(x, y) for y in range(y0, y1) for x in range(x0, x1)}
needed = {(x, y) for y in range(3) for x in range(5) if reaches(x, y)}
print(f"{len(touched)} tiles, {len(needed)} of them needed")
assert needed < touched

fig, ax = axes(1, width=5.4, height=3.3)
for x, y in touched:
    shade = ACCENT if (x, y) in needed else SECOND
    across, down = 16 * np.array([x, x + 1, x + 1, x]), 16 * np.array([y, y, y + 1, y + 1])
    ax.fill(across, down, color=shade, alpha=0.25)
turn = np.linspace(0, 2 * np.pi, 200)
k = np.sqrt(2 * np.log(255 * 0.9))
ellipse = centre[0][:, None] + k * np.linalg.cholesky(covar2d[0]) @ np.stack(
    [np.cos(turn), np.sin(turn)]
)
ax.plot(*ellipse, color=INK, lw=1.6)
(u, v), (rx, ry) = centre[0], radii[0]
across, down = (
    [u - rx, u + rx, u + rx, u - rx, u - rx],
    [v - ry, v - ry, v + ry, v + ry, v - ry],
)
ax.plot(across, down, "--", color=INK, lw=1)
ax.set(
    xlim=(0, 80), ylim=(48, 0), xticks=range(0, 81, 16), yticks=range(0, 49, 16), aspect="equal"
)
ax.set(xlabel="x, px", ylabel="y, px")
picture(
    fig,
    "A splat, where its alpha falls under the floor (ellipse), its extent (dashed) and its tiles. Orange tiles are "
    "listed for nothing; Speedy-Splat tests the ellipse itself and leaves them out.",
)

# %% [markdown]
# ## One sort for everything
#
# Now each tile needs its splats in the order of depth. A GPU sorts one long list faster than many short ones, so the
# lists of all tiles are made by *one* sort. For every pair of a splat and a tile that it overlaps, write an *entry*:
# the splat's index, and a *key*, a whole number of 64 bits:
#
# $$\text{key} = \underbrace{\text{tile}}_{\text{upper 32 bits}} \;\Big|\;
# \underbrace{\text{bits of the depth}}_{\text{lower 32 bits}}$$
#
# Sort the entries by key. Then all entries of tile 0 come first, by depth among each other, then those of tile 1, and
# so on; where the tile changes, a list ends. That the bits of a depth can be compared as a whole number is a property
# of the IEEE format: for positive floating-point numbers, larger means larger bits. (A GPU's radix sort never compares
# two keys; it deals them into piles digit by digit, in time proportional to their number.)

# %%
depths = np.array([0.01, 0.5, 1.0, 1.0000001, 3.14159, 1e6], dtype=np.float32)
bits = depths.view(np.uint32)
for depth, b in zip(depths, bits, strict=True):
    print(f"{depth:14.8g}  {b:032b}")
assert np.all(np.diff(bits.astype(np.int64)) > 0)


def sorted_lists(splats, width: int, height: int, size: int) -> list[list[int]]:
    """List every tile's splats front to back, by one sort of 64-bit keys."""
    tiles_x, tiles_y = grid_size(width, height, size)
    rects = tile_rects(splats.means2d, splats.radii, width, height, size)
    keys, ids = [], []
    for i, (x0, y0, x1, y1) in enumerate(rects.tolist()):
        depth = int(np.float32(splats.depths[i]).view(np.uint32))
        for y in range(y0, y1):
            for x in range(x0, x1):
                keys.append((y * tiles_x + x) << 32 | depth)
                ids.append(i)
    order = np.argsort(np.array(keys, dtype=np.uint64), kind="stable")
    keys, ids = np.array(keys, dtype=np.uint64)[order], np.array(ids)[order]
    # where each tile's entries begin
    begins = np.searchsorted(
        keys, np.arange(tiles_x * tiles_y + 1, dtype=np.uint64) << np.uint64(32)
    )
    return [ids[a:b].tolist() for a, b in pairwise(begins)]


splats = views[16].splats
mine = sorted_lists(splats, 80, 48, 16)
theirs = tile_lists(splats.means2d, splats.radii, splats.depths, 80, 48, 16)
assert mine == theirs
print(f"{sum(map(len, mine))} entries of {np.sum(splats.visible)} splats in {len(mine)} lists")

# %% [markdown]
# The oracle sorts the splats once by depth and then hands each to its tiles, which comes to the same:
#
# {{source: pop_ref.tiles.tile_lists}}
#
# ## Equal depths, and what depth means
#
# Two splats of one depth have one key, and a sort may return them either way. Training makes exact copies of Gaussians
# (chapter 9), which have equal depths, so it matters: the sort must be *stable*, that is keep the order of the indices
# (decision D4). If it is not, the same scene gives different pictures from run to run.
#
# And the depth is that of the *centre*. A long splat may be in front of another at one pixel and behind it at the next,
# but it is sorted once for the whole view. When the camera moves, the order of two centres flips at some moment, and
# the picture jumps a little: users of splat viewers know it as *popping*.


# %%
def crossing(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """See two long crossing splats from an angle; return a pixel's colour and the depths."""
    c, s = np.cos(angle), np.sin(angle)
    viewmat = np.array([[c, 0, -s, 0], [0, 1, 0, 0], [s, 0, c, 4.0], [0, 0, 0, 1.0]])
    two = Gaussians(
        np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]),
        np.array([[0.92, 0.0, 0.38, 0.0], [0.92, 0.0, -0.38, 0.0]]),
        np.array([[0.9, 0.3, 0.05]] * 2),
        np.array([0.8, 0.8]),
        np.array([[[1.4, -1.0, -1.4]], [[-1.4, -0.5, 1.4]]]),
    )
    view = render(
        two, Camera(viewmat, np.array([[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]]), 16, 16)
    )
    return view.image[8, 8], view.splats.depths


angles = np.linspace(-0.1, 0.1, 81)
reds = np.array([crossing(angle)[0][0] for angle in angles])
first = np.array([crossing(angle)[1].argmin() for angle in angles])
jump = np.abs(np.diff(reds)).max()
elsewhere = np.sort(np.abs(np.diff(reds)))[-2]
print(f"largest change between two angles {jump:.2f}, elsewhere at most {elsewhere:.4f}")
assert np.abs(np.diff(reds)).argmax() == np.abs(np.diff(first)).argmax()
assert jump > 0.2
assert elsewhere < 0.01 * jump

fig, ax = axes(1, width=5.0, height=2.3)
before = angles < 0
ax.plot(np.degrees(angles)[first == first[0]], reds[first == first[0]], color=ACCENT)
ax.plot(np.degrees(angles)[first != first[0]], reds[first != first[0]], color=ACCENT)
ax.set(xlabel="turn of the camera, degrees", ylabel="red of one pixel")
picture(
    fig,
    "Two crossing splats, seen from a camera that turns. Where their centres change order, the pixel jumps.",
)

# %% [markdown]
# ## Why sixteen?
#
# Small tiles fit the splats better: fewer are listed for nothing. But a splat is in more of them, so there are more
# entries to sort. Large tiles are the other way round. Sixteen also suits a GPU, in which 256 pixels are a block of
# threads that share the list in fast memory.

# %%
entries = {size: sum(map(len, view.tile_lists)) for size, view in views.items()}
visits = {size: view.n_traversed.sum() for size, view in views.items()}
print("tile size:            ", *(f"{size:7}" for size in views))
print("entries to sort:      ", *(f"{n:7}" for n in entries.values()))
print("visits of all pixels: ", *(f"{n:7}" for n in visits.values()))
assert list(entries.values()) == sorted(entries.values(), reverse=True)
assert list(visits.values()) == sorted(visits.values())

fig, (left, right) = axes(2, height=2.4, ticks=False)
for panel, size in ((left, 16), (right, 4)):
    shown = show_image(
        panel, views[size].n_traversed, f"visits per pixel, tiles of {size} px", vmin=0, vmax=60
    )
fig.colorbar(shown, ax=[left, right], shrink=0.8)
picture(
    fig,
    "What each pixel looks at before it is done. The picture that comes of it is the same to the last bit or so.",
)

# %% [markdown]
# ### Exercise 1: predict
# A Gaussian behind the camera has a negative depth, say $-2$. Where would its key put it, if it were not culled before
# (decision D1)?

# %% answer
# Last of its tile: the sign is the uppermost bit of a floating-point number, so as a whole number a negative depth is
# larger than every positive one. And among negative ones the order is reversed. Keys are in order only because what is
# behind the camera has been culled.
minus, farther, plus = np.array([-2.0, -3.0, 1e30], dtype=np.float32).view(np.uint32)
print(f"{minus:032b}\n{plus:032b}")
assert farther > minus > plus

# %% [markdown]
# ### Exercise 2: derive
# A splat has an extent of $r$ pixels to either side along both axes, with its centre anywhere. On average, how many
# tiles of side $s$ does it overlap? By what factor do the entries grow from $s = 16$ to $s = 8$ for $r = 8$?

# %% answer
# Along one axis an interval of length $2r$ overlaps $2r/s + 1$ tiles on average, since each of the borders, $s$ apart,
# is inside it with that frequency. So it is $(2r/s + 1)^2$: 4 for $s = 16$ and 9 for $s = 8$.
centres = rng.uniform(200.0, 300.0, (4000, 2))
extents = np.full((4000, 2), 8)
for size, wanted in ((16, 4.0), (8, 9.0)):
    a, b, c, d = tile_rects(centres, extents, 512, 512, size).T
    print(size, np.mean((c - a) * (d - b)))
    assert np.isclose(np.mean((c - a) * (d - b)), wanted, rtol=0.05)

# %% [markdown]
# ### Exercise 3: code
# How many of the 64 bits are used? Write a function that packs the tile into as few upper bits as it needs, and keeps
# only as many bits of the depth as fit into 32 in all. What goes wrong with the picture?


# %% answer
# 15 tiles need 4 bits, and 28 are left for the depth: the last four of its bits are lost. Depths that differ by less
# than about two millionths of their size count as equal and keep the order of their indices. Here nothing changes.
def short_key(tile: int, depth: float, n_tiles: int) -> int:
    bits_of_tile = max(1, (n_tiles - 1).bit_length())
    return tile << (32 - bits_of_tile) | int(np.float32(depth).view(np.uint32)) >> bits_of_tile


for tile, ids in enumerate(theirs):
    keys = [short_key(tile, splats.depths[i], len(theirs)) for i in ids]
    assert keys == sorted(keys)
    assert all(key < 2**32 for key in keys)
assert short_key(3, 1.0, 15) == short_key(3, 1.0000001, 15)

# %% [markdown]
# ### Exercise 4: find the bug
# One expression of this function is wrong. Which splats are affected, and what would their users see?
#
# {{bug: edge_exact_splat_dropped}}

# %% answer
# The last tile is rounded down, so a splat whose extent ends inside a tile loses that tile: colour and gradient are cut
# off along a straight edge. The law tries splats that end just inside a tile.
print(caught("edge_exact_splat_dropped"))
