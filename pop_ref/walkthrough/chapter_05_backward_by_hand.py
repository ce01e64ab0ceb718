# minutes: 40

# %% [markdown]
# # 5. The backward pass, by hand
#
# Training needs the derivative of the loss with respect to every number of every Gaussian. At the end of this chapter
# you can derive it for a pixel on paper, you know the one scalar that walks from back to front and carries all of it,
# and you have two ways to convince yourself that a hand-written gradient is right.

# %% [markdown]
# ## One pixel, three splats
#
# A pixel is $C = \sum_i T_i \alpha_i c_i + T_{\mathrm{final}}\, b$ with $T_1 = 1$ and $T_{i+1} = T_i (1 - \alpha_i)$
# (POP paper, eq. 1, with a background $b$). What happens if one $\alpha_i$ grows a little? Splat $i$ shows more of its
# own colour, and everything behind it is dimmed. Call $b_i$ the light that arrives at the back of splat $i$. Then
#
# $$\frac{\partial C}{\partial \alpha_i} = T_i \,(c_i - b_i), \qquad b_{i-1} = \alpha_i c_i + (1 - \alpha_i) b_i,
# \qquad b_m = b .$$
#
# The recurrence is eq. 1 read from back to front. Take three grey splats of alpha 1/2 and colours 1/2, 1/4 and 1 over
# black. On paper: $T = (1, 1/2, 1/4)$; from the back $b_3 = 0$, $b_2 = 1/2$, $b_1 = 3/8$; so the derivatives are $1/8$,
# $-1/8$ and $1/4$. The middle splat is darker than what it covers: the pixel would be brighter without it.

# %%
from dataclasses import replace

import numpy as np

from pop_ref.alpha import (
    alpha_from_sigma,
    alpha_from_sigma_vjp,
    sigma_at_pixel,
    sigma_at_pixel_vjp,
)
from pop_ref.compositing import composite_pixel, composite_pixel_vjp, composite_vjp
from pop_ref.pixel import SplatRows, rows_from_splats, zero_gradients
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render, render_vjp
from pop_ref.walkthrough.bugs import caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, DIVERGING, INK, MUTED, SECOND, axes, show_image


def stack(alphas, greys):
    """Put splats one behind the other, all centred on the pixel, so that alpha is the opacity."""
    n = len(alphas)
    return SplatRows(
        [[0.5, 0.5]] * n, [[1.0, 0.0, 1.0]] * n, alphas, [[grey] for grey in greys]
    )


def v_alphas_of(rows, background):
    """Differentiate the grey pixel with respect to each alpha, with the oracle's transpose."""
    n = len(rows.opacities)
    pixel = composite_pixel(range(n), rows, 0.5, 0.5, [background])
    totals = zero_gradients(n, 1)
    composite_pixel_vjp(pixel, rows, 0.5, 0.5, [background], [1.0], 0.0, totals)
    return totals.v_opacities


three = stack([0.5, 0.5, 0.5], [0.5, 0.25, 1.0])
assert composite_pixel([0, 1, 2], three, 0.5, 0.5, [0.0]).color == [7 / 16]
assert v_alphas_of(three, 0.0).tolist() == [1 / 8, -1 / 8, 1 / 4]

# %% [markdown]
# With three channels little changes. Let $g = \partial L / \partial C$ be the gradient of a loss $L$ with respect to
# the pixel. Only the product of a colour with $g$ counts, $q_i = c_i \cdot g$. With the same product of the light
# behind, $\beta_i = b_i \cdot g$,
#
# $$\frac{\partial L}{\partial \alpha_i} = T_i\,(q_i - \beta_i),
# \qquad \frac{\partial L}{\partial c_i} = T_i \alpha_i\, g .$$
#
# So one scalar, walked from back to front, is all that the backward pass of a pixel carries, however many channels it
# has. In the oracle $q_i$ is `color_dot_grad` and the scalar $\beta_i$ is `suffix_dot_grad`. It starts with the
# background. Where a loss reads the remaining light $T_{\mathrm{final}}$ itself, as one of the opacity does, its
# cotangent is light behind the last splat like any other: $\beta_n = b \cdot g + v_{T_{\mathrm{final}}}$. The last
# lines belong to the next section. `v_means2d_abs` there is no cotangent: it adds up, over pixels, the *sizes* of what
# each pixel gives to a centre, so that two pixels that pull in opposite directions do not cancel (AbsGS).
#
# {{source: pop_ref.pixel.composite_pixel_vjp}}

# %%
rng = np.random.default_rng(5)
n = 9
ray = stack(rng.uniform(0.1, 0.6, n).tolist(), rng.uniform(0.05, 1.0, n).tolist())
pixel = composite_pixel(range(n), ray, 0.5, 0.5, [0.3])
T, alphas, q = np.array(pixel.transmittances), np.array(pixel.alphas), np.ravel(ray.colors)

# the walk, with g = 1
beta = np.full(n, 0.3)
for i in reversed(range(1, n)):
    beta[i - 1] = alphas[i] * q[i] + (1.0 - alphas[i]) * beta[i]
v_alphas = T * (q - beta)
print("light behind", beta.round(3))
print("derivatives ", v_alphas.round(3))
np.testing.assert_allclose(v_alphas, v_alphas_of(ray, 0.3), rtol=1e-12)
# a cotangent of the remaining light is light behind the last splat, as the background is
totals = [zero_gradients(n, 1) for _ in range(2)]
for total, behind, v_T in zip(totals, (0.25, 0.75), (0.5, 0.0), strict=True):
    composite_pixel_vjp(pixel, ray, 0.5, 0.5, [behind], [1.0], v_T, total)
np.testing.assert_allclose(totals[0].v_opacities, totals[1].v_opacities, rtol=1e-12)
# the pixel grows with a splat's alpha exactly where the splat is brighter than what it covers
assert np.array_equal(v_alphas > 0.0, q > beta)

fig, (left, right) = axes(2, height=3.0)
where = np.arange(1, n + 1)
left.bar(where, q, color=[str(grey) for grey in q], edgecolor=MUTED, label=r"the splat, $q_i$")
left.plot(where, beta, color=SECOND, marker="o", ms=4, label=r"light behind $\beta_i$")
left.set(xlabel="splat, front to back", ylabel="grey", xticks=where, ylim=(0.0, 1.3))
left.legend(loc="upper right", ncols=2)
right.bar(where, v_alphas, color=[ACCENT if v > 0.0 else SECOND for v in v_alphas])
right.plot(where, T, color=INK, lw=1.0, label=r"transmittance $T_i$")
right.set(
    xlabel="splat, front to back", ylabel=r"$\partial C / \partial \alpha_i$", xticks=where
)
right.legend()
picture(
    fig,
    "One ray. Where a splat is brighter than the light behind it, more of it makes the pixel brighter (blue), and "
    "darker otherwise (orange); the transmittance in front of it only scales this.",
)

# %% [markdown]
# CUDA programs write the derivative with the sum over what lies behind,
# $S_i = \sum_{j>i} T_j \alpha_j c_j + T_{\mathrm{final}}\, b$, as $T_i c_i - S_i / (1 - \alpha_i)$. It is the same
# number, because $S_i = T_i (1 - \alpha_i) b_i$, but it divides by what an opaque splat makes zero. The walk never
# divides.

# %%
S = np.array([np.sum((T * alphas * q)[i + 1 :]) for i in range(n)]) + pixel.T_final * 0.3
print("by the sum", (T * q - S / (1.0 - alphas)).round(3))
np.testing.assert_allclose(T * q - S / (1.0 - alphas), v_alphas, rtol=1e-12)

# %% [markdown]
# ### Exercise 1: derive
#
# A fourth splat with alpha 1/2 and colour $c$ is put *behind* the first three. (a) What is the derivative with respect
# to its alpha? (b) For which $c$ does that with respect to the first splat's alpha vanish?

# %% answer
# (a) Nothing lies behind it, so it is $T_4 c = c/8$. (b) $b_1$ must be $c_1 = 1/2$. From the back, $b_3 = c/2$,
# $b_2 = 1/2 + c/4$ and $b_1 = 1/8 + 1/4 + c/8$, which is $1/2$ at $c = 1$.
four = v_alphas_of(stack([0.5] * 4, [0.5, 0.25, 1.0, 1.0]), 0.0)
assert (four[3], four[0]) == (1 / 8, 0.0)

# %% [markdown]
# ## From alpha to the splat
#
# At a pixel $p$, $\alpha = o\, e^{-\sigma}$ and $\sigma = \frac12 d^\top Q\, d$ with $d = \mu - p$ and the conic
# $Q = \Sigma^{-1}$ (eq. 11). The chain rule is short:
#
# $$\frac{\partial L}{\partial o} = e^{-\sigma} \frac{\partial L}{\partial \alpha},
# \quad \frac{\partial L}{\partial \sigma} = -\alpha \frac{\partial L}{\partial \alpha},
# \quad \frac{\partial L}{\partial \mu} = \frac{\partial L}{\partial \sigma}\, Q d,
# \quad \frac{\partial L}{\partial Q} = \frac{\partial L}{\partial \sigma} \tfrac12 d d^\top .$$
#
# Note that the gradient of the centre has $\alpha$, and so $o$, as a factor: a faint splat is moved only a little (POP
# paper, eq. 10; chapter 8 comes back to it). Two decisions cut the chain: a splat under the floor 1/255 is skipped
# (D5), and one over the ceiling 0.999 passes nothing, because the clamped alpha does not move (kink B3).
#
# {{source: pop_ref.alpha.alpha_from_sigma_vjp}}
#
# {{source: pop_ref.alpha.sigma_at_pixel_vjp}}

# %%
mean2d, conic = (2.0, 1.0), (1.0, 0.5, 2.0)
d, Q = np.array([1.5, 0.5]), np.array([[1.0, 0.5], [0.5, 2.0]])
sigma = sigma_at_pixel(mean2d, conic, 0.5, 0.5)
assert sigma == 0.5 * d @ Q @ d == 1.75

v_sigma, v_opacity = alpha_from_sigma_vjp(sigma, 0.5, v_alpha=1.0)
np.testing.assert_allclose([v_opacity, v_sigma], [np.exp(-1.75), -0.5 * np.exp(-1.75)])
v_mean2d, v_conic = sigma_at_pixel_vjp(mean2d, conic, 0.5, 0.5, v_sigma)
print("v_mean2d", np.round(v_mean2d, 4), " by the formula", (v_sigma * Q @ d).round(4))
np.testing.assert_allclose(v_mean2d, v_sigma * Q @ d)
# the off-diagonal stands once in the conic and twice in Q
np.testing.assert_allclose(
    v_conic, v_sigma * np.array([d[0] ** 2 / 2, d[0] * d[1], d[1] ** 2 / 2])
)

assert alpha_from_sigma(0.0, 1.0)[0] == 0.999
for sigma in (0.0, 10.0):
    assert alpha_from_sigma_vjp(sigma, 1.0, 1.0) == (0.0, 0.0)

# %% [markdown]
# ## Six sums are enough
#
# Put the halves together. For one splat at one pixel let
#
# $$\Gamma = T \alpha\, (q - \beta) = \alpha \frac{\partial L}{\partial \alpha},$$
#
# the weight that the forward pass had, times the difference between the splat and what it hides. Then
# $\partial L / \partial \sigma = -\Gamma$, and every gradient of the splat's shape and opacity is linear in six sums
# over its pixels, of $\Gamma$ times 1, $d_x$, $d_y$, $d_x^2$, $d_x d_y$ and $d_y^2$:
#
# $$\frac{\partial L}{\partial o} = \frac1o \sum \Gamma, \quad \frac{\partial L}{\partial \mu} = -Q \sum \Gamma\, d,
# \quad \frac{\partial L}{\partial Q} = -\tfrac12 \sum \Gamma\, d d^\top .$$
#
# Read the middle one as forces: where $\Gamma$ is negative, more of this splat would lower the loss, and gradient
# descent pulls its centre there; where $\Gamma$ is positive it pushes the centre away. Here the sums are collected one
# by one and compared with the oracle's gradients.

# %%
rng = np.random.default_rng(2)
n, size = 10, 28
gaussians = Gaussians(
    means=np.column_stack([rng.uniform(-1.0, 1.0, (n, 2)), rng.uniform(3.0, 5.0, n)]),
    quats=rng.normal(size=(n, 4)),
    scales=rng.uniform(0.15, 0.5, (n, 3)),
    opacities=rng.uniform(0.3, 0.9, n),
    sh=rng.uniform(-1.5, 1.5, (n, 1, 3)),
)
camera = Camera(
    np.eye(4), np.array([[40.0, 0, 14.0], [0, 40.0, 14.0], [0, 0, 1.0]]), size, size
)
view = render(gaussians, camera, tile_size=32)
splats, (everyone,) = view.splats, view.tile_lists
# the loss is the distance from grey, 1/2 sum (C - 1/2)^2, so that g = C - 1/2
g = view.image - 0.5

rows = rows_from_splats(splats)
gain, sums = np.zeros((n, size, size)), np.zeros((n, 6))
for y, x in np.ndindex(size, size):
    pixel = composite_pixel(everyone, rows, x + 0.5, y + 0.5, [0.0, 0.0, 0.0])
    behind = 0.0
    blended = list(zip(pixel.ids, pixel.alphas, pixel.weights, strict=True))
    for i, alpha, weight in reversed(blended):
        more = splats.colors[i] @ g[y, x] - behind
        gain[i, y, x] = weight * more
        behind += alpha * more
        dx, dy = splats.means2d[i] - (x + 0.5, y + 0.5)
        sums[i] += gain[i, y, x] * np.array([1.0, dx, dy, dx * dx, dx * dy, dy * dy])

exact = composite_vjp(splats, view.tile_lists, size, size, 32, g)
A, B, C = splats.conics.T
_, gx, gy, *_ = sums.T
np.testing.assert_allclose(sums[:, 0] / splats.opacities, exact.v_opacities, rtol=1e-9)
np.testing.assert_allclose(
    -np.array([A * gx + B * gy, B * gx + C * gy]).T, exact.v_means2d, rtol=1e-9
)
np.testing.assert_allclose(-sums[:, 3:] * [0.5, 1.0, 0.5], exact.v_conics, rtol=1e-9)

# %%
pushed = int(np.argmax(np.linalg.norm(exact.v_means2d, axis=1)))
centre, downhill = splats.means2d[pushed], -exact.v_means2d[pushed]
tip = centre + 6.0 * downhill / np.linalg.norm(downhill)
span = np.max(np.abs(gain[pushed]))
fig, (left, right) = axes(2)
show_image(left, view.image, "render")
signs = {"cmap": DIVERGING, "vmin": -span, "vmax": span}
shown = show_image(right, gain[pushed], r"$\Gamma$ of the splat at the cross", **signs)
fig.colorbar(shown, ax=right, shrink=0.8)
for ax, colour in ((left, "white"), (right, INK)):
    ax.plot(*centre, "+", color=colour)
    ax.annotate("", tip, centre, arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.5})
    ax.set(xlabel="x, px", ylabel="y, px")
picture(
    fig,
    r"The arrow is the way downhill for the splat's centre: the sum of $\Gamma d$ over its pixels, times $Q$.",
)

# %% [markdown]
# ## Is it right? Differences
#
# The oldest check: move one parameter by $\pm h$ and divide. Below, the loss is $\langle V, \mathrm{image} \rangle$
# with a random $V$; the oracle's `render_vjp` gives its gradient with respect to all parameters at once. The error of a
# central difference falls as $h^2$ until rounding, which grows as $1/h$, takes over; with a wrong gradient it would
# stop falling at the size of the mistake. Derivatives hold decisions fixed (which splat is skipped, where a pixel
# stops, which is in front), so the scene is one where none of them flips on the way.

# %%
rng = np.random.default_rng(11)
few = Gaussians(
    means=np.column_stack([rng.uniform(-0.3, 0.3, (4, 2)), [3.0, 3.5, 4.0, 4.5]]),
    quats=rng.normal(size=(4, 4)),
    scales=rng.uniform(0.6, 1.0, (4, 3)),
    opacities=rng.uniform(0.3, 0.7, 4),
    sh=rng.uniform(-0.8, 0.8, (4, 1, 3)),
)
small = Camera(np.eye(4), np.array([[8.0, 0, 3.0], [0, 8.0, 3.0], [0, 0, 1.0]]), 6, 6)
V = rng.normal(size=(6, 6, 3))
NAMES = ("means", "quats", "scales", "opacities", "sh")


def flat(scene):
    """List every parameter, or every gradient, in one vector."""
    return np.concatenate([getattr(scene, name).ravel() for name in NAMES])


def difference(direction, h):
    """Differentiate the loss along a direction of all parameters, by a central difference."""
    images = []
    for sign in (1.0, -1.0):
        parts = np.split(flat(few) + sign * h * direction, [12, 28, 40, 44])
        moved = {
            name: part.reshape(getattr(few, name).shape)
            for name, part in zip(NAMES, parts, strict=True)
        }
        view = render(Gaussians(**moved), small)
        # no decision flips: all four splats blend at every pixel
        assert np.all(view.n_blended == 4)
        images.append(view.image)
    return np.sum(V * (images[0] - images[1])) / (2.0 * h)


by_hand = flat(render_vjp(few, small, V))
assert len(by_hand) == 56
steps = 10.0 ** np.arange(-9.0, -1.0)
by_difference = np.array([[difference(unit, h) for unit in np.eye(56)] for h in steps])
errors = np.linalg.norm(by_difference - by_hand, axis=1) / np.linalg.norm(by_hand)
# a hundredfold for each tenfold, until rounding
np.testing.assert_allclose(errors[-2:] / errors[-3:-1], 100.0, rtol=0.1)
print("step h              ", *(f"{h:6.0e}" for h in steps))
print("relative difference ", *(f"{e:6.0e}" for e in errors))
assert errors.min() < 1e-9 < 1e-8 < errors[0]
# a gradient with a mistake of a thousandth: the difference falls no further than that
slip = 1e-3 * np.linalg.norm(by_hand) * np.eye(56)[5]
stuck = np.linalg.norm(by_difference - (by_hand + slip), axis=1) / np.linalg.norm(by_hand)
np.testing.assert_allclose(stuck[:-1], 1e-3, rtol=0.01)

fig, ax = axes(1, width=4.6, height=2.8)
ax.loglog(steps, errors, "o-", color=ACCENT, label="all 56 parameters")
ax.loglog(
    steps[-4:], errors[-1] * (steps[-4:] / steps[-1]) ** 2, "--", color=MUTED, label=r"$h^2$"
)
ax.set(xlabel="step h", ylabel="relative difference")
ax.legend()
picture(
    fig,
    "Central differences against the gradient by hand: truncation on the right, rounding on the left.",
)

# %% [markdown]
# ## Is it right? One number for all parameters
#
# Differences cost two renders a parameter; the dot-product test costs two in all. The backward pass is the transpose of
# the Jacobian $J$ of the forward pass, so for any direction $u$ of the parameters and any cotangent $v$ of the image
#
# $$\langle v, J u \rangle = \langle J^\top v, u \rangle .$$
#
# The left side is one directional difference, the right side the code under test. With random $u$ and $v$, one wrong
# entry, a forgotten factor or a swapped index parts the two sides.

# %%
u = rng.normal(size=56)
scale = np.linalg.norm(by_hand) * np.linalg.norm(u)
forward = difference(u, 1e-5)
print(f"<v, J u> = {forward:.9f}   <J^T v, u> = {by_hand @ u:.9f}")
assert abs(forward - by_hand @ u) < 1e-7 * scale

# the test can fail: two entries that are swapped are seen
swapped = by_hand.copy()
swapped[[7, 8]] = swapped[[8, 7]]
assert abs(forward - swapped @ u) > 1e-4 * scale

# %% [markdown]
# ### Exercise 2: code
#
# `render_vjp` also returns `means2d`, the gradient with respect to the projected centres, which *density control*
# reads, the rules that add and remove Gaussians (POP paper, eq. 3; chapter 9). Move the principal point of `K`: all
# splats shift together on the screen. Check that the loss changes by the sum of those gradients.


# %% answer
def moved_by(h):
    K = small.K + h * np.array([[0, 0, 0.6], [0, 0, -0.8], [0, 0, 0]])
    return np.sum(V * render(few, replace(small, K=K)).image)


v_shift = render_vjp(few, small, V).means2d.sum(axis=0) @ (0.6, -0.8)
assert np.isclose((moved_by(1e-5) - moved_by(-1e-5)) / 2e-5, v_shift, rtol=1e-6)

# %% [markdown]
# ### Exercise 3: predict
#
# The image jumps where a decision flips. A white splat of opacity 1 stands alone over black. By how much does a pixel
# jump where its alpha crosses the floor, and what does the gradient say on either side?

# %% answer
# From 1/255 to 0, one step of a byte. The gradient is finite above and exactly zero below, and sees no jump.
edge = np.log(255.0)
assert [alpha_from_sigma(edge + e, 1.0)[1] for e in (-1e-9, 1e-9)] == [False, True]
assert np.isclose(alpha_from_sigma_vjp(edge - 1e-9, 1.0, 1.0)[0], -1.0 / 255.0)
assert alpha_from_sigma_vjp(edge + 1e-9, 1.0, 1.0) == (0.0, 0.0)

# %% [markdown]
# ### Exercise 4: find the bug
# The walk from back to front with one mistake. In which pictures does it make no difference?
#
# {{bug: background_behind_forgotten}}

# %% answer
# The light behind the last splat starts at 0 instead of the background's. Over black, and wherever the light is used up
# before the background, nothing changes; over white every gradient of alpha is wrong.
print(caught("background_behind_forgotten"))
