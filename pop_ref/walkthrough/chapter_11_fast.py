# minutes: 40

# %% [markdown]
# # 11. From oracle to fast: tiles, matrix products, six sums
#
# The oracle visits one pixel and one splat at a time. At the end of this chapter you know how the same numbers come out
# of a few large array operations: the exponent as a matrix product, blending as a scan in place, the image as another
# product, and the whole backward pass as one recurrence and six sums. Every step is held to the oracle.
#
# ## One tile
#
# Screens are cut into tiles of 16 by 16 pixels, because all pixels of a tile share one list of splats, front to back.
# Take one tile, its 256 pixels and a list of 40. That is 10,240 pairs of a splat and a pixel, and each pair asks for
# the same dozen floating-point operations: work for arrays.

# %% setup
import time

import numpy as np
import torch

from pop_fast.stages import compositing as fast
from pop_fast.stages import tiles as fast_tiles
from pop_ref.alpha import alpha_from_sigma, sigma_at_pixel
from pop_ref.compositing import composite, composite_vjp
from pop_ref.constants import PAPER
from pop_ref.footprint import conics_from_covars2d, radii_from_covars2d
from pop_ref.pixel import SplatRows, composite_pixel, zero_gradients
from pop_ref.records import Splats
from pop_ref.tiles import tile_lists
from pop_ref.walkthrough.bugs import broken, caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import DIVERGING, SECOND, axes, show_image

TILE = 16


def random_splats(n, size, seed, widest=6.0):
    """Draw n splats on a screen of size by size px, front to back."""
    rng = np.random.default_rng(seed)
    turn, s = rng.uniform(0.0, np.pi, n), rng.uniform(1.2, widest, (n, 2))
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    covars = np.einsum("ijn,nj,kjn->nik", R, s**2, R)
    covars = 0.5 * (covars + covars.transpose(0, 2, 1))
    opacities = rng.choice([0.3, 0.6, 0.9, 0.99], n)
    radii = radii_from_covars2d(covars, opacities)
    means, colors = rng.uniform(0.0, size, (n, 2)), rng.uniform(0.0, 1.0, (n, 3))
    depths = np.sort(rng.uniform(1.0, 9.0, n))
    return Splats(means, depths, conics_from_covars2d(covars), opacities, colors, radii)


# %%
splats, white = random_splats(40, TILE, seed=5), np.ones(3)
lists = tile_lists(splats.means2d, splats.radii, splats.depths, TILE, TILE, TILE)
oracle = composite(splats, lists, TILE, TILE, TILE, background=white)
ids = lists[0]
assert ids == list(range(40))
assert len(ids) * TILE * TILE == 10240

# %% [markdown]
# ## The exponent is a matrix product
#
# For splat $k$ with centre $(u, v)$, conic $(A, B, C)$ and opacity $o$, the alpha at pixel $(x, y)$ is (POP paper, eq.
# 11)
#
# $$\alpha = o \exp\left(-\tfrac{1}{2} A (u - x)^2 - B (u - x)(v - y) - \tfrac{1}{2} C (v - y)^2\right) .$$
#
# Put $o$ into the exponent as $\ln o$ and multiply out: what is left is a polynomial of second degree in $x$ and $y$.
# So the exponent is a dot product of six coefficients, which belong to the splat, with six numbers that belong to the
# pixel, $p = (1, x, y, x^2, xy, y^2)$:
#
# $$\ln \alpha_{kp} = f_k \cdot p, \qquad f = \left(\ln o - \tfrac{1}{2} (g_x u + g_y v),\; g_x,\; g_y,\;
# -\tfrac{1}{2} A,\; -B,\; -\tfrac{1}{2} C\right),$$
#
# where $g_x = A u + B v$ and $g_y = B u + C v$.
#
# For a tile, $F$ is 40 by 6 and $P$ is 6 by 256, and one product gives all 10,240 exponents. $x$ and $y$ count from the
# tile's centre, which keeps them small, so $P$ is the same for every tile. Then two limits: an alpha under the floor
# 1/255 becomes 0, one over the ceiling 0.999 becomes that.

# %%
at = np.arange(TILE) + 0.5 - TILE / 2
y, x = (axis.ravel() for axis in np.meshgrid(at, at, indexing="ij"))
P = np.stack([np.ones(TILE * TILE), x, y, x * x, x * y, y * y])


def coefficients(splats, ids, center):
    """Return the six coefficients of ln alpha, from a given origin. [K, 6]"""
    (u, v), (A, B, C) = (splats.means2d[ids] - center).T, splats.conics[ids].T
    gx, gy = A * u + B * v, B * u + C * v
    constant = np.log(splats.opacities[ids]) - 0.5 * (gx * u + gy * v)
    return np.stack([constant, gx, gy, -0.5 * A, -B, -0.5 * C], axis=1)


center = np.array([TILE / 2, TILE / 2])
alpha = np.exp(coefficients(splats, ids, center) @ P)
alpha = np.where(alpha < PAPER.alpha_floor, 0.0, np.minimum(alpha, PAPER.alpha_ceiling))

for k in ids:
    for j in range(TILE * TILE):
        px, py = j % TILE + 0.5, j // TILE + 0.5
        sigma = sigma_at_pixel(splats.means2d[k], splats.conics[k], px, py)
        wanted, skipped = alpha_from_sigma(sigma, splats.opacities[k])
        assert abs(alpha[k, j] - (0.0 if skipped else wanted)) < 1e-12

fig, panels = axes(7, height=1.5, ticks=False)
names = ("$1$", "$x$", "$y$", "$x^2$", "$xy$", "$y^2$")
for panel, row, name in zip(panels, P, names, strict=False):
    most = np.abs(row).max()
    show_image(panel, row.reshape(TILE, TILE), name, vmin=-most, vmax=most, cmap=DIVERGING)
show_image(panels[6], alpha[6].reshape(TILE, TILE), "alpha of one", vmin=0, vmax=1)
picture(
    fig,
    "The six rows of $P$ as pictures of the tile. Every exponent is a weighted sum of these six; the last panel is "
    "$\\exp$ of one such sum, cut at the floor.",
)

# %% [markdown]
# ## Blending is a scan in place
#
# A pixel blends front to back: $w_k = T_k \alpha_k$, $T_{k+1} = T_k - w_k$ (POP paper, eq. 1). The order of the splats
# matters, the order of the pixels does not. So the loop runs over the list, and each turn treats 256 pixels at once.
# Stopping needs no branch either: where the next $T$ would be $10^{-4}$ or less, the splat is not blended and the pixel
# ends (section 3.1), which is the same as setting its $T$ to 0 there, for all that follows is then multiplied by 0.
#
# The weights fill a matrix $\Omega$, one row a splat, one column a pixel. With it the image is a product, the dominant
# splat (eq. 5) is the largest entry of a column, and a count of non-zeros is the number of splats blended.


# %%
def scan(alpha):
    """Return weights, and alphas set to 0 from where a pixel stops. [K, P] each"""
    weight, alpha, T = np.zeros_like(alpha), alpha.copy(), np.ones(alpha.shape[1])
    for k in range(len(alpha)):
        np.multiply(T, alpha[k], out=weight[k])
        T -= weight[k]
        ended = np.less_equal(T, PAPER.transmittance_stop)
        T[ended] = weight[k, ended] = alpha[k, ended] = 0.0
    return weight, alpha


weights, alpha = scan(alpha)
T_final = 1.0 - weights.sum(axis=0)
c = splats.colors[ids]
image = (c.T @ weights).T + T_final[:, None] * white

assert np.allclose(image.reshape(TILE, TILE, 3), oracle.image, rtol=0, atol=1e-12)
assert np.allclose(T_final.reshape(TILE, TILE), oracle.T_final, rtol=0, atol=1e-12)
# argmax takes the first of equals, which is the front one
assert np.array_equal(weights.argmax(axis=0).reshape(TILE, TILE), oracle.dominant_ids)
assert np.array_equal((weights > 0.0).sum(axis=0).reshape(TILE, TILE), oracle.n_blended)
stopped = (oracle.n_traversed < 40).mean()
assert 0.05 < stopped < 0.95

fig, panels = axes(2, height=2.9, width_ratios=[2.6, 1])
reach = oracle.n_traversed.ravel()
order = np.argsort(reach, kind="stable")
shown = np.log10(np.where(weights > 0.0, weights, np.nan))[:, order]
shade = panels[0].imshow(shown, aspect="auto", vmin=-4, vmax=0)
panels[0].plot(reach[order] - 0.5, color=SECOND, lw=1.5)
panels[0].set(xlabel="pixel, early stoppers first", ylabel="place in the list")
panels[0].set_title("weights, log10")
panels[0].grid(False)
fig.colorbar(shade, ax=panels[0], pad=0.02)
show_image(panels[1], image.reshape(TILE, TILE, 3), "the tile")
panels[1].set(xticks=[0, 8, 16], yticks=[0, 8, 16])
picture(
    fig,
    "Left: the weight matrix; blank is zero, because of the floor or because the pixel has stopped. The line is how "
    "far the oracle looked. Right: colours times weights, the image of the tile.",
)

# %% [markdown]
# ## Backward with one number per pixel
#
# Let $g$ be the gradient of the loss with respect to a pixel's colour. That with respect to $\alpha_k$ compares the
# splat's colour with the colour behind it, $b_k$, which is everything after $k$ as seen without $k$ (derivative of eq.
# 1, [chapter 5](chapter_05_backward_by_hand.py)):
#
# $$\frac{\partial L}{\partial \alpha_k} = T_k \, (c_k - b_k) \cdot g .$$
#
# Colours enter only through their product with $g$. So the three channels can be folded into one number first:
# $q_k = c_k \cdot g$ for all pairs is a product of two matrices, and $\beta_k = b_k \cdot g$ obeys, back to front,
#
# $$\beta_{k-1} = \beta_k + \alpha_k (q_k - \beta_k), \qquad \beta_{\mathrm{last}} = c_{\mathrm{background}} \cdot g .$$
#
# There is no division by $1 - \alpha$, which is small where splats are opaque, and POP makes them so. What we keep is
# $\Gamma_k = \alpha_k \, \partial L / \partial \alpha_k = w_k (q_k - \beta_k)$, as in chapter 5.

# %%
g = np.random.default_rng(1).normal(size=(TILE * TILE, 3))
v_of_tile = g.reshape(TILE, TILE, 3)
wanted = composite_vjp(splats, lists, TILE, TILE, TILE, v_of_tile, background=white)

q = c @ g.T
gain, beta = np.zeros_like(weights), white @ g.T
for k in reversed(range(40)):
    difference = q[k] - beta
    gain[k] = weights[k] * difference
    beta = beta + alpha[k] * difference

assert np.allclose(weights @ g, wanted.v_colors, rtol=1e-10, atol=1e-12)
v_opacities = gain.sum(axis=1) / splats.opacities
assert np.allclose(v_opacities, wanted.v_opacities, rtol=1e-10, atol=1e-12)

# %% [markdown]
# ## Geometry needs six sums
#
# Everything else reaches the loss through the exponent. Since $\ln \alpha = f \cdot p$, the gradient with respect to
# $f_k$ is $\sum_p \Gamma_{kp} \, p$: six sums over pixels,
#
# $$\Gamma P^\top = \left(\textstyle\sum \Gamma,\; \sum \Gamma x,\; \sum \Gamma y,\; \sum \Gamma x^2,\;
# \sum \Gamma x y,\; \sum \Gamma y^2\right),$$
#
# one more product, 40 by 256 times 256 by 6. From there to centre, conic and opacity is the chain rule through
# $f(u, v, A, B, C, o)$ with six numbers per splat, no longer with 256.

# %%
s0, sx, sy, sxx, sxy, syy = (gain @ P.T).T
(u, v), (A, B, C) = (splats.means2d - center).T, splats.conics.T
splat_u, splat_v = u, v
du, dv = u * s0 - sx, v * s0 - sy
v_means2d = -np.stack([A * du + B * dv, B * du + C * dv], axis=1)
v_a, v_c = -0.5 * (u * (du - sx) + sxx), -0.5 * (v * (dv - sy) + syy)
v_b = -(u * dv - v * sx + sxy)
v_conics = np.stack([v_a, v_b, v_c], axis=1)
assert np.allclose(v_means2d, wanted.v_means2d, rtol=1e-9, atol=1e-11)
assert np.allclose(v_conics, wanted.v_conics, rtol=1e-9, atol=1e-11)
print(f"largest gradient of a centre {np.abs(v_means2d).max():.3f}", end="; ")
print(f"off the oracle's by {np.abs(v_means2d - wanted.v_means2d).max():.0e}")

# %% [markdown]
# ## The real one
#
# `pop_fast.stages.compositing.composite` does this for all tiles of a screen. What it adds is bookkeeping: tiles of
# similar list length are treated together, a few list entries at a time, so that what is being worked on stays in the
# processor's cache; tiles whose pixels have all stopped drop out; and the backward pass keeps little and makes alphas
# again. In training it runs in float32; here in float64, against the oracle, on a screen of four tiles.

# %%
SCREEN = 32
many = random_splats(120, SCREEN, seed=2)
screen = (SCREEN, SCREEN, TILE)
v_image = np.random.default_rng(3).normal(size=(SCREEN, SCREEN, 3))
seconds = []
for _ in range(2):
    start = time.perf_counter()
    lists = tile_lists(many.means2d, many.radii, many.depths, *screen)
    oracle = composite(many, lists, *screen)
    wanted = composite_vjp(many, lists, *screen, v_image)
    seconds.append(time.perf_counter() - start)
oracle_seconds = min(seconds)

names = ("means2d", "conics", "opacities", "colors")
leaves = [torch.tensor(getattr(many, name), requires_grad=True) for name in names]
radii, depths = torch.tensor(many.radii), torch.tensor(many.depths)


def forward_and_backward():
    """Return the view, and leave gradients in the leaves."""
    means2d, conics, opacities, colors = leaves
    listed = fast_tiles.tile_lists(means2d.detach(), radii, depths, *screen)
    inputs = (means2d, conics, opacities, colors, listed, SCREEN, SCREEN)
    view = fast.composite(*inputs, dominance=True, counts=True)
    view.image.backward(torch.tensor(v_image))
    return view


found = forward_and_backward()
assert np.allclose(found.image.detach().numpy(), oracle.image, rtol=0, atol=1e-12)
assert np.array_equal(np.asarray(found.dominant_ids), oracle.dominant_ids)
assert np.array_equal(np.asarray(found.n_traversed), oracle.n_traversed)
for name, leaf in zip(names, leaves, strict=True):
    wish = getattr(wanted, f"v_{name}")
    assert np.allclose(np.asarray(leaf.grad), wish, rtol=1e-9, atol=1e-11)

# seconds are of this machine; the least of several is what other work on it disturbs least
seconds = []
for _ in range(5):
    start = time.perf_counter()
    forward_and_backward()
    seconds.append(time.perf_counter() - start)
fast_seconds = min(seconds)
print(f"forward and backward: oracle {oracle_seconds:.2f} s, fast {fast_seconds:.3f} s")

lengths = np.array([len(each) for each in lists]).reshape(2, 2)
listed = lengths.repeat(TILE, axis=0).repeat(TILE, axis=1)
fig, panels = axes(3, height=2.5)
limits = {"vmin": 0, "vmax": listed.max()}
shade = show_image(panels[0], listed, "in the tile's list", **limits)
show_image(panels[1], oracle.n_traversed, "looked at", **limits)
show_image(panels[2], oracle.n_blended, "blended", **limits)
for panel in panels:
    panel.set(xticks=[0, 16, 32], yticks=[0, 16, 32])
fig.colorbar(shade, ax=panels.tolist(), label="splats", shrink=0.8)
picture(
    fig,
    "What a pixel costs. Left: what is listed for it. Middle: what it looks at before it stops; POP acts here, since "
    "opaque splats stop pixels early. Right: what is above the floor too.",
)
assert (listed >= oracle.n_traversed).all()
assert (oracle.n_traversed >= oracle.n_blended).all()

# %% [markdown]
# ### Exercise 1: code
#
# Why count $x$ and $y$ from the tile's centre and not from the corner of the image? Take a needle (standard deviations
# 20 and 0.6 px, turned by 40 degrees) near pixel (1600, 900) and round the coefficients to float32 in both frames.

# %% answer
# The terms of the exponent are of the size of $1600^2 A$ there and cancel almost wholly. From the tile's centre they
# are of the size of $8^2 A$.
turn = np.deg2rad(40.0)
R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
covars = (R @ np.diag([20.0**2, 0.6**2]) @ R.T)[None]
covars = 0.5 * (covars + covars.transpose(0, 2, 1))
one, middle = np.ones((1, 1)), np.array([1608.0, 904.0])
conic, extent = conics_from_covars2d(covars), np.full((1, 2), 70)
needle = Splats(middle[None] + 3.0, one[0], conic, 0.9 * one[0], one, extent)
exact = coefficients(needle, [0], middle) @ P


def in_float32(origin):
    """Return the largest error of the exponent when its coefficients are rounded."""
    xo, yo = x + (middle - origin)[0], y + (middle - origin)[1]
    there = np.stack([np.ones_like(x), xo, yo, xo * xo, xo * yo, yo * yo])
    rounded = coefficients(needle, [0], origin).astype(np.float32).astype(np.float64)
    return np.abs(rounded @ there - exact).max()


assert in_float32(middle) < 1e-4
assert in_float32(np.zeros(2)) > 1e-2

# %% [markdown]
# ### Exercise 2: code
#
# AbsGS asks for the sum over pixels of the absolute value of each pixel's gradient with respect to the centre. Can it
# be had from the six sums? Compute it, and hold it to the oracle's `v_means2d_abs`.

# %% answer
# No: the absolute value is not linear, so all 256 pixels are needed. The sum is never smaller than the signed one.
wanted = composite_vjp(splats, [ids], TILE, TILE, TILE, v_of_tile, background=white)
u, v, A, B, C = (column[:, None] for column in (u, v, A, B, C))
along_x = np.abs(gain * (A * (u - x) + B * (v - y))).sum(axis=1)
along_y = np.abs(gain * (B * (u - x) + C * (v - y))).sum(axis=1)
absolute = np.stack([along_x, along_y], axis=1)
assert np.allclose(absolute, wanted.v_means2d_abs, rtol=1e-9, atol=1e-11)
assert (absolute >= np.abs(v_means2d) - 1e-12).all()
assert absolute.sum() > 2.0 * np.abs(v_means2d).sum()

# %% [markdown]
# ### Exercise 3: predict
# The tile of this chapter: how many multiplications and additions does the image take as a product, $3 \times 40$ by
# $40 \times 256$, and how many if every pixel loops over the splats that it blends? Which is faster in NumPy?

# %% answer
# The product takes $2 \cdot 3 \cdot 40 \cdot 256 = 61{,}440$, zeros included; the loop only those of the weights that
# are not zero, here about half. In NumPy the product is faster all the same, by the time measured below: it is one call
# instead of 256, and what a call costs by itself is more than these few operations do. That says nothing of compiled
# loops.
n_product, n_loop = 2 * 3 * 40 * 256, 2 * 3 * int(np.sum(weights > 0.0))
print(n_product, n_loop)
assert n_product == 61_440
assert 0.2 * n_product < n_loop < 0.9 * n_product


def by_pixel():
    """Loop over the pixels, each with the splats that it blends."""
    found = np.empty((weights.shape[1], 3))
    for pixel, column in enumerate(weights.T):
        blended = np.nonzero(column)[0]
        found[pixel] = column[blended] @ c[blended]
    return found


def least_seconds(function, times=20):
    """Time a function several times; the least is what other work disturbs least."""
    seconds = []
    for _ in range(times):
        began = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - began)
    return min(seconds)


assert np.allclose(by_pixel(), (c.T @ weights).T)
seconds = [least_seconds(lambda: (c.T @ weights).T), least_seconds(by_pixel)]
print(f"in NumPy: product {1e6 * seconds[0]:.0f} microseconds, loop {1e6 * seconds[1]:.0f}")
assert seconds[0] < seconds[1]

# %% [markdown]
# ### Exercise 4: derive
# From $f_1 = g_x = A u + B v$ and the other coefficients derive $\partial L / \partial u$ by the six sums, and see that
# it is the first component of `v_means2d` above.

# %% answer
# $u$ stands in $f_0 = \ln o - \frac12 (A u^2 + 2 B u v + C v^2)$ with derivative $-(A u + B v)$, in $f_1$ with $A$ and
# in $f_2 = B u + C v$ with $B$. So
#
# $$\frac{\partial L}{\partial u} = -(A u + B v)\, s_0 + A s_x + B s_y = -(A\, d_u + B\, d_v)$$
#
# with $d_u = u s_0 - s_x$ and $d_v = v s_0 - s_y$.
A, B, C = splats.conics.T
by_sums = -(A * splat_u + B * splat_v) * s0 + A * sx + B * sy
assert np.allclose(by_sums, v_means2d[:, 0])

# %% [markdown]
# ### Exercise 5: find the bug
# Fast programs remember where each pixel stopped and start the backward pass there. What is lost here?
#
# {{bug: stale_last_contributor}}

# %% answer
# The walk begins one splat too early in the list, so the last splat that a pixel blended gets no gradient from it, and
# those before it get one as if the background lay where it is. Nothing crashes, and no picture shows it (chapter 12
# draws one).
two = SplatRows([[0.5, 0.5]] * 2, [[1.0, 0.0, 1.0]] * 2, [0.5, 0.5], [[1.0], [0.25]])
at, totals = (0.5, 0.5, [0.0]), zero_gradients(2, 1)
walk = broken("stale_last_contributor", "composite_pixel_vjp")
walk(composite_pixel([0, 1], two, *at), two, *at, [1.0], 0.0, totals)
# 7/8 and 1/8 are right: T (c - b)
assert totals.v_opacities.tolist() == [1.0, 0.0]
print(caught("stale_last_contributor"))
